//! Resampling a photograph as the pinhole would have taken it.

use super::LensDistortion;
use crate::camera::Pinhole;
use crate::image::RgbImage8;
use rayon::prelude::*;

/// A photograph without lens distortion; all parts have the size of [`LensDistortion::undistorted_pinhole`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UndistortedImage {
    /// Straight RGB; black where nothing was seen.
    pub image: RgbImage8,
    /// Alpha `[h, w]`, when the photograph has one.
    pub alpha: Option<Vec<u8>>,
    /// `[h, w]`: 255 where the photograph and its mask cover the pixel, 0 where it carries no loss; `None` when every
    /// pixel counts.
    pub mask: Option<Vec<u8>>,
}

/// Rays per image side that decide the undistorted size. Borders are smooth: with 257 samples the extremes of a curve
/// that bows by 100 px are met within 0.01 px.
const NUM_BORDER_SAMPLES: u32 = 257;

/// Limits of the size of the undistorted image relative to the photograph, COLMAP's defaults.
const SIZE_LIMITS: (f64, f64) = (0.2, 2.0);

impl LensDistortion {
    /// The pinhole that replaces this lens: same focal lengths, and the largest size, with the principal point at the
    /// same relative place, that has no blank pixels. This is the choice of COLMAP's `image_undistorter` with its default
    /// `--blank_pixels 0`, so that scenes undistorted beforehand and on load agree; 0.2 to 2 times the size of the photograph.
    pub fn undistorted_pinhole(&self) -> Pinhole {
        let (mut width, mut height) = (self.width, self.height);
        if self.is_distorted() {
            let [scale_x, scale_y] = self.scale_without_blank_pixels();
            let scaled = |n: u32, scale: f64| ((f64::from(n) * scale) as u32).max(1);
            (width, height) = (scaled(width, scale_x), scaled(height, scale_y));
        }
        Pinhole {
            width,
            height,
            fx: self.fx as f32,
            fy: self.fy as f32,
            cx: (self.cx * f64::from(width) / f64::from(self.width)) as f32,
            cy: (self.cy * f64::from(height) / f64::from(self.height)) as f32,
        }
    }

    fn scale_without_blank_pixels(&self) -> [f64; 2] {
        let size = [f64::from(self.width), f64::from(self.height)];
        let (focal, center) = ([self.fx, self.fy], [self.cx, self.cy]);
        [0, 1].map(|axis| {
            // How far the sides at the small and at the large end of this axis bow into the image, in pixels from the
            // principal point; rays that are not one-to-one say nothing.
            let reach = |side: f64| {
                (0..NUM_BORDER_SAMPLES)
                    .filter_map(|i| {
                        let along = f64::from(i) / f64::from(NUM_BORDER_SAMPLES - 1);
                        let mut pixel = [0.0; 2];
                        pixel[axis] = side;
                        pixel[1 - axis] = 0.5 + along * (size[1 - axis] - 1.0);
                        let distorted = [0, 1].map(|c| (pixel[c] - center[c]) / focal[c]);
                        self.undistort(distorted).map(|ray| (ray[axis] * focal[axis]).abs())
                    })
                    .fold(f64::INFINITY, f64::min)
            };
            let (start, end) = (0.5, size[axis] - 0.5);
            // COLMAP's ratios to the digit, whose left one is half a pixel larger than the right one would suggest.
            let ratios = [center[axis] / reach(start), (end - center[axis]) / reach(end)];
            // A principal point outside the image leaves one side without a meaning.
            let shrink = ratios.into_iter().fold(0.0, f64::max);
            if shrink > 0.0 { (1.0 / shrink).clamp(SIZE_LIMITS.0, SIZE_LIMITS.1) } else { SIZE_LIMITS.1 }
        })
    }

    /// The photograph as [`undistorted_pinhole`](Self::undistorted_pinhole) sees it: inverse map, bilinear, colours weighted
    /// by their alpha. `alpha` and `mask` (0 = no loss) are `[height, width]`.
    ///
    /// # Panics
    /// When the image, `alpha` or `mask` does not have the size of the calibration.
    pub fn undistort_image(&self, image: &RgbImage8, alpha: Option<&[u8]>, mask: Option<&[u8]>) -> UndistortedImage {
        assert_eq!((image.width, image.height), (self.width, self.height), "calibration and photograph differ in size");
        assert_eq!(image.data.len(), 3 * image.num_pixels(), "image data does not have its declared size");
        assert!([alpha, mask].into_iter().flatten().all(|plane| plane.len() == image.num_pixels()), "size of a plane");
        let photo = Photo { width: self.width as usize, height: self.height as usize, rgb: &image.data, alpha, mask };
        let pinhole = self.undistorted_pinhole();
        let stride = pinhole.width as usize;
        let num_pixels = stride * pinhole.height as usize;
        let mut rgb = vec![0; 3 * num_pixels];
        let mut alpha_and_valid = vec![[0; 2]; num_pixels];
        let rows = rgb.par_chunks_mut(3 * stride).zip(alpha_and_valid.par_chunks_mut(stride));
        rows.enumerate().for_each(|(y, (rgb, alpha_and_valid))| {
            let ray_y = (y as f64 + 0.5 - f64::from(pinhole.cy)) / f64::from(pinhole.fy);
            for (x, (color, rest)) in rgb.chunks_exact_mut(3).zip(alpha_and_valid).enumerate() {
                let ray = [(x as f64 + 0.5 - f64::from(pinhole.cx)) / f64::from(pinhole.fx), ray_y];
                if !self.is_one_to_one(ray) {
                    continue;
                }
                let [u, v] = self.distort(ray);
                if let Some(seen) = photo.sample(u * self.fx + self.cx, v * self.fy + self.cy) {
                    color.copy_from_slice(&seen.color);
                    *rest = [seen.alpha, if seen.counts { 255 } else { 0 }];
                }
            }
        });
        let valid = || alpha_and_valid.iter().map(|rest| rest[1]);
        UndistortedImage {
            image: RgbImage8 { width: pinhole.width, height: pinhole.height, data: rgb },
            alpha: alpha.map(|_| alpha_and_valid.iter().map(|rest| rest[0]).collect()),
            mask: valid().any(|valid| valid == 0).then(|| valid().collect()),
        }
    }
}

/// The planes of a photograph, sampled at a point.
struct Photo<'a> {
    width: usize,
    height: usize,
    rgb: &'a [u8],
    alpha: Option<&'a [u8]>,
    mask: Option<&'a [u8]>,
}

struct Sample {
    color: [u8; 3],
    alpha: u8,
    counts: bool,
}

impl Photo<'_> {
    /// Bilinear value at (u, v) in pixels, the edge repeated over the outer half pixel; `None` outside the photograph.
    fn sample(&self, u: f64, v: f64) -> Option<Sample> {
        if !(u >= 0.0 && v >= 0.0 && u <= self.width as f64 && v <= self.height as f64) {
            return None;
        }
        let split = |position: f64, size: usize| {
            let position = (position - 0.5).clamp(0.0, (size - 1) as f64);
            let low = (position as usize).min(size.saturating_sub(2));
            (low, (low + 1).min(size - 1), (position - low as f64) as f32)
        };
        let ((x0, x1, tx), (y0, y1, ty)) = (split(u, self.width), split(v, self.height));
        let taps = [
            (y0 * self.width + x0, (1.0 - ty) * (1.0 - tx)),
            (y0 * self.width + x1, (1.0 - ty) * tx),
            (y1 * self.width + x0, ty * (1.0 - tx)),
            (y1 * self.width + x1, ty * tx),
        ];
        let counts = self.mask.is_none_or(|mask| taps.iter().all(|&(i, weight)| weight < 1e-3 || mask[i] != 0));
        let (mut sums, mut alpha_sum) = ([0.0_f32; 3], 0.0_f32);
        for (i, weight) in taps {
            // Colours are weighted by their alpha, 255 without one.
            let weight = weight * self.alpha.map_or(255.0, |plane| f32::from(plane[i]));
            alpha_sum += weight;
            for (sum, &value) in sums.iter_mut().zip(&self.rgb[3 * i..3 * i + 3]) {
                *sum += weight * f32::from(value);
            }
        }
        let inverse = if alpha_sum > 0.0 { 1.0 / alpha_sum } else { 0.0 };
        // The casts saturate; halves are rounded up.
        let color = sums.map(|sum| (sum * inverse + 0.5) as u8);
        Some(Sample { color, alpha: (alpha_sum + 0.5) as u8, counts })
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::phone;
    use super::super::{LensDistortion, LensModel};
    use super::*;

    #[test]
    fn undistorted_size_is_the_one_colmap_chose() {
        // `fox` was undistorted by COLMAP with this calibration: 1062 × 1894, principal point (531, 947).
        let pinhole = phone().undistorted_pinhole();
        assert_eq!((pinhole.width, pinhole.height), (1062, 1894));
        assert!((pinhole.cx - 531.0).abs() < 1e-3 && (pinhole.cy - 947.0).abs() < 1e-3);
        assert!((pinhole.fx - 1375.7195).abs() < 1e-3);
    }

    #[test]
    fn no_distortion_changes_nothing() {
        let lens = LensDistortion::new(LensModel::Radial, [7, 5], [6.0, 6.0], [3.5, 2.5], [0.0; 8]);
        let image = RgbImage8 { width: 7, height: 5, data: (0..105).map(|i| (i * 2) as u8).collect() };
        let alpha = vec![255; 35];
        let out = lens.undistort_image(&image, Some(&alpha), None);
        assert_eq!(out, UndistortedImage { image, alpha: Some(alpha), mask: None });
    }

    /// Colour = position along the image, so that the resampled value tells where it was taken from.
    fn ramp(lens: &LensDistortion) -> RgbImage8 {
        let (w, h) = (lens.width, lens.height);
        let level = |i: u32, n: u32| (255.0 * (f64::from(i) + 0.5) / f64::from(n)).round() as u8;
        let data = (0..h).flat_map(|y| (0..w).flat_map(move |x| [level(x, w), level(y, h), 128])).collect();
        RgbImage8 { width: w, height: h, data }
    }

    #[test]
    fn pixels_come_from_where_the_lens_puts_their_rays() {
        for (model, k) in [
            (LensModel::SimpleRadial, [-0.2, 0., 0., 0., 0., 0., 0., 0.]),
            (LensModel::OpenCv, [0.1, -0.05, 0.003, -0.002, 0., 0., 0., 0.]),
            (LensModel::OpenCvFisheye, [0.02, -0.01, 0.003, 0.0, 0., 0., 0., 0.]),
        ] {
            let lens = LensDistortion::new(model, [200, 150], [120.0, 118.0], [101.0, 73.0], k);
            let out = lens.undistort_image(&ramp(&lens), None, None);
            let pinhole = lens.undistorted_pinhole();
            for (x, y) in [(10, 10), (pinhole.width / 2, 20), (pinhole.width - 12, pinhole.height - 9)] {
                let ray = [
                    (f64::from(x) + 0.5 - f64::from(pinhole.cx)) / lens.fx,
                    (f64::from(y) + 0.5 - f64::from(pinhole.cy)) / lens.fy,
                ];
                let [u, v] = lens.distort(ray);
                let [r, g, b] = out.image.pixel(x, y);
                assert!((f64::from(r) / 255.0 * 200.0 - (u * lens.fx + lens.cx)).abs() < 1.0, "{model:?} ({x}, {y})");
                assert!((f64::from(g) / 255.0 * 150.0 - (v * lens.fy + lens.cy)).abs() < 1.0, "{model:?} ({x}, {y})");
                assert_eq!(b, 128);
            }
        }
    }

    #[test]
    fn usual_lenses_leave_no_blank_pixels_and_masks_are_carried_along() {
        let lens = phone().resized(108, 192);
        let image = RgbImage8::filled(108, 192, [9, 9, 9]);
        assert_eq!(lens.undistort_image(&image, None, None).mask, None);
        let mut mask = vec![255; 108 * 192];
        mask[96 * 108 + 54] = 0;
        let masked = lens.undistort_image(&image, None, Some(&mask)).mask.unwrap();
        let num_masked = masked.iter().filter(|&&m| m == 0).count();
        assert!((1..=9).contains(&num_masked), "{num_masked}");
    }

    #[test]
    fn hopeless_lenses_are_masked_instead_of_folded() {
        // The profile falls from r = 0.58 on, inside the image.
        let lens = LensDistortion::new(
            LensModel::SimpleRadial,
            [64, 64],
            [32.0, 32.0],
            [32.0, 32.0],
            [-1.0, 0., 0., 0., 0., 0., 0., 0.],
        );
        let out = lens.undistort_image(&RgbImage8::filled(64, 64, [1, 2, 3]), None, None);
        let mask = out.mask.unwrap();
        assert!(mask.contains(&0) && mask.contains(&255));
        let fisheye = LensDistortion::new(LensModel::OpenCvFisheye, [64, 64], [20.0, 20.0], [32.0, 32.0], [0.0; 8]);
        let pinhole = fisheye.undistorted_pinhole();
        assert!(pinhole.width <= 128 && pinhole.height <= 128);
    }
}
