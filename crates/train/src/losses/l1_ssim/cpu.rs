//! The loss on the CPU backends, over one slice kernel.

use super::{LossGradientOps, LossOps, LossTarget};
use crate::kernels::cpu::l1_ssim::{Comparison, LANE_LOSS, Weights, similarity, similarity_and_gradient};
use burn::backend::{NdArray, tensor::FloatTensor};
use gazesplat_render::host::{HostTensors, shape_of};

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
    let found = similarity(&comparison(&values, &shape, target));
    B::f32_tensor(found.packed(ssim_weight).to_vec(), &[3])
}

fn host_loss_with_gradient<B: HostTensors>(
    image: &FloatTensor<B>,
    target: &LossTarget,
    ssim_weight: f32,
) -> (FloatTensor<B>, FloatTensor<B>) {
    let shape = shape_of::<B>(image);
    let values = B::f32_slice(image);
    let (found, gradient) =
        similarity_and_gradient(&comparison(&values, &shape, target), Weights::of_loss(ssim_weight));
    (B::f32_tensor(found.packed(ssim_weight).to_vec(), &[3]), B::f32_tensor(gradient, &shape))
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
