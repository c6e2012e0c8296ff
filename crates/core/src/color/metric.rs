//! ΔE₀₀ as a metric tensor, in closed form: ΔE₀₀²(x, x + dx) = dxᵀ G dx + O(|dx|³).
//!
//! G is half the Hessian of the squared difference. It is written down rather than differentiated: the squared
//! difference has only two continuous derivatives on the grey axis, where finite differences converge slowly and
//! automatic differentiation divides zero by zero.

use super::ciede2000::{hue, stretch, weights};
use super::lab::{lab_from_linear, lab_jacobian};
use super::xyz::{decode_slope, linear_from_srgb};
use glam::{DMat3, DVec3};

/// Chroma below this is grey: the hue is taken as 0, and every direction around the axis weighs the same.
const GREY: f64 = 1e-9;

/// u vᵀ.
fn outer(u: DVec3, v: DVec3) -> DMat3 {
    DMat3::from_cols(u * v.x, u * v.y, u * v.z)
}

/// G with respect to Lab, ΔE² per unit of Lab².
pub fn metric_lab(lab: DVec3) -> DMat3 {
    // No derivative of the stretch: the formula scales both colours with the one of their mean.
    let g = stretch(lab.y.hypot(lab.z));
    let a = (1.0 + g) * lab.y;
    let chroma = a.hypot(lab.z);
    let (cos, sin, angle) = match chroma < GREY {
        true => (1.0, 0.0, 0.0),
        false => (a / chroma, lab.z / chroma, hue(a, lab.z)),
    };
    let w = weights(lab.x, chroma, angle);
    let lightness = DVec3::new(1.0 / w.s_l, 0.0, 0.0);
    let radial = DVec3::new(0.0, (1.0 + g) * cos, sin) / w.s_c;
    let around = DVec3::new(0.0, -(1.0 + g) * sin, cos) / w.s_h;
    outer(lightness, lightness)
        + outer(radial, radial)
        + outer(around, around)
        + (outer(radial, around) + outer(around, radial)) * (0.5 * w.r_t)
}

/// G with respect to linear sRGB.
pub fn metric_linear(rgb: DVec3) -> DMat3 {
    let jacobian = lab_jacobian(rgb);
    jacobian.transpose() * metric_lab(lab_from_linear(rgb)) * jacobian
}

/// G with respect to sRGB-encoded values.
pub fn metric_srgb(rgb: DVec3) -> DMat3 {
    let slope = DMat3::from_diagonal(rgb.map(decode_slope));
    slope * metric_linear(linear_from_srgb(rgb)) * slope
}

#[cfg(test)]
mod tests {
    use super::super::ciede2000::delta_e;
    use super::super::lab::lab_from_srgb;
    use super::*;

    #[test]
    fn metric_is_the_second_order_of_the_squared_difference() {
        for rgb in [DVec3::new(0.2, 0.7, 0.4), DVec3::splat(0.5), DVec3::new(0.1, 0.1, 0.9), DVec3::new(0.02, 0.5, 0.9)]
        {
            let g = metric_srgb(rgb);
            for v in [DVec3::X, DVec3::Y, DVec3::Z, DVec3::new(1.0, -1.0, 0.5)] {
                let h = 1e-6;
                let found = delta_e(lab_from_srgb(rgb), lab_from_srgb(rgb + v * h)) / h;
                assert!((found / v.dot(g * v).sqrt() - 1.0).abs() < 1e-4, "{rgb} {v}");
            }
        }
    }

    /// Leading minors, on a grid of the whole gamut.
    #[test]
    fn metric_is_positive_definite_on_the_gamut() {
        for i in 0..33 * 33 * 33 {
            let rgb = DVec3::new((i / 1089) as f64, (i / 33 % 33) as f64, (i % 33) as f64) / 32.0;
            for g in [metric_linear(rgb), metric_srgb(rgb)] {
                let (a, b) = (g.x_axis, g.y_axis);
                assert!(a.x > 0.0 && a.x * b.y - a.y * b.x > 0.0 && g.determinant() > 0.0, "{rgb}: {g}");
            }
        }
    }
}
