//! Which tiles an ellipse meets: the one definition of a (splat, tile) pair (renderer.md §2).
//!
//! A pair exists iff the ellipse α ≥ 1/255 meets the rectangle spanned by the tile's pixel centres inside the image.
//! Within one row of tiles the ellipse is convex, so the tiles it meets are consecutive.

#[cfg(feature = "gpu")]
use cubecl::prelude::*;

use super::conic::{Boundary, row_span};
use crate::layout::TILE;

/// Consecutive tiles along one axis, [first, end): whole numbers, as floats on both processors. Empty when they are
/// equal.
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TileSpan {
    /// First tile.
    pub first: f32,
    /// The tile behind the last.
    pub end: f32,
}

/// Tiles along one axis whose pixel centres come within [low, high]; `count` tiles cover `size` pixels. Empty for NaN.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn tiles_touched(low: f32, high: f32, size: f32, count: f32) -> TileSpan {
    // Tile i spans the centres 16 i + ½ … min(16 i + 15½, size − ½).
    let tile = TILE as f32;
    let mut first = 0.0_f32;
    let mut end = 0.0_f32;
    if low <= size - 0.5_f32 && high >= 0.5_f32 {
        first = f32::min(f32::max(f32::ceil((low - (tile - 0.5_f32)) / tile), 0.0_f32), count);
        end = f32::min(f32::max(f32::floor((high - 0.5_f32) / tile), 0.0_f32) + 1.0_f32, count);
    }
    TileSpan { first, end: f32::max(first, end) }
}

/// Tiles of row `row` that a splat with its mean at (`mean_x`, `mean_y`) meets, in an image of `width` × `height` pixels
/// and `tiles_x` tiles per row.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn tile_span(
    contour: Boundary,
    mean_x: f32,
    mean_y: f32,
    row: f32,
    width: f32,
    height: f32,
    tiles_x: f32,
) -> TileSpan {
    let tile = TILE as f32;
    let top = row * tile + 0.5_f32;
    let bottom = f32::min(top + (tile - 1.0_f32), height - 0.5_f32);
    let span = row_span(contour, top - mean_y, bottom - mean_y);
    let mut low = mean_x + span.min;
    let mut high = mean_x + span.max;
    if span.min > span.max {
        // An interval that lies outside the image on both sides.
        low = width;
        high = 0.0_f32;
    }
    tiles_touched(low, high, width, tiles_x)
}

#[cfg(feature = "gpu")]
super::copy_on_device!(TileSpanExpand);
