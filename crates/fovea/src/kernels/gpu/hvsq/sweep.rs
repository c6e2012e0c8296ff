//! The sweep over the levels, from the residual up: sums of distances and the gradient by the planes. Every map is dropped
//! before the next is made.

use super::gaze::GazeLevel;
use super::gradient::{self, Source};
use super::{Context, Plan, Tally, Wanted, compare, statistics};
use crate::hvs::pyramid::LEVELS;
use crate::kernels::gpu::pooling::Pools;
use crate::kernels::gpu::pyramid::{Group, Planes, correlate, correlate_bwd, halve_bwd};
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::Result;
use gazesplat_render::gpu::cube_dim;

/// Pooled grids of the high-pass, of the bands by level and group, and the residual.
type Reference<'a> = (&'a CubeTensor, &'a [Vec<CubeTensor>], &'a Planes);

/// Sums of a comparison on their way.
pub(super) struct Sweep<'a> {
    pub plan: &'a Plan,
    pub wanted: Wanted<'a>,
    pub tally: Tally,
}

impl Sweep<'_> {
    /// Values (or their weights) that a map of level `l` is the mean of.
    fn num_values(&self, l: usize) -> f64 {
        let (width, height) = self.plan.plane_size(l);
        3.0 * self.wanted.region.map_or((width * height) as f64, |r| r.totals[l])
    }

    fn context(&self, l: usize) -> Context {
        Context {
            distance: self.plan.distance,
            scale: (1.0 / (self.num_values(l) * self.plan.num_maps as f64)) as f32,
            weights: self.wanted.region.map(|r| r.weights[l].clone()),
            gradient: self.wanted.gradient,
        }
    }

    /// The uniform form; the gradient by the planes, `None` when not wanted.
    pub fn uniform(
        &mut self,
        planes: &Planes,
        (high, bands, residual): Reference<'_>,
        pools: &[Pools],
    ) -> Result<Option<Planes>> {
        let levels = self.plan.levels(planes)?;
        self.channels(
            &levels,
            Some(residual),
            |sweep, l, low, v_low| {
                for (group, other) in sweep.plan.filters.bands.iter().zip(&bands[l]) {
                    sweep.pooled_maps(l, low, &pools[l], group, other, v_low)?;
                }
                Ok(())
            },
            |sweep, v_planes| sweep.pooled_maps(0, planes, &pools[0], &sweep.plan.filters.high, high, v_planes),
        )
    }

    /// Pools of one pixel.
    pub fn linear(&mut self, planes: &Planes, reference: &Planes) -> Result<Option<Planes>> {
        let gpu = &self.plan.gpu;
        let difference = Planes::empty(gpu, planes.width, planes.height, planes.num_planes)?;
        difference_kernel::launch(
            &gpu.client,
            gpu.units(planes.len()),
            cube_dim(),
            planes.data.clone().into_buffer_arg(),
            reference.data.clone().into_buffer_arg(),
            difference.data.clone().into_buffer_arg(),
            planes.len() as u32,
        );
        let levels = self.plan.levels(&difference)?;
        self.channels(
            &levels,
            None,
            |sweep, l, low, v_low| {
                for group in &sweep.plan.filters.bands {
                    sweep.responses(l, low, group, None, v_low)?;
                }
                Ok(())
            },
            |sweep, v_planes| sweep.responses(0, &difference, &sweep.plan.filters.high, None, v_planes),
        )
    }

    /// The gaze-dependent form.
    pub fn gaze(&mut self, planes: &Planes, reference: &Planes, pools: &[GazeLevel]) -> Result<Option<Planes>> {
        let (levels, others) = (self.plan.levels(planes)?, self.plan.levels(reference)?);
        self.channels(
            &levels,
            Some(&others[LEVELS - 1]),
            |sweep, l, low, v_low| {
                for band in &sweep.plan.filters.single_bands {
                    sweep.gaze_map(l, [low, &others[l]], &pools[l], band, v_low)?;
                }
                Ok(())
            },
            |sweep, v_planes| sweep.gaze_map(0, [planes, reference], &pools[0], &sweep.plan.filters.high, v_planes),
        )
    }

    /// All channels from their residuals up. `bands` compares the bands of one level and adds to the gradient by its
    /// low-pass, `high` does so for the high-pass and the planes.
    fn channels(
        &mut self,
        levels: &[Planes],
        residual: Option<&Planes>,
        bands: impl Fn(&mut Self, usize, &Planes, Option<&Planes>) -> Result<()>,
        high: impl Fn(&mut Self, Option<&Planes>) -> Result<()>,
    ) -> Result<Option<Planes>> {
        let gpu = self.plan.gpu.clone();
        let last = LEVELS - 1;
        let context = self.context(last);
        // The gradient takes the place of what is compared: of a copy, since another level was made of the residual.
        let low = &levels[last];
        let v_residual = Planes { data: low.data.clone().copy(), ..low.clone() };
        gradient::compare_responses(&gpu, &v_residual, residual.map(|r| &r.data), &context, &mut self.tally);
        let mut v_low = context.gradient.then_some(v_residual);
        for l in (0..last).rev() {
            v_low = v_low.map(|v_half| halve_bwd(&gpu, &v_half)).transpose()?;
            bands(self, l, &levels[l], v_low.as_ref())?;
        }
        let v_planes = match &v_low {
            Some(v_low) => {
                let v_planes = Planes::zeros(&gpu, v_low.width, v_low.height, v_low.num_planes)?;
                correlate_bwd(&gpu, v_low, &self.plan.filters.low, &v_planes);
                Some(v_planes)
            }
            None => None,
        };
        high(self, v_planes.as_ref())?;
        Ok(v_planes)
    }

    fn pooled_maps(
        &mut self,
        l: usize,
        planes: &Planes,
        pools: &Pools,
        group: &Group,
        reference: &CubeTensor,
        v_planes: Option<&Planes>,
    ) -> Result<()> {
        if pools.is_identity() {
            return self.responses(l, planes, group, Some(reference), v_planes);
        }
        let gpu = &self.plan.gpu;
        let responses = correlate(gpu, planes, group)?;
        let grids = statistics::of(gpu, &responses, pools)?;
        let context = self.context(l);
        let num_maps = responses.num_planes;
        let v_grids = compare::grids(gpu, (&grids, reference), pools, num_maps, &context, &mut self.tally)?;
        if let Some(v_grids) = &v_grids {
            let source = Source::Grids(v_grids, pools);
            gradient::add(gpu, &responses, group, source, &context, &mut self.tally, v_planes);
        }
        Ok(())
    }

    fn responses(
        &mut self,
        l: usize,
        planes: &Planes,
        group: &Group,
        reference: Option<&CubeTensor>,
        v_planes: Option<&Planes>,
    ) -> Result<()> {
        let gpu = &self.plan.gpu;
        let responses = correlate(gpu, planes, group)?;
        let context = self.context(l);
        gradient::add(gpu, &responses, group, Source::Responses(reference), &context, &mut self.tally, v_planes);
        Ok(())
    }

    fn gaze_map(
        &mut self,
        l: usize,
        planes: [&Planes; 2],
        pools: &GazeLevel,
        filter: &Group,
        v_planes: Option<&Planes>,
    ) -> Result<()> {
        let gpu = &self.plan.gpu;
        let context = self.context(l);
        let v_responses = pools.compare(gpu, planes, filter, &context, &mut self.tally)?;
        if let (Some(v_responses), Some(v_planes)) = (&v_responses, v_planes) {
            correlate_bwd(gpu, v_responses, filter, v_planes);
        }
        Ok(())
    }
}

#[cube(launch)]
fn difference_kernel(a: &[f32], b: &[f32], difference: &mut [f32], len: u32) {
    if ABSOLUTE_POS < len as usize {
        difference[ABSOLUTE_POS] = a[ABSOLUTE_POS] - b[ABSOLUTE_POS];
    }
}
