//! Differences of images, pixel by pixel.

use gazesplat_core::color::ciede2000::delta_e;
use gazesplat_core::color::lab::lab_from_srgb;
use gazesplat_core::image::ImageF32;
use gazesplat_train::metrics;
use rayon::prelude::*;

/// Differences of the pixels of several images, in bins.
#[derive(Debug, Clone)]
pub(super) struct Differences {
    bins: Vec<u64>,
    /// Bins per unit.
    per_unit: f64,
    /// The largest; 0 without any.
    pub largest: f64,
    sum: f64,
    /// How many there are.
    pub num: u64,
}

impl Differences {
    /// None yet, of ΔE₀₀: up to 200 in bins of a thousandth.
    pub fn of_delta_e() -> Self {
        Self::new(200_000, 1e3)
    }

    /// None yet, of FLIP: up to 1 in bins of a hundred thousandth.
    pub fn of_flip() -> Self {
        Self::new(100_000, 1e5)
    }

    fn new(num_bins: usize, per_unit: f64) -> Self {
        Self { bins: vec![0; num_bins], per_unit, largest: 0.0, sum: 0.0, num: 0 }
    }

    /// Adds some. What is no number counts as larger than all that are: an image with a hole is not like another.
    pub fn add(&mut self, differences: &[f64]) {
        for &d in differences {
            let d = if d.is_nan() { f64::INFINITY } else { d };
            let bin = ((d * self.per_unit) as usize).min(self.bins.len() - 1);
            self.bins[bin] += 1;
            self.largest = self.largest.max(d);
            self.sum += d;
        }
        self.num += differences.len() as u64;
    }

    /// The mean; 0 without any.
    pub fn mean(&self) -> f64 {
        self.sum / self.num.max(1) as f64
    }

    /// The value that `share` of all exceed, to a bin.
    pub fn exceeded_by(&self, share: f64) -> f64 {
        let allowed = (share * self.num as f64) as u64;
        let mut above = 0;
        for (bin, count) in self.bins.iter().enumerate().rev() {
            above += count;
            if above > allowed {
                return (bin + 1) as f64 / self.per_unit;
            }
        }
        0.0
    }

    /// The share above `value`, to a bin.
    pub fn above(&self, value: f64) -> f64 {
        let first = (value * self.per_unit) as usize;
        self.bins[first.min(self.bins.len())..].iter().sum::<u64>() as f64 / self.num.max(1) as f64
    }
}

/// ΔE₀₀ of each pixel of two images of one size, clamped to 0…1.
pub(super) fn differences(a: &ImageF32, b: &ImageF32) -> Vec<f64> {
    let lab =
        |p: &[f32]| lab_from_srgb(glam::DVec3::from_array(std::array::from_fn(|c| f64::from(p[c].clamp(0.0, 1.0)))));
    let pixels = a.data.par_chunks_exact(3).zip(b.data.par_chunks_exact(3));
    pixels.map(|(p, q)| if p == q { 0.0 } else { delta_e(lab(p), lab(q)) }).collect()
}

/// PSNR of two images of one size, clamped to 0…1; at most [`metrics::MAX_PSNR_DB`], and NaN where a pixel is.
pub(super) fn psnr_between(a: &ImageF32, b: &ImageF32) -> f64 {
    let squares = a.data.iter().zip(&b.data).map(|(p, q)| {
        let d = f64::from(p.clamp(0.0, 1.0)) - f64::from(q.clamp(0.0, 1.0));
        d * d
    });
    let mse = squares.sum::<f64>() / a.data.len().max(1) as f64;
    let psnr = -10.0 * mse.log10();
    if psnr > metrics::MAX_PSNR_DB { metrics::MAX_PSNR_DB } else { psnr }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_of_differences_are_exact_to_a_bin() {
        let mut all = Differences::of_delta_e();
        all.add(&(0..1000).map(|i| f64::from(i) / 100.0).collect::<Vec<_>>());
        assert_eq!(all.largest, 9.99);
        assert!((all.exceeded_by(0.1) - 9.0).abs() < 0.02);
        assert!((all.above(5.0) - 0.5).abs() < 0.002);
    }

    #[test]
    fn a_pixel_that_is_no_number_is_not_overlooked() {
        let image = ImageF32 { width: 1, height: 1, data: vec![0.1, 0.5, 0.2] };
        let broken = ImageF32 { data: vec![0.1, f32::NAN, 0.2], ..image.clone() };
        let mut all = Differences::of_delta_e();
        all.add(&differences(&image, &broken));
        assert_eq!((all.largest, all.above(1.0)), (f64::INFINITY, 1.0));
        assert!(psnr_between(&image, &broken).is_nan());
    }

    #[test]
    fn equal_images_do_not_differ() {
        let image = ImageF32 { width: 2, height: 1, data: vec![0.1, 0.5, 2.0, 0.0, -1.0, 1.0] };
        assert_eq!(differences(&image, &image), [0.0, 0.0]);
        assert_eq!(psnr_between(&image, &image), metrics::MAX_PSNR_DB);
        // 2 and 1 are both white.
        let other = ImageF32 { data: vec![0.1, 0.5, 1.0, 0.0, -1.0, 1.0], ..image.clone() };
        assert_eq!(differences(&image, &other), [0.0, 0.0]);
    }
}
