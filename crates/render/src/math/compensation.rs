//! Opacity compensation of the antialiased mode: what the dilation adds to the area of a footprint is taken from its
//! opacity (Yu 2024, Mip-Splatting, Sec. 4.2: the 2D Mip filter).
//!
//! The compensation is √(det Σ'_raw / det Σ'), Σ'_raw = M Mᵀ before and Σ' after the dilation, and no less than 0.005. It is
//! a function of M alone, so what follows the projection need not know of it. Both determinants are sums of squares
//! ([`super::conic::dilate()`]); needles and discs seen edge-on lose no digits that M itself has not lost.

#[cfg(feature = "gpu")]
use cubecl::prelude::*;

use super::conic::{DILATION, Dilated};
use super::vec::{Mat2x3, Sym2, Vec3, combine};

/// Smallest compensation, as in the golden records: a Gaussian far below the size of a pixel keeps this share of its
/// opacity.
pub const COMPENSATION_MIN: f32 = 0.005;

/// What the dilation adds to the determinant: det Σ' − det Σ'_raw = 0.3 (xx + yy) + 0.09, of the scalars of Σ'_raw.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
fn added(d: Dilated) -> f32 {
    DILATION * (d.cov.xx + d.cov.yy - DILATION)
}

/// Whether the compensation is at its floor: det Σ'_raw ≤ 0.005² det Σ', solved for det Σ'_raw, which may be infinite.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
fn is_at_floor(d: Dilated) -> bool {
    d.raw_det <= added(d) * (COMPENSATION_MIN * COMPENSATION_MIN / (1.0_f32 - COMPENSATION_MIN * COMPENSATION_MIN))
}

/// √(max(det Σ'_raw / det Σ', 0.005²)), in [0.005, 1].
///
/// Above the floor det Σ'_raw is at least 2e-6, and 1/(1 + added/det Σ'_raw) is 1 rather than ∞/∞ where it overflows.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn compensation(d: Dilated) -> f32 {
    let mut share = 1.0_f32 / (1.0_f32 + added(d) / d.raw_det);
    if is_at_floor(d) {
        share = COMPENSATION_MIN * COMPENSATION_MIN;
    }
    f32::sqrt(share)
}

#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
fn cross(a: Vec3, b: Vec3) -> Vec3 {
    Vec3 { x: a.y * b.z - a.z * b.y, y: a.z * b.x - a.x * b.z, z: a.x * b.y - a.y * b.x }
}

/// Gradient of v · ln [`compensation()`] with respect to M; 0 at the floor. `conic` is Σ'⁻¹.
///
/// ½ ln det(M Mᵀ) has the gradient P = (M Mᵀ)⁻¹ M and ½ ln det Σ' has Σ'⁻¹ M. Their difference is 0.3 Σ'⁻¹ P, in which
/// nothing large cancels, and with the rows a, b of M and c = a × b the rows of P are b × c and c × a over |c|² = det Σ'_raw:
/// the factors of each are perpendicular, so no digit is lost however parallel a and b are.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn compensation_vjp(m: Mat2x3, d: Dilated, conic: Sym2, v: f32) -> Mat2x3 {
    let mut weight = DILATION * v / d.raw_det;
    if is_at_floor(d) {
        weight = 0.0_f32;
    }
    let c = cross(m.row0, m.row1);
    // The weight first: c alone may be large enough for its products with a and b to overflow.
    let c = Vec3 { x: c.x * weight, y: c.y * weight, z: c.z * weight };
    let p0 = cross(m.row1, c);
    let p1 = cross(c, m.row0);
    Mat2x3 { row0: combine(conic.xx, p0, conic.xy, p1), row1: combine(conic.xy, p0, conic.yy, p1) }
}

#[cfg(test)]
mod tests {
    use super::super::conic::{conic, dilate};
    use super::*;

    fn factor(a: [f32; 3], b: [f32; 3]) -> Mat2x3 {
        let vec = |[x, y, z]: [f32; 3]| Vec3 { x, y, z };
        Mat2x3 { row0: vec(a), row1: vec(b) }
    }

    /// ½ ln(det Σ'_raw / det Σ') in float64, without the floor.
    fn log_compensation(a: [f64; 3], b: [f64; 3]) -> f64 {
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let c = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
        0.5 * (dot(c, c) / (dot(c, c) + 0.3 * (dot(a, a) + dot(b, b)) + 0.09)).ln()
    }

    #[test]
    fn axis_aligned_footprint_has_the_compensation_computed_by_hand() {
        // Variances 4 and 0.25 pixels²: √(1 / (4.3 · 0.55)).
        let d = dilate(factor([2.0, 0.0, 0.0], [0.0, 0.5, 0.0]));
        assert!((compensation(d) - (1.0f32 / (4.3 * 0.55)).sqrt()).abs() < 1e-7);
        // Variances 0.3: √(0.09 / 0.36) = ½.
        let side = 0.3f32.sqrt();
        assert!((compensation(dilate(factor([side, 0.0, 0.0], [0.0, 0.0, side]))) - 0.5).abs() < 1e-7);
    }

    #[test]
    fn it_ends_at_the_floor_and_at_one() {
        assert_eq!(compensation(dilate(factor([0.0; 3], [0.0; 3]))), COMPENSATION_MIN);
        assert_eq!(compensation(dilate(factor([1e-4, 0.0, 0.0], [0.0, 1e-4, 0.0]))), COMPENSATION_MIN);
        // A line on the image, however long.
        assert_eq!(compensation(dilate(factor([1e3, 0.0, 0.0], [2e3, 0.0, 0.0]))), COMPENSATION_MIN);
        for side in [1e6, 1e9, 1e12, 1e18] {
            assert_eq!(compensation(dilate(factor([side, 0.0, 0.0], [0.0, side, 0.0]))), 1.0, "{side:e}");
        }
    }

    /// Relative to the largest component, for footprints from below a pixel to needles of 1e5:1 and discs edge-on.
    #[test]
    fn gradient_equals_differences_in_float64() {
        for (a, b) in [
            ([0.4, 0.1, 0.2], [-0.3, 0.5, 0.1]),
            ([30.0, 2.0, -1.0], [4.0, 25.0, 3.0]),
            ([900.0, 0.02, 0.0], [400.0, 0.0, 0.03]),
            ([300.0, 200.0, 0.01], [150.0, 100.0, 0.02]),
            ([0.05, 0.0, 0.01], [0.0, 0.06, 0.0]),
        ] {
            let m = factor(a, b);
            let d = dilate(m);
            assert!(compensation(d) > COMPENSATION_MIN, "{a:?} {b:?} is above the floor");
            let found = compensation_vjp(m, d, conic(d), 1.0);
            let found = [found.row0.x, found.row0.y, found.row0.z, found.row1.x, found.row1.y, found.row1.z];
            let at = |k: usize, step: f64| {
                let (mut a, mut b) = (a.map(f64::from), b.map(f64::from));
                if k < 3 {
                    a[k] += step
                } else {
                    b[k - 3] += step
                }
                log_compensation(a, b)
            };
            // The scale on which the function bends is its smaller half axis.
            let step =
                1e-5 * f64::from(d.raw_det.sqrt()) / f64::from(a.iter().chain(&b).fold(0.0f32, |m, v| m.max(*v)));
            let expected: Vec<f64> = (0..6).map(|k| (at(k, step) - at(k, -step)) / (2.0 * step)).collect();
            let largest = expected.iter().fold(0.0f64, |m, v| m.max(v.abs()));
            for (found, expected) in found.iter().zip(&expected) {
                // Differences with a step of 1e-5 of the bend are good to 1e-9; float32 is the rest.
                let error = (f64::from(*found) - expected).abs();
                assert!(error < 1e-5 * largest, "{a:?} {b:?}: found {found}, expected {expected}");
            }
        }
    }

    #[test]
    fn gradient_is_zero_at_the_floor_and_finite_everywhere() {
        let d = dilate(factor([1e-3, 0.0, 0.0], [0.0, 1e-3, 0.0]));
        let v = compensation_vjp(factor([1e-3, 0.0, 0.0], [0.0, 1e-3, 0.0]), d, conic(d), 1e6);
        assert_eq!(v, factor([0.0; 3], [0.0; 3]));
        for side in [0.0, 1e-20, 1e-3, 0.04, 1.0, 1e6, 1e12, 1e15] {
            for m in [factor([side, 0.0, 0.0], [0.0, side, 0.0]), factor([side, 0.0, 0.0], [side, 0.0, 0.0])] {
                let d = dilate(m);
                let v = compensation_vjp(m, d, conic(d), 1.0);
                let all = [v.row0.x, v.row0.y, v.row0.z, v.row1.x, v.row1.y, v.row1.z];
                assert!(all.iter().all(|v| v.is_finite()), "{side:e}: {all:?}");
            }
        }
    }
}
