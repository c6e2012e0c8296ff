//! HVSQ as one differentiable operation, with its gradient written by hand.
//!
//! The result is a scalar, so its gradient is computed together with it; the backward pass only scales it. It is computed
//! where the reference lives: of an image and a reference on the same GPU nothing comes to the host; otherwise the image
//! goes to the reference, and the gradient comes back.

#![expect(deprecated, reason = "burn-ndarray is this project's default CPU backend until its successor replaces it")]

use super::{HvsqReference, ImageView};
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
use gazesplat_core::color::from_u8;
use gazesplat_render::backend::host::{HostTensors, shape_of};
use gazesplat_train::losses::LossTarget;
use std::borrow::Cow;

/// What an image is compared with: the statistics of another, and the photograph they are of where a mask leaves out
/// pixels.
#[derive(Debug, Clone)]
pub struct HvsqTarget {
    /// The statistics.
    pub reference: HvsqReference,
    /// The photograph. Masked pixels take its colours before anything is pooled, so that what is drawn there cannot
    /// matter, and get no gradient.
    pub photo: Option<LossTarget>,
}

/// HVSQ, `[1]`, of `image`, `[H, W, at least 3]`.
///
/// # Panics
/// If the sizes differ: the caller renders at the size of the photograph.
pub fn hvsq(image: Tensor<3>, target: HvsqTarget) -> Tensor<1> {
    Tensor::from_dispatch(<Dispatch as HvsqOps>::hvsq(image.into_dispatch(), target))
}

/// HVSQ on each backend.
#[backend_extension(NdArray, Flex: cfg(feature = "flex"), Cube: cfg(feature = "gpu"), Autodiff)]
pub trait HvsqOps: Backend {
    /// See [`hvsq`](hvsq()).
    fn hvsq(image: FloatTensor<Self>, target: HvsqTarget) -> FloatTensor<Self>;
}

/// What the backward pass needs of a backend without autodiff.
pub trait HvsqGradientOps: HvsqOps {
    /// The value and its gradient by the image.
    fn hvsq_with_gradient(image: FloatTensor<Self>, target: HvsqTarget) -> (FloatTensor<Self>, FloatTensor<Self>);
    /// `gradient` times the only value of `v_value`.
    fn scaled_by_value(gradient: FloatTensor<Self>, v_value: FloatTensor<Self>) -> FloatTensor<Self>;
}

#[derive(Debug)]
struct HvsqBackward;

impl<B: HvsqGradientOps> Backward<B, 1> for HvsqBackward {
    type State = FloatTensor<B>;

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let [image] = ops.parents;
        let v_value = grads.consume::<B>(&ops.node);
        if let Some(node) = image {
            grads.register::<B>(node.id, B::scaled_by_value(ops.state, v_value));
        }
    }
}

impl<B: HvsqGradientOps, C: CheckpointStrategy> HvsqOps for Autodiff<B, C> {
    fn hvsq(image: FloatTensor<Self>, target: HvsqTarget) -> FloatTensor<Self> {
        let node = image.node();
        match HvsqBackward.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let (value, gradient) = B::hvsq_with_gradient(image.into_primitive(), target);
                prep.finish(gradient, value)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::hvsq(image.into_primitive(), target)),
        }
    }
}

impl HvsqOps for NdArray {
    fn hvsq(image: FloatTensor<Self>, target: HvsqTarget) -> FloatTensor<Self> {
        host_value::<Self>(&image, &target)
    }
}

impl HvsqGradientOps for NdArray {
    fn hvsq_with_gradient(image: FloatTensor<Self>, target: HvsqTarget) -> (FloatTensor<Self>, FloatTensor<Self>) {
        host_value_and_gradient::<Self>(&image, &target)
    }

    fn scaled_by_value(gradient: FloatTensor<Self>, v_value: FloatTensor<Self>) -> FloatTensor<Self> {
        host_scaled::<Self>(gradient, &v_value)
    }
}

#[cfg(feature = "flex")]
mod flex {
    use super::{FloatTensor, HvsqGradientOps, HvsqOps, HvsqTarget, host_scaled, host_value, host_value_and_gradient};
    use burn::backend::Flex;

    impl HvsqOps for Flex {
        fn hvsq(image: FloatTensor<Self>, target: HvsqTarget) -> FloatTensor<Self> {
            host_value::<Self>(&image, &target)
        }
    }

    impl HvsqGradientOps for Flex {
        fn hvsq_with_gradient(image: FloatTensor<Self>, target: HvsqTarget) -> (FloatTensor<Self>, FloatTensor<Self>) {
            host_value_and_gradient::<Self>(&image, &target)
        }

        fn scaled_by_value(gradient: FloatTensor<Self>, v_value: FloatTensor<Self>) -> FloatTensor<Self> {
            host_scaled::<Self>(gradient, &v_value)
        }
    }
}

/// Of a reference on the same adapter everything stays there. Of one on the host the image comes to it and the gradient goes
/// back; a device that stopped then gives a value that is not a number, and reading anything else from it is an error.
#[cfg(feature = "gpu")]
mod cube {
    use super::{FloatTensor, HvsqGradientOps, HvsqOps, HvsqTarget, SAME_SIZE, value_and_gradient_of, value_of};
    use crate::hvsq::device::DeviceReference;
    use crate::kernels::gpu::hvsq::{Found, scaled, unmasked, unmasked_bwd};
    use burn_cubecl::{CubeBackend, tensor::CubeTensor};
    use gazesplat_render::gpu::{Gpu, contiguous};
    use gazesplat_train::losses::LossTarget;

    /// The buffers of a comparison are at most a few times as large as the image.
    const FITS: &str = "the adapter holds the statistics of an image of that size";

    /// The adapter, shape and values of an image.
    fn download(image: FloatTensor<CubeBackend>) -> (Gpu, Vec<usize>, Vec<f32>) {
        let image = contiguous(image);
        let gpu = Gpu::of(&image);
        let shape: Vec<usize> = image.meta.shape().iter().copied().collect();
        let values = gpu.read_f32(&image).unwrap_or_else(|_| vec![f32::NAN; shape.iter().product()]);
        (gpu, shape, values)
    }

    /// The photograph where a mask leaves out pixels, as kernels take it: a word per pixel, red in the lowest byte, the
    /// highest 0 at masked pixels.
    fn mask(gpu: &Gpu, target: &HvsqTarget) -> Option<CubeTensor> {
        let photo: &LossTarget = target.photo.as_ref()?;
        let words: Vec<u32> = photo
            .rgb()
            .chunks_exact(3)
            .zip(photo.mask()?)
            .map(|(color, mask)| u32::from_le_bytes([color[0], color[1], color[2], if *mask == 0 { 0 } else { 255 }]))
            .collect();
        Some(gpu.upload_u32(&words, &[words.len()]))
    }

    fn compare(
        image: FloatTensor<CubeBackend>,
        reference: &DeviceReference,
        target: &HvsqTarget,
        gradient: bool,
    ) -> Found {
        let image = contiguous(image);
        let (width, height) = target.reference.size();
        assert_eq!(image.meta.shape()[..2], [height, width], "{SAME_SIZE}");
        let gpu = reference.gpu();
        let Some(mask) = mask(gpu, target) else { return reference.compare(&image, gradient).expect(FITS) };
        let found = reference.compare(&unmasked(gpu, &image, &mask).expect(FITS), gradient).expect(FITS);
        if let Some(v_image) = &found.v_image {
            unmasked_bwd(gpu, v_image, &mask);
        }
        found
    }

    impl HvsqOps for CubeBackend {
        fn hvsq(image: FloatTensor<Self>, target: HvsqTarget) -> FloatTensor<Self> {
            if let Some(reference) = target.reference.on_device() {
                return compare(image, reference, &target, false).value;
            }
            let (gpu, shape, values) = download(image);
            gpu.upload_f32(&[value_of(&values, &shape, &target)], &[1])
        }
    }

    impl HvsqGradientOps for CubeBackend {
        fn hvsq_with_gradient(image: FloatTensor<Self>, target: HvsqTarget) -> (FloatTensor<Self>, FloatTensor<Self>) {
            if let Some(reference) = target.reference.on_device() {
                let found = compare(image, reference, &target, true);
                return (found.value, found.v_image.expect("a gradient was asked for"));
            }
            let (gpu, shape, values) = download(image);
            let (value, gradient) = value_and_gradient_of(&values, &shape, &target);
            (gpu.upload_f32(&[value], &[1]), gpu.upload_f32(&gradient, &shape))
        }

        fn scaled_by_value(gradient: FloatTensor<Self>, v_value: FloatTensor<Self>) -> FloatTensor<Self> {
            scaled(&Gpu::of(&gradient), gradient, contiguous(v_value))
        }
    }
}

fn host_value<B: HostTensors>(image: &FloatTensor<B>, target: &HvsqTarget) -> FloatTensor<B> {
    let value = value_of(&B::f32_slice(image), &shape_of::<B>(image), target);
    B::f32_tensor(vec![value], &[1])
}

fn host_value_and_gradient<B: HostTensors>(
    image: &FloatTensor<B>,
    target: &HvsqTarget,
) -> (FloatTensor<B>, FloatTensor<B>) {
    let shape = shape_of::<B>(image);
    let (value, gradient) = value_and_gradient_of(&B::f32_slice(image), &shape, target);
    (B::f32_tensor(vec![value], &[1]), B::f32_tensor(gradient, &shape))
}

fn host_scaled<B: HostTensors>(mut gradient: FloatTensor<B>, v_value: &FloatTensor<B>) -> FloatTensor<B> {
    let v_value = B::f32_slice(v_value)[0];
    if v_value != 1.0 {
        B::f32_slice_mut(&mut gradient).iter_mut().for_each(|v| *v *= v_value);
    }
    gradient
}

/// Why sizes of an image and its reference cannot differ here.
const SAME_SIZE: &str = "the image has the size of its reference";

/// The value, where sizes come from a user.
pub(super) fn measured(values: &[f32], shape: &[usize], target: &HvsqTarget) -> crate::Result<f64> {
    target.reference.check_image_size((shape[1], shape[0]))?;
    target.reference.value(view(&unmasked(values, shape, target), shape))
}

fn value_of(values: &[f32], shape: &[usize], target: &HvsqTarget) -> f32 {
    let values = unmasked(values, shape, target);
    target.reference.value(view(&values, shape)).expect(SAME_SIZE) as f32
}

fn value_and_gradient_of(values: &[f32], shape: &[usize], target: &HvsqTarget) -> (f32, Vec<f32>) {
    let values = unmasked(values, shape, target);
    let (value, mut gradient) = target.reference.value_and_gradient(view(&values, shape)).expect(SAME_SIZE);
    if let Some(mask) = target.photo.as_ref().and_then(LossTarget::mask) {
        for (v, _) in gradient.chunks_exact_mut(shape[2]).zip(mask).filter(|(_, m)| **m == 0) {
            v.fill(0.0);
        }
    }
    (value as f32, gradient)
}

fn view<'a>(values: &'a [f32], shape: &[usize]) -> ImageView<'a, f32> {
    ImageView { width: shape[1], height: shape[0], channels: shape[2], data: values }
}

/// The image with the photograph's colours where the mask leaves pixels out.
fn unmasked<'a>(values: &'a [f32], shape: &[usize], target: &HvsqTarget) -> Cow<'a, [f32]> {
    let Some(photo) = &target.photo else { return Cow::Borrowed(values) };
    let Some(mask) = photo.mask() else { return Cow::Borrowed(values) };
    let mut values = values.to_vec();
    let pixels = values.chunks_exact_mut(shape[2]).zip(photo.rgb().chunks_exact(3)).zip(mask);
    for ((pixel, color), _) in pixels.filter(|(_, m)| **m == 0) {
        for (v, c) in pixel.iter_mut().zip(color) {
            *v = from_u8(*c);
        }
    }
    Cow::Owned(values)
}
