//! Position noise of stochastic gradient Langevin dynamics (MCMC, Eq. 8).
//!
//! mean += λ_means · noise · gate(o) · Σ η, η ~ N(0, I), gate(o) = σ(−100 (o − 0.005)): only nearly transparent
//! Gaussians explore, within their own shape. Reads all parameters, writes the means; rows that are not finite are left
//! alone. Draws depend on seed, step and row only.

use crate::math::{covariance_times, gate, logit_limit, normals};
use crate::optim::{Columns, Group};
use crate::rng::{Stream, draw};
use gazesplat_render::math::{quat::Quat, vec::Vec3};
use rayon::prelude::*;

/// Rows per job.
const CHUNK: usize = 4096;

/// Adds noise of strength `strength` (learning rate of the means times the noise multiple) to the means.
pub fn add_noise(params: &mut Columns, strength: f32, seed: u64, step: u32) {
    if strength <= 0.0 {
        return;
    }
    let mut means = std::mem::take(params.of_mut(Group::Means));
    let logits = params.of(Group::OpacityLogits);
    let logit_limit = logit_limit();
    means.par_chunks_mut(3 * CHUNK).zip(logits.par_chunks(CHUNK)).enumerate().for_each(|(chunk, (means, logits))| {
        for (i, (mean, &logit)) in means.chunks_exact_mut(3).zip(logits).enumerate() {
            if logit.is_nan() || logit > logit_limit {
                continue;
            }
            let row = chunk * CHUNK + i;
            let gate = gate(logit);
            let words = draw(seed, Stream::Noise, step, row as u64);
            let (q, s) = (params.row(Group::Quats, row), params.row(Group::LogScales, row));
            let shaped = covariance_times(
                Quat { w: q[0], x: q[1], y: q[2], z: q[3] },
                Vec3 { x: s[0], y: s[1], z: s[2] },
                normals(words[0], words[1], words[2], words[3]),
            );
            for (value, noise) in mean.iter_mut().zip([shaped.x, shaped.y, shaped.z]) {
                let moved = *value + strength * gate * noise;
                if moved.is_finite() {
                    *value = moved;
                }
            }
        }
    });
    *params.of_mut(Group::Means) = means;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::GATE_OPACITY;

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
