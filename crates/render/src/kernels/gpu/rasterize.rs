//! Rasterisation: every pixel composites its tile's list front to back.
//!
//! One workgroup per tile, one unit per pixel; splats are staged in batches in workgroup memory. A tile ends when all
//! its pixels have stopped. Empty lists give the background; pixels of the last tiles that lie outside the image have
//! stopped from the start.
//!
//! With a termination table a pixel also stops before a splat when its colour allows it (JND Sec. 3): a kernel of its own,
//! because none may bind more buffers. What both do is one device function.

use super::bin::TileLists;
use super::lut::{LutUse, below_limit, limits, residual, tile_lut};
use super::tile::{STAGED, StagedSplat, TileArgs, pixel, stage, staged_splat, tile_args};
use crate::error::Result;
use crate::gpu::{Gpu, UNITS, cube_dim};
use crate::kernels::cpu::rasterize::RasterOptions;
use crate::math::alpha::{LN_2, LOG2_ALPHA_MIN, log2_alpha, smooth_cut};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Splats of a batch: one per unit to stage.
const BATCH: usize = UNITS as usize;

/// List position of a pixel that never stops.
pub const NEVER: u32 = i32::MAX as u32;

/// What a frame leaves behind.
pub struct Raster {
    /// `[H, W, 4 or 5]`: RGB over the background, α = 1 − T, and Σ T α z if asked for.
    pub image: CubeTensor,
    /// Transmittance left at each pixel, `[H, W]`; empty unless kept.
    pub final_t: CubeTensor,
    /// List position at which each pixel stopped, `[H, W]`; [`NEVER`] if it did not. Empty unless kept.
    pub stop: CubeTensor,
    /// List position at which each tile ended, `[tiles]`: entries before it were worked through.
    pub tile_ends: CubeTensor,
}

/// Composites all tiles; `keep` keeps what the backward pass needs, for which there is no table.
///
/// # Errors
/// [`crate::Error::Limit`] when a buffer is larger than the adapter takes.
pub fn rasterize(gpu: &Gpu, lists: &TileLists, options: &RasterOptions, keep: bool) -> Result<Raster> {
    let grid = &lists.grid;
    let (width, height) = (grid.width as usize, grid.height as usize);
    let kept = if keep { [height, width] } else { [0, 0] };
    let image = gpu.empty("bytes of the image", &[height, width, options.num_channels()], DType::F32)?;
    let final_t = gpu.empty("bytes of the image", &kept, DType::F32)?;
    let stop = gpu.empty("bytes of the image", &kept, DType::U32)?;
    let tile_ends = gpu.empty("bytes of tile ends", &[grid.len()], DType::U32)?;
    if let Some(lut) = &options.lut {
        rasterize_lut_kernel::launch(
            &gpu.client,
            gpu.cubes(grid.len()),
            cube_dim(),
            lists.lanes.clone().into_buffer_arg(),
            lists.tile_offsets.clone().into_buffer_arg(),
            lists.pairs.clone().into_buffer_arg(),
            limits(gpu, lut).into_buffer_arg(),
            lists.color_max.clone().into_buffer_arg(),
            image.clone().into_buffer_arg(),
            tile_ends.clone().into_buffer_arg(),
            tile_args(grid, options),
            options.depth,
            LutUse::of(options),
        );
        return Ok(Raster { image, final_t, stop, tile_ends });
    }
    rasterize_kernel::launch(
        &gpu.client,
        gpu.cubes(grid.len()),
        cube_dim(),
        lists.lanes.clone().into_buffer_arg(),
        lists.tile_offsets.clone().into_buffer_arg(),
        lists.pairs.clone().into_buffer_arg(),
        image.clone().into_buffer_arg(),
        final_t.clone().into_buffer_arg(),
        stop.clone().into_buffer_arg(),
        tile_ends.clone().into_buffer_arg(),
        tile_args(grid, options),
        options.depth,
        options.smooth_cutoff,
        keep,
    );
    Ok(Raster { image, final_t, stop, tile_ends })
}

/// α of a splat at a pixel before the clamp, and its derivative with respect to the power; both 0 below the cut.
#[derive(CubeType, Clone, Copy)]
pub struct Alpha {
    /// Whether α reaches 1/255.
    pub is_hit: bool,
    /// α, not clamped.
    pub full: f32,
    /// ∂α/∂power.
    pub slope: f32,
}

/// α of a splat at the pixel centre (`x`, `y`), relative to the tile's corner.
#[cube]
pub fn alpha_at(s: StagedSplat, x: f32, y: f32, #[comptime] smooth: bool) -> Alpha {
    let power = log2_alpha(s.conic, s.log2_opacity, x - s.mean_x, y - s.mean_y);
    let mut is_hit = false;
    let mut full = 0.0_f32;
    let mut slope = 0.0_f32;
    // Compared before the exponential; false for NaN.
    if power >= LOG2_ALPHA_MIN {
        is_hit = true;
        full = f32::exp(LN_2 * power);
        slope = full;
        if comptime!(smooth) {
            let cut = smooth_cut(full);
            slope = full * cut.slope;
            full = cut.alpha;
        }
    }
    Alpha { is_hit, full, slope }
}

/// A pixel when its tile has ended.
#[derive(CubeType, Clone, Copy)]
struct PixelEnd {
    /// Row-major index in the image.
    index: u32,
    /// Whether the pixel lies in the image.
    is_inside: bool,
    /// Transmittance left.
    t: f32,
    /// List position at which it stopped; [`NEVER`] if it did not.
    stopped_at: u32,
}

/// The forward kernel. `keep`: fills what the backward pass needs.
#[cube(launch)]
fn rasterize_kernel(
    lanes: &[f32],
    tile_offsets: &[u32],
    pairs: &[u32],
    image: &mut [f32],
    final_t: &mut [f32],
    stop: &mut [u32],
    tile_ends: &mut [u32],
    args: TileArgs,
    #[comptime] depth: bool,
    #[comptime] smooth: bool,
    #[comptime] keep: bool,
) {
    if CUBE_POS >= args.num_tiles as usize {
        terminate!();
    }
    // Without a table the two buffers that belong to it are never read.
    let none = comptime!(None);
    let end = composite(lanes, tile_offsets, pairs, lanes, tile_offsets, image, tile_ends, &args, depth, smooth, none);
    if comptime!(keep) {
        let pixel = end.index as usize;
        if end.is_inside {
            final_t[pixel] = end.t;
            stop[pixel] = end.stopped_at;
        }
    }
}

/// The forward kernel with a termination table.
#[cube(launch)]
fn rasterize_lut_kernel(
    lanes: &[f32],
    tile_offsets: &[u32],
    pairs: &[u32],
    limits: &[f32],
    color_max: &[u32],
    image: &mut [f32],
    tile_ends: &mut [u32],
    args: TileArgs,
    #[comptime] depth: bool,
    #[comptime] lut: Option<LutUse>,
) {
    if CUBE_POS >= args.num_tiles as usize {
        terminate!();
    }
    composite(lanes, tile_offsets, pairs, limits, color_max, image, tile_ends, &args, depth, false, lut);
}

/// Composites the tile of this workgroup and writes its pixels.
#[cube]
fn composite(
    lanes: &[f32],
    tile_offsets: &[u32],
    pairs: &[u32],
    limits: &[f32],
    color_max: &[u32],
    image: &mut [f32],
    tile_ends: &mut [u32],
    args: &TileArgs,
    #[comptime] depth: bool,
    #[comptime] smooth: bool,
    #[comptime] lut: Option<LutUse>,
) -> PixelEnd {
    let mut staged = Shared::<[f32]>::new_slice(STAGED * BATCH);
    // Pixels that have not stopped; list position at which the last of them did.
    let votes = Shared::<[Atomic<u32>]>::new_slice(2usize);
    let table = tile_lut(limits, color_max, args, lut);
    let tile = CUBE_POS;
    let p = pixel(args, tile as u32);
    let start = tile_offsets[tile];
    let len = tile_offsets[tile + 1] - start;
    let mut t = 1.0_f32;
    let mut red = 0.0_f32;
    let mut green = 0.0_f32;
    let mut blue = 0.0_f32;
    let mut depth_sum = 0.0_f32;
    let mut is_done = !p.is_inside;
    let mut stopped_at = NEVER.runtime();
    let mut first = 0u32;
    let mut is_alive = true;
    while is_alive && first < len {
        let count = u32::min(BATCH as u32, len - first);
        if UNIT_POS == 0 {
            votes[0].store(0u32);
        }
        if UNIT_POS < count {
            let splat = pairs[(start + first + UNIT_POS) as usize * 2];
            stage(lanes, splat, &p, &mut staged, UNIT_POS as usize, BATCH);
        }
        sync_cube();
        let mut k = 0u32;
        while k < count && !is_done {
            let slot = k as usize;
            let alpha = alpha_at(staged_splat(&staged, slot, BATCH), p.center_x, p.center_y, smooth);
            if alpha.is_hit {
                let alpha = f32::min(alpha.full, args.alpha_max);
                let t_next = t - alpha * t;
                let mut is_blended = t_next > args.t_stop;
                if comptime!(lut.is_some()) {
                    is_blended = is_blended && !below_limit(&table, limits, args, t, red, green, blue, lut);
                }
                // Kerbl 2023, App. C: stop before the splat that would end the pixel.
                if is_blended {
                    let weight = alpha * t;
                    red += weight * staged[6 * BATCH + slot];
                    green += weight * staged[7 * BATCH + slot];
                    blue += weight * staged[8 * BATCH + slot];
                    if comptime!(depth) {
                        depth_sum += weight * staged[9 * BATCH + slot];
                    }
                    t = t_next;
                } else {
                    is_done = true;
                    stopped_at = first + k;
                }
            }
            k += 1u32;
        }
        if !is_done {
            votes[0].fetch_add(1u32);
        }
        sync_cube();
        is_alive = votes[0].load() > 0;
        first += BATCH as u32;
        sync_cube();
    }
    // E: where the last pixel stopped; entries before it were worked through, those after it changed nothing.
    if UNIT_POS == 0 {
        votes[1].store(0u32);
    }
    sync_cube();
    if p.is_inside {
        votes[1].fetch_max(u32::min(stopped_at, len));
    }
    sync_cube();
    if UNIT_POS == 0 {
        tile_ends[tile] = votes[1].load();
    }
    if p.is_inside {
        let pixel = p.index as usize;
        let channels = comptime!(if depth { 5usize } else { 4usize });
        let mut rest_r = args.background_r;
        let mut rest_g = args.background_g;
        let mut rest_b = args.background_b;
        if comptime!(lut.is_some()) {
            // A pixel that worked through its list sees the background, whatever the table.
            if stopped_at != NEVER {
                rest_r = residual(&table, t, red, rest_r, lut);
                rest_g = residual(&table, t, green, rest_g, lut);
                rest_b = residual(&table, t, blue, rest_b, lut);
            }
        }
        image[pixel * channels] = red + t * rest_r;
        image[pixel * channels + 1] = green + t * rest_g;
        image[pixel * channels + 2] = blue + t * rest_b;
        image[pixel * channels + 3] = 1.0_f32 - t;
        if comptime!(depth) {
            image[pixel * channels + 4] = depth_sum;
        }
    }
    PixelEnd { index: p.index, is_inside: p.is_inside, t, stopped_at }
}
