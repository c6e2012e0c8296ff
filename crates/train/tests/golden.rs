//! SSIM and Adam against the golden records (float64, torch), on the CPU.

use gazesplat_render::simd::SimdLevel;
use gazesplat_testkit::golden;
use gazesplat_train::kernels::cpu::l1_ssim::{Comparison, Weights, similarity, similarity_and_gradient};
use gazesplat_train::optim::adam::{AdamSettings, Step, update};

/// f32 arithmetic on images of up to 56 × 40: the sums themselves are exact to about 1e-7.
const VALUE_TOLERANCE: f64 = 1e-6;
/// Relative to the largest gradient of the image; E[x²] − μ² loses up to 1e-3 of C2 where variances vanish.
const GRADIENT_TOLERANCE: f64 = 2e-5;

#[test]
fn golden_ssim_values_and_gradients_at_every_simd_level() {
    let golden = golden::find("ssim").expect("golden record ssim").load();
    let sets: Vec<String> =
        golden.json.as_object().expect("an object").keys().filter(|k| *k != "constants").cloned().collect();
    assert!(!sets.is_empty());
    for level in SimdLevel::ALL.into_iter().filter(|l| l.is_available()) {
        gazesplat_render::simd::force_level(Some(level));
        for set in &sets {
            let image = golden.f32(&format!("{set}.img"));
            let target = golden.f32(&format!("{set}.ref"));
            let [height, width, 3] = *golden.shape(&format!("{set}.img")) else { panic!("images are [H, W, 3]") };
            let comparison = Comparison { width, height, channels: 3, image: &image, target: &target[..], mask: None };
            let number = |key: &str| golden.number(&format!("{set}.{key}")).expect(key);
            let found = similarity(&comparison);
            assert!((found.ssim - number("ssim_zero")).abs() < VALUE_TOLERANCE, "{level:?} {set} {found:?}");
            assert!((found.l1 - number("l1")).abs() < VALUE_TOLERANCE, "{level:?} {set} {found:?}");
            for (name, l1, ssim) in [("mean_ssim_zero", 0.0, 1.0), ("l1", 1.0, 0.0), ("loss_3dgs", 0.8, -0.2)] {
                let expected = golden.f64(&format!("{set}.grad_{name}"));
                let (_, gradient) = similarity_and_gradient(&comparison, Weights { l1, ssim });
                let largest = expected.iter().fold(0.0f64, |a, v| a.max(v.abs()));
                let worst = gradient.iter().zip(&expected).map(|(f, e)| (f64::from(*f) - e).abs()).fold(0.0, f64::max);
                assert!(worst < GRADIENT_TOLERANCE * largest, "{level:?} {set} {name}: {worst} of {largest}");
            }
        }
    }
    gazesplat_render::simd::force_level(None);
}

#[test]
fn golden_adam_follows_torch_over_all_steps() {
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
        let to_f32 = |values: Vec<f64>| values.into_iter().map(|v| v as f32).collect::<Vec<f32>>();
        let mut params = to_f32(golden.f64(&format!("{name}.param0")));
        let grads = to_f32(golden.f64(&format!("{name}.grads")));
        let expected = golden.f64(&format!("{name}.params"));
        let n = params.len();
        let (mut first, mut second) = (vec![0.0; n], vec![0.0; n]);
        for (t, (grads, expected)) in grads.chunks_exact(n).zip(expected.chunks_exact(n)).enumerate() {
            update(&mut params, grads, &mut first, &mut second, &[lr as f32; 3], &Step::new(&adam, t as u32 + 1));
            for (found, expected) in params.iter().zip(expected) {
                let error = (f64::from(*found) - expected).abs();
                // One rounding of the parameter per step, and the update itself to f32 precision.
                let tolerance = (t + 1) as f64 * (1.2e-7 * expected.abs() + 1e-5 * lr);
                assert!(error <= tolerance, "{name} step {t}: {found} {expected}");
            }
        }
        for (moments, key) in [(&first, "m"), (&second, "v")] {
            for (found, expected) in moments.iter().zip(golden.f64(&format!("{name}.{key}"))) {
                assert!((f64::from(*found) - expected).abs() <= 2e-6 * expected.abs() + 1e-12, "{name} {key}");
            }
        }
    }
    assert!(num_settings > 0, "no settings in the golden record");
}
