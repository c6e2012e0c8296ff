//! The small vectors and matrices the formulas speak.

#[cfg(feature = "gpu")]
use cubecl::prelude::*;

/// A vector (x, y, z).
#[cfg_attr(feature = "gpu", derive(CubeType, CubeLaunch))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Vec3 {
    /// First component.
    pub x: f32,
    /// Second component.
    pub y: f32,
    /// Third component.
    pub z: f32,
}

/// A 3 × 3 matrix by rows.
#[cfg_attr(feature = "gpu", derive(CubeType, CubeLaunch))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mat3 {
    /// First row.
    pub row0: Vec3,
    /// Second row.
    pub row1: Vec3,
    /// Third row.
    pub row2: Vec3,
}

/// A 2 × 3 matrix by rows.
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mat2x3 {
    /// First row.
    pub row0: Vec3,
    /// Second row.
    pub row1: Vec3,
}

/// A symmetric 2 × 2 matrix [[xx, xy], [xy, yy]].
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Sym2 {
    /// Upper left.
    pub xx: f32,
    /// Off-diagonal, once.
    pub xy: f32,
    /// Lower right.
    pub yy: f32,
}

/// a · b.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn dot(a: Vec3, b: Vec3) -> f32 {
    a.x * b.x + a.y * b.y + a.z * b.z
}

/// s a + t b.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn combine(s: f32, a: Vec3, t: f32, b: Vec3) -> Vec3 {
    Vec3 { x: s * a.x + t * b.x, y: s * a.y + t * b.y, z: s * a.z + t * b.z }
}

/// vᵀ m: the rows of `m` weighted by the components of `v`.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn row_times(v: Vec3, m: Mat3) -> Vec3 {
    Vec3 {
        x: v.x * m.row0.x + v.y * m.row1.x + v.z * m.row2.x,
        y: v.x * m.row0.y + v.y * m.row1.y + v.z * m.row2.y,
        z: v.x * m.row0.z + v.y * m.row1.z + v.z * m.row2.z,
    }
}

#[cfg(feature = "gpu")]
super::copy_on_device!(Vec3Expand, Mat3Expand, Mat2x3Expand, Sym2Expand);
