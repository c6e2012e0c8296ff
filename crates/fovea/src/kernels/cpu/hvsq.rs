//! HVSQ of two images and its gradient, on host slices (RTGS Eq. 2 over the statistics of Walton 2021).
//!
//! HVSQ is the mean, over the means and standard deviations of all responses of a pyramid and its residual, of the mean
//! distance of that map between two images. Value and gradient come from one sweep over channels and levels; of one
//! level of one channel, all bands at once:
//!
//! 1. `statistics`: responses of the filters and their pooled grids D x and D x²;
//! 2. `compare`: U of the grids of both images, mean and standard deviation, distance, and the gradient by the grids;
//! 3. `gradient`: responses again (cheaper than keeping them), the gradient by them, and the adjoints of the filters.
//!
//! Where pooling changes nothing (p = 2^j from level j on) standard deviations are equal and the third pass compares the
//! responses; for p = 1 that is everywhere, HVSQ is linear before its distance, and the pyramid is taken of the difference
//! image. The gaze-dependent form replaces passes 1 and 2 by chains of mips (`gaze`).
//!
//! **Schedule.** A job is a band of rows of the output of its pass, compiled for the vector width of the machine; what
//! lies beyond the band is recomputed. Sums are taken per row in a fixed order, in `f64` from there, and added in band
//! order: the same bits on any number of threads. **Ends.** Planes have at least 32 × 32 pixels, their levels at least
//! 4 × 4 (2 × 2 the residual). NaN anywhere in the colours gives a value that is not finite.

mod compare;
pub(crate) mod gaze;
mod gradient;
mod regions;
mod statistics;
mod sweep;

#[cfg(test)]
mod tests;

pub use crate::kernels::cpu::pyramid::ImageView;
pub(crate) use regions::Regions;

use crate::hvs::pooling::{GazePooling, Pooling};
use crate::hvs::pyramid::{BAND_LEVELS, FilterBank, LEVELS, SIDE_MULTIPLE};
use crate::kernels::cpu::pooling::Pools;
use crate::kernels::cpu::pyramid::{Filters, Kernel, Plane, Resize, correlate_row, halve};
use crate::real::{Real, Task, dispatch, dot, sum};
use gaze::GazeLevel;
use sweep::Sweep;

/// Variances below this count as this: the square root has no slope at 0.
pub(crate) const MIN_VARIANCE: f64 = 1e-7;
/// Rows of a job.
const BAND_ROWS: usize = 32;

/// Distance between two values of a map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Distance {
    /// Squared difference: guards and reported values.
    #[default]
    Mse,
    /// Absolute difference: training.
    L1,
}

/// Everything about a comparison that does not depend on the colours.
#[derive(Debug, Clone)]
pub(crate) struct Plan<T> {
    resize: Resize<T>,
    filters: Filters<T>,
    distance: Distance,
    num_maps: usize,
    pooling: PlannedPooling<T>,
}

#[derive(Debug, Clone)]
enum PlannedPooling<T> {
    /// p = 1: HVSQ of the difference image.
    Linear,
    /// Pools of every level that has bands.
    Uniform(Vec<Pools<T>>),
    Gaze(Vec<GazeLevel<T>>),
}

/// What is kept of the image that others are compared with.
#[derive(Debug, Clone)]
pub(crate) enum Statistics<T> {
    /// Its channels: p = 1 and the gaze-dependent form.
    Planes([Plane<T>; 3]),
    /// Its pooled grids, by channel.
    Uniform(Vec<ChannelStatistics<T>>),
}

/// Pooled grids (or responses where pooling changes nothing) of one channel.
#[derive(Debug, Clone)]
pub(crate) struct ChannelStatistics<T> {
    high: Vec<T>,
    /// By level, by group of bands.
    bands: Vec<Vec<Vec<T>>>,
    residual: Plane<T>,
}

/// What is wanted besides the value.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Wanted<'a, T> {
    /// The gradient by the image.
    pub gradient: bool,
    /// The distance of every pixel.
    pub map: bool,
    /// Values of these regions instead of that of the whole image; at most one when a gradient is wanted.
    pub regions: Option<&'a Regions<T>>,
}

/// What a comparison found.
#[derive(Debug, Clone)]
pub(crate) struct Found<T> {
    /// The value of the whole image, or of every region (NaN of an empty one).
    pub values: Vec<f64>,
    /// `[height, width, channels]` of the image; empty when not wanted.
    pub v_image: Vec<T>,
    /// `[height, width]` of the image; empty when not wanted.
    pub map: Vec<T>,
}

/// How one level is compared.
#[derive(Debug, Clone, Copy)]
struct Context<'a, T> {
    distance: Distance,
    /// Factor of the gradient of every distance.
    scale: T,
    /// Weights of the regions, `[height, width]` each; empty = the whole image.
    weights: &'a [Vec<T>],
    gradient: bool,
    map: bool,
}

/// Sums of distances over some rows.
#[derive(Debug, Clone)]
struct Tally<T> {
    /// The whole image, or every region.
    sums: Vec<f64>,
    /// Distances of the rows, added over the maps; empty when not wanted.
    rows: Vec<T>,
}

impl<T: Real> Context<'_, T> {
    fn tally(&self, rows: usize, width: usize) -> Tally<T> {
        let len = if self.map { rows * width } else { 0 };
        Tally { sums: vec![0.0; self.weights.len().max(1)], rows: vec![T::ZERO; len] }
    }

    /// Adds the distances of row `y`, the `index`-th row of the tally.
    #[inline(always)]
    fn add(&self, tally: &mut Tally<T>, y: usize, index: usize, distances: &[T]) {
        let width = distances.len();
        if self.weights.is_empty() {
            tally.sums[0] += sum(distances);
        }
        for (total, weights) in tally.sums.iter_mut().zip(self.weights) {
            *total += dot(&weights[y * width..][..width], distances);
        }
        if self.map {
            for (total, d) in tally.rows[index * width..][..width].iter_mut().zip(distances) {
                *total += *d;
            }
        }
    }

    /// Restricts gradients of row `y`, `N` per pixel, to the region they are of.
    #[inline(always)]
    fn restrict<const N: usize>(&self, y: usize, v: &mut [[T; N]]) {
        let width = v.len();
        if let [weights] = self.weights {
            for (v, w) in v.iter_mut().zip(&weights[y * width..][..width]) {
                for v in v {
                    *v *= *w;
                }
            }
        }
    }
}

/// Distance and its derivative, up to the factor `scale` of the latter.
#[inline(always)]
fn distance_of<T: Real, const L1: bool>(a: T, b: T, scale: T) -> (T, T) {
    let d = a - b;
    if L1 {
        let sign = if d > T::ZERO {
            scale
        } else if d < T::ZERO {
            -scale
        } else {
            T::ZERO
        };
        (d.abs(), sign)
    } else {
        (d * d, (scale + scale) * d)
    }
}

/// Cuts filters into groups that one pass applies at once.
fn groups<T>(kernels: &[Kernel<T>]) -> Vec<&[Kernel<T>]> {
    let mut rest = kernels;
    let mut groups = Vec::new();
    while !rest.is_empty() {
        let (group, others) = rest.split_at(match rest.len() {
            6.. => 6,
            2.. => 2,
            _ => 1,
        });
        groups.push(group);
        rest = others;
    }
    groups
}

/// Calls `$f::<T, FMA, N>($args)` with N the size of a group.
macro_rules! by_group {
    ($n:expr, $f:ident::<$t:ty, $fma:ident>($($arg:expr),* $(,)?)) => {
        match $n {
            6 => $f::<$t, $fma, 6>($($arg),*),
            2 => $f::<$t, $fma, 2>($($arg),*),
            _ => $f::<$t, $fma, 1>($($arg),*),
        }
    };
}
pub(crate) use by_group;

/// Size of the planes an image of this size is enlarged to.
pub(crate) fn enlarged((width, height): (usize, usize)) -> (usize, usize) {
    (width.next_multiple_of(SIDE_MULTIPLE), height.next_multiple_of(SIDE_MULTIPLE))
}

impl<T: Real> Plan<T> {
    /// For images of `size` (width, height), at least 1 × 1. A uniform pooling size must be at most the shorter enlarged
    /// side.
    pub fn new(size: (usize, usize), bank: &FilterBank, pooling: &Pooling, distance: Distance) -> Self {
        let planes = enlarged(size);
        let level = |l: usize| (planes.0 >> l, planes.1 >> l);
        let pooling = match pooling {
            Pooling::Uniform { size_px } if *size_px == 1.0 => PlannedPooling::Linear,
            Pooling::Uniform { size_px } => {
                let cells = |n: usize| (n as f64 / size_px).floor() as usize;
                let cells = (cells(planes.0), cells(planes.1));
                PlannedPooling::Uniform((0..BAND_LEVELS).map(|l| Pools::new(level(l), cells)).collect())
            }
            Pooling::Gaze(gaze) => Self::gaze(gaze, (0..BAND_LEVELS).map(level)),
        };
        let (resize, filters) = (Resize::new(size, planes), Filters::new(bank));
        Self { resize, filters, distance, num_maps: bank.num_maps(), pooling }
    }

    fn gaze(gaze: &GazePooling, levels: impl Iterator<Item = (usize, usize)>) -> PlannedPooling<T> {
        PlannedPooling::Gaze(levels.map(|size| GazeLevel::new(gaze, size)).collect())
    }

    /// Size of the images: width, height.
    #[cfg(test)]
    pub fn size(&self) -> (usize, usize) {
        self.resize.from
    }

    /// Size of the planes.
    fn plane_size(&self, level: usize) -> (usize, usize) {
        (self.resize.to.0 >> level, self.resize.to.1 >> level)
    }

    /// What others are compared with.
    pub fn statistics(&self, image: &ImageView<'_, T>) -> Statistics<T> {
        let planes = self.resize.planes(image);
        let PlannedPooling::Uniform(pools) = &self.pooling else { return Statistics::Planes(planes) };
        let of_channel = |plane: &Plane<T>| {
            let levels = self.levels(plane);
            let bands = pools.iter().zip(&levels).map(|(pools, low)| {
                let of_group = |kernels| statistics::of(low, pools, kernels, self.filters.antisymmetric);
                groups(&self.filters.bands).into_iter().map(of_group).collect()
            });
            ChannelStatistics {
                high: statistics::of(plane, &pools[0], &[self.filters.high], false),
                bands: bands.collect(),
                residual: levels[LEVELS - 1].clone(),
            }
        };
        Statistics::Uniform(planes.iter().map(of_channel).collect())
    }

    /// Low-passes of all levels of a channel.
    fn levels(&self, plane: &Plane<T>) -> Vec<Plane<T>> {
        let mut low = Plane::zeros(plane.width, plane.height);
        let kernel = [self.filters.low];
        low.fill_rows(|y, row| dispatch(LowPass { plane, y, kernel: &kernel, row }));
        let mut levels = vec![low];
        for l in 1..LEVELS {
            levels.push(halve(&levels[l - 1]));
        }
        levels
    }

    /// Compares an image of [`Plan::size`] with what is known of another.
    pub fn compare(&self, reference: &Statistics<T>, image: &ImageView<'_, T>, wanted: Wanted<'_, T>) -> Found<T> {
        let planes = self.resize.planes(image);
        let num_values = wanted.regions.map_or(1, Regions::num_regions);
        let mut sweep = Sweep {
            plan: self,
            wanted,
            sums: vec![vec![0.0; num_values]; LEVELS],
            maps: (0..LEVELS).map(|l| self.plane_size(l)).map(|(w, h)| vec![T::ZERO; w * h]).collect(),
            scratch: gaze::Scratch::default(),
        };
        if !wanted.map {
            sweep.maps.clear();
        }
        let mut v_planes: [Vec<T>; 3] = Default::default();
        for (c, (plane, v_plane)) in planes.into_iter().zip(&mut v_planes).enumerate() {
            *v_plane = match (reference, &self.pooling) {
                (Statistics::Uniform(channels), PlannedPooling::Uniform(pools)) => {
                    sweep.uniform(&plane, &channels[c], pools)
                }
                (Statistics::Planes(others), PlannedPooling::Gaze(levels)) => sweep.gaze(&plane, &others[c], levels),
                (Statistics::Planes(others), _) => sweep.linear(&plane, &others[c]),
                (Statistics::Uniform(_), _) => unreachable!("a reference is compared by the plan it was made by"),
            };
        }
        let values = (0..num_values).map(|k| {
            let mean = |l: usize| sweep.sums[l][k] / sweep.num_values(l, k);
            (0..LEVELS).map(mean).sum::<f64>() / self.num_maps as f64
        });
        let values = values.collect();
        let map = sweep.map();
        let v_image = if wanted.gradient { self.resize.planes_bwd(&mut v_planes, image.channels) } else { Vec::new() };
        Found { values, v_image, map }
    }
}

/// One row of the low-pass.
struct LowPass<'a, T> {
    plane: &'a Plane<T>,
    y: usize,
    kernel: &'a [Kernel<T>; 1],
    row: &'a mut [T],
}

impl<T: Real> Task for LowPass<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        correlate_row::<T, FMA, 1>(self.plane, self.y, self.kernel, false, self.row);
    }
}

impl<T: Real> Statistics<T> {
    /// Memory of the values, bytes.
    pub fn num_bytes(&self) -> usize {
        let of_plane = |plane: &Plane<T>| plane.num_bytes();
        match self {
            Self::Planes(planes) => planes.iter().map(of_plane).sum(),
            Self::Uniform(channels) => {
                let of_channel = |c: &ChannelStatistics<T>| {
                    let bands: usize = c.bands.iter().flatten().map(Vec::len).sum();
                    (c.high.len() + bands) * size_of::<T>() + c.residual.num_bytes()
                };
                channels.iter().map(of_channel).sum()
            }
        }
    }
}
