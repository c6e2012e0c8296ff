//! Rasterisation: every pixel composites its tile's list front to back.
//!
//! One task per row of tiles; per tile, splats are staged in batches and each visits the rows its ellipse reaches,
//! sixteen pixels at a time. The state of the 256 pixels stays in the first-level cache. A pixel that has stopped
//! keeps its transmittance with the sign flipped: the test "T(1−α) > T_stop" then fails for every later splat without
//! a mask. A tile ends when all its pixels have stopped, a row of one is left out from the next look on, eight splats later at
//! most. Empty lists give the background.
//!
//! With a termination table a pixel also stops before a splat when its colour allows it (JND Sec. 3). The table is looked
//! at for rows only in which some pixel has come within reach of its largest entry.
//!
//! A few lines over the aim: image, counters and table are one loop with options at compile time, not three copies.

use super::bin::TileLists;
use super::lut::{Line, TileLut, clear_or_stop, needs_fixed, residual, tile_lut};
use super::stats::{PairStats, StatsLevel};
use super::tile::{BATCH, CENTERS, RasterSplat, Row, RowI, Staged, TileRect, raster_splats, stage};
use crate::layout::{TILE, lane};
use crate::math::alpha::LOG2_ALPHA_MIN;
use crate::simd::{Kernel, LANES, Simd, dispatch};
use crate::stats::RenderStats;
use crate::termination::TerminationLut;
use rayon::prelude::*;
use std::borrow::Cow;

/// Options of the rasterisers.
#[derive(Debug, Clone, PartialEq)]
pub struct RasterOptions {
    /// Clamp of α.
    pub alpha_max: f32,
    /// A pixel stops before the splat that would bring T to this or below.
    pub t_stop: f32,
    /// Table by which a pixel stops too; never with the smoothed cut.
    pub lut: Option<TerminationLut>,
    /// Colour behind everything.
    pub background: [f32; 3],
    /// Fifth channel Σ T α z.
    pub depth: bool,
    /// Cut at α = 1/255 smoothed to C¹, for finite differences.
    pub smooth_cutoff: bool,
    /// Whether the gradient of a probed frame has the sums of per-pixel magnitudes (Ye 2024).
    pub absolute_gradients: bool,
}

impl RasterOptions {
    /// Channels of the image.
    pub fn num_channels(&self) -> usize {
        if self.depth { 5 } else { 4 }
    }
}

/// What a frame leaves behind.
#[derive(Debug, Clone, Default)]
pub struct Raster<'a> {
    /// `[H, W, 4 or 5]`: RGB over the background, α = 1 − T, and Σ T α z if asked for. Empty for a statistics pass.
    pub image: Vec<f32>,
    /// Transmittance left at each pixel, `[H, W]`.
    pub final_t: Cow<'a, [f32]>,
    /// List position at which each pixel stopped, `[H, W]`; `i32::MAX` = never.
    pub stop: Cow<'a, [i32]>,
    /// List position at which each tile ended, `[tiles]`: entries before it were worked through.
    pub tile_ends: Cow<'a, [u32]>,
    /// Counters of each pair, in list order, `[P]`; empty unless asked for.
    pub pair_stats: Vec<PairStats>,
    /// Splats blended in each pixel, `[H, W]`; empty unless all counters are asked for.
    pub blends: Vec<u32>,
    /// Per-tile counters, summed.
    pub stats: RenderStats,
}

/// Pixels of one tile row.
#[derive(Debug, Clone, Copy)]
struct PixelRow {
    /// Transmittance; negative once the pixel has stopped.
    t: Row,
    /// R, G, B, Σ T α z; a pass for all counters has no depth and keeps the number of blended splats in its place.
    channels: [Row; 4],
    /// List position of the stop.
    stop: RowI,
    /// Largest weight so far and its list position (statistics only).
    best: Row,
    best_index: RowI,
}

const FRESH: PixelRow = PixelRow {
    t: Row([1.0; LANES]),
    channels: [Row([0.0; LANES]); 4],
    stop: RowI([i32::MAX; LANES]),
    best: Row([0.0; LANES]),
    best_index: RowI([-1; LANES]),
};

/// Composites all tiles. `splats`: lanes `[V]`; `keep` keeps what the backward pass needs.
pub fn rasterize(
    splats: &[[f32; lane::COUNT]],
    lists: &TileLists<'_>,
    options: &RasterOptions,
    level: StatsLevel,
    keep: bool,
) -> Raster<'static> {
    let (width, height) = (lists.grid.width as usize, lists.grid.height as usize);
    let channels = if level == StatsLevel::None { options.num_channels() } else { 0 };
    let num_kept = if keep { width * height } else { 0 };
    let mut image = vec![0.0; width * height * channels];
    let (mut final_t, mut stop) = (vec![0.0; num_kept], vec![0; num_kept]);
    let mut tile_ends = vec![0; lists.grid.len()];
    let counts_blends = level == StatsLevel::All;
    let mut blends = vec![0; if counts_blends { width * height } else { 0 }];
    let splats = &raster_splats(splats);
    let with_fixed = options.lut.as_ref().is_some_and(|lut| needs_fixed(lut, options, lists));
    let mut tile_stats = vec![Vec::new(); lists.grid.tiles_y as usize];
    // A missing plane is cut into empty strips, so that all planes zip.
    let strip = |plane: usize| TILE * width * plane;
    let strips = (0..lists.grid.tiles_y as usize)
        .into_par_iter()
        .zip(strips_of(&mut image, strip(channels), lists))
        .zip(strips_of(&mut final_t, strip(usize::from(keep)), lists))
        .zip(strips_of(&mut stop, strip(usize::from(keep)), lists))
        .zip(strips_of(&mut blends, strip(usize::from(counts_blends)), lists))
        .zip(tile_ends.par_chunks_mut(lists.grid.tiles_x as usize))
        .zip(tile_stats.par_iter_mut())
        .map(|((((((tile_y, image), final_t), stop), blends), tile_ends), pair_stats)| {
            let strip = Strip { splats, lists, options, tile_y, image, final_t, stop, blends, tile_ends, pair_stats };
            if options.lut.is_some() {
                return match (with_fixed, level, options.depth) {
                    (false, StatsLevel::Dominance, _) => dispatch(ForwardStrip::<false, 1, false, LUT_ALONE>(strip)),
                    (false, StatsLevel::All, _) => dispatch(ForwardStrip::<false, 2, false, LUT_ALONE>(strip)),
                    (false, StatsLevel::None, false) => dispatch(ForwardStrip::<false, 0, false, LUT_ALONE>(strip)),
                    (false, StatsLevel::None, true) => dispatch(ForwardStrip::<true, 0, false, LUT_ALONE>(strip)),
                    (true, StatsLevel::Dominance, _) => dispatch(ForwardStrip::<false, 1, false, LUT_AND_FIXED>(strip)),
                    (true, StatsLevel::All, _) => dispatch(ForwardStrip::<false, 2, false, LUT_AND_FIXED>(strip)),
                    (true, StatsLevel::None, false) => dispatch(ForwardStrip::<false, 0, false, LUT_AND_FIXED>(strip)),
                    (true, StatsLevel::None, true) => dispatch(ForwardStrip::<true, 0, false, LUT_AND_FIXED>(strip)),
                };
            }
            match (level, options.depth, options.smooth_cutoff) {
                (StatsLevel::Dominance, ..) => dispatch(ForwardStrip::<false, 1, false, NO_LUT>(strip)),
                (StatsLevel::All, ..) => dispatch(ForwardStrip::<false, 2, false, NO_LUT>(strip)),
                (StatsLevel::None, false, false) => dispatch(ForwardStrip::<false, 0, false, NO_LUT>(strip)),
                (StatsLevel::None, true, false) => dispatch(ForwardStrip::<true, 0, false, NO_LUT>(strip)),
                (StatsLevel::None, false, true) => dispatch(ForwardStrip::<false, 0, true, NO_LUT>(strip)),
                (StatsLevel::None, true, true) => dispatch(ForwardStrip::<true, 0, true, NO_LUT>(strip)),
            }
        })
        .collect::<Vec<RenderStats>>();
    let mut stats = RenderStats::default();
    for strip in &strips {
        stats.add_tiles(strip);
    }
    Raster {
        image,
        final_t: final_t.into(),
        stop: stop.into(),
        tile_ends: tile_ends.into(),
        pair_stats: tile_stats.into_iter().flatten().collect(),
        blends,
        stats,
    }
}

/// `plane` cut into one strip per row of tiles; empty strips if there is no plane.
pub(super) fn strips_of<'a, T: Send>(
    plane: &'a mut [T],
    strip: usize,
    lists: &TileLists<'_>,
) -> rayon::vec::IntoIter<&'a mut [T]> {
    let len = plane.len();
    let ends = (1..=lists.grid.tiles_y as usize).map(|row| (row * strip).min(len));
    super::bin::split_at_offsets(plane, ends).into_par_iter()
}

/// One row of tiles and the parts of the output it owns.
struct Strip<'a> {
    splats: &'a [RasterSplat],
    lists: &'a TileLists<'a>,
    options: &'a RasterOptions,
    tile_y: usize,
    image: &'a mut [f32],
    final_t: &'a mut [f32],
    stop: &'a mut [i32],
    blends: &'a mut [u32],
    tile_ends: &'a mut [u32],
    pair_stats: &'a mut Vec<PairStats>,
}

/// Without a termination table.
const NO_LUT: u8 = 0;
/// With a termination table beside the fixed rule.
const LUT_AND_FIXED: u8 = 1;
/// With a termination table and nothing else: one comparison less, and a stop is looked for where the table was asked.
const LUT_ALONE: u8 = 2;

/// The forward kernel. `STATS`: 0 = image, 1 = dominance counters, 2 = all counters; counters replace the image. `LUT`:
/// [`NO_LUT`], [`LUT_AND_FIXED`] or [`LUT_ALONE`].
struct ForwardStrip<'a, const DEPTH: bool, const STATS: u8, const SMOOTH: bool, const LUT: u8>(Strip<'a>);

impl<const DEPTH: bool, const STATS: u8, const SMOOTH: bool, const LUT: u8> Kernel
    for ForwardStrip<'_, DEPTH, STATS, SMOOTH, LUT>
{
    type Output = RenderStats;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> RenderStats {
        let Strip { splats, lists, options, tile_y, image, final_t, stop, blends, tile_ends, pair_stats } = self.0;
        let (width, height) = (lists.grid.width as usize, lists.grid.height as usize);
        let mut stats = RenderStats::default();
        let mut staged = [Staged::default(); BATCH];
        for (tile_x, tile_end) in tile_ends.iter_mut().enumerate() {
            let tile = TileRect::new(tile_x, tile_y, width, height);
            let id = tile_y * lists.grid.tiles_x as usize + tile_x;
            let pairs = lists.tile_offsets[id] as usize..lists.tile_offsets[id + 1] as usize;
            stats.num_tiles_empty += u64::from(pairs.is_empty());
            let list = &lists.pair_splats[pairs];
            let lut = tile_lut(options, lists, id);
            let mut rows = [FRESH; TILE];
            let mut lines = [lut.first_line(); TILE];
            let outside = s.and_not(s.mask(u16::MAX), s.mask(tile.lane_bits()));
            for row in &mut rows[..tile.height] {
                s.store(s.select(outside, s.splat(-1.0), s.splat(1.0)), &mut row.t.0);
                s.store_i(s.select_i(outside, s.splat_i(-1), s.splat_i(i32::MAX)), &mut row.stop.0);
            }
            let first_pair = pair_stats.len();
            if STATS > 0 {
                pair_stats.resize(first_pair + list.len(), PairStats::default());
            }
            let mut alive = rows_alive(s, &rows[..tile.height]);
            for (batch, indices) in list.chunks(BATCH).enumerate() {
                stage(splats, indices, &tile, &mut staged);
                for (part, chunk) in staged[..indices.len()].chunks(CHECK).enumerate() {
                    for (k, splat) in chunk.iter().enumerate() {
                        let index = batch * BATCH + part * CHECK + k;
                        let counters = pair_stats.get_mut(first_pair + index);
                        let num_rows = composite::<S, DEPTH, STATS, SMOOTH, LUT>(
                            s,
                            splat,
                            index as i32,
                            &mut rows,
                            options,
                            lut,
                            &mut lines,
                            alive,
                            counters,
                        );
                        stats.num_lane_pixels += (num_rows * LANES) as u64;
                    }
                    alive = rows_alive(s, &rows[..tile.height]);
                    if alive == 0 {
                        break;
                    }
                }
                if alive == 0 {
                    break;
                }
            }
            // E: where the last pixel stopped; entries before it were worked through, those after it changed nothing.
            let end = if alive != 0 { list.len() } else { last_stop(&rows, &tile) };
            stats.num_pairs_used += end as u64;
            *tile_end = end as u32;
            if STATS > 0 {
                let counters = &mut pair_stats[first_pair..];
                super::stats::credit_winners(
                    counters,
                    rows[..tile.height].iter().map(|r| (&r.best_index.0, tile.width)),
                );
                if STATS == 2 {
                    stats.num_blended += counters.iter().map(|c| u64::from(c.pixels_blended)).sum::<u64>();
                    for (y, row) in rows[..tile.height].iter().enumerate() {
                        let counts = &mut blends[y * width + tile.x0..][..tile.width];
                        counts.iter_mut().zip(&row.channels[3].0).for_each(|(to, &count)| *to = count as u32);
                    }
                }
            } else {
                write_colors::<S, DEPTH, LUT>(s, &rows, &tile, width, options, lut, image);
            }
            if !final_t.is_empty() {
                for (y, row) in rows[..tile.height].iter().enumerate() {
                    let at = y * width + tile.x0;
                    for (dst, t) in final_t[at..at + tile.width].iter_mut().zip(&row.t.0) {
                        *dst = t.abs();
                    }
                    stop[at..at + tile.width].copy_from_slice(&row.stop.0[..tile.width]);
                }
            }
        }
        stats
    }
}

/// Blends one splat into the rows it reaches and in which some pixel is `alive`, as bits. Returns the number of rows visited.
#[expect(clippy::too_many_arguments, reason = "the state of the loop, passed in registers")]
#[inline(always)]
fn composite<S: Simd, const DEPTH: bool, const STATS: u8, const SMOOTH: bool, const LUT: u8>(
    s: S,
    g: &Staged,
    index: i32,
    rows: &mut [PixelRow; TILE],
    options: &RasterOptions,
    lut: TileLut<'_>,
    lines: &mut [Line; TILE],
    alive: u32,
    counters: Option<&mut PairStats>,
) -> usize {
    // Rows whose pixels have all stopped are left out.
    let reached = (1u32 << g.end_row.min(TILE as u32)).wrapping_sub(1u32 << g.first_row.min(TILE as u32));
    let mut open = if g.first_row < g.end_row { reached & alive } else { 0 };
    let num_rows = open.count_ones() as usize;
    if open == 0 {
        return 0;
    }
    // log2 α = yy dy² + xy dx dy + (xx dx² + log2 o)
    let dx = s.sub(s.load(&CENTERS), s.splat(g.mean_x));
    let quadratic_x = s.fma(s.mul(s.splat(g.conic.xx), dx), dx, s.splat(g.log2_opacity));
    let linear_x = s.mul(s.splat(g.conic.xy), dx);
    let yy = s.splat(g.conic.yy);
    let channels = g.channels.map(|c| s.splat(c));
    let cut = s.splat(LOG2_ALPHA_MIN);
    let alpha_max = s.splat(options.alpha_max);
    let t_stop = s.splat(options.t_stop);
    let (zero, position) = (s.splat(0.0), s.splat_i(index));
    let (mut num_blended, mut weight_max, mut weight_sum) = (0, s.splat(0.0), s.splat(0.0));
    while open != 0 {
        let y = open.trailing_zeros() as usize % TILE;
        open &= open - 1;
        let (row, center) = (&mut rows[y], CENTERS[y]);
        let dy = s.splat(center - g.mean_y);
        let power = s.fma(dy, s.fma(yy, dy, linear_x), quadratic_x);
        // Compared before the exponential; false for NaN.
        let hit = s.ge(power, cut);
        let mut alpha = s.exp2_where(hit, power);
        if SMOOTH {
            alpha = smooth_cutoff(s, alpha).0;
        }
        let alpha = s.min(alpha, alpha_max);
        let t = s.load(&row.t.0);
        let t_next = s.fnma(alpha, t, t);
        // Kerbl 2023, App. C: stop before the splat that would end the pixel.
        let (blended, now);
        if LUT == LUT_ALONE {
            (blended, now) = clear_or_stop(s, lut, hit, t, &row.channels, &mut lines[y]);
        } else {
            let mut ahead = s.gt_where(hit, t_next, t_stop);
            if LUT == LUT_AND_FIXED {
                ahead = s.and_not(ahead, clear_or_stop(s, lut, hit, t, &row.channels, &mut lines[y]).1);
            }
            blended = ahead;
            now = s.gt_where(s.and_not(hit, blended), t, zero);
        }
        let weight = s.mul_where(blended, alpha, t);
        // No branch: in a dense tile some pixel stops at almost every splat.
        let t_new = s.select(blended, t_next, t);
        s.store(s.select(now, s.neg_abs(t), t_new), &mut row.t.0);
        s.store_i(s.select_i(now, position, s.load_i(&row.stop.0)), &mut row.stop.0);
        if STATS == 0 || LUT != NO_LUT {
            let num = if DEPTH { 4 } else { 3 };
            for (sum, channel) in row.channels[..num].iter_mut().zip(channels) {
                s.store(s.fma(weight, channel, s.load(&sum.0)), &mut sum.0);
            }
        }
        if STATS > 0 {
            let best = s.load(&row.best.0);
            let better = s.gt_where(blended, weight, best);
            s.store(s.select(better, weight, best), &mut row.best.0);
            s.store_i(s.select_i(better, position, s.load_i(&row.best_index.0)), &mut row.best_index.0);
            weight_max = s.max(weight_max, weight);
            if STATS == 2 {
                num_blended += s.bits(blended).count_ones();
                let count = s.load(&row.channels[3].0);
                s.store(s.select(blended, s.add(count, s.splat(1.0)), count), &mut row.channels[3].0);
                weight_sum = s.add(weight_sum, weight);
            }
        }
    }
    if STATS > 0
        && let Some(counters) = counters
    {
        counters.weight_max = s.reduce_max(weight_max);
        if STATS == 2 {
            counters.set_blended(num_blended, s.reduce_sum4(weight_sum, zero, zero, zero)[0]);
        }
    }
    num_rows
}

/// The test-only smooth cut: α·h(u) and its derivative with respect to α, u = clamp(255 α − 1, 0, 1), h(u) = u²(3 − 2u).
#[inline(always)]
pub(super) fn smooth_cutoff<S: Simd>(s: S, alpha: S::F) -> (S::F, S::F) {
    let u = s.fma(alpha, s.splat(255.0), s.splat(-1.0));
    let u = s.min(s.max(u, s.splat(0.0)), s.splat(1.0));
    let h = s.mul(s.mul(u, u), s.fnma(s.splat(2.0), u, s.splat(3.0)));
    let slope = s.mul(s.mul(s.splat(6.0), u), s.sub(s.splat(1.0), u));
    (s.mul(alpha, h), s.fma(s.mul(alpha, s.splat(255.0)), slope, h))
}

/// Splats between two looks at whether the tile has ended.
const CHECK: usize = 8;

/// Rows in which some pixel has not stopped, as bits.
#[inline(always)]
fn rows_alive<S: Simd>(s: S, rows: &[PixelRow]) -> u32 {
    let is_alive = |row: &PixelRow| s.bits(s.gt(s.load(&row.t.0), s.splat(0.0))) != 0;
    rows.iter().enumerate().map(|(y, row)| u32::from(is_alive(row)) << y).sum()
}

/// The largest stop position of the pixels inside the image.
#[inline(always)]
fn last_stop(rows: &[PixelRow; TILE], tile: &TileRect) -> usize {
    let last = rows[..tile.height].iter().flat_map(|r| &r.stop.0[..tile.width]).copied().max();
    usize::try_from(last.unwrap_or(0)).unwrap_or(0)
}

/// Writes a tile's pixels: colour over the background, 1 − T, and depth.
#[inline(always)]
fn write_colors<S: Simd, const DEPTH: bool, const LUT: u8>(
    s: S,
    rows: &[PixelRow; TILE],
    tile: &TileRect,
    width: usize,
    options: &RasterOptions,
    lut: TileLut<'_>,
    image: &mut [f32],
) {
    let num = if DEPTH { 5 } else { 4 };
    let background = options.background.map(|b| s.splat(b));
    for (y, row) in rows[..tile.height].iter().enumerate() {
        let signed = s.load(&row.t.0);
        let t = s.abs(signed);
        let mut planes = [[0.0; LANES]; 5];
        for ((plane, channel), b) in planes.iter_mut().zip(&row.channels).zip(background) {
            let color = s.load(&channel.0);
            let mut rest = b;
            if LUT != NO_LUT {
                rest = s.select(s.gt(signed, s.splat(0.0)), b, residual(s, lut, t, color, b));
            }
            s.store(s.fma(t, rest, color), plane);
        }
        s.store(s.sub(s.splat(1.0), t), &mut planes[3]);
        planes[4] = row.channels[3].0;
        let mut pixels = [0.0; LANES * 5];
        for x in 0..LANES {
            for (c, plane) in planes[..num].iter().enumerate() {
                pixels[x * num + c] = plane[x];
            }
        }
        let len = tile.width * num;
        image[(y * width + tile.x0) * num..][..len].copy_from_slice(&pixels[..len]);
    }
}
