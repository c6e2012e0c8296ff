//! Area resampling: an output pixel is the mean of the input over the rectangle it covers.
//!
//! For reductions this is the exact integral of the image seen as constant pixels, which neither rings nor aliases as
//! interpolating filters do; overlaps are counted in integers, so that weights carry no rounding of positions. The mean
//! is taken of the encoded (sRGB) values, as the usual tools do that shrink training images.

use rayon::prelude::*;

/// Share of one input pixel in one output pixel.
struct Axis {
    /// For each output pixel the first input pixel it covers.
    first: Vec<usize>,
    /// For each output pixel the weights of the input pixels from `first` on; they sum to 1.
    weights: Vec<Vec<f32>>,
}

impl Axis {
    /// Input pixel k covers [k·out, (k+1)·out), output pixel i covers [i·in, (i+1)·in), in units of 1/(in·out).
    fn new(num_in: u32, num_out: u32) -> Self {
        assert!(num_in > 0 && num_out > 0, "resampling needs at least one pixel");
        let (num_in, num_out) = (u64::from(num_in), u64::from(num_out));
        let mut axis = Self { first: Vec::new(), weights: Vec::new() };
        for i in 0..num_out {
            let (start, end) = (i * num_in, (i + 1) * num_in);
            let (first, last) = (start / num_out, (end - 1) / num_out);
            let overlap = |k: u64| end.min((k + 1) * num_out) - start.max(k * num_out);
            axis.first.push(first as usize);
            axis.weights.push((first..=last).map(|k| overlap(k) as f32 / num_in as f32).collect());
        }
        axis
    }
}

/// Means over areas, as `f32` `[out_h, out_w, C]`. `add_row(y, weight, sums)` adds `weight` times input row `y` to
/// `sums` `[in_w, C]`.
fn resize<const C: usize>(
    [in_w, in_h]: [u32; 2],
    [out_w, out_h]: [u32; 2],
    add_row: impl Fn(usize, f32, &mut [f32]) + Sync,
) -> Vec<f32> {
    let (columns, rows) = (Axis::new(in_w, out_w), Axis::new(in_h, out_h));
    let mut out = vec![0.0; out_w as usize * out_h as usize * C];
    out.par_chunks_mut(out_w as usize * C).enumerate().for_each_init(
        || vec![0.0; in_w as usize * C],
        |sums, (y, out_row)| {
            sums.fill(0.0);
            for (k, &weight) in rows.weights[y].iter().enumerate() {
                add_row(rows.first[y] + k, weight, sums);
            }
            for (x, out_pixel) in out_row.chunks_exact_mut(C).enumerate() {
                let mut mean = [0.0; C];
                let covered = sums[columns.first[x] * C..].chunks_exact(C);
                for (&weight, pixel) in columns.weights[x].iter().zip(covered) {
                    for c in 0..C {
                        mean[c] += weight * pixel[c];
                    }
                }
                out_pixel.copy_from_slice(&mean);
            }
        },
    );
    out
}

/// Nearest level of a mean of levels, halves up.
fn level(mean: f32) -> u8 {
    // The cast saturates.
    (mean + 0.5) as u8
}

/// RGB `[h, w, 3]` of `from` = \[w, h\] pixels, resampled to the size `to`.
///
/// # Panics
/// When a size is zero or `rgb` has another length.
pub fn resize_rgb(rgb: &[u8], from: [u32; 2], to: [u32; 2]) -> Vec<u8> {
    let stride = check_len(rgb, from, 3);
    let means = resize::<3>(from, to, |y, weight, sums| {
        for (sum, &value) in sums.iter_mut().zip(&rgb[y * stride..(y + 1) * stride]) {
            *sum += weight * f32::from(value);
        }
    });
    means.par_iter().map(|&v| level(v)).collect()
}

/// Straight RGB `[h, w, 3]` and alpha `[h, w]`, resampled together: colours are weighted by their alpha, so that what is
/// transparent does not bleed into what is not. Where the result is fully transparent the colour is 0.
///
/// # Panics
/// When a size is zero or a slice has another length.
pub fn resize_rgba(rgb: &[u8], alpha: &[u8], from: [u32; 2], to: [u32; 2]) -> (Vec<u8>, Vec<u8>) {
    let stride = check_len(alpha, from, 1);
    check_len(rgb, from, 3);
    let means = resize::<4>(from, to, |y, weight, sums| {
        let row = y * stride..(y + 1) * stride;
        let colors = rgb[3 * row.start..3 * row.end].chunks_exact(3);
        for ((sum, color), &alpha) in sums.chunks_exact_mut(4).zip(colors).zip(&alpha[row]) {
            let weight = weight * f32::from(alpha);
            for c in 0..3 {
                sum[c] += weight * f32::from(color[c]);
            }
            sum[3] += weight;
        }
    });
    let mut colors = Vec::with_capacity(3 * means.len() / 4);
    let mut alphas = Vec::with_capacity(means.len() / 4);
    for mean in means.chunks_exact(4) {
        let inverse = if mean[3] > 0.0 { 1.0 / mean[3] } else { 0.0 };
        colors.extend([level(mean[0] * inverse), level(mean[1] * inverse), level(mean[2] * inverse)]);
        alphas.push(level(mean[3]));
    }
    (colors, alphas)
}

/// Mask `[h, w]` (0 = no loss) resampled: 255 where every covered input pixel counts, else 0, because the colour of a
/// pixel that covers a masked one is partly made of what was masked.
///
/// # Panics
/// When a size is zero or `mask` has another length.
pub fn resize_mask(mask: &[u8], from: [u32; 2], to: [u32; 2]) -> Vec<u8> {
    let stride = check_len(mask, from, 1);
    let masked_share = resize::<1>(from, to, |y, weight, sums| {
        for (sum, &value) in sums.iter_mut().zip(&mask[y * stride..(y + 1) * stride]) {
            *sum += if value == 0 { weight } else { 0.0 };
        }
    });
    // Slivers below a thousandth of a pixel change no 8-bit level.
    masked_share.par_iter().map(|&share| if share < 1e-3 { 255 } else { 0 }).collect()
}

/// Row length; panics when `values` is not `[h, w, channels]`.
fn check_len(values: &[u8], [w, h]: [u32; 2], channels: usize) -> usize {
    let stride = w as usize * channels;
    assert_eq!(values.len(), stride * h as usize, "{w} × {h} pixels of {channels} channels");
    stride
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn mean(values: &[u8]) -> f64 {
        values.iter().map(|&v| f64::from(v)).sum::<f64>() / values.len() as f64
    }

    /// The mean over an area straight from its definition, in f64.
    fn reference(rgb: &[u8], [w, h]: [u32; 2], [out_w, out_h]: [u32; 2], x: u32, y: u32, c: usize) -> f64 {
        let overlap = |k: u32, i: u32, scale: f64| {
            let (start, end) = (f64::from(i) * scale, f64::from(i + 1) * scale);
            (end.min(f64::from(k + 1)) - start.max(f64::from(k))).max(0.0) / scale
        };
        let (sx, sy) = (f64::from(w) / f64::from(out_w), f64::from(h) / f64::from(out_h));
        let mut sum = 0.0;
        for v in 0..h {
            for u in 0..w {
                sum += overlap(u, x, sx) * overlap(v, y, sy) * f64::from(rgb[3 * (v * w + u) as usize + c]);
            }
        }
        sum
    }

    proptest! {
        #[test]
        fn constant_images_stay_constant(
            w in 1_u32..40, h in 1_u32..40, out_w in 1_u32..40, out_h in 1_u32..40, color in any::<[u8; 3]>(), alpha in 1_u8..
        ) {
            let n = (w * h) as usize;
            let out = resize_rgb(&color.repeat(n), [w, h], [out_w, out_h]);
            prop_assert!(out.chunks(3).all(|p| p == color));
            let (out, alphas) = resize_rgba(&color.repeat(n), &vec![alpha; n], [w, h], [out_w, out_h]);
            prop_assert!(out.chunks(3).all(|p| p == color) && alphas.iter().all(|&a| a == alpha));
        }

        #[test]
        fn mean_is_preserved_within_rounding(w in 1_u32..24, h in 1_u32..24, out_w in 1_u32..24, out_h in 1_u32..24, seed in any::<u64>()) {
            let mut state = seed | 1;
            let rgb: Vec<u8> = (0..3 * w * h)
                .map(|_| { state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407); (state >> 56) as u8 })
                .collect();
            let out = resize_rgb(&rgb, [w, h], [out_w, out_h]);
            prop_assert!((mean(&out) - mean(&rgb)).abs() <= 0.501);
            for (i, &value) in out.iter().enumerate() {
                let (x, y) = ((i as u32 / 3) % out_w, (i as u32 / 3) / out_w);
                let expected = reference(&rgb, [w, h], [out_w, out_h], x, y, i % 3);
                prop_assert!((f64::from(value) - expected).abs() <= 0.501, "({x}, {y}) {value} {expected}");
            }
        }

        #[test]
        fn weights_of_an_output_pixel_sum_to_one(num_in in 1_u32..5000, num_out in 1_u32..5000) {
            let axis = Axis::new(num_in, num_out);
            for (first, weights) in axis.first.iter().zip(&axis.weights) {
                prop_assert!((weights.iter().sum::<f32>() - 1.0).abs() < 1e-4);
                prop_assert!(first + weights.len() <= num_in as usize);
            }
        }
    }

    #[test]
    fn same_size_is_the_identity() {
        let rgb: Vec<u8> = (0..60).map(|i| i * 4).collect();
        assert_eq!(resize_rgb(&rgb, [5, 4], [5, 4]), rgb);
    }

    #[test]
    fn transparent_pixels_do_not_bleed() {
        let (rgb, alpha) = resize_rgba(&[200, 100, 50, 0, 255, 0], &[255, 0], [2, 1], [1, 1]);
        assert_eq!((rgb, alpha), (vec![200, 100, 50], vec![128]));
    }

    #[test]
    fn a_masked_input_pixel_masks_every_output_pixel_that_covers_it() {
        let mut mask = vec![255; 9];
        mask[4] = 0;
        assert_eq!(resize_mask(&mask, [3, 3], [2, 2]), vec![0; 4]);
        mask.fill(1);
        assert_eq!(resize_mask(&mask, [3, 3], [2, 2]), vec![255; 4]);
    }
}
