//! SSIM and Adam against the golden records (float64, torch), on the CPU and on a GPU.

use burn::tensor::Tensor;
use gazesplat_render::simd::SimdLevel;
use gazesplat_testkit::golden;
use gazesplat_train::kernels::cpu::l1_ssim::{Comparison, Similarity, Weights, similarity, similarity_and_gradient};
use gazesplat_train::optim::{AdamSettings, Columns, Group, LearningRates, ModelState, Regularizers};

/// f32 arithmetic on images of up to 56 × 40: the sums themselves are exact to about 1e-7.
const VALUE_TOLERANCE: f64 = 1e-6;
/// Relative to the largest gradient of the image; E[x²] − μ² loses up to 1e-3 of C2 where variances vanish.
const GRADIENT_TOLERANCE: f64 = 2e-5;

/// An image and its reference, `[height, width, 3]`.
struct Pair {
    width: usize,
    height: usize,
    image: Vec<f32>,
    target: Vec<f32>,
}

/// `evaluate` gives L1 and SSIM of a pair, and the gradient of the loss with a weight λ of 1 − SSIM.
fn golden_ssim_values_and_gradients(device: &str, evaluate: impl Fn(&Pair, f32) -> (Similarity, Vec<f32>)) {
    let golden = golden::find("ssim").expect("golden record ssim").load();
    let sets: Vec<String> =
        golden.json.as_object().expect("an object").keys().filter(|k| *k != "constants").cloned().collect();
    assert!(!sets.is_empty());
    for set in &sets {
        let image = golden.f32(&format!("{set}.img"));
        let target = golden.f32(&format!("{set}.ref"));
        let [height, width, 3] = *golden.shape(&format!("{set}.img")) else { panic!("images are [H, W, 3]") };
        let pair = Pair { width, height, image, target };
        let number = |key: &str| golden.number(&format!("{set}.{key}")).expect(key);
        // The record of SSIM alone rises with it, the loss falls.
        for (name, ssim_weight, sign) in [("mean_ssim_zero", 1.0, -1.0), ("l1", 0.0, 1.0), ("loss_3dgs", 0.2, 1.0)] {
            let (found, gradient) = evaluate(&pair, ssim_weight);
            assert!((found.ssim - number("ssim_zero")).abs() < VALUE_TOLERANCE, "{device} {set} {found:?}");
            assert!((found.l1 - number("l1")).abs() < VALUE_TOLERANCE, "{device} {set} {found:?}");
            let expected = golden.f64(&format!("{set}.grad_{name}"));
            assert_eq!(gradient.len(), expected.len(), "{device} {set} {name}");
            let largest = expected.iter().fold(0.0f64, |a, v| a.max(v.abs()));
            let off = |(f, e): (&f32, &f64)| (sign * f64::from(*f) - e).abs();
            let worst = gradient.iter().zip(&expected).map(off).fold(0.0, f64::max);
            assert!(worst < GRADIENT_TOLERANCE * largest, "{device} {set} {name}: {worst} of {largest}");
        }
    }
}

#[test]
fn golden_ssim_on_the_cpu_at_every_simd_level() {
    for level in SimdLevel::ALL.into_iter().filter(|l| l.is_available()) {
        gazesplat_render::simd::force_level(Some(level));
        golden_ssim_values_and_gradients(&format!("{level:?}"), |pair, ssim_weight| {
            let &Pair { width, height, ref image, ref target } = pair;
            let comparison = Comparison { width, height, channels: 3, image, target: &target[..], mask: None };
            let (found, gradient) = similarity_and_gradient(&comparison, Weights::of_loss(ssim_weight));
            assert_eq!(found, similarity(&comparison));
            (found, gradient)
        });
    }
    gazesplat_render::simd::force_level(None);
}

/// Measured on software Vulkan: off by at most 7.3e-8 in values and 1.5e-6 of the largest gradient; the CPU by 2.7e-8
/// and 1.5e-6.
#[cfg(feature = "gpu")]
#[test]
fn golden_ssim_on_the_gpu() {
    use burn::tensor::DType;
    use burn_cubecl::tensor::CubeTensor;
    use gazesplat_render::gpu::Gpu;
    use gazesplat_train::kernels::cpu::l1_ssim::{LANE_L1, LANE_LOSS, LANE_SSIM};
    use gazesplat_train::kernels::gpu::l1_ssim::{Comparison, TargetFormat, similarity_and_gradient};

    let opened = gazesplat_testkit::devices::required_gpu(gazesplat_render::device::gpu_device(None));
    let Some(gpu) = opened.and_then(|device| Gpu::from_device(&device)) else { return };
    golden_ssim_values_and_gradients("gpu", |pair, ssim_weight| {
        let &Pair { width, height, ref image, ref target } = pair;
        let words = |values: &[f32]| {
            let words: Vec<u32> = values.iter().map(|v| v.to_bits()).collect();
            gpu.upload_u32(&words, &[height, width, 3])
        };
        let image = CubeTensor { dtype: DType::F32, ..words(image) };
        let (target, num_pixels) = (words(target), width * height);
        let format = TargetFormat::Floats;
        let comparison = Comparison { width, height, channels: 3, image, target, format, num_pixels };
        let (packed, gradient) = similarity_and_gradient(&gpu, &comparison, ssim_weight).expect("it fits");
        let packed = gpu.read_f32(&packed).expect("the adapter answers");
        let found = Similarity { l1: f64::from(packed[LANE_L1]), ssim: f64::from(packed[LANE_SSIM]) };
        let loss = found.packed(ssim_weight)[LANE_LOSS];
        // Four roundings of values below 1.
        assert!((packed[LANE_LOSS] - loss).abs() <= 1.2e-7, "{packed:?}");
        (found, gpu.read_f32(&gradient).expect("the adapter answers"))
    });
}

#[test]
fn golden_adam_follows_torch_over_all_steps_on_every_device() {
    let mut devices = vec![gazesplat_render::cpu_device()];
    devices.extend(gazesplat_testkit::devices::required_gpu(gazesplat_render::device::gpu_device(None)));
    let golden = golden::find("adam").expect("golden record adam").load();
    let settings = golden.json.as_object().expect("an object");
    let mut num_settings = 0;
    for (name, entry) in settings.iter().filter(|(_, v)| v.is_object()) {
        num_settings += 1;
        let number = |value: Option<f64>| value.expect("a number");
        let adam = AdamSettings {
            beta1: number(entry["betas"][0].as_f64()),
            beta2: number(entry["betas"][1].as_f64()),
            epsilon: number(entry["eps"].as_f64()),
            weight_decay: number(entry["weight_decay"].as_f64()),
        };
        let lr = number(entry["lr"].as_f64());
        let rate = lr as f32;
        let rates = LearningRates {
            means: rate,
            quats: rate,
            log_scales: rate,
            opacity_logits: rate,
            sh_dc: rate,
            sh_rest: rate,
        };
        let to_f32 = |values: Vec<f64>| values.into_iter().map(|v| v as f32).collect::<Vec<f32>>();
        let start = to_f32(golden.f64(&format!("{name}.param0")));
        let grads = to_f32(golden.f64(&format!("{name}.grads")));
        let expected = golden.f64(&format!("{name}.params"));
        let n = start.len();
        for device in &devices {
            let mut state = ModelState::new(in_three_groups(&start), adam, device).expect("it fits");
            for (t, (grads, expected)) in grads.chunks_exact(n).zip(expected.chunks_exact(n)).enumerate() {
                let loss = Tensor::<1>::ones([1], device);
                let grads = in_three_groups(grads).into_splats(device);
                state.update(grads, loss, rates, Regularizers::default(), false).expect("the device answers");
                let found = Columns::from_splats(state.splats()).expect("the device answers");
                for group in THREE_GROUPS {
                    for (found, expected) in found.of(group).iter().zip(expected) {
                        let error = (f64::from(*found) - expected).abs();
                        // One rounding of the parameter per step, and the update itself to f32 precision.
                        let tolerance = (t + 1) as f64 * (1.2e-7 * expected.abs() + 1e-5 * lr);
                        assert!(error <= tolerance, "{name} {group:?} step {t}: {found} {expected}");
                    }
                }
            }
            for (moments, key) in state.moments().expect("the device answers").iter().zip(["m", "v"]) {
                for group in THREE_GROUPS {
                    for (found, expected) in moments.of(group).iter().zip(golden.f64(&format!("{name}.{key}"))) {
                        let error = (f64::from(*found) - expected).abs();
                        assert!(error <= 2e-6 * expected.abs() + 1e-12, "{name} {group:?} {key}");
                    }
                }
            }
        }
    }
    assert!(num_settings > 0, "no settings in the golden record");
}

/// The groups whose rows have three values, as the golden record's have.
const THREE_GROUPS: [Group; 3] = [Group::Means, Group::LogScales, Group::Sh];

fn in_three_groups(values: &[f32]) -> Columns {
    let n = values.len() / 3;
    let data = [values.to_vec(), vec![0.0; 4 * n], values.to_vec(), vec![0.0; n], values.to_vec()];
    Columns { data, widths: [3, 4, 3, 1, 3] }
}
