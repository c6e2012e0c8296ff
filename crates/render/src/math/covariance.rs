//! The covariance factor N = R S of a Gaussian: Σ = N Nᵀ (Kerbl 2023, Eq. 6).
//!
//! The factor is kept instead of Σ: projecting it loses no digits however thin the Gaussian is.

#[cfg(feature = "gpu")]
use cubecl::prelude::*;

use super::vec::{Mat3, Vec3};

/// N = R diag(s).
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn factor(r: Mat3, s: Vec3) -> Mat3 {
    Mat3 {
        row0: Vec3 { x: r.row0.x * s.x, y: r.row0.y * s.y, z: r.row0.z * s.z },
        row1: Vec3 { x: r.row1.x * s.x, y: r.row1.y * s.y, z: r.row1.z * s.z },
        row2: Vec3 { x: r.row2.x * s.x, y: r.row2.y * s.y, z: r.row2.z * s.z },
    }
}

/// Gradient of [`factor()`] with respect to log s: ∂L/∂log s_j = s_j Σ_i V_ij R_ij.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn factor_vjp_log_scales(r: Mat3, s: Vec3, v: Mat3) -> Vec3 {
    Vec3 {
        x: s.x * (v.row0.x * r.row0.x + v.row1.x * r.row1.x + v.row2.x * r.row2.x),
        y: s.y * (v.row0.y * r.row0.y + v.row1.y * r.row1.y + v.row2.y * r.row2.y),
        z: s.z * (v.row0.z * r.row0.z + v.row1.z * r.row1.z + v.row2.z * r.row2.z),
    }
}
