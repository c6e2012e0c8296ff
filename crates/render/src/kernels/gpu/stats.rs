//! Per-Gaussian counters from per-pair counters (definitions: [`SplatStats`]).
//!
//! A pass of its own composites every tile again: in batches of eight splats, pixels leave the weights they blend in
//! workgroup memory, and 32 units per splat sum, count and take the largest. Every pair has its own counters, which are
//! then summed per splat, one unit each. All sums are integers or have a fixed order, and all maxima are exact. Counters go
//! to the host, so a frame that is asked for them reads back twice: the number of pairs, and here.

use super::bin::TileLists;
use super::lut::{LutUse, below_limit, limits, tile_lut};
use super::rasterize::alpha_at;
use super::tile::{STAGED, TileArgs, pixel, stage, staged_splat, tile_args};
use crate::error::Result;
use crate::gpu::{Gpu, UNITS, cube_dim};
use crate::kernels::cpu::rasterize::RasterOptions;
use crate::options::StatsMode;
use crate::stats::{SplatStats, TileStats};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Splats of a batch.
const BATCH: usize = 8;
/// Units that reduce one splat.
const UNITS_PER_SPLAT: usize = UNITS as usize / BATCH;
/// Pixels that one of them looks at.
const PIXELS_PER_UNIT: usize = BATCH;

/// Words of the counters of one (Gaussian, tile) pair.
mod pair_word {
    /// 1 if the pair stands before the end of its tile.
    pub const USED: usize = 0;
    /// Pixels it dominates.
    pub const DOMINATED: usize = 1;
    /// Pixels in which it is blended.
    pub const BLENDED: usize = 2;
    /// Largest weight, bits of an `f32`.
    pub const WEIGHT_MAX: usize = 3;
    /// Sum of the weights over the tile's pixels, bits of an `f32`.
    pub const WEIGHT_SUM: usize = 4;
    /// Words in all.
    pub const COUNT: usize = 5;
}

/// Words of the counters of one splat.
mod splat_word {
    /// Tiles in which it is used.
    pub const USED: usize = 0;
    /// Pixels it dominates.
    pub const DOMINATED: usize = 1;
    /// Pixels in which it is blended.
    pub const BLENDED: usize = 2;
    /// Largest weight, bits of an `f32`.
    pub const WEIGHT_MAX: usize = 3;
    /// Sum of the weights, units of 2⁻³²: low word; the high word follows.
    pub const WEIGHT_SUM: usize = 4;
    /// Tiles in which it is blended.
    pub const TILES_BLENDED: usize = 6;
    /// Words in all.
    pub const COUNT: usize = 7;
}

/// Counters per Gaussian, and the number of tiles without any pair; `num_splats` is N, `tile_ends` those of the frame.
///
/// # Errors
/// [`crate::Error::Limit`] when a buffer is larger than the adapter takes; [`crate::Error::Device`] when the adapter does
/// not answer.
pub fn splat_stats(
    gpu: &Gpu,
    mode: StatsMode,
    num_splats: usize,
    lists: &TileLists,
    options: &RasterOptions,
    tile_ends: &CubeTensor,
) -> Result<(SplatStats, u64)> {
    let rows = |wanted: StatsMode| if mode >= wanted { num_splats } else { 0 };
    let num_pixels = lists.grid.width as usize * lists.grid.height as usize;
    let mut out = SplatStats {
        tiles_used: vec![0; rows(StatsMode::Tiles)],
        pixels_dominated: vec![0; rows(StatsMode::Dominance)],
        weight_max: vec![0.0; rows(StatsMode::Dominance)],
        pixels_blended: vec![0; rows(StatsMode::All)],
        weight_sum: vec![0; rows(StatsMode::All)],
        tiles_blended: vec![0; rows(StatsMode::All)],
        tiles: TileStats::default(),
        blends_of_pixels: vec![0; if mode == StatsMode::All { num_pixels } else { 0 }],
    };
    if mode == StatsMode::None {
        return Ok((out, 0));
    }
    if lists.num_pairs == 0 {
        let none = vec![0; lists.grid.len()];
        out.tiles = TileStats { num_pairs: none.clone(), num_pairs_used: none };
        return Ok((out, lists.grid.len() as u64));
    }
    // The counters of pixels stand behind those of pairs: the kernel has no binding left.
    let num_pair_words = lists.num_pairs * pair_word::COUNT;
    let counters = gpu.zeros("bytes of pair counters", &[num_pair_words + num_pixels], DType::U32)?;
    count_pairs::launch(
        &gpu.client,
        gpu.cubes(lists.grid.len()),
        cube_dim(),
        lists.lanes.clone().into_buffer_arg(),
        lists.tile_offsets.clone().into_buffer_arg(),
        lists.pairs.clone().into_buffer_arg(),
        tile_ends.clone().into_buffer_arg(),
        match &options.lut {
            Some(lut) => limits(gpu, lut).into_buffer_arg(),
            // Never read without a table.
            None => lists.lanes.clone().into_buffer_arg(),
        },
        lists.color_max.clone().into_buffer_arg(),
        counters.clone().into_buffer_arg(),
        tile_args(&lists.grid, options),
        num_pair_words as u32,
        mode >= StatsMode::Dominance,
        LutUse::of(options),
    );
    let of_pixels = gpu.empty("bytes of pixel counters", &[out.blends_of_pixels.len()], DType::U32)?;
    if mode == StatsMode::All {
        copy_from::launch(
            &gpu.client,
            gpu.units(num_pixels),
            cube_dim(),
            counters.clone().into_buffer_arg(),
            of_pixels.clone().into_buffer_arg(),
            num_pair_words as u32,
            num_pixels as u32,
        );
    }
    let per_splat = gpu.empty("bytes of splat counters", &[lists.num_visible, splat_word::COUNT], DType::U32)?;
    sum_counters::launch(
        &gpu.client,
        gpu.units(lists.num_visible),
        cube_dim(),
        counters.into_buffer_arg(),
        lists.record_offsets.clone().into_buffer_arg(),
        per_splat.clone().into_buffer_arg(),
        lists.num_visible as u32,
    );
    let [words, ids, offsets, ends, blends] =
        gpu.read_all_u32([&per_splat, &lists.global_from_compact, &lists.tile_offsets, tile_ends, &of_pixels])?;
    out.tiles = TileStats { num_pairs: offsets.windows(2).map(|w| w[1] - w[0]).collect(), num_pairs_used: ends };
    if mode == StatsMode::All {
        out.blends_of_pixels = blends;
    }
    let num_empty = offsets.windows(2).filter(|w| w[0] == w[1]).count() as u64;
    for (row, &id) in words.chunks_exact(splat_word::COUNT).zip(&ids) {
        let i = id as usize;
        out.tiles_used[i] = row[splat_word::USED];
        if mode >= StatsMode::Dominance {
            out.pixels_dominated[i] = row[splat_word::DOMINATED];
            out.weight_max[i] = f32::from_bits(row[splat_word::WEIGHT_MAX]);
        }
        if mode >= StatsMode::All {
            out.pixels_blended[i] = row[splat_word::BLENDED];
            out.tiles_blended[i] = row[splat_word::TILES_BLENDED];
            let (low, high) = (row[splat_word::WEIGHT_SUM], row[splat_word::WEIGHT_SUM + 1]);
            out.weight_sum[i] = u64::from(low) | u64::from(high) << 32;
        }
    }
    Ok((out, num_empty))
}

/// Composites every tile and fills the counters of its pairs, up to where the tile ended.
#[cube(launch)]
fn count_pairs(
    lanes: &[f32],
    tile_offsets: &[u32],
    pairs: &[u32],
    tile_ends: &[u32],
    limits: &[f32],
    color_max: &[u32],
    counters: &[Atomic<u32>],
    args: TileArgs,
    first_pixel: u32,
    #[comptime] pixels: bool,
    #[comptime] lut: Option<LutUse>,
) {
    let units = UNITS as usize;
    let unit = UNIT_POS as usize;
    let mut staged = Shared::<[f32]>::new_slice(STAGED * BATCH);
    // Weights of the batch, splat by splat.
    let mut weights = Shared::<[f32]>::new_slice(BATCH * UNITS as usize);
    // Sum, largest and number of each unit's weights.
    let mut partial = Shared::<[f32]>::new_slice(3 * UNITS as usize);
    let tile = CUBE_POS;
    if tile >= args.num_tiles as usize {
        terminate!();
    }
    let p = pixel(&args, tile as u32);
    let start = tile_offsets[tile];
    let end = tile_ends[tile];
    // 1. Pairs before the end are used.
    for k in range_stepped(UNIT_POS, end, UNITS) {
        let record = pairs[(start + k) as usize * 2 + 1] as usize;
        counters[record * pair_word::COUNT + pair_word::USED].store(1u32);
    }
    if comptime!(pixels) {
        let table = tile_lut(limits, color_max, &args, lut);
        let mut t = 1.0_f32;
        let mut red = 0.0_f32;
        let mut green = 0.0_f32;
        let mut blue = 0.0_f32;
        let mut is_done = !p.is_inside;
        let mut best = 0.0_f32;
        let mut best_at = end;
        let mut blends = 0u32;
        for batch in 0..end.div_ceil(BATCH as u32) {
            let first = batch * BATCH as u32;
            let count = u32::min(BATCH as u32, end - first);
            if UNIT_POS < count {
                let splat = pairs[(start + first + UNIT_POS) as usize * 2];
                stage(lanes, splat, &p, &mut staged, unit, BATCH);
            }
            sync_cube();
            // 2. A unit is a pixel.
            for k in 0..count {
                let slot = k as usize;
                let mut weight = 0.0_f32;
                if !is_done {
                    let alpha = alpha_at(staged_splat(&staged, slot, BATCH), p.center_x, p.center_y, false);
                    if alpha.is_hit {
                        let alpha = f32::min(alpha.full, args.alpha_max);
                        let t_next = t - alpha * t;
                        let mut is_blended = t_next > args.t_stop;
                        if comptime!(lut.is_some()) {
                            is_blended = is_blended && !below_limit(&table, limits, &args, t, red, green, blue, lut);
                        }
                        if is_blended {
                            weight = alpha * t;
                            if comptime!(lut.is_some()) {
                                red += weight * staged[6 * BATCH + slot];
                                green += weight * staged[7 * BATCH + slot];
                                blue += weight * staged[8 * BATCH + slot];
                            }
                            t = t_next;
                            blends += 1u32;
                            // The nearer wins a tie.
                            if weight > best {
                                best = weight;
                                best_at = first + k;
                            }
                        } else {
                            is_done = true;
                        }
                    }
                }
                weights[slot * units + unit] = weight;
            }
            sync_cube();
            // 3. 32 units are a splat.
            let k = unit / UNITS_PER_SPLAT;
            let part = unit % UNITS_PER_SPLAT;
            let mut sum = 0.0_f32;
            let mut largest = 0.0_f32;
            let mut number = 0.0_f32;
            if (k as u32) < count {
                for q in 0..PIXELS_PER_UNIT {
                    let weight = weights[k * units + q * UNITS_PER_SPLAT + part];
                    sum += weight;
                    largest = f32::max(largest, weight);
                    // A weight is never 0 where something is blended: α ≥ 1/255 and T above the stop or the limit.
                    if weight > 0.0_f32 {
                        number += 1.0_f32;
                    }
                }
            }
            partial[unit] = sum;
            partial[units + unit] = largest;
            partial[2 * units + unit] = number;
            sync_cube();
            if UNIT_POS < count {
                let mut sum = 0.0_f32;
                let mut largest = 0.0_f32;
                let mut number = 0.0_f32;
                for j in 0..UNITS_PER_SPLAT {
                    let at = unit * UNITS_PER_SPLAT + j;
                    sum += partial[at];
                    largest = f32::max(largest, partial[units + at]);
                    number += partial[2 * units + at];
                }
                let record = pairs[(start + first + UNIT_POS) as usize * 2 + 1] as usize * pair_word::COUNT;
                counters[record + pair_word::BLENDED].store(u32::cast_from(number));
                counters[record + pair_word::WEIGHT_MAX].store(u32::reinterpret(largest));
                counters[record + pair_word::WEIGHT_SUM].store(u32::reinterpret(sum));
            }
            sync_cube();
        }
        // 4. Each pixel credits the entry with its largest weight.
        if best_at < end {
            let record = pairs[(start + best_at) as usize * 2 + 1] as usize;
            counters[record * pair_word::COUNT + pair_word::DOMINATED].fetch_add(1u32);
        }
        if p.is_inside {
            counters[(first_pixel + p.index) as usize].store(blends);
        }
    }
}

/// Copies `len` words from `start` on.
#[cube(launch)]
fn copy_from(from: &[u32], to: &mut [u32], start: u32, len: u32) {
    if ABSOLUTE_POS < len as usize {
        to[ABSOLUTE_POS] = from[start as usize + ABSOLUTE_POS];
    }
}

/// Sums the counters of each splat's pairs.
#[cube(launch)]
fn sum_counters(counters: &[u32], record_offsets: &[u32], per_splat: &mut [u32], num_visible: u32) {
    let r = ABSOLUTE_POS;
    if r < num_visible as usize {
        let mut used = 0u32;
        let mut dominated = 0u32;
        let mut blended = 0u32;
        let mut tiles_blended = 0u32;
        let mut largest = 0u32;
        let mut low = 0u32;
        let mut high = 0u32;
        for record in record_offsets[r]..record_offsets[r + 1] {
            let at = record as usize * pair_word::COUNT;
            used += counters[at + pair_word::USED];
            dominated += counters[at + pair_word::DOMINATED];
            blended += counters[at + pair_word::BLENDED];
            if counters[at + pair_word::BLENDED] > 0 {
                tiles_blended += 1u32;
            }
            // The bits of positive floats order like the floats.
            largest = u32::max(largest, counters[at + pair_word::WEIGHT_MAX]);
            // 64-bit fixed point in units of 2⁻³²: whole part and fraction are exact.
            let sum = f32::reinterpret(counters[at + pair_word::WEIGHT_SUM]);
            let whole = f32::floor(sum);
            let fraction = u32::cast_from((sum - whole) * 4_294_967_296.0_f32);
            let before = low;
            low += fraction;
            high += u32::cast_from(whole);
            if low < before {
                high += 1u32;
            }
        }
        let to = r * splat_word::COUNT;
        per_splat[to + splat_word::USED] = used;
        per_splat[to + splat_word::DOMINATED] = dominated;
        per_splat[to + splat_word::BLENDED] = blended;
        per_splat[to + splat_word::WEIGHT_MAX] = largest;
        per_splat[to + splat_word::WEIGHT_SUM] = low;
        per_splat[to + splat_word::WEIGHT_SUM + 1] = high;
        per_splat[to + splat_word::TILES_BLENDED] = tiles_blended;
    }
}
