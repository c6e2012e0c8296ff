//! Gradient of the camera's pose from the gradients of what it sees.
//!
//! Moving the camera by exp(ω, v) from the left moves every point of the scene so in camera coordinates. Hence the gradient
//! of one splat's part is a function of the gradients of its parameters alone, whatever the renderer did with them: depth,
//! dilation and clamps are in those already.

#[cfg(feature = "gpu")]
use cubecl::prelude::*;

use super::quat::Quat;
use super::vec::{Mat3, Vec3, dot};

/// A gradient with respect to a twist (ω, v).
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TwistGradient {
    /// Per radian, about the axes of the camera.
    pub omega: Vec3,
    /// Per world unit, along the axes of the camera.
    pub v: Vec3,
}

/// a × b.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn cross(a: Vec3, b: Vec3) -> Vec3 {
    Vec3 { x: a.y * b.z - a.z * b.y, y: a.z * b.x - a.x * b.z, z: a.x * b.y - a.y * b.x }
}

/// m a.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn times(m: Mat3, a: Vec3) -> Vec3 {
    Vec3 { x: dot(m.row0, a), y: dot(m.row1, a), z: dot(m.row2, a) }
}

/// Gradient of a turn of the rotation `q` by the angle vector θ from the left, in world axes: of θ at 0, for the gradient `v` of the
/// raw quaternion. The turned one is (1, θ/2) ⊗ q to first order, of whatever length.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn torque(q: Quat, v: Quat) -> Vec3 {
    let u = Vec3 { x: q.x, y: q.y, z: q.z };
    let g = Vec3 { x: v.x, y: v.y, z: v.z };
    let c = cross(u, g);
    Vec3 {
        x: 0.5 * (q.w * g.x - v.w * u.x + c.x),
        y: 0.5 * (q.w * g.y - v.w * u.y + c.y),
        z: 0.5 * (q.w * g.z - v.w * u.z + c.z),
    }
}

/// One splat's part of the gradient of the pose.
///
/// `v_mean` is the whole gradient of the mean, also through its colour: v moves the mean against the camera, and with it the
/// direction it is seen from. ω turns the camera about its own centre, which changes no direction in the world: what
/// `v_mean` holds of the colour, `v_direction` across the unit `direction`, is taken out again.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn twist_vjp(
    rotation: Mat3,
    in_camera: Vec3,
    v_mean: Vec3,
    v_turn: Vec3,
    direction: Vec3,
    v_direction: Vec3,
) -> TwistGradient {
    let v = times(rotation, v_mean);
    let lever = cross(in_camera, v);
    let through_color = cross(direction, v_direction);
    let turned = times(
        rotation,
        Vec3 { x: v_turn.x - through_color.x, y: v_turn.y - through_color.y, z: v_turn.z - through_color.z },
    );
    TwistGradient { omega: Vec3 { x: lever.x + turned.x, y: lever.y + turned.y, z: lever.z + turned.z }, v }
}

#[cfg(feature = "gpu")]
super::copy_on_device!(TwistGradientExpand);
