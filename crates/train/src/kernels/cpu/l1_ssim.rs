//! L1 and SSIM of an image against its target, with the gradient, on host slices.
//!
//! Wang 2004, Eq. 13 with the window of 3DGS: 11 × 11 Gaussian, σ 1.5, C1 = 0.01², C2 = 0.03², zero padding, population
//! moments, mean over pixels and colour channels. With x the image, y the target, μ their windowed means,
//! q = E\[x² + y²\] and p = E\[xy\]:
//!
//! S = A1·A2 / (B1·B2), A1 = 2 μx μy + C1, A2 = 2 (p − μx μy) + C2, B1 = μx² + μy² + C1, B2 = q − μx² − μy² + C2;
//! only the sum of the two variances occurs, so four windowed quantities are enough. The window is symmetric, so
//! ∂ΣS/∂x = blur(∂S/∂μx) + 2 x·blur(∂S/∂q) + y·blur(∂S/∂p).
//!
//! **Schedule.** One job is a band of about `BAND_ROWS` rows, cut into strips of `STRIP_COLUMNS`; rows stream through ring
//! buffers of 16 that stay in the L2 cache, so nothing of image size is written but the gradient. A row holds its three
//! channels one after the other, with their own halo, and every loop runs over all of it at once. Bands overlap by the
//! window: 10 rows in and 5 out on each side are recomputed. Sums are taken per band and added in band order, so the
//! result does not depend on the number of threads.
//!
//! **Mask.** A masked pixel (mask 0) takes the target's colour before the windows are formed, carries no L1 and no SSIM
//! value, and gets no gradient; means are over unmasked pixels. So neighbours see no difference there, and what the
//! model draws under a mask cannot matter.
//!
//! NaN in the image gives a NaN loss, which the trainer reports. An empty image has L1 0 and SSIM 1.

mod rows;
#[cfg(test)]
mod tests;

use gazesplat_render::simd::{Kernel, LANES, Simd, dispatch};
use rayon::prelude::*;
use rows::{blur_maps, blur_moments, gradient_row, load_row, ssim_maps};
use std::cell::RefCell;
use std::mem::MaybeUninit;

/// Half width of the window.
pub(crate) const RADIUS: usize = 5;
/// Width of the window.
pub(crate) const TAPS: usize = 2 * RADIUS + 1;
/// exp(−d²/(2·1.5²)), d = −5..5, normalised to sum 1.
pub(crate) const WINDOW: [f32; TAPS] = [
    0.001_028_380_1,
    0.007_598_758,
    0.036_000_773,
    0.109_360_695,
    0.213_005_54,
    0.266_011_72,
    0.213_005_54,
    0.109_360_695,
    0.036_000_773,
    0.007_598_758,
    0.001_028_380_1,
];
/// Keeps the ratio of means finite, (0.01 · range)².
pub(crate) const C1: f32 = 0.01 * 0.01;
/// Keeps the ratio of variances finite, (0.03 · range)².
pub(crate) const C2: f32 = 0.03 * 0.03;
/// Output rows of a job, about: the overlap costs a tenth more forward work, larger jobs would be too few for many cores.
const BAND_ROWS: usize = 96;
/// Output columns of a strip: the ring buffers take 0.5 MB, half of a usual L2 cache.
const STRIP_COLUMNS: usize = 512;
/// Rows of a ring buffer: 11 of the window, 5 older ones whose pixels the gradient still needs; a power of two.
const RING: usize = 16;

/// A component of a target colour.
pub trait TargetPixel: Copy + Send + Sync {
    /// The value on the scale 0..1.
    fn unit(self) -> f32;
}

impl TargetPixel for u8 {
    #[inline(always)]
    fn unit(self) -> f32 {
        f32::from(self) * (1.0 / 255.0)
    }
}

impl TargetPixel for f32 {
    #[inline(always)]
    fn unit(self) -> f32 {
        self
    }
}

/// An image and what it is compared with.
#[derive(Debug, Clone, Copy)]
pub struct Comparison<'a, P> {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Values per pixel of `image`, at least 3; the first three are RGB, the others carry no loss.
    pub channels: usize,
    /// `[height, width, channels]`.
    pub image: &'a [f32],
    /// `[height, width, 3]`.
    pub target: &'a [P],
    /// `[height, width]`, 0 = the pixel carries no loss.
    pub mask: Option<&'a [u8]>,
}

/// Means over unmasked pixels and the three colour channels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    /// Mean absolute difference.
    pub l1: f64,
    /// Mean structural similarity.
    pub ssim: f64,
}

/// Lane of [`Similarity::packed`] that carries the loss.
pub const LANE_LOSS: usize = 0;
/// Lane with the mean absolute difference.
pub const LANE_L1: usize = 1;
/// Lane with the mean SSIM.
pub const LANE_SSIM: usize = 2;

impl Similarity {
    /// The loss (1 − λ) L1 + λ (1 − SSIM) (3DGS, Eq. 7), L1 and SSIM; see the lanes. `ssim_weight` is λ, in 0..1.
    pub fn packed(&self, ssim_weight: f32) -> [f32; 3] {
        let w = f64::from(ssim_weight);
        let loss = (1.0 - w) * self.l1 + w * (1.0 - self.ssim);
        [loss as f32, self.l1 as f32, self.ssim as f32]
    }
}

/// Factors of the two terms of a loss `l1 · L1 + ssim · SSIM` whose gradient is wanted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weights {
    /// Factor of the mean absolute difference.
    pub l1: f32,
    /// Factor of the mean structural similarity (negative in a loss).
    pub ssim: f32,
}

impl Weights {
    /// Those of (1 − λ) L1 + λ (1 − SSIM); `ssim_weight` is λ, in 0..1.
    pub fn of_loss(ssim_weight: f32) -> Self {
        Self { l1: 1.0 - ssim_weight, ssim: -ssim_weight }
    }
}

/// L1 and SSIM of a comparison.
///
/// # Panics
/// If a slice does not have the size that `width`, `height` and `channels` promise.
pub fn similarity<P: TargetPixel>(comparison: &Comparison<'_, P>) -> Similarity {
    run(comparison, None)
}

/// L1 and SSIM of a comparison, and the gradient of `weights.l1 · L1 + weights.ssim · SSIM` with respect to the image,
/// `[height, width, channels]`, zero beyond RGB.
///
/// # Panics
/// If a slice does not have the size that `width`, `height` and `channels` promise.
pub fn similarity_and_gradient<P: TargetPixel>(
    comparison: &Comparison<'_, P>,
    weights: Weights,
) -> (Similarity, Vec<f32>) {
    let len = comparison.image.len();
    let mut v_image = Vec::with_capacity(len);
    let found = run(comparison, Some((weights, &mut v_image.spare_capacity_mut()[..len])));
    // SAFETY: `run` initialises all `len` values, whatever the mask.
    unsafe { v_image.set_len(len) };
    (found, v_image)
}

/// The bands of the gradient are initialised where they are computed: clearing the whole image first would run on one
/// thread and cost a sixth of the whole loss.
fn run<P: TargetPixel>(
    comparison: &Comparison<'_, P>,
    gradient: Option<(Weights, &mut [MaybeUninit<f32>])>,
) -> Similarity {
    let &Comparison { width, height, channels, image, target, mask } = comparison;
    assert!(channels >= 3, "an image has at least three channels, this one has {channels}");
    assert_eq!(image.len(), width * height * channels, "image size");
    assert_eq!(target.len(), width * height * 3, "target size");
    if let Some(mask) = mask {
        assert_eq!(mask.len(), width * height, "mask size");
    }
    let num_pixels = mask.map_or(width * height, |m| m.iter().filter(|&&v| v != 0).count());
    if num_pixels == 0 {
        if let Some((_, v_image)) = gradient {
            v_image.fill(MaybeUninit::new(0.0));
        }
        return Similarity { l1: 0.0, ssim: 1.0 };
    }
    let norm = 1.0 / (3.0 * num_pixels as f64);
    let band_rows = band_rows(height);
    let sums: Vec<(f64, f64)> = match gradient {
        Some((weights, v_image)) => {
            assert_eq!(v_image.len(), image.len(), "gradient size");
            let scaled = Weights { l1: weights.l1 * norm as f32, ssim: weights.ssim * norm as f32 };
            v_image
                .par_chunks_mut(band_rows * width * channels)
                .enumerate()
                .map(|(band, rows)| {
                    rows.fill(MaybeUninit::new(0.0));
                    // SAFETY: all of `rows` has just been written.
                    let rows = unsafe { rows.assume_init_mut() };
                    with_scratch(|scratch| {
                        let (y0, y1) = (band * band_rows, ((band + 1) * band_rows).min(height));
                        dispatch(BandPass {
                            comparison: *comparison,
                            rows: (y0, y1),
                            weights: scaled,
                            v_rows: rows,
                            scratch,
                        })
                    })
                })
                .collect()
        }
        None => (0..height.div_ceil(band_rows))
            .into_par_iter()
            .map(|band| {
                let none = Weights { l1: 0.0, ssim: 0.0 };
                with_scratch(|scratch| {
                    let (y0, y1) = (band * band_rows, ((band + 1) * band_rows).min(height));
                    dispatch(BandPass {
                        comparison: *comparison,
                        rows: (y0, y1),
                        weights: none,
                        v_rows: &mut [],
                        scratch,
                    })
                })
            })
            .collect(),
    };
    let (l1, ssim) = sums.iter().fold((0.0, 0.0), |(a, b), (l1, ssim)| (a + l1, b + ssim));
    Similarity { l1: l1 * norm, ssim: ssim * norm }
}

/// Rows of a band: the image in a multiple of four nearly equal parts, so that two or four cores end together.
fn band_rows(height: usize) -> usize {
    height.div_ceil((height / BAND_ROWS).next_multiple_of(4).max(1))
}

/// Runs `job` with this thread's scratch memory, which is kept between jobs: fresh memory of this size costs page faults.
fn with_scratch<R>(job: impl FnOnce(&mut Vec<f32>) -> R) -> R {
    thread_local!(static SCRATCH: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) });
    SCRATCH.with_borrow_mut(|scratch| job(scratch))
}

/// One band; its output are the sums of |x − y| and of SSIM. The gradient goes to `v_rows`, unless that is empty.
struct BandPass<'a, P> {
    comparison: Comparison<'a, P>,
    /// First row of the band, and the one behind its last.
    rows: (usize, usize),
    weights: Weights,
    v_rows: &'a mut [f32],
    scratch: &'a mut Vec<f32>,
}

impl<P: TargetPixel> Kernel for BandPass<'_, P> {
    type Output = (f64, f64);

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> (f64, f64) {
        let Self { comparison, rows, weights, v_rows, scratch } = self;
        let (mut l1, mut ssim) = (0.0, 0.0);
        let mut x0 = 0;
        while x0 < comparison.width {
            let x1 = (x0 + STRIP_COLUMNS).min(comparison.width);
            let sums = strip(simd, &comparison, (x0, x1), rows, weights, v_rows, scratch);
            l1 += sums.0;
            ssim += sums.1;
            x0 = x1;
        }
        (l1, ssim)
    }
}

/// One strip of one band. Column i of a raw row is image column x0 − 10 + i; of a map row x0 − 5 + i; of an output row
/// x0 + i. All three have stride `segment` between channels; what lies between the last column and the next channel
/// is finite and has weight 0.
#[inline(always)]
fn strip<S: Simd, P: TargetPixel>(
    simd: S,
    comparison: &Comparison<'_, P>,
    (x0, x1): (usize, usize),
    (y0, y1): (usize, usize),
    weights: Weights,
    v_rows: &mut [f32],
    scratch: &mut Vec<f32>,
) -> (f64, f64) {
    let &Comparison { width, height, channels, mask, .. } = comparison;
    let columns = x1 - x0;
    let segment = columns + 4 * RADIUS;
    let n = (3 * segment).next_multiple_of(LANES);
    // Horizontal windows read up to 10 values past their output.
    let stride = n + LANES;
    scratch.clear();
    scratch.resize((5 * RING + 4 + 4) * stride + LANES, 0.0);
    // Rows begin at cache lines: loads that straddle two cost twice.
    let aligned = scratch.as_ptr().align_offset(64).min(LANES);
    let scratch = &mut scratch[aligned..];
    let (raw_x, rest) = scratch.split_at_mut(RING * stride);
    let (raw_y, rest) = rest.split_at_mut(RING * stride);
    let (map_mu, rest) = rest.split_at_mut(RING * stride);
    let (map_q, rest) = rest.split_at_mut(RING * stride);
    let (map_p, rest) = rest.split_at_mut(RING * stride);
    let (blurred, rest) = rest.split_at_mut(4 * stride);
    let (inside, rest) = rest.split_at_mut(stride);
    let (map_weight, rest) = rest.split_at_mut(stride);
    let (own, v_row) = rest.split_at_mut(stride);
    for c in 0..3 {
        for i in 0..columns + 2 * RADIUS {
            let in_image = x0 + i >= RADIUS && x0 + i < width + RADIUS;
            inside[c * segment + i] = if in_image { 1.0 } else { 0.0 };
            own[c * segment + i] = if i >= RADIUS && i < columns + RADIUS { 1.0 } else { 0.0 };
        }
    }
    map_weight.copy_from_slice(inside);
    let slot = |r: isize| (r & (RING as isize - 1)) as usize * stride;
    let (mut l1_sum, mut ssim_sum) = (0.0, 0.0);
    let first = y0 as isize - RADIUS as isize;
    for r in first - RADIUS as isize..first + RADIUS as isize {
        load_row(comparison, r, x0, segment, &mut raw_x[slot(r)..][..n], &mut raw_y[slot(r)..][..n]);
    }
    for i in first..(y1 + RADIUS) as isize {
        let r = i + RADIUS as isize;
        load_row(comparison, r, x0, segment, &mut raw_x[slot(r)..][..n], &mut raw_y[slot(r)..][..n]);
        let at = slot(i);
        let maps = [&mut map_mu[at..][..n], &mut map_q[at..][..n], &mut map_p[at..][..n]];
        if i < 0 || i >= height as isize {
            maps.into_iter().for_each(|map| map.fill(0.0));
        } else {
            if let Some(mask) = mask {
                mask_weights(&mask[i as usize * width..][..width], x0, segment, inside, map_weight);
            }
            blur_moments(simd, raw_x, raw_y, &window_offsets(i, stride), n, stride, blurred);
            let sum = ssim_maps(simd, blurred, n, stride, map_weight, own, maps);
            if i >= y0 as isize && i < y1 as isize {
                ssim_sum += sum;
            }
        }
        // The output row whose window has just been completed.
        let out = i - RADIUS as isize;
        if out < y0 as isize {
            continue;
        }
        let x_row = &raw_x[slot(out)..][..stride];
        let y_row = &raw_y[slot(out)..][..stride];
        if !v_rows.is_empty() {
            blur_maps(simd, [map_mu, map_q, map_p], &window_offsets(out, stride), n, stride, blurred);
        }
        l1_sum += gradient_row(simd, blurred, n, stride, [x_row, y_row, own], weights, v_row);
        if v_rows.is_empty() {
            continue;
        }
        let masked = mask.map(|m| &m[out as usize * width..][..width]);
        let (v_r, rest) = v_row.split_at(segment);
        let (v_g, v_b) = rest.split_at(segment);
        let v_pixels =
            v_rows[((out as usize - y0) * width + x0) * channels..][..columns * channels].chunks_exact_mut(channels);
        for (((v_pixel, r), g), b) in v_pixels.zip(v_r).zip(v_g).zip(v_b) {
            (v_pixel[0], v_pixel[1], v_pixel[2]) = (*r, *g, *b);
        }
        if let Some(masked) = masked {
            let v_pixels = v_rows[((out as usize - y0) * width + x0) * channels..][..columns * channels]
                .chunks_exact_mut(channels);
            for (v_pixel, _) in v_pixels.zip(&masked[x0..]).filter(|(_, m)| **m == 0) {
                v_pixel.fill(0.0);
            }
        }
    }
    (l1_sum, ssim_sum)
}

/// Places in a ring of rows of the window around row `center`.
#[inline(always)]
fn window_offsets(center: isize, stride: usize) -> [usize; TAPS] {
    let mut offsets = [0; TAPS];
    for (k, offset) in offsets.iter_mut().enumerate() {
        let row = center + k as isize - RADIUS as isize;
        *offset = (row & (RING as isize - 1)) as usize * stride;
    }
    offsets
}

/// `inside` without the masked columns of this row.
#[inline(always)]
fn mask_weights(mask_row: &[u8], x0: usize, segment: usize, inside: &[f32], weights: &mut [f32]) {
    weights.copy_from_slice(inside);
    for c in 0..3 {
        for i in 0..segment - 2 * RADIUS {
            if (x0 + i).checked_sub(RADIUS).and_then(|column| mask_row.get(column)) == Some(&0) {
                weights[c * segment + i] = 0.0;
            }
        }
    }
}
