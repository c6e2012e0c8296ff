//! Image quality: PSNR and SSIM of a float image against an 8-bit photograph, and what other measures look like.

mod guard;

pub use guard::{Bound, Guard};

use crate::kernels::cpu::l1_ssim::{Comparison, similarity};
use crate::losses::LossTarget;
use gazesplat_core::color::from_u8;
use gazesplat_core::image::ImageF32;
use rayon::prelude::*;
use std::borrow::Cow;

/// A measure of how close an image comes to its photograph.
pub trait ImageMetric: Send + Sync {
    /// Name, as in reports.
    fn name(&self) -> &str;
    /// The value for `image` (colours as drawn, not clamped). Not a number where the image is none.
    ///
    /// # Errors
    /// When the two cannot be compared.
    fn measure(&self, image: &ImageF32, target: &LossTarget) -> crate::Result<f64>;
}

/// [`psnr`] as a metric.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Psnr;

impl ImageMetric for Psnr {
    fn name(&self) -> &str {
        "psnr"
    }

    fn measure(&self, image: &ImageF32, target: &LossTarget) -> crate::Result<f64> {
        check_size(image, target)?;
        Ok(psnr(image, target))
    }
}

/// [`ssim`] as a metric.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Ssim;

impl ImageMetric for Ssim {
    fn name(&self) -> &str {
        "ssim"
    }

    fn measure(&self, image: &ImageF32, target: &LossTarget) -> crate::Result<f64> {
        check_size(image, target)?;
        Ok(ssim(image, target))
    }
}

fn check_size(image: &ImageF32, target: &LossTarget) -> crate::Result<()> {
    let found = (image.width as usize, image.height as usize);
    if found == target.size() {
        return Ok(());
    }
    let text = format!("found {} x {}, expected {} x {}", found.0, found.1, target.size().0, target.size().1);
    Err(crate::Error::parameter("size of the image", text))
}

/// `image` with the photograph's colours where its mask leaves pixels out: for metrics of neighbourhoods, to which a pixel
/// that must not count is best one that does not differ.
pub fn unmasked<'a>(image: &'a ImageF32, target: &LossTarget) -> Cow<'a, ImageF32> {
    let Some(mask) = target.mask().filter(|mask| 3 * mask.len() == image.data.len()) else {
        return Cow::Borrowed(image);
    };
    let mut image = image.clone();
    let pixels = image.data.chunks_exact_mut(3).zip(target.rgb().chunks_exact(3)).zip(mask);
    for ((pixel, color), _) in pixels.filter(|(_, m)| **m == 0) {
        for (v, c) in pixel.iter_mut().zip(color) {
            *v = from_u8(*c);
        }
    }
    Cow::Owned(image)
}

/// Value reported for identical images, and the largest one: a mean over views has to stay finite.
pub const MAX_PSNR_DB: f64 = 100.0;

/// Peak signal-to-noise ratio in dB, −10 log₁₀ MSE over unmasked pixels and the three channels, of `image` clamped to
/// [0, 1] against the 8-bit target; at most [`MAX_PSNR_DB`]. Not a number where the image is none.
///
/// # Panics
/// If the sizes differ.
pub fn psnr(image: &ImageF32, target: &LossTarget) -> f64 {
    assert_eq!((image.width as usize, image.height as usize), target.size(), "image and photograph differ in size");
    let width = image.width as usize;
    let mask = target.mask();
    // Sums per row, added in row order: the same on any number of threads.
    let rows: Vec<(f64, usize)> = image
        .data
        .par_chunks(3 * width)
        .zip(target.rgb().par_chunks(3 * width))
        .enumerate()
        .map(|(r, (found, expected))| {
            let (mut sum, mut num_pixels) = (0.0, 0);
            for (j, (x, y)) in found.chunks_exact(3).zip(expected.chunks_exact(3)).enumerate() {
                if mask.is_some_and(|m| m[r * width + j] == 0) {
                    continue;
                }
                num_pixels += 1;
                for c in 0..3 {
                    let d = f64::from(x[c].clamp(0.0, 1.0)) - f64::from(y[c]) / 255.0;
                    sum += d * d;
                }
            }
            (sum, num_pixels)
        })
        .collect();
    let (sum, num_pixels) = rows.iter().fold((0.0, 0), |a, r| (a.0 + r.0, a.1 + r.1));
    let mse = sum / (3 * num_pixels.max(1)) as f64;
    let db = -10.0 * mse.log10();
    if db > MAX_PSNR_DB { MAX_PSNR_DB } else { db }
}

/// Mean SSIM, with the windows and the treatment of borders and masks of the training loss, of `image` clamped to [0, 1].
///
/// # Panics
/// If the sizes differ.
pub fn ssim(image: &ImageF32, target: &LossTarget) -> f64 {
    let (width, height) = target.size();
    assert_eq!((image.width as usize, image.height as usize), (width, height), "image and photograph differ in size");
    let clamped: Vec<f32> = image.data.iter().map(|v| v.clamp(0.0, 1.0)).collect();
    let comparison =
        Comparison { width, height, channels: 3, image: &clamped, target: target.rgb(), mask: target.mask() };
    similarity(&comparison).ssim
}

#[cfg(test)]
mod tests {
    use super::*;
    use gazesplat_core::image::RgbImage8;
    use gazesplat_core::io::images::TrainingImage;
    use std::sync::Arc;

    fn target(mask: Option<Vec<u8>>) -> LossTarget {
        let image = RgbImage8 { width: 4, height: 3, data: vec![51; 36] };
        LossTarget::new(Arc::new(TrainingImage { image, alpha: None, mask }), [0.0; 3])
    }

    #[test]
    fn psnr_of_a_constant_difference() {
        let image = ImageF32 { width: 4, height: 3, data: vec![0.3; 36] };
        assert!((psnr(&image, &target(None)) - 20.0).abs() < 1e-5);
    }

    #[test]
    fn equal_images_have_the_largest_values() {
        let image = ImageF32 { width: 4, height: 3, data: vec![0.2; 36] };
        assert_eq!(psnr(&image, &target(None)), MAX_PSNR_DB);
        assert!((ssim(&image, &target(None)) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn values_beyond_the_range_are_clamped_and_masked_pixels_ignored() {
        let mut data = vec![0.2; 36];
        data[..3].copy_from_slice(&[-4.0, 9.0, 0.0]);
        let image = ImageF32 { width: 4, height: 3, data };
        let mut mask = vec![1; 12];
        assert!((psnr(&image, &target(None)) + 10.0 * ((0.04 + 0.64 + 0.04f64) / 36.0).log10()).abs() < 1e-5);
        mask[0] = 0;
        assert_eq!(psnr(&image, &target(Some(mask))), MAX_PSNR_DB);
    }
}
