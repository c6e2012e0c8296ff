//! Real spherical harmonics in the order and signs of the 3DGS PLY format, degree 0 to 4.
//!
//! Each band has its basis functions as polynomials of the unit direction (x, y, z), and the gradient of their weighted
//! sum with respect to that direction (the polynomials taken as functions of three free variables).

#[cfg(feature = "gpu")]
use cubecl::prelude::*;

use super::vec::Vec3;

/// Y of degree 0.
pub const C0: f32 = 0.282_094_78;
/// Factor of degree 1.
pub const C1: f32 = 0.488_602_52;

/// 3 values, one per basis function of degree 1.
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Band1 {
    /// Order m = -1.
    pub m0: f32,
    /// Order m = 0.
    pub m1: f32,
    /// Order m = 1.
    pub m2: f32,
}

/// Basis functions of degree 1 in the unit direction (x, y, z).
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn band1(x: f32, y: f32, z: f32) -> Band1 {
    Band1 { m0: -C1 * y, m1: C1 * z, m2: -C1 * x }
}

/// Gradient of Σ v_m Y_m of degree 1 with respect to (x, y, z): a constant.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn band1_vjp(v: Band1) -> Vec3 {
    let v0 = C1 * v.m0;
    let v1 = C1 * v.m1;
    let v2 = C1 * v.m2;
    Vec3 { x: -v2, y: -v0, z: v1 }
}

/// 5 values, one per basis function of degree 2.
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Band2 {
    /// Order m = -2.
    pub m0: f32,
    /// Order m = -1.
    pub m1: f32,
    /// Order m = 0.
    pub m2: f32,
    /// Order m = 1.
    pub m3: f32,
    /// Order m = 2.
    pub m4: f32,
}

/// Basis functions of degree 2 in the unit direction (x, y, z).
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn band2(x: f32, y: f32, z: f32) -> Band2 {
    Band2 {
        m0: 1.092_548_5_f32 * (x * y),
        m1: -1.092_548_5_f32 * (y * z),
        m2: 0.315_391_57_f32 * (-x * x - y * y + 2.0_f32 * z * z),
        m3: -1.092_548_5_f32 * (x * z),
        m4: 0.546_274_24_f32 * ((x - y) * (x + y)),
    }
}

/// Gradient of Σ v_m Y_m of degree 2 with respect to (x, y, z).
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn band2_vjp(x: f32, y: f32, z: f32, v: Band2) -> Vec3 {
    let v0 = 1.092_548_5_f32 * v.m0;
    let v1 = -1.092_548_5_f32 * v.m1;
    let v2 = 0.315_391_57_f32 * v.m2;
    let v3 = -1.092_548_5_f32 * v.m3;
    let v4 = 0.546_274_24_f32 * v.m4;
    Vec3 {
        x: v0 * (y) + v2 * (-2.0_f32 * x) + v3 * (z) + v4 * (2.0_f32 * x),
        y: v0 * (x) + v1 * (z) + v2 * (-2.0_f32 * y) + v4 * (-2.0_f32 * y),
        z: v1 * (y) + v2 * (4.0_f32 * z) + v3 * (x),
    }
}

/// 7 values, one per basis function of degree 3.
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Band3 {
    /// Order m = -3.
    pub m0: f32,
    /// Order m = -2.
    pub m1: f32,
    /// Order m = -1.
    pub m2: f32,
    /// Order m = 0.
    pub m3: f32,
    /// Order m = 1.
    pub m4: f32,
    /// Order m = 2.
    pub m5: f32,
    /// Order m = 3.
    pub m6: f32,
}

/// Basis functions of degree 3 in the unit direction (x, y, z).
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn band3(x: f32, y: f32, z: f32) -> Band3 {
    Band3 {
        m0: -0.590_043_6_f32 * (y * (3.0_f32 * x * x - y * y)),
        m1: 2.890_611_4_f32 * (x * y * z),
        m2: -0.457_045_8_f32 * (-y * (x * x + y * y - 4.0_f32 * z * z)),
        m3: 0.373_176_34_f32 * (-z * (3.0_f32 * x * x + 3.0_f32 * y * y - 2.0_f32 * z * z)),
        m4: -0.457_045_8_f32 * (-x * (x * x + y * y - 4.0_f32 * z * z)),
        m5: 1.445_305_7_f32 * (z * (x - y) * (x + y)),
        m6: -0.590_043_6_f32 * (x * (x * x - 3.0_f32 * y * y)),
    }
}

/// Gradient of Σ v_m Y_m of degree 3 with respect to (x, y, z).
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn band3_vjp(x: f32, y: f32, z: f32, v: Band3) -> Vec3 {
    let v0 = -0.590_043_6_f32 * v.m0;
    let v1 = 2.890_611_4_f32 * v.m1;
    let v2 = -0.457_045_8_f32 * v.m2;
    let v3 = 0.373_176_34_f32 * v.m3;
    let v4 = -0.457_045_8_f32 * v.m4;
    let v5 = 1.445_305_7_f32 * v.m5;
    let v6 = -0.590_043_6_f32 * v.m6;
    Vec3 {
        x: v0 * (6.0_f32 * x * y)
            + v1 * (y * z)
            + v2 * (-2.0_f32 * x * y)
            + v3 * (-6.0_f32 * x * z)
            + v4 * (-3.0_f32 * x * x - y * y + 4.0_f32 * z * z)
            + v5 * (2.0_f32 * x * z)
            + v6 * (3.0_f32 * (x - y) * (x + y)),
        y: v0 * (3.0_f32 * (x - y) * (x + y))
            + v1 * (x * z)
            + v2 * (-x * x - 3.0_f32 * y * y + 4.0_f32 * z * z)
            + v3 * (-6.0_f32 * y * z)
            + v4 * (-2.0_f32 * x * y)
            + v5 * (-2.0_f32 * y * z)
            + v6 * (-6.0_f32 * x * y),
        z: v1 * (x * y)
            + v2 * (8.0_f32 * y * z)
            + v3 * (-3.0_f32 * (x * x + y * y - 2.0_f32 * z * z))
            + v4 * (8.0_f32 * x * z)
            + v5 * ((x - y) * (x + y)),
    }
}

/// 9 values, one per basis function of degree 4.
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Band4 {
    /// Order m = -4.
    pub m0: f32,
    /// Order m = -3.
    pub m1: f32,
    /// Order m = -2.
    pub m2: f32,
    /// Order m = -1.
    pub m3: f32,
    /// Order m = 0.
    pub m4: f32,
    /// Order m = 1.
    pub m5: f32,
    /// Order m = 2.
    pub m6: f32,
    /// Order m = 3.
    pub m7: f32,
    /// Order m = 4.
    pub m8: f32,
}

/// Basis functions of degree 4 in the unit direction (x, y, z).
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn band4(x: f32, y: f32, z: f32) -> Band4 {
    Band4 {
        m0: 2.503_342_9_f32 * (x * y * (x - y) * (x + y)),
        m1: -1.770_130_8_f32 * (y * z * (3.0_f32 * x * x - y * y)),
        m2: 0.946_174_7_f32 * (x * y * (7.0_f32 * z * z - 1.0)),
        m3: -0.669_046_5_f32 * (y * z * (7.0_f32 * z * z - 3.0)),
        m4: 0.105_785_55_f32 * (35.0_f32 * z * z * z * z - 30.0_f32 * z * z + 3.0),
        m5: -0.669_046_5_f32 * (x * z * (7.0_f32 * z * z - 3.0)),
        m6: 0.473_087_34_f32 * ((x - y) * (x + y) * (7.0_f32 * z * z - 1.0)),
        m7: -1.770_130_8_f32 * (x * z * (x * x - 3.0_f32 * y * y)),
        m8: 0.625_835_7_f32 * ((x * x - 2.0_f32 * x * y - y * y) * (x * x + 2.0_f32 * x * y - y * y)),
    }
}

/// Gradient of Σ v_m Y_m of degree 4 with respect to (x, y, z).
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn band4_vjp(x: f32, y: f32, z: f32, v: Band4) -> Vec3 {
    let v0 = 2.503_342_9_f32 * v.m0;
    let v1 = -1.770_130_8_f32 * v.m1;
    let v2 = 0.946_174_7_f32 * v.m2;
    let v3 = -0.669_046_5_f32 * v.m3;
    let v4 = 0.105_785_55_f32 * v.m4;
    let v5 = -0.669_046_5_f32 * v.m5;
    let v6 = 0.473_087_34_f32 * v.m6;
    let v7 = -1.770_130_8_f32 * v.m7;
    let v8 = 0.625_835_7_f32 * v.m8;
    Vec3 {
        x: v0 * (y * (3.0_f32 * x * x - y * y))
            + v1 * (6.0_f32 * x * y * z)
            + v2 * (y * (7.0_f32 * z * z - 1.0))
            + v5 * (z * (7.0_f32 * z * z - 3.0))
            + v6 * (2.0_f32 * x * (7.0_f32 * z * z - 1.0))
            + v7 * (3.0_f32 * z * (x - y) * (x + y))
            + v8 * (4.0_f32 * x * (x * x - 3.0_f32 * y * y)),
        y: v0 * (x * (x * x - 3.0_f32 * y * y))
            + v1 * (3.0_f32 * z * (x - y) * (x + y))
            + v2 * (x * (7.0_f32 * z * z - 1.0))
            + v3 * (z * (7.0_f32 * z * z - 3.0))
            + v6 * (-2.0_f32 * y * (7.0_f32 * z * z - 1.0))
            + v7 * (-6.0_f32 * x * y * z)
            + v8 * (-4.0_f32 * y * (3.0_f32 * x * x - y * y)),
        z: v1 * (y * (3.0_f32 * x * x - y * y))
            + v2 * (14.0_f32 * x * y * z)
            + v3 * (3.0_f32 * y * (7.0_f32 * z * z - 1.0))
            + v4 * (20.0_f32 * z * (7.0_f32 * z * z - 3.0))
            + v5 * (3.0_f32 * x * (7.0_f32 * z * z - 1.0))
            + v6 * (14.0_f32 * z * (x - y) * (x + y))
            + v7 * (x * (x * x - 3.0_f32 * y * y)),
    }
}

#[cfg(feature = "gpu")]
super::copy_on_device!(Band1Expand, Band2Expand, Band3Expand, Band4Expand);
