//! The image-plane gradient of the means, for strategies that decide by it.

use crate::densify::Observation;
use burn::tensor::{Gradients, Int, Tensor};
use gazesplat_core::Camera;
use gazesplat_render::{MeansProbe, RenderStats, Splats};

/// A leaf of the graph of one step that receives it.
#[derive(Debug)]
pub(super) struct Watch(MeansProbe);

impl Watch {
    /// A watch on the step over `leaves`.
    pub(super) fn new(leaves: &Splats) -> Self {
        Self(MeansProbe::new(leaves.len(), &leaves.device()))
    }

    /// What the renderer delivers to.
    pub(super) fn probe(&self) -> &MeansProbe {
        &self.0
    }

    /// What a strategy is told of a frame; `None` if no gradient arrived.
    pub(super) fn observation(
        &self,
        gradients: &Gradients,
        visible: Tensor<1, Int>,
        stats: &RenderStats,
        camera: &Camera,
    ) -> Option<Observation> {
        let size = [camera.intrinsics.width, camera.intrinsics.height];
        let num_visible = stats.num_visible as usize;
        let gradient = self.0.gradient(gradients)?.inner();
        Some(Observation { gradient, visible: visible.inner(), num_visible, size })
    }
}
