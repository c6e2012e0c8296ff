//! The image-plane ellipse of a Gaussian: dilated covariance, its inverse (the conic), its extent, its rows.

#[cfg(feature = "gpu")]
use cubecl::prelude::*;

use super::vec::{Mat2x3, Sym2, dot};

/// Variance added to the image-plane covariance, pixels²: a Gaussian is never thinner than a pixel (Kerbl 2023).
pub const DILATION: f32 = 0.3;

/// The dilated covariance Σ' = M Mᵀ + 0.3 I and its determinant, both in pixels.
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dilated {
    /// Σ', pixels².
    pub cov: Sym2,
    /// det Σ', pixels⁴.
    pub det: f32,
    /// det Σ'_raw = det(M Mᵀ), before the dilation, pixels⁴.
    pub raw_det: f32,
}

/// Part of a row of pixels, in pixels: empty when `min > max`.
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Span {
    /// Left end.
    pub min: f32,
    /// Right end.
    pub max: f32,
}

/// Σ' and its determinant from the projected factor.
///
/// det(M Mᵀ) is the sum of the squared 2 × 2 minors of M (Cauchy–Binet), so nothing cancels for thin Gaussians:
/// det Σ' = Σ minors² + 0.3 (xx + yy) + 0.09.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn dilate(m: Mat2x3) -> Dilated {
    let xx = dot(m.row0, m.row0);
    let yy = dot(m.row1, m.row1);
    let m01 = m.row0.x * m.row1.y - m.row0.y * m.row1.x;
    let m02 = m.row0.x * m.row1.z - m.row0.z * m.row1.x;
    let m12 = m.row0.y * m.row1.z - m.row0.z * m.row1.y;
    let raw_det = m01 * m01 + m02 * m02 + m12 * m12;
    Dilated {
        cov: Sym2 { xx: xx + DILATION, xy: dot(m.row0, m.row1), yy: yy + DILATION },
        det: raw_det + DILATION * (xx + yy) + DILATION * DILATION,
        raw_det,
    }
}

/// conic = Σ'⁻¹, pixels⁻².
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn conic(d: Dilated) -> Sym2 {
    let inverse = 1.0 / d.det;
    Sym2 { xx: d.cov.yy * inverse, xy: -d.cov.xy * inverse, yy: d.cov.xx * inverse }
}

/// Gradient of [`conic()`] with respect to the scalars of Σ': −Q V Q with Q the conic.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn conic_vjp(q: Sym2, v: Sym2) -> Sym2 {
    let half = 0.5 * v.xy;
    // P = V Q, then −Q P.
    let p00 = v.xx * q.xx + half * q.xy;
    let p01 = v.xx * q.xy + half * q.yy;
    let p10 = half * q.xx + v.yy * q.xy;
    let p11 = half * q.xy + v.yy * q.yy;
    Sym2 {
        xx: -(q.xx * p00 + q.xy * p10),
        xy: -(q.xx * p01 + q.xy * p11) - (q.xy * p00 + q.yy * p10),
        yy: -(q.xy * p01 + q.yy * p11),
    }
}

/// The right boundary of the ellipse {dᵀ conic d ≤ power2} as a function of dy: slope·dy + half_width √(1 − (dy/e)²),
/// with e = 1/`inverse_extent` the half extent along y; the left boundary is its mirror image. Ours: the ellipse
/// equation solved for dx.
#[cfg_attr(feature = "gpu", derive(CubeType))]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Boundary {
    /// The dy at which the right boundary reaches farthest right, pixels.
    pub top: f32,
    /// Pixels right per pixel down of the middle line.
    pub slope: f32,
    /// Half width of the row through the mean, pixels.
    pub half_width: f32,
    /// 1 / half extent along y, pixels⁻¹.
    pub inverse_extent: f32,
}

/// The boundary of the ellipse of a conic; `power2` = 2 ln(255 o), extents as in [`crate::layout::lane`].
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn boundary(q: Sym2, power2: f32, extent_x: f32, extent_y: f32) -> Boundary {
    Boundary {
        top: -(q.xy / q.yy) * extent_x,
        slope: -(q.xy / q.xx),
        half_width: f32::sqrt(power2 / q.xx),
        inverse_extent: 1.0_f32 / extent_y,
    }
}

/// The x-extent, relative to the mean, of the part of the ellipse with dy ∈ [min_y, max_y].
///
/// The right boundary is concave with its maximum at `top`; over an interval the maximum lies there or at the nearer
/// end. An interval that misses the ellipse gives an empty span.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn row_span(b: Boundary, min_y: f32, max_y: f32) -> Span {
    let right_y = f32::min(f32::max(b.top, min_y), max_y);
    let left_y = f32::min(f32::max(-b.top, min_y), max_y);
    let right_u = right_y * b.inverse_extent;
    let left_u = left_y * b.inverse_extent;
    let mut right = b.slope * right_y + b.half_width * f32::sqrt(f32::max(1.0 - right_u * right_u, 0.0));
    let mut left = b.slope * left_y - b.half_width * f32::sqrt(f32::max(1.0 - left_u * left_u, 0.0));
    if min_y * b.inverse_extent > 1.0_f32 || max_y * b.inverse_extent < -1.0_f32 {
        left = 1.0_f32;
        right = -1.0_f32;
    }
    Span { min: left, max: right }
}

#[cfg(feature = "gpu")]
super::copy_on_device!(DilatedExpand, SpanExpand, BoundaryExpand);
