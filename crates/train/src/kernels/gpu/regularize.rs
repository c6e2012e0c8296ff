//! Regularisers of MCMC (Kheradmand 2024, Eq. 10): the mean opacity and the mean scale, each with a weight.
//!
//! Their gradients are added where Adam reads the loss's. Their means are computed only when somebody will read them:
//! 256 workgroups sum every 65536th value per unit and then their units as a tree, one workgroup sums the 256 sums: the
//! same order every time. NaN goes into the mean; an empty model is never handed over.

use super::rows::{Sections, SectionsLaunch};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::Result;
use gazesplat_render::gpu::{Gpu, UNITS, cube_dim, packed::PackedLayout};

/// Workgroups of the first sum, and values of the second.
const NUM_SUMS: u32 = UNITS;

/// factor · σ'(logit).
#[cube]
pub fn opacity_gradient(logit: f32, factor: f32) -> f32 {
    let opacity = 1.0f32 / (1.0f32 + f32::exp(-logit));
    factor * opacity * (1.0f32 - opacity)
}

/// factor · exp(log scale).
#[cube]
pub fn scale_gradient(log_scale: f32, factor: f32) -> f32 {
    factor * f32::exp(log_scale)
}

/// Puts the mean opacity and the mean scale into the status; the gradients are Adam's to add.
///
/// # Errors
/// [`gazesplat_render::Error::Limit`] never in practice: the sums take two kilobytes.
pub fn regularize(gpu: &Gpu, layout: &PackedLayout, params: &CubeTensor, status: &CubeTensor) -> Result<()> {
    let sums = gpu.empty("bytes of sums", &[2 * NUM_SUMS as usize], DType::F32)?;
    sum_values::launch(
        &gpu.client,
        gpu.cubes(NUM_SUMS as usize),
        cube_dim(),
        params.clone().into_buffer_arg(),
        sums.clone().into_buffer_arg(),
        SectionsLaunch::of(layout),
    );
    let num_rows = layout.num_rows as f32;
    finish::launch(
        &gpu.client,
        gpu.cubes(1),
        cube_dim(),
        sums.into_buffer_arg(),
        status.clone().into_buffer_arg(),
        1.0 / num_rows,
        1.0 / (3.0 * num_rows),
    );
    Ok(())
}

/// Sum of one value per unit of a workgroup, as a tree, into the first of the [`UNITS`] values of `shared`. Every unit must
/// call it.
#[cube]
fn sum_units(shared: &mut Shared<[f32]>, value: f32) {
    let unit = UNIT_POS as usize;
    sync_cube();
    shared[unit] = value;
    sync_cube();
    let mut distance = 1usize;
    while distance < UNITS as usize {
        if unit & (2 * distance - 1) == 0 {
            let other = shared[unit + distance];
            shared[unit] += other;
        }
        sync_cube();
        distance *= 2;
    }
}

#[cube(launch)]
fn sum_values(params: &[f32], sums: &mut [f32], at: Sections) {
    let mut shared = Shared::<[f32]>::new_slice(UNITS as usize);
    let mut opacities = 0.0f32;
    let mut scales = 0.0f32;
    if CUBE_POS < NUM_SUMS as usize {
        let mut i = ABSOLUTE_POS as u32;
        while i < 3u32 * at.num_rows {
            if i < at.num_rows {
                opacities += 1.0f32 / (1.0f32 + f32::exp(-params[(at.opacity_logits + i) as usize]));
            }
            scales += f32::exp(params[(at.log_scales + i) as usize]);
            i += NUM_SUMS * UNITS;
        }
    }
    sum_units(&mut shared, opacities);
    let opacity = shared[0];
    sum_units(&mut shared, scales);
    let scale = shared[0];
    if UNIT_POS == 0u32 && CUBE_POS < NUM_SUMS as usize {
        sums[CUBE_POS] = opacity;
        sums[CUBE_POS + NUM_SUMS as usize] = scale;
    }
}

#[cube(launch)]
fn finish(sums: &[f32], status: &mut [u32], per_row: f32, per_scale: f32) {
    let mut shared = Shared::<[f32]>::new_slice(UNITS as usize);
    sum_units(&mut shared, sums[UNIT_POS as usize]);
    let opacity = shared[0];
    sum_units(&mut shared, sums[UNIT_POS as usize + NUM_SUMS as usize]);
    let scale = shared[0];
    if ABSOLUTE_POS == 0 {
        status[2] = u32::reinterpret(opacity * per_row);
        status[3] = u32::reinterpret(scale * per_scale);
    }
}
