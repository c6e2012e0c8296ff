//! What the rasterisers do with a termination table: reading it, asking it, and what becomes of the rest.
//!
//! Sixteen pixels of a tile row at a time. The table is looked at for rows only in which some pixel has come within reach
//! of its largest entry. NaN counts as a dark channel; an empty tile never asks.

use super::bin::TileLists;
use super::rasterize::RasterOptions;
use super::tile::Row;
use crate::simd::Simd;
use crate::termination::{BELOW_ONE, ColorMax, Residual};

/// The termination table as a tile sees it.
#[derive(Clone, Copy)]
pub(super) struct TileLut<'a> {
    /// γ times the entries, `[size³]`.
    limits: &'a [f32],
    size: f32,
    /// The largest of them.
    largest: f32,
    /// Bound of the hidden channels.
    color_max: f32,
    residual: Residual,
}

/// The table in tile `id`; without one, what is never read.
pub(super) fn tile_lut<'a>(options: &'a RasterOptions, lists: &TileLists<'_>, id: usize) -> TileLut<'a> {
    let Some(lut) = &options.lut else {
        return TileLut { limits: &[], size: 0.0, largest: 0.0, color_max: 1.0, residual: Residual::Background };
    };
    let color_max = match lut.color_max() {
        ColorMax::One => 1.0,
        ColorMax::Tile => options.background.iter().copied().fold(1.0, f32::max).max(lists.color_max[id]),
    };
    let (limits, size, largest) = (lut.limits(), lut.size() as f32, lut.largest_limit());
    TileLut { limits, size, largest, color_max, residual: lut.residual() }
}

/// Pixels of a row among `hit` that stop because the rest cannot be seen: T·c_max ≤ γ·LUT(C) (JND Sec. 3). Those
/// that have stopped before are not among them.
#[inline(always)]
pub(super) fn below_limit<S: Simd>(s: S, lut: TileLut<'_>, hit: S::M, t: S::F, channels: &[Row; 4]) -> S::M {
    let left = s.mul(t, s.splat(lut.color_max));
    // No entry is larger, so above this line no pixel stops, whatever its colour.
    let near = s.and_not(s.gt_where(hit, t, s.splat(0.0)), s.gt(left, s.splat(lut.largest)));
    if s.bits(near) == 0 {
        return near;
    }
    let size = s.splat(lut.size);
    let [red, green, blue] = [0, 1, 2].map(|c| {
        let color = s.min(s.max(s.load(&channels[c].0), s.splat(0.0)), s.splat(BELOW_ONE));
        s.truncate(s.mul(color, size))
    });
    let limit = s.lookup(lut.limits, s.fma(s.fma(red, size, green), size, blue));
    s.and_not(near, s.gt(left, limit))
}

/// What a pixel that stopped receives per unit of the transmittance left; `color` is what it has composited.
#[inline(always)]
pub(super) fn residual<S: Simd>(s: S, lut: TileLut<'_>, t: S::F, color: S::F, background: S::F) -> S::F {
    match lut.residual {
        Residual::Drop => s.splat(0.0),
        Residual::Background => background,
        // A pixel that stopped at once has seen nothing: 0 / ε.
        Residual::Mean => s.div(color, s.max(s.sub(s.splat(1.0), t), s.splat(f32::EPSILON))),
        Residual::Centre => s.splat(0.5 * lut.color_max),
    }
}
