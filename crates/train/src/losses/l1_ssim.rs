//! (1 − λ) L1 + λ (1 − SSIM) (3DGS, Eq. 7) as one differentiable operation.
//!
//! The loss is a scalar, so its gradient is computed together with it, while the windows are at hand; the backward pass
//! only scales it, and not even that when nothing follows the loss.

#![expect(deprecated, reason = "burn-ndarray is this project's default CPU backend until its successor replaces it")]

use super::ssim_kernel::{Comparison, Similarity, Weights, similarity, similarity_and_gradient};
use super::{ImageLoss, ImageLossValue, LossTarget, LossTerm};
use burn::backend::{
    Autodiff, Backend, Dispatch, NdArray,
    autodiff::{
        checkpoint::{base::Checkpointer, strategy::CheckpointStrategy},
        grads::Gradients,
        ops::{Backward, Ops, OpsKind},
    },
    backend_extension,
    tensor::FloatTensor,
};
use burn::tensor::Tensor;
use gazesplat_render::host::{HostTensors, shape_of};

/// The fused loss of 3DGS.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct L1Ssim {
    /// λ, the weight of 1 − SSIM, in 0..1.
    pub ssim_weight: f32,
}

impl ImageLoss for L1Ssim {
    fn evaluate(&self, image: Tensor<3>, target: &LossTarget) -> ImageLossValue {
        let packed = l1_ssim(image, target.clone(), self.ssim_weight);
        let values = crate::optim::into_vec(packed.clone().inner());
        let terms =
            vec![LossTerm { name: "l1", value: values[LANE_L1] }, LossTerm { name: "ssim", value: values[LANE_SSIM] }];
        ImageLossValue { loss: packed.narrow(0, LANE_LOSS, 1), terms }
    }
}

/// Lane of the packed result that carries the loss, and the only one that carries a gradient.
pub const LANE_LOSS: usize = 0;
/// Lane with the mean absolute difference.
pub const LANE_L1: usize = 1;
/// Lane with the mean SSIM.
pub const LANE_SSIM: usize = 2;

/// Loss, L1 and SSIM, packed as `[3]`, of `image` `[H, W, at least 3]` against `target`; see the lanes. Masks and borders
/// are treated as [`super::ssim_kernel`] says.
///
/// # Panics
/// If the sizes differ: the trainer renders at the size of the photograph.
pub fn l1_ssim(image: Tensor<3>, target: LossTarget, ssim_weight: f32) -> Tensor<1> {
    Tensor::from_dispatch(<Dispatch as LossOps>::l1_ssim(image.into_dispatch(), target, ssim_weight))
}

/// The loss on each backend.
#[backend_extension(NdArray, Flex: cfg(feature = "flex"), Autodiff)]
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

impl LossOps for NdArray {
    fn l1_ssim(image: FloatTensor<Self>, target: LossTarget, ssim_weight: f32) -> FloatTensor<Self> {
        host_loss::<Self>(&image, &target, ssim_weight)
    }
}

impl LossGradientOps for NdArray {
    fn l1_ssim_with_gradient(
        image: FloatTensor<Self>,
        target: LossTarget,
        ssim_weight: f32,
    ) -> (FloatTensor<Self>, FloatTensor<Self>) {
        host_loss_with_gradient::<Self>(&image, &target, ssim_weight)
    }

    fn scaled_by_loss(gradient: FloatTensor<Self>, v_packed: FloatTensor<Self>) -> FloatTensor<Self> {
        host_scaled::<Self>(gradient, &v_packed)
    }
}

#[cfg(feature = "flex")]
mod flex {
    use super::{FloatTensor, LossGradientOps, LossOps, LossTarget, host_loss, host_loss_with_gradient, host_scaled};
    use burn::backend::Flex;

    impl LossOps for Flex {
        fn l1_ssim(image: FloatTensor<Self>, target: LossTarget, ssim_weight: f32) -> FloatTensor<Self> {
            host_loss::<Self>(&image, &target, ssim_weight)
        }
    }

    impl LossGradientOps for Flex {
        fn l1_ssim_with_gradient(
            image: FloatTensor<Self>,
            target: LossTarget,
            ssim_weight: f32,
        ) -> (FloatTensor<Self>, FloatTensor<Self>) {
            host_loss_with_gradient::<Self>(&image, &target, ssim_weight)
        }

        fn scaled_by_loss(gradient: FloatTensor<Self>, v_packed: FloatTensor<Self>) -> FloatTensor<Self> {
            host_scaled::<Self>(gradient, &v_packed)
        }
    }
}

fn host_loss<B: HostTensors>(image: &FloatTensor<B>, target: &LossTarget, ssim_weight: f32) -> FloatTensor<B> {
    let shape = shape_of::<B>(image);
    let values = B::f32_slice(image);
    packed::<B>(similarity(&comparison(&values, &shape, target)), ssim_weight)
}

fn host_loss_with_gradient<B: HostTensors>(
    image: &FloatTensor<B>,
    target: &LossTarget,
    ssim_weight: f32,
) -> (FloatTensor<B>, FloatTensor<B>) {
    let shape = shape_of::<B>(image);
    let values = B::f32_slice(image);
    let weights = Weights { l1: 1.0 - ssim_weight, ssim: -ssim_weight };
    let (found, gradient) = similarity_and_gradient(&comparison(&values, &shape, target), weights);
    (packed::<B>(found, ssim_weight), B::f32_tensor(gradient, &shape))
}

fn host_scaled<B: HostTensors>(mut gradient: FloatTensor<B>, v_packed: &FloatTensor<B>) -> FloatTensor<B> {
    let v_loss = B::f32_slice(v_packed)[LANE_LOSS];
    if v_loss != 1.0 {
        B::f32_slice_mut(&mut gradient).iter_mut().for_each(|v| *v *= v_loss);
    }
    gradient
}

fn comparison<'a>(image: &'a [f32], shape: &[usize], target: &'a LossTarget) -> Comparison<'a, u8> {
    let (width, height) = target.size();
    assert_eq!(&shape[..2], [height, width], "image and photograph differ in size");
    Comparison { width, height, channels: shape[2], image, target: target.rgb(), mask: target.mask() }
}

fn packed<B: HostTensors>(found: Similarity, ssim_weight: f32) -> FloatTensor<B> {
    let w = f64::from(ssim_weight);
    let loss = (1.0 - w) * found.l1 + w * (1.0 - found.ssim);
    B::f32_tensor(vec![loss as f32, found.l1 as f32, found.ssim as f32], &[3])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::losses::WeightedLosses;
    use burn::tensor::{Device, TensorData};
    use gazesplat_core::image::RgbImage8;
    use gazesplat_core::io::images::TrainingImage;
    use std::sync::Arc;

    fn target() -> LossTarget {
        let image = RgbImage8 { width: 9, height: 7, data: (0..189).map(|i| (i * 37 % 256) as u8).collect() };
        LossTarget::new(Arc::new(TrainingImage { image, alpha: None, mask: None }), [0.0; 3])
    }

    fn image(device: &Device) -> Tensor<3> {
        let data: Vec<f32> = (0..9 * 7 * 4).map(|i| (i * 29 % 101) as f32 / 101.0).collect();
        Tensor::from_data(TensorData::new(data, [7, 9, 4]), device).autodiff().require_grad()
    }

    fn gradient(device: &Device, weight: f32) -> (f32, Vec<f32>) {
        let losses = WeightedLosses::default().with(weight, Box::new(L1Ssim { ssim_weight: 0.2 }));
        let image = image(device);
        let (loss, terms) = losses.evaluate(image.clone(), &target()).expect("the test sets this up");
        let gradients = loss.backward();
        (terms.total, crate::optim::into_vec(image.grad(&gradients).expect("the test sets this up")))
    }

    #[test]
    fn the_weight_of_a_term_scales_its_value_and_gradient() {
        let device = gazesplat_render::cpu_device();
        let ((one, v_one), (three, v_three)) = (gradient(&device, 1.0), gradient(&device, 3.0));
        assert!((three - 3.0 * one).abs() < 1e-6);
        assert!(v_one.iter().zip(&v_three).all(|(a, b)| (3.0 * a - b).abs() < 1e-7));
        assert!(v_one.iter().any(|v| *v != 0.0));
    }

    #[cfg(feature = "flex")]
    #[test]
    fn both_cpu_backends_give_the_same_bits() {
        let (ndarray, flex) = (gazesplat_render::cpu_device(), gazesplat_render::flex_device());
        assert_eq!(gradient(&ndarray, 2.0), gradient(&flex, 2.0));
    }
}
