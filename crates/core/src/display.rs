//! How a flat image is seen: from distance 1, on the axis through its centre. Only its width over the distance matters.
//!
//! Directions are (x, y, 1), +x right, +y down, in units of the distance. A display need not be the camera that made the
//! image: a photograph taken with a long lens can fill the field of view.

use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::gaze::Gaze;

/// Widest horizontal field of view, degrees: a flat image cannot fill 180.
pub const MAX_FOV_DEG: f64 = 170.0;

/// Where the samples of an image lie on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PixelGrid {
    /// Pixel i of n at (i + ½) / n: the renderer's.
    #[default]
    Centres,
    /// Pixel i of n at i / (n − 1), the outermost ones on the edges: a grid some publications use.
    EndPoints,
}

impl PixelGrid {
    /// Place of pixel `index` of `count`, in 0..1.
    pub fn place(self, index: usize, count: usize) -> f64 {
        match self {
            Self::Centres => (index as f64 + 0.5) / count as f64,
            Self::EndPoints if count > 1 => index as f64 / (count - 1) as f64,
            Self::EndPoints => 0.0,
        }
    }
}

/// An image in front of an eye.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Display {
    width: f64,
}

impl Default for Display {
    /// 90° wide.
    fn default() -> Self {
        Self { width: 2.0 }
    }
}

impl Display {
    /// A display whose width is seen under `degrees`, above 0 and up to [`MAX_FOV_DEG`].
    ///
    /// # Errors
    /// [`Error::Parameter`] when it is outside.
    pub fn from_fov_deg(degrees: f64) -> Result<Self> {
        if degrees > 0.0 && degrees <= MAX_FOV_DEG {
            return Ok(Self { width: 2.0 * (0.5 * degrees.to_radians()).tan() });
        }
        Err(Error::Parameter {
            name: "display field of view".into(),
            message: format!("found {degrees}, expected degrees above 0 and up to {MAX_FOV_DEG}"),
        })
    }

    /// A display of `width` seen from `distance`, both in the same unit.
    ///
    /// # Errors
    /// [`Error::Parameter`] when one is not a positive number, or the field of view is beyond [`MAX_FOV_DEG`].
    pub fn from_size(width: f64, distance: f64) -> Result<Self> {
        let widest = 2.0 * (0.5 * MAX_FOV_DEG.to_radians()).tan();
        let relative = width / distance;
        if width > 0.0 && distance > 0.0 && relative > 0.0 && relative <= widest {
            return Ok(Self { width: relative });
        }
        Err(Error::Parameter {
            name: "display size".into(),
            message: format!(
                "found width {width} at distance {distance}, expected positive numbers and at most {MAX_FOV_DEG} degrees"
            ),
        })
    }

    /// The display that shows the image of `camera` under the angles it was taken at.
    ///
    /// # Errors
    /// As [`Display::from_size`].
    pub fn from_camera(camera: &Camera) -> Result<Self> {
        Self::from_size(f64::from(camera.intrinsics.width), f64::from(camera.intrinsics.fx))
    }

    /// Width over distance.
    pub fn width(&self) -> f64 {
        self.width
    }

    /// Direction, of any length and with z = 1, of the point (x, y) of an image of `size` (width and height in pixels), x
    /// and y in image units as for [`Gaze`].
    pub fn direction(&self, size: (usize, usize), x: f64, y: f64) -> [f64; 3] {
        let aspect = size.1 as f64 / size.0 as f64;
        // Farther is no other direction, and squares stay finite.
        let [x, y] = [x, y].map(|v| v.clamp(-FARTHEST, FARTHEST));
        [(x - 0.5) * self.width, (y - 0.5) * self.width * aspect, 1.0]
    }

    /// Angle in radians between the directions of `gaze` and of the point (x, y) of an image of `size`.
    pub fn eccentricity_rad(&self, size: (usize, usize), gaze: Gaze, x: f64, y: f64) -> f64 {
        angle(self.direction(size, gaze.x(), gaze.y()), self.direction(size, x, y))
    }
}

/// Points beyond this many image sizes are taken as being there.
const FARTHEST: f64 = 1e60;

/// Angle between two directions of any length, radians in 0..π: by the arc tangent, which keeps its digits where the
/// angle is small and the arc cosine has none.
pub fn angle(a: [f64; 3], b: [f64; 3]) -> f64 {
    let cross = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    let dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    (cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2]).sqrt().atan2(dot)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_of_a_display_are_seen_under_half_its_field_of_view() {
        for fov in [1.0, 90.0, 170.0] {
            let display = Display::from_fov_deg(fov).unwrap();
            let e = display.eccentricity_rad((80, 60), Gaze::CENTRE, 1.0, 0.5);
            assert!((e.to_degrees() - 0.5 * fov).abs() < 1e-9, "{fov}: {e}");
        }
        assert!((Display::from_size(2.0, 1.0).unwrap().width() - Display::default().width()).abs() < 1e-12);
    }

    #[test]
    fn eccentricity_vanishes_at_the_gaze_only() {
        let gaze = Gaze::new(0.25, 0.75).unwrap();
        let e = |x, y| Display::default().eccentricity_rad((160, 96), gaze, x, y);
        assert_eq!(e(0.25, 0.75), 0.0);
        assert!(e(0.25 + 1e-9, 0.75) > 1e-10);
    }

    #[test]
    fn gazes_however_far_have_a_direction() {
        let display = Display::default();
        let e = |x: f64, at: f64| {
            let gaze = Gaze::new(x, 0.5).unwrap();
            display.eccentricity_rad((160, 96), gaze, at, 0.5).to_degrees()
        };
        for x in [1e12, 1e154, 1e200, f64::MAX] {
            // To an eye that looks straight to the right, edges of 90 degrees are 45 and 135 degrees away.
            for (at, expected) in [(1.0, 45.0), (0.5, 90.0), (0.0, 135.0)] {
                assert!((e(x, at) - expected).abs() < 1e-9, "{x} {at}: {}", e(x, at));
                assert!((e(-x, 1.0 - at) - expected).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn impossible_displays_are_refused() {
        for fov in [0.0, -1.0, 170.1, f64::NAN, f64::INFINITY] {
            assert!(Display::from_fov_deg(fov).is_err(), "{fov}");
        }
        for (w, d) in [(0.0, 1.0), (1.0, 0.0), (f64::NAN, 1.0), (1.0, f64::INFINITY), (100.0, 1.0), (-1.0, -1.0)] {
            assert!(Display::from_size(w, d).is_err(), "{w} {d}");
        }
    }

    #[test]
    fn grids_place_pixels() {
        assert_eq!(PixelGrid::Centres.place(0, 4), 0.125);
        assert_eq!([0, 3].map(|i| PixelGrid::EndPoints.place(i, 4)), [0.0, 1.0]);
        assert_eq!(PixelGrid::EndPoints.place(0, 1), 0.0);
    }
}
