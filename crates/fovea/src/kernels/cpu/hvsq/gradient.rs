//! Pass 3: responses of a group of filters once more, the gradient by them, and the adjoints of the filters. One job is a
//! band of rows of the plane; the gradient by responses of five rows lives in a ring, two rows beyond each end of the band
//! are recomputed.

use super::{BAND_ROWS, Context, Distance, Tally, by_group, distance_of};
use crate::kernels::cpu::pooling::Pools;
use crate::kernels::cpu::pyramid::{GRADIENT_PAD, Kernel, Plane, correlate_row, correlate_row_bwd, flipped};
use crate::real::{Real, Task, dispatch, fma};
use rayon::prelude::*;

/// Where gradients by responses come from.
#[derive(Debug, Clone, Copy)]
pub(super) enum Source<'a, T> {
    /// Gradients by the pooled grids, as the second pass leaves them.
    Grids(&'a [T], &'a Pools<T>),
    /// Distance of the responses to these, `[rows, filters, columns]`, or to zero.
    Responses(Option<&'a [T]>),
    /// Given, `[rows, columns]` of the one filter.
    Rows(&'a [T]),
}

/// Adds the gradient by `plane` to `v_plane`, `[height, width]`, if the context wants gradients; tallies distances of
/// responses where they are the source.
pub(super) fn add<T: Real>(
    plane: &Plane<T>,
    kernels: &[Kernel<T>],
    antisymmetric: bool,
    source: Source<'_, T>,
    context: &Context<'_, T>,
    v_plane: &mut [T],
) -> Vec<Tally<T>> {
    let job = |b: usize, v_rows: &mut [T]| {
        let rows = (b * BAND_ROWS, ((b + 1) * BAND_ROWS).min(plane.height));
        dispatch(Band { plane, kernels, antisymmetric, source, context, rows, v_rows })
    };
    if context.gradient {
        v_plane.par_chunks_mut(BAND_ROWS * plane.width).enumerate().map(|(b, v_rows)| job(b, v_rows)).collect()
    } else {
        (0..plane.height.div_ceil(BAND_ROWS)).into_par_iter().map(|b| job(b, &mut [])).collect()
    }
}

struct Band<'a, T> {
    plane: &'a Plane<T>,
    kernels: &'a [Kernel<T>],
    antisymmetric: bool,
    source: Source<'a, T>,
    context: &'a Context<'a, T>,
    rows: (usize, usize),
    v_rows: &'a mut [T],
}

impl<T: Real> Task for Band<'_, T> {
    type Output = Tally<T>;

    #[inline(always)]
    fn run<const FMA: bool>(self) -> Tally<T> {
        by_group!(self.kernels.len(), band::<T, FMA>(self))
    }
}

/// Rows of the ring: the height of a filter.
const RING: usize = 5;

#[inline(always)]
fn band<T: Real, const FMA: bool, const N: usize>(band: Band<'_, T>) -> Tally<T> {
    let Band { plane, kernels, antisymmetric, source, context, rows: (y0, y1), v_rows } = band;
    let (width, height) = (plane.width, plane.height);
    let counts = matches!(source, Source::Responses(_));
    let mut tally = context.tally(if counts { y1 - y0 } else { 0 }, width);
    let mut responses = vec![T::ZERO; N * width];
    let mut distances = vec![T::ZERO; width];
    let mut spread = SpreadRows::new(N, width, source);
    let padded = width + 2 * GRADIENT_PAD;
    let mut ring = vec![T::ZERO; RING * N * padded];
    let zeros = vec![T::ZERO; padded];
    let mut reached = vec![T::ZERO; width + GRADIENT_PAD];
    let mut flipped_kernels = [[T::ZERO; 25]; N];
    for (to, from) in flipped_kernels.iter_mut().zip(kernels) {
        *to = flipped(from);
    }
    let (first, end) = if context.gradient { (y0.saturating_sub(2), y1 + 2) } else { (y0, y1) };
    for r in first..end {
        if r < height {
            if !matches!(source, Source::Rows(_)) {
                correlate_row::<T, FMA, N>(plane, r, kernels, antisymmetric, &mut responses);
            }
            let slot = &mut ring[r % RING * N * padded..][..N * padded];
            for (o, slot) in slot.chunks_exact_mut(padded).enumerate() {
                let v = &mut slot[GRADIENT_PAD..][..width];
                let x = &responses[o * width..][..width];
                match source {
                    Source::Grids(v_grids, pools) => spread.gradient_row::<FMA>(v_grids, pools, o, r, x, v),
                    Source::Rows(rows) => v.copy_from_slice(&rows[r * width..][..width]),
                    Source::Responses(reference) => {
                        let reference = reference.map(|b| &b[(r * N + o) * width..][..width]);
                        match context.distance {
                            Distance::Mse => compare_responses::<T, false>(x, reference, context, &mut distances, v),
                            Distance::L1 => compare_responses::<T, true>(x, reference, context, &mut distances, v),
                        }
                        if (y0..y1).contains(&r) {
                            context.add(&mut tally, r, r - y0, &distances);
                        }
                        context.restrict(r, v.as_chunks_mut::<1>().0);
                    }
                }
            }
        }
        if !context.gradient || r < y0 + 2 {
            continue;
        }
        let y = r - 2;
        let ring = &ring;
        let v_out = |o: usize, row: usize| &ring[(row % RING * N + o) * padded..][..padded];
        let v_row = &mut v_rows[(y - y0) * width..][..width];
        correlate_row_bwd::<T, FMA, N>(v_out, &zeros, (y, height), &flipped_kernels, &mut reached, v_row);
    }
    tally
}

/// Distances of a row of responses and the gradients by them.
#[inline(always)]
fn compare_responses<T: Real, const L1: bool>(
    found: &[T],
    reference: Option<&[T]>,
    context: &Context<'_, T>,
    distances: &mut [T],
    v: &mut [T],
) {
    let scale = context.scale;
    let out = distances.iter_mut().zip(v);
    match reference {
        Some(reference) => {
            for ((d, v), (a, b)) in out.zip(found.iter().zip(reference)) {
                (*d, *v) = distance_of::<T, L1>(*a, *b, scale);
            }
        }
        None => {
            for ((d, v), a) in out.zip(found) {
                (*d, *v) = distance_of::<T, L1>(*a, T::ZERO, scale);
            }
        }
    }
}

/// Rows of cells spread over their samples: those of row i of cells at i mod 2, by filter, kept while rows of samples go
/// by.
struct SpreadRows<T> {
    width: usize,
    of: Vec<[usize; 2]>,
    rows: Vec<[T; 2]>,
    sums: Vec<[T; 2]>,
}

impl<T: Real> SpreadRows<T> {
    fn new(num_maps: usize, width: usize, source: Source<'_, T>) -> Self {
        let Source::Grids(_, pools) = source else {
            return Self { width, of: Vec::new(), rows: Vec::new(), sums: Vec::new() };
        };
        Self {
            width,
            of: vec![[usize::MAX; 2]; num_maps],
            rows: vec![[T::ZERO; 2]; num_maps * 2 * width],
            sums: vec![[T::ZERO; 2]; pools.x.area.num_cells()],
        }
    }

    /// ∂/∂x = Dᵀ of the gradients by the means + 2 x Dᵀ of those by the mean squares, for row `r` of map `o`.
    #[inline(always)]
    fn gradient_row<const FMA: bool>(
        &mut self,
        v_grids: &[T],
        pools: &Pools<T>,
        o: usize,
        r: usize,
        x: &[T],
        v: &mut [T],
    ) {
        let (width, num_maps, columns) = (self.width, self.of.len(), pools.x.area.num_cells());
        let cells = pools.y.area.cells_of(r);
        let of_cell = |i: usize| v_grids[(i * num_maps + o) * 2 * columns..][..2 * columns].as_chunks().0;
        let slots = &mut self.rows[o * 2 * width..][..2 * width];
        let num_slots = if cells.len() <= 2 {
            for i in cells.clone() {
                if self.of[o][i % 2] != i {
                    self.of[o][i % 2] = i;
                    pools.x.area.spread(of_cell(i), &mut slots[i % 2 * width..][..width]);
                }
            }
            cells.len()
        } else {
            self.sums.fill([T::ZERO; 2]);
            for i in cells.clone() {
                for (sum, v) in self.sums.as_flattened_mut().iter_mut().zip(of_cell(i).as_flattened()) {
                    *sum += *v;
                }
            }
            pools.x.area.spread(&self.sums, &mut slots[cells.start % 2 * width..][..width]);
            self.of[o][cells.start % 2] = usize::MAX;
            1
        };
        let (even, odd) = slots.split_at(width);
        let (one, two) = if cells.start.is_multiple_of(2) { (even, odd) } else { (odd, even) };
        if num_slots == 1 {
            for ((v, x), [m, q]) in v.iter_mut().zip(x).zip(one) {
                *v = fma::<T, FMA>(*x + *x, *q, *m);
            }
        } else {
            for (((v, x), [m, q]), [m2, q2]) in v.iter_mut().zip(x).zip(one).zip(two) {
                *v = fma::<T, FMA>(*x + *x, *q + *q2, *m + *m2);
            }
        }
    }
}
