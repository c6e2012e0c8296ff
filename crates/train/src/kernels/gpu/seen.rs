//! Adam for the SH coefficients of the Gaussians that a view may see; the others' are left until they are needed.
//!
//! As on the CPU, with the words of the rows in a buffer that is overwritten in place. One unit per row marks it and writes
//! down how many updates its values have missed; one unit per SH coefficient does the rest. Nothing is read back, and
//! nothing is done while the status is closed. NaN stays in its value; an empty model is never handed over.

use super::adam::{Constants, ConstantsLaunch, flushed};
use super::rows::PackedRows;
use super::rows::{Sections, SectionsLaunch};
use crate::backend::{AdamUpdate, MissedUpdates};
use crate::kernels::cpu::adam::Step;
use crate::math::may_be_seen;
use crate::optim::SeenBy;
use crate::optim::missed::{ENTRY, PREPARED, flattened, missed};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::Result;
use gazesplat_render::gpu::{Gpu, cube_dim, packed::PackedLayout};
use gazesplat_render::kernels::gpu::project::{row3, sides_launch};
use gazesplat_render::math::frustum::{Side, SideLaunch, Sides};
use gazesplat_render::math::vec::Vec3Launch;

/// What rows have missed up to one update, on a device.
#[derive(Debug, Clone)]
struct Missing {
    table: CubeTensor,
    updates: MissedUpdates,
}

impl Missing {
    fn new(gpu: &Gpu, updates: MissedUpdates) -> Self {
        let table = flattened(&missed(&updates.settings, updates.through));
        Self { table: gpu.upload_f32(&table, &[table.len()]), updates }
    }
}

/// Marks the rows that `view` may see, and brings their SH coefficients up to date.
///
/// # Errors
/// [`gazesplat_render::Error::Limit`] when a buffer is larger than the adapter takes.
pub fn prepare(
    gpu: &Gpu,
    rows: &PackedRows,
    last: &CubeTensor,
    status: &CubeTensor,
    view: &SeenBy,
    updates: MissedUpdates,
) -> Result<()> {
    let n = rows.layout.num_rows;
    let gaps = gpu.empty("bytes of missed updates", &[n], DType::U32)?;
    let Side { normal, offset, pad } = view.front;
    mark_rows::launch(
        &gpu.client,
        gpu.units(n),
        cube_dim(),
        rows.params.clone().into_buffer_arg(),
        last.clone().into_buffer_arg(),
        gaps.clone().into_buffer_arg(),
        status.clone().into_buffer_arg(),
        SectionsLaunch::of(&rows.layout),
        sides_launch(&view.sides),
        SideLaunch::new(Vec3Launch::new(normal.x, normal.y, normal.z), offset, pad),
        updates.through,
    );
    advance_by(gpu, rows, &gaps, &Missing::new(gpu, updates));
    Ok(())
}

/// Brings the SH coefficients of all rows up to date, and nothing else.
///
/// # Errors
/// As [`prepare`].
pub fn advance(
    gpu: &Gpu,
    rows: &PackedRows,
    last: &CubeTensor,
    status: &CubeTensor,
    updates: MissedUpdates,
) -> Result<()> {
    advance_all(gpu, rows, last, status, &Missing::new(gpu, updates))
}

fn advance_all(gpu: &Gpu, rows: &PackedRows, last: &CubeTensor, status: &CubeTensor, missing: &Missing) -> Result<()> {
    let n = rows.layout.num_rows;
    let gaps = gpu.empty("bytes of missed updates", &[n], DType::U32)?;
    note_gaps::launch(
        &gpu.client,
        gpu.units(n),
        cube_dim(),
        last.clone().into_buffer_arg(),
        gaps.clone().into_buffer_arg(),
        status.clone().into_buffer_arg(),
        missing.updates.through,
        n as u32,
    );
    advance_by(gpu, rows, &gaps, missing);
    Ok(())
}

fn advance_by(gpu: &Gpu, rows: &PackedRows, gaps: &CubeTensor, missing: &Missing) {
    let num_values = num_values(&rows.layout);
    advance_values::launch(
        &gpu.client,
        gpu.units(num_values),
        cube_dim(),
        rows.params.clone().into_buffer_arg(),
        rows.first.clone().into_buffer_arg(),
        rows.second.clone().into_buffer_arg(),
        gaps.clone().into_buffer_arg(),
        missing.table.clone().into_buffer_arg(),
        SectionsLaunch::of(&rows.layout),
        missing.updates.rates.dc,
        missing.updates.rates.rest,
        num_values as u32,
    );
}

/// Brings values and moments of all rows up to date; their words mean nothing afterwards.
///
/// # Errors
/// As [`prepare`].
pub fn catch_up(
    gpu: &Gpu,
    rows: &PackedRows,
    last: &CubeTensor,
    status: &CubeTensor,
    updates: MissedUpdates,
) -> Result<()> {
    let missing = Missing::new(gpu, updates);
    advance_all(gpu, rows, last, status, &missing)?;
    let num_values = num_values(&rows.layout);
    decay_moments::launch(
        &gpu.client,
        gpu.units(num_values),
        cube_dim(),
        rows.first.clone().into_buffer_arg(),
        rows.second.clone().into_buffer_arg(),
        last.clone().into_buffer_arg(),
        status.clone().into_buffer_arg(),
        missing.table.into_buffer_arg(),
        SectionsLaunch::of(&rows.layout),
        updates.through,
        num_values as u32,
    );
    Ok(())
}

/// One update of the SH coefficients of the marked rows.
pub fn update_seen(
    gpu: &Gpu,
    rows: &PackedRows,
    grads: &CubeTensor,
    last: &CubeTensor,
    status: &CubeTensor,
    update: &AdamUpdate,
) {
    let step = Step::new(&update.settings, update.number);
    let through = update.number - 1;
    let table = flattened(&missed(&update.settings, through));
    let num_values = num_values(&rows.layout);
    update_values::launch(
        &gpu.client,
        gpu.units(num_values),
        cube_dim(),
        rows.params.clone().into_buffer_arg(),
        grads.clone().into_buffer_arg(),
        rows.first.clone().into_buffer_arg(),
        rows.second.clone().into_buffer_arg(),
        last.clone().into_buffer_arg(),
        status.clone().into_buffer_arg(),
        gpu.upload_f32(&table, &[table.len()]).into_buffer_arg(),
        SectionsLaunch::of(&rows.layout),
        ConstantsLaunch::new(
            step.beta1,
            step.one_minus_beta1,
            step.beta2,
            step.one_minus_beta2,
            step.epsilon,
            step.weight_decay,
            step.inverse_sqrt_bias2,
        ),
        step.rate(update.rates.sh_dc),
        step.rate(update.rates.sh_rest),
        through,
        num_values as u32,
    );
    unmark_rows::launch(
        &gpu.client,
        gpu.units(rows.layout.num_rows),
        cube_dim(),
        last.clone().into_buffer_arg(),
        status.clone().into_buffer_arg(),
        update.number,
        rows.layout.num_rows as u32,
    );
}

/// SH coefficients of all rows.
fn num_values(layout: &PackedLayout) -> usize {
    layout.num_rows * layout.widths()[4]
}

/// Updates between the one a word names and `through`.
#[cube]
fn missed_by(word: u32, through: u32) -> u32 {
    let last = word & !PREPARED;
    let mut gap = 0u32;
    if last < through {
        gap = through - last;
    }
    gap
}

#[cube(launch)]
fn mark_rows(
    params: &[f32],
    last: &mut [u32],
    gaps: &mut [u32],
    status: &[u32],
    at: Sections,
    sides: Sides,
    front: Side,
    through: u32,
) {
    let row = ABSOLUTE_POS;
    if row < at.num_rows as usize {
        let word = last[row];
        let mut gap = 0u32;
        if status[0] == 0u32 && word < PREPARED {
            let s = at.log_scales as usize + 3 * row;
            let scale = f32::exp(f32::max(f32::max(params[s], params[s + 1]), params[s + 2]));
            if may_be_seen(sides, front, row3(params, row), scale) {
                gap = missed_by(word, through);
                last[row] = word | PREPARED;
            }
        }
        gaps[row] = gap;
    }
}

#[cube(launch)]
fn note_gaps(last: &[u32], gaps: &mut [u32], status: &[u32], through: u32, num_rows: u32) {
    let row = ABSOLUTE_POS;
    if row < num_rows as usize {
        let mut gap = 0u32;
        if status[0] == 0u32 && last[row] < PREPARED {
            gap = missed_by(last[row], through);
        }
        gaps[row] = gap;
    }
}

#[cube(launch)]
fn advance_values(
    params: &mut [f32],
    first: &[f32],
    second: &[f32],
    gaps: &[u32],
    table: &[f32],
    at: Sections,
    rate_dc: f32,
    rate_rest: f32,
    len: u32,
) {
    if ABSOLUTE_POS < len as usize {
        let i = ABSOLUTE_POS as u32;
        let gap = gaps[(i / at.sh_width) as usize];
        if gap > 0u32 {
            let entry = gap as usize * ENTRY;
            let place = (at.sh + i) as usize;
            let mut rate = rate_rest;
            if i % at.sh_width < 3u32 {
                rate = rate_dc;
            }
            let root = f32::sqrt(second[place]);
            // Both fractions over one denominator: it is 1e-30 at least.
            let a = root + table[entry + 2];
            let b = root + table[entry + 3];
            params[place] -= rate * (first[place] * ((table[entry] * b + table[entry + 1] * a) / (a * b)));
        }
    }
}

#[cube(launch)]
fn decay_moments(
    first: &mut [f32],
    second: &mut [f32],
    last: &[u32],
    status: &[u32],
    table: &[f32],
    at: Sections,
    through: u32,
    len: u32,
) {
    if ABSOLUTE_POS < len as usize && status[0] == 0u32 {
        let i = ABSOLUTE_POS as u32;
        let gap = missed_by(last[(i / at.sh_width) as usize], through);
        if gap > 0u32 {
            let entry = gap as usize * ENTRY;
            let place = (at.sh + i) as usize;
            first[place] = flushed(first[place] * table[entry + 4]);
            second[place] = flushed(second[place] * table[entry + 5]);
        }
    }
}

#[cube(launch)]
fn update_values(
    params: &mut [f32],
    grads: &[f32],
    first: &mut [f32],
    second: &mut [f32],
    last: &[u32],
    status: &[u32],
    table: &[f32],
    at: Sections,
    step: Constants,
    rate_dc: f32,
    rate_rest: f32,
    through: u32,
    len: u32,
) {
    if ABSOLUTE_POS < len as usize && status[0] == 0u32 {
        let i = ABSOLUTE_POS as u32;
        let word = last[(i / at.sh_width) as usize];
        if word >= PREPARED {
            let entry = missed_by(word, through) as usize * ENTRY;
            let place = (at.sh + i) as usize;
            let mut rate = rate_rest;
            if i % at.sh_width < 3u32 {
                rate = rate_dc;
            }
            let p = params[place];
            let g = grads[place] + step.weight_decay * p;
            let before = flushed(first[place] * table[entry + 4]);
            let before2 = flushed(second[place] * table[entry + 5]);
            let m = flushed(step.beta1 * before + step.one_minus_beta1 * g);
            let v = flushed(step.beta2 * before2 + step.one_minus_beta2 * g * g);
            first[place] = m;
            second[place] = v;
            params[place] = p - rate * m / (f32::sqrt(v) * step.inverse_sqrt_bias2 + step.epsilon);
        }
    }
}

#[cube(launch)]
fn unmark_rows(last: &mut [u32], status: &[u32], number: u32, num_rows: u32) {
    if ABSOLUTE_POS < num_rows as usize && status[0] == 0u32 && last[ABSOLUTE_POS] >= PREPARED {
        last[ABSOLUTE_POS] = number;
    }
}
