//! Pass 2: the grids of two images enlarged, means and standard deviations, their distance, and the gradient by the grids
//! of the first image. One job is a band of rows of cells; it compares the pixels that its cells contribute to, and
//! counts those that begin in the band.

use super::statistics::cell_rows_of_band;
use super::{Context, Distance, MIN_VARIANCE, Tally, distance_of};
use crate::kernels::cpu::pooling::Pools;
use crate::kernels::cpu::pyramid::{block, in_blocks};
use crate::real::{Real, Task, add_scaled, dispatch, fma};
use rayon::prelude::*;
use std::ops::Range;

/// Compares `[rows of cells, num_maps, columns of cells, 2]` of two images. The gradient, of the same shape, is by the
/// sums over the samples of a cell (divided by their number already); empty when not wanted.
pub(super) fn grids<T: Real>(
    found: &[T],
    reference: &[T],
    pools: &Pools<T>,
    num_maps: usize,
    context: &Context<'_, T>,
) -> (Vec<Tally<T>>, Vec<T>) {
    let rows = pools.y.area.num_cells();
    let row_len = num_maps * 2 * pools.x.area.num_cells();
    let band = cell_rows_of_band(pools);
    let mut v_grids = vec![T::ZERO; if context.gradient { rows * row_len } else { 0 }];
    let bands_of = |b: usize| b * band..((b + 1) * band).min(rows);
    let compare = |b: usize, v_grids: &mut [T]| {
        dispatch(Compare { found, reference, pools, num_maps, rows: bands_of(b), context, v_grids })
    };
    let tallies = if context.gradient {
        v_grids.par_chunks_mut(band * row_len).enumerate().map(|(b, v_grids)| compare(b, v_grids)).collect()
    } else {
        (0..rows.div_ceil(band)).into_par_iter().map(|b| compare(b, &mut [])).collect()
    };
    (tallies, v_grids)
}

struct Compare<'a, T> {
    found: &'a [T],
    reference: &'a [T],
    pools: &'a Pools<T>,
    num_maps: usize,
    rows: Range<usize>,
    context: &'a Context<'a, T>,
    v_grids: &'a mut [T],
}

impl<T: Real> Task for Compare<'_, T> {
    type Output = Tally<T>;

    #[inline(always)]
    fn run<const FMA: bool>(self) -> Tally<T> {
        match self.context.distance {
            Distance::Mse => self.rows::<FMA, false>(),
            Distance::L1 => self.rows::<FMA, true>(),
        }
    }
}

impl<T: Real> Compare<'_, T> {
    #[inline(always)]
    fn rows<const FMA: bool, const L1: bool>(self) -> Tally<T> {
        let Self { found, reference, pools, num_maps, rows, context, v_grids } = self;
        let (columns, width) = (pools.x.area.num_cells(), pools.x.area.num_samples());
        let up = &pools.y.up;
        let own = up.places(rows.clone());
        // Pixels between the row of cells above the band and its first one contribute to the gradient of the latter.
        let reached = if context.gradient { up.places(rows.start.saturating_sub(1)..rows.end) } else { own.clone() };
        let mut tally = context.tally(own.len(), width);
        // Enlarged rows of cells i at i mod 2: mean and mean square of the first image, then of the second.
        let mut enlarged = vec![[T::ZERO; 4]; 2 * width];
        let mut cells = vec![[T::ZERO; 4]; columns];
        let mut v_rows = vec![[T::ZERO; 2]; 2 * width];
        let mut distances = vec![T::ZERO; width];
        let mut v_pixels = vec![[T::ZERO; 2]; width];
        for o in 0..num_maps {
            let mut enlarged_of = [usize::MAX; 2];
            let mut v_rows_of = [usize::MAX; 2];
            v_rows.fill([T::ZERO; 2]);
            for y in reached.clone() {
                let (upper, lower, weight) = up.source(y);
                for i in [upper, lower] {
                    if enlarged_of[i % 2] != i {
                        enlarged_of[i % 2] = i;
                        let start = (i * num_maps + o) * 2 * columns;
                        let found = found[start..][..2 * columns].as_chunks().0;
                        let reference = reference[start..][..2 * columns].as_chunks().0;
                        let out = &mut enlarged[i % 2 * width..][..width];
                        pools.x.up.enlarge_pairs::<FMA>([found, reference], &mut cells, out);
                    }
                }
                let rows_of = [&enlarged[upper % 2 * width..][..width], &enlarged[lower % 2 * width..][..width]];
                compare_row::<T, FMA, L1>(rows_of, weight, context.scale, &mut distances, &mut v_pixels);
                if own.contains(&y) {
                    context.add(&mut tally, y, y - own.start, &distances);
                }
                if !context.gradient {
                    continue;
                }
                context.restrict(y, &mut v_pixels);
                for (i, w) in [(upper, T::ONE - weight), (lower, weight)] {
                    if w == T::ZERO || !rows.contains(&i) {
                        continue;
                    }
                    let slot = &mut v_rows[i % 2 * width..][..width];
                    if v_rows_of[i % 2] != i {
                        finish::<T, FMA>(pools, v_rows_of[i % 2], (rows.start, num_maps, o), slot, v_grids);
                        v_rows_of[i % 2] = i;
                    }
                    add_scaled::<T, FMA>(slot.as_flattened_mut(), w, v_pixels.as_flattened());
                }
            }
            if context.gradient {
                for (i, slot) in v_rows_of.into_iter().zip(v_rows.chunks_exact_mut(width)) {
                    finish::<T, FMA>(pools, i, (rows.start, num_maps, o), slot, v_grids);
                }
            }
        }
        tally
    }
}

/// Writes the gradients by row `i` of cells from those by its enlarged row, which are cleared; nothing for `usize::MAX`.
#[inline(always)]
fn finish<T: Real, const FMA: bool>(
    pools: &Pools<T>,
    i: usize,
    (first, num_maps, o): (usize, usize, usize),
    v_row: &mut [[T; 2]],
    v_grids: &mut [T],
) {
    if i != usize::MAX {
        let columns = pools.x.area.num_cells();
        let out = &mut v_grids[((i - first) * num_maps + o) * 2 * columns..][..2 * columns];
        let by_row = pools.y.area.inverse_count(i);
        for (j, out) in out.as_chunks_mut::<2>().0.iter_mut().enumerate() {
            let count = by_row * pools.x.area.inverse_count(j);
            let [mean, square] = pools.x.up.gathered_pair::<FMA>(j, v_row);
            *out = [mean * count, square * count];
        }
    }
    v_row.fill([T::ZERO; 2]);
}

/// Distances of one row and, in `v_pixels`, the gradients by the enlarged mean and mean square of the first image.
#[inline(always)]
fn compare_row<T: Real, const FMA: bool, const L1: bool>(
    rows: [&[[T; 4]]; 2],
    weight: T,
    scale: T,
    distances: &mut [T],
    v_pixels: &mut [[T; 2]],
) {
    in_blocks!(distances.len(), |x0, B, _C| {
        let (upper, lower) = (block::<[T; 4], B>(rows[0], x0), block::<[T; 4], B>(rows[1], x0));
        let (mut d, mut v) = ([T::ZERO; B], [[T::ZERO; 2]; B]);
        for x in 0..B {
            let (a, b) = (&upper[x], &lower[x]);
            macro_rules! mixed {
                ($q:literal) => {
                    fma::<T, FMA>(weight, b[$q] - a[$q], a[$q])
                };
            }
            let found = (mixed!(0), mixed!(1));
            let reference = (mixed!(2), mixed!(3));
            let (distance, v_mean, v_square) = compare_statistics::<T, L1>(found, reference, scale);
            d[x] = distance;
            v[x] = [v_mean, v_square];
        }
        distances[x0..x0 + B].copy_from_slice(&d);
        v_pixels[x0..x0 + B].copy_from_slice(&v);
    });
}

/// Distance of two pools, each given by mean and mean square, over mean and standard deviation, and the gradients by the
/// mean and the mean square of the first. Below the smallest variance the standard deviation has no gradient.
#[inline(always)]
pub(super) fn compare_statistics<T: Real, const L1: bool>(
    (mean, square): (T, T),
    (other_mean, other_square): (T, T),
    scale: T,
) -> (T, T, T) {
    let least = T::of(MIN_VARIANCE);
    let variance = square - mean * mean;
    let other_variance = other_square - other_mean * other_mean;
    // Comparisons in this order keep NaN.
    let deviation = (if variance < least { least } else { variance }).sqrt();
    let other_deviation = (if other_variance < least { least } else { other_variance }).sqrt();
    let (d_mean, v_mean) = distance_of::<T, L1>(mean, other_mean, scale);
    let (d_deviation, v_deviation) = distance_of::<T, L1>(deviation, other_deviation, scale);
    let v_variance = if variance < least { T::ZERO } else { v_deviation / (deviation + deviation) };
    (d_mean + d_deviation, v_mean - (mean + mean) * v_variance, v_variance)
}
