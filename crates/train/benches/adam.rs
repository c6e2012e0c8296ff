//! One Adam update of all parameter groups, by number of Gaussians (SH degree 3: 59 values each); and one with what comes
//! before it where SH coefficients of unseen Gaussians lag, when two of five are seen: always the same (`same`), or every
//! second time others, which have missed an update each (`other`).

use burn::tensor::{Device, Tensor};
use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use gazesplat_core::{Camera, Pinhole};
use gazesplat_render::{Splats, cpu_device, device::gpu_device, is_gpu};
use gazesplat_train::config::OptimSection;
use gazesplat_train::optim::{AdamSettings, Columns, Group, LearningRates, ModelState, Regularizers, ShRates};
use glam::Vec3;

fn adam(c: &mut Criterion) {
    let mut group = c.benchmark_group("adam");
    let mut devices = vec![("cpu", cpu_device())];
    devices.extend(gpu_device(None).ok().map(|device| ("gpu", device)));
    for (name, device) in devices {
        for num_gaussians in [60_000usize, 300_000] {
            let widths = [3, 4, 3, 1, 48];
            let rows = |value| Columns { data: widths.map(|w| vec![value; w * num_gaussians]), widths };
            let mut state = ModelState::new(rows(0.1), AdamSettings::default(), &device).expect("it fits");
            let mut gradients = gradients(rows(1e-3), &device);
            group.throughput(Throughput::Elements(num_gaussians as u64));
            group.bench_function(BenchmarkId::new(name, num_gaussians), |b| {
                b.iter_batched(&mut gradients, |grads| update(&mut state, grads), BatchSize::PerIteration);
            });
            for (seen, directions) in [("same", [Vec3::X, Vec3::X]), ("other", [Vec3::X, Vec3::Y])] {
                let mut state = lagging(rows(0.1), &device);
                let mut turn = 0;
                group.bench_function(BenchmarkId::new(format!("{name}, {seen} seen"), num_gaussians), |b| {
                    let step = |grads| {
                        turn += 1;
                        state.prepare(&camera(directions[turn % 2]), 0.01).expect("valid");
                        update(&mut state, grads);
                    };
                    b.iter_batched(&mut gradients, step, BatchSize::PerIteration);
                });
            }
        }
    }
    group.finish();
}

fn camera(direction: Vec3) -> Camera {
    Camera::look_at(Pinhole::from_fov_x(64, 48, 0.8), Vec3::ZERO, direction, Vec3::Z)
}

/// A model late enough for rows to lag, two of five clusters along x, two along y, one behind.
fn lagging(mut rows: Columns, device: &Device) -> ModelState {
    for row in 0..rows.num_rows() {
        let mean = [[2.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 2.0, 0.0], [-2.0, -2.0, 0.0]];
        rows.row_mut(Group::Means, row).copy_from_slice(&mean[row / 256 % 5]);
        rows.row_mut(Group::LogScales, row).fill(-5.0);
    }
    let still = Columns { data: rows.data.each_ref().map(|d| vec![0.0; d.len()]), widths: rows.widths };
    let mut state = ModelState::new(rows, AdamSettings::default(), device).expect("it fits");
    let rates = LearningRates::at(&OptimSection::default(), 0, 1000, 1.0);
    state.let_unseen_lag(ShRates { dc: rates.sh_dc, rest: rates.sh_rest });
    for _ in 0..gazesplat_train::optim::missed::DENSE_UPDATES {
        update(&mut state, still.clone().into_splats(device));
    }
    state
}

/// One update, and the wait for it.
fn update(state: &mut ModelState, gradients: Splats) {
    // Means stay, so that a view sees the same rows for as long as the bench runs; the work is the same.
    let rates = LearningRates { means: 0.0, ..LearningRates::at(&OptimSection::default(), 0, 1000, 1.0) };
    let loss = Tensor::<1>::ones([1], state.device());
    state.update(gradients, loss, rates, Regularizers::default(), false).expect("the device answers");
    state.status().expect("the device answers");
}

/// Gradients as the backward pass of the renderer leaves them: tensors of their own on a CPU, views of one allocation on
/// a GPU, which is how a model comes out of an update.
fn gradients(rows: Columns, device: &Device) -> impl FnMut() -> Splats + use<> {
    let device = device.clone();
    let packed = is_gpu(&device).then(|| {
        let mut state = ModelState::new(rows.clone(), AdamSettings::default(), &device).expect("it fits");
        update(&mut state, rows.zeros_like().into_splats(&device));
        state.splats()
    });
    move || packed.clone().unwrap_or_else(|| rows.clone().into_splats(&device))
}

criterion_group!(benches, adam);
criterion_main!(benches);
