//! Where somebody looks.

use crate::error::{Error, Result};

/// A point of an image that is looked at, in image units: (0, 0) is the upper left corner of the image, (1, 1) the lower
/// right one. Points outside are legal: one can look past a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gaze {
    x: f64,
    y: f64,
}

impl Gaze {
    /// The middle of the image.
    pub const CENTRE: Self = Self { x: 0.5, y: 0.5 };

    /// The point (x, y), any finite numbers.
    ///
    /// # Errors
    /// [`Error::Parameter`] when a coordinate is not finite.
    pub fn new(x: f64, y: f64) -> Result<Self> {
        if x.is_finite() && y.is_finite() {
            return Ok(Self { x, y });
        }
        Err(Error::Parameter { name: "gaze".into(), message: format!("found ({x}, {y}), expected two finite numbers") })
    }

    /// From the left edge of the image, in widths.
    pub fn x(&self) -> f64 {
        self.x
    }

    /// From the upper edge of the image, in heights.
    pub fn y(&self) -> f64 {
        self.y
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_finite_points_can_be_looked_at() {
        assert!(Gaze::new(3.0, -2.0).is_ok());
        for (x, y) in [(f64::NAN, 0.0), (0.0, f64::INFINITY)] {
            assert!(matches!(Gaze::new(x, y), Err(Error::Parameter { .. })));
        }
    }
}
