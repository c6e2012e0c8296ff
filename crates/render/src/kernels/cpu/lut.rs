//! What the rasterisers do with a termination table: reading it, asking it, and what becomes of the rest.
//!
//! Sixteen pixels of a tile row at a time. The table is looked at for rows only in which some pixel has come below its
//! line: first the largest entry, and once that has been reached the largest entry that its colour can still come to. NaN
//! counts as a dark channel; an empty tile never asks.

use super::bin::TileLists;
use super::rasterize::RasterOptions;
use super::tile::Row;
use crate::simd::{LANES, Simd};
use crate::termination::{BELOW_ONE, ColorMax, Residual};

/// The termination table as a tile sees it.
#[derive(Clone, Copy)]
pub(super) struct TileLut<'a> {
    /// γ times the entries, `[size³]`.
    limits: &'a [f32],
    size: f32,
    /// The largest of them.
    largest: f32,
    /// For each cell the largest limit its colours can still come to; empty where that is not known.
    limits_ahead: &'a [f32],
    /// Bound of the hidden channels.
    color_max: f32,
    residual: Residual,
}

/// The table in tile `id`; without one, what is never read.
pub(super) fn tile_lut<'a>(options: &'a RasterOptions, lists: &TileLists<'_>, id: usize) -> TileLut<'a> {
    let Some(lut) = &options.lut else {
        let residual = Residual::Background;
        return TileLut { limits: &[], size: 0.0, largest: 0.0, limits_ahead: &[], color_max: 1.0, residual };
    };
    let brightest = lists.color_max[id].max(1.0);
    let color_max = match lut.color_max() {
        ColorMax::One => 1.0,
        ColorMax::Tile => options.background.iter().copied().fold(brightest, f32::max),
    };
    let (limits, size, largest) = (lut.limits(), lut.size() as f32, lut.largest_limit());
    // Cells that a colour advances at most after T·c_max has come down to the largest limit, and what rounding adds.
    let advance = 1.001 * size * largest * (brightest / color_max);
    let limits_ahead = if advance < lut.ahead() as f32 { lut.limits_ahead() } else { &[] };
    TileLut { limits, size, largest, limits_ahead, color_max, residual: lut.residual() }
}

impl TileLut<'_> {
    /// The line of pixels that have not been looked at: no entry is larger, whatever the colour.
    pub fn first_line(&self) -> Row {
        Row([self.largest; LANES])
    }
}

/// Pixels of a row among `hit` that stop because the rest cannot be seen: T·c_max ≤ γ·LUT(C) (JND Sec. 3). Those
/// that have stopped before are not among them. `line`: values of T·c_max above which no pixel of the row can stop.
#[inline(always)]
pub(super) fn below_limit<S: Simd>(
    s: S,
    lut: TileLut<'_>,
    hit: S::M,
    t: S::F,
    channels: &[Row; 4],
    line: &mut Row,
) -> S::M {
    let left = s.mul(t, s.splat(lut.color_max));
    let near = s.and_not(s.gt_where(hit, t, s.splat(0.0)), s.gt(left, s.load(&line.0)));
    if s.bits(near) == 0 {
        return near;
    }
    let size = s.splat(lut.size);
    let [red, green, blue] = [0, 1, 2].map(|c| {
        let color = s.min(s.max(s.load(&channels[c].0), s.splat(0.0)), s.splat(BELOW_ONE));
        s.truncate(s.mul(color, size))
    });
    let cell = s.fma(s.fma(red, size, green), size, blue);
    if !lut.limits_ahead.is_empty() {
        // Channels never shrink: from here on the colour meets the entries ahead of its cell only.
        let ahead = s.lookup(lut.limits_ahead, cell);
        s.store(s.select(near, ahead, s.load(&line.0)), &mut line.0);
    }
    s.and_not(near, s.gt(left, s.lookup(lut.limits, cell)))
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
