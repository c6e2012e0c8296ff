//! The shape of one Gaussian in the image, from its quaternion and scales to the conic, and the way back.

#[cfg(feature = "gpu")]
use cubecl::prelude::*;

use super::compensation::compensation_vjp;
use super::conic::{Dilated, conic, conic_vjp, dilate};
use super::covariance::{factor, factor_vjp_log_scales};
use super::ewa::{
    Linearization, ViewParams, linearize, outer_vjp, project_factor, project_factor_vjp_n, project_factor_vjp_t,
    projection_vjp,
};
use super::quat::{Quat, UnitQuat, normalize, rotation, rotation_vjp};
use super::vec::{Mat2x3, Mat3, Sym2, Vec3, combine, row_times};

/// Σ' of a Gaussian with everything on the way to it.
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Footprint {
    /// The quaternion, normalised.
    pub unit: UnitQuat,
    /// R.
    pub rotation: Mat3,
    /// N = R S, world units.
    pub factor: Mat3,
    /// T = J W.
    pub linearization: Linearization,
    /// M = T N, pixels.
    pub projected_factor: Mat2x3,
    /// Σ' = M Mᵀ + 0.3 I.
    pub dilated: Dilated,
    /// Σ'⁻¹, pixels⁻².
    pub conic: Sym2,
}

/// Σ' and its inverse for a Gaussian whose mean is `in_camera` (Zwicker 2001; Kerbl 2023, Eq. 5).
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn footprint(view: ViewParams, in_camera: Vec3, quat: Quat, scales: Vec3) -> Footprint {
    let unit = normalize(quat);
    let rotation = rotation(unit.q);
    let factor = factor(rotation, scales);
    let linearization = linearize(view, in_camera);
    let projected_factor = project_factor(linearization.t, factor);
    let dilated = dilate(projected_factor);
    Footprint { unit, rotation, factor, linearization, projected_factor, dilated, conic: conic(dilated) }
}

/// Gradient with respect to what places and shapes a Gaussian.
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GeometryGradient {
    /// Of the mean, world frame, without the part through the colour.
    pub mean: Vec3,
    /// Of the raw quaternion.
    pub quat: Quat,
    /// Of the log scales.
    pub log_scales: Vec3,
}

/// Upstream gradient of what a splat looks like in the image.
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SplatGradient {
    /// Of the image-plane mean, x.
    pub mean_x: f32,
    /// Of the image-plane mean, y.
    pub mean_y: f32,
    /// Of the camera-space z.
    pub depth: f32,
    /// Of the conic's scalars.
    pub conic: Sym2,
}

/// Carries the gradient of a splat through [`footprint()`] and the projection of its mean.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn footprint_vjp(
    view: ViewParams,
    fp: Footprint,
    in_camera: Vec3,
    scales: Vec3,
    v: SplatGradient,
) -> GeometryGradient {
    geometry_vjp(view, fp, in_camera, scales, v, factor_vjp(fp, v.conic))
}

/// As [`footprint_vjp()`] in the antialiased mode: the opacity of the splat depends on its shape as well. `v_log_opacity` is
/// the upstream gradient of the logarithm of the compensated opacity.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn antialiased_vjp(
    view: ViewParams,
    fp: Footprint,
    in_camera: Vec3,
    scales: Vec3,
    v: SplatGradient,
    v_log_opacity: f32,
) -> GeometryGradient {
    let a = factor_vjp(fp, v.conic);
    let b = compensation_vjp(fp.projected_factor, fp.dilated, fp.conic, v_log_opacity);
    let v_m =
        Mat2x3 { row0: combine(1.0_f32, a.row0, 1.0_f32, b.row0), row1: combine(1.0_f32, a.row1, 1.0_f32, b.row1) };
    geometry_vjp(view, fp, in_camera, scales, v, v_m)
}

/// Conic → Σ' → M = T N.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
fn factor_vjp(fp: Footprint, v_conic: Sym2) -> Mat2x3 {
    outer_vjp(fp.projected_factor, conic_vjp(fp.conic, v_conic))
}

/// Carries the gradient `v_m` of M = T N and those of mean and depth in `v` to the parameters.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
fn geometry_vjp(
    view: ViewParams,
    fp: Footprint,
    in_camera: Vec3,
    scales: Vec3,
    v: SplatGradient,
    v_m: Mat2x3,
) -> GeometryGradient {
    // N = R S → quaternion and scales.
    let v_n = project_factor_vjp_n(fp.linearization.t, v_m);
    let log_scales = factor_vjp_log_scales(fp.rotation, scales, v_n);
    let v_rotation = Mat3 {
        row0: Vec3 { x: v_n.row0.x * scales.x, y: v_n.row0.y * scales.y, z: v_n.row0.z * scales.z },
        row1: Vec3 { x: v_n.row1.x * scales.x, y: v_n.row1.y * scales.y, z: v_n.row1.z * scales.z },
        row2: Vec3 { x: v_n.row2.x * scales.x, y: v_n.row2.y * scales.y, z: v_n.row2.z * scales.z },
    };
    let quat = rotation_vjp(fp.unit, v_rotation);
    // T = J W, mean and depth → camera space → world.
    let v_t = project_factor_vjp_t(fp.factor, v_m);
    let v_camera = projection_vjp(view, in_camera, fp.linearization, v_t, v.mean_x, v.mean_y);
    let v_camera = Vec3 { x: v_camera.x, y: v_camera.y, z: v_camera.z + v.depth };
    GeometryGradient { mean: row_times(v_camera, view.rotation), quat, log_scales }
}

#[cfg(feature = "gpu")]
super::copy_on_device!(FootprintExpand, GeometryGradientExpand, SplatGradientExpand);
