//! The operations of ADC on every device: closed forms, moments, counts, agreement.

use super::growth::SPLIT_LOG_SCALE;
use super::*;
use crate::backend::{Densification, StatisticStep};
use crate::config::OptimSection;
use crate::event::BrokenCounts;
use crate::host::read;
use crate::kernels::cpu::densify::add_statistic as add_on_host;
use crate::optim::{AdamSettings, Columns, Group, LearningRates};
use burn::backend::Dispatch;
use burn::tensor::{DType, TensorData};
use gazesplat_render::{cpu_device, device::gpu_device};
use gazesplat_testkit::{Rng, devices::required_gpu};

/// Every device of this machine that a model can live on, a CPU first.
fn devices() -> Vec<Device> {
    let mut devices = vec![cpu_device()];
    #[cfg(feature = "flex")]
    devices.push(gazesplat_render::flex_device());
    devices.extend(required_gpu(gpu_device(None)));
    devices
}

fn logit(opacity: f32) -> f32 {
    (opacity / (1.0 - opacity)).ln()
}

/// Rows side by side along x with these scales along their first axis, a third of it along the others.
fn rows(scales: &[f32]) -> Columns {
    let n = scales.len();
    let means = (0..n).flat_map(|i| [i as f32, 1.0, 2.0]).collect();
    let log_scales = scales.iter().flat_map(|s| [s.ln(), (s / 3.0).ln(), (s / 3.0).ln()]).collect();
    // A quarter turn about z, twice the length it should have: the first axis is the world's y.
    let quats = [2f32.sqrt(), 0.0, 0.0, 2f32.sqrt()].repeat(n);
    let data = [means, quats, log_scales, vec![logit(0.5); n], (0..6 * n).map(|i| i as f32 * 0.01).collect()];
    Columns { data, widths: [3, 4, 3, 1, 6] }
}

fn densification(cap: usize) -> Densification {
    Densification {
        seed: 7,
        step: 600,
        cap,
        grow_gradient: 2e-4,
        max_clone_log_scale: 0.01f32.ln(),
        min_logit: logit(0.005),
        max_log_scale: None,
        bounds: Bounds::of_scene([0.0; 3], 1.0),
        reset_logit: None,
    }
}

/// The model with moments: an update whose rates are zero.
fn model(params: &Columns, device: &Device) -> ModelState {
    let mut state = ModelState::new(params.clone(), AdamSettings::default(), device).expect("it fits");
    let mut rng = Rng::new(5);
    let mut grads = params.zeros_like();
    grads.data.iter_mut().flatten().for_each(|g| *g = rng.unit() as f32 + 0.1);
    let rates =
        LearningRates { means: 0.0, quats: 0.0, log_scales: 0.0, opacity_logits: 0.0, sh_dc: 0.0, sh_rest: 0.0 };
    let loss = Tensor::<1>::ones([1], device);
    state.update(grads.into_splats(device), loss, rates, Regularizers::default(), false).expect("the device answers");
    state
}

fn params(state: &ModelState) -> Columns {
    Columns::from_splats(state.lent()).expect("the device answers")
}

/// A statistic of these means over four views.
fn statistic(means: &[f32], device: &Device) -> Tensor<2> {
    let values: Vec<f32> = means.iter().flat_map(|mean| [4.0 * mean, 4.0]).collect();
    Tensor::from_data(TensorData::new(values, [means.len(), 2]), device)
}

fn is_zero(moments: &[Columns; 2], row: usize) -> bool {
    moments.iter().all(|m| Group::ALL.into_iter().all(|g| m.row(g, row).iter().all(|v| *v == 0.0)))
}

#[test]
fn small_gaussians_are_cloned_large_ones_split_and_moments_follow_their_rows() {
    for device in devices() {
        let mut start = rows(&[0.005, 0.3, 0.005, 0.2]);
        start.of_mut(Group::OpacityLogits)[2] = logit(0.004);
        let mut state = model(&start, &device);
        let moments = state.moments().expect("the device answers");
        // The first is cloned, the second split, the third removed; the last hardly moves.
        let means = [3e-4, 3e-4, 3e-4, 1e-4];
        let report = state.densify(statistic(&means, &device), densification(100)).expect("the device answers");
        assert_eq!((report.num_cloned, report.num_split, report.num_added), (1, 1, 2));
        assert_eq!((report.num_transparent, report.num_large, report.broken.total()), (1, 0, 0));
        assert_eq!((report.num_gaussians, state.num_rows()), (5, 5));
        let (after, new_moments) = (params(&state), state.moments().expect("the device answers"));
        // Kept rows are what they were; the copy equals its source, and both parts the Gaussian they replace, but for place
        // and size.
        for (row, source) in [(0, 0), (1, 3), (2, 0), (3, 1), (4, 1)] {
            let is_part = row >= 3;
            for group in Group::ALL {
                let (found, expected) = (after.row(group, row), start.row(group, source));
                match group {
                    Group::Means if is_part => assert_ne!(found, expected),
                    Group::LogScales if is_part => {
                        let shrunk: Vec<f32> = expected.iter().map(|s| s - SPLIT_LOG_SCALE).collect();
                        assert_eq!(found, shrunk);
                    }
                    _ => assert_eq!(found, expected, "{row} {group:?}"),
                }
            }
        }
        assert_ne!(after.row(Group::Means, 3), after.row(Group::Means, 4));
        assert!((SPLIT_LOG_SCALE - 1.6f32.ln()).abs() < 1e-7);
        for (row, source) in [(0, 0), (1, 3)] {
            for (new, old) in new_moments.iter().zip(&moments) {
                assert!(Group::ALL.into_iter().all(|g| new.row(g, row) == old.row(g, source)), "{row}");
            }
            assert!(!is_zero(&new_moments, row));
        }
        assert!((2..5).all(|row| is_zero(&new_moments, row)));
    }
}

#[test]
fn parts_are_drawn_from_the_gaussian_they_replace() {
    const NUM: usize = 2000;
    for device in devices() {
        let mut start = rows(&[0.3; NUM]);
        start.of_mut(Group::Means).fill(0.5);
        let mut state = model(&start, &device);
        let report =
            state.densify(statistic(&[1.0; NUM], &device), densification(10 * NUM)).expect("the device answers");
        assert_eq!((report.num_split, state.num_rows()), (NUM, 2 * NUM));
        let after = params(&state);
        let (places, _) = after.of(Group::Means).as_chunks::<3>();
        let n = places.len() as f64;
        let mean = |f: &dyn Fn(&[f32; 3]) -> f64| places.iter().map(f).sum::<f64>() / n;
        let centered = |p: &[f32; 3], axis: usize| f64::from(p[axis]) - 0.5;
        // The long axis is the world's y.
        let deviations = [0.1, 0.3, 0.1];
        for a in 0..3 {
            // A mean of n draws is off by s / √n, a variance by s² √(2 / n), a covariance by s t / √n: four times that.
            let found = mean(&|p| centered(p, a));
            assert!(found.abs() < 4.0 * deviations[a] / n.sqrt(), "{a}: {found}");
            for b in 0..=a {
                let found = mean(&|p| centered(p, a) * centered(p, b));
                let scale = deviations[a] * deviations[b];
                let (expected, off) = if a == b { (scale, (2.0 / n).sqrt()) } else { (0.0, (1.0 / n).sqrt()) };
                assert!((found - expected).abs() < 4.0 * off * scale, "{a} {b}: {found} {expected}");
            }
        }
        // The two parts of one Gaussian are drawn apart: their product has mean 0 and deviation s² / √(n / 2).
        let products = places.chunks_exact(2).map(|pair| centered(&pair[0], 1) * centered(&pair[1], 1));
        let product = products.sum::<f64>() / (n / 2.0);
        assert!(product.abs() < 4.0 * 0.09 / (n / 2.0).sqrt(), "{product}");
    }
}

#[test]
fn opacities_are_lowered_and_forget_only_their_moments() {
    for device in devices() {
        let mut start = rows(&[0.3; 4]);
        let logits = [logit(0.5), logit(0.007), logit(0.011), logit(0.999)];
        start.of_mut(Group::OpacityLogits).copy_from_slice(&logits);
        let mut state = model(&start, &device);
        let (handed_out, moments) = (state.splats(), state.moments().expect("the device answers"));
        let reset = Densification { reset_logit: Some(logit(0.01)), ..densification(100) };
        let report = state.densify(statistic(&[0.0; 4], &device), reset).expect("the device answers");
        assert_eq!((report.num_opacity_resets, report.num_gaussians), (1, 4));
        let after = params(&state);
        for (found, before) in after.of(Group::OpacityLogits).iter().zip(logits) {
            assert_eq!(*found, before.min(logit(0.01)));
            assert!(1.0 / (1.0 + (-found).exp()) > gazesplat_render::layout::ALPHA_MIN);
        }
        for (new, old) in state.moments().expect("the device answers").iter().zip(&moments) {
            assert!(new.of(Group::OpacityLogits).iter().all(|v| *v == 0.0));
            for group in [Group::Means, Group::Quats, Group::LogScales, Group::Sh] {
                assert_eq!(new.of(group), old.of(group));
                assert_eq!(after.of(group), start.of(group));
            }
        }
        let kept = Columns::from_splats(handed_out).expect("the device answers");
        assert_eq!(kept, start, "what was handed out stays");
    }
}

/// Rows of all kinds: small, large, faint, broken, with statistics around the threshold but not on it.
fn mixed(n: usize) -> (Columns, Vec<f32>) {
    let mut rng = Rng::new(11);
    let scales: Vec<f32> = (0..n).map(|_| 10f32.powf(-3.5 + 3.0 * rng.unit() as f32)).collect();
    let mut start = rows(&scales);
    start.of_mut(Group::OpacityLogits).iter_mut().for_each(|l| *l = -7.0 + 9.0 * rng.unit() as f32);
    start.of_mut(Group::Quats).iter_mut().for_each(|q| *q = rng.unit() as f32 - 0.5);
    start.of_mut(Group::Means).iter_mut().for_each(|m| *m = rng.unit() as f32 - 0.5);
    start.row_mut(Group::Sh, 3)[2] = f32::NAN;
    start.row_mut(Group::Quats, 4)[0] = f32::INFINITY;
    start.row_mut(Group::LogScales, 5)[1] = 101f32.ln();
    start.row_mut(Group::Means, 6)[2] = -1.1e4;
    (start, (0..n).map(|_| 4e-4 * rng.unit() as f32).collect())
}

#[test]
fn every_device_decides_alike_and_the_cap_holds() {
    let n = 3000;
    let (start, means) = mixed(n);
    let devices = devices();
    for cap in [n / 4, n, n + 40, 10 * n] {
        let large = Densification { max_log_scale: Some(0.1f32.ln()), ..densification(cap) };
        let run = |device: &Device| {
            let mut state = model(&start, device);
            let report = state.densify(statistic(&means, device), large).expect("the device answers");
            (report, params(&state), state.moments().expect("the device answers"))
        };
        let (expected, on_cpu, moments) = run(&devices[0]);
        assert_eq!(expected.broken, BrokenCounts { non_finite: 2, huge: 1, far: 1 });
        assert!(expected.num_transparent > 100 && expected.num_large > 100, "{expected:?}");
        let removed = expected.num_transparent + expected.num_large + 4;
        assert_eq!(expected.num_gaussians, n - removed + expected.num_added);
        assert!(expected.num_gaussians <= cap.max(n - removed), "{expected:?}");
        assert_eq!(expected.num_added > 0, cap > n / 4, "{expected:?}");
        for device in &devices[1..] {
            let (report, found, found_moments) = run(device);
            assert_eq!(report, expected);
            for group in [Group::Quats, Group::LogScales, Group::OpacityLogits, Group::Sh] {
                assert_eq!(found.of(group), on_cpu.of(group), "{group:?}");
            }
            // As for position noise: a shader's logarithm makes a normal number off by up to 1e-3 where it is small; a scale
            // is at most a third of a unit.
            for (found, expected) in found.of(Group::Means).iter().zip(on_cpu.of(Group::Means)) {
                assert!((found - expected).abs() <= 1e-6 * expected.abs() + 3f32.sqrt() * 0.33 * 1e-3);
            }
            for (found, expected) in found_moments.iter().zip(&moments) {
                for (found, expected) in found.data.iter().flatten().zip(expected.data.iter().flatten()) {
                    assert_eq!(*found == 0.0, *expected == 0.0);
                }
            }
        }
    }
}

#[test]
fn the_statistic_is_the_mean_norm_in_half_images_over_the_views_that_see_a_gaussian() {
    let n = 9000;
    let mut rng = Rng::new(3);
    let gradient: Vec<f32> = (0..4 * n).map(|_| rng.unit() as f32 - 0.5).collect();
    let views: [Vec<u32>; 2] = [3, 4].map(|k| (0..n as u32).filter(|i| i % k != 1).collect());
    let step =
        |visible: &[u32], absolute| StatisticStep { num_visible: visible.len(), half_size: [160.0, 120.0], absolute };
    for absolute in [false, true] {
        let mut expected = vec![0.0f64; 2 * n];
        for visible in &views {
            for &row in visible {
                let g = &gradient[4 * row as usize + if absolute { 2 } else { 0 }..][..2];
                expected[2 * row as usize] += (160.0 * f64::from(g[0])).hypot(120.0 * f64::from(g[1]));
                expected[2 * row as usize + 1] += 1.0;
            }
        }
        for device in devices() {
            let mut statistic = Tensor::<2>::zeros([n, 2], &device);
            for visible in &views {
                // Behind the visible rows something else may stand.
                let words: Vec<i32> = visible.iter().map(|v| v.cast_signed()).chain([-1, 7]).collect();
                let len = words.len();
                let words = Tensor::<1, Int>::from_data(TensorData::new(words, [len]), (&device, DType::I32));
                let gradient = Tensor::<2>::from_data(TensorData::new(gradient.clone(), [n, 4]), &device);
                statistic = Tensor::from_dispatch(<Dispatch as crate::backend::OptimOps>::add_statistic(
                    statistic.into_dispatch(),
                    gradient.into_dispatch(),
                    words.into_dispatch(),
                    step(visible, absolute),
                ));
            }
            let found = read(statistic).expect("the device answers");
            for (i, (found, expected)) in found.iter().zip(&expected).enumerate() {
                // Two products, a sum, a root and one addition in f32.
                assert!((f64::from(*found) - expected).abs() <= 4e-7 * expected, "{i}: {found} {expected}");
            }
        }
        let on_threads = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("the test sets this up");
            let mut sums = vec![0.0; 2 * n];
            pool.install(|| add_on_host(&mut sums, &gradient, &views[0], &step(&views[0], absolute)));
            sums
        };
        assert!(on_threads(1) == on_threads(2) && on_threads(1) == on_threads(5));
    }
}

#[test]
fn broken_gaussians_are_swept_with_their_moments_and_counted() {
    let bounds = Bounds::of_scene([0.0; 3], 1.0);
    for device in devices() {
        let (start, _) = mixed(700);
        let mut state = model(&start, &device);
        let (handed_out, moments) = (state.splats(), state.moments().expect("the device answers"));
        let report = state.sweep(bounds).expect("the device answers");
        assert_eq!(report.broken, BrokenCounts { non_finite: 2, huge: 1, far: 1 });
        assert_eq!((report.num_gaussians, state.num_rows()), (696, 696));
        let (after, new_moments) = (params(&state), state.moments().expect("the device answers"));
        for (row, source) in (0..3).chain(7..700).enumerate() {
            for group in Group::ALL {
                assert_eq!(after.row(group, row), start.row(group, source));
                for (new, old) in new_moments.iter().zip(&moments) {
                    assert_eq!(new.row(group, row), old.row(group, source));
                }
            }
        }
        assert_eq!(handed_out.len(), 700, "what was handed out stays");
        // Nothing is broken any more: the rows stay where they are, but are their own again.
        let handed_out = state.splats();
        assert_eq!(state.sweep(bounds).expect("the device answers").broken.total(), 0);
        let rates = LearningRates::at(&OptimSection::default(), 0, 100, 1.0);
        let (grads, loss) = (after.clone().into_splats(&device), Tensor::<1>::ones([1], &device));
        state.update(grads, loss, rates, Regularizers::default(), false).expect("the device answers");
        assert_ne!(params(&state), after);
        assert_eq!(Columns::from_splats(handed_out).expect("the device answers"), after);
        // A model of which nothing would be left.
        let none = Bounds { max_log_scale: -100.0, ..bounds };
        let report = state.sweep(none).expect("the device answers");
        assert_eq!((report.broken.total(), report.num_gaussians), (0, 696));
    }
}

#[test]
fn a_closed_state_is_neither_densified_nor_swept() {
    for device in devices() {
        let (start, means) = mixed(300);
        let mut state = model(&start, &device);
        let bits = |c: Columns| c.data.concat().into_iter().map(f32::to_bits).collect::<Vec<_>>();
        let before = bits(params(&state));
        let grads = start.zeros_like().into_splats(&device);
        let loss = Tensor::<1>::from_data([f32::NAN], &device);
        let rates = LearningRates::at(&OptimSection::default(), 0, 100, 1.0);
        state.update(grads, loss, rates, Regularizers::default(), false).expect("the device answers");
        let reset = Densification { reset_logit: Some(logit(0.01)), ..densification(1000) };
        let untouched = DensifyReport { num_gaussians: 300, ..DensifyReport::default() };
        assert_eq!(state.densify(statistic(&means, &device), reset).expect("the device answers"), untouched);
        assert_eq!(state.sweep(reset.bounds).expect("the device answers"), untouched);
        assert!(bits(params(&state)) == before);
    }
}

#[test]
fn an_empty_model_stays_empty() {
    for device in devices() {
        let mut state = ModelState::new(rows(&[]), AdamSettings::default(), &device).expect("it fits");
        let statistic = Tensor::zeros([0, 2], &device);
        assert_eq!(state.densify(statistic, densification(10)).expect("the device answers").num_gaussians, 0);
        assert_eq!(state.sweep(densification(10).bounds).expect("the device answers").num_gaussians, 0);
    }
}
