//! Gaze-dependent statistics: chains of mips of the responses of one filter, both images at once, two mips sampled at
//! every pixel, and the adjoint of it all.
//!
//! A sample holds x and x² of the first image, then of the second; a chain is their area means, every mip half the size
//! of the one before, down to one sample. Of the finest only the responses are kept: few pixels sample it. Mips are never
//! stored enlarged: of a row of pixels, the mips it uses are enlarged along columns, and its pixels look up two values of
//! each. Jobs are bands of rows of pixels, which keep the gradients by the mips that they reach for themselves; these are
//! added in the order of the bands.
//!
//! Above 400 lines: what builds a chain, what samples it and the adjoints share its layout and are read together.

use super::compare::compare_statistics;
use super::{BAND_ROWS, Context, Distance, Tally};
use crate::hvs::pooling::GazePooling;
use crate::kernels::cpu::pooling::{AreaMean, Bilinear};
use crate::kernels::cpu::pyramid::{Kernel, Plane, block, correlate_row, in_blocks};
use crate::real::{Real, Task, add_scaled, dispatch, fma};
use rayon::prelude::*;
use std::ops::{Range, RangeInclusive};

/// Two images, mean and mean square each.
type Sample<T> = [T; 4];
/// Gradients by mean and mean square of the first image.
type VSample<T> = [T; 2];
/// Responses of both images.
type Pair<T> = [T; 2];

/// One mip of a level.
#[derive(Debug, Clone)]
struct Mip<T> {
    width: usize,
    height: usize,
    /// Area means of the mip before, by axis.
    columns: AreaMean<T>,
    rows: AreaMean<T>,
    /// Enlargement to the level.
    up_columns: Bilinear<T>,
    up_rows: Bilinear<T>,
}

/// Pooling of one level.
#[derive(Debug, Clone)]
pub(crate) struct GazeLevel<T> {
    width: usize,
    height: usize,
    mips: Vec<Mip<T>>,
    /// First of the two mips of every pixel.
    first: Vec<u8>,
    /// Weight of the second.
    weight: Vec<T>,
    /// Mips that any pixel of a row uses.
    used: Vec<RangeInclusive<usize>>,
}

/// Memory that one map after the other uses: fresh memory would cost more than what is computed into it.
#[derive(Debug)]
pub(super) struct Scratch<T> {
    responses: Vec<Pair<T>>,
    /// From the second mip on.
    chain: Vec<Vec<Sample<T>>>,
    v_mips: Vec<Vec<VSample<T>>>,
    v_responses: Vec<T>,
}

impl<T> Default for Scratch<T> {
    fn default() -> Self {
        Self { responses: Vec::new(), chain: Vec::new(), v_mips: Vec::new(), v_responses: Vec::new() }
    }
}

impl<T: Real> Scratch<T> {
    fn fit(&mut self, level: &GazeLevel<T>, gradient: bool) {
        let size = level.width * level.height;
        self.responses.resize(size, [T::ZERO; 2]);
        self.chain.resize_with(level.mips.len() - 1, Vec::new);
        for (samples, mip) in self.chain.iter_mut().zip(&level.mips[1..]) {
            samples.resize(mip.width * mip.height, [T::ZERO; 4]);
        }
        if gradient {
            self.v_responses.resize(size, T::ZERO);
            self.v_mips.resize_with(level.mips.len() - 1, Vec::new);
            for (v_mip, mip) in self.v_mips.iter_mut().zip(&level.mips[1..]) {
                v_mip.resize(mip.width * mip.height, [T::ZERO; 2]);
            }
        }
    }
}

impl<T: Real> GazeLevel<T> {
    pub fn new(pooling: &GazePooling, (width, height): (usize, usize)) -> Self {
        let mut mips: Vec<Mip<T>> = Vec::new();
        let (mut w, mut h) = (width, height);
        loop {
            let (from_w, from_h) = mips.last().map_or((w, h), |m| (m.width, m.height));
            mips.push(Mip {
                width: w,
                height: h,
                columns: AreaMean::new(from_w, w),
                rows: AreaMean::new(from_h, h),
                up_columns: Bilinear::new(width, w),
                up_rows: Bilinear::new(height, h),
            });
            if (w, h) == (1, 1) {
                break;
            }
            (w, h) = ((w / 2).max(1), (h / 2).max(1));
        }
        let last = mips.len() - 1;
        let of_pixel = |i: usize| {
            let lod = GazePooling::level_of_detail(pooling.pooling_px((width, height), i % width, i / width));
            let first = (lod as usize).min(last);
            let weight = if first == last { 0.0 } else { lod - first as f64 };
            (first as u8, T::of(weight))
        };
        let (first, weight): (Vec<u8>, Vec<T>) = (0..width * height).into_par_iter().map(of_pixel).unzip();
        let used = first.chunks_exact(width).map(|row| {
            let (low, high) = row.iter().fold((u8::MAX, 0), |(a, b), k| (a.min(*k), b.max(*k)));
            usize::from(low)..=(usize::from(high) + 1).min(last)
        });
        let used = used.collect();
        Self { width, height, mips, first, weight, used }
    }

    /// Sizes of the mips, finest first.
    #[cfg(feature = "gpu")]
    pub fn mip_sizes(&self) -> impl Iterator<Item = (usize, usize)> {
        self.mips.iter().map(|mip| (mip.width, mip.height))
    }

    /// First of the two mips of every pixel, and the weight of the second.
    #[cfg(feature = "gpu")]
    pub fn lods(&self) -> impl Iterator<Item = (u8, T)> {
        self.first.iter().copied().zip(self.weight.iter().copied())
    }

    /// Compares the responses of two planes to one filter: tallies of bands of rows, and the gradient by the responses of
    /// the first, `[height, width]`, empty when not wanted.
    pub(super) fn compare<'s>(
        &self,
        planes: [&Plane<T>; 2],
        kernel: &Kernel<T>,
        context: &Context<'_, T>,
        scratch: &'s mut Scratch<T>,
    ) -> (Vec<Tally<T>>, &'s [T]) {
        scratch.fit(self, context.gradient);
        let Scratch { responses, chain, v_mips, v_responses } = scratch;
        self.chain(planes, kernel, responses, chain);
        let (responses, chain) = (&responses[..], &chain[..]);
        let job = |b: usize| {
            let rows = b * BAND_ROWS..((b + 1) * BAND_ROWS).min(self.height);
            dispatch(Compare { level: self, responses, chain, rows, context })
        };
        let bands = (0..self.height.div_ceil(BAND_ROWS)).into_par_iter().map(job);
        let (tallies, v_bands): (Vec<_>, Vec<_>) = bands.unzip();
        if !context.gradient {
            return (tallies, &[]);
        }
        self.gradient(responses, &v_bands, v_mips, v_responses);
        (tallies, v_responses)
    }

    /// Both images' responses, and all mips of them and their squares.
    fn chain(
        &self,
        planes: [&Plane<T>; 2],
        kernel: &Kernel<T>,
        responses: &mut [Pair<T>],
        chain: &mut [Vec<Sample<T>>],
    ) {
        // Planes have an even number of rows and columns.
        let [first, rest @ ..] = chain else { unreachable!("planes have more than one pixel") };
        let rows_of_two = responses.par_chunks_mut(2 * self.width).zip(first.par_chunks_mut(self.width / 2));
        rows_of_two.enumerate().for_each(|(i, (responses, mip))| {
            dispatch(Responses { planes, kernel: &[*kernel], y: 2 * i, responses, mip });
        });
        let mut finer = &*first;
        for (k, samples) in rest.iter_mut().enumerate() {
            let (from, mip) = (&self.mips[k + 1], &self.mips[k + 2]);
            samples.par_chunks_mut(mip.width).enumerate().for_each(|(i, row)| {
                dispatch(Means { finer, from, mip, i, row });
            });
            finer = samples;
        }
    }

    /// The gradient by the responses, from those by the mips that every band reaches.
    fn gradient(
        &self,
        responses: &[Pair<T>],
        v_bands: &[VBand<T>],
        v_mips: &mut [Vec<VSample<T>>],
        v_responses: &mut [T],
    ) {
        // From the coarsest on, each mip takes what the one before passes on.
        for k in (1..self.mips.len()).rev() {
            let (v_finer, v_coarser) = v_mips.split_at_mut(k);
            let v_coarser = v_coarser.first().map(|v| &v[..]);
            let row_len = self.mips[k].width;
            v_finer[k - 1].par_chunks_mut(row_len).enumerate().for_each(|(i, row)| {
                dispatch(Gather { level: self, k, i, v_bands, v_coarser, row });
            });
        }
        let v_coarser = Some(&v_mips[0][..]);
        let rows = v_responses.par_chunks_mut(self.width).zip(responses.par_chunks(self.width));
        rows.enumerate().for_each_init(
            || vec![[T::ZERO; 2]; self.width],
            |row, (i, (v_responses, responses))| {
                dispatch(Gather { level: self, k: 0, i, v_bands, v_coarser, row });
                for ((v, [mean, square]), [x, _]) in v_responses.iter_mut().zip(row).zip(responses) {
                    *v = *mean + (*x + *x) * *square;
                }
            },
        );
    }
}

/// Two rows of responses and the row of the second mip that they make.
struct Responses<'a, T> {
    planes: [&'a Plane<T>; 2],
    kernel: &'a [Kernel<T>],
    y: usize,
    responses: &'a mut [Pair<T>],
    mip: &'a mut [Sample<T>],
}

impl<T: Real> Task for Responses<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let Self { planes, kernel, y, responses, mip } = self;
        let width = planes[0].width;
        let mut found = vec![T::ZERO; width];
        let mut reference = vec![T::ZERO; width];
        for (r, row) in responses.chunks_exact_mut(width).enumerate() {
            correlate_row::<T, FMA, 1>(planes[0], y + r, kernel, false, &mut found);
            correlate_row::<T, FMA, 1>(planes[1], y + r, kernel, false, &mut reference);
            for ((pair, a), b) in row.iter_mut().zip(&found).zip(&reference) {
                *pair = [*a, *b];
            }
        }
        let (upper, lower) = responses.split_at(width);
        let quarter = T::of(0.25);
        for ((sample, upper), lower) in mip.iter_mut().zip(upper.chunks_exact(2)).zip(lower.chunks_exact(2)) {
            let of = |q: usize| [upper[0][q], upper[1][q], lower[0][q], lower[1][q]];
            let ([a, b, c, d], [e, f, g, h]) = (of(0), of(1));
            *sample = [
                ((a + b) + (c + d)) * quarter,
                ((a * a + b * b) + (c * c + d * d)) * quarter,
                ((e + f) + (g + h)) * quarter,
                ((e * e + f * f) + (g * g + h * h)) * quarter,
            ];
        }
    }
}

/// One row of a mip.
struct Means<'a, T> {
    finer: &'a [Sample<T>],
    from: &'a Mip<T>,
    mip: &'a Mip<T>,
    i: usize,
    row: &'a mut [Sample<T>],
}

impl<T: Real> Task for Means<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let Self { finer, from, mip, i, row } = self;
        for (j, sample) in row.iter_mut().enumerate() {
            let mut sum = [T::ZERO; 4];
            for y in mip.rows.cell(i) {
                for s in &finer[y * from.width..][mip.columns.cell(j)] {
                    for q in 0..4 {
                        sum[q] += s[q];
                    }
                }
            }
            let scale = mip.rows.inverse_count(i) * mip.columns.inverse_count(j);
            for q in 0..4 {
                sample[q] = sum[q] * scale;
            }
        }
    }
}

/// Gradients by the mips, as far as one band of pixels reaches them: per mip its rows, and the values.
type VBand<T> = Vec<(Range<usize>, Vec<VSample<T>>)>;

/// Pixels of some rows.
struct Compare<'a, T> {
    level: &'a GazeLevel<T>,
    responses: &'a [Pair<T>],
    chain: &'a [Vec<Sample<T>>],
    rows: Range<usize>,
    context: &'a Context<'a, T>,
}

impl<T: Real> Task for Compare<'_, T> {
    type Output = (Tally<T>, VBand<T>);

    #[inline(always)]
    fn run<const FMA: bool>(self) -> Self::Output {
        match self.context.distance {
            Distance::Mse => self.pixels::<FMA, false>(),
            Distance::L1 => self.pixels::<FMA, true>(),
        }
    }
}

impl<T: Real> Compare<'_, T> {
    #[inline(always)]
    fn pixels<const FMA: bool, const L1: bool>(self) -> (Tally<T>, VBand<T>) {
        let Self { level, responses, chain, rows, context } = self;
        let (width, first_row) = (level.width, rows.start);
        let mut tally = context.tally(rows.len(), width);
        // Of every mip, its row at the place of the pixels, and the gradients by that.
        let mut mixed: Vec<Vec<Sample<T>>> = level.mips.iter().map(|m| vec![[T::ZERO; 4]; m.width]).collect();
        let mut v_mixed: Vec<Vec<VSample<T>>> = level.mips.iter().map(|m| vec![[T::ZERO; 2]; m.width]).collect();
        let mut v_band = if context.gradient { level.reached(rows.clone()) } else { Vec::new() };
        let (mut pooled, mut second) = (vec![[T::ZERO; 4]; width], vec![[T::ZERO; 4]; width]);
        let mut distances = vec![T::ZERO; width];
        let mut v_row = vec![[T::ZERO; 2]; width];
        for y in rows {
            for k in level.used[y].clone() {
                match k.checked_sub(1) {
                    None => {
                        for (v, [a, b]) in mixed[0].iter_mut().zip(&responses[y * width..][..width]) {
                            *v = [*a, *a * *a, *b, *b * *b];
                        }
                    }
                    Some(k) => mix_rows::<T, FMA>(&level.mips[k + 1], &chain[k], y, &mut mixed[k + 1]),
                }
            }
            let (first, weights) = (&level.first[y * width..][..width], &level.weight[y * width..][..width]);
            for run in runs(first) {
                let k = usize::from(first[run.start]);
                let out = &mut pooled[run.clone()];
                level.mips[k].up_columns.enlarge_quads::<FMA>(&mixed[k], run.start, out);
                if let Some(mip) = level.mips.get(k + 1) {
                    let second = &mut second[..run.len()];
                    mip.up_columns.enlarge_quads::<FMA>(&mixed[k + 1], run.start, second);
                    for ((v, s), w) in out.iter_mut().zip(second).zip(&weights[run]) {
                        for q in 0..4 {
                            v[q] = fma::<T, FMA>(*w, s[q] - v[q], v[q]);
                        }
                    }
                }
            }
            compare_row::<T, L1>(&pooled, context.scale, &mut distances, &mut v_row);
            context.add(&mut tally, y, y - first_row, &distances);
            if !context.gradient {
                continue;
            }
            context.restrict(y, &mut v_row);
            for run in runs(first) {
                let k = usize::from(first[run.start]);
                let (x, v, weights) = (run.start, &v_row[run.clone()], &weights[run]);
                if let Some(mip) = level.mips.get(k + 1) {
                    spread::<T, FMA>(mip, x, v.iter().zip(weights).map(|(v, w)| (*v, *w)), &mut v_mixed[k + 1]);
                }
                let rest = v.iter().zip(weights).map(|(v, w)| (*v, T::ONE - *w));
                spread::<T, FMA>(&level.mips[k], x, rest, &mut v_mixed[k]);
            }
            for k in level.used[y].clone() {
                let (mip, v_mixed) = (&level.mips[k], &mut v_mixed[k]);
                let (reached, v_rows) = &mut v_band[k];
                let (upper, lower, down) = mip.up_rows.source(y);
                for (row, w) in [(upper, T::ONE - down), (lower, down)] {
                    if w != T::ZERO {
                        let v_rows = &mut v_rows[(row - reached.start) * mip.width..][..mip.width];
                        add_scaled::<T, FMA>(v_rows.as_flattened_mut(), w, v_mixed.as_flattened());
                    }
                }
                v_mixed.fill([T::ZERO; 2]);
            }
        }
        (tally, v_band)
    }
}

impl<T: Real> GazeLevel<T> {
    /// Zeros for the gradients by the rows of all mips that these rows of pixels reach.
    fn reached(&self, rows: Range<usize>) -> VBand<T> {
        let used = |k: usize| rows.clone().filter(move |y| self.used[*y].contains(&k));
        let of_mip = |(k, mip): (usize, &Mip<T>)| {
            let first = used(k).next().map_or(0, |y| mip.up_rows.first(y));
            let end = used(k).next_back().map_or(0, |y| mip.up_rows.source(y).1 + 1);
            (first..end, vec![[T::ZERO; 2]; (end - first) * mip.width])
        };
        self.mips.iter().enumerate().map(of_mip).collect()
    }
}

/// A mip, enlarged along columns, at row `y` of pixels.
#[inline(always)]
fn mix_rows<T: Real, const FMA: bool>(mip: &Mip<T>, samples: &[Sample<T>], y: usize, out: &mut [Sample<T>]) {
    let (upper, lower, down) = mip.up_rows.source(y);
    let row = |i: usize| samples[i * mip.width..][..mip.width].as_flattened();
    for ((v, a), b) in out.as_flattened_mut().iter_mut().zip(row(upper)).zip(row(lower)) {
        *v = fma::<T, FMA>(down, *b - *a, *a);
    }
}

/// Ranges of pixels of a row that have their first mip in common.
fn runs(first: &[u8]) -> impl Iterator<Item = Range<usize>> {
    let mut end = 0;
    first.chunk_by(|a, b| a == b).map(move |run| {
        end += run.len();
        end - run.len()..end
    })
}

/// The adjoint of [`Bilinear::enlarge_quads`] for the first image: adds the gradients at the pixels from `x` on, each times a weight.
/// Pixels between the same two values add up in registers: in memory each would wait for the one before.
#[inline(always)]
fn spread<T: Real, const FMA: bool>(
    mip: &Mip<T>,
    x: usize,
    v_pixels: impl Iterator<Item = (VSample<T>, T)>,
    v_row: &mut [VSample<T>],
) {
    let add = |v: &mut VSample<T>, sum: VSample<T>| *v = [v[0] + sum[0], v[1] + sum[1]];
    let mut current = mip.up_columns.first(x);
    let (mut by_left, mut by_right) = ([T::ZERO; 2], [T::ZERO; 2]);
    for ((v, weight), (left, _, across)) in v_pixels.zip(mip.up_columns.sources(x)) {
        if left != current {
            add(&mut v_row[current], by_left);
            if left == current + 1 {
                by_left = by_right;
            } else {
                add(&mut v_row[current + 1], by_right);
                by_left = [T::ZERO; 2];
            }
            by_right = [T::ZERO; 2];
            current = left;
        }
        let (w_left, w_right) = (weight * (T::ONE - across), weight * across);
        for q in 0..2 {
            by_left[q] = fma::<T, FMA>(w_left, v[q], by_left[q]);
        }
        for q in 0..2 {
            by_right[q] = fma::<T, FMA>(w_right, v[q], by_right[q]);
        }
    }
    add(&mut v_row[current], by_left);
    // Behind the last value there is none, and no pixel weighs it.
    if let Some(v) = v_row.get_mut(current + 1) {
        add(v, by_right);
    }
}

/// Distances of a row of pools and, in `v_row`, the gradients by mean and mean square of the first image.
#[inline(always)]
fn compare_row<T: Real, const L1: bool>(pooled: &[Sample<T>], scale: T, distances: &mut [T], v_row: &mut [VSample<T>]) {
    in_blocks!(distances.len(), |x0, B, _C| {
        let pooled = block::<Sample<T>, B>(pooled, x0);
        let (mut d, mut v) = ([T::ZERO; B], [[T::ZERO; 2]; B]);
        for x in 0..B {
            let [mean, square, other_mean, other_square] = pooled[x];
            let (distance, v_mean, v_square) =
                compare_statistics::<T, L1>((mean, square), (other_mean, other_square), scale);
            d[x] = distance;
            v[x] = [v_mean, v_square];
        }
        distances[x0..x0 + B].copy_from_slice(&d);
        v_row[x0..x0 + B].copy_from_slice(&v);
    });
}

/// Gradients by row `i` of mip `k`: what the bands that reach it have, and what the next coarser mip passes on.
struct Gather<'a, T> {
    level: &'a GazeLevel<T>,
    k: usize,
    i: usize,
    v_bands: &'a [VBand<T>],
    v_coarser: Option<&'a [VSample<T>]>,
    row: &'a mut [VSample<T>],
}

impl<T: Real> Task for Gather<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let Self { level, k, i, v_bands, v_coarser, row } = self;
        let width = level.mips[k].width;
        row.fill([T::ZERO; 2]);
        if let (Some(v_coarser), Some(coarser)) = (v_coarser, level.mips.get(k + 1)) {
            for c in coarser.rows.cells_of(i) {
                let cells = &v_coarser[c * coarser.width..][..coarser.width];
                let by_row = coarser.rows.inverse_count(c);
                if width == 2 * coarser.width {
                    // A sample belongs to one cell, and a cell has two of them.
                    let count = by_row * T::of(0.5);
                    for (pair, v) in row.chunks_exact_mut(2).zip(cells) {
                        let v = [v[0] * count, v[1] * count];
                        for sample in pair {
                            *sample = [sample[0] + v[0], sample[1] + v[1]];
                        }
                    }
                    continue;
                }
                for (j, v) in row.iter_mut().enumerate() {
                    for d in coarser.columns.cells_of(j) {
                        let count = by_row * coarser.columns.inverse_count(d);
                        *v = [v[0] + cells[d][0] * count, v[1] + cells[d][1] * count];
                    }
                }
            }
        }
        for v_band in v_bands {
            let (reached, v_rows) = &v_band[k];
            if reached.contains(&i) {
                let own = &v_rows[(i - reached.start) * width..][..width];
                add_scaled::<T, FMA>(row.as_flattened_mut(), T::ONE, own.as_flattened());
            }
        }
    }
}
