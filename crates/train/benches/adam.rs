//! One Adam update of all parameter groups, by number of Gaussians (SH degree 3: 59 values each).

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use gazesplat_train::config::OptimSection;
use gazesplat_train::optim::{Adam, AdamSettings, Columns, LearningRates};

fn adam(c: &mut Criterion) {
    let mut group = c.benchmark_group("adam");
    for num_gaussians in [60_000usize, 300_000] {
        let widths = [3, 4, 3, 1, 48];
        let mut params = Columns { data: widths.map(|w| vec![0.1; w * num_gaussians]), widths };
        let mut grads = params.zeros_like();
        grads.data.iter_mut().for_each(|g| g.fill(1e-3));
        let mut adam = Adam::new(&params, AdamSettings::default());
        let rates = LearningRates::at(&OptimSection::default(), 0, 1000, 1.0);
        group.throughput(Throughput::Elements(num_gaussians as u64));
        group.bench_function(BenchmarkId::from_parameter(num_gaussians), |b| {
            b.iter(|| adam.update(&mut params, &grads, &rates));
        });
    }
    group.finish();
}

criterion_group!(benches, adam);
criterion_main!(benches);
