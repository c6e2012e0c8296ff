//! Depth of a drawn frame: what the fifth channel of its image is, and the depth that is expected where something is seen.

use crate::renderer::Rendered;
use burn::tensor::Tensor;

/// The accumulated depth is divided by no less than this opacity, as the golden records have it: where nothing is seen the
/// quotient is 0. What is blended at all has an alpha of 1/255 at least.
pub const EXPECTED_DEPTH_ALPHA_MIN: f32 = 1e-10;

impl Rendered {
    /// Σ T α z, `[H, W]`, world units: camera-space z, not distance, each splat weighted by what is seen of it. `None` unless
    /// [`crate::RenderOptions::depth`] asked for it. Differentiable like the image.
    pub fn accumulated_depth(&self) -> Option<Tensor<2>> {
        let [height, width, channels] = self.image.dims();
        (channels == 5).then(|| self.image.clone().slice([0..height, 0..width, 4..5]).reshape([height, width]))
    }

    /// Σ T α z / max(alpha, 1e-10), `[H, W]`, world units: the camera-space z that a ray is expected to end at, given that it
    /// ends on a splat; 0 where it meets none. `None` unless [`crate::RenderOptions::depth`] asked for it. Differentiable like
    /// the image, without a gradient through the guard.
    pub fn expected_depth(&self) -> Option<Tensor<2>> {
        let [height, width, _] = self.image.dims();
        let accumulated = self.accumulated_depth()?;
        let alpha = self.image.clone().slice([0..height, 0..width, 3..4]).reshape([height, width]);
        Some(accumulated / alpha.clamp_min(EXPECTED_DEPTH_ALPHA_MIN))
    }
}
