//! The only home of lane numbers, tile size and thresholds that kernels share. Constants of a formula (the dilation,
//! log2(1/255)) stand with the formula in [`crate::math`].

/// Side of a square tile in pixels: one row of a tile is one vector of sixteen lanes, and 256 pixels of state stay in
/// the first-level cache (CPU) or in one workgroup (GPU).
pub const TILE: usize = 16;

/// α below this is skipped: one step of an 8-bit display (Kerbl 2023, App. C).
pub const ALPHA_MIN: f32 = 1.0 / 255.0;

/// Default clamp of α. At 1 a splat would hide everything behind it and the backward pass would divide by 0.
pub const ALPHA_MAX: f32 = 0.999;

/// Largest clamp of α a caller may ask for: above it 1 − α loses more than three digits of the gradient.
pub const ALPHA_MAX_LIMIT: f32 = 0.9999;

/// Guard of 1 − α before the backward pass divides by it; above [`ALPHA_MAX_LIMIT`] only rounding could reach it.
pub const ONE_MINUS_ALPHA_MIN: f32 = 1e-6;

/// Default transmittance at which a pixel stops (Kerbl 2023, App. C).
pub const T_STOP: f32 = 1e-4;

/// Transmittance below this counts as nothing even when a pixel never stops: the backward pass recovers T by division,
/// and a T that has sunk into the denormals no longer says what it was divided by.
pub const T_FLOOR: f32 = 1e-30;

/// Default near plane, world units.
pub const NEAR: f32 = 0.01;

/// The EWA Jacobian is taken inside the image extended by this share of its size on each side: farther out the affine
/// approximation would blow splats up without bound.
pub const JACOBIAN_MARGIN: f32 = 0.15;

/// Determinants of the dilated covariance at or below this are dropped. The dilation keeps it above 0.09.
pub const DET_MIN: f32 = 1e-6;

/// Squared quaternion lengths below this are dropped: their direction is rounding noise.
pub const QUAT_NORM2_MIN: f32 = 1e-6;

/// Extents are widened by this relative share before whole rows or tiles are skipped, so that rounding never skips a
/// pixel that the comparison in the rasteriser would blend.
pub const EXTENT_SLACK: f32 = 1e-5;

/// Gaussians that are culled together: consecutive rows share one bounding box when they are spatially sorted.
pub const CLUSTER: usize = 256;

/// Most (Gaussian, tile) pairs of one frame: their indices must fit 31 bits on every backend.
pub const MAX_PAIRS: u64 = (1 << 31) - 1;

/// Lanes of one projected splat.
pub mod lane {
    /// Image-plane mean x, pixels.
    pub const MEAN_X: usize = 0;
    /// Image-plane mean y, pixels.
    pub const MEAN_Y: usize = 1;
    /// Conic xx, pixels⁻².
    pub const CONIC_XX: usize = 2;
    /// Conic xy, pixels⁻².
    pub const CONIC_XY: usize = 3;
    /// Conic yy, pixels⁻².
    pub const CONIC_YY: usize = 4;
    /// log2 of the opacity.
    pub const LOG2_OPACITY: usize = 5;
    /// Red, after the clamp at 0; green and blue follow.
    pub const RED: usize = 6;
    /// Depth: camera-space z, world units.
    pub const DEPTH: usize = 9;
    /// Half extent of the contour α = 1/255 along x, pixels.
    pub const EXTENT_X: usize = 10;
    /// Half extent of the contour α = 1/255 along y, pixels.
    pub const EXTENT_Y: usize = 11;
    /// Lanes in all.
    pub const COUNT: usize = 12;
}

/// Lanes of the gradient of one projected splat; the first ten mirror [`lane`] (opacity: gradient times opacity).
pub mod grad_lane {
    /// Σ over pixels of |∂L/∂mean x|.
    pub const ABS_X: usize = 10;
    /// Σ over pixels of |∂L/∂mean y|.
    pub const ABS_Y: usize = 11;
    /// Lanes in all.
    pub const COUNT: usize = 12;
}
