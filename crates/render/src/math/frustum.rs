//! The sides of what a frame can show, widened by the footprint: what lies outside needs no projection.
//!
//! For the left side: the footprint ends left of the image iff fx x/z + cx + e < 0, where its half extent
//! e ≤ √q (fx/z) √(1 + r²) σ + √(0.3 q), r the largest clamped ratio, σ the largest standard deviation and q = 2 ln 255
//! the value on the contour α = 1/255 of an opaque Gaussian. Times z this is linear in the mean. Ours.

#[cfg(feature = "gpu")]
use cubecl::prelude::*;

use super::vec::{Vec3, dot};

/// A half-space. Outside iff normal · mean + offset + pad · σ < 0.
#[cfg_attr(feature = "gpu", derive(CubeType, CubeLaunch))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Side {
    /// Inward normal, not of unit length: pixels.
    pub normal: Vec3,
    /// Pixels times world units.
    pub offset: f32,
    /// Pixels times what a standard deviation of one world unit reaches beyond.
    pub pad: f32,
}

/// The four sides.
#[cfg_attr(feature = "gpu", derive(CubeType, CubeLaunch))]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sides {
    /// Left edge of the image.
    pub left: Side,
    /// Right edge.
    pub right: Side,
    /// Upper edge.
    pub top: Side,
    /// Lower edge.
    pub bottom: Side,
}

/// Whether a Gaussian in front of the near plane with largest standard deviation `scale` lies outside one side for certain.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn is_beyond(side: Side, mean: Vec3, scale: f32) -> bool {
    dot(side.normal, mean) + side.offset + side.pad * scale < 0.0_f32
}

/// Whether it lies outside any side for certain.
#[cfg_attr(feature = "gpu", cube)]
#[inline(always)]
pub fn excludes(sides: Sides, mean: Vec3, scale: f32) -> bool {
    is_beyond(sides.left, mean, scale)
        || is_beyond(sides.right, mean, scale)
        || is_beyond(sides.top, mean, scale)
        || is_beyond(sides.bottom, mean, scale)
}

#[cfg(feature = "gpu")]
super::copy_on_device!(SideExpand, SidesExpand);
