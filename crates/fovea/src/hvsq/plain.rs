//! RTGS Eq. 2 read literally, as a cross-check of evaluations: features are the colours Y, Cr, Cb themselves, pools are exact
//! square windows whose side grows with eccentricity, cut at the border of the image.
//!
//! HVSQ = mean over pixels and channels of (M(a) − M(b))² + (σ(a) − σ(b))², σ of the population, its variance at least 1e-7.
//! Windows are summed by summed-area tables in `f64`, and so is their adjoint, a table of differences. One thread: a window
//! costs four reads whatever its size.

use super::ImageView;
use crate::error::{Error, Result};
use crate::hvs::pooling::Growth;
use crate::kernels::cpu::hvsq::MIN_VARIANCE;
use gazesplat_core::camera::Pinhole;
use gazesplat_core::display::angle;

/// Windows around the pixels of an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlainPooling {
    /// The camera whose image is looked at.
    pub camera: Pinhole,
    /// The pixel looked at, in pixels from the upper left corner.
    pub gaze_px: [f64; 2],
    /// Side of a window, in focal lengths (fx) per radian of eccentricity or its square: above 0.
    pub scale: f64,
    /// How the side grows.
    pub growth: Growth,
}

/// What a comparison found.
#[derive(Debug, Clone, PartialEq)]
pub struct PlainHvsq {
    /// Mean over pixels and channels.
    pub value: f64,
    /// Mean over channels, `[height, width]`.
    pub per_pixel: Vec<f64>,
    /// Gradient of the value by the altered image, `[height, width, channels]`, zero beyond RGB.
    pub v_altered: Vec<f64>,
}

impl PlainHvsq {
    /// Means over regions 0..`num_regions` of pixels, `None` of those without a pixel; `labels`, `[height, width]`, is the
    /// region of every pixel, labels from `num_regions` on belong to none.
    pub fn by_region(&self, labels: &[u8], num_regions: usize) -> Vec<Option<f64>> {
        let mut sums = vec![(0.0, 0u64); num_regions];
        for (value, label) in self.per_pixel.iter().zip(labels) {
            if let Some(sum) = sums.get_mut(usize::from(*label)) {
                *sum = (sum.0 + value, sum.1 + 1);
            }
        }
        sums.into_iter().map(|(sum, n)| (n > 0).then(|| sum / n as f64)).collect()
    }
}

impl PlainPooling {
    /// Checks camera, gaze and scale.
    ///
    /// # Errors
    /// [`Error::Parameter`] naming what is not finite or not positive.
    pub fn validate(&self) -> Result<()> {
        let Pinhole { fx, fy, cx, cy, .. } = self.camera;
        let positive =
            [("focal length", f64::from(fx)), ("focal length", f64::from(fy)), ("pooling scale", self.scale)];
        for (name, v) in positive {
            if !(v.is_finite() && v > 0.0) {
                return Err(Error::parameter(name, v, "a positive number"));
            }
        }
        let [x, y] = self.gaze_px;
        for (name, v) in
            [("principal point", f64::from(cx)), ("principal point", f64::from(cy)), ("gaze", x), ("gaze", y)]
        {
            if !v.is_finite() {
                return Err(Error::parameter(name, v, "a finite number"));
            }
        }
        Ok(())
    }

    /// Eccentricity of the centre of a pixel, radians.
    pub fn eccentricity_rad(&self, column: usize, row: usize) -> f64 {
        let Pinhole { fx, fy, cx, cy, .. } = self.camera;
        let ray = |x: f64, y: f64| [(x - f64::from(cx)) / f64::from(fx), (y - f64::from(cy)) / f64::from(fy), 1.0];
        angle(ray(self.gaze_px[0], self.gaze_px[1]), ray(column as f64 + 0.5, row as f64 + 0.5))
    }

    /// Half side r of the window around a pixel: it has (2 r + 1)² pixels before the border cuts it.
    pub fn radius_px(&self, column: usize, row: usize) -> usize {
        let side = self.growth.angle_rad(self.scale, self.eccentricity_rad(column, row)) * f64::from(self.camera.fx);
        (0.5 * side).floor() as usize
    }

    /// Compares an altered image with its reference.
    ///
    /// # Errors
    /// As [`PlainPooling::validate`]; [`Error::Shape`] when an image has not the size of the camera or less than three
    /// channels.
    pub fn compare(&self, reference: ImageView<'_, f32>, altered: ImageView<'_, f32>) -> Result<PlainHvsq> {
        self.validate()?;
        let (width, height) = (self.camera.width as usize, self.camera.height as usize);
        for image in [&reference, &altered] {
            super::check_image(image)?;
            if (image.width, image.height) != (width, height) || width * height == 0 {
                let (found, expected) = (vec![image.width, image.height], vec![width.max(1), height.max(1)]);
                return Err(Error::Shape { name: "image (width, height)", found, expected });
            }
        }
        let windows: Vec<Window> = (0..width * height)
            .map(|i| {
                let (x, y) = (i % width, i / width);
                let r = self.radius_px(x, y);
                let range = |at: usize, n: usize| (at.saturating_sub(r), at.saturating_add(r).saturating_add(1).min(n));
                Window { columns: range(x, width), rows: range(y, height) }
            })
            .collect();
        let n = 3.0 * (width * height) as f64;
        let mut per_pixel = vec![0.0; width * height];
        let mut v_channels: [Vec<f64>; 3] = Default::default();
        for (channel, v_channel) in v_channels.iter_mut().enumerate() {
            let (a, b) = (feature(&altered, channel), feature(&reference, channel));
            let tables = [&a, &b].map(|x| (Table::new(x, width, |v| v), Table::new(x, width, |v| v * v)));
            let (mut v_means, mut v_squares) = (Table::zeros(width, height), Table::zeros(width, height));
            for (window, value) in windows.iter().zip(&mut per_pixel) {
                let count = window.count();
                let [(mean, variance), (other_mean, other_variance)] = tables.each_ref().map(|(sums, squares)| {
                    let mean = sums.sum(window) / count;
                    (mean, squares.sum(window) / count - mean * mean)
                });
                let deviation = |variance: f64| if variance < MIN_VARIANCE { MIN_VARIANCE } else { variance }.sqrt();
                let d_mean = mean - other_mean;
                let d_deviation = deviation(variance) - deviation(other_variance);
                *value += (d_mean * d_mean + d_deviation * d_deviation) / 3.0;
                let v_variance = if variance < MIN_VARIANCE { 0.0 } else { d_deviation / (deviation(variance) * n) };
                v_means.spread(window, (2.0 * d_mean / n - 2.0 * mean * v_variance) / count);
                v_squares.spread(window, v_variance / count);
            }
            let (v_means, v_squares) = (v_means.accumulated(), v_squares.accumulated());
            *v_channel = a.iter().zip(v_means.iter().zip(&v_squares)).map(|(x, (m, q))| m + 2.0 * x * q).collect();
        }
        let [v_y, v_cr, v_cb] = &v_channels;
        let mut v_altered = vec![0.0; width * height * altered.channels];
        for (i, pixel) in v_altered.chunks_exact_mut(altered.channels).enumerate() {
            let (v_cr, v_cb) = (0.713 * v_cr[i], 0.564 * v_cb[i]);
            let v_y = v_y[i] - v_cr - v_cb;
            pixel[..3].copy_from_slice(&[0.299 * v_y + v_cr, 0.587 * v_y, 0.114 * v_y + v_cb]);
        }
        let value = per_pixel.iter().sum::<f64>() / (width * height) as f64;
        Ok(PlainHvsq { value, per_pixel, v_altered })
    }
}

/// Y, Cr or Cb of an image.
fn feature(image: &ImageView<'_, f32>, channel: usize) -> Vec<f64> {
    let of_pixel = |p: &[f32]| {
        let [r, g, b] = [p[0], p[1], p[2]].map(f64::from);
        let y = 0.299 * r + 0.587 * g + 0.114 * b;
        match channel {
            0 => y,
            1 => 0.5 + 0.713 * (r - y),
            _ => 0.5 + 0.564 * (b - y),
        }
    };
    image.data.chunks_exact(image.channels).map(of_pixel).collect()
}

/// A window: columns and rows, the ends excluded.
#[derive(Debug, Clone, Copy)]
struct Window {
    columns: (usize, usize),
    rows: (usize, usize),
}

impl Window {
    fn count(&self) -> f64 {
        ((self.columns.1 - self.columns.0) * (self.rows.1 - self.rows.0)) as f64
    }
}

/// Sums over everything above and to the left, or the differences they are the sums of: one row and column more than the
/// image.
struct Table {
    stride: usize,
    values: Vec<f64>,
}

impl Table {
    fn zeros(width: usize, height: usize) -> Self {
        Self { stride: width + 1, values: vec![0.0; (width + 1) * (height + 1)] }
    }

    fn new(image: &[f64], width: usize, f: impl Fn(f64) -> f64) -> Self {
        let mut table = Self::zeros(width, image.len() / width);
        let stride = table.stride;
        for (y, row) in image.chunks_exact(width).enumerate() {
            let mut sum = 0.0;
            for (x, v) in row.iter().enumerate() {
                sum += f(*v);
                table.values[(y + 1) * stride + x + 1] = table.values[y * stride + x + 1] + sum;
            }
        }
        table
    }

    fn sum(&self, w: &Window) -> f64 {
        let at = |x: usize, y: usize| self.values[y * self.stride + x];
        let ((x0, x1), (y0, y1)) = (w.columns, w.rows);
        (at(x1, y1) - at(x0, y1)) - (at(x1, y0) - at(x0, y0))
    }

    /// Adds `v` to every pixel of a window, as differences.
    fn spread(&mut self, w: &Window, v: f64) {
        let ((x0, x1), (y0, y1)) = (w.columns, w.rows);
        for (x, y, v) in [(x0, y0, v), (x1, y0, -v), (x0, y1, -v), (x1, y1, v)] {
            self.values[y * self.stride + x] += v;
        }
    }

    /// The image whose differences these are.
    fn accumulated(self) -> Vec<f64> {
        let (width, height) = (self.stride - 1, self.values.len() / self.stride - 1);
        let mut image = vec![0.0; width * height];
        for y in 0..height {
            let mut sum = 0.0;
            for x in 0..width {
                sum += self.values[y * self.stride + x];
                image[y * width + x] = sum + if y > 0 { image[(y - 1) * width + x] } else { 0.0 };
            }
        }
        image
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pooling(scale: f64) -> PlainPooling {
        let camera = Pinhole { width: 30, height: 20, fx: 25.0, fy: 25.0, cx: 15.0, cy: 10.0 };
        PlainPooling { camera, gaze_px: [4.0, 6.0], scale, growth: Growth::Linear }
    }

    fn view(data: &[f32]) -> ImageView<'_, f32> {
        ImageView { width: 30, height: 20, channels: 3, data }
    }

    #[test]
    fn windows_of_one_pixel_compare_colours() {
        let a: Vec<f32> = (0..1800).map(|i| (i * 7919 % 1009) as f32 / 1009.0).collect();
        let b: Vec<f32> = a.iter().map(|v| v + 0.125).collect();
        let found = pooling(1e-9).compare(view(&a), view(&b)).unwrap();
        assert!((found.value - 0.125f64.powi(2) / 3.0).abs() < 1e-9, "{}", found.value);
        assert_eq!(pooling(0.5).compare(view(&a), view(&a)).unwrap().value, 0.0);
        assert!(found.by_region(&[1; 600], 2)[0].is_none());
    }

    #[test]
    fn impossible_windows_are_refused() {
        let image = vec![0.5; 1800];
        for bad in [pooling(0.0), pooling(f64::NAN), PlainPooling { gaze_px: [f64::INFINITY, 0.0], ..pooling(1.0) }] {
            assert!(matches!(bad.compare(view(&image), view(&image)), Err(Error::Parameter { .. })));
        }
        let other = ImageView { width: 20, height: 30, ..view(&image) };
        assert!(matches!(pooling(1.0).compare(view(&image), other), Err(Error::Shape { .. })));
    }
}
