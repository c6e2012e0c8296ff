//! Gradient of the rasterisation: every tile walks its list back to front.
//!
//! One workgroup per tile, in batches of eight splats and two phases. In the first a unit is a pixel: it steps its
//! transmittance T in front of each splat, and the scalar R·v of what lies behind (renderer.md §3): nothing is subtracted
//! from a sum, so no digits are lost where 1 − α is small. It leaves v = ∂L/∂power and the weight T α of every splat of the
//! batch in workgroup memory. In the second, 32 units per splat reduce these to six moments of v, from which mean, conic
//! and opacity follow, and to the sums for colour and depth.
//!
//! α has to come out as in the forward pass, which the same device function sees to. Should a driver compile it otherwise
//! here, a pixel that lies on the cut is taken to have blended a splat it has not: its T is then off by 1/255, once.
//!
//! Every pair writes its own record, at the place its splat has reserved: no float is added atomically, so the gradient
//! has the same bits on every run, and drivers without such atomics need no other path. Records behind the end of a tile
//! are zero.

use super::bin::TileLists;
use super::rasterize::{Raster, alpha_at};
use super::tile::{STAGED, TileArgs, pixel, stage, staged_splat, tile_args};
use crate::error::Result;
use crate::gpu::{Gpu, SHARED_BYTES, UNITS, cube_dim};
use crate::kernels::cpu::rasterize::RasterOptions;
use crate::layout::{ONE_MINUS_ALPHA_MIN, TILE, grad_lane, lane};
use crate::math::alpha::LN_2;
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Splats of a batch: two values per splat and pixel take 16 KiB of workgroup memory.
const BATCH: usize = 8;
/// Units that reduce one splat.
const UNITS_PER_SPLAT: usize = UNITS as usize / BATCH;
/// Pixels that one of them looks at: the same column in every other row.
const PIXELS_PER_UNIT: usize = BATCH;
const _: () = assert!(UNITS_PER_SPLAT == 2 * TILE, "a unit keeps its column");
const _: () = assert!(
    4 * (STAGED * BATCH + (2 * BATCH + 4) * UNITS as usize + 1) == SHARED_BYTES,
    "adapters are asked for the workgroup memory that this kernel takes"
);

/// Gradients of all pairs, by record: `[P, 12]`, lanes as in [`grad_lane`].
///
/// `v_image`: upstream gradient `[H, W, 4 or 5]`; `raster` as kept by the forward pass. `absolute` also fills the sums of
/// per-pixel magnitudes (Ye 2024), if the options ask for them.
///
/// # Errors
/// [`crate::Error::Limit`] when a buffer is larger than the adapter takes.
pub fn rasterize_bwd(
    gpu: &Gpu,
    lists: &TileLists,
    options: &RasterOptions,
    raster: &Raster,
    v_image: CubeTensor,
    absolute: bool,
) -> Result<CubeTensor> {
    let records = gpu.zeros("bytes of pair gradients", &[lists.num_pairs, grad_lane::COUNT], DType::F32)?;
    if lists.num_pairs > 0 {
        rasterize_bwd_kernel::launch(
            &gpu.client,
            gpu.cubes(lists.grid.len()),
            cube_dim(),
            lists.lanes.clone().into_buffer_arg(),
            lists.tile_offsets.clone().into_buffer_arg(),
            lists.pairs.clone().into_buffer_arg(),
            raster.final_t.clone().into_buffer_arg(),
            raster.stop.clone().into_buffer_arg(),
            v_image.into_buffer_arg(),
            records.clone().into_buffer_arg(),
            tile_args(&lists.grid, options),
            options.depth,
            options.smooth_cutoff,
            absolute && options.absolute_gradients,
        );
    }
    Ok(records)
}

/// The backward kernel.
#[cube(launch)]
fn rasterize_bwd_kernel(
    lanes: &[f32],
    tile_offsets: &[u32],
    pairs: &[u32],
    final_t: &[f32],
    stop: &[u32],
    v_image: &[f32],
    records: &mut [f32],
    args: TileArgs,
    #[comptime] depth: bool,
    #[comptime] smooth: bool,
    #[comptime] absolute: bool,
) {
    let units = UNITS as usize;
    let unit = UNIT_POS as usize;
    let mut staged = Shared::<[f32]>::new_slice(STAGED * BATCH);
    // v and weight of the batch, splat by splat; later the partial sums, lane by lane.
    let mut exchange = Shared::<[f32]>::new_slice(2 * BATCH * UNITS as usize);
    // Upstream gradients of red, green, blue and depth.
    let mut upstream = Shared::<[f32]>::new_slice(4 * UNITS as usize);
    let last = Shared::<[Atomic<u32>]>::new_slice(1usize);
    let tile = CUBE_POS;
    if tile >= args.num_tiles as usize {
        terminate!();
    }
    let p = pixel(&args, tile as u32);
    let start = tile_offsets[tile];
    let len = tile_offsets[tile + 1] - start;
    // 1. Transmittance, stop and upstream gradient of this pixel; where the tile ended.
    let mut t = 0.0_f32;
    let mut behind = 0.0_f32;
    let mut stopped_at = 0u32;
    let mut v_red = 0.0_f32;
    let mut v_green = 0.0_f32;
    let mut v_blue = 0.0_f32;
    let mut v_depth = 0.0_f32;
    if UNIT_POS == 0 {
        last[0].store(0u32);
    }
    sync_cube();
    if p.is_inside {
        let channels = comptime!(if depth { 5usize } else { 4usize });
        let at = p.index as usize * channels;
        t = final_t[p.index as usize];
        stopped_at = u32::min(stop[p.index as usize], len);
        v_red = v_image[at];
        v_green = v_image[at + 1];
        v_blue = v_image[at + 2];
        let v_alpha = v_image[at + 3];
        if comptime!(depth) {
            v_depth = v_image[at + 4];
        }
        behind = t * (args.background_r * v_red + args.background_g * v_green + args.background_b * v_blue - v_alpha);
        // A tile without upstream gradient (masked, for instance) keeps its zero records.
        if v_red != 0.0_f32 || v_green != 0.0_f32 || v_blue != 0.0_f32 || v_alpha != 0.0_f32 || v_depth != 0.0_f32 {
            last[0].fetch_max(stopped_at);
        }
    }
    upstream[unit] = v_red;
    upstream[units + unit] = v_green;
    upstream[2 * units + unit] = v_blue;
    upstream[3 * units + unit] = v_depth;
    sync_cube();
    let end = last[0].load();
    let num_batches = end.div_ceil(BATCH as u32);
    for back in 0..num_batches {
        let first = (num_batches - 1 - back) * BATCH as u32;
        let count = u32::min(BATCH as u32, end - first);
        if UNIT_POS < count {
            let splat = pairs[(start + first + UNIT_POS) as usize * 2];
            stage(lanes, splat, &p, &mut staged, unit, BATCH);
        }
        sync_cube();
        // 2. A unit is a pixel: step it in front of each splat.
        for back in 0..count {
            let k = (count - 1 - back) as usize;
            let mut v_power = 0.0_f32;
            let mut weight = 0.0_f32;
            if first + (k as u32) < stopped_at {
                let alpha = alpha_at(staged_splat(&staged, k, BATCH), p.center_x, p.center_y, smooth);
                if alpha.is_hit {
                    let clamped = f32::min(alpha.full, args.alpha_max);
                    let inverse = 1.0_f32 / f32::max(1.0_f32 - clamped, ONE_MINUS_ALPHA_MIN);
                    t *= inverse;
                    weight = clamped * t;
                    let mut value = staged[6 * BATCH + k] * v_red
                        + staged[7 * BATCH + k] * v_green
                        + staged[8 * BATCH + k] * v_blue;
                    if comptime!(depth) {
                        value += staged[9 * BATCH + k] * v_depth;
                    }
                    // ∂L/∂α_k = T_k value − behind / (1 − α_k); none through a clamped α.
                    if alpha.full < args.alpha_max {
                        v_power = (t * value - behind * inverse) * alpha.slope;
                    }
                    behind += weight * value;
                }
            }
            exchange[k * units + unit] = v_power;
            exchange[(BATCH + k) * units + unit] = weight;
        }
        sync_cube();
        // 3. 32 units are a splat: moments of v and sums of the weights over eight pixels each.
        let k = unit / UNITS_PER_SPLAT;
        let part = unit % UNITS_PER_SPLAT;
        let mut m0 = 0.0_f32;
        let mut my = 0.0_f32;
        let mut myy = 0.0_f32;
        let mut s_red = 0.0_f32;
        let mut s_green = 0.0_f32;
        let mut s_blue = 0.0_f32;
        let mut s_depth = 0.0_f32;
        let mut abs_x = 0.0_f32;
        let mut abs_y = 0.0_f32;
        let s = staged_splat(&staged, k, BATCH);
        let dx = f32::cast_from((part % TILE) as u32) + 0.5_f32 - s.mean_x;
        if (k as u32) < count {
            for q in 0..PIXELS_PER_UNIT {
                let at = q * UNITS_PER_SPLAT + part;
                let v_power = exchange[k * units + at];
                let weight = exchange[(BATCH + k) * units + at];
                let dy = f32::cast_from((at / TILE) as u32) + 0.5_f32 - s.mean_y;
                let v_dy = v_power * dy;
                m0 += v_power;
                my += v_dy;
                myy += v_dy * dy;
                s_red += weight * upstream[at];
                s_green += weight * upstream[units + at];
                s_blue += weight * upstream[2 * units + at];
                if comptime!(depth) {
                    s_depth += weight * upstream[3 * units + at];
                }
                if comptime!(absolute) {
                    abs_x += f32::abs(v_power * (2.0_f32 * s.conic.xx * dx + s.conic.xy * dy));
                    abs_y += f32::abs(v_power * (2.0_f32 * s.conic.yy * dy + s.conic.xy * dx));
                }
            }
        }
        sync_cube();
        let mx = m0 * dx;
        exchange[unit] = m0;
        exchange[units + unit] = mx;
        exchange[2 * units + unit] = my;
        exchange[3 * units + unit] = mx * dx;
        exchange[4 * units + unit] = my * dx;
        exchange[5 * units + unit] = myy;
        exchange[6 * units + unit] = s_red;
        exchange[7 * units + unit] = s_green;
        exchange[8 * units + unit] = s_blue;
        exchange[9 * units + unit] = s_depth;
        exchange[10 * units + unit] = abs_x;
        exchange[11 * units + unit] = abs_y;
        sync_cube();
        // 4. A unit is one sum of one splat.
        let k = unit / grad_lane::COUNT;
        let l = unit % grad_lane::COUNT;
        if (k as u32) < count {
            // Four sums side by side: shorter chains of additions round less, and need not wait for each other.
            let from = l * units + k * UNITS_PER_SPLAT;
            let mut sum0 = 0.0_f32;
            let mut sum1 = 0.0_f32;
            let mut sum2 = 0.0_f32;
            let mut sum3 = 0.0_f32;
            for j in 0..UNITS_PER_SPLAT / 4 {
                sum0 += exchange[from + 4 * j];
                sum1 += exchange[from + 4 * j + 1];
                sum2 += exchange[from + 4 * j + 2];
                sum3 += exchange[from + 4 * j + 3];
            }
            let sum = (sum0 + sum1) + (sum2 + sum3);
            // Slot 0 of the splat's part of the lane keeps the sum; no other unit reads this part.
            exchange[l * units + k * UNITS_PER_SPLAT] = sum;
        }
        sync_cube();
        // 5. From moments to lanes: power = −½ dᵀ conic d, so ∂power/∂mean = −ln 2 · (2 xx dx + xy dy, …).
        if UNIT_POS < count {
            let k = unit;
            let s = staged_splat(&staged, k, BATCH);
            let slot = k * UNITS_PER_SPLAT;
            let to = pairs[(start + first + UNIT_POS) as usize * 2 + 1] as usize * grad_lane::COUNT;
            let mx = exchange[units + slot];
            let my = exchange[2 * units + slot];
            records[to + lane::MEAN_X] = -LN_2 * (2.0_f32 * s.conic.xx * mx + s.conic.xy * my);
            records[to + lane::MEAN_Y] = -LN_2 * (s.conic.xy * mx + 2.0_f32 * s.conic.yy * my);
            records[to + lane::CONIC_XX] = -0.5_f32 * exchange[3 * units + slot];
            records[to + lane::CONIC_XY] = -exchange[4 * units + slot];
            records[to + lane::CONIC_YY] = -0.5_f32 * exchange[5 * units + slot];
            records[to + lane::LOG2_OPACITY] = exchange[slot];
            records[to + lane::RED] = exchange[6 * units + slot];
            records[to + lane::RED + 1] = exchange[7 * units + slot];
            records[to + lane::RED + 2] = exchange[8 * units + slot];
            records[to + lane::DEPTH] = exchange[9 * units + slot];
            records[to + grad_lane::ABS_X] = LN_2 * exchange[10 * units + slot];
            records[to + grad_lane::ABS_Y] = LN_2 * exchange[11 * units + slot];
        }
        sync_cube();
    }
}
