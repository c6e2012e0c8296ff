//! Position noise of stochastic gradient Langevin dynamics (MCMC, Eq. 8), with the draws of the CPU.
//!
//! One unit per row reads its parameters and overwrites its mean: the caller owns them. Coordinates that would not be
//! finite are left alone, and so is everything while the status is closed.

use super::rows::{Sections, SectionsLaunch};
use crate::backend::NoiseUpdate;
use crate::math::{covariance_times, gate, logit_limit, normals};
use crate::rng::Stream;
use crate::rng::gpu::{Draws, DrawsLaunch, draw};
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::gpu::device_fn::is_finite;
use gazesplat_render::gpu::{Gpu, cube_dim, packed::PackedLayout};
use gazesplat_render::math::quat::Quat;
use gazesplat_render::math::vec::Vec3;

/// Adds noise to the means.
pub fn add_noise(gpu: &Gpu, layout: &PackedLayout, params: &CubeTensor, status: &CubeTensor, noise: &NoiseUpdate) {
    shift_means::launch(
        &gpu.client,
        gpu.units(layout.num_rows),
        cube_dim(),
        params.clone().into_buffer_arg(),
        status.clone().into_buffer_arg(),
        SectionsLaunch::of(layout),
        DrawsLaunch::of(noise.seed, Stream::Noise, noise.step),
        noise.strength,
        logit_limit(),
    );
}

#[cube(launch)]
fn shift_means(params: &mut [f32], status: &[u32], at: Sections, draws: Draws, strength: f32, logit_limit: f32) {
    let row = ABSOLUTE_POS;
    if row < at.num_rows as usize && status[0] == 0u32 {
        let logit = params[at.opacity_logits as usize + row];
        if is_finite(logit) && logit <= logit_limit {
            let words = draw(&draws, row as u32);
            let q = at.quats as usize + 4 * row;
            let s = at.log_scales as usize + 3 * row;
            let shaped = covariance_times(
                Quat { w: params[q], x: params[q + 1], y: params[q + 2], z: params[q + 3] },
                Vec3 { x: params[s], y: params[s + 1], z: params[s + 2] },
                normals(words.w0, words.w1, words.w2, words.w3),
            );
            let factor = strength * gate(logit);
            shift(params, 3 * row, factor * shaped.x);
            shift(params, 3 * row + 1, factor * shaped.y);
            shift(params, 3 * row + 2, factor * shaped.z);
        }
    }
}

#[cube]
fn shift(params: &mut [f32], at: usize, distance: f32) {
    let moved = params[at] + distance;
    if is_finite(moved) {
        params[at] = moved;
    }
}
