//! (1 − λ) L1 + λ (1 − SSIM) (3DGS, Eq. 7) as one differentiable operation.
//!
//! The loss is a scalar, so its gradient is computed together with it, while the windows are at hand; the backward pass
//! only scales it. Nothing is read back from a device.

#![expect(deprecated, reason = "burn-ndarray is this project's default CPU backend until its successor replaces it")]

mod cpu;
#[cfg(feature = "gpu")]
mod gpu;
#[cfg(test)]
mod tests;

pub use crate::kernels::cpu::l1_ssim::{LANE_L1, LANE_LOSS, LANE_SSIM};

use super::{ImageLoss, ImageLossValue, LossTarget};
use burn::backend::{
    Autodiff, Backend, Dispatch,
    autodiff::{
        checkpoint::{base::Checkpointer, strategy::CheckpointStrategy},
        grads::Gradients,
        ops::{Backward, Ops, OpsKind},
    },
    backend_extension,
    tensor::FloatTensor,
};
use burn::tensor::Tensor;

/// The fused loss of 3DGS.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct L1Ssim {
    /// λ, the weight of 1 − SSIM, in 0..1.
    pub ssim_weight: f32,
}

impl ImageLoss for L1Ssim {
    fn evaluate(&self, image: Tensor<3>, target: &LossTarget) -> ImageLossValue {
        let packed = l1_ssim(image, target.clone(), self.ssim_weight);
        // The last two lanes are the terms.
        let terms = packed.clone().inner().narrow(0, LANE_L1, 2);
        ImageLossValue { loss: packed.narrow(0, LANE_LOSS, 1), terms, names: &["l1", "ssim"] }
    }
}

/// Loss, L1 and SSIM, packed as `[3]`, of `image` `[H, W, at least 3]` against `target`; see the lanes. Masks and borders
/// are treated as [`crate::kernels::cpu::l1_ssim`] says.
///
/// # Panics
/// If the sizes differ: the trainer renders at the size of the photograph.
pub fn l1_ssim(image: Tensor<3>, target: LossTarget, ssim_weight: f32) -> Tensor<1> {
    Tensor::from_dispatch(<Dispatch as LossOps>::l1_ssim(image.into_dispatch(), target, ssim_weight))
}

/// The loss on each backend.
#[backend_extension(NdArray, Flex: cfg(feature = "flex"), Cube: cfg(feature = "gpu"), Autodiff)]
pub trait LossOps: Backend {
    /// See [`l1_ssim`](l1_ssim()).
    fn l1_ssim(image: FloatTensor<Self>, target: LossTarget, ssim_weight: f32) -> FloatTensor<Self>;
}

/// What the backward pass needs of a backend without autodiff.
pub trait LossGradientOps: LossOps {
    /// The packed result and the gradient of its loss lane by the image.
    fn l1_ssim_with_gradient(
        image: FloatTensor<Self>,
        target: LossTarget,
        ssim_weight: f32,
    ) -> (FloatTensor<Self>, FloatTensor<Self>);
    /// `gradient` times the loss lane of `v_packed`.
    fn scaled_by_loss(gradient: FloatTensor<Self>, v_packed: FloatTensor<Self>) -> FloatTensor<Self>;
}

#[derive(Debug)]
struct L1SsimBackward;

impl<B: LossGradientOps> Backward<B, 1> for L1SsimBackward {
    type State = FloatTensor<B>;

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let [image] = ops.parents;
        let v_packed = grads.consume::<B>(&ops.node);
        if let Some(node) = image {
            grads.register::<B>(node.id, B::scaled_by_loss(ops.state, v_packed));
        }
    }
}

impl<B: LossGradientOps, C: CheckpointStrategy> LossOps for Autodiff<B, C> {
    fn l1_ssim(image: FloatTensor<Self>, target: LossTarget, ssim_weight: f32) -> FloatTensor<Self> {
        let node = image.node();
        match L1SsimBackward.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let (packed, gradient) = B::l1_ssim_with_gradient(image.into_primitive(), target, ssim_weight);
                prep.finish(gradient, packed)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::l1_ssim(image.into_primitive(), target, ssim_weight)),
        }
    }
}
