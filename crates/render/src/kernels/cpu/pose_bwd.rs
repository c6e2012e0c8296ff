//! Gradient of the camera's pose: from the gradients of the parameters, summed over the visible splats.
//!
//! One chunk of [`CLUSTER`] visible splats per task. A part in which anything overflows is left out, as its row is in
//! [`super::project_bwd`]; what is not visible is not even looked at, so NaN in it goes nowhere. Parts are computed in
//! float32 and added in float64, chunk by chunk: adding them loses nothing that a float32 could show, however many there
//! are and however they cancel. Nothing visible gives zero.

use super::project::{GaussianSlices, ViewSpec};
use super::project_bwd::{ParameterGradients, color_direction_vjp};
use crate::layout::CLUSTER;
use crate::math::ewa::{to_camera, view_direction};
use crate::math::pose::{TwistGradient, torque, twist_vjp};
use crate::math::quat::Quat;
use crate::math::sh;
use crate::math::vec::Vec3;
use crate::simd::vectorize;
use rayon::prelude::*;

/// Gradient of the pose as a twist from the left, (ω, v): per radian and per world unit, in camera axes. `v` are the
/// gradients of the parameters that [`super::project_bwd::project_bwd`] gave, `visible` the Gaussians it had a splat of.
pub fn pose_bwd(g: &GaussianSlices<'_>, view: &ViewSpec, visible: &[u32], v: &ParameterGradients) -> [f32; 6] {
    let sums: Vec<[f64; 6]> = visible
        .par_chunks(CLUSTER)
        .map(|chunk| {
            let mut sum = [0.0; 6];
            vectorize(
                #[inline(always)]
                || {
                    for &id in chunk {
                        let TwistGradient { omega, v } = row_gradient(g, view, id as usize, v);
                        add_finite(&mut sum, [omega.x, omega.y, omega.z, v.x, v.y, v.z]);
                    }
                },
            );
            sum
        })
        .collect();
    let mut total = [0.0; 6];
    for sum in sums {
        for (t, s) in total.iter_mut().zip(sum) {
            *t += s;
        }
    }
    total.map(|t| t as f32)
}

/// Adds a part, unless a value of it is not finite.
#[inline(always)]
fn add_finite(sum: &mut [f64; 6], part: [f32; 6]) {
    if part.iter().all(|v| v.is_finite()) {
        for (s, v) in sum.iter_mut().zip(part) {
            *s += f64::from(v);
        }
    }
}

/// The part of Gaussian `i`.
#[inline(always)]
fn row_gradient(g: &GaussianSlices<'_>, view: &ViewSpec, i: usize, v: &ParameterGradients) -> TwistGradient {
    let mean = g.mean(i);
    let in_camera = to_camera(view.params, mean);
    let [x, y, z] = v.means.as_chunks::<3>().0[i];
    let v_mean = Vec3 { x, y, z };
    let [w, x, y, z] = v.quats.as_chunks::<4>().0[i];
    let v_turn = torque(g.quat(i), Quat { w, x, y, z });
    let direction = view_direction(view.params, mean);
    let mut v_direction = Vec3 { x: 0.0, y: 0.0, z: 0.0 };
    if g.sh_degree > 0 {
        // The constant basis function tells the gradient of the colour, gated where the colour was clamped.
        let v_color = v.sh.as_chunks::<3>().0[i * g.num_coefficients].map(|v| v / sh::C0);
        v_direction = color_direction_vjp(g, i, direction.unit, &v_color);
    }
    twist_vjp(view.params.rotation, in_camera, v_mean, v_turn, direction.unit, v_direction)
}
