//! Opacity of a Gaussian at a pixel, in base-2 logarithms: α = 2^(log2 o + log2(e)·power), power = −½ dᵀ conic d.
//!
//! Folding the opacity into the exponent saves a multiplication per pixel and turns the 1/255 cut into a comparison
//! that needs no exponential (Kerbl 2023, App. C, with the cut made before the exponential).

#[cfg(feature = "gpu")]
use cubecl::prelude::*;

use super::vec::Sym2;

/// log2(1/255): α below 1/255 is skipped, the step of an 8-bit display.
pub const LOG2_ALPHA_MIN: f32 = -7.994_353_4;

/// log2(e).
pub const LOG2_E: f32 = std::f32::consts::LOG2_E;

/// ln 2.
pub const LN_2: f32 = std::f32::consts::LN_2;

/// The conic scaled so that log2 α = xx·dx² + xy·dx·dy + yy·dy² + log2 o.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn log2_conic(q: Sym2) -> Sym2 {
    Sym2 { xx: -0.5 * LOG2_E * q.xx, xy: -LOG2_E * q.xy, yy: -0.5 * LOG2_E * q.yy }
}

/// log2 α at the offset (dx, dy) = pixel centre − mean, pixels, for a scaled conic of [`log2_conic()`].
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn log2_alpha(q: Sym2, log2_opacity: f32, dx: f32, dy: f32) -> f32 {
    dy * (q.yy * dy + q.xy * dx) + (q.xx * dx * dx + log2_opacity)
}

/// 2 ln(255 o): the value of dᵀ conic d on the contour α = 1/255.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn contour_power2(log2_opacity: f32) -> f32 {
    2.0 * LN_2 * (log2_opacity - LOG2_ALPHA_MIN)
}

/// Logistic function 1 / (1 + e⁻ˣ).
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + f32::exp(-x))
}

/// α behind the test-only smooth cut, and its derivative with respect to α.
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SmoothCut {
    /// α·h(u).
    pub alpha: f32,
    /// d(α·h(u))/dα.
    pub slope: f32,
}

/// The test-only smooth cut α·h(u), u = clamp(255 α − 1, 0, 1), h(u) = u²(3 − 2u): C¹ where the cut at 1/255 jumps.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn smooth_cut(alpha: f32) -> SmoothCut {
    let u = f32::clamp(255.0_f32 * alpha - 1.0_f32, 0.0_f32, 1.0_f32);
    let h = u * u * (3.0_f32 - 2.0_f32 * u);
    SmoothCut { alpha: alpha * h, slope: 255.0_f32 * alpha * (6.0_f32 * u * (1.0_f32 - u)) + h }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn log2_form_is_the_gaussian_of_the_paper() {
        let conic = Sym2 { xx: 0.3, xy: -0.1, yy: 0.2 };
        for (dx, dy, opacity) in [(0.0f32, 0.0f32, 0.9f32), (1.5, -2.0, 0.5), (-3.0, 4.0, 0.99)] {
            let power = -0.5 * (conic.xx * dx * dx + 2.0 * conic.xy * dx * dy + conic.yy * dy * dy);
            let alpha = log2_alpha(log2_conic(conic), opacity.log2(), dx, dy).exp2();
            assert!((alpha / (opacity * power.exp()) - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn the_cut_is_one_step_of_an_8_bit_display() {
        assert!((LOG2_ALPHA_MIN - crate::layout::ALPHA_MIN.log2()).abs() < 1e-6);
        assert!((contour_power2(LOG2_ALPHA_MIN)).abs() < 1e-6);
    }
}
