//! What the rasterisers do with a termination table: reading it, asking it, and what becomes of the rest.
//!
//! Sixteen pixels of a tile row at a time. The table is looked at for rows only in which some pixel has come below its
//! line: first the largest entry, and once that has been reached the largest entry that its colour can still come to. NaN
//! counts as a dark channel; an empty tile never asks.

use super::bin::TileLists;
use super::rasterize::RasterOptions;
use super::tile::Row;
use crate::layout::T_FLOOR;
use crate::simd::{LANES, Simd};
use crate::termination::{BELOW_ONE, ColorMax, Residual, TerminationLut};

/// The termination table as a tile sees it.
#[derive(Clone, Copy)]
pub(super) struct TileLut<'a> {
    /// γ times the entries, `[size³]`.
    limits: &'a [f32],
    size: f32,
    /// How many there are.
    cells: f32,
    /// The largest of them.
    largest: f32,
    /// For each set of axes and each cell the largest limit that its colours can still come to along them; empty where that
    /// is not known.
    limits_ahead: &'a [f32],
    /// Cells ahead that it covers.
    ahead: f32,
    /// How far a channel can advance, in parts of T·c_max: more than 1 where c_max is not the largest channel.
    reach: f32,
    /// Bound of the hidden channels.
    color_max: f32,
    residual: Residual,
}

/// The table in tile `id`; without one, what is never read.
pub(super) fn tile_lut<'a>(options: &'a RasterOptions, lists: &TileLists<'_>, id: usize) -> TileLut<'a> {
    let Some(lut) = &options.lut else {
        let residual = Residual::Background;
        return TileLut {
            limits: &[],
            size: 0.0,
            cells: 0.0,
            largest: 0.0,
            limits_ahead: &[],
            ahead: 0.0,
            reach: 1.0,
            color_max: 1.0,
            residual,
        };
    };
    let brightest = lists.color_max[id].max(1.0);
    let color_max = match lut.color_max() {
        ColorMax::One => 1.0,
        ColorMax::Tile => options.background.iter().copied().fold(brightest, f32::max),
    };
    let (limits, size, largest) = (lut.limits(), lut.size() as f32, lut.largest_limit());
    // A thousandth is for rounding.
    let reach = 1.001 * brightest / color_max;
    // Cells that a colour advances at most after T·c_max has come down to the largest limit.
    let advance = size * largest * reach;
    let limits_ahead = if advance < lut.ahead() as f32 { lut.limits_ahead() } else { &[] };
    TileLut {
        limits,
        size,
        cells: limits.len() as f32,
        largest,
        limits_ahead,
        ahead: lut.ahead() as f32,
        reach,
        color_max,
        residual: lut.residual(),
    }
}

/// Whether the fixed rule at `options.t_stop` can stop a pixel that the table does not: it was asked for, or the table admits
/// transmittances so small that f32 ends.
pub(super) fn needs_fixed(lut: &TerminationLut, options: &RasterOptions, lists: &TileLists<'_>) -> bool {
    let color_max = match lut.color_max() {
        ColorMax::One => 1.0,
        ColorMax::Tile => lists.color_max.iter().chain(&options.background).copied().fold(1.0, f32::max),
    };
    // One splat takes a pixel down to a 10⁻⁴th: between 10⁻¹⁵ and the floor there is room for the last.
    options.t_stop > T_FLOOR || lut.smallest_limit() / color_max < 1e-15
}

/// Values of T·c_max above which no pixel of a row can stop.
#[derive(Clone, Copy)]
pub(super) struct Line {
    values: Row,
    /// Pixels whose value is their limit, whatever they still composite, as bits.
    is_final: u16,
}

impl TileLut<'_> {
    /// The line of pixels that have not been looked at: no entry is larger, whatever the colour.
    pub fn first_line(&self) -> Line {
        Line { values: Row([self.largest; LANES]), is_final: 0 }
    }
}

/// Pixels of a row among `hit` that go on, and those that stop because the rest cannot be seen: T·c_max ≤ γ·LUT(C)
/// (JND Sec. 3). Those that have stopped before are neither.
#[inline(always)]
pub(super) fn clear_or_stop<S: Simd>(
    s: S,
    lut: TileLut<'_>,
    hit: S::M,
    t: S::F,
    channels: &[Row; 4],
    line: &mut Line,
) -> (S::M, S::M) {
    let zero = s.splat(0.0);
    let left = s.mul(t, s.splat(lut.color_max));
    // Stopped pixels have T < 0, below every line.
    let clear = s.gt_where(hit, left, s.load(&line.values.0));
    let near = s.gt_where(s.and_not(hit, clear), t, zero);
    if s.bits(near) & !line.is_final == 0 {
        return (clear, near);
    }
    let stop = look_up(s, lut, near, t, left, channels, line);
    (s.and_not(s.gt_where(hit, t, zero), stop), stop)
}

/// The pixels among `near` that stop, by the table; lowers the line.
#[inline(always)]
fn look_up<S: Simd>(
    s: S,
    lut: TileLut<'_>,
    near: S::M,
    t: S::F,
    left: S::F,
    channels: &[Row; 4],
    line: &mut Line,
) -> S::M {
    let size = s.splat(lut.size);
    // No closures over arrays: what is not inlined is compiled for the baseline processor.
    let (red, green, blue) = (s.load(&channels[0].0), s.load(&channels[1].0), s.load(&channels[2].0));
    let (r, g, b) = (place(s, red, size), place(s, green, size), place(s, blue, size));
    let cell = s.fma(s.fma(r, size, g), size, b);
    let limit = s.lookup(lut.limits, cell);
    let stop = s.and_not(near, s.gt(left, limit));
    if lut.limits_ahead.is_empty() {
        return stop;
    }
    // Channels never shrink: from here on a colour meets the entries only that lie ahead of its cell along the axes on which
    // all that is left leads out of it, and that of its cell alone where there is no such axis. Neighbours come down
    // together, so that the whole row learns of it, as far as what is left is less than what `limits_ahead` covers.
    let reach = s.mul(left, s.splat(lut.reach));
    let near_enough = s.gt(s.splat(lut.ahead), s.mul(reach, size));
    let stay = s.and_not(s.gt_where(near_enough, t, s.splat(0.0)), stop);
    // What is final stays so, whatever rounding makes of a second look.
    let stay = s.and_not(stay, s.mask(line.is_final));
    let (zero, two) = (s.splat(0.0), s.splat(2.0));
    let farther_r = s.sub(place(s, s.add(red, reach), size), r);
    let farther_g = s.sub(place(s, s.add(green, reach), size), g);
    let farther_b = s.sub(place(s, s.add(blue, reach), size), b);
    let one = s.splat(1.0);
    let axes = s.fma(s.min(farther_r, one), two, s.min(farther_g, one));
    let axes = s.fma(axes, two, s.min(farther_b, one));
    let at = s.fma(axes, s.splat(lut.cells), cell);
    let values = s.select(stay, s.lookup(lut.limits_ahead, at), s.load(&line.values.0));
    let last = s.and_not(stay, s.gt(axes, zero));
    s.store(values, &mut line.values.0);
    line.is_final |= s.bits(last);
    stop
}

/// Cells of a channel, whole numbers.
#[inline(always)]
fn place<S: Simd>(s: S, color: S::F, size: S::F) -> S::F {
    s.truncate(s.mul(s.min(s.max(color, s.splat(0.0)), s.splat(BELOW_ONE)), size))
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
