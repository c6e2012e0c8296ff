//! Planes, filters with reflected borders, halving, colour and resizing, each with its adjoint, row by row.
//!
//! A row function computes one row of one channel; callers cut the image into bands of rows. Filters run over blocks of
//! 32 columns whose sums stay in registers; the last block of a row overlaps the one before it, rows shorter than a block
//! use blocks of 4 (every width is a multiple of 4). NaN spreads as arithmetic spreads it. No plane is empty.

use crate::hvs::pyramid::{FilterBank, Taps};
use crate::kernels::cpu::pooling::Bilinear;
use crate::real::{Real, fma};
use rayon::prelude::*;

/// Half width of a filter.
pub(crate) const RADIUS: usize = 2;
/// Columns of a block.
pub(crate) const BLOCK: usize = 32;
/// Columns of a block of a short row: all widths are multiples of it.
pub(crate) const SMALL_BLOCK: usize = 4;

/// Colour values of an image on the host.
#[derive(Debug, Clone, Copy)]
pub struct ImageView<'a, T> {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Values per pixel, at least 3; the first three are RGB, sRGB-encoded, nominally 0..1; the others are not looked at.
    pub channels: usize,
    /// `[height, width, channels]`.
    pub data: &'a [T],
}

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

/// Y, Cr, Cb of an encoded colour (ITU-R BT.601).
#[inline(always)]
fn ycrcb<T: Real>(r: T, g: T, b: T) -> [T; 3] {
    let y = (T::of(0.299) * r + T::of(0.587) * g) + T::of(0.114) * b;
    [y, T::of(0.5) + T::of(0.713) * (r - y), T::of(0.5) + T::of(0.564) * (b - y)]
}

/// Adjoint of [`ycrcb`].
#[inline(always)]
fn ycrcb_bwd<T: Real>(v_y: T, v_cr: T, v_cb: T) -> [T; 3] {
    let v_cr = T::of(0.713) * v_cr;
    let v_cb = T::of(0.564) * v_cb;
    let v_y = v_y - (v_cr + v_cb);
    [T::of(0.299) * v_y + v_cr, T::of(0.587) * v_y, T::of(0.114) * v_y + v_cb]
}

/// How an image is brought to the size the pyramid needs.
#[derive(Debug, Clone)]
pub(crate) struct Resize<T> {
    /// Size of the image: width, height.
    pub from: (usize, usize),
    /// Size of the planes.
    pub to: (usize, usize),
    columns: Bilinear<T>,
    rows: Bilinear<T>,
}

impl<T: Real> Resize<T> {
    pub fn new(from: (usize, usize), to: (usize, usize)) -> Self {
        Self { from, to, columns: Bilinear::new(to.0, from.0), rows: Bilinear::new(to.1, from.1) }
    }

    /// Channels Y, Cr, Cb of the resized image. Bilinear interpolation keeps an image whose size is right as it is.
    pub fn planes(&self, image: &ImageView<'_, T>) -> [Plane<T>; 3] {
        let (width, height) = self.to;
        let mut planes: [Plane<T>; 3] = std::array::from_fn(|_| Plane::zeros(width, height));
        let [y_plane, cr_plane, cb_plane] = &mut planes;
        let rows = y_plane.rows_mut().zip(cr_plane.rows_mut()).zip(cb_plane.rows_mut()).enumerate();
        let c = image.channels;
        rows.for_each(|(row, ((ys, crs), cbs))| {
            let input = |r: usize| &image.data[r * image.width * c..][..image.width * c];
            let (upper, lower, down) = self.rows.source(row);
            let (upper, lower) = (input(upper), input(lower));
            for x in 0..width {
                let at = RADIUS + x;
                let (left, right, across) = self.columns.source(x);
                let value = |channel: usize| {
                    let mix = |row: &[T]| {
                        let (a, b) = (row[left * c + channel], row[right * c + channel]);
                        if across == T::ZERO { a } else { (T::ONE - across) * a + across * b }
                    };
                    if down == T::ZERO { mix(upper) } else { (T::ONE - down) * mix(upper) + down * mix(lower) }
                };
                [ys[at], crs[at], cbs[at]] = ycrcb(value(0), value(1), value(2));
            }
            for plane_row in [ys, crs, cbs] {
                reflect_columns(plane_row, width);
            }
        });
        planes
    }

    /// The gradient by the image, `[height, width, channels]`, zero beyond RGB, from those by the three planes, each
    /// `[height, width]` of the resized size; these are overwritten.
    pub fn planes_bwd(&self, v_planes: &mut [Vec<T>; 3], channels: usize) -> Vec<T> {
        let (width, _) = self.to;
        let [v_y, v_cr, v_cb] = v_planes;
        v_y.par_chunks_mut(width).zip(v_cr.par_chunks_mut(width)).zip(v_cb.par_chunks_mut(width)).for_each(
            |((v_y, v_cr), v_cb)| {
                for ((y, cr), cb) in v_y.iter_mut().zip(v_cr).zip(v_cb) {
                    [*y, *cr, *cb] = ycrcb_bwd(*y, *cr, *cb);
                }
            },
        );
        let v_planes = [&*v_y, &*v_cr, &*v_cb];
        let mut v_image = vec![T::ZERO; self.from.0 * self.from.1 * channels];
        v_image.par_chunks_mut(self.from.0 * channels).enumerate().for_each(|(row, v_row)| {
            let mut sums = vec![T::ZERO; width];
            for (channel, plane) in v_planes.iter().enumerate() {
                sums.fill(T::ZERO);
                for (r, weight) in self.rows.targets(row) {
                    for (sum, v) in sums.iter_mut().zip(&plane[r * width..][..width]) {
                        *sum += weight * *v;
                    }
                }
                for (x, pixel) in v_row.chunks_exact_mut(channels).enumerate() {
                    pixel[channel] = self.columns.gathered(x, &sums);
                }
            }
        });
        v_image
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gazesplat_testkit::Rng;

    fn noise(rng: &mut Rng, n: usize) -> Vec<f64> {
        (0..n).map(|_| 2.0 * rng.unit() - 1.0).collect()
    }

    fn dot(a: &[f64], b: &[f64]) -> f64 {
        a.iter().zip(b).map(|(a, b)| a * b).sum()
    }

    fn plane(width: usize, height: usize, values: &[f64]) -> Plane<f64> {
        let mut plane = Plane::zeros(width, height);
        plane.fill_rows(|y, row| row.copy_from_slice(&values[y * width..][..width]));
        plane
    }

    #[test]
    fn borders_are_reflected_without_repeating_the_edge() {
        assert_eq!([-2, -1, 0, 5, 6, 7].map(|i| reflect(i, 6)), [2, 1, 0, 5, 4, 3]);
    }

    /// Σ of the definition, with every tap.
    #[test]
    fn filters_match_their_definition() {
        let mut rng = Rng::new(3);
        let filters = Filters::<f64>::new(&FilterBank::sp5());
        assert!(filters.antisymmetric);
        for (width, height) in [(4, 4), (8, 6), (36, 5), (64, 9)] {
            let values = noise(&mut rng, width * height);
            let plane = plane(width, height, &values);
            let mut out = vec![0.0; 6 * width];
            let mut other = out.clone();
            for y in 0..height {
                correlate_row::<f64, false, 6>(&plane, y, &filters.bands, true, &mut out);
                correlate_row::<f64, false, 6>(&plane, y, &filters.bands, false, &mut other);
                for (o, k) in filters.bands.iter().enumerate() {
                    for x in 0..width {
                        let mut sum = 0.0;
                        for i in 0..5 {
                            for j in 0..5 {
                                let (r, c) = ((y + i) as isize - 2, (x + j) as isize - 2);
                                sum += k[5 * i + j] * values[reflect(r, height) * width + reflect(c, width)];
                            }
                        }
                        assert!((out[o * width + x] - sum).abs() < 1e-14);
                        assert!((other[o * width + x] - sum).abs() < 1e-14);
                    }
                }
            }
        }
    }

    /// ⟨A x, y⟩ = ⟨x, Aᵀ y⟩.
    #[test]
    fn adjoint_of_every_filter_with_its_border() {
        let mut rng = Rng::new(4);
        let filters = Filters::<f64>::new(&FilterBank::sp5());
        let kernels = [&filters.bands[..], &[filters.low, filters.high]].concat();
        for (width, height) in [(4, 4), (8, 5), (32, 4), (40, 7), (68, 6)] {
            let (x, v) = (noise(&mut rng, width * height), noise(&mut rng, width * height));
            let plane = plane(width, height, &x);
            for kernel in &kernels {
                let kernel = &[*kernel][..];
                let (mut forward, mut v_x) = (vec![0.0; width * height], vec![0.0; width * height]);
                let padded: Vec<Vec<f64>> =
                    v.chunks(width).map(|row| [&[0.0; GRADIENT_PAD][..], row, &[0.0; GRADIENT_PAD]].concat()).collect();
                let zeros = vec![0.0; width + 2 * GRADIENT_PAD];
                let mut reached = vec![0.0; width + 4];
                for y in 0..height {
                    let rows = y * width..(y + 1) * width;
                    correlate_row::<f64, false, 1>(&plane, y, kernel, false, &mut forward[rows.clone()]);
                    correlate_row_bwd::<f64, false, 1>(
                        |_, r| &padded[r],
                        &zeros,
                        (y, height),
                        &[flipped(&kernel[0])],
                        &mut reached,
                        &mut v_x[rows],
                    );
                }
                let (a, b) = (dot(&forward, &v), dot(&x, &v_x));
                assert!((a - b).abs() <= 1e-12 * (1.0 + a.abs()), "{width}×{height}: {a} {b}");
            }
        }
    }

    #[test]
    fn adjoint_of_halving_colour_and_resizing() {
        let mut rng = Rng::new(5);
        let (x, v) = (noise(&mut rng, 8 * 6), noise(&mut rng, 4 * 3));
        let half = halve(&plane(8, 6, &x));
        let forward: Vec<f64> = (0..3).flat_map(|y| half.row(y).to_vec()).collect();
        let mut v_x = vec![0.0; 48];
        halve_bwd(&v, &mut v_x, 8);
        assert!((dot(&forward, &v) - dot(&x, &v_x)).abs() < 1e-13);

        for from in [(2usize, 3usize), (31, 17), (32, 64), (33, 67), (67, 2)] {
            let to = (from.0.next_multiple_of(32), from.1.next_multiple_of(32));
            let resize = Resize::<f64>::new(from, to);
            let x = noise(&mut rng, from.0 * from.1 * 4);
            let mut v: [Vec<f64>; 3] = std::array::from_fn(|_| noise(&mut rng, to.0 * to.1));
            let view = |data| ImageView { width: from.0, height: from.1, channels: 4, data };
            let zero = vec![0.0; x.len()];
            // The colour transform has a constant part, which the gradient does not see.
            let (planes, offsets) = (resize.planes(&view(&x)), resize.planes(&view(&zero)));
            let mut forward = 0.0;
            for c in 0..3 {
                for y in 0..to.1 {
                    let difference = planes[c].row(y).iter().zip(offsets[c].row(y)).map(|(a, b)| a - b);
                    forward += dot(&difference.collect::<Vec<_>>(), &v[c][y * to.0..][..to.0]);
                }
            }
            let v_x = resize.planes_bwd(&mut v, 4);
            let backward = dot(&x, &v_x);
            assert!((forward - backward).abs() < 1e-11 * (1.0 + forward.abs()), "{from:?}: {forward} {backward}");
        }
    }
}
