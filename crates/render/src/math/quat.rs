//! Rotations from unnormalised quaternions (w, x, y, z) and the way back.

#[cfg(feature = "gpu")]
use cubecl::prelude::*;

use super::vec::{Mat3, Vec3};

/// A quaternion (w, x, y, z).
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Quat {
    /// Real part.
    pub w: f32,
    /// First imaginary part.
    pub x: f32,
    /// Second imaginary part.
    pub y: f32,
    /// Third imaginary part.
    pub z: f32,
}

/// A quaternion of unit length and the length it had.
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UnitQuat {
    /// q / |q|; garbage when `norm` is 0 or not finite.
    pub q: Quat,
    /// |q|.
    pub norm: f32,
}

/// q / |q| without overflow or underflow of the squares: the largest component is divided out first.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn normalize(q: Quat) -> UnitQuat {
    let largest = f32::max(f32::max(f32::abs(q.w), f32::abs(q.x)), f32::max(f32::abs(q.y), f32::abs(q.z)));
    let scale = 1.0 / largest;
    let w = q.w * scale;
    let x = q.x * scale;
    let y = q.y * scale;
    let z = q.z * scale;
    let length = f32::sqrt(w * w + x * x + y * y + z * z);
    let inverse = 1.0 / length;
    UnitQuat { q: Quat { w: w * inverse, x: x * inverse, y: y * inverse, z: z * inverse }, norm: largest * length }
}

/// Rotation matrix of a unit quaternion (Kerbl 2023, Sec. 4).
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn rotation(q: Quat) -> Mat3 {
    Mat3 {
        row0: Vec3 {
            x: 1.0 - 2.0 * (q.y * q.y + q.z * q.z),
            y: 2.0 * (q.x * q.y - q.w * q.z),
            z: 2.0 * (q.x * q.z + q.w * q.y),
        },
        row1: Vec3 {
            x: 2.0 * (q.x * q.y + q.w * q.z),
            y: 1.0 - 2.0 * (q.x * q.x + q.z * q.z),
            z: 2.0 * (q.y * q.z - q.w * q.x),
        },
        row2: Vec3 {
            x: 2.0 * (q.x * q.z - q.w * q.y),
            y: 2.0 * (q.y * q.z + q.w * q.x),
            z: 1.0 - 2.0 * (q.x * q.x + q.y * q.y),
        },
    }
}

/// Gradient of [`rotation()`] ∘ [`normalize()`] with respect to the raw quaternion.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn rotation_vjp(unit: UnitQuat, v: Mat3) -> Quat {
    let q = unit.q;
    let vw = 2.0 * (q.x * (v.row2.y - v.row1.z) + q.y * (v.row0.z - v.row2.x) + q.z * (v.row1.x - v.row0.y));
    let vx = 2.0
        * (q.w * (v.row2.y - v.row1.z) - 2.0 * q.x * (v.row1.y + v.row2.z)
            + q.y * (v.row0.y + v.row1.x)
            + q.z * (v.row0.z + v.row2.x));
    let vy = 2.0
        * (q.w * (v.row0.z - v.row2.x) + q.x * (v.row0.y + v.row1.x) - 2.0 * q.y * (v.row0.x + v.row2.z)
            + q.z * (v.row1.z + v.row2.y));
    let vz = 2.0
        * (q.w * (v.row1.x - v.row0.y) + q.x * (v.row0.z + v.row2.x) + q.y * (v.row1.z + v.row2.y)
            - 2.0 * q.z * (v.row0.x + v.row1.y));
    // Normalisation: only the part across q̂ survives, divided by the length.
    let along = q.w * vw + q.x * vx + q.y * vy + q.z * vz;
    let inverse = 1.0 / unit.norm;
    Quat {
        w: (vw - q.w * along) * inverse,
        x: (vx - q.x * along) * inverse,
        y: (vy - q.y * along) * inverse,
        z: (vz - q.z * along) * inverse,
    }
}

#[cfg(feature = "gpu")]
super::copy_on_device!(QuatExpand, UnitQuatExpand);
