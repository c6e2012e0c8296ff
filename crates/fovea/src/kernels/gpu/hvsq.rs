//! HVSQ of two images and its gradient, on a GPU. The mathematics, the passes and their order are those of
//! [`crate::kernels::cpu::hvsq`]; the three channels go through a pass together.
//!
//! Responses of a group of three filters are stored, and the gradient by them takes their place: with all that is made of
//! them they need less than twelve planes of three channels. A unit computes one value of the output of its pass. Sums over
//! pixels have three stages of fixed order: a unit's own pixels, the units of a workgroup by halves, and at the end all
//! workgroups of all passes by one, whose units add up with compensation and are then added by halves.
//!
//! **Ends.** Every pass compares its position with the size of its output. Planes have at least 32 × 32 pixels, their
//! levels at least 4 × 4 (2 × 2 the residual). NaN anywhere in the colours gives a value that is not finite.

mod compare;
mod gaze;
mod gradient;
mod regions;
mod statistics;
mod sweep;

pub(crate) use regions::Regions;

use crate::hvs::pooling::Pooling;
use crate::hvs::pyramid::{BAND_LEVELS, FilterBank, LEVELS};
use crate::kernels::cpu::hvsq::{Distance, enlarged};
use crate::kernels::cpu::pooling::Pools as HostPools;
use crate::kernels::gpu::pooling::Pools;
use crate::kernels::gpu::pyramid::{Filters, GROUP, Planes, Resize, correlate, halve};
use crate::kernels::gpu::{NUM_UNITS, reduced};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gaze::GazeLevel;
use gazesplat_render::Result;
use gazesplat_render::gpu::{Gpu, cube_dim};
use sweep::Sweep;

/// Everything about a comparison that does not depend on the colours.
#[derive(Clone)]
pub(crate) struct Plan {
    gpu: Gpu,
    resize: Resize,
    filters: Filters,
    distance: Distance,
    num_maps: usize,
    pooling: PlannedPooling,
}

#[derive(Clone)]
enum PlannedPooling {
    /// p = 1: HVSQ of the difference image.
    Linear,
    /// Pools of every level that has bands.
    Uniform(Vec<Pools>),
    Gaze(Vec<GazeLevel>),
}

/// What is kept of the image that others are compared with.
#[derive(Debug, Clone)]
pub(crate) enum Statistics {
    /// Its channels: p = 1 and the gaze-dependent form.
    Planes(Planes),
    /// Its pooled grids (or responses where pooling changes nothing).
    Uniform {
        high: CubeTensor,
        /// By level, by group of bands.
        bands: Vec<Vec<CubeTensor>>,
        residual: Box<Planes>,
    },
}

/// What is wanted besides the value.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Wanted<'a> {
    /// The gradient by the image.
    pub gradient: bool,
    /// The value of this region instead of that of the whole image.
    pub region: Option<&'a Regions>,
}

/// What a comparison found.
#[derive(Debug, Clone)]
pub(crate) struct Found {
    /// The value, `[1]`.
    pub value: CubeTensor,
    /// `[height, width, channels]` of the image; `None` when not wanted.
    pub v_image: Option<CubeTensor>,
}

/// How one level is compared.
#[derive(Debug, Clone)]
struct Context {
    distance: Distance,
    /// Factor of every distance and of its gradient.
    scale: f32,
    /// Weights of the region, `[height, width]`; `None` = the whole image.
    weights: Option<CubeTensor>,
    gradient: bool,
}

impl Context {
    /// The weights, or something that can be bound in their place.
    fn weights_or(&self, other: &CubeTensor) -> CubeTensor {
        self.weights.as_ref().unwrap_or(other).clone()
    }

    fn is_l1(&self) -> bool {
        self.distance == Distance::L1
    }
}

/// Sums of distances by workgroup, over all passes.
#[derive(Debug, Clone)]
struct Tally {
    sums: CubeTensor,
    num_sums: usize,
}

impl Tally {
    /// Reserves places for a pass of `num_units` units: the first of them.
    fn reserve(&mut self, num_units: usize) -> u32 {
        let first = self.num_sums;
        self.num_sums += num_units.div_ceil(NUM_UNITS);
        first as u32
    }
}

/// Checks that an adapter takes the largest buffer of a comparison of images of `size`: the chain of mips of one filter, or
/// the responses of a group of filters and the gradients along their rows of cells.
///
/// # Errors
/// [`gazesplat_render::Error::Limit`].
pub(crate) fn check_size(gpu: &Gpu, size: (usize, usize), pooling: &Pooling) -> Result<()> {
    let (width, height) = enlarged(size);
    let rows = match pooling {
        // Four values per sample, and mips take less than half of what they are made of.
        Pooling::Gaze(_) => 3 * 4 * height * 3 / 2,
        Pooling::Uniform { size_px } => 3 * GROUP * height.max(2 * (height as f64 / size_px) as usize),
    };
    gpu.check_size("bytes of responses of a pyramid", &[rows, width], DType::F32)
}

impl Plan {
    /// As [`crate::kernels::cpu::hvsq::Plan::new`], on an adapter.
    pub fn new(gpu: &Gpu, size: (usize, usize), bank: &FilterBank, pooling: &Pooling, distance: Distance) -> Self {
        let planes = enlarged(size);
        let level = |l: usize| (planes.0 >> l, planes.1 >> l);
        let pooling = match pooling {
            Pooling::Uniform { size_px } if *size_px == 1.0 => PlannedPooling::Linear,
            Pooling::Uniform { size_px } => {
                let cells = |n: usize| (n as f64 / size_px).floor() as usize;
                let cells = (cells(planes.0), cells(planes.1));
                let pools = (0..BAND_LEVELS).map(|l| Pools::new(gpu, &HostPools::new(level(l), cells)));
                PlannedPooling::Uniform(pools.collect())
            }
            Pooling::Gaze(gaze) => {
                PlannedPooling::Gaze((0..BAND_LEVELS).map(|l| GazeLevel::new(gpu, gaze, level(l))).collect())
            }
        };
        Self {
            gpu: gpu.clone(),
            resize: Resize::new(gpu, size, planes),
            filters: Filters::new(gpu, bank),
            distance,
            num_maps: bank.num_maps(),
            pooling,
        }
    }

    /// The adapter.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// Size of the planes.
    fn plane_size(&self, level: usize) -> (usize, usize) {
        (self.resize.to.0 >> level, self.resize.to.1 >> level)
    }

    /// What others are compared with, of an image `[height, width, 3 or more]`, contiguous.
    ///
    /// # Errors
    /// [`gazesplat_render::Error::Limit`] when a buffer would be larger than the adapter takes.
    pub fn statistics(&self, image: &CubeTensor) -> Result<Statistics> {
        let gpu = &self.gpu;
        let planes = self.resize.planes(gpu, image)?;
        let PlannedPooling::Uniform(pools) = &self.pooling else { return Ok(Statistics::Planes(planes)) };
        let levels = self.levels(&planes)?;
        let mut bands = Vec::with_capacity(BAND_LEVELS);
        for (pools, low) in pools.iter().zip(&levels) {
            let of_group = |group| statistics::of(gpu, &correlate(gpu, low, group)?, pools);
            bands.push(self.filters.bands.iter().map(of_group).collect::<Result<_>>()?);
        }
        let high = statistics::of(gpu, &correlate(gpu, &planes, &self.filters.high)?, &pools[0])?;
        Ok(Statistics::Uniform { high, bands, residual: Box::new(levels[LEVELS - 1].clone()) })
    }

    /// Low-passes of all levels.
    fn levels(&self, planes: &Planes) -> Result<Vec<Planes>> {
        let mut levels = vec![correlate(&self.gpu, planes, &self.filters.low)?];
        for l in 1..LEVELS {
            levels.push(halve(&self.gpu, &levels[l - 1])?);
        }
        Ok(levels)
    }

    /// Compares an image of [`Plan::size`], `[height, width, 3 or more]`, contiguous, with what is known of another.
    ///
    /// # Errors
    /// As [`Plan::statistics`].
    pub fn compare(&self, reference: &Statistics, image: &CubeTensor, wanted: Wanted<'_>) -> Result<Found> {
        let gpu = &self.gpu;
        let planes = self.resize.planes(gpu, image)?;
        let sums = gpu.empty("bytes of sums of distances", &[self.num_sums()], DType::F32)?;
        let mut sweep = Sweep { plan: self, wanted, tally: Tally { sums, num_sums: 0 } };
        let v_planes = match (reference, &self.pooling) {
            (Statistics::Uniform { high, bands, residual }, PlannedPooling::Uniform(pools)) => {
                sweep.uniform(&planes, (high, bands, residual), pools)?
            }
            (Statistics::Planes(others), PlannedPooling::Gaze(levels)) => sweep.gaze(&planes, others, levels)?,
            (Statistics::Planes(others), _) => sweep.linear(&planes, others)?,
            (Statistics::Uniform { .. }, _) => unreachable!("a reference is compared by the plan it was made by"),
        };
        let value = self.total(&sweep.tally)?;
        let channels = image.meta.shape()[2];
        let v_image = v_planes.map(|v| self.resize.planes_bwd(gpu, &v, channels)).transpose()?;
        Ok(Found { value, v_image })
    }

    /// Sums that a comparison leaves at most: a map has a unit per pixel, or per column and row of cells.
    fn num_sums(&self) -> usize {
        let of_level = |l: usize| {
            let (width, height) = self.plane_size(l);
            let rows = match &self.pooling {
                PlannedPooling::Uniform(pools) if l < BAND_LEVELS => pools[l].y.num_cells.max(height),
                _ => height,
            };
            // A pass of its own for every map at worst.
            self.num_maps * (3 * width * rows).div_ceil(NUM_UNITS)
        };
        (0..LEVELS).map(of_level).sum()
    }

    /// The sum of all that was tallied, `[1]`.
    fn total(&self, tally: &Tally) -> Result<CubeTensor> {
        let value = self.gpu.empty("bytes of a value", &[1], DType::F32)?;
        total_kernel::launch(
            &self.gpu.client,
            self.gpu.cubes(1),
            cube_dim(),
            tally.sums.clone().into_buffer_arg(),
            value.clone().into_buffer_arg(),
            tally.num_sums as u32,
        );
        Ok(value)
    }
}

impl Statistics {
    /// Memory of the values, bytes.
    pub fn num_bytes(&self) -> usize {
        match self {
            Self::Planes(planes) => planes.num_bytes(),
            Self::Uniform { high, bands, residual } => {
                let grids = bands.iter().flatten().chain([high]).map(|grid| grid.meta.num_elements());
                grids.sum::<usize>() * size_of::<f32>() + residual.num_bytes()
            }
        }
    }
}

/// `gradient` times the only value of `v_value`; both contiguous. In place unless `gradient` is shared.
pub(crate) fn scaled(gpu: &Gpu, gradient: CubeTensor, v_value: CubeTensor) -> CubeTensor {
    let gradient = if gradient.can_mut() { gradient } else { gradient.copy() };
    let len = gradient.meta.num_elements();
    scale_kernel::launch(
        &gpu.client,
        gpu.units(len),
        cube_dim(),
        gradient.clone().into_buffer_arg(),
        v_value.into_buffer_arg(),
        len as u32,
    );
    gradient
}

/// The image, contiguous, with the colours of `photo` where it says so; a word per pixel, red in the lowest byte, the
/// highest 0 where the colours are to be taken.
///
/// # Errors
/// [`gazesplat_render::Error::Limit`] when a buffer would be larger than the adapter takes.
pub(crate) fn unmasked(gpu: &Gpu, image: &CubeTensor, photo: &CubeTensor) -> Result<CubeTensor> {
    let shape: Vec<usize> = image.meta.shape().iter().copied().collect();
    let out = gpu.empty("bytes of an image", &shape, DType::F32)?;
    let len = image.meta.num_elements();
    unmasked_kernel::launch(
        &gpu.client,
        gpu.units(len),
        cube_dim(),
        image.clone().into_buffer_arg(),
        photo.clone().into_buffer_arg(),
        out.clone().into_buffer_arg(),
        shape[2] as u32,
        len as u32,
    );
    Ok(out)
}

/// Clears the gradient by an image, contiguous, where [`unmasked`] takes other colours.
pub(crate) fn unmasked_bwd(gpu: &Gpu, v_image: &CubeTensor, photo: &CubeTensor) {
    let len = v_image.meta.num_elements();
    unmasked_bwd_kernel::launch(
        &gpu.client,
        gpu.units(len),
        cube_dim(),
        v_image.clone().into_buffer_arg(),
        photo.clone().into_buffer_arg(),
        v_image.meta.shape()[2] as u32,
        len as u32,
    );
}

/// A distance and its derivative, up to the factor `scale` of the latter.
#[derive(CubeType)]
struct Distanced {
    value: f32,
    slope: f32,
}

#[cube]
fn distance_of(a: f32, b: f32, scale: f32, #[comptime] is_l1: bool) -> Distanced {
    let d = a - b;
    let mut value = d * d;
    let mut slope = (scale + scale) * d;
    if comptime![is_l1] {
        value = f32::abs(d);
        slope = 0.0_f32;
        if d > 0.0_f32 {
            slope = scale;
        } else if d < 0.0_f32 {
            slope = -scale;
        }
    }
    Distanced { value, slope }
}

/// Writes the sum over the units of this workgroup, times `scale`, to its place; every unit must call it.
#[cube]
fn tally_sum(sums: &mut [f32], sum: f32, first: u32, num_units: usize, scale: f32) {
    let mut shared = Shared::<[f32]>::new_slice(NUM_UNITS);
    let total = reduced(&mut shared, sum);
    if UNIT_POS == 0 && CUBE_POS < num_units.div_ceil(NUM_UNITS) {
        sums[first as usize + CUBE_POS] = total * scale;
    }
}

#[cube(launch)]
fn total_kernel(sums: &[f32], value: &mut [f32], len: u32) {
    let mut shared = Shared::<[f32]>::new_slice(NUM_UNITS);
    let mut sum = 0.0_f32;
    let mut lost = 0.0_f32;
    let mut i = UNIT_POS as usize;
    while i < len as usize {
        // What the sum is too coarse for is added to the next value (Kahan).
        let next = sums[i] - lost;
        let larger = sum + next;
        lost = (larger - sum) - next;
        sum = larger;
        i += NUM_UNITS;
    }
    let total = reduced(&mut shared, sum);
    if UNIT_POS == 0 && CUBE_POS == 0 {
        value[0] = total;
    }
}

#[cube(launch)]
fn scale_kernel(values: &mut [f32], factor: &[f32], len: u32) {
    if ABSOLUTE_POS < len as usize {
        values[ABSOLUTE_POS] *= factor[0];
    }
}

#[cube(launch)]
fn unmasked_kernel(image: &[f32], photo: &[u32], out: &mut [f32], channels: u32, len: u32) {
    if ABSOLUTE_POS < len as usize {
        let word = photo[ABSOLUTE_POS / channels as usize];
        let channel = (ABSOLUTE_POS % channels as usize) as u32;
        let mut value = image[ABSOLUTE_POS];
        if (word >> 24u32) == 0u32 && channel < 3 {
            value = f32::cast_from((word >> (8 * channel)) & 0xffu32) * (1.0_f32 / 255.0_f32);
        }
        out[ABSOLUTE_POS] = value;
    }
}

#[cube(launch)]
fn unmasked_bwd_kernel(v_image: &mut [f32], photo: &[u32], channels: u32, len: u32) {
    if ABSOLUTE_POS < len as usize && (photo[ABSOLUTE_POS / channels as usize] >> 24u32) == 0u32 {
        v_image[ABSOLUTE_POS] = 0.0_f32;
    }
}
