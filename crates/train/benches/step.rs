//! A whole training step of the standard case: 300,000 Gaussians of SH degree 3, one megapixel, 40 % visible; on the CPU,
//! and on a GPU that is no software driver. There the loss is read after every step, so that a sample is a whole step; the
//! stages are times of queueing.

use criterion::{Criterion, criterion_group, criterion_main};
use gazesplat_core::dataset::{Dataset, LoadOptions, SceneFormat, SparsePoints};
use gazesplat_core::image::RgbImage8;
use gazesplat_core::io::images::ImageCache;
use gazesplat_core::synthetic::{bench_camera, bench_cloud};
use gazesplat_core::view::View;
use gazesplat_render::cpu_device;
use gazesplat_render::device::{Device, adapters, gpu_device};
use gazesplat_train::config::StrategyKind;
use gazesplat_train::{Config, StageMs, Trainer};
use std::sync::Arc;

fn step(c: &mut Criterion) {
    let dir = std::env::temp_dir().join(format!("gazesplat-bench-step-{}", std::process::id()));
    std::fs::create_dir_all(&dir).expect("the temporary directory can be written");
    let path = dir.join("view.png");
    let data = (0..3_000_000u32).map(|i| (i / 3 % 1000 / 4) as u8).collect();
    let image = RgbImage8 { width: 1000, height: 1000, data };
    gazesplat_core::io::save_png(&path, &image).expect("the temporary directory can be written");
    let camera = bench_camera(1000, 1000);
    let view = View { name: "view.png".into(), camera, image_path: Some(path), distortion: None, mask_path: None };
    let options = LoadOptions { test_every: 0, ..LoadOptions::default() };
    let dataset = Dataset::from_views(vec![view], SparsePoints::default(), SceneFormat::default(), &options);
    let mut config = Config::default();
    config.densify.strategy = StrategyKind::None;
    config.train.log_every = 1;
    for (name, device) in devices() {
        run(c, name, &device, &dataset, &config);
    }
    std::fs::remove_dir_all(&dir).expect("the directory of this bench");
}

fn devices() -> Vec<(&'static str, Device)> {
    let mut devices = vec![("step_300k_1mpx", cpu_device())];
    match adapters().into_iter().find(|a| a.is_default) {
        Some(a) if !a.is_software() => {
            println!("GPU: {} ({}, {})", a.name, a.api, a.driver);
            devices.push(("step_300k_1mpx_gpu", gpu_device(None).expect("the adapter opens")));
        }
        _ => println!("SKIPPED on a GPU: there is none but perhaps a software driver"),
    }
    devices
}

fn run(c: &mut Criterion, name: &str, device: &Device, dataset: &Dataset, config: &Config) {
    let images = Arc::new(ImageCache::new(dataset.train.clone(), config.data.cache_bytes));
    let cloud = bench_cloud(300_000, 0);
    let mut trainer = Trainer::from_cloud(&cloud, dataset, images, config, device).expect("a valid scene");
    let mut stages: Vec<StageMs> = Vec::new();
    c.bench_function(name, |b| {
        b.iter(|| stages.push(trainer.step().expect("a finite loss").stage_ms));
    });
    let median = |stage: fn(&StageMs) -> f32| {
        let mut values: Vec<f32> = stages.iter().map(stage).collect();
        values.sort_by(f32::total_cmp);
        values[values.len() / 2]
    };
    println!(
        "median ms: image {:.2}, forward {:.2}, loss {:.2}, backward {:.2}, optim {:.2}, densify {:.2}, total {:.2}",
        median(|s| s.image),
        median(|s| s.forward),
        median(|s| s.loss),
        median(|s| s.backward),
        median(|s| s.optim),
        median(|s| s.densify),
        median(|s| s.total)
    );
}

criterion_group!(benches, step);
criterion_main!(benches);
