//! LDR-FLIP: what is seen of the difference between two images that alternate on a display (FLIP: Andersson, Nilsson,
//! Akenine-Möller, Oskarsson, Åström, Fairchild, *FLIP: A Difference Evaluator for Alternating Images*, 2020).
//!
//! Colours are blurred as the eye blurs them at a distance (contrast sensitivity, FLIP Sec. 4.1.1), compared in a uniform
//! space (Sec. 4.1.2–4.1.4), and the difference is amplified where edges or points differ (Sec. 4.2). All in `f64`; every
//! filter is a sum of products of one-dimensional ones, so that images are filtered by rows and columns.

use gazesplat_core::color::from_u8;
use gazesplat_core::color::lab::lab_from_xyz;
use gazesplat_core::color::xyz::{linear_from_srgb, white};
use gazesplat_core::image::ImageF32;
use gazesplat_render::simd::vectorize;
use gazesplat_render::{Error, Result};
use gazesplat_train::losses::LossTarget;
use gazesplat_train::metrics::{ImageMetric, unmasked};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use std::f64::consts::PI;

/// Pixels per degree of visual angle of a 0.7 m wide display of 3840 pixels seen from 0.7 m: the published default.
pub const PIXELS_PER_DEGREE: f64 = 67.0;

/// Most pixels per degree: filters are as wide as an image then, and nobody sees more than a hundred.
const MAX_PIXELS_PER_DEGREE: f64 = 1000.0;

/// Contrast sensitivity of the achromatic, red-green and blue-yellow channel as sums of Gaussians, (a, b) each: their
/// spectrum is Σ a exp(−b f²), f in cycles per degree (FLIP Table 1).
const SENSITIVITY: [&[(f64, f64)]; 3] = [&[(1.0, 0.0047)], &[(1.0, 0.0053)], &[(34.1, 0.04), (13.5, 0.025)]];

/// Width of the eye's edge detector from peak to trough, degrees: two standard deviations (FLIP Sec. 4.2).
const DETECTOR_WIDTH: f64 = 0.082;

/// Exponent of colour differences (FLIP Sec. 4.1.4).
const Q_COLOR: f64 = 0.7;
/// Exponent of feature differences (FLIP Sec. 4.2).
const Q_FEATURE: f64 = 0.5;
/// Colour differences up to this part of the largest one take [`P_TARGET`] of the range (FLIP Sec. 4.1.4).
const P_COLOR: f64 = 0.4;
/// See [`P_COLOR`].
const P_TARGET: f64 = 0.95;

/// Linear sRGB to XYZ with the exact rational entries that the metric is published with, columns.
const XYZ_FROM_LINEAR: DMat3 = DMat3::from_cols_array(&[
    10_135_552.0 / 24_577_794.0,
    2_613_072.0 / 12_288_897.0,
    1_425_312.0 / 73_733_382.0,
    8_788_810.0 / 24_577_794.0,
    8_788_810.0 / 12_288_897.0,
    8_788_810.0 / 73_733_382.0,
    4_435_075.0 / 24_577_794.0,
    887_015.0 / 12_288_897.0,
    70_074_185.0 / 73_733_382.0,
]);

/// An observer at a distance.
#[derive(Debug, Clone)]
pub struct Flip {
    /// Of each opponent channel: pairs of filters along rows and along columns, whose results are added.
    sensitivity: [Vec<[Vec<f64>; 2]>; 3],
    /// Gaussian of the feature detectors, sum 1.
    smooth: Vec<f64>,
    /// Its first derivative, positive and negative weights of sum 1 each.
    edge: Vec<f64>,
    /// Its second derivative, likewise.
    point: Vec<f64>,
    linear_from_relative: DMat3,
    relative_from_linear: DMat3,
    /// The largest colour difference, between green and blue, to the power of [`Q_COLOR`].
    largest: f64,
}

/// An image as the observer sees it: what differences are taken of.
#[derive(Debug, Clone, PartialEq)]
pub struct Appearance {
    width: usize,
    height: usize,
    /// Lightness and hues after the Hunt effect, of the blurred colours.
    colors: Vec<DVec3>,
    /// Strength of the edge and of the point at each pixel.
    features: Vec<[f64; 2]>,
}

impl Flip {
    /// An observer who sees this many pixels per degree ([`PIXELS_PER_DEGREE`]).
    ///
    /// # Errors
    /// [`Error::Parameter`] unless the number is above 0 and at most 1000.
    pub fn new(pixels_per_degree: f64) -> Result<Self> {
        if !(pixels_per_degree > 0.0 && pixels_per_degree <= MAX_PIXELS_PER_DEGREE) {
            return Err(Error::Parameter {
                name: "pixels per degree",
                found: pixels_per_degree.to_string(),
                expected: "a number above 0 and at most 1000",
            });
        }
        // One domain for all channels: three standard deviations of the widest Gaussian.
        let widest = SENSITIVITY.iter().copied().flatten().map(|g| g.1).fold(0.0, f64::max);
        let radius = (3.0 * (widest / (2.0 * PI * PI)).sqrt() * pixels_per_degree).ceil() as i32;
        let sensitivity = SENSITIVITY.map(|gaussians| {
            let parts: Vec<(f64, Vec<f64>)> = gaussians
                .iter()
                .map(|&(a, b)| {
                    let at = |x: i32| (-(PI * f64::from(x) / pixels_per_degree).powi(2) / b).exp();
                    (a * (PI / b).sqrt(), (-radius..=radius).map(at).collect())
                })
                .collect();
            let total: f64 = parts.iter().map(|(scale, g)| scale * g.iter().sum::<f64>().powi(2)).sum();
            parts.into_iter().map(|(scale, g)| [g.iter().map(|v| v * scale / total).collect(), g]).collect()
        });
        let deviation = 0.5 * DETECTOR_WIDTH * pixels_per_degree;
        let radius = (3.0 * deviation).ceil() as i32;
        let taps = |f: &dyn Fn(f64) -> f64| -> Vec<f64> {
            (-radius..=radius).map(|x| f64::from(x) / deviation).map(|u| f(u) * (-0.5 * u * u).exp()).collect()
        };
        let relative_from_linear = DMat3::from_diagonal((XYZ_FROM_LINEAR * DVec3::ONE).recip()) * XYZ_FROM_LINEAR;
        let mut flip = Self {
            sensitivity,
            smooth: balanced(taps(&|_| 1.0)),
            edge: balanced(taps(&|u| -u)),
            point: balanced(taps(&|u| u * u - 1.0)),
            linear_from_relative: relative_from_linear.inverse(),
            relative_from_linear,
            largest: 0.0,
        };
        flip.largest = distance(flip.hunt(DVec3::Y), flip.hunt(DVec3::Z)).powf(Q_COLOR);
        Ok(flip)
    }

    /// How the observer sees an image: sRGB-encoded, clamped to 0…1; beyond the border its outermost pixels go on. What is
    /// not a number spoils its neighbourhood.
    ///
    /// # Errors
    /// [`Error::Shape`] if the image has no pixels or does not fill its size.
    pub fn appearance(&self, image: &ImageF32) -> Result<Appearance> {
        let (width, height) = (image.width as usize, image.height as usize);
        let expected = [height, width, 3];
        if image.data.len() != width * height * 3 || image.data.is_empty() {
            return Err(Error::Shape { name: "image", found: vec![image.data.len()], expected: expected.to_vec() });
        }
        let opponent: Vec<DVec3> = image
            .data
            .par_chunks_exact(3)
            .map(|p| {
                let color = DVec3::from_array(std::array::from_fn(|c| f64::from(p[c].clamp(0.0, 1.0))));
                opponent_from_relative(self.relative_from_linear * linear_from_srgb(color))
            })
            .collect();
        let plane = |c: usize| -> Vec<f64> { opponent.par_iter().map(|p| p[c]).collect() };
        let planes = [plane(0), plane(1), plane(2)];
        let [first, second, third] = [0, 1, 2].map(|c| {
            let mut sum = vec![0.0; width * height];
            for [across, down] in &self.sensitivity[c] {
                let part = columns(&rows(&planes[c], width, across), width, down);
                sum.iter_mut().zip(part).for_each(|(s, p)| *s += p);
            }
            sum
        });
        let colors = (0..width * height)
            .into_par_iter()
            .map(|i| {
                let relative = relative_from_opponent(DVec3::new(first[i], second[i], third[i]));
                let linear = (self.linear_from_relative * relative).clamp(DVec3::ZERO, DVec3::ONE);
                self.hunt(linear)
            })
            .collect();
        // Luminance 0…1.
        let light: Vec<f64> = planes[0].iter().map(|y| (y + 16.0) / 116.0).collect();
        let smooth = rows(&light, width, &self.smooth);
        let strengths = [&self.edge, &self.point].map(|taps| {
            let across = columns(&rows(&light, width, taps), width, &self.smooth);
            let down = columns(&smooth, width, taps);
            across.iter().zip(down).map(|(x, y)| x.hypot(y)).collect::<Vec<f64>>()
        });
        let [edges, points] = strengths;
        let features = edges.into_iter().zip(points).map(|(e, p)| [e, p]).collect();
        Ok(Appearance { width, height, colors, features })
    }

    /// What is seen of the difference at each pixel, 0 (nothing) … 1, `[H·W]`; symmetric in its arguments.
    ///
    /// # Errors
    /// [`Error::Shape`] if the images have different sizes.
    pub fn difference(&self, a: &Appearance, b: &Appearance) -> Result<Vec<f64>> {
        if (a.width, a.height) != (b.width, b.height) {
            let (found, expected) = (vec![b.height, b.width], vec![a.height, a.width]);
            return Err(Error::Shape { name: "second image", found, expected });
        }
        let pixels = a.colors.par_iter().zip(&b.colors).zip(a.features.par_iter().zip(&b.features));
        Ok(pixels.map(|((a, b), (f, g))| self.error([*a, *b], [*f, *g])).collect())
    }

    /// The error of a pixel from the colours and features of both images (FLIP Sec. 4.1.4, 4.2 and 4.3).
    fn error(&self, colors: [DVec3; 2], features: [[f64; 2]; 2]) -> f64 {
        let knee = P_COLOR * self.largest;
        let color = distance(colors[0], colors[1]).powf(Q_COLOR);
        let color = if color < knee {
            P_TARGET / knee * color
        } else {
            P_TARGET + (color - knee) / (self.largest - knee) * (1.0 - P_TARGET)
        };
        let [f, g] = features;
        let feature = (f[0] - g[0]).abs().max((f[1] - g[1]).abs());
        color.powf(1.0 - (feature / 2f64.sqrt()).powf(Q_FEATURE))
    }

    /// Lab of a linear colour with the chroma that its lightness leaves (Hunt effect, FLIP Sec. 4.1.3).
    fn hunt(&self, linear: DVec3) -> DVec3 {
        // The white point of `lab` and that of this metric differ in the fifth digit.
        let lab = lab_from_xyz(self.relative_from_linear * linear * white());
        DVec3::new(lab.x, 0.01 * lab.x * lab.y, 0.01 * lab.x * lab.z)
    }
}

/// Mean FLIP between an image and its photograph as a metric, over the pixels that the photograph's mask leaves; 0 when all
/// are masked.
#[derive(Debug, Clone)]
pub struct FlipMetric(pub Flip);

impl FlipMetric {
    /// What is seen of the difference at each pixel, `[H·W]`; 0 where the mask leaves a pixel out.
    ///
    /// # Errors
    /// [`Error::Shape`] if image and photograph differ in size.
    pub fn map(&self, image: &ImageF32, target: &LossTarget) -> Result<Vec<f64>> {
        let (width, height) = target.size();
        let photo = ImageF32 {
            width: width as u32,
            height: height as u32,
            data: target.rgb().iter().map(|v| from_u8(*v)).collect(),
        };
        let seen = self.0.appearance(&unmasked(image, target))?;
        let mut map = self.0.difference(&self.0.appearance(&photo)?, &seen)?;
        for (value, _) in map.iter_mut().zip(target.mask().unwrap_or_default()).filter(|(_, mask)| **mask == 0) {
            // Neighbours may be seen here; they are counted where they are.
            *value = 0.0;
        }
        Ok(map)
    }
}

impl ImageMetric for FlipMetric {
    fn name(&self) -> &str {
        "flip"
    }

    fn measure(&self, image: &ImageF32, target: &LossTarget) -> gazesplat_train::Result<f64> {
        let map = self.map(image, target)?;
        let num = target.mask().map_or(map.len(), |mask| mask.iter().filter(|m| **m != 0).count());
        // In the order of the pixels, whatever the number of threads.
        Ok(map.iter().sum::<f64>() / num.max(1) as f64)
    }
}

/// HyAB: lightness and hue apart (FLIP Eq. 3).
fn distance(a: DVec3, b: DVec3) -> f64 {
    let d = a - b;
    d.x.abs() + d.y.hypot(d.z)
}

/// YCxCz, the linear twin of Lab (FLIP Sec. 4.1.1), of XYZ relative to white.
fn opponent_from_relative(xyz: DVec3) -> DVec3 {
    DVec3::new(116.0 * xyz.y - 16.0, 500.0 * (xyz.x - xyz.y), 200.0 * (xyz.y - xyz.z))
}

/// The inverse of [`opponent_from_relative`].
fn relative_from_opponent(opponent: DVec3) -> DVec3 {
    let y = (opponent.x + 16.0) / 116.0;
    DVec3::new(y + opponent.y / 500.0, y, y - opponent.z / 200.0)
}

/// The weights with the positive ones divided by their sum, and the negative ones by theirs.
fn balanced(weights: Vec<f64>) -> Vec<f64> {
    let sum = |sign: f64| weights.iter().map(|w| (sign * w).max(0.0)).sum::<f64>();
    let (positive, negative) = (sum(1.0), sum(-1.0));
    weights.iter().map(|&w| if w < 0.0 { w / negative } else { w / positive }).collect()
}

/// Correlates every row with `taps`, whose number is odd.
fn rows(plane: &[f64], width: usize, taps: &[f64]) -> Vec<f64> {
    let radius = taps.len() / 2;
    let mut out = vec![0.0; plane.len()];
    out.par_chunks_exact_mut(width).zip(plane.par_chunks_exact(width)).for_each(|(out, row)| {
        let mut padded = vec![row[0]; width + 2 * radius];
        padded[radius..radius + width].copy_from_slice(row);
        padded[radius + width..].fill(row[width - 1]);
        vectorize(
            #[inline(always)]
            || taps.iter().enumerate().for_each(|(k, &tap)| add(out, tap, &padded[k..k + width])),
        );
    });
    out
}

/// Correlates every column with `taps`, whose number is odd.
fn columns(plane: &[f64], width: usize, taps: &[f64]) -> Vec<f64> {
    let (radius, height) = (taps.len() / 2, plane.len() / width);
    let mut out = vec![0.0; plane.len()];
    out.par_chunks_exact_mut(width).enumerate().for_each(|(y, out)| {
        vectorize(
            #[inline(always)]
            || {
                for (k, &tap) in taps.iter().enumerate() {
                    let from = (y + k).saturating_sub(radius).min(height - 1);
                    add(out, tap, &plane[from * width..(from + 1) * width]);
                }
            },
        );
    });
    out
}

/// `sum += tap · values`.
#[inline(always)]
fn add(sum: &mut [f64], tap: f64, values: &[f64]) {
    for (sum, value) in sum.iter_mut().zip(values) {
        *sum += tap * value;
    }
}
