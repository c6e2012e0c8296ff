//! Tests of the loss as an operation: weights, backends against each other, bits of two runs.

use super::*;
use crate::host::read;
use crate::losses::{LossTerms, WeightedLosses};
use crate::rng::{philox, uniform};
use burn::tensor::{Device, TensorData};
use gazesplat_core::image::RgbImage8;
use gazesplat_core::io::images::TrainingImage;
use gazesplat_testkit::devices::required_gpu;
use std::sync::Arc;

/// Both sides round the same sums of f32 differently: a value adds about a thousand errors of 6e-8 that mostly cancel.
/// Measured on software Vulkan: 1.2e-7.
const VALUE_TOLERANCE: f32 = 1e-6;
/// Relative to the largest gradient of the image, as against float64 in `tests/golden.rs`: E\[x²\] − μ² keeps a thousandth
/// of C2 where variances vanish. Measured on software Vulkan: 7e-7, and 8e-6 on the single pixel, which has no variance.
const GRADIENT_TOLERANCE: f32 = 2e-5;

/// Width, height, and whether there is a mask.
type Case = (usize, usize, bool);

const CASES: [Case; 9] = [
    (1, 1, false),
    (5, 7, false),
    (5, 7, true),
    (16, 16, false),
    (16, 16, true),
    (33, 47, false),
    (33, 47, true),
    (100, 70, false),
    (100, 70, true),
];

fn noise(n: usize, seed: u32) -> impl Iterator<Item = f32> {
    (0..n as u32).map(move |i| uniform(philox([i, 0, 0, 0], [seed, 11])[0]))
}

fn gpu() -> Option<Device> {
    required_gpu(gazesplat_render::device::gpu_device(None))
}

fn target((width, height, masked): Case) -> LossTarget {
    let data = noise(width * height * 3, 1).map(|v| (v * 255.0) as u8).collect();
    let image = RgbImage8 { width: width as u32, height: height as u32, data };
    let mask = masked.then(|| noise(width * height, 2).map(|v| u8::from(v > 0.3)).collect());
    LossTarget::new(Arc::new(TrainingImage { image, alpha: None, mask }), [0.0; 3])
}

/// Noise for the image, near the target every other pixel, and equal to it in some components.
fn image(case: Case, channels: usize) -> Vec<f32> {
    let target = target(case);
    let mut values: Vec<f32> = noise(case.0 * case.1 * channels, 3).collect();
    for (i, (pixel, color)) in values.chunks_exact_mut(channels).zip(target.rgb().chunks_exact(3)).enumerate() {
        for (v, color) in pixel.iter_mut().zip(color) {
            let y = f32::from(*color) * (1.0 / 255.0);
            match i % 4 {
                0 => *v = y + 0.05 * (*v - 0.5),
                1 if *v < 0.2 => *v = y,
                _ => {}
            }
        }
    }
    values
}

struct Evaluated {
    report: LossTerms,
    v_image: Vec<f32>,
}

fn evaluated(device: &Device, case: Case, channels: usize, losses: &WeightedLosses) -> Evaluated {
    let data = TensorData::new(image(case, channels), [case.1, case.0, channels]);
    let image = Tensor::<3>::from_data(data, device).autodiff().require_grad();
    let pending = losses.evaluate(image.clone(), &target(case)).expect("there is a loss");
    let gradients = pending.loss.backward();
    let v_image = read(image.grad(&gradients).expect("the image is a leaf")).expect("the device answers");
    Evaluated { report: pending.read().expect("the device answers"), v_image }
}

fn losses(weight: f32, ssim_weight: f32) -> WeightedLosses {
    WeightedLosses::default().with(weight, Box::new(L1Ssim { ssim_weight }))
}

fn largest(values: &[f32]) -> f32 {
    values.iter().fold(0.0, |a, v| a.max(v.abs()))
}

fn farthest(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).fold(0.0, |worst, (a, b)| worst.max((a - b).abs()))
}

/// The value on its own and with the gradient, the gradient, and zeros where no loss is.
#[test]
fn gpu_equals_cpu_in_value_and_gradient() {
    let Some(gpu) = gpu() else { return };
    let cpu = gazesplat_render::cpu_device();
    for case in CASES {
        for channels in [4, 5] {
            for ssim_weight in [0.0, 0.2, 1.0] {
                let what = format!("{case:?}, {channels} channels, λ {ssim_weight}");
                let losses = losses(1.0, ssim_weight);
                let [expected, found] = [&cpu, &gpu].map(|device| evaluated(device, case, channels, &losses));
                let values = |e: &Evaluated| {
                    [e.report.total, e.report.get("l1").expect("a term"), e.report.get("ssim").expect("a term")]
                };
                assert!(
                    farthest(&values(&expected), &values(&found)) <= VALUE_TOLERANCE,
                    "{what}: {:?} {:?}",
                    expected.report,
                    found.report
                );
                let data = TensorData::new(image(case, channels), [case.1, case.0, channels]);
                let packed = l1_ssim(Tensor::from_data(data, &gpu), target(case), ssim_weight);
                // Another kernel, whose products the driver may fuse otherwise.
                let alone = read(packed).expect("the device answers");
                assert!(farthest(&alone, &values(&expected)) <= VALUE_TOLERANCE, "{what}: {alone:?}");
                let worst = farthest(&expected.v_image, &found.v_image);
                let scale = largest(&expected.v_image);
                assert!(worst <= GRADIENT_TOLERANCE * scale, "{what}: gradient off by {worst} of {scale}");
                let target = target(case);
                for (i, v) in found.v_image.iter().enumerate() {
                    if i % channels >= 3 || target.mask().is_some_and(|m| m[i / channels] == 0) {
                        assert_eq!(*v, 0.0, "{what}: value {i}");
                    }
                }
            }
        }
    }
}

/// 65,538 tiles, more than one axis of a dispatch takes.
#[test]
fn more_tiles_than_one_axis_of_a_dispatch() {
    let Some(gpu) = gpu() else { return };
    let case = (16 * 65_537 + 1, 1, false);
    let losses = losses(1.0, 0.2);
    let [expected, found] = [gazesplat_render::cpu_device(), gpu].map(|device| evaluated(&device, case, 4, &losses));
    assert!((expected.report.total - found.report.total).abs() <= VALUE_TOLERANCE, "{:?}", found.report);
    let worst = farthest(&expected.v_image, &found.v_image);
    assert!(worst <= GRADIENT_TOLERANCE * largest(&expected.v_image), "{worst}");
}

#[test]
fn two_runs_on_the_gpu_give_the_same_bits() {
    let Some(gpu) = gpu() else { return };
    let run = || evaluated(&gpu, (100, 70, true), 4, &losses(1.0, 0.2));
    let (one, two) = (run(), run());
    assert_eq!(one.report, two.report);
    assert_eq!(one.v_image, two.v_image);
}

#[test]
fn the_weight_of_a_term_scales_its_value_and_gradient() {
    for device in [Some(gazesplat_render::cpu_device()), gpu()].into_iter().flatten() {
        let [one, three] = [1.0, 3.0].map(|w| evaluated(&device, (9, 7, false), 4, &losses(w, 0.2)));
        assert!((three.report.total - 3.0 * one.report.total).abs() < 1e-6);
        assert_eq!(three.report.terms, one.report.terms);
        let tripled: Vec<f32> = one.v_image.iter().map(|v| 3.0 * v).collect();
        // One rounding of a product on each side.
        assert!(farthest(&tripled, &three.v_image) <= 2.4e-7 * largest(&tripled));
        assert!(largest(&one.v_image) > 0.0);
    }
}

#[test]
fn a_sum_of_losses_reports_every_term_in_order() {
    for device in [Some(gazesplat_render::cpu_device()), gpu()].into_iter().flatten() {
        let two = losses(0.5, 0.0).with(2.0, Box::new(L1Ssim { ssim_weight: 1.0 }));
        let Evaluated { report, v_image } = evaluated(&device, (33, 47, true), 4, &two);
        let names: Vec<_> = report.terms.iter().map(|t| t.name).collect();
        assert_eq!(names, ["l1", "ssim", "l1", "ssim"]);
        let (l1, ssim) = (report.terms[0].value, report.terms[3].value);
        assert!((report.total - (0.5 * l1 + 2.0 * (1.0 - ssim))).abs() < 1e-6, "{report:?}");
        let parts = [(0.5, 0.0), (2.0, 1.0)].map(|(w, l)| evaluated(&device, (33, 47, true), 4, &losses(w, l)).v_image);
        let sum: Vec<f32> = parts[0].iter().zip(&parts[1]).map(|(a, b)| a + b).collect();
        assert!(farthest(&sum, &v_image) <= 2.4e-7 * largest(&sum));
    }
}

#[test]
fn nothing_to_compare_has_no_loss_and_no_gradient() {
    for device in [Some(gazesplat_render::cpu_device()), gpu()].into_iter().flatten() {
        let photo = RgbImage8 { width: 20, height: 3, data: vec![90; 180] };
        let photo = TrainingImage { image: photo, alpha: None, mask: Some(vec![0; 60]) };
        let target = LossTarget::new(Arc::new(photo), [0.0; 3]);
        let image = Tensor::<3>::full([3, 20, 4], f32::NAN, &device).autodiff().require_grad();
        let pending = losses(1.0, 0.2).evaluate(image.clone(), &target).expect("there is a loss");
        let gradients = pending.loss.backward();
        let report = pending.read().expect("the device answers");
        assert_eq!((report.total, report.get("l1"), report.get("ssim")), (0.0, Some(0.0), Some(1.0)));
        let v_image = read(image.grad(&gradients).expect("the image is a leaf")).expect("the device answers");
        assert!(v_image.len() == 240 && v_image.iter().all(|v| *v == 0.0));
    }
}

#[test]
fn nan_shows_in_the_loss_unless_masked() {
    for device in [Some(gazesplat_render::cpu_device()), gpu()].into_iter().flatten() {
        for masked in [false, true] {
            let case = (33, 20, true);
            let target = target(case);
            let mask = target.mask().expect("there is a mask");
            let at = mask.iter().position(|m| (*m == 0) == masked).expect("there are both");
            let mut values = image(case, 4);
            values[4 * at + 1] = f32::NAN;
            let image = Tensor::<3>::from_data(TensorData::new(values, [20, 33, 4]), &device);
            let report = losses(1.0, 0.2).evaluate(image, &target).expect("a loss").read().expect("the device answers");
            assert_eq!(report.total.is_nan(), !masked, "{report:?}");
        }
    }
}

/// A kernel that no adapter takes.
#[cfg(feature = "gpu")]
mod refused {
    use cubecl::prelude::*;

    #[cube(launch)]
    pub(super) fn fill(values: &mut [f32]) {
        let mut shared = Shared::<[f32]>::new_slice(1_000_000usize);
        shared[UNIT_POS as usize] = 1.0_f32;
        sync_cube();
        if ABSOLUTE_POS < values.len() {
            values[ABSOLUTE_POS] = shared[0];
        }
    }
}

/// What a lost adapter looks like from here: the image was never drawn.
#[cfg(feature = "gpu")]
#[test]
fn reading_from_a_device_that_failed_is_an_error() {
    use burn::backend::{BackendTensor, DispatchTensorKind};
    use gazesplat_render::gpu::{Gpu, cube_dim};

    let Some(gpu) = gpu() else { return };
    let case = (9, 7, false);
    let image = Tensor::<3>::from_data(TensorData::new(image(case, 4), [7, 9, 4]), &gpu);
    let DispatchTensorKind::Cube(BackendTensor::Float(values)) = image.clone().into_dispatch().kind else {
        panic!("the image is on the GPU")
    };
    let gpu = Gpu::of(&values);
    refused::fill::launch(&gpu.client, gpu.cubes(1), cube_dim(), values.into_buffer_arg());
    let pending = losses(1.0, 0.2).evaluate(image, &target(case)).expect("there is a loss");
    let error = pending.read().expect_err("nothing was computed");
    assert!(matches!(error, crate::Error::Render(gazesplat_render::Error::Device { .. })), "{error}");
}

#[cfg(feature = "flex")]
#[test]
fn both_cpu_backends_give_the_same_bits() {
    let devices = [gazesplat_render::cpu_device(), gazesplat_render::flex_device()];
    let [one, two] = devices.map(|device| evaluated(&device, (9, 7, false), 4, &losses(2.0, 0.2)));
    assert_eq!(one.report, two.report);
    assert_eq!(one.v_image, two.v_image);
}
