//! L1 and SSIM of an image against its target, with the gradient, on a GPU. The mathematics, the mask and the borders are
//! those of [`crate::kernels::cpu::l1_ssim`].
//!
//! One workgroup computes 16 × 16 pixels, one per unit; its windows reach 5 pixels beyond, so it loads 26 × 26 into
//! workgroup memory, channel after channel, and windows them along columns first, then along rows. Two passes over the
//! image: `ssim_pass` forms the moments, SSIM and its derivatives by them, and the workgroup's sums of |x − y| and of
//! SSIM; `gradient_pass` windows the derivatives. One workgroup then adds the sums. Every sum has a fixed order.
//!
//! **Ends.** Pixels outside the image are zero and have no weight; workgroups beyond the last tile lie outside entirely
//! and write nothing. NaN in an unmasked pixel gives a NaN loss. A fully masked or empty image has L1 0, SSIM 1 and no
//! gradient, and launches no pass.

mod windows;

use crate::kernels::cpu::l1_ssim::{C1, C2, LANE_L1, LANE_LOSS, LANE_SSIM, RADIUS, Similarity, Weights};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::Result;
use gazesplat_render::gpu::{Gpu, cube_dim};
use windows::{
    BLURRED, HALO, NUM_UNITS, REACHED, TILE, TILE_PIXELS, blur_maps, blur_moments, blur_rows, is_masked, own_tile,
    place_of, reduced, target_value,
};

/// How a target is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum TargetFormat {
    /// `[height, width]`: red, green, blue from the lowest byte on, the highest byte 0 = the pixel carries no loss.
    Bytes,
    /// `[height, width, 3]`: the bits of f32 on the scale 0..1, no mask.
    Floats,
}

/// An image and what it is compared with.
#[derive(Debug, Clone)]
pub struct Comparison {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Values per pixel of `image`, at least 3; the first three are RGB, the others carry no loss.
    pub channels: usize,
    /// `[height, width, channels]` of f32, contiguous.
    pub image: CubeTensor,
    /// Words of u32, contiguous.
    pub target: CubeTensor,
    /// What the words are.
    pub format: TargetFormat,
    /// Pixels that carry loss.
    pub num_pixels: usize,
}

/// Loss, L1 and SSIM, `[3]`, lanes as in [`Similarity::packed`]; `ssim_weight` is λ, in 0..1.
///
/// # Errors
/// [`gazesplat_render::Error::Limit`] when a buffer would be larger than the adapter takes: never when it took the image.
pub fn similarity(gpu: &Gpu, comparison: &Comparison, ssim_weight: f32) -> Result<CubeTensor> {
    if comparison.num_pixels == 0 {
        return Ok(similarity_of_nothing(gpu, ssim_weight));
    }
    let nothing = gpu.empty("bytes of derivatives", &[1], DType::F32)?;
    let maps = [nothing.clone(), nothing.clone(), nothing];
    let sums = run_ssim_pass(gpu, comparison, &maps, false)?;
    run_packed(gpu, comparison, &sums, ssim_weight)
}

/// As [`similarity`], and the gradient of the loss with respect to the image, `[height, width, channels]`, zero beyond RGB.
///
/// # Errors
/// As [`similarity`].
pub fn similarity_and_gradient(
    gpu: &Gpu,
    comparison: &Comparison,
    ssim_weight: f32,
) -> Result<(CubeTensor, CubeTensor)> {
    let &Comparison { width, height, channels, num_pixels, .. } = comparison;
    let shape = [height, width, channels];
    if num_pixels == 0 {
        let v_image = gpu.zeros("bytes of the gradient of the image", &shape, DType::F32)?;
        return Ok((similarity_of_nothing(gpu, ssim_weight), v_image));
    }
    // Three buffers: one of all would be larger than the image.
    let map = || gpu.empty("bytes of derivatives", &[3, height, width], DType::F32);
    let maps = [map()?, map()?, map()?];
    let v_image = gpu.empty("bytes of the gradient of the image", &shape, DType::F32)?;
    let sums = run_ssim_pass(gpu, comparison, &maps, true)?;
    let norm = norm(num_pixels);
    let Weights { l1, ssim } = Weights::of_loss(ssim_weight);
    let [v_mu, v_q, v_p] = maps;
    gradient_pass::launch(
        &gpu.client,
        gpu.cubes(num_tiles(comparison)),
        cube_dim(),
        comparison.image.clone().into_buffer_arg(),
        comparison.target.clone().into_buffer_arg(),
        v_mu.into_buffer_arg(),
        v_q.into_buffer_arg(),
        v_p.into_buffer_arg(),
        v_image.clone().into_buffer_arg(),
        width as u32,
        height as u32,
        channels as u32,
        l1 * norm,
        ssim * norm,
        comparison.format,
    );
    Ok((run_packed(gpu, comparison, &sums, ssim_weight)?, v_image))
}

/// `gradient` times the loss lane of `v_packed`, `[3]`; both contiguous. In place unless `gradient` is shared.
pub fn scaled(gpu: &Gpu, gradient: CubeTensor, v_packed: CubeTensor) -> CubeTensor {
    let gradient = if gradient.can_mut() { gradient } else { gradient.copy() };
    let len = gradient.meta.num_elements();
    if len > 0 {
        scale::launch(
            &gpu.client,
            gpu.units(len),
            cube_dim(),
            gradient.clone().into_buffer_arg(),
            v_packed.into_buffer_arg(),
            len as u32,
        );
    }
    gradient
}

/// One over the number of compared values.
fn norm(num_pixels: usize) -> f32 {
    (1.0 / (3.0 * num_pixels as f64)) as f32
}

fn num_tiles(comparison: &Comparison) -> usize {
    comparison.width.div_ceil(TILE) * comparison.height.div_ceil(TILE)
}

fn similarity_of_nothing(gpu: &Gpu, ssim_weight: f32) -> CubeTensor {
    let words = Similarity { l1: 0.0, ssim: 1.0 }.packed(ssim_weight).map(f32::to_bits);
    CubeTensor { dtype: DType::F32, ..gpu.upload_u32(&words, &[3]) }
}

/// Sums of |x − y| and of SSIM by tile, `[2, tiles]`.
fn run_ssim_pass(gpu: &Gpu, comparison: &Comparison, maps: &[CubeTensor; 3], with_maps: bool) -> Result<CubeTensor> {
    let num_tiles = num_tiles(comparison);
    let sums = gpu.empty("bytes of sums", &[2, num_tiles], DType::F32)?;
    let [v_mu, v_q, v_p] = maps;
    ssim_pass::launch(
        &gpu.client,
        gpu.cubes(num_tiles),
        cube_dim(),
        comparison.image.clone().into_buffer_arg(),
        comparison.target.clone().into_buffer_arg(),
        v_mu.clone().into_buffer_arg(),
        v_q.clone().into_buffer_arg(),
        v_p.clone().into_buffer_arg(),
        sums.clone().into_buffer_arg(),
        comparison.width as u32,
        comparison.height as u32,
        comparison.channels as u32,
        num_tiles as u32,
        comparison.format,
        with_maps,
    );
    Ok(sums)
}

fn run_packed(gpu: &Gpu, comparison: &Comparison, sums: &CubeTensor, ssim_weight: f32) -> Result<CubeTensor> {
    let packed_values = gpu.empty("bytes of a loss", &[3], DType::F32)?;
    packed::launch(
        &gpu.client,
        gpu.cubes(1),
        cube_dim(),
        sums.clone().into_buffer_arg(),
        packed_values.clone().into_buffer_arg(),
        num_tiles(comparison) as u32,
        norm(comparison.num_pixels),
        ssim_weight,
    );
    Ok(packed_values)
}

/// SSIM of a tile and, where wanted, its derivatives by μx, q and p, `[3, height, width]` each, zero at masked pixels.
#[cube(launch)]
fn ssim_pass(
    image: &[f32],
    target: &[u32],
    v_mu: &mut [f32],
    v_q: &mut [f32],
    v_p: &mut [f32],
    sums: &mut [f32],
    width: u32,
    height: u32,
    channels: u32,
    num_tiles: u32,
    #[comptime] format: TargetFormat,
    #[comptime] with_maps: bool,
) {
    let mut raw = Shared::<[f32]>::new_slice(2 * REACHED);
    let mut blurred = Shared::<[f32]>::new_slice(4 * BLURRED);
    let mut windowed = Shared::<[f32]>::new_slice(4 * TILE_PIXELS);
    let unit = UNIT_POS as usize;
    let (column, row) = (unit % TILE, unit / TILE);
    let own_at = (row + RADIUS) * HALO + column + RADIUS;
    let tile = own_tile(width);
    let own = place_of(own_at, &tile, width, height);
    let mut is_valid = own.in_image;
    if own.in_image {
        is_valid = !is_masked(target, own.pixel, format);
    }
    let mut l1_sum = 0.0_f32;
    let mut ssim_sum = 0.0_f32;
    for channel in 0..3u32 {
        // 1. Both images, zero outside; masked pixels take the target's colour.
        let mut i = unit;
        while i < REACHED {
            let place = place_of(i, &tile, width, height);
            let mut x = 0.0_f32;
            let mut y = 0.0_f32;
            if place.in_image {
                y = target_value(target, place.pixel, channel, format);
                x = y;
                if !is_masked(target, place.pixel, format) {
                    x = image[place.pixel * channels as usize + channel as usize];
                }
            }
            raw[i] = x;
            raw[REACHED + i] = y;
            i += NUM_UNITS;
        }
        sync_cube();
        // 2. Windows along columns. What a unit reads here, the next channel overwrites after a barrier only.
        blur_moments(&raw, &mut blurred);
        let difference = f32::abs(raw[own_at] - raw[REACHED + own_at]);
        sync_cube();
        // 3. Windows along rows.
        blur_rows(&blurred, &mut windowed, 4usize);
        sync_cube();
        // 4. SSIM, its derivatives.
        let mx = windowed[unit];
        let my = windowed[TILE_PIXELS + unit];
        let q = windowed[2 * TILE_PIXELS + unit];
        let p = windowed[3 * TILE_PIXELS + unit];
        let both = mx * my;
        let means = mx * mx + my * my;
        let a1 = 2.0_f32 * both + C1;
        let a2 = 2.0_f32 * (p - both) + C2;
        let b1 = means + C1;
        let b2 = (q - means) + C2;
        let inverse = 1.0_f32 / (b1 * b2);
        let s = a1 * a2 * inverse;
        if is_valid {
            l1_sum += difference;
            ssim_sum += s;
        }
        if comptime![with_maps] {
            let to = channel as usize * (width * height) as usize + own.pixel;
            if own.in_image {
                let mut by_mu = 0.0_f32;
                let mut by_q = 0.0_f32;
                let mut by_p = 0.0_f32;
                if is_valid {
                    by_mu = 2.0_f32 * (my * (a2 - a1) * inverse - mx * s * ((b2 - b1) * inverse));
                    by_q = -s * (b1 * inverse);
                    by_p = 2.0_f32 * (a1 * inverse);
                }
                v_mu[to] = by_mu;
                v_q[to] = by_q;
                v_p[to] = by_p;
            }
        }
    }
    // 5. Sums of the tile.
    let total = reduced(&mut raw, l1_sum, ssim_sum);
    if unit == 0 && CUBE_POS < num_tiles as usize {
        sums[CUBE_POS] = total.l1;
        sums[num_tiles as usize + CUBE_POS] = total.ssim;
    }
}

/// Windows of the three derivatives, and the gradient by x of the weighted sum of both terms.
#[cube(launch)]
fn gradient_pass(
    image: &[f32],
    target: &[u32],
    v_mu: &[f32],
    v_q: &[f32],
    v_p: &[f32],
    v_image: &mut [f32],
    width: u32,
    height: u32,
    channels: u32,
    l1_weight: f32,
    ssim_weight: f32,
    #[comptime] format: TargetFormat,
) {
    let mut maps = Shared::<[f32]>::new_slice(3 * REACHED);
    let mut blurred = Shared::<[f32]>::new_slice(3 * BLURRED);
    let mut windowed = Shared::<[f32]>::new_slice(3 * TILE_PIXELS);
    let unit = UNIT_POS as usize;
    let (column, row) = (unit % TILE, unit / TILE);
    let own_at = (row + RADIUS) * HALO + column + RADIUS;
    let tile = own_tile(width);
    let own = place_of(own_at, &tile, width, height);
    let plane = (width * height) as usize;
    for channel in 0..3u32 {
        // 1. The derivatives, zero outside the image.
        let mut i = unit;
        while i < REACHED {
            let place = place_of(i, &tile, width, height);
            let mut mu = 0.0_f32;
            let mut q = 0.0_f32;
            let mut p = 0.0_f32;
            if place.in_image {
                let from = channel as usize * plane + place.pixel;
                mu = v_mu[from];
                q = v_q[from];
                p = v_p[from];
            }
            maps[i] = mu;
            maps[REACHED + i] = q;
            maps[2 * REACHED + i] = p;
            i += NUM_UNITS;
        }
        sync_cube();
        // 2. Windows along columns.
        blur_maps(&maps, &mut blurred);
        sync_cube();
        // 3. Windows along rows.
        blur_rows(&blurred, &mut windowed, 3usize);
        sync_cube();
        // 4. The gradient.
        let mu = windowed[unit];
        let q = windowed[TILE_PIXELS + unit];
        let p = windowed[2 * TILE_PIXELS + unit];
        if own.in_image {
            let to = own.pixel * channels as usize + channel as usize;
            let mut v = 0.0_f32;
            if !is_masked(target, own.pixel, format) {
                let x = image[to];
                let y = target_value(target, own.pixel, channel, format);
                // torch's sign: 0 at equality.
                if x > y {
                    v = l1_weight;
                } else if x < y {
                    v = -l1_weight;
                }
                v += ssim_weight * (2.0_f32 * x * q + (y * p + mu));
            }
            v_image[to] = v;
        }
    }
    // 5. What carries no loss.
    if own.in_image {
        for channel in 3..channels {
            v_image[own.pixel * channels as usize + channel as usize] = 0.0_f32;
        }
    }
}

/// Loss, L1 and SSIM of the sums of all tiles; one workgroup.
#[cube(launch)]
fn packed(sums: &[f32], packed: &mut [f32], num_tiles: u32, norm: f32, ssim_weight: f32) {
    let mut shared = Shared::<[f32]>::new_slice(2 * NUM_UNITS);
    let mut l1_sum = 0.0_f32;
    let mut ssim_sum = 0.0_f32;
    let mut tile = UNIT_POS as usize;
    while tile < num_tiles as usize {
        l1_sum += sums[tile];
        ssim_sum += sums[num_tiles as usize + tile];
        tile += NUM_UNITS;
    }
    let total = reduced(&mut shared, l1_sum, ssim_sum);
    let l1 = total.l1 * norm;
    let ssim = total.ssim * norm;
    if UNIT_POS == 0 && CUBE_POS == 0 {
        packed[LANE_LOSS] = (1.0_f32 - ssim_weight) * l1 + ssim_weight * (1.0_f32 - ssim);
        packed[LANE_L1] = l1;
        packed[LANE_SSIM] = ssim;
    }
}

/// Multiplies by the loss lane.
#[cube(launch)]
fn scale(values: &mut [f32], v_packed: &[f32], len: u32) {
    if ABSOLUTE_POS < len as usize {
        values[ABSOLUTE_POS] *= v_packed[LANE_LOSS];
    }
}
