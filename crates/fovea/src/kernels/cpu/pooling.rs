//! Area means and bilinear enlargement along one axis, and both adjoints as gathers: every value knows which values of
//! the other side it meets, so sums have a fixed order and need no atomics.
//!
//! Tables are computed once per pair of lengths; positions in integers or `f64`. Cells may overlap by one sample where
//! they shrink, and share samples where they enlarge. Lengths are at least 1.

use crate::real::{Real, fma};
use std::ops::Range;

/// Area mean of `n` samples in `m` cells: cell i covers samples ⌊i n / m⌋ up to ⌈(i + 1) n / m⌉, excluded.
#[derive(Debug, Clone)]
pub(crate) struct AreaMean<T> {
    /// Samples of every cell.
    cells: Vec<(u32, u32)>,
    /// One over the number of samples of every cell.
    inverse_counts: Vec<T>,
    /// Cells that every sample belongs to.
    samples: Vec<(u32, u32)>,
}

impl<T: Real> AreaMean<T> {
    /// Tables for `n` samples and `m` cells.
    pub fn new(n: usize, m: usize) -> Self {
        let cells: Vec<_> = (0..m).map(|i| ((i * n / m) as u32, ((i + 1) * n).div_ceil(m) as u32)).collect();
        let inverse_counts = cells.iter().map(|(a, b)| T::of(1.0 / f64::from(b - a))).collect();
        let samples = (0..n as u32)
            .map(|s| {
                let first = cells.partition_point(|(_, end)| *end <= s);
                (first as u32, cells.partition_point(|(start, _)| *start <= s) as u32)
            })
            .collect();
        Self { cells, inverse_counts, samples }
    }

    pub fn num_samples(&self) -> usize {
        self.samples.len()
    }

    pub fn num_cells(&self) -> usize {
        self.cells.len()
    }

    /// Samples of cell `i`.
    #[inline(always)]
    pub fn cell(&self, i: usize) -> Range<usize> {
        self.cells[i].0 as usize..self.cells[i].1 as usize
    }

    /// One over the number of samples of cell `i`.
    #[inline(always)]
    pub fn inverse_count(&self, i: usize) -> T {
        self.inverse_counts[i]
    }

    /// Cells that sample `s` belongs to: at least one.
    #[inline(always)]
    pub fn cells_of(&self, s: usize) -> Range<usize> {
        self.samples[s].0 as usize..self.samples[s].1 as usize
    }

    /// Means of two rows, times `scale`, one beside the other.
    #[inline(always)]
    pub fn means(&self, rows: [&[T]; 2], scale: T, out: &mut [[T; 2]]) {
        for ((v, (a, b)), inverse) in out.iter_mut().zip(&self.cells).zip(&self.inverse_counts) {
            let (mut sum, mut other) = (T::ZERO, T::ZERO);
            let range = *a as usize..*b as usize;
            for (x, y) in rows[0][range.clone()].iter().zip(&rows[1][range]) {
                sum += *x;
                other += *y;
            }
            let scale = *inverse * scale;
            *v = [sum * scale, other * scale];
        }
    }

    /// For every sample the sum over its cells: the adjoint of [`AreaMean::means`] but for the counts.
    #[inline(always)]
    pub fn spread(&self, cells: &[[T; 2]], out: &mut [[T; 2]]) {
        for (v, (a, b)) in out.iter_mut().zip(&self.samples) {
            let mut sum = cells[*a as usize];
            for x in &cells[*a as usize + 1..*b as usize] {
                sum = [sum[0] + x[0], sum[1] + x[1]];
            }
            *v = sum;
        }
    }
}

/// Bilinear interpolation of `m` values at `n` places, half-pixel centres, clamped: place s lies at
/// c = max((s + ½) m / n − ½, 0) between values ⌊c⌋ and ⌊c⌋ + 1.
#[derive(Debug, Clone)]
pub(crate) struct Bilinear<T> {
    num_values: usize,
    /// First value of every place; the second is the next one, or the same at the end.
    first: Vec<u32>,
    /// Weight of the second value.
    weight: Vec<T>,
    /// First place whose first value is not below this one, for every value and one more.
    starts: Vec<u32>,
}

impl<T: Real> Bilinear<T> {
    /// Tables for `n` places among `m` values.
    pub fn new(n: usize, m: usize) -> Self {
        let (mut first, mut weight) = (Vec::with_capacity(n), Vec::with_capacity(n));
        for s in 0..n {
            let c = ((s as f64 + 0.5) * m as f64 / n as f64 - 0.5).max(0.0);
            let i = (c.floor() as usize).min(m - 1);
            first.push(i as u32);
            weight.push(if i == m - 1 { T::ZERO } else { T::of(c - i as f64) });
        }
        let starts = (0..=m as u32).map(|j| first.partition_point(|i| *i < j) as u32).collect();
        Self { num_values: m, first, weight, starts }
    }

    /// First value of place `s`.
    #[inline(always)]
    pub fn first(&self, s: usize) -> usize {
        self.first[s] as usize
    }

    /// Both values of place `s`, and the weight of the second.
    #[inline(always)]
    pub fn source(&self, s: usize) -> (usize, usize, T) {
        let i = self.first(s);
        (i, (i + 1).min(self.num_values - 1), self.weight[s])
    }

    /// As [`Bilinear::source`] of the places from `s` on.
    #[inline(always)]
    pub fn sources(&self, s: usize) -> impl Iterator<Item = (usize, usize, T)> {
        let last = self.num_values - 1;
        let pairs = self.first[s..].iter().zip(&self.weight[s..]);
        pairs.map(move |(i, w)| (*i as usize, (*i as usize + 1).min(last), *w))
    }

    /// Places whose first value is in `values`.
    #[inline(always)]
    pub fn places(&self, values: Range<usize>) -> Range<usize> {
        self.starts[values.start] as usize..self.starts[values.end] as usize
    }

    /// Places that value `j` contributes to, with its weight there.
    #[inline(always)]
    pub fn targets(&self, j: usize) -> impl Iterator<Item = (usize, T)> {
        let second = self.places(j.saturating_sub(1)..j).map(|s| (s, self.weight[s]));
        second.chain(self.places(j..j + 1).map(|s| (s, T::ONE - self.weight[s])))
    }

    /// All places of a row of values.
    #[inline(always)]
    pub fn enlarge(&self, values: &[T], out: &mut [T]) {
        let last = self.num_values - 1;
        for ((v, i), w) in out.iter_mut().zip(&self.first).zip(&self.weight) {
            let i = *i as usize;
            let a = values[i];
            *v = a + *w * (values[(i + 1).min(last)] - a);
        }
    }

    /// All places of two rows of pairs, one beside the other: the four numbers share what is looked up. `quads` is scratch
    /// of the values' length: laid together there, four numbers are one load.
    #[inline(always)]
    pub fn enlarge_pairs<const FMA: bool>(&self, values: [&[[T; 2]]; 2], quads: &mut [[T; 4]], out: &mut [[T; 4]]) {
        for ((quad, a), b) in quads.iter_mut().zip(values[0]).zip(values[1]) {
            *quad = [a[0], a[1], b[0], b[1]];
        }
        self.enlarge_quads::<FMA>(quads, 0, out);
    }

    /// Places from `s` on, as many as `out` takes, of a row of four numbers each.
    #[inline(always)]
    pub fn enlarge_quads<const FMA: bool>(&self, quads: &[[T; 4]], s: usize, out: &mut [[T; 4]]) {
        for (v, (left, right, weight)) in out.iter_mut().zip(self.sources(s)) {
            let (from, to) = (&quads[left], &quads[right]);
            for q in 0..4 {
                v[q] = fma::<T, FMA>(weight, to[q] - from[q], from[q]);
            }
        }
    }

    /// Value `j` of the adjoint of [`Bilinear::enlarge`].
    #[inline(always)]
    pub fn gathered(&self, j: usize, v_places: &[T]) -> T {
        let mut sum = T::ZERO;
        for (s, weight) in self.targets(j) {
            sum += weight * v_places[s];
        }
        sum
    }

    /// Value `j` of the adjoint of [`Bilinear::enlarge`] for pairs.
    #[inline(always)]
    pub fn gathered_pair<const FMA: bool>(&self, j: usize, v_places: &[[T; 2]]) -> [T; 2] {
        let mut sum = [T::ZERO; 2];
        let mut add = |weight: T, v: &[T; 2]| {
            sum[0] = fma::<T, FMA>(weight, v[0], sum[0]);
            sum[1] = fma::<T, FMA>(weight, v[1], sum[1]);
        };
        let places = self.places(j.saturating_sub(1)..j);
        for (w, v) in self.weight[places.clone()].iter().zip(&v_places[places]) {
            add(*w, v);
        }
        let places = self.places(j..j + 1);
        for (w, v) in self.weight[places.clone()].iter().zip(&v_places[places]) {
            add(T::ONE - *w, v);
        }
        sum
    }
}

/// One axis of a pooling: area means in cells, and bilinear enlargement to the samples.
#[derive(Debug, Clone)]
pub(crate) struct Axis<T> {
    pub area: AreaMean<T>,
    pub up: Bilinear<T>,
}

impl<T: Real> Axis<T> {
    pub fn new(samples: usize, cells: usize) -> Self {
        Self { area: AreaMean::new(samples, cells), up: Bilinear::new(samples, cells) }
    }

    /// Whether pooling changes nothing: a whole number of cells in every sample.
    pub fn is_identity(&self) -> bool {
        self.area.num_cells().is_multiple_of(self.area.num_samples())
    }
}

/// Both axes of a pooling.
#[derive(Debug, Clone)]
pub(crate) struct Pools<T> {
    pub x: Axis<T>,
    pub y: Axis<T>,
    is_identity: bool,
}

impl<T: Real> Pools<T> {
    /// Pools of a plane of `width` × `height` in `columns` × `rows` cells.
    pub fn new((width, height): (usize, usize), (columns, rows): (usize, usize)) -> Self {
        let (x, y) = (Axis::new(width, columns), Axis::new(height, rows));
        let is_identity = x.is_identity() && y.is_identity();
        Self { x, y, is_identity }
    }

    /// Whether pooling changes nothing.
    pub fn is_identity(&self) -> bool {
        self.is_identity
    }

    /// The same pools, computed even where they change nothing.
    #[cfg(test)]
    pub fn never_identity(self) -> Self {
        Self { is_identity: false, ..self }
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

    /// ⟨A x, y⟩ = ⟨x, Aᵀ y⟩, shrinking and enlarging.
    #[test]
    fn adjoints_of_area_means_and_enlargement() {
        let mut rng = Rng::new(1);
        for n in 2..=67 {
            for m in [1, 2, 3, n / 2, n - 1, n, n + 1, 2 * n, 3 * n + 1] {
                if m == 0 {
                    continue;
                }
                let (samples, cells) = (noise(&mut rng, n), noise(&mut rng, m));
                let area = AreaMean::<f64>::new(n, m);
                let others: Vec<f64> = samples.iter().rev().copied().collect();
                let (mut means, mut spread) = (vec![[0.0; 2]; m], vec![[0.0; 2]; n]);
                area.means([&samples, &others], 1.0, &mut means);
                let divided: Vec<[f64; 2]> =
                    (0..m).map(|i| [cells[i], 3.0 * cells[i]].map(|v| v * area.inverse_count(i))).collect();
                area.spread(&divided, &mut spread);
                for q in 0..2 {
                    let lane = |pairs: &[[f64; 2]]| pairs.iter().map(|v| v[q]).collect::<Vec<_>>();
                    let (factor, x) = if q == 0 { (1.0, &samples) } else { (3.0, &others) };
                    let (a, b) = (factor * dot(&lane(&means), &cells), dot(x, &lane(&spread)));
                    assert!((a - b).abs() < 1e-11, "area {n} {m}: {a} {b}");
                }

                let up = Bilinear::<f64>::new(n, m);
                let mut enlarged = vec![0.0; n];
                up.enlarge(&cells, &mut enlarged);
                let gathered: Vec<f64> = (0..m).map(|j| up.gathered(j, &samples)).collect();
                let pairs: Vec<[f64; 2]> = samples.iter().map(|v| [*v, -v]).collect();
                for (j, v) in gathered.iter().enumerate() {
                    let pair = up.gathered_pair::<false>(j, &pairs);
                    assert!((pair[0] - v).abs() < 1e-12 && pair[1] == -pair[0]);
                }
                let cell_pairs: Vec<[f64; 2]> = cells.iter().map(|v| [*v, 2.0 * v]).collect();
                let mut quads = vec![[0.0; 4]; n];
                up.enlarge_pairs::<false>([&cell_pairs, &cell_pairs], &mut vec![[0.0; 4]; m], &mut quads);
                assert!(quads.iter().zip(&enlarged).all(|(q, v)| *q == [*v, 2.0 * v, *v, 2.0 * v]));
                let (a, b) = (dot(&enlarged, &samples), dot(&cells, &gathered));
                assert!((a - b).abs() < 1e-12, "bilinear {n} {m}: {a} {b}");
            }
        }
    }

    #[test]
    fn whole_numbers_of_cells_per_sample_change_nothing() {
        let mut rng = Rng::new(2);
        for (n, m) in [(5, 5), (6, 12), (7, 21), (4, 32)] {
            let axis = Axis::<f64>::new(n, m);
            assert!(axis.is_identity());
            let samples = noise(&mut rng, n);
            let (mut cells, mut back) = (vec![[0.0; 2]; m], vec![0.0; n]);
            axis.area.means([&samples, &samples], 1.0, &mut cells);
            axis.up.enlarge(&cells.iter().map(|v| v[0]).collect::<Vec<_>>(), &mut back);
            assert_eq!(back, samples);
        }
        assert!(!Axis::<f64>::new(6, 4).is_identity() && !Axis::<f64>::new(4, 6).is_identity());
    }

    #[test]
    fn places_are_those_whose_first_value_is_asked_for() {
        let up = Bilinear::<f64>::new(10, 3);
        let all: Vec<usize> = (0..3).flat_map(|i| up.places(i..i + 1)).collect();
        assert_eq!(all, (0..10).collect::<Vec<_>>());
        assert!(up.places(1..2).all(|s| up.first(s) == 1));
    }
}
