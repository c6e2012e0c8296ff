//! L1 and SSIM of an image against its target, with the gradient, on a GPU. The mathematics, the mask and the borders are
//! those of [`crate::kernels::cpu::l1_ssim`].
//!
//! One workgroup computes 16 × 16 pixels, one per unit; its windows reach 5 pixels beyond, so it loads 26 × 26 into
//! workgroup memory, channel after channel, and windows them along columns first, then along rows. Two passes over the
//! image: [`ssim_pass`] forms the moments, SSIM and its derivatives by them, and the workgroup's sums of |x − y| and of
//! SSIM; [`gradient_pass`] windows the derivatives. One workgroup then adds the sums. Every sum has a fixed order.
//!
//! **Ends.** Pixels outside the image are zero and have no weight; workgroups beyond the last tile lie outside entirely
//! and write nothing. NaN in an unmasked pixel gives a NaN loss. A fully masked or empty image has L1 0, SSIM 1 and no
//! gradient, and launches no pass.

use crate::kernels::cpu::l1_ssim::{C1, C2, LANE_L1, LANE_LOSS, LANE_SSIM, RADIUS, Similarity, TAPS, WINDOW, Weights};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::Result;
use gazesplat_render::gpu::{Gpu, UNITS, cube_dim};

/// Side of the tile of a workgroup, pixels.
const TILE: usize = 16;
/// Side of what its windows reach.
const HALO: usize = TILE + 2 * RADIUS;
/// Pixels that its windows reach.
const REACHED: usize = HALO * HALO;
/// Values windowed along columns: 16 rows of 26.
const WINDOWED: usize = TILE * HALO;
/// Units, as a length.
const NUM_UNITS: usize = UNITS as usize;

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

/// Where value `i` of a tile's reach lies: its pixel, and whether the image has it.
#[derive(CubeType)]
struct Place {
    pixel: usize,
    in_image: bool,
}

/// Column and row are counted from the upper left corner of the reach, which lies 5 pixels outside the tile.
#[cube]
fn place_of(column: usize, row: usize, width: u32, height: u32) -> Place {
    let (width, height) = (width as usize, height as usize);
    let tiles_across = width.div_ceil(TILE);
    let x = CUBE_POS % tiles_across * TILE + column;
    let y = CUBE_POS / tiles_across * TILE + row;
    let in_image = x >= RADIUS && y >= RADIUS && x < width + RADIUS && y < height + RADIUS;
    let pixel = select(in_image, (y - RADIUS) * width + x - RADIUS, 0usize);
    Place { pixel, in_image }
}

/// A component of the target's colour on the scale 0..1.
#[cube]
fn target_value(target: &[u32], pixel: usize, channel: u32, #[comptime] format: TargetFormat) -> f32 {
    if comptime![format == TargetFormat::Floats] {
        f32::reinterpret(target[pixel * 3 + channel as usize])
    } else {
        f32::cast_from((target[pixel] >> (8 * channel)) & 0xffu32) * (1.0_f32 / 255.0_f32)
    }
}

/// True if the pixel carries no loss.
#[cube]
fn is_masked(target: &[u32], pixel: usize, #[comptime] format: TargetFormat) -> bool {
    if comptime![format == TargetFormat::Floats] { false.runtime() } else { (target[pixel] >> 24u32) == 0u32 }
}

/// Sum over the units of a workgroup, by halves; every unit must call it. `shared` holds one value per unit.
#[cube]
fn reduced(shared: &mut Shared<[f32]>, value: f32) -> f32 {
    let unit = UNIT_POS as usize;
    sync_cube();
    shared[unit] = value;
    sync_cube();
    let mut half = (NUM_UNITS / 2).runtime();
    while half > 0 {
        if unit < half {
            shared[unit] = shared[unit] + shared[unit + half];
        }
        sync_cube();
        half /= 2;
    }
    shared[0]
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
    let mut raw_x = Shared::<[f32]>::new_slice(REACHED);
    let mut raw_y = Shared::<[f32]>::new_slice(REACHED);
    let mut blurred = Shared::<[f32]>::new_slice(4 * WINDOWED);
    let unit = UNIT_POS as usize;
    let (column, row) = (unit % TILE, unit / TILE);
    let own = place_of(column + RADIUS, row + RADIUS, width, height);
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
            let place = place_of(i % HALO, i / HALO, width, height);
            let mut x = 0.0_f32;
            let mut y = 0.0_f32;
            if place.in_image {
                y = target_value(target, place.pixel, channel, format);
                x = y;
                if !is_masked(target, place.pixel, format) {
                    x = image[place.pixel * channels as usize + channel as usize];
                }
            }
            raw_x[i] = x;
            raw_y[i] = y;
            i += NUM_UNITS;
        }
        sync_cube();
        // 2. Windows along columns of x, y, x² + y² and xy.
        let mut i = unit;
        while i < WINDOWED {
            let mut a = 0.0_f32;
            let mut b = 0.0_f32;
            let mut q = 0.0_f32;
            let mut p = 0.0_f32;
            #[unroll]
            for k in 0..TAPS {
                let w = comptime![WINDOW[k]];
                let x = raw_x[i + k * HALO];
                let y = raw_y[i + k * HALO];
                a += w * x;
                b += w * y;
                q += w * x * x + w * y * y;
                p += w * x * y;
            }
            blurred[i] = a;
            blurred[WINDOWED + i] = b;
            blurred[2 * WINDOWED + i] = q;
            blurred[3 * WINDOWED + i] = p;
            i += NUM_UNITS;
        }
        let at = (row + RADIUS) * HALO + column + RADIUS;
        let difference = f32::abs(raw_x[at] - raw_y[at]);
        // From here on the raw values are free for the next channel.
        sync_cube();
        // 3. Windows along rows, SSIM, its derivatives.
        let mut mx = 0.0_f32;
        let mut my = 0.0_f32;
        let mut q = 0.0_f32;
        let mut p = 0.0_f32;
        #[unroll]
        for k in 0..TAPS {
            let w = comptime![WINDOW[k]];
            let i = row * HALO + column + k;
            mx += w * blurred[i];
            my += w * blurred[WINDOWED + i];
            q += w * blurred[2 * WINDOWED + i];
            p += w * blurred[3 * WINDOWED + i];
        }
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
            if own.in_image {
                let mut by_mu = 0.0_f32;
                let mut by_q = 0.0_f32;
                let mut by_p = 0.0_f32;
                if is_valid {
                    by_mu = 2.0_f32 * (my * (a2 - a1) * inverse - mx * s * ((b2 - b1) * inverse));
                    by_q = -s * (b1 * inverse);
                    by_p = 2.0_f32 * (a1 * inverse);
                }
                let to = channel as usize * (width * height) as usize + own.pixel;
                v_mu[to] = by_mu;
                v_q[to] = by_q;
                v_p[to] = by_p;
            }
        }
    }
    // 4. Sums of the tile.
    let l1_total = reduced(&mut raw_x, l1_sum);
    let ssim_total = reduced(&mut raw_y, ssim_sum);
    if unit == 0 && CUBE_POS < num_tiles as usize {
        sums[CUBE_POS] = l1_total;
        sums[num_tiles as usize + CUBE_POS] = ssim_total;
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
    let mut blurred = Shared::<[f32]>::new_slice(3 * WINDOWED);
    let unit = UNIT_POS as usize;
    let (column, row) = (unit % TILE, unit / TILE);
    let own = place_of(column + RADIUS, row + RADIUS, width, height);
    let plane = (width * height) as usize;
    for channel in 0..3u32 {
        // 1. The derivatives, zero outside the image.
        let mut i = unit;
        while i < REACHED {
            let place = place_of(i % HALO, i / HALO, width, height);
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
        let mut i = unit;
        while i < WINDOWED {
            let mut mu = 0.0_f32;
            let mut q = 0.0_f32;
            let mut p = 0.0_f32;
            #[unroll]
            for k in 0..TAPS {
                let w = comptime![WINDOW[k]];
                mu += w * maps[i + k * HALO];
                q += w * maps[REACHED + i + k * HALO];
                p += w * maps[2 * REACHED + i + k * HALO];
            }
            blurred[i] = mu;
            blurred[WINDOWED + i] = q;
            blurred[2 * WINDOWED + i] = p;
            i += NUM_UNITS;
        }
        sync_cube();
        // 3. Windows along rows, the gradient.
        let mut mu = 0.0_f32;
        let mut q = 0.0_f32;
        let mut p = 0.0_f32;
        #[unroll]
        for k in 0..TAPS {
            let w = comptime![WINDOW[k]];
            let i = row * HALO + column + k;
            mu += w * blurred[i];
            q += w * blurred[WINDOWED + i];
            p += w * blurred[2 * WINDOWED + i];
        }
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
    // 4. What carries no loss.
    if own.in_image {
        for channel in 3..channels {
            v_image[own.pixel * channels as usize + channel as usize] = 0.0_f32;
        }
    }
}

/// Loss, L1 and SSIM of the sums of all tiles; one workgroup.
#[cube(launch)]
fn packed(sums: &[f32], packed: &mut [f32], num_tiles: u32, norm: f32, ssim_weight: f32) {
    let mut shared = Shared::<[f32]>::new_slice(NUM_UNITS);
    let mut l1_sum = 0.0_f32;
    let mut ssim_sum = 0.0_f32;
    let mut tile = UNIT_POS as usize;
    while tile < num_tiles as usize {
        l1_sum += sums[tile];
        ssim_sum += sums[num_tiles as usize + tile];
        tile += NUM_UNITS;
    }
    let l1 = reduced(&mut shared, l1_sum) * norm;
    let ssim = reduced(&mut shared, ssim_sum) * norm;
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
