//! Planes, filters with reflected borders, halving, colour and resizing, each with its adjoint, row by row.
//!
//! A row function computes one row of one channel; callers cut the image into bands of rows. Filters run over blocks of
//! 32 columns whose sums stay in registers; the last block of a row overlaps the one before it, rows shorter than a block
//! use blocks of 4 (every width is a multiple of 4). NaN spreads as arithmetic spreads it. No plane is empty.

mod resize;
#[cfg(test)]
pub(crate) mod tests;

pub use resize::ImageView;
pub(crate) use resize::Resize;

use crate::hvs::pyramid::{FilterBank, Taps};
use crate::real::{Real, fma};
use rayon::prelude::*;

/// Half width of a filter.
pub(crate) const RADIUS: usize = 2;
/// Columns of a block.
pub(crate) const BLOCK: usize = 32;
/// Columns of a block of a short row: all widths are multiples of it.
pub(crate) const SMALL_BLOCK: usize = 4;

/// One channel of one level: rows with two reflected columns on each side.
#[derive(Debug, Clone)]
pub(crate) struct Plane<T> {
    pub width: usize,
    pub height: usize,
    data: Vec<T>,
}

/// Index −1 is 1, −2 is 2, n is n − 2, n + 1 is n − 3: reflection without repeating the edge. Residuals may have two
/// columns, of which the fourth reflection does not exist; they are not filtered.
#[inline(always)]
pub(crate) fn reflect(index: isize, n: usize) -> usize {
    let n = n as isize;
    let index = index.abs();
    (if index >= n { (2 * (n - 1) - index).max(0) } else { index }) as usize
}

impl<T: Real> Plane<T> {
    pub fn zeros(width: usize, height: usize) -> Self {
        Self { width, height, data: vec![T::ZERO; (width + 2 * RADIUS) * height] }
    }

    /// Memory of the values, bytes.
    pub fn num_bytes(&self) -> usize {
        self.data.len() * size_of::<T>()
    }

    /// Values of one row without the reflected columns.
    #[inline(always)]
    pub fn row(&self, y: usize) -> &[T] {
        let stride = self.width + 2 * RADIUS;
        &self.data[y * stride + RADIUS..][..self.width]
    }

    /// The five rows around row `y`, with their reflected columns.
    #[inline(always)]
    fn rows_around(&self, y: usize) -> [&[T]; 5] {
        let stride = self.width + 2 * RADIUS;
        // Loops instead of closures: what is not inlined is not compiled for the vector width of the machine.
        let mut rows = [&self.data[..0]; 5];
        for (i, row) in rows.iter_mut().enumerate() {
            let from = reflect(y as isize + i as isize - RADIUS as isize, self.height);
            *row = &self.data[from * stride..][..stride];
        }
        rows
    }

    /// Calls `fill(y, row)` for every row on all threads, and reflects the columns.
    pub fn fill_rows(&mut self, fill: impl Fn(usize, &mut [T]) + Sync) {
        let width = self.width;
        self.data.par_chunks_mut(width + 2 * RADIUS).enumerate().for_each(|(y, row)| {
            fill(y, &mut row[RADIUS..][..width]);
            reflect_columns(row, width);
        });
    }

    fn rows_mut(&mut self) -> impl IndexedParallelIterator<Item = &mut [T]> {
        self.data.par_chunks_mut(self.width + 2 * RADIUS)
    }
}

fn reflect_columns<T: Copy>(row: &mut [T], width: usize) {
    for i in [-2isize, -1, width as isize, width as isize + 1] {
        row[(i + RADIUS as isize) as usize] = row[RADIUS + reflect(i, width)];
    }
}

/// A filter, rows one after the other.
pub(crate) type Kernel<T> = [T; 25];

/// A bank, rounded once.
#[derive(Debug, Clone)]
pub(crate) struct Filters<T> {
    pub low: Kernel<T>,
    pub high: Kernel<T>,
    pub bands: Vec<Kernel<T>>,
    /// Whether every band has k\[4−i\]\[4−j\] = −k\[i\]\[j\]: half of the products suffice.
    pub antisymmetric: bool,
}

impl<T: Real> Filters<T> {
    pub fn new(bank: &FilterBank) -> Self {
        let kernel = |taps: &Taps| std::array::from_fn(|i| T::of(taps[i / 5][i % 5]));
        let is_antisymmetric = |taps: &Taps| (0..25).all(|i| taps[i / 5][i % 5] == -taps[4 - i / 5][4 - i % 5]);
        Self {
            low: kernel(bank.low()),
            high: kernel(bank.high()),
            bands: bank.bands().iter().map(kernel).collect(),
            antisymmetric: bank.bands().iter().all(is_antisymmetric),
        }
    }
}

/// Runs the body for blocks of `$size` columns from `$x0` on that cover `$n`; a filter reaches `$reach` columns of each.
macro_rules! in_blocks {
    ($n:expr, |$x0:ident, $size:ident, $reach:ident| $body:expr) => {{
        let n = $n;
        if n >= $crate::kernels::cpu::pyramid::BLOCK {
            const $size: usize = $crate::kernels::cpu::pyramid::BLOCK;
            const $reach: usize = $size + 4;
            let mut next = 0;
            while next < n {
                let $x0 = next.min(n - $crate::kernels::cpu::pyramid::BLOCK);
                $body;
                next += $crate::kernels::cpu::pyramid::BLOCK;
            }
        } else {
            const $size: usize = $crate::kernels::cpu::pyramid::SMALL_BLOCK;
            const $reach: usize = $size + 4;
            debug_assert_eq!(n % $crate::kernels::cpu::pyramid::SMALL_BLOCK, 0);
            let mut $x0 = 0;
            while $x0 < n {
                $body;
                $x0 += $crate::kernels::cpu::pyramid::SMALL_BLOCK;
            }
        }
    }};
}
pub(crate) use in_blocks;

#[inline(always)]
pub(crate) fn block<T, const B: usize>(row: &[T], x0: usize) -> &[T; B] {
    row[x0..x0 + B].try_into().expect("the slice has that length")
}

/// Row `y` of `plane` under `N` filters: out\[o\]\[x\] = Σ k\[o\]\[i\]\[j\] · in\[y+i−2\]\[x+j−2\], rows of `out` one after the other.
#[inline(always)]
pub(crate) fn correlate_row<T: Real, const FMA: bool, const N: usize>(
    plane: &Plane<T>,
    y: usize,
    kernels: &[Kernel<T>],
    antisymmetric: bool,
    out: &mut [T],
) {
    let kernels: &[Kernel<T>; N] = kernels.try_into().expect("as many filters as asked for");
    let rows = plane.rows_around(y);
    let width = plane.width;
    in_blocks!(width, |x0, B, C| {
        let sums = if antisymmetric {
            correlate_antisymmetric::<T, FMA, N, B, C>(&rows, x0, kernels)
        } else {
            correlate_any::<T, FMA, N, B, C>(&rows, x0, kernels)
        };
        for (o, sums) in sums.iter().enumerate() {
            out[o * width + x0..][..B].copy_from_slice(sums);
        }
    });
}

#[inline(always)]
fn correlate_any<T: Real, const FMA: bool, const N: usize, const B: usize, const C: usize>(
    rows: &[&[T]; 5],
    x0: usize,
    kernels: &[Kernel<T>; N],
) -> [[T; B]; N] {
    let mut sums = [[T::ZERO; B]; N];
    for (o, sums) in sums.iter_mut().enumerate() {
        *sums = weighted::<T, FMA, B, C>(rows, x0, &kernels[o], *sums);
    }
    sums
}

/// The rows that a block of columns reaches: tap (i, j) of column x meets value x + j of row i. Arrays, so that five
/// addresses serve 25 taps.
#[inline(always)]
fn reached<'a, T, const C: usize>(rows: &[&'a [T]; 5], x0: usize) -> [&'a [T; C]; 5] {
    let mut at = [block::<T, C>(rows[0], x0); 5];
    for (at, row) in at.iter_mut().zip(rows) {
        *at = block::<T, C>(row, x0);
    }
    at
}

/// `sums` plus the 25 taps times the block's neighbourhood: tap (i, j) meets column x0 + x + j of row i.
#[inline(always)]
fn weighted<T: Real, const FMA: bool, const B: usize, const C: usize>(
    rows: &[&[T]; 5],
    x0: usize,
    k: &Kernel<T>,
    mut sums: [T; B],
) -> [T; B] {
    let at = reached::<T, C>(rows, x0);
    for x in 0..B {
        let mut sum = sums[x];
        macro_rules! taps {
            ($($i:literal)*) => { $(sum = fma::<T, FMA>(k[$i], at[$i / 5][x + $i % 5], sum);)* };
        }
        taps!(0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23 24);
        sums[x] = sum;
    }
    sums
}

/// Opposite taps differ in sign, so all filters share the twelve differences of opposite pixels.
#[inline(always)]
fn correlate_antisymmetric<T: Real, const FMA: bool, const N: usize, const B: usize, const C: usize>(
    rows: &[&[T]; 5],
    x0: usize,
    kernels: &[Kernel<T>; N],
) -> [[T; B]; N] {
    let mut sums = [[T::ZERO; B]; N];
    let at = reached::<T, C>(rows, x0);
    for x in 0..B {
        let mut sum = [T::ZERO; N];
        macro_rules! pairs {
            ($($i:literal)*) => { $(
                let difference = at[$i / 5][x + $i % 5] - at[(24 - $i) / 5][x + (24 - $i) % 5];
                for o in 0..N {
                    sum[o] = fma::<T, FMA>(kernels[o][$i], difference, sum[o]);
                }
            )* };
        }
        pairs!(0 1 2 3 4 5 6 7 8 9 10 11);
        for o in 0..N {
            sums[o][x] = sum[o];
        }
    }
    sums
}

/// The filter that the adjoint correlates with.
#[inline(always)]
pub(crate) fn flipped<T: Real>(kernel: &Kernel<T>) -> Kernel<T> {
    let mut flipped = *kernel;
    flipped.reverse();
    flipped
}

/// Columns of zeros on each side of a gradient row, for [`correlate_row_bwd`].
pub(crate) const GRADIENT_PAD: usize = 2 * RADIUS;

/// Adds to `v_row` the gradient by row `y` of a plane of `height` rows, given the gradients by the outputs of `N` filters, [`flipped`]:
/// `v_out(o, r)` is row r, 0 ≤ r < height, |r − y| ≤ 2, of filter o with [`GRADIENT_PAD`] zeros on each side. `zeros` is
/// such a row of zeros; `sums_row` is scratch of the plane's width + 4.
#[inline(always)]
pub(crate) fn correlate_row_bwd<'a, T: Real, const FMA: bool, const N: usize>(
    v_out: impl Fn(usize, usize) -> &'a [T],
    zeros: &'a [T],
    (y, height): (usize, usize),
    flipped: &[Kernel<T>; N],
    sums_row: &mut [T],
    v_row: &mut [T],
) {
    // Correlation with the flipped filter, over the row and the two reflected columns on each side.
    let width = v_row.len();
    let (y, n) = (y as isize, height as isize);
    // The row itself and the rows beyond the border that mirror it.
    for from in [y, -2, -1, n, n + 1] {
        if from != y && reflect(from, height) as isize != y {
            continue;
        }
        let mut rows = [[zeros; 5]; N];
        for (o, rows) in rows.iter_mut().enumerate() {
            for (i, row) in rows.iter_mut().enumerate() {
                let r = from + i as isize - RADIUS as isize;
                if (0..n).contains(&r) {
                    *row = v_out(o, r as usize);
                }
            }
        }
        in_blocks!(width + 2 * RADIUS, |x0, B, C| {
            let mut sums = [T::ZERO; B];
            for o in 0..N {
                sums = weighted::<T, FMA, B, C>(&rows[o], x0, &flipped[o], sums);
            }
            sums_row[x0..x0 + B].copy_from_slice(&sums);
        });
        for (v, r) in v_row.iter_mut().zip(&sums_row[RADIUS..]) {
            *v += *r;
        }
        for i in [-2isize, -1, width as isize, width as isize + 1] {
            v_row[reflect(i, width)] += sums_row[(i + RADIUS as isize) as usize];
        }
    }
}

/// 2 × 2 means.
pub(crate) fn halve<T: Real>(plane: &Plane<T>) -> Plane<T> {
    let mut half = Plane::zeros(plane.width / 2, plane.height / 2);
    let quarter = T::of(0.25);
    half.fill_rows(|y, row| {
        let pairs = plane.row(2 * y).chunks_exact(2).zip(plane.row(2 * y + 1).chunks_exact(2));
        for (v, (upper, lower)) in row.iter_mut().zip(pairs) {
            *v = ((upper[0] + upper[1]) + (lower[0] + lower[1])) * quarter;
        }
    });
    half
}

/// Adds the adjoint of [`halve`]: a quarter of `v_half`, `[height / 2, width / 2]`, to each of four values of `v_plane`,
/// `[height, width]`.
pub(crate) fn halve_bwd<T: Real>(v_half: &[T], v_plane: &mut [T], width: usize) {
    let quarter = T::of(0.25);
    v_plane.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        let half = &v_half[y / 2 * (width / 2)..][..width / 2];
        for (pair, v) in row.chunks_exact_mut(2).zip(half) {
            pair[0] += quarter * *v;
            pair[1] += quarter * *v;
        }
    });
}
