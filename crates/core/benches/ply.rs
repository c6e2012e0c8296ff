//! Loading and saving of 3DGS PLY files from and to the page cache, beside a plain copy of the same bytes.
//!
//! Throughput is counted in bytes of the file.

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use gazesplat_core::GaussianCloud;
use gazesplat_core::io::ply;
use gazesplat_core::rng::Rng;
use std::hint::black_box;

fn cloud(num_gaussians: usize, degree: u32) -> GaussianCloud {
    let mut rng = Rng::new(1);
    let mut cloud = GaussianCloud::zeros(num_gaussians, degree);
    cloud.quats.fill([1.0, 0.0, 0.0, 0.0]);
    cloud.means.as_flattened_mut().iter_mut().for_each(|v| *v = rng.uniform());
    cloud.sh.as_flattened_mut().iter_mut().for_each(|v| *v = rng.uniform());
    cloud
}

fn benches(criterion: &mut Criterion) {
    let dir = tempfile::tempdir().expect("a temporary directory can be made");
    let path = dir.path().join("model.ply");
    for (num_gaussians, degree) in [(10_000, 3), (100_000, 3), (1_000_000, 3), (1_000_000, 0)] {
        let cloud = cloud(num_gaussians, degree);
        ply::save(&path, &cloud).expect("the directory is writable");
        let bytes = std::fs::read(&path).expect("the file was just written");
        let mut group = criterion.benchmark_group("ply");
        group.sample_size(10).throughput(Throughput::Bytes(bytes.len() as u64));
        let name = format!("{num_gaussians} of degree {degree}");
        group.bench_with_input(BenchmarkId::new("copy", &name), &bytes, |b, bytes| b.iter(|| black_box(bytes.clone())));
        group.bench_with_input(BenchmarkId::new("load", &name), &path, |b, path| b.iter(|| ply::load(path)));
        group.bench_with_input(BenchmarkId::new("encode", &name), &cloud, |b, cloud| {
            let mut out = Vec::with_capacity(bytes.len());
            b.iter(|| {
                out.clear();
                ply::write_to(&mut out, cloud)
            });
        });
        group.bench_with_input(BenchmarkId::new("save", &name), &cloud, |b, cloud| b.iter(|| ply::save(&path, cloud)));
        group.finish();
    }
}

criterion_group!(group, benches);
criterion_main!(group);
