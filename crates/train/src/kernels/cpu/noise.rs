//! Position noise of stochastic gradient Langevin dynamics (MCMC, Eq. 8).
//!
//! mean += λ_means · noise · gate(o) · Σ η, η ~ N(0, I), gate(o) = σ(−100 (o − 0.005)): only nearly transparent
//! Gaussians explore, within their own shape. Reads all parameters, writes the means; rows that are not finite are left
//! alone. Draws depend on seed, step and row only.

use crate::optim::{Columns, Group};
use crate::rng::{Stream, draw, normals};
use rayon::prelude::*;

/// Steepness of the gate.
const GATE_STEEPNESS: f32 = 100.0;
/// Opacity at which the gate is one half.
const GATE_OPACITY: f32 = 0.005;
/// Below this gate (opacity above 0.14) the noise of a whole published run stays under a hundredth of a standard
/// deviation, and the draw is skipped: most Gaussians of a trained model.
const MIN_GATE: f32 = 1e-6;
/// Rows per job.
const CHUNK: usize = 4096;

/// Adds noise of strength `strength` (learning rate of the means times the noise multiple) to the means.
pub fn add_noise(params: &mut Columns, strength: f32, seed: u64, step: u32) {
    if strength <= 0.0 {
        return;
    }
    let mut means = std::mem::take(params.of_mut(Group::Means));
    let logits = params.of(Group::OpacityLogits);
    // gate ≥ MIN_GATE ⇔ opacity ≤ limit: one comparison of logits for most rows.
    let limit = GATE_OPACITY + (1.0 / MIN_GATE - 1.0).ln() / GATE_STEEPNESS;
    let logit_limit = (limit / (1.0 - limit)).ln();
    means.par_chunks_mut(3 * CHUNK).zip(logits.par_chunks(CHUNK)).enumerate().for_each(|(chunk, (means, logits))| {
        for (i, (mean, &logit)) in means.chunks_exact_mut(3).zip(logits).enumerate() {
            if logit.is_nan() || logit > logit_limit {
                continue;
            }
            let row = chunk * CHUNK + i;
            let opacity = 1.0 / (1.0 + (-logit).exp());
            let gate = 1.0 / (1.0 + (GATE_STEEPNESS * (opacity - GATE_OPACITY)).exp());
            let eta = normals(draw(seed, Stream::Noise, step, row as u64));
            let shaped = covariance_times(params.row(Group::Quats, row), params.row(Group::LogScales, row), eta);
            for (value, noise) in mean.iter_mut().zip(shaped) {
                let moved = *value + strength * gate * noise;
                if moved.is_finite() {
                    *value = moved;
                }
            }
        }
    });
    *params.of_mut(Group::Means) = means;
}

/// R diag(s²) Rᵀ v for an unnormalised quaternion (w, x, y, z).
fn covariance_times(quat: &[f32], log_scales: &[f32], v: [f32; 3]) -> [f32; 3] {
    let norm_squared = quat.iter().map(|q| q * q).sum::<f32>();
    let inverse = 1.0 / norm_squared.max(1e-12).sqrt();
    let [w, x, y, z] = [quat[0] * inverse, quat[1] * inverse, quat[2] * inverse, quat[3] * inverse];
    let r = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ];
    let local: [f32; 3] = std::array::from_fn(|k| {
        let variance = (2.0 * log_scales[k]).exp();
        variance * (r[0][k] * v[0] + r[1][k] * v[1] + r[2][k] * v[2])
    });
    std::array::from_fn(|i| r[i][0] * local[0] + r[i][1] * local[1] + r[i][2] * local[2])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn columns(n: usize, opacity: f32) -> Columns {
        let half = 0.5f32.sqrt();
        Columns {
            data: [
                vec![0.0; 3 * n],
                [half, 0.0, 0.0, half].repeat(n),
                [0.1f32.ln(), 0.01f32.ln(), 0.001f32.ln()].repeat(n),
                vec![(opacity / (1.0 - opacity)).ln(); n],
                vec![0.0; 3 * n],
            ],
            widths: [3, 4, 3, 1, 3],
        }
    }

    #[test]
    fn noise_follows_the_covariance() {
        // The quaternion turns x into y, so the widest axis is the world's y.
        let mut params = columns(20_000, GATE_OPACITY);
        add_noise(&mut params, 2.0, 1, 1);
        let spread = |axis: usize| {
            let sum: f32 = params.of(Group::Means).iter().skip(axis).step_by(3).map(|v| v * v).sum();
            (sum / 20_000.0).sqrt()
        };
        for (axis, expected) in [(1, 1e-2), (0, 1e-4), (2, 1e-6)] {
            assert!((spread(axis) / expected - 1.0).abs() < 0.03, "{axis}: {} {expected}", spread(axis));
        }
    }

    #[test]
    fn opaque_gaussians_stay() {
        let mut params = columns(100, 0.5);
        let before = params.clone();
        add_noise(&mut params, 80.0, 1, 1);
        assert_eq!(params, before);
    }
}
