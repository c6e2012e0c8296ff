//! The operations on a model, on the CPU and, where there is one, on a GPU. The file is long because every operation is
//! tested with the same few helpers.

use super::*;
use crate::config::OptimSection;
use crate::event::BrokenCounts;
use crate::optim::Group;
use gazesplat_render::{cpu_device, device::gpu_device};
use gazesplat_testkit::{Rng, devices::required_gpu};

/// Every device of this machine that a model can live on.
fn devices() -> Vec<Device> {
    let mut devices = vec![cpu_device()];
    #[cfg(feature = "flex")]
    devices.push(gazesplat_render::flex_device());
    devices.extend(required_gpu(gpu_device(None)));
    devices
}

/// N rows of small random values, SH of `num_coefficients`.
fn random(n: usize, num_coefficients: usize, seed: u64) -> Columns {
    let mut rng = Rng::new(seed);
    let widths = [3, 4, 3, 1, 3 * num_coefficients];
    Columns { data: widths.map(|w| (0..w * n).map(|_| rng.unit() as f32 * 2.0 - 1.0).collect()), widths }
}

/// Rows side by side of the given opacities.
fn of_opacities(opacities: &[f32]) -> Columns {
    let n = opacities.len();
    let logits = opacities.iter().map(|o| (o / (1.0 - o)).ln()).collect();
    let means = (0..3 * n).map(|i| i as f32).collect();
    let data = [means, [1.0, 0.0, 0.0, 0.0].repeat(n), vec![-2.0; 3 * n], logits, vec![0.1; 3 * n]];
    Columns { data, widths: [3, 4, 3, 1, 3] }
}

fn model(params: &Columns, device: &Device) -> ModelState {
    ModelState::new(params.clone(), AdamSettings::default(), device).expect("it fits")
}

fn params(state: &ModelState) -> Columns {
    Columns::from_splats(state.lent()).expect("the device answers")
}

fn rates() -> LearningRates {
    LearningRates::at(&OptimSection::default(), 0, 100, 1.0)
}

const REGULARIZERS: Regularizers = Regularizers { opacity: 0.01, scale: 0.02 };

/// One update by `grads` of a loss of `loss`.
fn update(state: &mut ModelState, grads: &Columns, loss: f32) {
    let device = state.device().clone();
    let loss = Tensor::<1>::from_data([loss], &device);
    state.update(grads.clone().into_splats(&device), loss, rates(), REGULARIZERS, true).expect("the device answers");
}

fn refinement(cap: usize) -> Refinement {
    Refinement {
        seed: 3,
        step: 500,
        growth: 1.05,
        cap,
        min_opacity: 0.005,
        bounds: Bounds { center: [0.0; 3], max_log_scale: 1000f32.ln(), max_distance: 1e5 },
    }
}

fn refine(state: &mut ModelState, cap: usize) -> DensifyReport {
    state.refine(refinement(cap)).expect("the device answers")
}

#[track_caller]
fn assert_close(found: &Columns, expected: &Columns, relative: f32, absolute: f32) {
    assert_eq!(found.widths, expected.widths);
    for group in Group::ALL {
        let (found, expected) = (found.of(group), expected.of(group));
        assert_eq!(found.len(), expected.len(), "{group:?}");
        for (i, (f, e)) in found.iter().zip(expected).enumerate() {
            let is_close = (f - e).abs() <= relative * e.abs() + absolute;
            assert!(is_close || (f.is_nan() && e.is_nan()), "{group:?} {i}: {f} {e}");
        }
    }
}

#[test]
fn twelve_updates_are_the_same_on_every_device() {
    let start = random(700, 4, 1);
    let run = |device: &Device| {
        let mut state = model(&start, device);
        for t in 0..12 {
            let mut grads = random(700, 4, 10 + t);
            // Rows without a gradient, tiny gradients, and values whose moments are flushed to zero.
            grads.row_mut(Group::Sh, 5).fill(0.0);
            grads.row_mut(Group::Quats, 6).fill(1e-19);
            grads.row_mut(Group::Means, 7).iter_mut().for_each(|g| *g *= 1e-6);
            update(&mut state, &grads, 0.5);
        }
        state
    };
    let devices = devices();
    let expected = run(&devices[0]);
    let status = expected.status().expect("a CPU answers");
    let moments = expected.moments().expect("a CPU answers");
    assert!(status.failed.is_none() && status.mean_opacity > 0.1 && status.mean_scale > 0.1);
    for device in &devices[1..] {
        let found = run(device);
        assert_eq!(found.num_updates(), 12);
        // A rounding of the parameter per step, and the step itself, at most 5e-2 in length, to a few roundings of the
        // square root, the division and the exponential.
        assert_close(&params(&found), &params(&expected), 12.0 * 1.2e-7, 12.0 * 5e-2 * 2e-6);
        // Moments are running sums of a few roundings each; opposite gradients leave them at the absolute part.
        for (found, expected) in found.moments().expect("the device answers").iter().zip(&moments) {
            assert_close(found, expected, 3e-6, 3e-7);
        }
        let found = found.status().expect("the device answers");
        // Means of 2100 values, each to a few roundings.
        assert!((found.mean_opacity / status.mean_opacity - 1.0).abs() < 2e-6, "{found:?} {status:?}");
        assert!((found.mean_scale / status.mean_scale - 1.0).abs() < 2e-6, "{found:?} {status:?}");
    }
}

#[test]
fn noise_is_the_same_on_every_device() {
    let mut start = random(3000, 1, 2);
    for (i, logit) in start.of_mut(Group::OpacityLogits).iter_mut().enumerate() {
        *logit = -8.0 + 0.005 * i as f32;
    }
    start.row_mut(Group::Quats, 3).fill(f32::NAN);
    let run = |device: &Device| {
        let mut state = model(&start, device);
        state.add_noise(NoiseUpdate { strength: 0.3, seed: 9, step: 4 }).expect("the device answers");
        params(&state)
    };
    let devices = devices();
    let expected = run(&devices[0]);
    assert_ne!(expected.row(Group::Means, 0), start.row(Group::Means, 0));
    assert_eq!(expected.row(Group::Means, 3), start.row(Group::Means, 3));
    assert_eq!(expected.row(Group::Means, 2999), start.row(Group::Means, 2999));
    for device in &devices[1..] {
        // A shader's logarithm is off by up to 2⁻²¹ near 1 (Vulkan), which a small radius feels by its square root:
        // 1e-3 of a normal number, times Σ below e² and the strength.
        assert_close(&run(device), &expected, 1e-6, 0.3 * 7.4 * 1e-3);
    }
}

#[test]
fn relocation_keeps_the_composited_opacity_at_every_place() {
    let mut opacities = vec![0.6f32; 50];
    opacities.extend([0.001; 30]);
    for device in devices() {
        let mut state = model(&of_opacities(&opacities), &device);
        update(&mut state, &state_grads(80), 1.0);
        let before = params(&state);
        let report = refine(&mut state, 80);
        assert_eq!((report.num_relocated, report.num_added, report.num_gaussians), (30, 0, 80));
        let after = params(&state);
        let [first, second] = state.moments().expect("the device answers");
        let opacity = |logit: f32| 1.0 / (1.0 + f64::from(-logit).exp());
        for row in 0..50 {
            let place = before.row(Group::Means, row);
            let there: Vec<usize> = (0..80).filter(|&i| after.row(Group::Means, i) == place).collect();
            assert!(there.contains(&row));
            let transmittance: f64 = there.iter().map(|&i| 1.0 - opacity(after.of(Group::OpacityLogits)[i])).product();
            let expected = opacity(before.of(Group::OpacityLogits)[row]);
            assert!((1.0 - transmittance - expected).abs() < 1e-5, "{row}: {transmittance}");
            let has_moments = there.len() == 1;
            for &i in &there {
                for moments in [&first, &second] {
                    let zero = Group::ALL.into_iter().all(|g| moments.row(g, i).iter().all(|v| *v == 0.0));
                    assert_eq!(zero, !has_moments, "{i}");
                }
                assert_eq!(after.row(Group::LogScales, i), after.row(Group::LogScales, row));
            }
        }
    }
}

fn state_grads(n: usize) -> Columns {
    random(n, 1, 77)
}

#[test]
fn drawn_rows_are_divided_alike_on_every_device() {
    // One live row: which source is drawn leaves no choice.
    let opacities = [&[0.8f32][..], &[0.001; 6]].concat();
    let run = |device: &Device| {
        let mut state = model(&of_opacities(&opacities), device);
        assert_eq!(refine(&mut state, 7).num_relocated, 6);
        params(&state)
    };
    let devices = devices();
    let expected = run(&devices[0]);
    for device in &devices[1..] {
        // What `math` promises of the split, and the logarithm of a shader.
        assert_close(&run(device), &expected, 2e-6, 2e-6);
    }
}

#[test]
fn sources_are_drawn_in_proportion_to_their_opacity() {
    // Half of the live rows have four times the opacity of the others.
    let n = 4000;
    let opacities: Vec<f32> = (0..2 * n).map(|i| if i >= n { 0.001 } else { [0.8, 0.2][i % 2] }).collect();
    for device in devices() {
        let mut state = model(&of_opacities(&opacities), &device);
        assert_eq!(refine(&mut state, 2 * n).num_relocated, n);
        let after = params(&state);
        let copies = (n..2 * n).filter(|&i| (after.row(Group::Means, i)[0] as usize / 3).is_multiple_of(2)).count();
        // Binomial with n = 4000, p = 0.8: a standard deviation is 25.
        assert!(copies.abs_diff(n * 4 / 5) < 100, "{copies}");
    }
}

#[test]
fn growth_ends_at_the_cap() {
    for device in devices() {
        let mut state = model(&of_opacities(&[0.5; 100]), &device);
        update(&mut state, &state_grads(100), 1.0);
        assert_eq!([108; 3].map(|cap| refine(&mut state, cap).num_added), [5, 3, 0]);
        assert_eq!(state.num_rows(), 108);
        let after = params(&state);
        let [first, second] = state.moments().expect("the device answers");
        for row in 100..108 {
            assert!((0..100).any(|i| after.row(Group::Means, i) == after.row(Group::Means, row)));
            let moments = [&first, &second].map(|m| m.row(Group::Sh, row).to_vec()).concat();
            assert!(moments.iter().all(|v| *v == 0.0));
        }
    }
}

#[test]
fn broken_gaussians_are_replaced_and_counted() {
    for device in devices() {
        let mut broken = of_opacities(&[0.5; 10]);
        broken.row_mut(Group::Sh, 2)[1] = f32::NAN;
        broken.row_mut(Group::LogScales, 4)[0] = 40.0;
        broken.row_mut(Group::Means, 6)[2] = 1e7;
        broken.row_mut(Group::OpacityLogits, 8)[0] = f32::INFINITY;
        let mut state = model(&broken, &device);
        let report = refine(&mut state, 10);
        assert_eq!((report.num_relocated, report.broken), (0, BrokenCounts { non_finite: 2, huge: 1, far: 1 }));
        assert!(params(&state).data.iter().flatten().all(|v| v.is_finite()));
    }
}

#[test]
fn a_model_without_live_gaussians_is_left_alone() {
    for device in devices() {
        let start = of_opacities(&[0.001; 10]);
        let mut state = model(&start, &device);
        let report = refine(&mut state, 20);
        assert_eq!((report.num_relocated, report.num_added, report.num_gaussians), (0, 0, 10));
        assert_eq!(params(&state), start);
    }
}

#[test]
fn an_empty_model_stays_empty() {
    for device in devices() {
        let mut state = model(&of_opacities(&[]), &device);
        assert_eq!(refine(&mut state, 20).num_gaussians, 0);
        state.add_noise(NoiseUpdate { strength: 1.0, seed: 1, step: 1 }).expect("the device answers");
        state.sort_spatially([0.0; 3], 1.0).expect("the device answers");
        assert_eq!(state.num_rows(), 0);
    }
}

#[test]
fn a_loss_that_is_no_number_closes_the_state_until_it_is_opened() {
    for device in devices() {
        let start = of_opacities(&[0.5, 0.001, 0.006]);
        let mut state = model(&start, &device);
        let grads = state_grads(3);
        update(&mut state, &grads, 1.0);
        let before = (params(&state), state.moments().expect("the device answers"));
        for loss in [f32::INFINITY, 1.0, f32::NAN] {
            update(&mut state, &grads, loss);
            state.add_noise(NoiseUpdate { strength: 10.0, seed: 1, step: 1 }).expect("the device answers");
            assert_eq!(refine(&mut state, 10).num_gaussians, 3);
        }
        assert_eq!((params(&state), state.moments().expect("the device answers")), before);
        assert_eq!(state.status().expect("the device answers").failed, Some((2, f32::INFINITY)));
        state.reopen(1);
        update(&mut state, &grads, 1.0);
        assert_eq!((state.num_updates(), state.status().expect("the device answers").failed), (2, None));
        assert_ne!(params(&state), before.0);
    }
}

#[test]
fn parameters_handed_out_stay_as_they_are() {
    for device in devices() {
        let mut state = model(&of_opacities(&[0.5, 0.001, 0.006]), &device);
        let grads = state_grads(3);
        // Once, so that a GPU has packed them.
        update(&mut state, &grads, 1.0);
        let operations: [fn(&mut ModelState); 3] = [
            |state| update(state, &state_grads(3), 1.0),
            |state| state.add_noise(NoiseUpdate { strength: 1e3, seed: 1, step: 1 }).expect("the device answers"),
            |state| assert_eq!(refine(state, 3).num_relocated, 1),
        ];
        for operation in operations {
            let held = state.splats();
            let before = params(&state);
            operation(&mut state);
            assert_ne!(params(&state), before);
            assert_eq!(Columns::from_splats(held).expect("the device answers"), before);
        }
    }
}

#[test]
fn sorting_moves_whole_rows_with_their_moments() {
    for device in devices() {
        let mut start = random(5000, 4, 6);
        start.row_mut(Group::Means, 17)[1] = f32::NAN;
        // The first gradient becomes a tenth of it as a moment: it names the row.
        let mut grads = start.zeros_like();
        for row in 0..5000 {
            let bits = start.row(Group::Quats, row)[0];
            grads.row_mut(Group::Sh, row)[11] = bits;
        }
        let mut state = model(&start, &device);
        let without = Regularizers::default();
        let loss = Tensor::<1>::ones([1], &device);
        let no_rates =
            LearningRates { means: 0.0, quats: 0.0, log_scales: 0.0, opacity_logits: 0.0, sh_dc: 0.0, sh_rest: 0.0 };
        state.update(grads.into_splats(&device), loss, no_rates, without, false).expect("the device answers");
        state.sort_spatially([0.0; 3], 1.0).expect("the device answers");
        let after = params(&state);
        let [first, _] = state.moments().expect("the device answers");
        let key = |c: &Columns, row: usize| c.row(Group::Quats, row).iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        let mut found: Vec<_> = (0..5000).map(|row| key(&after, row)).collect();
        let mut expected: Vec<_> = (0..5000).map(|row| key(&start, row)).collect();
        assert!(after.row(Group::Means, 4999)[1].is_nan());
        for row in 0..5000 {
            let moment = first.row(Group::Sh, row)[11];
            assert!((moment - 0.1 * after.row(Group::Quats, row)[0]).abs() < 1e-6, "{row}");
        }
        found.sort_unstable();
        expected.sort_unstable();
        assert!(found == expected);
        let length = |c: &Columns| -> f32 {
            let (points, _) = c.of(Group::Means).as_chunks::<3>();
            let step = |w: &[[f32; 3]]| (0..3).map(|a| (w[0][a] - w[1][a]).powi(2)).sum::<f32>().sqrt();
            points.windows(2).map(step).filter(|d| d.is_finite()).sum()
        };
        assert!(length(&after) < 0.15 * length(&start), "{} {}", length(&after), length(&start));
    }
}

#[test]
fn widened_rows_keep_their_first_values() {
    for device in devices() {
        let start = random(70, 1, 5);
        let mut state = model(&start, &device);
        update(&mut state, &state_grads(70), 1.0);
        let before = (params(&state), state.moments().expect("the device answers"));
        state.widen_sh(4).expect("the device answers");
        let after = [vec![params(&state)], state.moments().expect("the device answers").to_vec()].concat();
        for (wide, narrow) in after.iter().zip([&before.0, &before.1[0], &before.1[1]]) {
            assert_eq!(wide.data[..4], narrow.data[..4]);
            for row in 0..70 {
                assert_eq!(wide.row(Group::Sh, row)[..3], *narrow.row(Group::Sh, row));
                assert_eq!(wide.row(Group::Sh, row)[3..], [0.0; 9]);
            }
        }
        assert_eq!(state.num_coefficients(), 4);
    }
}

#[test]
fn selected_rows_keep_their_moments_and_their_order() {
    let start = random(700, 4, 3);
    let rows: Vec<u32> = (0..700).filter(|i| i % 3 != 1).rev().collect();
    for device in devices() {
        let mut state = model(&start, &device);
        update(&mut state, &random(700, 4, 4), 0.5);
        let (before, moments) = (params(&state), state.moments().expect("the device answers"));
        let handed_out = state.splats();
        state.select_rows(rows.clone()).expect("it fits");
        let (after, new_moments) = (params(&state), state.moments().expect("the device answers"));
        assert_eq!((state.num_rows(), state.num_updates()), (rows.len(), 1));
        for (found, expected) in [(&after, &before), (&new_moments[0], &moments[0]), (&new_moments[1], &moments[1])] {
            for (i, &row) in rows.iter().enumerate() {
                for group in Group::ALL {
                    assert_eq!(found.row(group, i), expected.row(group, row as usize));
                }
            }
        }
        assert_eq!(handed_out.len(), 700, "what was handed out stays");
        update(&mut state, &random(rows.len(), 4, 5), 0.5);
    }
}

#[test]
fn clamped_opacities_forget_their_moments_and_only_theirs() {
    let start = of_opacities(&[0.05, 0.9, 0.1, 0.999, 0.0999]);
    for device in devices() {
        let mut state = model(&start, &device);
        update(&mut state, &random(5, 1, 8), 0.5);
        let (before, moments) = (params(&state), state.moments().expect("the device answers"));
        let handed_out = state.splats();
        state.clamp_opacities(0.1).expect("it fits");
        let limit = (0.1f32 / 0.9).ln();
        let after = params(&state);
        for (found, before) in after.of(Group::OpacityLogits).iter().zip(before.of(Group::OpacityLogits)) {
            assert_eq!(*found, before.min(limit));
        }
        let new = state.moments().expect("the device answers");
        for (new, old) in new.iter().zip(&moments) {
            assert!(new.of(Group::OpacityLogits).iter().all(|v| *v == 0.0));
            assert!(old.of(Group::OpacityLogits).iter().any(|v| *v != 0.0));
            for group in [Group::Means, Group::Quats, Group::LogScales, Group::Sh] {
                assert_eq!(new.of(group), old.of(group));
            }
        }
        let kept = Columns::from_splats(handed_out).expect("the device answers");
        assert_eq!(kept, before, "what was handed out stays");
    }
}

#[test]
fn snapshot_outlives_what_happens_to_the_state() {
    for device in devices() {
        let mut state = model(&random(300, 4, 1), &device);
        update(&mut state, &random(300, 4, 2), 0.5);
        let snapshot = state.snapshot().expect("it fits");
        let expected = snapshot.to_host().expect("the device answers");
        for _ in 0..2 {
            update(&mut state, &random(300, 4, 3), 0.5);
            state.select_rows((0..100).collect()).expect("it fits");
            state.clamp_opacities(0.3).expect("it fits");
            // A loss that is no number closes a state; going back opens it.
            update(&mut state, &random(100, 4, 4), f32::NAN);
            assert_eq!(snapshot.to_host().expect("the device answers"), expected);
            state.restore(&snapshot).expect("it fits");
            assert_eq!(state.snapshot().and_then(|s| s.to_host()).expect("the device answers"), expected);
            assert_eq!((state.num_updates(), state.status().expect("the device answers").failed), (1, None));
        }
        let uploaded = Snapshot::from_host(expected.clone(), &device).expect("it fits");
        assert_eq!(uploaded.to_host().expect("the device answers"), expected);
    }
}
