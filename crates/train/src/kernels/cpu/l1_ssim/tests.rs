//! Tests of the loss kernel: closed forms, finite differences, seams, threads.

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
    let c = Comparison { width: 2, height: 2, channels: 3, image: &image, target: &target[..], mask: Some(&[0; 4]) };
    let (found, v) = similarity_and_gradient(&c, Weights { l1: 1.0, ssim: 1.0 });
    assert_eq!((found.l1, found.ssim), (0.0, 1.0));
    assert!(v.iter().all(|v| *v == 0.0));
}
