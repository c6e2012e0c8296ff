//! Relocation and growth of MCMC (Kheradmand 2024, Sec. 3.4): dead Gaussians take the place of parts of live ones, new
//! ones are added the same way.
//!
//! A survey weighs every row (one unit each), prefix sums number the dead rows and line the weights up, sources are drawn
//! by weight (one unit per copy), drawn rows are divided (one unit per row), copies are written. A row with a value that
//! is not finite, or absurd, counts as dead; a model in which no row is alive, or that has none, is left alone, and so is
//! one whose status is closed. Parameters and moments are overwritten in place: the caller owns them.
//!
//! Weights are whole numbers whose sum fits 32 bits, so that prefix sums are exact and draws do not depend on the order
//! of additions: a Gaussian on the threshold of death among a million has a weight of some twenty, one of three hundred
//! thousand of some seventy. One read-back of six words tells the host how many rows are dead.

use super::rows::{Listed, PackedRows, Sections, SectionsLaunch, copy_row, select_rows, zero_row};
use super::sweep::{BoundsArgs, BoundsArgsLaunch, NUM_REASONS, broken, broken_counts};
use crate::backend::Refinement;
use crate::densify::relocation::MAX_PARTS;
use crate::event::{BrokenCounts, DensifyReport};
use crate::math::{logit_of_depth, opacity_of_depth, optical_depth, scale_of_parts};
use crate::rng::Stream;
use crate::rng::gpu::{Draws, DrawsLaunch, draw};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::Result;
use gazesplat_render::gpu::{Gpu, cube_dim, packed::PackedLayout};
use gazesplat_render::kernels::gpu::scan::exclusive_scan;

/// Largest weight of a row: what an opacity in `f32` can tell apart.
const MAX_WEIGHT: u32 = 1 << 24;
/// ln((1 − 1e-6) / 1e-6): the largest logit of a part, as on the CPU.
const MAX_LOGIT: f32 = 13.815_51;

/// The rows as sources and as what is to be replaced.
struct Survey {
    /// Weights before each row, `[N + 1]`.
    weights_before: CubeTensor,
    /// 1 for a dead row, `[N]`.
    is_dead: CubeTensor,
    /// Dead rows before each row, `[N + 1]`.
    dead_before: CubeTensor,
    /// Broken rows by reason, `[3]`.
    broken: CubeTensor,
}

/// Weights of the rows as sources (their opacities, 0 for dead ones), the dead rows, and what is wrong with the broken ones.
fn survey(gpu: &Gpu, rows: &PackedRows, refinement: &Refinement) -> Result<Survey> {
    let n = rows.layout.num_rows;
    let [weights, is_dead] = [0; 2].map(|_| gpu.empty("bytes of a survey", &[n], DType::U32));
    let (weights, is_dead) = (weights?, is_dead?);
    let broken = gpu.zeros("bytes of counts", &[NUM_REASONS], DType::U32)?;
    // No row weighs more than this, so that the sum fits 32 bits.
    let scale = (u32::MAX / n as u32).min(MAX_WEIGHT);
    weigh_rows::launch(
        &gpu.client,
        gpu.units(n),
        cube_dim(),
        rows.params.clone().into_buffer_arg(),
        weights.clone().into_buffer_arg(),
        is_dead.clone().into_buffer_arg(),
        broken.clone().into_buffer_arg(),
        SectionsLaunch::of(&rows.layout),
        BoundsArgsLaunch::of(&refinement.bounds),
        refinement.min_opacity,
        scale as f32,
    );
    Ok(Survey {
        weights_before: exclusive_scan(gpu, &weights, n)?,
        dead_before: exclusive_scan(gpu, &is_dead, n)?,
        broken,
        is_dead,
    })
}

/// `count` rows drawn by weight, and the division of the drawn ones done: each keeps its place with the opacity and
/// scale of one of its parts.
fn draw_sources(
    gpu: &Gpu,
    rows: &PackedRows,
    weights_before: &CubeTensor,
    count: usize,
    refinement: &Refinement,
    first_index: usize,
) -> Result<CubeTensor> {
    let n = rows.layout.num_rows;
    let sources = gpu.empty("bytes of sources", &[count], DType::U32)?;
    let num_drawn = gpu.zeros("bytes of counts", &[n], DType::U32)?;
    draw_rows::launch(
        &gpu.client,
        gpu.units(count),
        cube_dim(),
        weights_before.clone().into_buffer_arg(),
        sources.clone().into_buffer_arg(),
        num_drawn.clone().into_buffer_arg(),
        DrawsLaunch::of(refinement.seed, Stream::Sampling, refinement.step),
        first_index as u32,
        count as u32,
        n as u32,
    );
    split_rows::launch(
        &gpu.client,
        gpu.units(n),
        cube_dim(),
        rows.params.clone().into_buffer_arg(),
        rows.first.clone().into_buffer_arg(),
        rows.second.clone().into_buffer_arg(),
        num_drawn.into_buffer_arg(),
        SectionsLaunch::of(&rows.layout),
        // Never below the threshold of death: a part has to get the chance to grow.
        (refinement.min_opacity / (1.0 - refinement.min_opacity)).ln(),
    );
    Ok(sources)
}

/// Moves the dead rows onto live ones, then adds rows.
///
/// # Errors
/// [`gazesplat_render::Error::Limit`] when the model would be larger than the adapter takes, before anything is done;
/// [`gazesplat_render::Error::Device`] when the adapter does not answer.
pub fn refine(
    gpu: &Gpu,
    rows: PackedRows,
    status: &CubeTensor,
    refinement: &Refinement,
) -> Result<(PackedRows, DensifyReport)> {
    let n = rows.layout.num_rows;
    let untouched = DensifyReport { num_gaussians: n, ..DensifyReport::default() };
    if n == 0 {
        return Ok((rows, untouched));
    }
    let num_added = refinement.num_added(n);
    let grown = PackedLayout::new(n + num_added, rows.layout.num_coefficients);
    gpu.check_size("bytes of packed parameters", &[grown.len()], DType::F32)?;
    // 1. Who is dead, and who can be a source.
    let found = survey(gpu, &rows, refinement)?;
    let ([total, num_dead, failed], broken) = read_totals(gpu, &found, status, n)?;
    if total == 0 || failed > 0 {
        return Ok((rows, untouched));
    }
    let num_dead = num_dead as usize;
    // 2. Relocation.
    if num_dead > 0 {
        let sources = draw_sources(gpu, &rows, &found.weights_before, num_dead, refinement, 0)?;
        replace_dead::launch(
            &gpu.client,
            gpu.units(n),
            cube_dim(),
            rows.params.clone().into_buffer_arg(),
            rows.first.clone().into_buffer_arg(),
            rows.second.clone().into_buffer_arg(),
            found.is_dead.into_buffer_arg(),
            found.dead_before.into_buffer_arg(),
            sources.into_buffer_arg(),
            SectionsLaunch::of(&rows.layout),
        );
    }
    // 3. Growth, by the opacities that relocation left.
    let rows = if num_added > 0 {
        let found = survey(gpu, &rows, refinement)?;
        let sources = draw_sources(gpu, &rows, &found.weights_before, num_added, refinement, num_dead)?;
        let select = |from, listed| select_rows(gpu, &rows.layout, from, &grown, &sources, listed);
        PackedRows {
            params: select(rows.params.clone(), Listed::Copied)?,
            first: select(rows.first.clone(), Listed::Zero)?,
            second: select(rows.second.clone(), Listed::Zero)?,
            layout: grown,
        }
    } else {
        rows
    };
    let report = DensifyReport {
        num_relocated: num_dead - broken.total(),
        broken,
        num_added,
        num_gaussians: rows.layout.num_rows,
        ..DensifyReport::default()
    };
    Ok((rows, report))
}

/// Sum of the weights, dead rows and the first word of the status; the broken rows.
fn read_totals(gpu: &Gpu, found: &Survey, status: &CubeTensor, n: usize) -> Result<([u32; 3], BrokenCounts)> {
    let totals = gpu.empty("bytes of counts", &[3], DType::U32)?;
    gather_totals::launch(
        &gpu.client,
        gpu.cubes(1),
        cube_dim(),
        found.weights_before.clone().into_buffer_arg(),
        found.dead_before.clone().into_buffer_arg(),
        status.clone().into_buffer_arg(),
        totals.clone().into_buffer_arg(),
        n as u32,
    );
    let [totals, broken] = gpu.read_all_u32([&totals, &found.broken])?;
    Ok((std::array::from_fn(|i| totals[i]), broken_counts(&broken)))
}

#[cube(launch)]
fn weigh_rows(
    params: &[f32],
    weights: &mut [u32],
    is_dead: &mut [u32],
    num_broken: &mut [Atomic<u32>],
    at: Sections,
    bounds: BoundsArgs,
    min_opacity: f32,
    whole: f32,
) {
    let row = ABSOLUTE_POS;
    if row < at.num_rows as usize {
        let reason = broken(params, &at, &bounds, row);
        let mut weight = 0u32;
        if reason > 0u32 {
            num_broken[reason as usize - 1].fetch_add(1u32);
        } else {
            let opacity = 1.0f32 / (1.0f32 + f32::exp(-params[at.opacity_logits as usize + row]));
            if opacity > min_opacity {
                // `whole` is the weight of an opacity of 1.
                weight = u32::max(1u32, (opacity * whole) as u32);
            }
        }
        let mut dead = 0u32;
        if weight == 0u32 {
            dead = 1u32;
        }
        weights[row] = weight;
        is_dead[row] = dead;
    }
}

#[cube(launch)]
fn gather_totals(weights_before: &[u32], dead_before: &[u32], status: &[u32], totals: &mut [u32], num_rows: u32) {
    if ABSOLUTE_POS == 0 {
        totals[0] = weights_before[num_rows as usize];
        totals[1] = dead_before[num_rows as usize];
        totals[2] = status[0];
    }
}

/// Draws a source for each copy and counts how often each row was drawn. Should no row have a weight, which relocation
/// can bring about when it leaves every row on the threshold of death, the last one is drawn: as dead as all others.
#[cube(launch)]
fn draw_rows(
    weights_before: &[u32],
    sources: &mut [u32],
    num_drawn: &mut [Atomic<u32>],
    draws: Draws,
    first_index: u32,
    count: u32,
    num_rows: u32,
) {
    let i = ABSOLUTE_POS;
    if i < count as usize {
        let words = draw(&draws, first_index + i as u32);
        let total = weights_before[num_rows as usize];
        // 1. 64 random bits times the total, the upper 32 of 96: a whole number below the total.
        let mut u = u32::mul_hi(words.w0, total);
        let low = words.w0 * total;
        let sum = low + u32::mul_hi(words.w1, total);
        if sum < low {
            u += 1u32;
        }
        // 2. The last row before whose weight there is at most u: the one whose weight covers it.
        let mut low_row = 0u32;
        let mut high_row = num_rows;
        while low_row + 1u32 < high_row {
            let middle = (low_row + high_row) / 2u32;
            if weights_before[middle as usize] <= u {
                low_row = middle;
            } else {
                high_row = middle;
            }
        }
        sources[i] = low_row;
        num_drawn[low_row as usize].fetch_add(1u32);
    }
}

/// Divides each drawn row into itself and its copies (MCMC, Eq. 9).
#[cube(launch)]
fn split_rows(
    params: &mut [f32],
    first: &mut [f32],
    second: &mut [f32],
    num_drawn: &[u32],
    at: Sections,
    min_logit: f32,
) {
    let row = ABSOLUTE_POS;
    if row < at.num_rows as usize && num_drawn[row] > 0u32 {
        let parts = u32::min(num_drawn[row] + 1u32, MAX_PARTS as u32);
        let place = at.opacity_logits as usize + row;
        let depth = optical_depth(params[place]);
        let part = depth / parts as f32;
        let scale = scale_of_parts(opacity_of_depth(depth), opacity_of_depth(part), parts);
        params[place] = f32::max(min_logit, f32::min(logit_of_depth(part), MAX_LOGIT));
        let shift = f32::ln(scale);
        for i in 0..3usize {
            params[at.log_scales as usize + 3 * row + i] += shift;
        }
        zero_row(first, &at, row as u32);
        zero_row(second, &at, row as u32);
    }
}

/// Overwrites each dead row with the source drawn for it; sources are alive, so no unit reads what another writes.
#[cube(launch)]
fn replace_dead(
    params: &mut [f32],
    first: &mut [f32],
    second: &mut [f32],
    is_dead: &[u32],
    dead_before: &[u32],
    sources: &[u32],
    at: Sections,
) {
    let row = ABSOLUTE_POS;
    if row < at.num_rows as usize && is_dead[row] == 1u32 {
        let source = sources[dead_before[row] as usize];
        copy_row(params, &at, row as u32, source);
        zero_row(first, &at, row as u32);
        zero_row(second, &at, row as u32);
    }
}
