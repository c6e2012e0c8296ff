//! The row passes of the loss kernel: windows along both axes, the SSIM maps, the gradient.
//!
//! A row holds three channels at a stride of `segment` and is padded to whole vectors; rows of a ring are addressed by
//! their offsets. Every pass works through `n` values, a multiple of 16, of rows of `stride` ≥ n + 16.

use super::{C1, C2, Comparison, RADIUS, TAPS, TargetPixel, WINDOW, Weights};
use gazesplat_render::simd::{LANES, Simd};

/// Row `r` of both images by channel, zero outside them; masked pixels take the target's colour.
#[inline(always)]
pub(super) fn load_row<P: TargetPixel>(
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
pub(super) fn separate<const C: usize, P: TargetPixel>(pixels: &[P], segment: usize, shift: usize, row: &mut [f32]) {
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
pub(super) fn lanes(values: &[f32], i: usize) -> &[f32; LANES] {
    debug_assert!(i + LANES <= values.len());
    // SAFETY: callers step through `n` values of rows that hold `n + LANES`, with shifts of at most 10; `strip` sizes
    // them. Bounds checks here would double the number of instructions of the inner loops.
    unsafe { &*values.as_ptr().add(i).cast() }
}

/// The sixteen values from `i` on, for writing.
#[inline(always)]
pub(super) fn lanes_mut(values: &mut [f32], i: usize) -> &mut [f32; LANES] {
    debug_assert!(i + LANES <= values.len());
    // SAFETY: as in `lanes`.
    unsafe { &mut *values.as_mut_ptr().add(i).cast() }
}

/// Vertical windows of x, y, x² + y² and xy over 11 raw rows.
#[inline(always)]
pub(super) fn blur_moments<S: Simd>(
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
pub(super) fn ssim_maps<S: Simd>(
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
pub(super) fn blur_maps<S: Simd>(
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
pub(super) fn gradient_row<S: Simd>(
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
pub(super) fn reduced<S: Simd>(simd: S, sum: S::F) -> f64 {
    let mut values = [0.0; LANES];
    simd.store(sum, &mut values);
    values.iter().map(|&v| f64::from(v)).sum()
}
