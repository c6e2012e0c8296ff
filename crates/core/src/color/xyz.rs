//! Linear sRGB and CIE 1931 XYZ (IEC 61966-2-1), and the sRGB transfer curve in `f64` with its slope.
//!
//! All values are relative: white has Y = 1.

use glam::{DMat3, DVec3};

/// A matrix from its rows, as standards print them.
pub(super) const fn from_rows(rows: [[f64; 3]; 3]) -> DMat3 {
    let [[a, b, c], [d, e, f], [g, h, i]] = rows;
    DMat3::from_cols_array(&[a, d, g, b, e, h, c, f, i])
}

/// Linear sRGB to XYZ, D65 (IEC 61966-2-1, with the seven digits in use for it).
pub const XYZ_FROM_LINEAR: DMat3 = from_rows([
    [0.412_456_4, 0.357_576_1, 0.180_437_5],
    [0.212_672_9, 0.715_152_2, 0.072_175_0],
    [0.019_333_9, 0.119_192_0, 0.950_304_1],
]);

/// The white point: the row sums of [`XYZ_FROM_LINEAR`], so that r = g = b is achromatic to the last digit.
pub fn white() -> DVec3 {
    XYZ_FROM_LINEAR * DVec3::ONE
}

/// XYZ of a linear sRGB colour.
pub fn xyz_from_linear(rgb: DVec3) -> DVec3 {
    XYZ_FROM_LINEAR * rgb
}

/// Linear light of an sRGB-encoded channel (IEC 61966-2-1), the twin of [`super::srgb_to_linear`]; 1 and more follow the
/// power law.
pub fn decode(value: f64) -> f64 {
    if value <= KNEE { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// d [`decode`] / d value.
pub fn decode_slope(value: f64) -> f64 {
    if value <= KNEE { 1.0 / 12.92 } else { 2.4 / 1.055 * ((value + 0.055) / 1.055).powf(1.4) }
}

/// Linear light of an encoded colour.
pub fn linear_from_srgb(rgb: DVec3) -> DVec3 {
    rgb.map(decode)
}

/// Encoded value at which the linear toe of the curve ends (IEC 61966-2-1).
const KNEE: f64 = 0.040_45;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn white_is_d65() {
        assert!((white() - DVec3::new(0.950_47, 1.0, 1.088_83)).length() < 1e-6);
    }

    #[test]
    fn decoding_is_that_of_the_images_and_the_slope_its_derivative() {
        for i in 0..=100 {
            let v = f64::from(i) / 100.0 + 1e-3;
            assert!((decode(v) - f64::from(super::super::srgb_to_linear(v as f32))).abs() < 1e-6);
            let h = 1e-6;
            assert!(((decode(v + h) - decode(v - h)) / (2.0 * h) - decode_slope(v)).abs() < 1e-7, "{v}");
        }
    }
}
