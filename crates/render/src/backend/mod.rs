//! The renderer as a Burn backend extension: one trait, implemented by every backend and by [`Autodiff`] over them.
//!
//! The whole frame is one differentiable operation. Burn cannot hand out the gradient of a tensor that is not a leaf,
//! so the image-plane gradient that densification needs leaves through an extra leaf, the probe, instead of through an
//! intermediate `projected` tensor between two operations.
//!
//! [`Autodiff`]: burn::backend::Autodiff

mod autodiff;
mod cpu;
#[cfg(feature = "gpu")]
mod cube;
pub mod host;

use crate::error::Result;
use crate::kernels::cpu::project::ViewSpec;
use crate::kernels::cpu::rasterize::RasterOptions;
use crate::options::StatsMode;
use crate::stats::{RenderStats, SplatStats};
use burn::backend::{
    Backend, ExtensionType, backend_extension,
    tensor::{FloatTensor, IntTensor},
};

/// Parameters of N Gaussians, shapes as in [`crate::Splats`].
#[derive(Debug, Clone, ExtensionType)]
pub struct Parameters<B: Backend> {
    /// `[N, 3]`.
    pub means: FloatTensor<B>,
    /// `[N, 4]`.
    pub quats: FloatTensor<B>,
    /// `[N, 3]`.
    pub log_scales: FloatTensor<B>,
    /// `[N]`.
    pub opacity_logits: FloatTensor<B>,
    /// `[N, K, 3]`.
    pub sh: FloatTensor<B>,
}

/// One frame to draw: everything that is not a tensor.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Camera, size, near plane.
    pub view: ViewSpec,
    /// Compositing.
    pub raster: RasterOptions,
    /// SH degree evaluated.
    pub sh_degree: u32,
    /// Counters wanted with the image.
    pub stats: StatsMode,
    /// Keep what a backward pass needs.
    pub keep: bool,
    /// Draw the image; else only count.
    pub draws: bool,
}

/// The image of a frame, and what its backward pass reads.
#[derive(Debug, Clone, ExtensionType)]
pub struct Forward<B: Backend> {
    /// `[H, W, 4 or 5]`; `[0, 0, 4 or 5]` unless [`Frame::draws`].
    pub image: FloatTensor<B>,
    /// What the frame leaves for its backward pass.
    #[extension_type]
    pub saved: Saved<B>,
    /// What was done and skipped, or why nothing could be drawn.
    pub outcome: Result<(RenderStats, SplatStats)>,
}

/// Intermediate results of a frame; all empty unless [`Frame::keep`].
#[derive(Debug, Clone, ExtensionType)]
pub struct Saved<B: Backend> {
    /// Lanes of the visible splats, `[V, 12]`.
    pub lanes: FloatTensor<B>,
    /// Transmittance left at each pixel, `[H, W]`.
    pub final_t: FloatTensor<B>,
    /// Gaussian of each splat, `[V]`: ascending on the CPU, by depth on a GPU.
    pub global_from_compact: IntTensor<B>,
    /// Start of each tile's list, `[tiles + 1]`.
    pub tile_offsets: IntTensor<B>,
    /// Splat of each pair, `[P]`; on a GPU splat and record of each pair, `[P, 2]`.
    pub pair_splats: IntTensor<B>,
    /// First record of each splat, `[V + 1]`.
    pub record_offsets: IntTensor<B>,
    /// Pair of each record, `[P]`; empty on a GPU, whose records lie in the order of their splats.
    pub record_pairs: IntTensor<B>,
    /// End of each tile, `[tiles]`.
    pub tile_ends: IntTensor<B>,
    /// List position at which each pixel stopped, `[H, W]`.
    pub stop: IntTensor<B>,
}

/// What asks for gradients beside those of the parameters: nothing, or leaves that receive them.
#[derive(Debug, Clone, ExtensionType)]
pub struct Probe<B: Backend> {
    /// Of the image-plane means, `[N, 4]`, or `[0, 4]` if nobody asks.
    pub means2d: FloatTensor<B>,
    /// Of the camera's pose, `[6]`, or `[0]` if nobody asks.
    pub pose: FloatTensor<B>,
}

/// Which gradients beside those of the parameters somebody asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wanted {
    /// Those of the image-plane means.
    pub means2d: bool,
    /// That of the camera's pose.
    pub pose: bool,
}

/// Gradients of a frame, shapes as in [`Parameters`] and [`Probe`].
#[derive(Debug, Clone, ExtensionType)]
pub struct Backward<B: Backend> {
    /// Gradients of the parameters.
    #[extension_type]
    pub parameters: Parameters<B>,
    /// Image-plane gradient (x, y) in pixels and the sums of its per-pixel magnitudes; gradient of the pose as a twist from
    /// the left, (ω, v), per radian and world unit.
    #[extension_type]
    pub probe: Probe<B>,
}

/// The renderer's operations. No default bodies: a backend without a kernel does not compile.
#[backend_extension(NdArray, Flex: cfg(feature = "flex"), Cube: cfg(feature = "gpu"), Autodiff)]
pub trait RenderOps: Backend {
    /// Draws a frame.
    fn render_forward(
        #[extension_type] parameters: Parameters<Self>,
        #[extension_type] probe: Probe<Self>,
        frame: Frame,
    ) -> Forward<Self>;

    /// Gradients of a frame drawn with [`Frame::keep`], for the upstream gradient `v_image`, `[H, W, 4 or 5]`.
    fn render_backward(
        #[extension_type] parameters: Parameters<Self>,
        #[extension_type] saved: Saved<Self>,
        v_image: FloatTensor<Self>,
        frame: Frame,
        wanted: Wanted,
    ) -> Backward<Self>;
}
