//! One Adam update of all parameter groups, by number of Gaussians (SH degree 3: 59 values each).

use burn::tensor::{Device, Tensor};
use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use gazesplat_render::{cpu_device, device::gpu_device};
use gazesplat_train::config::OptimSection;
use gazesplat_train::optim::{AdamSettings, Columns, LearningRates, ModelState, Regularizers};

fn adam(c: &mut Criterion) {
    let mut group = c.benchmark_group("adam");
    let mut devices = vec![("cpu", cpu_device())];
    devices.extend(gpu_device(None).ok().map(|device| ("gpu", device)));
    for (name, device) in devices {
        for num_gaussians in [60_000usize, 300_000] {
            group.throughput(Throughput::Elements(num_gaussians as u64));
            group.bench_function(BenchmarkId::new(name, num_gaussians), |b| {
                let mut update = updates(num_gaussians, &device);
                b.iter(&mut update);
            });
        }
    }
    group.finish();
}

/// What does one update and waits for it.
fn updates(num_gaussians: usize, device: &Device) -> impl FnMut() + use<> {
    let widths = [3, 4, 3, 1, 48];
    let params = Columns { data: widths.map(|w| vec![0.1; w * num_gaussians]), widths };
    let mut grads = params.zeros_like();
    grads.data.iter_mut().for_each(|g| g.fill(1e-3));
    let grads = grads.into_splats(device);
    let loss = Tensor::<1>::ones([1], device);
    let mut state = ModelState::new(params, AdamSettings::default(), device);
    let rates = LearningRates::at(&OptimSection::default(), 0, 1000, 1.0);
    move || {
        state.update(grads.clone(), loss.clone(), rates, Regularizers::default(), false).expect("the device answers");
        state.status().expect("the device answers");
    }
}

criterion_group!(benches, adam);
criterion_main!(benches);
