//! EWA projection of a Gaussian onto the image plane (Zwicker 2001; Kerbl 2023, Eq. 5).

#[cfg(feature = "gpu")]
use cubecl::prelude::*;

use super::vec::{Mat2x3, Mat3, Sym2, Vec3, combine, dot, row_times};

/// A camera as the kernels want it: pinhole, rigid transform, and the limits of the EWA Jacobian.
#[cfg_attr(feature = "gpu", derive(CubeType, CubeLaunch))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewParams {
    /// Rotation from world to camera.
    pub rotation: Mat3,
    /// Translation of the world-to-camera transform.
    pub translation: Vec3,
    /// Camera centre in world coordinates.
    pub position: Vec3,
    /// Focal length x, pixels.
    pub fx: f32,
    /// Focal length y, pixels.
    pub fy: f32,
    /// Principal point x, pixels.
    pub cx: f32,
    /// Principal point y, pixels.
    pub cy: f32,
    /// Smallest x/z the Jacobian is taken at: the image extended by 15 % of its width.
    pub min_x: f32,
    /// Largest x/z the Jacobian is taken at.
    pub max_x: f32,
    /// Smallest y/z the Jacobian is taken at.
    pub min_y: f32,
    /// Largest y/z the Jacobian is taken at.
    pub max_y: f32,
}

/// The Jacobian of the pinhole projection at a camera-space point, with x/z and y/z clamped, times the rotation: T = J W.
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Linearization {
    /// T = J W, pixels per world unit.
    pub t: Mat2x3,
    /// x/z after the clamp.
    pub ratio_x: f32,
    /// y/z after the clamp.
    pub ratio_y: f32,
}

/// Mean in camera coordinates: W p + t.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn to_camera(view: ViewParams, p: Vec3) -> Vec3 {
    Vec3 {
        x: dot(view.rotation.row0, p) + view.translation.x,
        y: dot(view.rotation.row1, p) + view.translation.y,
        z: dot(view.rotation.row2, p) + view.translation.z,
    }
}

/// The affine approximation of the projection at the camera-space point `c` (Zwicker 2001, Eq. 26–29), clamped.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn linearize(view: ViewParams, c: Vec3) -> Linearization {
    let inverse_z = 1.0 / c.z;
    let ratio_x = f32::min(f32::max(c.x * inverse_z, view.min_x), view.max_x);
    let ratio_y = f32::min(f32::max(c.y * inverse_z, view.min_y), view.max_y);
    let jx = view.fx * inverse_z;
    let jy = view.fy * inverse_z;
    let w = view.rotation;
    Linearization {
        t: Mat2x3 {
            row0: combine(jx, w.row0, -jx * ratio_x, w.row2),
            row1: combine(jy, w.row1, -jy * ratio_y, w.row2),
        },
        ratio_x,
        ratio_y,
    }
}

/// The projected factor M = T N, 2 × 3: the image-plane covariance is M Mᵀ.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn project_factor(t: Mat2x3, n: Mat3) -> Mat2x3 {
    Mat2x3 { row0: row_times(t.row0, n), row1: row_times(t.row1, n) }
}

/// Gradient of M Mᵀ with respect to M, for an upstream gradient of the scalars (xx, xy, yy).
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn outer_vjp(m: Mat2x3, v: Sym2) -> Mat2x3 {
    Mat2x3 { row0: combine(2.0 * v.xx, m.row0, v.xy, m.row1), row1: combine(v.xy, m.row0, 2.0 * v.yy, m.row1) }
}

/// Gradient of [`project_factor()`] with respect to N: Tᵀ V.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn project_factor_vjp_n(t: Mat2x3, v: Mat2x3) -> Mat3 {
    Mat3 {
        row0: combine(t.row0.x, v.row0, t.row1.x, v.row1),
        row1: combine(t.row0.y, v.row0, t.row1.y, v.row1),
        row2: combine(t.row0.z, v.row0, t.row1.z, v.row1),
    }
}

/// Gradient of [`project_factor()`] with respect to T: V Nᵀ.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn project_factor_vjp_t(n: Mat3, v: Mat2x3) -> Mat2x3 {
    Mat2x3 {
        row0: Vec3 { x: dot(v.row0, n.row0), y: dot(v.row0, n.row1), z: dot(v.row0, n.row2) },
        row1: Vec3 { x: dot(v.row1, n.row0), y: dot(v.row1, n.row1), z: dot(v.row1, n.row2) },
    }
}

/// Gradient of [`linearize()`] and of the projected mean with respect to the camera-space point.
///
/// A clamped ratio is a constant: nothing flows to x or y, and to z only through 1/z.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn projection_vjp(
    view: ViewParams,
    c: Vec3,
    lin: Linearization,
    v_t: Mat2x3,
    v_mean_x: f32,
    v_mean_y: f32,
) -> Vec3 {
    let w = view.rotation;
    let inverse_z = 1.0 / c.z;
    let jx = view.fx * inverse_z;
    let jy = view.fy * inverse_z;
    let v_j00 = dot(v_t.row0, w.row0);
    let v_j02 = dot(v_t.row0, w.row2);
    let v_j11 = dot(v_t.row1, w.row1);
    let v_j12 = dot(v_t.row1, w.row2);
    let mut v_ratio_x = -jx * v_j02;
    let mut v_ratio_y = -jy * v_j12;
    if c.x * inverse_z != lin.ratio_x {
        v_ratio_x = 0.0;
    }
    if c.y * inverse_z != lin.ratio_y {
        v_ratio_y = 0.0;
    }
    let v_x = (jx * v_mean_x) + v_ratio_x * inverse_z;
    let v_y = (jy * v_mean_y) + v_ratio_y * inverse_z;
    // J = (fx/z) [1, 0, −ratio_x]: its z-derivative is −J/z, and the ratios carry −x/z² and −y/z².
    let through_j = -inverse_z * (jx * (v_j00 - lin.ratio_x * v_j02) + jy * (v_j11 - lin.ratio_y * v_j12));
    let v_z = through_j - inverse_z * (c.x * v_x + c.y * v_y);
    Vec3 { x: v_x, y: v_y, z: v_z }
}

/// Direction from the camera centre to a mean.
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewDirection {
    /// Unit direction; (0, 0, 1) · 0 when the mean is the camera centre.
    pub unit: Vec3,
    /// 1 / distance, in 1 / world units.
    pub inverse_distance: f32,
}

/// Direction in which the camera sees `mean`. The largest component is divided out first, so that far means do not
/// overflow.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn view_direction(view: ViewParams, mean: Vec3) -> ViewDirection {
    let x = mean.x - view.position.x;
    let y = mean.y - view.position.y;
    let z = mean.z - view.position.z;
    let largest = f32::max(f32::max(f32::max(f32::abs(x), f32::abs(y)), f32::abs(z)), f32::MIN_POSITIVE);
    let x = x / largest;
    let y = y / largest;
    let z = z / largest;
    let inverse = 1.0 / f32::sqrt(x * x + y * y + z * z);
    let inverse_distance = inverse / largest;
    ViewDirection { unit: Vec3 { x: x * inverse, y: y * inverse, z: z * inverse }, inverse_distance }
}

/// Gradient of [`view_direction()`] with respect to the mean, for the upstream gradient `v` of the unit direction: only the
/// part across the direction survives, divided by the distance.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn view_direction_vjp(d: ViewDirection, v: Vec3) -> Vec3 {
    let along = v.x * d.unit.x + v.y * d.unit.y + v.z * d.unit.z;
    let s = d.inverse_distance;
    Vec3 { x: (v.x - along * d.unit.x) * s, y: (v.y - along * d.unit.y) * s, z: (v.z - along * d.unit.z) * s }
}

#[cfg(feature = "gpu")]
super::copy_on_device!(ViewParamsExpand, LinearizationExpand, ViewDirectionExpand);
