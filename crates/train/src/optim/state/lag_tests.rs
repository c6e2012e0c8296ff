//! Rows that lag against the dense optimiser, which does every update of every row.
//! The file is long because all of it compares one model with its dense twin.

use super::*;
use crate::backend::{Densification, NoiseUpdate, Refinement};
use crate::densify::Bounds;
use crate::optim::{AdamSettings, Columns, Group, HostState, LearningRates, Regularizers};
use burn::tensor::{Device, Tensor};
use gazesplat_core::Pinhole;
use gazesplat_render::{cpu_device, device::gpu_device};
use gazesplat_testkit::{Rng, devices::required_gpu};
use glam::Vec3;

const RATES: ShRates = ShRates { dc: 2.5e-3, rest: 1.25e-4 };
/// Rows; a job of the CPU has 256.
const N: usize = 700;
const K: usize = 4;
const WIDTH: usize = 3 * K;

fn devices() -> Vec<Device> {
    let mut devices = vec![cpu_device()];
    #[cfg(feature = "flex")]
    devices.push(gazesplat_render::flex_device());
    devices.extend(required_gpu(gpu_device(None)));
    devices
}

/// Cameras that look along x, y or z from the origin.
fn camera(axis: usize) -> Camera {
    let target = [Vec3::X, Vec3::Y, Vec3::Z][axis];
    let up = [Vec3::Y, Vec3::Z, Vec3::X][axis];
    Camera::look_at(Pinhole::from_fov_x(64, 48, 0.8), Vec3::ZERO, target, up)
}

/// Small Gaussians; row i lies on axis i mod 4 and is seen by that camera only; those of 3 by none.
fn start() -> Columns {
    let mut rng = Rng::new(5);
    let widths = [3, 4, 3, 1, WIDTH];
    let mut columns = Columns { data: widths.map(|w| vec![0.0; w * N]), widths };
    for row in 0..N {
        let mut mean = [0.05 * (rng.unit() as f32 - 0.5), 0.05, 0.02];
        match row % 4 {
            3 => mean = [-3.0, -3.0, -3.0],
            axis => mean[axis] = 2.0 + rng.unit() as f32,
        }
        columns.row_mut(Group::Means, row).copy_from_slice(&mean);
        columns.row_mut(Group::Quats, row)[0] = 1.0;
        columns.row_mut(Group::LogScales, row).fill(-5.0);
        columns.row_mut(Group::Sh, row).iter_mut().for_each(|v| *v = rng.unit() as f32 * 2.0 - 1.0);
    }
    columns
}

fn is_seen(row: usize, axis: usize) -> bool {
    row % 4 == axis
}

/// Only SH coefficients learn, so that the views stay as they are.
fn rates() -> LearningRates {
    LearningRates { sh_dc: RATES.dc, sh_rest: RATES.rest, ..LearningRates::NONE }
}

/// The view of an update: now and then the same for long, so that the others miss many.
fn view_of(number: u32) -> usize {
    let words = crate::rng::draw(3, crate::rng::Stream::ViewOrder, number / 40, 0);
    match words[0] % 3 {
        0 => (number % 3) as usize,
        1 => 1,
        _ => (words[1] % 2) as usize,
    }
}

/// Gradients of what `axis` sees, from 1 down to below ε: row by row another scale.
fn gradients(number: u32, axis: usize) -> Columns {
    let mut rng = Rng::new(u64::from(number));
    let widths = [3, 4, 3, 1, WIDTH];
    let mut columns = Columns { data: widths.map(|w| vec![0.0; w * N]), widths };
    for row in (0..N).filter(|&row| is_seen(row, axis)) {
        let scale = 10f32.powi(-((row / 4 % 18) as i32));
        columns.row_mut(Group::Sh, row).iter_mut().for_each(|v| *v = scale * (rng.unit() as f32 * 2.0 - 0.8));
    }
    columns
}

fn update(state: &mut ModelState, grads: &Columns, loss: f32) {
    let device = state.device().clone();
    let loss = Tensor::<1>::from_data([loss], &device);
    let grads = grads.clone().into_splats(&device);
    state.update(grads, loss, rates(), Regularizers::default(), false).expect("the device answers");
}

fn step(state: &mut ModelState, number: u32) {
    let axis = view_of(number);
    state.prepare(&camera(axis), 0.01).expect("valid");
    update(state, &gradients(number, axis), 0.5);
}

fn model(lags: bool, device: &Device) -> ModelState {
    let mut state = ModelState::new(start(), AdamSettings::default(), device).expect("it fits");
    if lags {
        state.let_unseen_lag(RATES);
    }
    state
}

fn run(state: &mut ModelState, updates: std::ops::RangeInclusive<u32>) {
    updates.for_each(|number| step(state, number));
}

fn host(state: &ModelState) -> HostState {
    state.snapshot().and_then(|s| s.to_host()).expect("the device answers")
}

fn current(state: &ModelState) -> Columns {
    Columns::from_splats(state.current().expect("the device answers")).expect("the device answers")
}

/// Adam in f64, every update of every row: values, moments, and the length of the way of each value.
fn reference(num_updates: u32) -> [Vec<f64>; 4] {
    let values: Vec<f64> = start().of(Group::Sh).iter().map(|&v| f64::from(v)).collect();
    let zeros = || vec![0.0f64; values.len()];
    let (mut first, mut second, mut way) = (zeros(), zeros(), zeros());
    let mut values = values;
    let (beta1, beta2) = (0.9f64, 0.999f64);
    for number in 1..=num_updates {
        let grads = gradients(number, view_of(number));
        let t = f64::from(number);
        for (i, &g) in grads.of(Group::Sh).iter().enumerate() {
            let (g, lr) = (f64::from(g), f64::from(if i % WIDTH < 3 { RATES.dc } else { RATES.rest }));
            first[i] = beta1 * first[i] + (1.0 - beta1) * g;
            second[i] = beta2 * second[i] + (1.0 - beta2) * g * g;
            let root = (second[i] / (1.0 - beta2.powf(t))).sqrt();
            let moved = lr * first[i] / (1.0 - beta1.powf(t)) / (root + 1e-15);
            values[i] -= moved;
            way[i] += moved.abs();
        }
    }
    [values, first, second, way]
}

/// Updates of the tests: past one catching-up of all rows at 768 and 1024, with rows behind at the end.
const NUM_UPDATES: u32 = 1100;

#[test]
fn rows_that_lagged_end_where_the_dense_optimiser_takes_them() {
    let [values, first, second, way] = reference(NUM_UPDATES);
    for device in devices() {
        for lags in [false, true] {
            let mut state = model(lags, &device);
            run(&mut state, 1..=NUM_UPDATES);
            assert_eq!(state.is_lagging, lags);
            let found = current(&state);
            if lags {
                let words = host(&state).last;
                assert!(words.iter().any(|&w| w + 30 < NUM_UPDATES) && words.contains(&NUM_UPDATES), "some lag");
                state.catch_up().expect("it fits");
                let caught_up = Columns::from_splats(state.lent()).expect("the device answers");
                assert!(caught_up == found, "looking and catching up are the same");
            }
            let moments = state.moments().expect("the device answers");
            for (i, &found) in found.of(Group::Sh).iter().enumerate() {
                // The value is rounded once per update; a step is off by a few roundings of its moments, which are running
                // sums of a few roundings each: up to ten units in the last place, and on a device its square root and
                // division to 2.5 more each.
                let allowed = f64::from(NUM_UPDATES) * 6e-8 * values[i].abs().max(1.0) + 16.0 * 6e-8 * way[i];
                let error = (f64::from(found) - values[i]).abs();
                assert!(error <= allowed, "{lags} row {} lane {}: {error:e}, {allowed:e}", i / WIDTH, i % WIDTH);
                // Opposite gradients leave a first moment at the rounding of what it was: its root mean square.
                let (m, v) = (f64::from(moments[0].of(Group::Sh)[i]), f64::from(moments[1].of(Group::Sh)[i]));
                let m_error = (m - first[i]).abs() / (second[i].sqrt() * 10.0 + 1e-36);
                // What is below 1e-37 is set to zero (kernels/cpu/adam.rs): of a larger moment that may cost a part of 1e-5.
                let v_error = if second[i] > 1e-32 { (v / second[i] - 1.0).abs() } else { 0.0 };
                assert!(m_error < 3e-6, "{lags} {i}: {m:e} {:e}", first[i]);
                // A running mean of a thousand updates: each rounding lives for a thousand, 6e-8 √1000 and its worst.
                assert!(v_error < 6e-5, "{lags} {i}: {v:e} {:e}", second[i]);
            }
        }
    }
}

#[test]
fn rows_that_are_always_seen_take_the_very_updates_of_the_dense_optimiser() {
    // Every row in front of one camera: not a bit may differ, whatever kernel does it.
    for device in devices() {
        let mut params = start();
        for row in 0..N {
            params.row_mut(Group::Means, row).copy_from_slice(&[0.0, 0.0, 2.0]);
        }
        let mut states = [false, true].map(|lags| {
            let mut state = ModelState::new(params.clone(), AdamSettings::default(), &device).expect("it fits");
            if lags {
                state.let_unseen_lag(RATES);
            }
            state
        });
        for number in 1..=DENSE_UPDATES + 20 {
            for state in &mut states {
                state.prepare(&camera(2), 0.01).expect("valid");
                update(state, &gradients(number, (number % 3) as usize), 0.5);
            }
        }
        assert!(states[1].is_lagging && host(&states[1]).last.iter().all(|&w| w == DENSE_UPDATES + 20));
        let [dense, seen] = states.each_ref().map(host);
        assert!(dense.rows == seen.rows);
    }
}

#[test]
fn bits_do_not_depend_on_threads_nor_on_who_looks_nor_on_interruptions() {
    let device = cpu_device();
    let mut expected = model(true, &device);
    run(&mut expected, 1..=900);
    let expected = host(&expected);
    assert!(!expected.last.is_empty());
    for threads in [1, 2, 5] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("the test sets this up");
        let found = pool.install(|| {
            let mut state = model(true, &device);
            run(&mut state, 1..=600);
            // Looks, a snapshot to go back to, and a state that is written down and taken up again.
            let before = (current(&state), host(&state));
            let snapshot = state.snapshot().expect("it fits");
            let seen = Columns::from_splats(snapshot.splats().expect("it fits")).expect("a CPU answers");
            assert!(seen == before.0);
            run(&mut state, 601..=650);
            state.restore(&snapshot).expect("it fits");
            assert!((current(&state), host(&state)) == before);
            let mut state = ModelState::from_host(host(&state), AdamSettings::default(), &device).expect("it fits");
            state.let_unseen_lag(RATES);
            run(&mut state, 601..=900);
            host(&state)
        });
        assert!(found == expected, "{threads} threads");
    }
}

#[test]
fn snapshots_of_a_device_stay_as_they_are() {
    for device in devices() {
        let mut state = model(true, &device);
        run(&mut state, 1..=560);
        let snapshot = state.snapshot().expect("it fits");
        let expected = snapshot.to_host().expect("the device answers");
        let handed_out = state.current().expect("it fits");
        let held = current(&state);
        run(&mut state, 561..=600);
        state.catch_up().expect("it fits");
        assert!(snapshot.to_host().expect("the device answers") == expected);
        assert!(Columns::from_splats(handed_out).expect("the device answers") == held);
        state.restore(&snapshot).expect("it fits");
        assert!(host(&state) == expected);
        // A state that is prepared can be taken up, too: the view it was prepared for comes again.
        state.prepare(&camera(view_of(561)), 0.01).expect("valid");
        let prepared = host(&state);
        assert!(prepared.last.iter().any(|&w| w & crate::optim::missed::PREPARED > 0));
        let mut resumed = ModelState::from_host(prepared, AdamSettings::default(), &device).expect("it fits");
        resumed.let_unseen_lag(RATES);
        run(&mut resumed, 561..=580);
        state.restore(&snapshot).expect("it fits");
        run(&mut state, 561..=580);
        assert!(host(&resumed) == host(&state));
    }
}

#[test]
fn a_loss_that_is_no_number_changes_nothing_of_what_lags() {
    for device in devices() {
        let mut state = model(true, &device);
        run(&mut state, 1..=560);
        let expected = {
            let snapshot = state.snapshot().expect("it fits");
            run(&mut state, 561..=575);
            let expected = host(&state);
            state.restore(&snapshot).expect("it fits");
            expected
        };
        state.prepare(&camera(view_of(561)), 0.01).expect("valid");
        update(&mut state, &gradients(561, view_of(561)), f32::NAN);
        // A GPU goes on until somebody looks.
        run(&mut state, 562..=565);
        assert_eq!(state.status().expect("the device answers").failed.map(|f| f.0), Some(561));
        state.reopen(560);
        run(&mut state, 561..=575);
        assert!(host(&state) == expected);
        // Where rows were to be brought up to date in between, no word speaks of an update that was never done.
        state.prepare(&camera(view_of(576)), 0.01).expect("valid");
        update(&mut state, &gradients(576, view_of(576)), f32::NAN);
        state.catch_up().expect("it fits");
        run(&mut state, 577..=580);
        state.reopen(575);
        let words = host(&state).last;
        assert!(words.iter().all(|&word| word <= 575), "{words:?}");
        run(&mut state, 576..=577);
    }
}

const BOUNDS: Bounds = Bounds { center: [0.0; 3], max_log_scale: 5.0, max_distance: 1e5 };

#[test]
fn every_operation_on_rows_finds_them_up_to_date() {
    type Operation = fn(&mut ModelState);
    let operations: [(&str, Operation); 7] = [
        ("sort", |state| state.sort_spatially([0.0; 3], 4.0).expect("it fits")),
        ("select", |state| state.select_rows((0..N as u32).rev().filter(|i| i % 5 > 0).collect()).expect("it fits")),
        ("widen", |state| state.widen_sh(9).expect("it fits")),
        ("refine", |state| {
            let refinement =
                Refinement { seed: 3, step: 500, growth: 1.05, cap: 720, min_opacity: 0.005, bounds: BOUNDS };
            assert_eq!(state.refine(refinement).expect("it fits").num_added, 20);
        }),
        ("densify", |state| {
            let densification = Densification {
                seed: 3,
                step: 500,
                cap: 720,
                grow_gradient: 0.5,
                max_clone_log_scale: 0.0,
                min_logit: -20.0,
                max_log_scale: None,
                bounds: BOUNDS,
                reset_logit: None,
            };
            let statistic = Tensor::<2>::ones([state.num_rows(), 2], state.device());
            assert_eq!(state.densify(statistic, densification).expect("it fits").num_added, 20);
        }),
        ("sweep", |state| {
            state.sweep(BOUNDS).expect("it fits");
        }),
        ("update", |state| update(state, &gradients(1, 0), 0.5)),
    ];
    for device in devices() {
        let mut state = model(true, &device);
        run(&mut state, 1..=600);
        let snapshot = state.snapshot().expect("it fits");
        for (name, operation) in operations {
            state.restore(&snapshot).expect("it fits");
            state.catch_up().expect("it fits");
            operation(&mut state);
            let expected = host(&state);
            state.restore(&snapshot).expect("it fits");
            assert!(state.is_lagging);
            operation(&mut state);
            assert!(!state.is_lagging && host(&state) == expected, "{name}");
        }
        // Noise moves means and reads no colour: rows go on lagging.
        state.restore(&snapshot).expect("it fits");
        state.add_noise(NoiseUpdate { strength: 1.0, seed: 1, step: 1 }).expect("it fits");
        assert!(state.is_lagging);
    }
}

#[test]
fn nothing_lags_early_without_bands_or_without_rows() {
    let device = cpu_device();
    let mut state = model(true, &device);
    run(&mut state, 1..=DENSE_UPDATES);
    assert!(!state.is_lagging);
    run(&mut state, DENSE_UPDATES + 1..=DENSE_UPDATES + 1);
    assert!(state.is_lagging);
    state.select_rows(Vec::new()).expect("it fits");
    state.prepare(&camera(0), 0.01).expect("valid");
    assert!(!state.is_lagging && state.num_rows() == 0);
    // Only the constant coefficient: three of fourteen values are not worth words.
    let mut params = start();
    (params.data[Group::Sh as usize], params.widths[Group::Sh as usize]) = (vec![0.1; 3 * N], 3);
    let mut state = ModelState::new(params, AdamSettings::default(), &device).expect("it fits");
    state.let_unseen_lag(RATES);
    state.num_updates = 2 * DENSE_UPDATES;
    state.prepare(&camera(0), 0.01).expect("valid");
    assert!(!state.is_lagging);
}

/// The half-spaces hold everything that the renderer draws.
#[test]
fn what_is_drawn_may_be_seen() {
    use gazesplat_render::{RenderOptions, StatsMode, count};
    let mut rng = Rng::new(11);
    let n = 20_000;
    let mut columns = Columns { data: [3, 4, 3, 1, 3].map(|w| vec![0.0; w * n]), widths: [3, 4, 3, 1, 3] };
    for row in 0..n {
        columns.row_mut(Group::Means, row).iter_mut().for_each(|v| *v = 4.0 * (rng.unit() as f32 - 0.5));
        columns.row_mut(Group::Quats, row).iter_mut().for_each(|v| *v = rng.unit() as f32 - 0.5);
        columns.row_mut(Group::LogScales, row).iter_mut().for_each(|v| *v = -7.0 + 6.0 * rng.unit() as f32);
        columns.row_mut(Group::OpacityLogits, row)[0] = 12.0 * (rng.unit() as f32 - 0.3);
    }
    for device in devices() {
        let splats = columns.clone().into_splats(&device);
        let (mut num_drawn, mut num_marked) = (0, 0);
        for (near, axis) in [(0.01, 0), (0.5, 1), (1.5, 2)] {
            let view = SeenBy::new(&camera(axis), near).expect("valid");
            let options = RenderOptions { stats: StatsMode::Tiles, near, ..RenderOptions::default() };
            let counted = count(&splats, &camera(axis), &options).expect("valid").splat_stats;
            for row in 0..n {
                let mean = columns.row(Group::Means, row);
                let mean = gazesplat_render::math::vec::Vec3 { x: mean[0], y: mean[1], z: mean[2] };
                let scale = columns.row(Group::LogScales, row).iter().fold(f32::MIN, |a, &b| a.max(b)).exp();
                let is_marked = crate::math::may_be_seen(view.sides, view.front, mean, scale);
                assert!(is_marked || counted.tiles_used[row] == 0, "{near} {row}");
                num_drawn += usize::from(counted.tiles_used[row] > 0);
                num_marked += usize::from(is_marked);
            }
        }
        assert!(num_drawn > 1000 && num_marked < 2 * n, "{num_drawn} drawn, {num_marked} marked");
    }
}
