//! The CIEDE2000 colour difference ΔE₀₀ (ISO/CIE 11664-6; CIE 142-2001) with k_L = k_C = k_H = 1.
//!
//! Written after Sharma, Wu, Dalal, *The CIEDE2000 Color-Difference Formula: Implementation Notes*, 2005, whose equation
//! numbers stand beside the steps.

use glam::DVec3;
use std::f64::consts::{PI, TAU};

/// 25⁷.
const POW25_7: f64 = 6_103_515_625.0;

/// √(C⁷ / (C⁷ + 25⁷)).
fn saturation(chroma: f64) -> f64 {
    let c7 = chroma.powi(7);
    (c7 / (c7 + POW25_7)).sqrt()
}

/// G of Eq. 4: how far the a axis is stretched at chroma C\*.
pub(super) fn stretch(chroma: f64) -> f64 {
    0.5 * (1.0 - saturation(chroma))
}

/// Weights of the difference at a lightness, chroma and hue.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Weights {
    /// Weight of lightness, Eq. 17.
    pub s_l: f64,
    /// Weight of chroma, Eq. 18.
    pub s_c: f64,
    /// Weight of hue, Eq. 19.
    pub s_h: f64,
    /// Rotation of chroma and hue differences in the blue, Eq. 21.
    pub r_t: f64,
}

/// The weights at (L′, C′, h′), h′ in radians, 0…2π (Eq. 15–21).
pub(super) fn weights(lightness: f64, chroma: f64, hue: f64) -> Weights {
    let deg = f64::to_radians;
    let t = 1.0 - 0.17 * (hue - deg(30.0)).cos() + 0.24 * (2.0 * hue).cos() + 0.32 * (3.0 * hue + deg(6.0)).cos()
        - 0.20 * (4.0 * hue - deg(63.0)).cos();
    let from_blue = (hue.to_degrees() - 275.0) / 25.0;
    let rotation = deg(30.0) * (-from_blue * from_blue).exp();
    let from_middle = (lightness - 50.0) * (lightness - 50.0);
    Weights {
        s_l: 1.0 + 0.015 * from_middle / (20.0 + from_middle).sqrt(),
        s_c: 1.0 + 0.045 * chroma,
        s_h: 1.0 + 0.015 * chroma * t,
        r_t: -(2.0 * rotation).sin() * 2.0 * saturation(chroma),
    }
}

/// Hue angle in 0…2π; 0 for an achromatic colour (Eq. 7).
pub(super) fn hue(a: f64, b: f64) -> f64 {
    if a == 0.0 && b == 0.0 {
        return 0.0;
    }
    let h = b.atan2(a);
    if h < 0.0 { h + TAU } else { h }
}

/// ΔE₀₀ of two Lab colours. Symmetric; 0 for equal colours; NaN where a coordinate is.
pub fn delta_e(lab1: DVec3, lab2: DVec3) -> f64 {
    // 1. Chroma and hue with the stretched a axis (Eq. 2–7).
    let g = stretch(0.5 * (lab1.y.hypot(lab1.z) + lab2.y.hypot(lab2.z)));
    let (a1, a2) = ((1.0 + g) * lab1.y, (1.0 + g) * lab2.y);
    let (c1, c2) = (a1.hypot(lab1.z), a2.hypot(lab2.z));
    let (h1, h2) = (hue(a1, lab1.z), hue(a2, lab2.z));
    // 2. Differences (Eq. 8–11).
    let achromatic = c1 * c2 == 0.0;
    let turn = h2 - h1;
    let dh = match () {
        () if achromatic => 0.0,
        () if turn > PI => turn - TAU,
        () if turn < -PI => turn + TAU,
        () => turn,
    };
    let (dl, dc, dh) = (lab2.x - lab1.x, c2 - c1, 2.0 * (c1 * c2).sqrt() * (0.5 * dh).sin());
    // 3. Mean hue (Eq. 14).
    let sum = h1 + h2;
    let mean_hue = match () {
        () if achromatic => sum,
        () if turn.abs() <= PI => 0.5 * sum,
        () if sum < TAU => 0.5 * (sum + TAU),
        () => 0.5 * (sum - TAU),
    };
    // 4. Weighted sum (Eq. 22).
    let w = weights(0.5 * (lab1.x + lab2.x), 0.5 * (c1 + c2), mean_hue);
    let (l, c, h) = (dl / w.s_l, dc / w.s_c, dh / w.s_h);
    // Rounding may leave −1e-16 where the rotation term cancels; a maximum with 0 would hide NaN.
    let squared = l * l + c * c + h * h + w.r_t * c * h;
    if squared < 0.0 { 0.0 } else { squared.sqrt() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grey_differences_are_those_of_lightness_alone() {
        // At L̄ = 50 the weight of lightness is 1.
        assert!((delta_e(DVec3::new(49.0, 0.0, 0.0), DVec3::new(51.0, 0.0, 0.0)) - 2.0).abs() < 1e-12);
    }

    #[test]
    fn what_is_no_colour_differs_by_no_number() {
        let grey = DVec3::new(50.0, 0.0, 0.0);
        for broken in [DVec3::new(f64::NAN, 0.0, 0.0), DVec3::new(50.0, f64::NAN, 0.0), DVec3::new(50.0, 1.0, f64::NAN)]
        {
            assert!(delta_e(grey, broken).is_nan() && delta_e(broken, grey).is_nan(), "{broken}");
        }
    }

    #[test]
    fn equal_colours_do_not_differ_and_order_does_not_matter() {
        for lab in [DVec3::ZERO, DVec3::new(50.0, 60.0, -80.0), DVec3::new(100.0, 0.0, 1e-9)] {
            assert_eq!(delta_e(lab, lab), 0.0);
            for other in [DVec3::new(20.0, -5.0, 3.0), DVec3::new(50.0, -60.0, 80.0)] {
                assert!((delta_e(lab, other) - delta_e(other, lab)).abs() < 1e-12);
            }
        }
    }
}
