//! Adaptive density control (3DGS, Sec. 5.2): the statistic by which Gaussians grow, and the clones, parts and removals that
//! follow from it.
//!
//! The statistic takes one unit per row in view; gradients that are not finite were zeroed by the renderer. The change
//! surveys every row (one unit each); the host reads four words of each, decides on the whole as for a CPU, and says which
//! row each new one begins as. Copies are written, and one unit per part moves it. Kept rows keep their moments, new ones
//! have none. Draws depend on seed, step and row only. A model of which no row would be left is left alone, and so is an
//! empty one or one whose status is closed. Units beyond the last row do nothing.

use super::rows::{Listed, PackedRows, Sections, SectionsLaunch, clamp_opacities, zero_row};
use super::sweep::{BoundsArgs, BoundsArgsLaunch, broken};
use crate::backend::{Densification, StatisticStep};
use crate::densify::Broken;
use crate::densify::growth::{Decision, Figures, SPLIT_LOG_SCALE, decide};
use crate::event::DensifyReport;
use crate::math::{image_norm, normals, shaped};
use crate::rng::Stream;
use crate::rng::gpu::{Draws, DrawsLaunch, draw};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::Result;
use gazesplat_render::gpu::{Gpu, cube_dim, packed::PackedLayout};
use gazesplat_render::math::quat::Quat;
use gazesplat_render::math::vec::Vec3;

/// Words of a row in a survey.
const NUM_FIGURES: usize = 4;

/// Adds the gradients of one view, `[N, 4]`, to the statistic, `[N, 2]`: norm and count of the rows `visible`. `statistic` is
/// overwritten in place.
pub fn add_statistic(
    gpu: &Gpu,
    statistic: &CubeTensor,
    gradient: &CubeTensor,
    visible: &CubeTensor,
    step: &StatisticStep,
) {
    if step.num_visible == 0 {
        return;
    }
    add_norms::launch(
        &gpu.client,
        gpu.units(step.num_visible),
        cube_dim(),
        statistic.clone().into_buffer_arg(),
        gradient.clone().into_buffer_arg(),
        visible.clone().into_buffer_arg(),
        step.half_size[0],
        step.half_size[1],
        if step.absolute { 2 } else { 0 },
        step.num_visible as u32,
    );
}

#[cube(launch)]
fn add_norms(
    statistic: &mut [f32],
    gradient: &[f32],
    visible: &[u32],
    half_width: f32,
    half_height: f32,
    first: u32,
    num_visible: u32,
) {
    if ABSOLUTE_POS < num_visible as usize {
        let row = visible[ABSOLUTE_POS] as usize;
        let from = 4 * row + first as usize;
        statistic[2 * row] += image_norm(half_width * gradient[from], half_height * gradient[from + 1]);
        statistic[2 * row + 1] += 1.0f32;
    }
}

/// What the decision reads of every row, and the first word of the status.
fn survey(
    gpu: &Gpu,
    rows: &PackedRows,
    status: &CubeTensor,
    statistic: &CubeTensor,
    d: &Densification,
) -> Result<(Vec<Figures>, u32)> {
    let n = rows.layout.num_rows;
    let figures = gpu.empty("bytes of a survey", &[n, NUM_FIGURES], DType::U32)?;
    survey_rows::launch(
        &gpu.client,
        gpu.units(n),
        cube_dim(),
        rows.params.clone().into_buffer_arg(),
        statistic.clone().into_buffer_arg(),
        figures.clone().into_buffer_arg(),
        SectionsLaunch::of(&rows.layout),
        BoundsArgsLaunch::of(&d.bounds),
    );
    let [words, status] = gpu.read_all_u32([&figures, status])?;
    let (words, _) = words.as_chunks::<NUM_FIGURES>();
    let figures = words.iter().map(|&[statistic, log_scale, opacity_logit, reason]| Figures {
        statistic: f32::from_bits(statistic),
        log_scale: f32::from_bits(log_scale),
        opacity_logit: f32::from_bits(opacity_logit),
        broken: Broken::from_word(reason),
    });
    Ok((figures.collect(), status[0]))
}

#[cube(launch)]
fn survey_rows(params: &[f32], statistic: &[f32], figures: &mut [u32], at: Sections, bounds: BoundsArgs) {
    let row = ABSOLUTE_POS;
    if row < at.num_rows as usize {
        let count = statistic[2 * row + 1];
        let mut mean = 0.0f32;
        if count > 0.0f32 {
            mean = statistic[2 * row] / count;
        }
        let s = at.log_scales as usize + 3 * row;
        let largest = f32::max(f32::max(params[s], params[s + 1]), params[s + 2]);
        let to = NUM_FIGURES * row;
        figures[to] = u32::reinterpret(mean);
        figures[to + 1] = u32::reinterpret(largest);
        figures[to + 2] = u32::reinterpret(params[at.opacity_logits as usize + row]);
        figures[to + 3] = broken(params, &at, &bounds, row);
    }
}

/// Clones, splits and removes rows, then lowers the opacities when it is time.
///
/// # Errors
/// [`gazesplat_render::Error::Limit`] when the model would be larger than the adapter takes, before anything is done;
/// [`gazesplat_render::Error::Device`] when the adapter does not answer.
pub fn densify(
    gpu: &Gpu,
    rows: PackedRows,
    status: &CubeTensor,
    statistic: &CubeTensor,
    d: &Densification,
) -> Result<(PackedRows, DensifyReport)> {
    let n = rows.layout.num_rows;
    let untouched = DensifyReport { num_gaussians: n, ..DensifyReport::default() };
    // 1. What becomes of the rows.
    let (figures, failed) = survey(gpu, &rows, status, statistic, d)?;
    let Some(decision) = decide(&figures, d).filter(|_| failed == 0) else { return Ok((rows, untouched)) };
    let mut report = decision.report;
    let rows = if decision.is_nothing(n) { rows } else { rebuilt(gpu, &rows, &decision, d)? };
    // 4. Opacities.
    if let Some(logit) = d.reset_logit {
        clamp_opacities(gpu, &rows.layout, &rows.params, &rows.first, &rows.second, logit);
        report.num_opacity_resets = 1;
    }
    Ok((rows, report))
}

/// The rows that `decision` leaves, in buffers of their own.
fn rebuilt(gpu: &Gpu, rows: &PackedRows, decision: &Decision, d: &Densification) -> Result<PackedRows> {
    let sources = decision.sources();
    let num_rows = sources.len();
    let layout = PackedLayout::new(num_rows, rows.layout.num_coefficients);
    gpu.check_size("bytes of packed parameters", &[layout.len()], DType::F32)?;
    let list = gpu.upload_u32(&sources, &[num_rows]);
    // 2. Copies, of which only the kept rows have moments.
    let rows = rows.selected(gpu, layout, &list, Listed::Only)?;
    let num_kept = decision.kept.len();
    if num_rows > num_kept {
        for moments in [&rows.first, &rows.second] {
            forget_rows::launch(
                &gpu.client,
                gpu.units(num_rows - num_kept),
                cube_dim(),
                moments.clone().into_buffer_arg(),
                SectionsLaunch::of(&rows.layout),
                num_kept as u32,
            );
        }
    }
    // 3. Parts.
    if !decision.split.is_empty() {
        part::launch(
            &gpu.client,
            gpu.units(2 * decision.split.len()),
            cube_dim(),
            rows.params.clone().into_buffer_arg(),
            list.into_buffer_arg(),
            SectionsLaunch::of(&rows.layout),
            DrawsLaunch::of(d.seed, Stream::Sampling, d.step),
            decision.first_part() as u32,
        );
    }
    Ok(rows)
}

/// Forgets the values of the rows from `first_row` on.
#[cube(launch)]
fn forget_rows(values: &mut [f32], at: Sections, first_row: u32) {
    let row = ABSOLUTE_POS as u32 + first_row;
    if row < at.num_rows {
        zero_row(values, &at, row);
    }
}

/// Moves the parts of split rows to places drawn from the Gaussian they replace, and makes them smaller.
#[cube(launch)]
fn part(params: &mut [f32], sources: &[u32], at: Sections, draws: Draws, first_part: u32) {
    let k = ABSOLUTE_POS as u32;
    let row = (k + first_part) as usize;
    if row < at.num_rows as usize {
        let words = draw(&draws, 2u32 * sources[row] + k % 2u32);
        let q = at.quats as usize + 4 * row;
        let s = at.log_scales as usize + 3 * row;
        let offset = shaped(
            Quat { w: params[q], x: params[q + 1], y: params[q + 2], z: params[q + 3] },
            Vec3 { x: params[s], y: params[s + 1], z: params[s + 2] },
            normals(words.w0, words.w1, words.w2, words.w3),
        );
        params[3 * row] += offset.x;
        params[3 * row + 1] += offset.y;
        params[3 * row + 2] += offset.z;
        for i in 0..3usize {
            params[s + i] -= SPLIT_LOG_SCALE;
        }
    }
}
