//! Gradient of the rasteriser with respect to the lanes of the splats.
//!
//! Each tile walks its list back to front from where its last pixel stopped. Per pixel it carries the transmittance
//! behind the current splat, divided by 1 − α to step in front of it, and the scalar R·v of what lies behind
//! (renderer.md §3): nothing is subtracted from a sum, so no digits are lost where 1 − α is small. Per (splat, tile)
//! the pixels are reduced to six moments of v = ∂L/∂power, from which mean, conic and opacity follow, and to the sums
//! for colour and depth. Every pair writes its own record; records of entries behind the stop are zero.

use super::bin::TileLists;
use super::rasterize::{Raster, RasterOptions, smooth_cutoff};
use super::tile::{BATCH, CENTERS, RasterSplat, Row, RowI, Staged, TileRect, raster_splats, stage};
use crate::layout::{ONE_MINUS_ALPHA_MIN, TILE, grad_lane, lane};
use crate::math::alpha::{LN_2, LOG2_ALPHA_MIN};
use crate::simd::{Kernel, LANES, Simd, dispatch};
use rayon::prelude::*;

/// Gradient of one (splat, tile) pair, lanes as in [`grad_lane`].
pub type Record = [f32; grad_lane::COUNT];

/// Pixels of one tile row, going backwards.
#[derive(Debug, Clone, Copy)]
struct PixelRow {
    /// Transmittance behind the current splat.
    t: Row,
    /// Σ_{j behind} T_j α_j (c_j·v_C + z_j v_D) + T_final (b·v_C − v_A).
    behind: Row,
    /// Upstream gradient of R, G, B and depth.
    upstream: [Row; 4],
    /// List position at which the pixel stopped.
    stop: RowI,
}

const EMPTY: PixelRow = PixelRow {
    t: Row([0.0; LANES]),
    behind: Row([0.0; LANES]),
    upstream: [Row([0.0; LANES]); 4],
    stop: RowI([0; LANES]),
};

/// Gradients of all pairs, in list order: `[P]`.
///
/// `v_image`: upstream gradient `[H, W, 4 or 5]`; `raster` as kept by the forward pass. `absolute` also fills the sums
/// of per-pixel magnitudes (Ye 2024), if the options ask for them.
pub fn rasterize_bwd(
    splats: &[[f32; lane::COUNT]],
    lists: &TileLists<'_>,
    options: &RasterOptions,
    raster: &Raster<'_>,
    v_image: &[f32],
    absolute: bool,
) -> Vec<Record> {
    let tiles_x = lists.grid.tiles_x as usize;
    let splats = &raster_splats(splats);
    let mut by_list: Vec<Record> = vec![[0.0; grad_lane::COUNT]; lists.pair_splats.len()];
    let ends = (1..=lists.grid.tiles_y as usize).map(|r| lists.tile_offsets[r * tiles_x] as usize);
    super::bin::split_at_offsets(&mut by_list, ends).into_par_iter().enumerate().for_each(|(tile_y, records)| {
        let strip = Strip { splats, lists, options, raster, v_image, tile_y, records };
        match (options.depth, options.smooth_cutoff, absolute && options.absolute_gradients) {
            (false, false, false) => dispatch(BackwardStrip::<false, false, false>(strip)),
            (true, false, false) => dispatch(BackwardStrip::<true, false, false>(strip)),
            (false, true, false) => dispatch(BackwardStrip::<false, true, false>(strip)),
            (true, true, false) => dispatch(BackwardStrip::<true, true, false>(strip)),
            (false, false, true) => dispatch(BackwardStrip::<false, false, true>(strip)),
            (true, false, true) => dispatch(BackwardStrip::<true, false, true>(strip)),
            (false, true, true) => dispatch(BackwardStrip::<false, true, true>(strip)),
            (true, true, true) => dispatch(BackwardStrip::<true, true, true>(strip)),
        }
    });
    by_list
}

/// One row of tiles and its records.
struct Strip<'a> {
    splats: &'a [RasterSplat],
    lists: &'a TileLists<'a>,
    options: &'a RasterOptions,
    raster: &'a Raster<'a>,
    v_image: &'a [f32],
    tile_y: usize,
    records: &'a mut [Record],
}

struct BackwardStrip<'a, const DEPTH: bool, const SMOOTH: bool, const ABSOLUTE: bool>(Strip<'a>);

impl<const DEPTH: bool, const SMOOTH: bool, const ABSOLUTE: bool> Kernel
    for BackwardStrip<'_, DEPTH, SMOOTH, ABSOLUTE>
{
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Strip { splats, lists, options, raster, v_image, tile_y, records } = self.0;
        let (width, height) = (lists.grid.width as usize, lists.grid.height as usize);
        let first_tile = tile_y * lists.grid.tiles_x as usize;
        let first_pair = lists.tile_offsets[first_tile] as usize;
        let mut staged = [Staged::default(); BATCH];
        for tile_x in 0..lists.grid.tiles_x as usize {
            let tile = TileRect::new(tile_x, tile_y, width, height);
            let pairs =
                lists.tile_offsets[first_tile + tile_x] as usize..lists.tile_offsets[first_tile + tile_x + 1] as usize;
            let end = raster.tile_ends[first_tile + tile_x] as usize;
            let mut rows = [EMPTY; TILE];
            // A tile without upstream gradient (masked, for instance) keeps its zero records.
            if end == 0 || !load_tile::<DEPTH>(&mut rows, &tile, width, options, raster, v_image) {
                continue;
            }
            let list = &lists.pair_splats[pairs.clone()][..end];
            let records = &mut records[pairs.start - first_pair..][..end];
            for (batch, (indices, records)) in list.chunks(BATCH).zip(records.chunks_mut(BATCH)).enumerate().rev() {
                stage(splats, indices, &tile, &mut staged);
                for (k, record) in records.iter_mut().enumerate().rev() {
                    let index = (batch * BATCH + k) as i32;
                    uncomposite::<S, DEPTH, SMOOTH, ABSOLUTE>(s, &staged[k], index, &mut rows, options, record);
                }
            }
        }
    }
}

/// Loads transmittances, stops and upstream gradients of a tile. False if no gradient arrives.
#[inline(always)]
fn load_tile<const DEPTH: bool>(
    rows: &mut [PixelRow; TILE],
    tile: &TileRect,
    width: usize,
    options: &RasterOptions,
    raster: &Raster<'_>,
    v_image: &[f32],
) -> bool {
    let num = if DEPTH { 5 } else { 4 };
    let mut any = false;
    for (y, row) in rows[..tile.height].iter_mut().enumerate() {
        let at = (tile.y0 + y) * width + tile.x0;
        row.t.0[..tile.width].copy_from_slice(&raster.final_t[at..at + tile.width]);
        row.stop.0[..tile.width].copy_from_slice(&raster.stop[at..at + tile.width]);
        for (x, v) in v_image[at * num..][..tile.width * num].chunks_exact(num).enumerate() {
            let mut background = -v[3];
            for ((upstream, v), b) in row.upstream.iter_mut().zip(&v[..3]).zip(&options.background) {
                upstream.0[x] = *v;
                background += b * v;
            }
            if DEPTH {
                row.upstream[3].0[x] = v[4];
            }
            row.behind.0[x] = row.t.0[x] * background;
            any |= v.iter().any(|v| *v != 0.0);
        }
    }
    any
}

/// Steps all pixels in front of one splat and reduces its gradient to `record`.
#[inline(always)]
fn uncomposite<S: Simd, const DEPTH: bool, const SMOOTH: bool, const ABSOLUTE: bool>(
    s: S,
    g: &Staged,
    index: i32,
    rows: &mut [PixelRow; TILE],
    options: &RasterOptions,
    record: &mut Record,
) {
    let (first, end) = (g.first_row as usize, (g.end_row as usize).min(TILE));
    if first >= end {
        return;
    }
    // The same expressions as in the forward pass: α must come out with the same bits.
    let dx = s.sub(s.load(&CENTERS), s.splat(g.mean_x));
    let quadratic_x = s.fma(s.mul(s.splat(g.conic.xx), dx), dx, s.splat(g.log2_opacity));
    let linear_x = s.mul(s.splat(g.conic.xy), dx);
    let yy = s.splat(g.conic.yy);
    let channels = g.channels.map(|c| s.splat(c));
    let (cut, position) = (s.splat(LOG2_ALPHA_MIN), s.splat_i(index));
    let alpha_max = s.splat(options.alpha_max);
    let (zero, one) = (s.splat(0.0), s.splat(1.0));
    let guard = s.splat(ONE_MINUS_ALPHA_MIN);
    // power = −½ dᵀ conic d = ln 2 · (xx dx² + xy dx dy + yy dy²), so ∂power/∂mean = −ln 2 · (2 xx dx + xy dy, …).
    let (slope_xx, slope_xy, slope_yy) = (s.splat(2.0 * g.conic.xx), s.splat(g.conic.xy), s.splat(2.0 * g.conic.yy));
    let (mut m0, mut my, mut myy) = (zero, zero, zero);
    let mut v_channels = [zero; 4];
    let (mut abs_x, mut abs_y) = (zero, zero);
    for (row, center) in rows[first..end].iter_mut().zip(&CENTERS[first..end]) {
        let dy = s.splat(center - g.mean_y);
        let power = s.fma(dy, s.fma(yy, dy, linear_x), quadratic_x);
        let hit = s.gt_i_where(s.ge(power, cut), s.load_i(&row.stop.0), position);
        let raw = s.exp2_where(hit, power);
        let (full, slope) = if SMOOTH { smooth_cutoff(s, raw) } else { (raw, one) };
        let alpha = s.min(full, alpha_max);
        // No gradient through a clamped α.
        let free = s.gt_where(hit, alpha_max, full);
        let inverse = s.recip(s.max(s.sub(one, alpha), guard));
        let t_behind = s.load(&row.t.0);
        let t = s.mul(t_behind, inverse);
        // Selected, since 1/1 need not come out as exactly 1. All else vanishes with α where nothing is hit.
        s.store(s.select(hit, t, t_behind), &mut row.t.0);
        let weight = s.mul(alpha, t);
        let mut value = s.mul(channels[0], s.load(&row.upstream[0].0));
        value = s.fma(channels[1], s.load(&row.upstream[1].0), value);
        value = s.fma(channels[2], s.load(&row.upstream[2].0), value);
        if DEPTH {
            value = s.fma(channels[3], s.load(&row.upstream[3].0), value);
        }
        // ∂L/∂α_k = T_k value − behind / (1 − α_k)
        let behind = s.load(&row.behind.0);
        let v_alpha = s.fnma(behind, inverse, s.mul(t, value));
        s.store(s.fma(weight, value, behind), &mut row.behind.0);
        for (sum, upstream) in v_channels[..if DEPTH { 4 } else { 3 }].iter_mut().zip(&row.upstream) {
            *sum = s.fma(weight, s.load(&upstream.0), *sum);
        }
        // ∂α/∂power = α where it is not clamped.
        let d_alpha = if SMOOTH { s.mul(raw, slope) } else { raw };
        let v_power = s.mul_where(free, v_alpha, d_alpha);
        let v_dy = s.mul(v_power, dy);
        m0 = s.add(m0, v_power);
        my = s.add(my, v_dy);
        myy = s.fma(v_dy, dy, myy);
        if ABSOLUTE {
            let gx = s.fma(slope_xx, dx, s.mul(slope_xy, dy));
            let gy = s.fma(slope_yy, dy, s.mul(slope_xy, dx));
            abs_x = s.add(abs_x, s.abs(s.mul(v_power, gx)));
            abs_y = s.add(abs_y, s.abs(s.mul(v_power, gy)));
        }
    }
    let mx = s.mul(m0, dx);
    let [m0, mx, mxx, my_sum] = s.reduce_sum4(m0, mx, s.mul(mx, dx), my);
    let [mxy, myy, red, green] = s.reduce_sum4(s.mul(my, dx), myy, v_channels[0], v_channels[1]);
    let [blue, depth, abs_x, abs_y] = s.reduce_sum4(v_channels[2], v_channels[3], abs_x, abs_y);
    record[lane::MEAN_X] = -LN_2 * (2.0 * g.conic.xx * mx + g.conic.xy * my_sum);
    record[lane::MEAN_Y] = -LN_2 * (g.conic.xy * mx + 2.0 * g.conic.yy * my_sum);
    record[lane::CONIC_XX] = -0.5 * mxx;
    record[lane::CONIC_XY] = -mxy;
    record[lane::CONIC_YY] = -0.5 * myy;
    record[lane::LOG2_OPACITY] = m0;
    record[lane::RED] = red;
    record[lane::RED + 1] = green;
    record[lane::RED + 2] = blue;
    record[lane::DEPTH] = depth;
    record[grad_lane::ABS_X] = LN_2 * abs_x;
    record[grad_lane::ABS_Y] = LN_2 * abs_y;
}
