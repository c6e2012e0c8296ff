//! The fused L1 + SSIM loss with its gradient, by image size.

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use gazesplat_train::kernels::cpu::l1_ssim::{Comparison, Weights, similarity, similarity_and_gradient};
use std::hint::black_box;

fn loss(c: &mut Criterion) {
    let mut group = c.benchmark_group("l1_ssim");
    for (width, height) in [(359, 640), (1000, 1000), (1920, 1080)] {
        let image: Vec<f32> = (0..width * height * 4).map(|i| (i * 7919 % 1009) as f32 / 1009.0).collect();
        let target: Vec<u8> = (0..width * height * 3).map(|i| (i * 104_729 % 256) as u8).collect();
        let comparison = Comparison { width, height, channels: 4, image: &image, target: &target[..], mask: None };
        group.throughput(Throughput::Elements((width * height) as u64));
        let size = format!("{width}x{height}");
        group.bench_function(BenchmarkId::new("value_and_gradient", &size), |b| {
            b.iter(|| black_box(similarity_and_gradient(black_box(&comparison), Weights { l1: 0.8, ssim: -0.2 })));
        });
        group.bench_function(BenchmarkId::new("value", &size), |b| {
            b.iter(|| black_box(similarity(black_box(&comparison))));
        });
    }
    group.finish();
}

criterion_group!(benches, loss);
criterion_main!(benches);
