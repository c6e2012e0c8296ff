//! Pass 1: responses of a group of filters, pooled into grids. One job is a band of grid rows; the sample that two cells
//! share is computed once.

use super::{BAND_ROWS, by_group};
use crate::kernels::cpu::pooling::Pools;
use crate::kernels::cpu::pyramid::{Kernel, Plane, correlate_row};
use crate::real::{Real, Task, dispatch, fma};
use rayon::prelude::*;
use std::ops::Range;

/// Means and means of squares of the responses, `[rows of cells, filters, columns of cells, 2]`; where pooling changes
/// nothing, the responses, `[rows, filters, columns]`.
pub(super) fn of<T: Real>(plane: &Plane<T>, pools: &Pools<T>, kernels: &[Kernel<T>], antisymmetric: bool) -> Vec<T> {
    let n = kernels.len();
    if pools.is_identity() {
        let mut out = vec![T::ZERO; n * plane.width * plane.height];
        let band = BAND_ROWS * n * plane.width;
        out.par_chunks_mut(band).enumerate().for_each(|(b, out)| {
            dispatch(Responses { plane, kernels, antisymmetric, first: b * BAND_ROWS, out });
        });
        return out;
    }
    let (rows, columns) = (pools.y.area.num_cells(), pools.x.area.num_cells());
    let row_len = n * 2 * columns;
    let band = cell_rows_of_band(pools);
    let mut grids = vec![T::ZERO; rows * row_len];
    grids.par_chunks_mut(band * row_len).enumerate().for_each(|(b, grids)| {
        let rows = b * band..((b + 1) * band).min(rows);
        dispatch(Pool { plane, pools, kernels, antisymmetric, rows, grids });
    });
    grids
}

/// Rows of cells of a job.
pub(super) fn cell_rows_of_band<T: Real>(pools: &Pools<T>) -> usize {
    (BAND_ROWS * pools.y.area.num_cells() / pools.y.area.num_samples()).max(1)
}

struct Responses<'a, T> {
    plane: &'a Plane<T>,
    kernels: &'a [Kernel<T>],
    antisymmetric: bool,
    first: usize,
    out: &'a mut [T],
}

impl<T: Real> Task for Responses<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let Self { plane, kernels, antisymmetric, first, out } = self;
        for (y, row) in out.chunks_exact_mut(kernels.len() * plane.width).enumerate() {
            by_group!(kernels.len(), correlate_row::<T, FMA>(plane, first + y, kernels, antisymmetric, row));
        }
    }
}

struct Pool<'a, T> {
    plane: &'a Plane<T>,
    pools: &'a Pools<T>,
    kernels: &'a [Kernel<T>],
    antisymmetric: bool,
    rows: Range<usize>,
    grids: &'a mut [T],
}

impl<T: Real> Task for Pool<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let Self { plane, pools, kernels, antisymmetric, rows, grids } = self;
        let (n, width, columns) = (kernels.len(), plane.width, pools.x.area.num_cells());
        let mut responses = vec![T::ZERO; n * width];
        let mut sums = vec![T::ZERO; n * width];
        let mut squares = vec![T::ZERO; n * width];
        let mut computed = usize::MAX;
        for (i, row) in rows.zip(grids.chunks_exact_mut(n * 2 * columns)) {
            sums.fill(T::ZERO);
            squares.fill(T::ZERO);
            for y in pools.y.area.cell(i) {
                if y != computed {
                    by_group!(n, correlate_row::<T, FMA>(plane, y, kernels, antisymmetric, &mut responses));
                    computed = y;
                }
                for ((sum, square), x) in sums.iter_mut().zip(&mut squares).zip(&responses) {
                    *sum += *x;
                    *square = fma::<T, FMA>(*x, *x, *square);
                }
            }
            let scale = pools.y.area.inverse_count(i);
            for (o, cells) in row.chunks_exact_mut(2 * columns).enumerate() {
                let rows = [&sums[o * width..][..width], &squares[o * width..][..width]];
                pools.x.area.means(rows, scale, cells.as_chunks_mut().0);
            }
        }
    }
}
