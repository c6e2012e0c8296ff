//! The scalar formulas of training: one text for CPU and GPU, as in [`gazesplat_render::math`].

#[cfg(feature = "gpu")]
use cubecl::prelude::*;

use gazesplat_render::math::frustum::{Side, Sides, excludes, is_beyond};
use gazesplat_render::math::quat::{Quat, rotation};
use gazesplat_render::math::vec::{Vec3, dot, row_times};

/// 2⁻²⁴.
const UNIFORM_STEP: f32 = 1.0 / 16_777_216.0;
const TAU: f32 = std::f32::consts::TAU;

/// A random word as a number in [0, 1).
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn uniform(word: u32) -> f32 {
    (word >> 8) as f32 * UNIFORM_STEP
}

/// Three independent standard normal numbers from four random words (Box and Muller 1958).
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn normals(word0: u32, word1: u32, word2: u32, word3: u32) -> Vec3 {
    // The radius takes 1 − u in (0, 1]: the logarithm stays finite.
    let radius_a = f32::sqrt(-2.0f32 * f32::ln(1.0f32 - uniform(word0)));
    let radius_b = f32::sqrt(-2.0f32 * f32::ln(1.0f32 - uniform(word2)));
    let angle_a = TAU * uniform(word1);
    let angle_b = TAU * uniform(word3);
    Vec3 { x: radius_a * f32::cos(angle_a), y: radius_a * f32::sin(angle_a), z: radius_b * f32::cos(angle_b) }
}

/// Tiles a Gaussian may be used in without scale decay, T (RTGS Eq. 6).
pub const FREE_TILES: u32 = 4;

/// G = max(U − T, 0) of a Gaussian used in U tiles (RTGS Eq. 6).
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn excess_tiles(used: u32) -> f32 {
    let mut excess = 0u32;
    if used > FREE_TILES {
        excess = used - FREE_TILES;
    }
    excess as f32
}

/// Whether a view with the half-spaces `sides` and `front` may see a Gaussian with largest standard deviation `scale`; true
/// where a value is not finite.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn may_be_seen(sides: Sides, front: Side, mean: Vec3, scale: f32) -> bool {
    !is_beyond(front, mean, scale) && !excludes(sides, mean, scale)
}

/// Steepness of the gate of position noise (MCMC, Eq. 8).
pub const GATE_STEEPNESS: f32 = 100.0;
/// Opacity at which the gate is one half.
pub const GATE_OPACITY: f32 = 0.005;
/// Below this gate (opacity above 0.14) the noise of a whole published run stays under a hundredth of a standard
/// deviation, and the draw is skipped: most Gaussians of a trained model.
const MIN_GATE: f32 = 1e-6;

/// σ(−100 (o − 0.005)) of the opacity o = σ(logit): only nearly transparent Gaussians explore.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn gate(logit: f32) -> f32 {
    let opacity = 1.0 / (1.0 + f32::exp(-logit));
    1.0 / (1.0 + f32::exp(GATE_STEEPNESS * (opacity - GATE_OPACITY)))
}

/// The logit above which the gate is closed: one comparison for most rows.
pub fn logit_limit() -> f32 {
    let limit = GATE_OPACITY + (1.0 / MIN_GATE - 1.0).ln() / GATE_STEEPNESS;
    (limit / (1.0 - limit)).ln()
}

/// R diag(s²) Rᵀ v for an unnormalised quaternion and the logarithms of s.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn covariance_times(q: Quat, log_scales: Vec3, v: Vec3) -> Vec3 {
    let norm_squared = q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z;
    let inverse = 1.0 / f32::sqrt(f32::max(norm_squared, 1e-12));
    let r = rotation(Quat { w: q.w * inverse, x: q.x * inverse, y: q.y * inverse, z: q.z * inverse });
    let along = row_times(v, r);
    let local = Vec3 {
        x: f32::exp(2.0 * log_scales.x) * along.x,
        y: f32::exp(2.0 * log_scales.y) * along.y,
        z: f32::exp(2.0 * log_scales.z) * along.z,
    };
    Vec3 { x: dot(r.row0, local), y: dot(r.row1, local), z: dot(r.row2, local) }
}

/// R diag(s) v for an unnormalised quaternion and the logarithms of s: where v, drawn from a standard normal distribution,
/// lies in the Gaussian of that shape.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn shaped(q: Quat, log_scales: Vec3, v: Vec3) -> Vec3 {
    let norm_squared = q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z;
    let inverse = 1.0 / f32::sqrt(f32::max(norm_squared, 1e-12));
    let r = rotation(Quat { w: q.w * inverse, x: q.x * inverse, y: q.y * inverse, z: q.z * inverse });
    let local =
        Vec3 { x: f32::exp(log_scales.x) * v.x, y: f32::exp(log_scales.y) * v.y, z: f32::exp(log_scales.z) * v.z };
    Vec3 { x: dot(r.row0, local), y: dot(r.row1, local), z: dot(r.row2, local) }
}

/// Length of a gradient in the image plane.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn image_norm(x: f32, y: f32) -> f32 {
    f32::sqrt(x * x + y * y)
}

/// −ln(1 − o) of the opacity o = σ(logit), that is ln(1 + e^logit): of n equal parts each has an n-th of it.
///
/// By ln(1 + t) = 2 artanh(t / (2 + t)), whose series needs seven terms for t ≤ 1: the logarithm of a shader has an
/// absolute error near 1, where faint Gaussians are.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn optical_depth(logit: f32) -> f32 {
    let t = f32::exp(-f32::abs(logit));
    let z = t / (2.0 + t);
    let w = z * z;
    let tail = 1.0f32 / 7.0f32 + w * (1.0f32 / 9.0f32 + w * (1.0f32 / 11.0f32 + w * (1.0f32 / 13.0f32)));
    f32::max(logit, 0.0) + 2.0 * z * (1.0 + w * (1.0f32 / 3.0f32 + w * (1.0f32 / 5.0f32 + w * tail)))
}

/// 1 − e^−x for x ≥ 0 without cancellation: the opacity of an optical depth.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn opacity_of_depth(x: f32) -> f32 {
    let tail = 1.0 - x / 5.0 * (1.0 - x / 6.0 * (1.0 - x / 7.0 * (1.0 - x / 8.0)));
    let mut opacity = x * (1.0 - x / 2.0 * (1.0 - x / 3.0 * (1.0 - x / 4.0 * tail)));
    if x > 0.5 {
        opacity = 1.0 - f32::exp(-x);
    }
    opacity
}

/// Logit of the opacity of an optical depth x > 0: ln((1 − e^−x) / e^−x).
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn logit_of_depth(x: f32) -> f32 {
    f32::ln(opacity_of_depth(x)) + x
}

/// Distance of two nodes of the integral in [`scale_of_parts`].
const NODE_STEP: f32 = 0.12;
/// Nodes besides the one at 0.
const NUM_NODES: u32 = 40;
/// 2 / √π times the distance of two nodes.
const NODE_WEIGHT: f32 = std::f32::consts::FRAC_2_SQRT_PI * NODE_STEP;

/// Factor of the scales of `num_parts` Gaussians of opacity `part` that replace one of opacity `whole` (MCMC, Eq. 9).
///
/// The paper's sum Σ_{k<n} C(n, k + 1) (−1)ᵏ o'^{k+1} / √(k + 1) cancels badly in `f32`. With
/// 1/√(k + 1) = 2/√π ∫₀^∞ e^{−(k+1) s²} ds and the binomial theorem it is
/// 2/√π ∫₀^∞ 1 − (1 − q)ⁿ ds, q = o' e^{−s²}, and 1 − (1 − q)ⁿ = q Σ_{i<n} (1 − q)ⁱ has positive terms only. The integrand
/// is even and entire, so the trapezoidal rule converges exponentially: what it misses are the Fourier coefficients of
/// e^{−j s²} at 2π / 0.12, below e^{−685/j}, times C(n, j) o'ʲ: under 1e-9 of the sum up to 51 parts. The integrand has
/// decayed to e^{−23} of its largest terms at the last node.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn scale_of_parts(whole: f32, part: f32, num_parts: u32) -> f32 {
    let mut integral = 0.0f32;
    for node in 0..NUM_NODES + 1 {
        let s = node as f32 * NODE_STEP;
        let q = part * f32::exp(-s * s);
        let mut power = 1.0f32;
        let mut sum = 0.0f32;
        for _ in 0..num_parts {
            sum += power;
            power *= 1.0 - q;
        }
        // The integral begins in the middle of the even function: the first node counts half.
        if node == 0 {
            integral += 0.5 * q * sum;
        } else {
            integral += q * sum;
        }
    }
    whole / (NODE_WEIGHT * integral)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::densify::relocation::{MAX_PARTS, RelocationTable};

    #[test]
    fn parts_in_f32_equal_the_table_in_f64() {
        let mut worst = [0.0f64; 2];
        for whole in [0.005, 0.006, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 0.99, 0.999, 0.999_9, 0.999_99] {
            let logit = f64::ln(whole / (1.0 - whole)) as f32;
            // The opacity that the rounded logit stands for.
            let whole = 1.0 / (1.0 + (-f64::from(logit)).exp());
            for n in 2..=MAX_PARTS {
                let (part, scale) = RelocationTable::shared().split(whole, n);
                let depth = optical_depth(logit);
                let found = opacity_of_depth(depth / n as f32);
                let found_scale = scale_of_parts(opacity_of_depth(depth), found, n as u32);
                let found_logit = f64::from(logit_of_depth(depth / n as f32));
                let errors = [f64::from(found) / part - 1.0, f64::from(found_scale) / scale - 1.0].map(f64::abs);
                worst = std::array::from_fn(|i| worst[i].max(errors[i]));
                assert!((found_logit - (part / (1.0 - part)).ln()).abs() < 2e-6, "{whole} {n}");
            }
        }
        println!("largest relative errors of opacity and scale: {worst:?}");
        // A few roundings of f32 in the opacity; the sum of 41 nodes of up to 51 terms in the scale.
        assert!(worst[0] < 1e-6 && worst[1] < 3e-6, "{worst:?}");
    }
}
