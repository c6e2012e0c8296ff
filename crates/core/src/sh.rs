//! Spherical harmonics as the 3DGS PLY format stores them: real basis, degree 0 to 4.

/// Y₀⁰, the constant basis function 1 / (2 √π).
pub const SH_C0: f32 = 0.282_094_79;

/// Highest degree that is loaded.
pub const MAX_DEGREE: u32 = 4;

/// Number of coefficients per colour channel of SH of `degree`: (degree + 1)².
pub const fn num_coefficients(degree: u32) -> usize {
    ((degree + 1) * (degree + 1)) as usize
}

/// Number of `f_rest_*` properties of a 3DGS PLY of `degree`: all coefficients but the first, of three channels.
pub const fn num_rest(degree: u32) -> usize {
    3 * (num_coefficients(degree) - 1)
}

/// The degree whose coefficients number `n`, if there is one.
pub fn degree_from_coefficients(n: usize) -> Option<u32> {
    (0..=MAX_DEGREE).find(|&d| num_coefficients(d) == n)
}

/// The degree whose `f_rest_*` properties number `n` (0, 9, 24, 45 or 72), if there is one.
pub fn degree_from_rest(n: usize) -> Option<u32> {
    (0..=MAX_DEGREE).find(|&d| num_rest(d) == n)
}

/// DC coefficient that shows the constant colour `c` (colour = SH + ½).
pub fn dc_from_color(c: f32) -> f32 {
    (c - 0.5) / SH_C0
}

/// Constant colour shown by the DC coefficient `dc`, before the clamp at 0.
pub fn color_from_dc(dc: f32) -> f32 {
    dc * SH_C0 + 0.5
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_and_degrees_are_inverse() {
        for degree in 0..=MAX_DEGREE {
            assert_eq!(degree_from_coefficients(num_coefficients(degree)), Some(degree));
            assert_eq!(degree_from_rest(num_rest(degree)), Some(degree));
        }
        assert_eq!((0..=MAX_DEGREE).map(num_rest).collect::<Vec<_>>(), [0, 9, 24, 45, 72]);
        assert_eq!(degree_from_rest(44), None);
        assert_eq!(degree_from_coefficients(0), None);
    }

    #[test]
    fn constant_colour_survives_the_round_trip() {
        assert!((SH_C0 - 0.5 / std::f32::consts::PI.sqrt()).abs() < 1e-7);
        for c in [0.0, 0.25, 1.0] {
            assert!((color_from_dc(dc_from_color(c)) - c).abs() < 1e-6);
        }
    }
}
