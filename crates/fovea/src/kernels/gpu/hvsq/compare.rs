//! Pass 2: the grids of two images enlarged, means and standard deviations, their distance, and the gradient by the grids
//! of the first image. In the first kernel a unit is a column of pixels and a row of cells: it compares the pixels of its
//! column that the row contributes to, counts those that begin in the row, and sums gradients over them; in the second a
//! unit is a cell, which gathers what the columns have.

use super::super::pooling::{Pools, Source, inverse_count, up_source, up_start, up_weight};
use super::{Context, Tally, distance_of, tally_sum};
use crate::kernels::cpu::hvsq::MIN_VARIANCE;
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::Result;
use gazesplat_render::gpu::{Gpu, cube_dim};

/// [`MIN_VARIANCE`] as the kernels take it.
const LEAST: f32 = MIN_VARIANCE as f32;

/// Compares `[num_maps, rows of cells, columns of cells, 2]` of two images. The gradient, of the same shape, is by the
/// sums over the samples of a cell (divided by their number already); `None` when not wanted.
///
/// # Errors
/// [`gazesplat_render::Error::Limit`] when a buffer would be larger than the adapter takes.
pub(super) fn grids(
    gpu: &Gpu,
    (found, reference): (&CubeTensor, &CubeTensor),
    pools: &Pools,
    num_maps: usize,
    context: &Context,
    tally: &mut Tally,
) -> Result<Option<CubeTensor>> {
    let (width, height) = (pools.x.num_samples, pools.y.num_samples);
    let (columns, rows) = (pools.x.num_cells, pools.y.num_cells);
    let shape = if context.gradient { vec![num_maps, rows, width, 2] } else { vec![1] };
    let v_rows = gpu.empty("bytes of gradients by pooled statistics", &shape, DType::F32)?;
    let len = num_maps * rows * width;
    let first_sum = tally.reserve(len);
    compare_kernel::launch(
        &gpu.client,
        gpu.units(len),
        cube_dim(),
        found.clone().into_buffer_arg(),
        reference.clone().into_buffer_arg(),
        pools.x.words.clone().into_buffer_arg(),
        pools.y.words.clone().into_buffer_arg(),
        context.weights_or(reference).into_buffer_arg(),
        v_rows.clone().into_buffer_arg(),
        tally.sums.clone().into_buffer_arg(),
        width as u32,
        height as u32,
        columns as u32,
        rows as u32,
        len as u32,
        first_sum,
        context.scale,
        context.is_l1(),
        context.gradient,
        context.weights.is_some(),
    );
    if !context.gradient {
        return Ok(None);
    }
    let v_grids = gpu.empty("bytes of gradients by pooled statistics", &[num_maps, rows, columns, 2], DType::F32)?;
    let len = num_maps * rows * columns;
    gather_kernel::launch(
        &gpu.client,
        gpu.units(len),
        cube_dim(),
        v_rows.into_buffer_arg(),
        pools.x.words.clone().into_buffer_arg(),
        pools.y.words.clone().into_buffer_arg(),
        v_grids.clone().into_buffer_arg(),
        width as u32,
        columns as u32,
        rows as u32,
        len as u32,
    );
    Ok(Some(v_grids))
}

/// Mean and mean square of a pool of the first image, then of the second.
#[derive(CubeType)]
pub(super) struct Pooled {
    pub(super) mean: f32,
    pub(super) square: f32,
    pub(super) other_mean: f32,
    pub(super) other_square: f32,
}

/// `a` with `weight` of the way to `b`.
#[cube]
pub(super) fn mixed(a: f32, b: f32, weight: f32) -> f32 {
    a + weight * (b - a)
}

/// A place in a row of cells of both images, which begins at cell `row`.
#[cube]
fn enlarged(found: &[f32], reference: &[f32], row: usize, across: &Source) -> Pooled {
    let a = 2 * (row + across.first);
    let b = 2 * (row + across.second);
    Pooled {
        mean: mixed(found[a], found[b], across.weight),
        square: mixed(found[a + 1], found[b + 1], across.weight),
        other_mean: mixed(reference[a], reference[b], across.weight),
        other_square: mixed(reference[a + 1], reference[b + 1], across.weight),
    }
}

#[cube]
pub(super) fn mixed_pooled(a: &Pooled, b: &Pooled, weight: f32) -> Pooled {
    Pooled {
        mean: mixed(a.mean, b.mean, weight),
        square: mixed(a.square, b.square, weight),
        other_mean: mixed(a.other_mean, b.other_mean, weight),
        other_square: mixed(a.other_square, b.other_square, weight),
    }
}

/// The distance of two pools and the gradients by the mean and the mean square of the first.
#[derive(CubeType)]
pub(super) struct Compared {
    pub(super) distance: f32,
    pub(super) v_mean: f32,
    pub(super) v_square: f32,
}

/// Distance over mean and standard deviation. Below the smallest variance the latter has no gradient.
#[cube]
pub(super) fn compare_statistics(pooled: &Pooled, scale: f32, #[comptime] is_l1: bool) -> Compared {
    let variance = pooled.square - pooled.mean * pooled.mean;
    let other_variance = pooled.other_square - pooled.other_mean * pooled.other_mean;
    // Comparisons in this order keep NaN.
    let mut clamped = variance;
    if variance < LEAST {
        clamped = LEAST;
    }
    let mut other_clamped = other_variance;
    if other_variance < LEAST {
        other_clamped = LEAST;
    }
    let deviation = f32::sqrt(clamped);
    let of_mean = distance_of(pooled.mean, pooled.other_mean, scale, is_l1);
    let of_deviation = distance_of(deviation, f32::sqrt(other_clamped), scale, is_l1);
    let mut v_variance = of_deviation.slope / (deviation + deviation);
    if variance < LEAST {
        v_variance = 0.0_f32;
    }
    Compared {
        distance: of_mean.value + of_deviation.value,
        v_mean: of_mean.slope - (pooled.mean + pooled.mean) * v_variance,
        v_square: v_variance,
    }
}

#[cube(launch)]
fn compare_kernel(
    found: &[f32],
    reference: &[f32],
    columns: &[u32],
    rows: &[u32],
    weights: &[f32],
    v_rows: &mut [f32],
    sums: &mut [f32],
    width: u32,
    height: u32,
    num_columns: u32,
    num_rows: u32,
    len: u32,
    first_sum: u32,
    scale: f32,
    #[comptime] is_l1: bool,
    #[comptime] gradient: bool,
    #[comptime] weighted: bool,
) {
    let (width, height) = (width as usize, height as usize);
    let (num_columns, num_rows) = (num_columns as usize, num_rows as usize);
    let mut sum = 0.0_f32;
    if ABSOLUTE_POS < len as usize {
        let x = ABSOLUTE_POS % width;
        let i = ABSOLUTE_POS / width % num_rows;
        let map = ABSOLUTE_POS / (width * num_rows) * num_rows;
        // 1. The row of cells and those above and below it, enlarged to this column.
        let across = up_source(columns, width, num_columns, x);
        let before = i.max(1) - 1;
        let behind = (i + 1).min(num_rows - 1);
        let own = enlarged(found, reference, (map + i) * num_columns, &across);
        let upper = enlarged(found, reference, (map + before) * num_columns, &across);
        let lower = enlarged(found, reference, (map + behind) * num_columns, &across);
        // 2. Pixels that begin in the row above, which only the gradient needs, then those that begin in this one.
        let begin = up_start(rows, height, num_rows, i);
        let mut v_mean = 0.0_f32;
        let mut v_square = 0.0_f32;
        if comptime![gradient] {
            for y in up_start(rows, height, num_rows, before)..begin {
                let weight = up_weight(rows, height, num_rows, i, y);
                let compared = compare_statistics(&mixed_pooled(&upper, &own, weight), scale, is_l1);
                let mut v_weight = weight;
                if comptime![weighted] {
                    v_weight *= weights[y * width + x];
                }
                v_mean += v_weight * compared.v_mean;
                v_square += v_weight * compared.v_square;
            }
        }
        for y in begin..up_start(rows, height, num_rows, i + 1) {
            let own_weight = up_weight(rows, height, num_rows, i, y);
            let down = up_source(rows, height, num_rows, y);
            let compared = compare_statistics(&mixed_pooled(&own, &lower, down.weight), scale, is_l1);
            let mut distance = compared.distance;
            let mut v_weight = own_weight;
            if comptime![weighted] {
                distance *= weights[y * width + x];
                v_weight *= weights[y * width + x];
            }
            sum += distance;
            if comptime![gradient] {
                v_mean += v_weight * compared.v_mean;
                v_square += v_weight * compared.v_square;
            }
        }
        if comptime![gradient] {
            v_rows[2 * ABSOLUTE_POS] = v_mean;
            v_rows[2 * ABSOLUTE_POS + 1] = v_square;
        }
    }
    // 3. The distances of the workgroup.
    tally_sum(sums, sum, first_sum, len as usize, scale);
}

#[cube(launch)]
fn gather_kernel(
    v_rows: &[f32],
    columns: &[u32],
    rows: &[u32],
    v_grids: &mut [f32],
    width: u32,
    num_columns: u32,
    num_rows: u32,
    len: u32,
) {
    let width = width as usize;
    let (num_columns, num_rows) = (num_columns as usize, num_rows as usize);
    if ABSOLUTE_POS < len as usize {
        let j = ABSOLUTE_POS % num_columns;
        let row = ABSOLUTE_POS / num_columns;
        let mut v_mean = 0.0_f32;
        let mut v_square = 0.0_f32;
        for x in up_start(columns, width, num_columns, j.max(1) - 1)..up_start(columns, width, num_columns, j + 1) {
            let weight = up_weight(columns, width, num_columns, j, x);
            v_mean += weight * v_rows[2 * (row * width + x)];
            v_square += weight * v_rows[2 * (row * width + x) + 1];
        }
        let count = inverse_count(rows, num_rows, row % num_rows) * inverse_count(columns, num_columns, j);
        v_grids[2 * ABSOLUTE_POS] = v_mean * count;
        v_grids[2 * ABSOLUTE_POS + 1] = v_square * count;
    }
}
