//! The sweep over the levels of one channel, from the residual up: sums of distances, the distance of every pixel, and the
//! gradient by the channel. Every map is dropped before the next is made.

use super::gaze::{self, GazeLevel};
use super::gradient::{self, Source};
use super::{ChannelStatistics, Context, Distance, Plan, Tally, Wanted, compare, distance_of, groups, statistics};
use crate::hvs::pyramid::LEVELS;
use crate::kernels::cpu::pooling::{Bilinear, Pools};
use crate::kernels::cpu::pyramid::{Kernel, Plane, halve_bwd};
use crate::real::Real;

/// Sums of a comparison on their way.
pub(super) struct Sweep<'a, T> {
    pub plan: &'a Plan<T>,
    pub wanted: Wanted<'a, T>,
    /// By level, by region.
    pub sums: Vec<Vec<f64>>,
    /// By level, over channels and maps; empty when not wanted.
    pub maps: Vec<Vec<T>>,
    /// Of the gaze-dependent form.
    pub scratch: gaze::Scratch<T>,
}

impl<T: Real> Sweep<'_, T> {
    /// Values (or their weights) that a map of level `l` is the mean of.
    pub fn num_values(&self, l: usize, region: usize) -> f64 {
        let (width, height) = self.plan.plane_size(l);
        3.0 * self.wanted.regions.map_or((width * height) as f64, |r| r.totals[l][region])
    }

    fn context(&self, l: usize) -> Context<'_, T> {
        Context {
            distance: self.plan.distance,
            scale: T::of(1.0 / (self.num_values(l, 0) * self.plan.num_maps as f64)),
            weights: self.wanted.regions.map_or(&[], |r| &r.weights[l]),
            gradient: self.wanted.gradient,
            map: self.wanted.map,
        }
    }

    /// Adds tallies of level `l`, of adjacent bands of rows.
    fn add(&mut self, l: usize, tallies: Vec<Tally<T>>) {
        let mut at = 0;
        for tally in tallies {
            for (total, sum) in self.sums[l].iter_mut().zip(&tally.sums) {
                *total += sum;
            }
            if self.wanted.map {
                for (total, d) in self.maps[l][at..].iter_mut().zip(&tally.rows) {
                    *total += *d;
                }
                at += tally.rows.len();
            }
        }
    }

    /// A gradient by a plane of level `l`; empty when none is wanted.
    fn gradient_plane(&self, l: usize) -> Vec<T> {
        let (width, height) = self.plan.plane_size(l);
        if self.wanted.gradient { vec![T::ZERO; width * height] } else { Vec::new() }
    }

    /// A channel of the uniform form.
    pub fn uniform(&mut self, plane: &Plane<T>, reference: &ChannelStatistics<T>, pools: &[Pools<T>]) -> Vec<T> {
        let levels = self.plan.levels(plane);
        let bands = &self.plan.filters.bands;
        self.channel(
            plane,
            &levels,
            Some(&reference.residual),
            |sweep, l, low, v_low| {
                for (kernels, other) in groups(bands).into_iter().zip(&reference.bands[l]) {
                    sweep.pooled_maps(l, low, &pools[l], kernels, other, v_low);
                }
            },
            |sweep, v_plane| {
                let high = [sweep.plan.filters.high];
                sweep.pooled_maps(0, plane, &pools[0], &high, &reference.high, v_plane);
            },
        )
    }

    /// A channel with pools of one pixel.
    pub fn linear(&mut self, plane: &Plane<T>, reference: &Plane<T>) -> Vec<T> {
        let mut difference = Plane::zeros(plane.width, plane.height);
        difference.fill_rows(|y, row| {
            for ((d, a), b) in row.iter_mut().zip(plane.row(y)).zip(reference.row(y)) {
                *d = *a - *b;
            }
        });
        let levels = self.plan.levels(&difference);
        let bands = &self.plan.filters.bands;
        self.channel(
            &difference,
            &levels,
            None,
            |sweep, l, low, v_low| {
                for kernels in groups(bands) {
                    sweep.responses(l, low, kernels, Source::Responses(None), v_low);
                }
            },
            |sweep, v_plane| {
                sweep.responses(0, &difference, &[sweep.plan.filters.high], Source::Responses(None), v_plane);
            },
        )
    }

    /// A channel of the gaze-dependent form.
    pub fn gaze(&mut self, plane: &Plane<T>, reference: &Plane<T>, pools: &[GazeLevel<T>]) -> Vec<T> {
        let (levels, others) = (self.plan.levels(plane), self.plan.levels(reference));
        let bands = &self.plan.filters.bands;
        self.channel(
            plane,
            &levels,
            Some(&others[LEVELS - 1]),
            |sweep, l, low, v_low| {
                for kernel in bands {
                    sweep.gaze_map(l, [low, &others[l]], &pools[l], kernel, v_low);
                }
            },
            |sweep, v_plane| {
                sweep.gaze_map(0, [plane, reference], &pools[0], &sweep.plan.filters.high, v_plane);
            },
        )
    }

    /// One channel from its residual up; the gradient by its plane, empty when none is wanted. `bands` compares the bands
    /// of one level and adds to the gradient by its low-pass, `high` does so for the high-pass and the plane.
    fn channel(
        &mut self,
        plane: &Plane<T>,
        levels: &[Plane<T>],
        residual: Option<&Plane<T>>,
        bands: impl Fn(&mut Self, usize, &Plane<T>, &mut [T]),
        high: impl Fn(&mut Self, &mut [T]),
    ) -> Vec<T> {
        let last = LEVELS - 1;
        let mut v_low = self.gradient_plane(last);
        self.residual(&levels[last], residual, &mut v_low);
        for l in (0..last).rev() {
            let v_half = std::mem::replace(&mut v_low, self.gradient_plane(l));
            if self.wanted.gradient {
                halve_bwd(&v_half, &mut v_low, levels[l].width);
            }
            bands(self, l, &levels[l], &mut v_low);
        }
        let mut v_plane = self.gradient_plane(0);
        if self.wanted.gradient {
            gradient::add(plane, &[self.plan.filters.low], false, Source::Rows(&v_low), &self.context(0), &mut v_plane);
        }
        high(self, &mut v_plane);
        v_plane
    }

    fn residual(&mut self, low: &Plane<T>, reference: Option<&Plane<T>>, v_low: &mut [T]) {
        let context = self.context(LEVELS - 1);
        let width = low.width;
        let mut tally = context.tally(low.height, width);
        let mut distances = vec![T::ZERO; width];
        let mut v_row = vec![T::ZERO; width];
        for y in 0..low.height {
            for x in 0..width {
                let (a, b) = (low.row(y)[x], reference.map_or(T::ZERO, |r| r.row(y)[x]));
                (distances[x], v_row[x]) = match context.distance {
                    Distance::Mse => distance_of::<T, false>(a, b, context.scale),
                    Distance::L1 => distance_of::<T, true>(a, b, context.scale),
                };
            }
            context.add(&mut tally, y, y, &distances);
            if context.gradient {
                context.restrict(y, v_row.as_chunks_mut::<1>().0);
                v_low[y * width..][..width].copy_from_slice(&v_row);
            }
        }
        self.add(LEVELS - 1, vec![tally]);
    }

    fn pooled_maps(
        &mut self,
        l: usize,
        plane: &Plane<T>,
        pools: &Pools<T>,
        kernels: &[Kernel<T>],
        reference: &[T],
        v_plane: &mut [T],
    ) {
        if pools.is_identity() {
            return self.responses(l, plane, kernels, Source::Responses(Some(reference)), v_plane);
        }
        let antisymmetric = self.plan.filters.antisymmetric && kernels.len() > 1;
        let grids = statistics::of(plane, pools, kernels, antisymmetric);
        let context = self.context(l);
        let (tallies, v_grids) = compare::grids(&grids, reference, pools, kernels.len(), &context);
        drop(grids);
        if context.gradient {
            gradient::add(plane, kernels, antisymmetric, Source::Grids(&v_grids, pools), &context, v_plane);
        }
        self.add(l, tallies);
    }

    fn responses(
        &mut self,
        l: usize,
        plane: &Plane<T>,
        kernels: &[Kernel<T>],
        source: Source<'_, T>,
        v_plane: &mut [T],
    ) {
        let antisymmetric = self.plan.filters.antisymmetric && kernels.len() > 1;
        let tallies = gradient::add(plane, kernels, antisymmetric, source, &self.context(l), v_plane);
        self.add(l, tallies);
    }

    fn gaze_map(
        &mut self,
        l: usize,
        planes: [&Plane<T>; 2],
        pools: &GazeLevel<T>,
        kernel: &Kernel<T>,
        v_plane: &mut [T],
    ) {
        let mut scratch = std::mem::take(&mut self.scratch);
        let context = self.context(l);
        let (tallies, v_responses) = pools.compare(planes, kernel, &context, &mut scratch);
        if context.gradient {
            gradient::add(planes[0], &[*kernel], false, Source::Rows(v_responses), &context, v_plane);
        }
        self.scratch = scratch;
        self.add(l, tallies);
    }

    /// The mean distance of every pixel of the image.
    pub fn map(&self) -> Vec<T> {
        if self.maps.is_empty() {
            return Vec::new();
        }
        let (width, height) = self.plan.resize.to;
        let mut total = vec![T::ZERO; width * height];
        for (l, map) in self.maps.iter().enumerate() {
            let level = enlarge(map, self.plan.plane_size(l), (width, height));
            total.iter_mut().zip(level).for_each(|(t, v)| *t += v);
        }
        let scale = T::of(1.0 / (3 * self.plan.num_maps) as f64);
        total.iter_mut().for_each(|t| *t *= scale);
        enlarge(&total, (width, height), self.plan.resize.from)
    }
}

/// Bilinear interpolation of a map, half-pixel centres.
fn enlarge<T: Real>(values: &[T], from: (usize, usize), to: (usize, usize)) -> Vec<T> {
    let (columns, rows) = (Bilinear::<T>::new(to.0, from.0), Bilinear::<T>::new(to.1, from.1));
    let mut out = vec![T::ZERO; to.0 * to.1];
    let mut mixed = vec![T::ZERO; from.0];
    for (y, row) in out.chunks_exact_mut(to.0).enumerate() {
        let (upper, lower, w) = rows.source(y);
        let row_of = |r: usize| &values[r * from.0..][..from.0];
        for ((m, a), b) in mixed.iter_mut().zip(row_of(upper)).zip(row_of(lower)) {
            *m = *a + w * (*b - *a);
        }
        columns.enlarge(&mixed, row);
    }
    out
}
