//! Scale decay (RTGS Eq. 4–6): WS = (1/N) Σ S_i G_i, what Gaussians cost by being in many tiles.
//!
//! S_i is the largest scale of Gaussian i, G_i = max(U_i − T, 0) with the tiles U_i it is used in, in the view of this
//! step. U is a constant: nothing flows through the rasteriser. The value is for reports; what a step needs is the
//! gradient, which is added to that of the image loss on the device.

use crate::backend::OptimOps;
use crate::kernels::cpu::scale_decay::largest_axis;
use crate::math::excess_tiles;
use burn::backend::Dispatch;
use burn::tensor::{DType, Int, Tensor, TensorData};

/// WS in units of `scale_unit` world units: `log_scales` `[N, 3]`, `used` the tiles each Gaussian is used in, `[N]`. 0 for
/// an empty model.
pub fn scale_decay(log_scales: &[f32], used: &[u32], scale_unit: f32) -> f64 {
    // A row in no tile may have any scale, even one whose exponential is no number.
    let rows = log_scales.as_chunks::<3>().0.iter().zip(used).filter(|(_, used)| excess_tiles(**used) > 0.0);
    let sum: f64 =
        rows.map(|(row, &used)| f64::from(row[largest_axis(row)]).exp() * f64::from(excess_tiles(used))).sum();
    sum / f64::from(scale_unit) / used.len().max(1) as f64
}

/// `grads` of the log scales, `[N, 3]`, with those of γ · WS added, where γ = `weight` for scales in units of `scale_unit`.
pub(crate) fn add_gradient(
    log_scales: Tensor<2>,
    grads: Tensor<2>,
    used: &[u32],
    weight: f32,
    scale_unit: f32,
) -> Tensor<2> {
    if used.is_empty() || weight == 0.0 {
        return grads;
    }
    let device = grads.device();
    // Counts of tiles are far below 2³¹: the bits are the same number.
    let words: Vec<i32> = used.iter().map(|u| u.cast_signed()).collect();
    let used = Tensor::<1, Int>::from_data(TensorData::new(words, [used.len()]), (&device, DType::I32));
    let factor = weight / (scale_unit * used.dims()[0] as f32);
    let (log_scales, grads) = (log_scales.into_dispatch(), grads.into_dispatch());
    Tensor::from_dispatch(<Dispatch as OptimOps>::add_scale_decay(log_scales, grads, used.into_dispatch(), factor))
}

#[cfg(test)]
mod tests {
    use super::*;
    use gazesplat_render::{cpu_device, device::gpu_device};
    use gazesplat_testkit::{Rng, devices::required_gpu};

    fn tensor(values: &[f32], device: &burn::tensor::Device) -> Tensor<2> {
        Tensor::from_data(TensorData::new(values.to_vec(), [values.len() / 3, 3]), device)
    }

    /// spec/pruning.md, Sec. 10, test 5.
    #[test]
    fn value_and_gradient_of_the_closed_form() {
        let log_scales = [0.5f32, 0.1, 0.2, 0.2, 0.1, 0.05].map(f32::ln);
        let used = [10, 3];
        assert!((scale_decay(&log_scales, &used, 1.0) - 1.5).abs() < 1e-6);
        assert!((scale_decay(&log_scales, &used, 3.0) - 0.5).abs() < 1e-6);
        assert_eq!(scale_decay(&[], &[], 1.0), 0.0);
        assert_eq!(scale_decay(&[800.0, 0.0, 0.0, f32::NAN, 0.0, 0.0], &[0, 4], 1.0), 0.0);
        let mut devices = vec![cpu_device()];
        devices.extend(required_gpu(gpu_device(None)));
        for device in devices {
            for (unit, expected) in [(1.0, 1.5f32), (3.0, 0.5)] {
                let zeros = tensor(&[0.0; 6], &device);
                let grads = add_gradient(tensor(&log_scales, &device), zeros, &used, 1.0, unit);
                let grads: Vec<f32> = grads.into_data().try_into_vec().expect("floats");
                assert!((grads[0] - expected).abs() < 1e-6 && grads[1..] == [0.0; 5], "{grads:?}");
            }
        }
    }

    #[test]
    fn gradient_equals_finite_differences_and_is_the_same_on_a_gpu() {
        let mut rng = Rng::new(5);
        let n = 3001;
        let log_scales: Vec<f32> = (0..3 * n).map(|_| rng.unit() as f32 * 4.0 - 3.0).collect();
        let used: Vec<u32> = (0..n).map(|_| (rng.unit() * 20.0) as u32).collect();
        let before: Vec<f32> = (0..3 * n).map(|_| rng.unit() as f32).collect();
        let weight = 0.7;
        let on = |device: &burn::tensor::Device| -> Vec<f32> {
            let grads = add_gradient(tensor(&log_scales, device), tensor(&before, device), &used, weight, 1.0);
            grads.into_data().try_into_vec().expect("floats")
        };
        let found = on(&cpu_device());
        for i in (0..3 * n).step_by(97) {
            let value = |step: f32| {
                let mut moved = log_scales.clone();
                moved[i] += step;
                scale_decay(&moved, &used, 1.0)
            };
            let step = 1e-3;
            let expected = f64::from(weight) * (value(step) - value(-step)) / (2.0 * f64::from(step));
            // Central differences are off by step²/6 of the value, the f32 step by 1e-4 of the difference; gradients
            // are of the order of 1e-2 at most.
            let found = f64::from(found[i] - before[i]);
            assert!((found - expected).abs() < 2e-6, "{i}: {found} {expected}");
        }
        if let Some(gpu) = required_gpu(gpu_device(None)) {
            for (f, e) in on(&gpu).iter().zip(&found) {
                assert!((f - e).abs() <= 1e-6 * e.abs(), "{f} {e}");
            }
        }
    }
}
