//! What the forward and backward rasterisers share: a tile's splats, staged for sixteen lanes, and its pixel rows.

use crate::layout::{EXTENT_SLACK, TILE, lane};
use crate::math::alpha::{contour_power2, log2_conic};
use crate::math::conic::{Boundary, boundary, row_span};
use crate::math::vec::Sym2;
use crate::simd::{LANES, prefetch};
use rayon::prelude::*;

const _: () = assert!(TILE == LANES, "one tile row is one vector");

/// Splats staged at a time: enough to amortise, few enough to stay in the first-level cache and to waste little when
/// the tile stops inside a batch.
pub(super) const BATCH: usize = 128;

/// Pixel-centre offsets 0.5 … 15.5 inside a tile.
pub(super) const CENTERS: [f32; LANES] =
    [0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5, 8.5, 9.5, 10.5, 11.5, 12.5, 13.5, 14.5, 15.5];

/// Sixteen floats on their own cache line.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
pub(super) struct Row(pub [f32; LANES]);

/// Sixteen integers on their own cache line.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
pub(super) struct RowI(pub [i32; LANES]);

/// One splat as the rasterisers read it: a cache line, gathered once per pair.
#[derive(Debug, Clone, Copy, Default)]
#[repr(align(64))]
pub(super) struct RasterSplat {
    mean_x: f32,
    mean_y: f32,
    /// Conic scaled to base-2 logarithms, see [`log2_conic()`].
    conic: Sym2,
    log2_opacity: f32,
    /// RGB and depth.
    channels: [f32; 4],
    /// Boundary of the contour α = 1/255 with x and y exchanged: it bounds rows.
    contour: Boundary,
}

/// The splats as the rasterisers read them, `[V]`.
pub(super) fn raster_splats(splats: &[[f32; lane::COUNT]]) -> Vec<RasterSplat> {
    splats
        .par_iter()
        .with_min_len(4096)
        .map(|s| {
            let conic = Sym2 { xx: s[lane::CONIC_XX], xy: s[lane::CONIC_XY], yy: s[lane::CONIC_YY] };
            let transposed = Sym2 { xx: conic.yy, xy: conic.xy, yy: conic.xx };
            let power2 = contour_power2(s[lane::LOG2_OPACITY]);
            RasterSplat {
                mean_x: s[lane::MEAN_X],
                mean_y: s[lane::MEAN_Y],
                conic: log2_conic(conic),
                log2_opacity: s[lane::LOG2_OPACITY],
                channels: [s[lane::RED], s[lane::RED + 1], s[lane::RED + 2], s[lane::DEPTH]],
                contour: boundary(transposed, power2, s[lane::EXTENT_Y], s[lane::EXTENT_X]),
            }
        })
        .collect()
}

/// One splat as a tile sees it.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Staged {
    /// Mean relative to the tile's corner, pixels.
    pub mean_x: f32,
    pub mean_y: f32,
    /// Conic scaled to base-2 logarithms.
    pub conic: Sym2,
    pub log2_opacity: f32,
    /// RGB and depth.
    pub channels: [f32; 4],
    /// Rows of the tile the splat can reach: [first_row, end_row).
    pub first_row: u32,
    pub end_row: u32,
}

/// The tile at column `tile_x` and row `tile_y`, and how much of it lies in the image.
#[derive(Debug, Clone, Copy)]
pub(super) struct TileRect {
    pub x0: usize,
    pub y0: usize,
    pub width: usize,
    pub height: usize,
}

impl TileRect {
    pub fn new(tile_x: usize, tile_y: usize, width: usize, height: usize) -> Self {
        let (x0, y0) = (tile_x * TILE, tile_y * TILE);
        Self { x0, y0, width: TILE.min(width - x0), height: TILE.min(height - y0) }
    }

    /// Lanes inside the image, as bits.
    pub fn lane_bits(&self) -> u16 {
        if self.width == LANES { u16::MAX } else { (1 << self.width) - 1 }
    }
}

/// Stages the splats at `indices`. The row range comes from the analytic extent of the ellipse over the tile's columns,
/// widened by the slack: rows outside hold no pixel with α ≥ 1/255.
#[inline(always)]
pub(super) fn stage(splats: &[RasterSplat], indices: &[u32], tile: &TileRect, staged: &mut [Staged; BATCH]) {
    let (x0, y0) = (tile.x0 as f32, tile.y0 as f32);
    let (right, height) = (tile.width as f32 - 0.5, tile.height as f32);
    for (k, (slot, &index)) in staged.iter_mut().zip(indices).enumerate() {
        if let Some(&ahead) = indices.get(k + PREFETCH_AHEAD) {
            prefetch(&splats[ahead as usize]);
        }
        let s = &splats[index as usize];
        let (mean_x, mean_y) = (s.mean_x - x0, s.mean_y - y0);
        let span = row_span(s.contour, 0.5 - SLACK_PX - mean_x, right + SLACK_PX - mean_x);
        let slack = SLACK_PX + EXTENT_SLACK * (s.contour.half_width + mean_y.abs());
        // Row y has its centre at y + ½: the first row is ⌈low − ½⌉, the last ⌊high − ½⌋.
        let first = (mean_y + span.min - slack - 0.5).ceil();
        let end = (mean_y + span.max + slack + 0.5).floor();
        *slot = Staged {
            mean_x,
            mean_y,
            conic: s.conic,
            log2_opacity: s.log2_opacity,
            channels: s.channels,
            first_row: first.max(0.0).min(height) as u32,
            end_row: end.max(0.0).min(height) as u32,
        };
    }
}

/// How many entries ahead a splat is asked for: enough to cover a miss of the second-level cache.
const PREFETCH_AHEAD: usize = 12;

/// Absolute slack of the row range, pixels.
const SLACK_PX: f32 = 1e-3;
