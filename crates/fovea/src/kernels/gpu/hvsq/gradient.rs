//! Pass 3: gradients by responses, in the place of the responses, and the adjoints of the filters. A unit computes one
//! value.

use super::super::pooling::{Pools, end_cell, first_cell};
use super::super::pyramid::{Group, Planes, correlate_bwd};
use super::{Context, Tally, distance_of, tally_sum};
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::gpu::{Gpu, cube_dim};

/// Where gradients by responses come from.
#[derive(Debug, Clone, Copy)]
pub(super) enum Source<'a> {
    /// Gradients by the pooled grids, as the second pass leaves them.
    Grids(&'a CubeTensor, &'a Pools),
    /// Distance of the responses to these, or to zero.
    Responses(Option<&'a CubeTensor>),
}

/// Adds the gradient by the planes to `v_planes`, where there are any; tallies distances of responses where they are the
/// source. What `responses` holds is overwritten.
pub(super) fn add(
    gpu: &Gpu,
    responses: &Planes,
    group: &Group,
    source: Source<'_>,
    context: &Context,
    tally: &mut Tally,
    v_planes: Option<&Planes>,
) {
    match source {
        Source::Grids(v_grids, pools) => spread(gpu, responses, v_grids, pools),
        Source::Responses(reference) => compare_responses(gpu, responses, reference, context, tally),
    }
    if let Some(v_planes) = v_planes {
        correlate_bwd(gpu, responses, group, v_planes);
    }
}

/// Distances of responses, which the gradients by them take the place of when they are wanted.
pub(super) fn compare_responses(
    gpu: &Gpu,
    responses: &Planes,
    reference: Option<&CubeTensor>,
    context: &Context,
    tally: &mut Tally,
) {
    let len = responses.len();
    let first_sum = tally.reserve(len);
    // Something has to be bound where there is no reference; it may not be what is written.
    let bound = reference.cloned().unwrap_or_else(|| gpu.upload_f32(&[0.0], &[1]));
    compare_responses_kernel::launch(
        &gpu.client,
        gpu.units(len),
        cube_dim(),
        responses.data.clone().into_buffer_arg(),
        bound.clone().into_buffer_arg(),
        context.weights_or(&bound).into_buffer_arg(),
        tally.sums.clone().into_buffer_arg(),
        (responses.width * responses.height) as u32,
        len as u32,
        first_sum,
        context.scale,
        context.is_l1(),
        context.gradient,
        context.weights.is_some(),
        reference.is_some(),
    );
}

/// ∂/∂x = Dᵀ of the gradients by the means + 2 x Dᵀ of those by the mean squares, in the place of the responses x.
fn spread(gpu: &Gpu, responses: &Planes, v_grids: &CubeTensor, pools: &Pools) {
    spread_kernel::launch(
        &gpu.client,
        gpu.units(responses.len()),
        cube_dim(),
        responses.data.clone().into_buffer_arg(),
        v_grids.clone().into_buffer_arg(),
        pools.x.words.clone().into_buffer_arg(),
        pools.y.words.clone().into_buffer_arg(),
        responses.width as u32,
        responses.height as u32,
        pools.x.num_cells as u32,
        pools.y.num_cells as u32,
        responses.len() as u32,
    );
}

#[cube(launch)]
fn compare_responses_kernel(
    responses: &mut [f32],
    reference: &[f32],
    weights: &[f32],
    sums: &mut [f32],
    size: u32,
    len: u32,
    first_sum: u32,
    scale: f32,
    #[comptime] is_l1: bool,
    #[comptime] gradient: bool,
    #[comptime] weighted: bool,
    #[comptime] has_reference: bool,
) {
    let mut sum = 0.0_f32;
    if ABSOLUTE_POS < len as usize {
        let mut other = 0.0_f32;
        if comptime![has_reference] {
            other = reference[ABSOLUTE_POS];
        }
        let compared = distance_of(responses[ABSOLUTE_POS], other, scale, is_l1);
        sum = compared.value;
        let mut v = compared.slope;
        if comptime![weighted] {
            let weight = weights[ABSOLUTE_POS % size as usize];
            sum *= weight;
            v *= weight;
        }
        if comptime![gradient] {
            responses[ABSOLUTE_POS] = v;
        }
    }
    tally_sum(sums, sum, first_sum, len as usize, scale);
}

#[cube(launch)]
fn spread_kernel(
    responses: &mut [f32],
    v_grids: &[f32],
    columns: &[u32],
    rows: &[u32],
    width: u32,
    height: u32,
    num_columns: u32,
    num_rows: u32,
    len: u32,
) {
    let (width, height) = (width as usize, height as usize);
    let (num_columns, num_rows) = (num_columns as usize, num_rows as usize);
    if ABSOLUTE_POS < len as usize {
        let x = ABSOLUTE_POS % width;
        let y = ABSOLUTE_POS / width % height;
        let map = ABSOLUTE_POS / (width * height) * num_rows;
        let mut v_mean = 0.0_f32;
        let mut v_square = 0.0_f32;
        for i in first_cell(rows, num_rows, y)..end_cell(rows, height, num_rows, y) {
            for j in first_cell(columns, num_columns, x)..end_cell(columns, width, num_columns, x) {
                let at = 2 * ((map + i) * num_columns + j);
                v_mean += v_grids[at];
                v_square += v_grids[at + 1];
            }
        }
        let value = responses[ABSOLUTE_POS];
        responses[ABSOLUTE_POS] = v_mean + (value + value) * v_square;
    }
}
