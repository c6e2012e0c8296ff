//! Scale decay (RTGS Eq. 4–6): the gradient that shrinks Gaussians in many tiles.
//!
//! One unit per row writes into its own three gradients. A row with a value that is not finite is culled, in no tile, and
//! left alone; units beyond the last row do nothing; an empty model is never handed over.

use crate::math::excess_tiles;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::gpu::{Gpu, cube_dim};

/// Adds `factor` · S_i · G_i to the gradient of the largest log scale of each row, as the twin on the CPU does. `grads` is
/// overwritten in place.
pub fn add_scale_decay(gpu: &Gpu, log_scales: &CubeTensor, grads: &CubeTensor, used: &CubeTensor, factor: f32) {
    let num_rows = used.meta.num_elements();
    decay::launch(
        &gpu.client,
        gpu.units(num_rows),
        cube_dim(),
        log_scales.clone().into_buffer_arg(),
        grads.clone().into_buffer_arg(),
        used.clone().into_buffer_arg(),
        factor,
        num_rows as u32,
    );
}

#[cube(launch)]
fn decay(log_scales: &[f32], grads: &mut [f32], used: &[u32], factor: f32, num_rows: u32) {
    let row = ABSOLUTE_POS;
    if row < num_rows as usize {
        let excess = excess_tiles(used[row]);
        if excess > 0.0f32 {
            let axis = largest_axis(log_scales[3 * row], log_scales[3 * row + 1], log_scales[3 * row + 2]);
            let at = 3 * row + axis as usize;
            grads[at] += factor * f32::exp(log_scales[at]) * excess;
        }
    }
}

/// The axis of the largest of three values, the first on ties.
#[cube]
pub fn largest_axis(x: f32, y: f32, z: f32) -> u32 {
    let mut axis = 0u32;
    let mut largest = x;
    if y > largest {
        axis = 1u32;
        largest = y;
    }
    if z > largest {
        axis = 2u32;
    }
    axis
}
