//! Over how many pixels the eye averages features: everywhere the same (uniform), or more the farther a pixel is from
//! where somebody looks.

use crate::error::{Error, Result};
use gazesplat_core::display::angle;
use gazesplat_core::{Display, Gaze, PixelGrid};

/// How the pooling angle grows with eccentricity e.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Growth {
    /// α e².
    #[default]
    Quadratic,
    /// α e.
    Linear,
}

impl Growth {
    /// Pooling angle in radians at eccentricity `e` (radians).
    pub fn angle_rad(self, alpha: f64, e: f64) -> f64 {
        match self {
            Self::Quadratic => alpha * e * e,
            Self::Linear => alpha * e,
        }
    }
}

/// Pooling that follows the gaze.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GazePooling {
    /// How the image is seen.
    pub display: Display,
    /// Where somebody looks.
    pub gaze: Gaze,
    /// Pooling angle over eccentricity (or its square), radians: above 0.
    pub alpha: f64,
    /// How the pooling angle grows.
    pub growth: Growth,
    /// Where pixels lie on the display.
    pub grid: PixelGrid,
}

impl Default for GazePooling {
    /// The centre of a 90° display is looked at; α = 0.05, quadratic (RTGS, published program).
    fn default() -> Self {
        Self {
            display: Display::default(),
            gaze: Gaze::CENTRE,
            alpha: 0.05,
            growth: Growth::default(),
            grid: PixelGrid::default(),
        }
    }
}

/// Angle beyond which the tangent of a pooling region's far end is no longer followed: its edge is at the horizon.
const LARGEST_ANGLE_RAD: f64 = 1.55;

impl GazePooling {
    /// Side of the pooling region around pixel (`column`, `row`) of an image of `size` (width, height), in pixels of that
    /// image, at least 0: the square root of the area of the ellipse that a pooling angle cuts out of the display.
    pub fn pooling_px(&self, size: (usize, usize), column: usize, row: usize) -> f64 {
        let (x, y) = (self.grid.place(column, size.0), self.grid.place(row, size.1));
        let direction = self.display.direction(size, x, y);
        let distance = direction.iter().map(|v| v * v).sum::<f64>().sqrt();
        let from_centre = angle(direction, [0.0, 0.0, 1.0]);
        let e = self.display.eccentricity_rad(size, self.gaze, x, y);
        let half = 0.5 * self.growth.angle_rad(self.alpha, e);
        let major = (from_centre + half).min(LARGEST_ANGLE_RAD).tan() - (from_centre - half).tan();
        let minor = 2.0 * distance * half.tan();
        (std::f64::consts::FRAC_PI_4 * major * minor).abs().sqrt() / self.display.width() * size.0 as f64
    }

    /// Level of detail of a pooling size: log₂ of it, at least 0.
    pub fn level_of_detail(pooling_px: f64) -> f64 {
        // The published program adds 1e-6 where others would take a maximum; the golden data hold it.
        let lod = (1e-6 + pooling_px).log2();
        // What is no number stays none.
        if lod < 0.0 { 0.0 } else { lod }
    }
}

/// Over what features are averaged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pooling {
    /// Squares of this side in pixels, any number from 1 on: training, guards and level quality.
    Uniform {
        /// Side in pixels of the resized image.
        size_px: f64,
    },
    /// Regions that grow with eccentricity: a whole foveated frame.
    Gaze(GazePooling),
}

/// Pooling size of quality level `level` (0 = the fovea): round((1 + k (√12 − 1) / 3)²) = 1, 3, 7, 12 (RTGS).
pub fn level_pooling_px(level: u32) -> f64 {
    (1.0 + f64::from(level) * (12f64.sqrt() - 1.0) / 3.0).powi(2).round()
}

impl Pooling {
    /// Checks what does not depend on an image.
    ///
    /// # Errors
    /// [`Error::Parameter`]: a uniform size that is no number from 1 on, or an α that is no positive number.
    pub fn validate(&self) -> Result<()> {
        match self {
            Self::Uniform { size_px } if size_px.is_finite() && *size_px >= 1.0 => Ok(()),
            Self::Uniform { size_px } => Err(Error::parameter("pooling size", size_px, "pixels from 1 on")),
            Self::Gaze(gaze) if gaze.alpha.is_finite() && gaze.alpha > 0.0 => Ok(()),
            Self::Gaze(gaze) => Err(Error::parameter("pooling growth alpha", gaze.alpha, "a positive number")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_pool_over_1_3_7_and_12_pixels() {
        assert_eq!([0, 1, 2, 3].map(level_pooling_px), [1.0, 3.0, 7.0, 12.0]);
    }

    #[test]
    fn impossible_pools_are_refused() {
        for size_px in [0.0, 0.99, -3.0, f64::NAN, f64::INFINITY] {
            assert!(matches!(Pooling::Uniform { size_px }.validate(), Err(Error::Parameter { .. })), "{size_px}");
        }
        for alpha in [0.0, -0.1, f64::NAN, f64::INFINITY] {
            let pooling = Pooling::Gaze(GazePooling { alpha, ..GazePooling::default() });
            assert!(matches!(pooling.validate(), Err(Error::Parameter { .. })), "{alpha}");
        }
    }

    /// Far outside the image, at a corner, at a pixel centre.
    #[test]
    fn pools_are_finite_wherever_somebody_looks() {
        let size = (40, 24);
        for (x, y) in [(3.0, -2.0), (0.0, 0.0), (20.5 / 40.0, 12.5 / 24.0), (1e9, 0.5)] {
            for growth in [Growth::Quadratic, Growth::Linear] {
                for grid in [PixelGrid::Centres, PixelGrid::EndPoints] {
                    let pooling =
                        GazePooling { gaze: Gaze::new(x, y).unwrap(), growth, grid, ..GazePooling::default() };
                    for row in 0..size.1 {
                        for column in 0..size.0 {
                            let p = pooling.pooling_px(size, column, row);
                            assert!(p.is_finite() && p >= 0.0, "{x} {y}: {p}");
                            let is_gaze = (grid.place(column, size.0), grid.place(row, size.1)) == (x, y);
                            assert_eq!(p == 0.0, is_gaze, "{p} at {column} {row}");
                        }
                    }
                }
            }
        }
    }
}
