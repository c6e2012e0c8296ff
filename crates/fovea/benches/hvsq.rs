//! HVSQ of 960 × 540 images with the reference at hand: value and gradient, the value alone, and making a reference; beside
//! them the fused loss of training at that size, as a yardstick of the machine.

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use gazesplat_fovea::Hvsq;
use gazesplat_fovea::hvs::pooling::{GazePooling, Pooling};
use gazesplat_fovea::hvsq::{Distance, ImageView};
use gazesplat_testkit::reference::hvsq::images::{interleaved, pair};
use gazesplat_train::kernels::cpu::l1_ssim::{Comparison, Weights, similarity_and_gradient};
use std::hint::black_box;

const SIZE: (usize, usize) = (960, 540);

fn hvsq(c: &mut Criterion) {
    let (width, height) = SIZE;
    let [a, b] = pair(height, width).map(|i| interleaved(&i, 4));
    let view = |data| ImageView { width, height, channels: 4, data };
    let (a_view, b_view) = (view(&a[..]), view(&b[..]));
    let mut group = c.benchmark_group("hvsq");
    group.sample_size(20);
    let poolings = [
        ("p=1", Pooling::Uniform { size_px: 1.0 }),
        ("p=3", Pooling::Uniform { size_px: 3.0 }),
        ("p=7", Pooling::Uniform { size_px: 7.0 }),
        ("p=12", Pooling::Uniform { size_px: 12.0 }),
        ("gaze", Pooling::Gaze(GazePooling::default())),
    ];
    for (name, pooling) in poolings {
        for (d, distance) in [("l1", Distance::L1), ("mse", Distance::Mse)] {
            let hvsq = Hvsq::new(pooling, distance).expect("valid");
            let reference = hvsq.reference(a_view).expect("valid");
            let of = |what: &str| BenchmarkId::new(format!("{what} {d}"), name);
            group.bench_function(of("value_and_gradient"), |bench| {
                bench.iter(|| black_box(reference.value_and_gradient(black_box(b_view)).expect("same size")));
            });
            if distance == Distance::L1 {
                continue;
            }
            group.bench_function(of("value"), |bench| {
                bench.iter(|| black_box(reference.value(black_box(b_view)).expect("same size")));
            });
            group.bench_function(of("reference"), |bench| {
                bench.iter(|| black_box(hvsq.reference(black_box(a_view)).expect("valid")));
            });
        }
    }
    let target: Vec<f32> = interleaved(&pair(height, width)[0], 3);
    let comparison = Comparison { width, height, channels: 4, image: &b, target: &target[..], mask: None };
    group.bench_function("l1_ssim value_and_gradient", |bench| {
        bench.iter(|| black_box(similarity_and_gradient(black_box(&comparison), Weights { l1: 0.8, ssim: -0.2 })));
    });
    group.finish();
}

criterion_group!(benches, hvsq);
criterion_main!(benches);
