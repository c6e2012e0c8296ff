//! Steps that cost less, on a scene from photographs to quality: rows that lag, and images that grow.

use gazesplat_core::dataset::Dataset;
use gazesplat_core::io::images::ImageCache;
use gazesplat_core::synthetic::{SynthOptions, write_scene};
use gazesplat_render::{cpu_device, device::gpu_device};
use gazesplat_testkit::devices::required_gpu;
use gazesplat_train::{Config, Trainer};
use std::sync::Arc;

fn scene(dir: &std::path::Path) -> Dataset {
    let options = SynthOptions {
        num_views: 24,
        width: 96,
        height: 64,
        samples_per_side: 1,
        num_points: 1500,
        ..SynthOptions::default()
    };
    write_scene(dir, &options).expect("writable")
}

fn config(steps: u32) -> Config {
    let mut config = Config::default();
    config.train.steps = steps;
    config.densify.cap = 3000;
    config.model.sh_degree = 2;
    config
}

/// How much better a model must become than it began, for its quality to say anything: half the squared error, dB.
const LEAST_GAIN: f64 = 3.0;

/// Quality on the test views at the beginning, dB.
fn untrained(dataset: &Dataset) -> f64 {
    let images = Arc::new(ImageCache::new(dataset.train.clone(), 1 << 30));
    let mut trainer = Trainer::new(dataset, images, &config(10), &cpu_device()).expect("valid");
    trainer.evaluate().expect("readable").psnr
}

/// Quality on the test views at the end, dB.
fn trained(dataset: &Dataset, config: &Config, device: &burn::tensor::Device) -> f64 {
    let images = Arc::new(ImageCache::new(dataset.train.clone(), 1 << 30));
    let mut trainer = Trainer::new(dataset, images, config, device).expect("valid");
    while trainer.step_index() < config.train.steps {
        trainer.step().expect("trains");
    }
    trainer.evaluate().expect("readable").psnr
}

#[test]
fn quality_is_that_of_the_dense_optimiser_when_rows_lag() {
    let dir = tempfile::tempdir().expect("temporary directory");
    let dataset = scene(dir.path());
    let quality = |visible_only: bool| {
        let mut config = config(1200);
        config.optim.visible_only = visible_only;
        trained(&dataset, &config, &cpu_device())
    };
    let (start, dense, lagging) = (untrained(&dataset), quality(false), quality(true));
    println!("start {start} dB, dense {dense} dB, visible only {lagging} dB");
    // The optimiser is the same but for rounding, which a run amplifies to what another seed does: the published version
    // without the caught-up decay loses 0.18 dB.
    assert!((lagging - dense).abs() < 0.1 && dense > start + LEAST_GAIN);
}

#[test]
fn a_run_from_coarse_to_fine_ends_as_good_as_one_of_full_size() {
    let dir = tempfile::tempdir().expect("temporary directory");
    let dataset = scene(dir.path());
    let quality = |num_downscales: u32| {
        let mut config = config(800);
        config.train.num_downscales = num_downscales;
        trained(&dataset, &config, &cpu_device())
    };
    let (start, fine, coarse) = (untrained(&dataset), quality(0), quality(2));
    println!("start {start} dB, full size {fine} dB, from coarse to fine {coarse} dB");
    // A run that ended on half of the size would lose several dB on images of full size.
    assert!(coarse > fine - 0.5 && fine > start + LEAST_GAIN);
}

#[test]
fn a_gpu_takes_both_to_the_quality_of_the_cpu() {
    let Some(device) = required_gpu(gpu_device(None)) else { return };
    let dir = tempfile::tempdir().expect("temporary directory");
    let dataset = scene(dir.path());
    let mut config = config(600);
    (config.optim.visible_only, config.train.num_downscales) = (true, 1);
    let (cpu, gpu) = (trained(&dataset, &config, &cpu_device()), trained(&dataset, &config, &device));
    println!("CPU {cpu} dB, GPU {gpu} dB");
    // Draws of sources differ between the two by design, as another seed would; spec/training.md asks for 0.3 dB.
    assert!((cpu - gpu).abs() < 0.3, "{cpu} {gpu}");
}
