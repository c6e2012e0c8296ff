//! One Adam update of all parameter groups, by number of Gaussians (SH degree 3: 59 values each).

use burn::tensor::{Device, Tensor};
use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use gazesplat_render::{Splats, cpu_device, device::gpu_device, is_gpu};
use gazesplat_train::config::OptimSection;
use gazesplat_train::optim::{AdamSettings, Columns, LearningRates, ModelState, Regularizers};

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
        }
    }
    group.finish();
}

/// One update, and the wait for it.
fn update(state: &mut ModelState, gradients: Splats) {
    let rates = LearningRates::at(&OptimSection::default(), 0, 1000, 1.0);
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
