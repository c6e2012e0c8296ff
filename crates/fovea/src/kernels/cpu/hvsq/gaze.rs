//! Gaze-dependent statistics: chains of mips of the responses of one filter, both images at once, two mips sampled at
//! every pixel, and the adjoint of it all.
//!
//! A sample holds x and x² of the first image, then of the second; a chain is their area means, every mip half the size
//! of the one before, down to one sample. Mips are never stored enlarged. Jobs are bands of rows: of the plane where
//! pixels are compared, of each mip where gradients are gathered; rows of pixels that do not use a mip are passed over.

use super::compare::compare_statistics;
use super::{BAND_ROWS, Context, Distance, Tally};
use crate::hvs::pooling::GazePooling;
use crate::kernels::cpu::pooling::{AreaMean, Bilinear};
use crate::kernels::cpu::pyramid::{Kernel, Plane, correlate_row};
use crate::real::{Real, Task, dispatch, fma};
use rayon::prelude::*;
use std::ops::RangeInclusive;

/// Two images, mean and mean square each.
type Sample<T> = [T; 4];
/// Gradients by mean and mean square of the first image.
type VSample<T> = [T; 2];

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
    pub(super) fn compare(
        &self,
        planes: [&Plane<T>; 2],
        kernel: &Kernel<T>,
        context: &Context<'_, T>,
    ) -> (Vec<Tally<T>>, Vec<T>) {
        let chain = self.chain(planes, kernel);
        let band = BAND_ROWS * self.width;
        let mut v_pixels = vec![[T::ZERO; 2]; if context.gradient { self.width * self.height } else { 0 }];
        let job = |b: usize, v_pixels: &mut [VSample<T>]| {
            let rows = (b * BAND_ROWS, ((b + 1) * BAND_ROWS).min(self.height));
            dispatch(Compare { level: self, chain: &chain, rows, context, v_pixels })
        };
        if !context.gradient {
            let tallies = (0..self.height.div_ceil(BAND_ROWS)).into_par_iter().map(|b| job(b, &mut [])).collect();
            return (tallies, Vec::new());
        }
        let tallies = v_pixels.par_chunks_mut(band).enumerate().map(|(b, v)| job(b, v)).collect();
        let v_responses = self.gradient(&chain[0], &v_pixels);
        (tallies, v_responses)
    }

    /// Both images' responses and squares, and all mips of them.
    fn chain(&self, planes: [&Plane<T>; 2], kernel: &Kernel<T>) -> Vec<Vec<Sample<T>>> {
        let mut samples = vec![[T::ZERO; 4]; self.width * self.height];
        samples.par_chunks_mut(self.width).enumerate().for_each(|(y, row)| {
            dispatch(Samples { planes, kernel: &[*kernel], y, row });
        });
        let mut chain = vec![samples];
        for (k, mip) in self.mips.iter().enumerate().skip(1) {
            let (finer, from) = (&chain[k - 1], &self.mips[k - 1]);
            let mut samples = vec![[T::ZERO; 4]; mip.width * mip.height];
            samples.par_chunks_mut(mip.width).enumerate().for_each(|(i, row)| {
                for (j, sample) in row.iter_mut().enumerate() {
                    let mut sum = [T::ZERO; 4];
                    for y in mip.rows.cell(i) {
                        for s in &finer[y * from.width..][mip.columns.cell(j)] {
                            for q in 0..4 {
                                sum[q] += s[q];
                            }
                        }
                    }
                    *sample = sum.map(|v| v * (mip.rows.inverse_count(i) * mip.columns.inverse_count(j)));
                }
            });
            chain.push(samples);
        }
        chain
    }

    /// The gradient by the responses, from those by the pooled statistics of every pixel.
    fn gradient(&self, samples: &[Sample<T>], v_pixels: &[VSample<T>]) -> Vec<T> {
        let mut v_coarser: Vec<VSample<T>> = Vec::new();
        for (k, mip) in self.mips.iter().enumerate().rev() {
            let mut v_mip = vec![[T::ZERO; 2]; mip.width * mip.height];
            let coarser = self.mips.get(k + 1);
            let v_of_coarser = &v_coarser;
            v_mip.par_chunks_mut(mip.width).enumerate().for_each(|(i, row)| {
                dispatch(Gather { level: self, k, i, v_pixels, row });
                // What the next coarser mip passes on.
                let Some(coarser) = coarser else { return };
                for c in coarser.rows.cells_of(i) {
                    let cells = &v_of_coarser[c * coarser.width..][..coarser.width];
                    for (j, v) in row.iter_mut().enumerate() {
                        for d in coarser.columns.cells_of(j) {
                            let count = coarser.rows.inverse_count(c) * coarser.columns.inverse_count(d);
                            v[0] += cells[d][0] * count;
                            v[1] += cells[d][1] * count;
                        }
                    }
                }
            });
            v_coarser = v_mip;
        }
        v_coarser.par_iter().zip(samples).map(|(v, s)| v[0] + (s[0] + s[0]) * v[1]).collect()
    }
}

/// One row of responses and their squares.
struct Samples<'a, T> {
    planes: [&'a Plane<T>; 2],
    kernel: &'a [Kernel<T>],
    y: usize,
    row: &'a mut [Sample<T>],
}

impl<T: Real> Task for Samples<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let mut responses = vec![T::ZERO; 2 * self.row.len()];
        let (found, reference) = responses.split_at_mut(self.row.len());
        correlate_row::<T, FMA, 1>(self.planes[0], self.y, self.kernel, false, found);
        correlate_row::<T, FMA, 1>(self.planes[1], self.y, self.kernel, false, reference);
        for ((sample, a), b) in self.row.iter_mut().zip(found).zip(reference) {
            *sample = [*a, *a * *a, *b, *b * *b];
        }
    }
}

/// Pixels of some rows.
struct Compare<'a, T> {
    level: &'a GazeLevel<T>,
    chain: &'a [Vec<Sample<T>>],
    rows: (usize, usize),
    context: &'a Context<'a, T>,
    v_pixels: &'a mut [VSample<T>],
}

impl<T: Real> Task for Compare<'_, T> {
    type Output = Tally<T>;

    #[inline(always)]
    fn run<const FMA: bool>(self) -> Tally<T> {
        match self.context.distance {
            Distance::Mse => self.pixels::<FMA, false>(),
            Distance::L1 => self.pixels::<FMA, true>(),
        }
    }
}

impl<T: Real> Compare<'_, T> {
    #[inline(always)]
    fn pixels<const FMA: bool, const L1: bool>(self) -> Tally<T> {
        let Self { level, chain, rows: (y0, y1), context, v_pixels } = self;
        let width = level.width;
        let mut tally = context.tally(y1 - y0, width);
        let mut distances = vec![T::ZERO; width];
        let mut v_row = vec![[T::ZERO; 2]; width];
        for y in y0..y1 {
            for x in 0..width {
                let pixel = y * width + x;
                let k = usize::from(level.first[pixel]);
                let weight = level.weight[pixel];
                let mut pooled = sampled::<T, FMA>(&level.mips[k], &chain[k], x, y);
                if weight != T::ZERO {
                    let second = sampled::<T, FMA>(&level.mips[k + 1], &chain[k + 1], x, y);
                    for q in 0..4 {
                        pooled[q] = fma::<T, FMA>(weight, second[q] - pooled[q], pooled[q]);
                    }
                }
                let [mean, square, other_mean, other_square] = pooled;
                (distances[x], v_row[x][0], v_row[x][1]) =
                    compare_statistics::<T, L1>((mean, square), (other_mean, other_square), context.scale);
            }
            context.add(&mut tally, y, y - y0, &distances);
            if context.gradient {
                context.restrict(y, &mut v_row);
                v_pixels[(y - y0) * width..][..width].copy_from_slice(&v_row);
            }
        }
        tally
    }
}

/// A mip, bilinearly enlarged, at pixel (x, y).
#[inline(always)]
fn sampled<T: Real, const FMA: bool>(mip: &Mip<T>, samples: &[Sample<T>], x: usize, y: usize) -> Sample<T> {
    let (left, right, across) = mip.up_columns.source(x);
    let (upper, lower, down) = mip.up_rows.source(y);
    let mixed = |row: usize| -> Sample<T> {
        let (a, b) = (&samples[row * mip.width + left], &samples[row * mip.width + right]);
        std::array::from_fn(|q| fma::<T, FMA>(across, b[q] - a[q], a[q]))
    };
    let (a, b) = (mixed(upper), mixed(lower));
    std::array::from_fn(|q| fma::<T, FMA>(down, b[q] - a[q], a[q]))
}

/// Gradients by row `i` of mip `k`, as far as pixels sample it directly.
struct Gather<'a, T> {
    level: &'a GazeLevel<T>,
    k: usize,
    i: usize,
    v_pixels: &'a [VSample<T>],
    row: &'a mut [VSample<T>],
}

impl<T: Real> Task for Gather<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let Self { level, k, i, v_pixels, row } = self;
        let (width, mip) = (level.width, &level.mips[k]);
        let mut sums = vec![[T::ZERO; 2]; width];
        let mut is_used = false;
        for (y, by_row) in mip.up_rows.targets(i) {
            if by_row == T::ZERO || !level.used[y].contains(&k) {
                continue;
            }
            is_used = true;
            let pixels = y * width..(y + 1) * width;
            let lods = level.first[pixels.clone()].iter().zip(&level.weight[pixels.clone()]);
            for ((sum, v), (first, weight)) in sums.iter_mut().zip(&v_pixels[pixels]).zip(lods) {
                let first = usize::from(*first);
                let by_mip = if first == k {
                    T::ONE - *weight
                } else if first + 1 == k {
                    *weight
                } else {
                    continue;
                };
                let w = by_row * by_mip;
                sum[0] = fma::<T, FMA>(w, v[0], sum[0]);
                sum[1] = fma::<T, FMA>(w, v[1], sum[1]);
            }
        }
        if !is_used {
            return;
        }
        for (j, v) in row.iter_mut().enumerate() {
            for (x, w) in mip.up_columns.targets(j) {
                v[0] = fma::<T, FMA>(w, sums[x][0], v[0]);
                v[1] = fma::<T, FMA>(w, sums[x][1], v[1]);
            }
        }
    }
}
