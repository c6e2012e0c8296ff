//! CIE 1976 L\*a\*b\* (ISO/CIE 11664-4), with the exact rational constants of CIE 15:2004.

use super::xyz::{XYZ_FROM_LINEAR, white, xyz_from_linear};
use glam::{DMat3, DVec3};

/// 6/29: the knee of the lightness curve, in lightness.
const DELTA: f64 = 6.0 / 29.0;

/// Lightness curve: the cube root above (6/29)³, its tangent below.
fn f(t: f64) -> f64 {
    if t > DELTA * DELTA * DELTA { t.cbrt() } else { t / (3.0 * DELTA * DELTA) + 4.0 / 29.0 }
}

/// d f / dt.
fn f_slope(t: f64) -> f64 {
    if t > DELTA * DELTA * DELTA {
        let root = t.cbrt();
        1.0 / (3.0 * root * root)
    } else {
        1.0 / (3.0 * DELTA * DELTA)
    }
}

/// (L, a, b) = [`MIX`] · (f(X), f(Y), f(Z)) − (16, 0, 0).
const MIX: DMat3 = super::xyz::from_rows([[0.0, 116.0, 0.0], [500.0, -500.0, 0.0], [0.0, 200.0, -200.0]]);

/// Lab of an XYZ colour, relative to the white of sRGB; L in 0…100.
pub fn lab_from_xyz(xyz: DVec3) -> DVec3 {
    MIX * (xyz / white()).map(f) - DVec3::new(16.0, 0.0, 0.0)
}

/// Lab of a linear sRGB colour.
pub fn lab_from_linear(rgb: DVec3) -> DVec3 {
    lab_from_xyz(xyz_from_linear(rgb))
}

/// Lab of an sRGB-encoded colour.
pub fn lab_from_srgb(rgb: DVec3) -> DVec3 {
    lab_from_linear(super::xyz::linear_from_srgb(rgb))
}

/// ∂Lab/∂RGB at a linear sRGB colour.
pub fn lab_jacobian(rgb: DVec3) -> DMat3 {
    let white = white();
    let slopes = (xyz_from_linear(rgb) / white).map(f_slope) / white;
    MIX * DMat3::from_diagonal(slopes) * XYZ_FROM_LINEAR
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn greys_are_achromatic_and_white_has_lightness_100() {
        for i in 0..=16 {
            let lab = lab_from_linear(DVec3::splat(f64::from(i) / 16.0));
            assert!(lab.y.abs() < 1e-12 && lab.z.abs() < 1e-12, "{lab}");
        }
        assert!((lab_from_linear(DVec3::ONE).x - 100.0).abs() < 1e-12);
        assert!(lab_from_linear(DVec3::ZERO).length() < 1e-12);
    }

    #[test]
    fn jacobian_is_the_derivative() {
        for rgb in [DVec3::new(0.2, 0.7, 0.05), DVec3::new(1e-4, 2e-3, 5e-4), DVec3::new(0.9, 0.01, 0.4)] {
            let j = lab_jacobian(rgb);
            for axis in 0..3 {
                let h = 1e-7;
                let mut step = DVec3::ZERO;
                step[axis] = h;
                let numeric = (lab_from_linear(rgb + step) - lab_from_linear(rgb - step)) / (2.0 * h);
                assert!((numeric - j.col(axis)).length() < 1e-6 * j.col(axis).length(), "{rgb} axis {axis}");
            }
        }
    }
}
