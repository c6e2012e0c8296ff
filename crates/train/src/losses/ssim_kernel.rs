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
//! **Schedule.** One job is a band of about [`BAND_ROWS`] rows, cut into strips of [`STRIP_COLUMNS`]; rows stream through ring
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

use gazesplat_render::simd::{Kernel, LANES, Simd, dispatch};
use rayon::prelude::*;
use std::cell::RefCell;
use std::mem::MaybeUninit;

/// Half width of the window.
const RADIUS: usize = 5;
/// Width of the window.
const TAPS: usize = 2 * RADIUS + 1;
/// exp(−d²/(2·1.5²)), d = −5..5, normalised to sum 1.
const WINDOW: [f32; TAPS] = [
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
const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
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

/// Factors of the two terms of a loss `l1 · L1 + ssim · SSIM` whose gradient is wanted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weights {
    /// Factor of the mean absolute difference.
    pub l1: f32,
    /// Factor of the mean structural similarity (negative in a loss).
    pub ssim: f32,
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

/// Row `r` of both images by channel, zero outside them; masked pixels take the target's colour.
#[inline(always)]
fn load_row<P: TargetPixel>(
    comparison: &Comparison<'_, P>,
    r: isize,
    x0: usize,
    segment: usize,
    x_row: &mut [f32],
    y_row: &mut [f32],
) {
    let &Comparison { width, height, channels, image, target, mask } = comparison;
    // Columns outside the image are zero from the start: nothing writes them.
    if r < 0 || r >= height as isize {
        x_row.fill(0.0);
        y_row.fill(0.0);
        return;
    }
    let r = r as usize;
    let from = x0.saturating_sub(2 * RADIUS);
    let to = (x0 + segment - 2 * RADIUS).min(width);
    let shift = from + 2 * RADIUS - x0;
    let pixels = &image[(r * width + from) * channels..][..(to - from) * channels];
    let colors = &target[(r * width + from) * 3..][..(to - from) * 3];
    // The usual widths as constants: the compiler then separates channels with shuffles.
    match channels {
        4 => separate::<4, f32>(pixels, segment, shift, x_row),
        5 => separate::<5, f32>(pixels, segment, shift, x_row),
        _ => {
            for (j, pixel) in pixels.chunks_exact(channels).enumerate() {
                for c in 0..3 {
                    x_row[c * segment + shift + j] = pixel[c];
                }
            }
        }
    }
    separate::<3, P>(colors, segment, shift, y_row);
    if let Some(mask) = mask {
        for (j, _) in mask[r * width + from..][..to - from].iter().enumerate().filter(|(_, m)| **m == 0) {
            for at in [shift + j, segment + shift + j, 2 * segment + shift + j] {
                x_row[at] = y_row[at];
            }
        }
    }
}

/// The first three of every `C` values, each to its channel of `row` from `shift` on.
#[inline(always)]
fn separate<const C: usize, P: TargetPixel>(pixels: &[P], segment: usize, shift: usize, row: &mut [f32]) {
    let (r, rest) = row.split_at_mut(segment);
    let (g, b) = rest.split_at_mut(segment);
    let num_pixels = pixels.len() / C;
    let (r, g, b) = (&mut r[shift..][..num_pixels], &mut g[shift..][..num_pixels], &mut b[shift..][..num_pixels]);
    let (blocks, tail) = pixels.split_at(num_pixels / LANES * LANES * C);
    let whole = blocks.len() / C;
    for (channel, out) in [&mut *r, &mut *g, &mut *b].into_iter().enumerate() {
        for (block, out) in blocks.chunks_exact(LANES * C).zip(out.chunks_exact_mut(LANES)) {
            for lane in 0..LANES {
                out[lane] = block[lane * C + channel].unit();
            }
        }
        for (pixel, out) in tail.chunks_exact(C).zip(&mut out[whole..]) {
            *out = pixel[channel].unit();
        }
    }
}

/// The sixteen values from `i` on.
#[inline(always)]
fn lanes(values: &[f32], i: usize) -> &[f32; LANES] {
    debug_assert!(i + LANES <= values.len());
    // SAFETY: callers step through `n` values of rows that hold `n + LANES`, with shifts of at most 10; `strip` sizes
    // them. Bounds checks here would double the number of instructions of the inner loops.
    unsafe { &*values.as_ptr().add(i).cast() }
}

/// The sixteen values from `i` on, for writing.
#[inline(always)]
fn lanes_mut(values: &mut [f32], i: usize) -> &mut [f32; LANES] {
    debug_assert!(i + LANES <= values.len());
    // SAFETY: as in `lanes`.
    unsafe { &mut *values.as_mut_ptr().add(i).cast() }
}

/// Vertical windows of x, y, x² + y² and xy over 11 raw rows.
#[inline(always)]
fn blur_moments<S: Simd>(
    simd: S,
    raw_x: &[f32],
    raw_y: &[f32],
    offsets: &[usize; TAPS],
    n: usize,
    stride: usize,
    blurred: &mut [f32],
) {
    for i in (0..n).step_by(LANES) {
        let zero = simd.splat(0.0);
        let (mut a, mut b, mut q, mut p) = (zero, zero, zero, zero);
        for (k, w) in WINDOW.into_iter().enumerate() {
            let w = simd.splat(w);
            let x = simd.load(lanes(raw_x, offsets[k] + i));
            let y = simd.load(lanes(raw_y, offsets[k] + i));
            let (wx, wy) = (simd.mul(w, x), simd.mul(w, y));
            a = simd.add(a, wx);
            b = simd.add(b, wy);
            q = simd.fma(wx, x, simd.fma(wy, y, q));
            p = simd.fma(wx, y, p);
        }
        for (quantity, value) in [a, b, q, p].into_iter().enumerate() {
            simd.store(value, lanes_mut(blurred, quantity * stride + i));
        }
    }
}

/// Horizontal windows, SSIM and its derivatives by μx, q and p, times `weight`; returns the sum of SSIM times
/// `weight · own`.
#[inline(always)]
fn ssim_maps<S: Simd>(
    simd: S,
    blurred: &[f32],
    n: usize,
    stride: usize,
    weight: &[f32],
    own: &[f32],
    maps: [&mut [f32]; 3],
) -> f64 {
    let [v_mu, v_q, v_p] = maps;
    let (two, c1, c2) = (simd.splat(2.0), simd.splat(C1), simd.splat(C2));
    let mut sum = simd.splat(0.0);
    for i in (0..n).step_by(LANES) {
        let zero = simd.splat(0.0);
        let (mut mx, mut my, mut q, mut p) = (zero, zero, zero, zero);
        for (k, w) in WINDOW.into_iter().enumerate() {
            let w = simd.splat(w);
            mx = simd.fma(w, simd.load(lanes(blurred, i + k)), mx);
            my = simd.fma(w, simd.load(lanes(blurred, stride + i + k)), my);
            q = simd.fma(w, simd.load(lanes(blurred, 2 * stride + i + k)), q);
            p = simd.fma(w, simd.load(lanes(blurred, 3 * stride + i + k)), p);
        }
        let both = simd.mul(mx, my);
        let means = simd.fma(mx, mx, simd.mul(my, my));
        let a1 = simd.fma(two, both, c1);
        let a2 = simd.fma(two, simd.sub(p, both), c2);
        let b1 = simd.add(means, c1);
        let b2 = simd.add(simd.sub(q, means), c2);
        let inverse = simd.div(simd.splat(1.0), simd.mul(b1, b2));
        let weighted = simd.mul(simd.load(lanes(weight, i)), inverse);
        let s = simd.mul(simd.mul(a1, a2), weighted);
        sum = simd.fma(s, simd.load(lanes(own, i)), sum);
        let by_my = simd.mul(simd.mul(my, simd.sub(a2, a1)), weighted);
        let by_mx = simd.mul(simd.mul(mx, s), simd.mul(simd.sub(b2, b1), inverse));
        simd.store(simd.mul(two, simd.sub(by_my, by_mx)), lanes_mut(v_mu, i));
        simd.store(simd.fnma(s, simd.mul(b1, inverse), zero), lanes_mut(v_q, i));
        simd.store(simd.mul(two, simd.mul(a1, weighted)), lanes_mut(v_p, i));
    }
    reduced(simd, sum)
}

/// Vertical windows of the three derivative maps.
#[inline(always)]
fn blur_maps<S: Simd>(
    simd: S,
    maps: [&[f32]; 3],
    offsets: &[usize; TAPS],
    n: usize,
    stride: usize,
    blurred: &mut [f32],
) {
    let [mu, q, p] = maps;
    for i in (0..n).step_by(LANES) {
        let zero = simd.splat(0.0);
        let (mut v_mu, mut v_q, mut v_p) = (zero, zero, zero);
        for (k, w) in WINDOW.into_iter().enumerate() {
            let w = simd.splat(w);
            v_mu = simd.fma(w, simd.load(lanes(mu, offsets[k] + i)), v_mu);
            v_q = simd.fma(w, simd.load(lanes(q, offsets[k] + i)), v_q);
            v_p = simd.fma(w, simd.load(lanes(p, offsets[k] + i)), v_p);
        }
        for (map, value) in [v_mu, v_q, v_p].into_iter().enumerate() {
            simd.store(value, lanes_mut(blurred, map * stride + i));
        }
    }
}

/// Horizontal windows of the three maps, and the gradient by x of the weighted sum of both terms; returns Σ |x − y|.
/// `x_row` and `y_row` are raw rows, `own` is a map row; all hold `stride` values.
#[inline(always)]
fn gradient_row<S: Simd>(
    simd: S,
    blurred: &[f32],
    n: usize,
    stride: usize,
    [x_row, y_row, own]: [&[f32]; 3],
    weights: Weights,
    v_row: &mut [f32],
) -> f64 {
    let mut sum = simd.splat(0.0);
    let (ssim_weight, l1_weight) = (simd.splat(weights.ssim), simd.splat(weights.l1));
    for i in (0..n).step_by(LANES) {
        let zero = simd.splat(0.0);
        let (mut v_mu, mut v_q, mut v_p) = (zero, zero, zero);
        for (k, w) in WINDOW.into_iter().enumerate() {
            let w = simd.splat(w);
            v_mu = simd.fma(w, simd.load(lanes(blurred, i + k)), v_mu);
            v_q = simd.fma(w, simd.load(lanes(blurred, stride + i + k)), v_q);
            v_p = simd.fma(w, simd.load(lanes(blurred, 2 * stride + i + k)), v_p);
        }
        let x = simd.load(lanes(x_row, i + 2 * RADIUS));
        let y = simd.load(lanes(y_row, i + 2 * RADIUS));
        let d = simd.sub(x, y);
        sum = simd.fma(simd.abs(d), simd.load(lanes(own, i + RADIUS)), sum);
        // torch's sign: 0 at equality.
        let up = simd.keep(simd.gt(d, zero), l1_weight);
        let down = simd.keep(simd.gt(zero, d), l1_weight);
        let v_ssim = simd.fma(simd.add(x, x), v_q, simd.fma(y, v_p, v_mu));
        simd.store(simd.fma(ssim_weight, v_ssim, simd.sub(up, down)), lanes_mut(v_row, i));
    }
    reduced(simd, sum)
}

/// Sum of the lanes, in lane order.
#[inline(always)]
fn reduced<S: Simd>(simd: S, sum: S::F) -> f64 {
    let mut values = [0.0; LANES];
    simd.store(sum, &mut values);
    values.iter().map(|&v| f64::from(v)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(n: usize, seed: u32) -> Vec<f32> {
        (0..n as u32).map(|i| crate::rng::uniform(crate::rng::philox([i, 0, 0, 0], [seed, 7])[0])).collect()
    }

    #[test]
    fn window_is_the_normalised_gaussian() {
        let taps: Vec<f64> = (-5..=5).map(|d| (-f64::from(d * d) / 4.5).exp()).collect();
        let sum: f64 = taps.iter().sum();
        for (found, tap) in WINDOW.iter().zip(taps) {
            assert!((f64::from(*found) - tap / sum).abs() < 1e-8);
        }
    }

    #[test]
    fn an_image_equals_itself_and_has_no_ssim_gradient() {
        let (width, height) = (530, 70);
        let image = noise(width * height * 3, 1);
        let comparison = Comparison { width, height, channels: 3, image: &image, target: &image[..], mask: None };
        let (found, v_image) = similarity_and_gradient(&comparison, Weights { l1: 0.8, ssim: -0.2 });
        assert!((found.ssim - 1.0).abs() < 1e-6 && found.l1 == 0.0, "{found:?}");
        let largest = v_image.iter().fold(0.0f32, |a, v| a.max(v.abs()));
        assert!(largest * (width * height * 3) as f32 * 5.0 < 1e-3, "{largest}");
    }

    #[test]
    fn gradient_equals_finite_differences_with_mask_and_extra_channels() {
        let (width, height, channels) = (23, 17, 5);
        let mut image = noise(width * height * channels, 2);
        let target: Vec<u8> = noise(width * height * 3, 3).iter().map(|v| (v * 255.0) as u8).collect();
        let mask: Vec<u8> = noise(width * height, 4).iter().map(|v| u8::from(*v > 0.3)).collect();
        let weights = Weights { l1: 0.8, ssim: -0.2 };
        let value = |image: &[f32]| {
            let c = Comparison { width, height, channels, image, target: &target[..], mask: Some(&mask) };
            let s = similarity(&c);
            f64::from(weights.l1) * s.l1 + f64::from(weights.ssim) * s.ssim
        };
        let c = Comparison { width, height, channels, image: &image, target: &target[..], mask: Some(&mask) };
        let (_, v_image) = similarity_and_gradient(&c, weights);
        for index in (0..image.len()).step_by(7) {
            let at = image[index];
            let step = 2e-3;
            let (pixel, c) = (index / channels, index % channels);
            if c < 3 && (at - f32::from(target[pixel * 3 + c]) / 255.0).abs() <= step {
                // The kink of |x − y|.
                continue;
            }
            image[index] = at + step;
            let up = value(&image);
            image[index] = at - step;
            let down = value(&image);
            image[index] = at;
            let expected = (up - down) / (2.0 * f64::from(step));
            let found = f64::from(v_image[index]);
            // The differences of an f32 forward pass carry about 1e-7 / 4e-3 of noise.
            assert!((found - expected).abs() < 4e-5, "{index}: {found} {expected}");
            if mask[index / channels] == 0 || index % channels >= 3 {
                assert_eq!(found, 0.0);
            }
        }
    }

    #[test]
    fn bands_and_strips_leave_no_seam() {
        // The same texture at two sizes that split differently: interior gradients must agree.
        let (width, height) = (STRIP_COLUMNS + 40, 3 * BAND_ROWS);
        let image = noise(width * height * 3, 5);
        let target = noise(width * height * 3, 6);
        let crop = |data: &[f32], x: usize, y: usize, w: usize, h: usize| -> Vec<f32> {
            (y..y + h).flat_map(|r| data[(r * width + x) * 3..][..w * 3].to_vec()).collect()
        };
        let gradient = |image: &[f32], target: &[f32], width: usize, height: usize| {
            let c = Comparison { width, height, channels: 3, image, target, mask: None };
            let n = (width * height) as f32;
            similarity_and_gradient(&c, Weights { l1: n, ssim: -n }).1
        };
        let full = gradient(&image, &target, width, height);
        let (x, y, w, h) = (STRIP_COLUMNS - 30, band_rows(height) - 30, 60, 60);
        let part = gradient(&crop(&image, x, y, w, h), &crop(&target, x, y, w, h), w, h);
        let full = crop(&full, x, y, w, h);
        for r in 10..h - 10 {
            for i in (r * w + 10) * 3..(r * w + w - 10) * 3 {
                assert!((full[i] - part[i]).abs() < 1e-5, "{r} {i}: {} {}", full[i], part[i]);
            }
        }
    }

    #[test]
    fn sums_do_not_depend_on_the_number_of_threads() {
        let (width, height) = (200, 333);
        let image = noise(width * height * 4, 8);
        let target = noise(width * height * 3, 9);
        let c = Comparison { width, height, channels: 4, image: &image, target: &target[..], mask: None };
        let results: Vec<_> = [1, 2, 3]
            .into_iter()
            .map(|threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("the test sets this up");
                pool.install(|| similarity_and_gradient(&c, Weights { l1: 0.8, ssim: -0.2 }))
            })
            .collect();
        assert!(results.windows(2).all(|w| w[0] == w[1]));
    }

    #[test]
    fn a_fully_masked_image_has_no_loss() {
        let image = noise(12, 1);
        let target = noise(12, 2);
        let c =
            Comparison { width: 2, height: 2, channels: 3, image: &image, target: &target[..], mask: Some(&[0; 4]) };
        let (found, v) = similarity_and_gradient(&c, Weights { l1: 1.0, ssim: 1.0 });
        assert_eq!((found.l1, found.ssim), (0.0, 1.0));
        assert!(v.iter().all(|v| *v == 0.0));
    }
}
