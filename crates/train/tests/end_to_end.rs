//! Whole training runs on a small procedural scene: quality, reproducibility, failure.

#![expect(clippy::unwrap_used, reason = "a helper of a test may panic like the test")]

use gazesplat_core::dataset::{Dataset, SparsePoints};
use gazesplat_core::io::images::ImageCache;
use gazesplat_core::synthetic::{SynthOptions, write_scene};
use gazesplat_render::cpu_device;
use gazesplat_train::event::{Observer, TrainEvent};
use gazesplat_train::{Config, Error, Outcome, Trainer, run, with_threads};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// A directory of this test, removed when dropped.
struct Scratch(PathBuf);

impl Scratch {
    fn new(name: &str) -> Self {
        let dir = std::env::temp_dir().join(format!("gazesplat-train-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        Self(dir)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        // A leftover in the temporary directory is no reason to fail.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn scene(name: &str, num_views: usize) -> (Scratch, Dataset) {
    let scratch = Scratch::new(name);
    let options = SynthOptions {
        num_views,
        width: 120,
        height: 80,
        samples_per_side: 2,
        num_points: 2000,
        ..SynthOptions::default()
    };
    let dataset = write_scene(&scratch.0, &options).unwrap();
    (scratch, dataset)
}

fn config(steps: u32, cap: usize) -> Config {
    let mut config = Config::default();
    config.train.steps = steps;
    config.densify.cap = cap;
    config
}

fn trainer(dataset: &Dataset, config: &Config) -> Trainer {
    let images = Arc::new(ImageCache::new(dataset.train.clone(), config.data.cache_bytes));
    Trainer::new(dataset, images, config, &cpu_device()).unwrap()
}

/// What a run said.
#[derive(Default)]
struct Log {
    losses: Vec<f32>,
    messages: Vec<String>,
    psnr: Option<f64>,
    num_densified: usize,
    finished: bool,
}

impl Observer for Log {
    fn on_event(&mut self, event: &TrainEvent<'_>) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
        match event {
            TrainEvent::Step(report) => self.losses.extend(report.losses.as_ref().map(|l| l.total)),
            TrainEvent::Message(text) => self.messages.push((*text).to_string()),
            TrainEvent::Evaluated { report, .. } => self.psnr = Some(report.psnr),
            TrainEvent::Densified { .. } => self.num_densified += 1,
            TrainEvent::Finished { .. } => self.finished = true,
            TrainEvent::Started { .. } | TrainEvent::LoadingImages { .. } => {}
        }
        Ok(())
    }
}

#[test]
fn a_short_run_on_the_room_reaches_its_quality_floor() {
    let (_scratch, dataset) = scene("floor", 32);
    let mut trainer = trainer(&dataset, &config(800, 6000));
    let before = trainer.evaluate().unwrap();
    let mut log = Log::default();
    let outcome = run(&mut trainer, &mut [&mut log], &AtomicBool::new(false)).unwrap();
    assert_eq!(outcome, Outcome::Finished);
    assert!(log.finished && log.num_densified > 0);
    assert_eq!(trainer.splats().len(), 6000);
    let psnr = log.psnr.unwrap();
    println!("test PSNR {:.2} dB, before training {:.2} dB", psnr, before.psnr);
    assert!(psnr > PSNR_FLOOR_DB && psnr > before.psnr + 3.0, "{psnr} {}", before.psnr);
    let cloud = trainer.to_cloud().unwrap();
    assert_eq!((cloud.len(), cloud.sh_degree), (6000, 3));
    cloud.validate().unwrap();
}

/// Measured on AVX-512; one dB below leaves room for other instruction sets.
const PSNR_FLOOR_DB: f64 = 22.0;

#[test]
fn the_model_does_not_depend_on_the_number_of_threads() {
    let (_scratch, dataset) = scene("threads", 9);
    let clouds: Vec<_> = [1, 2, 3]
        .into_iter()
        .map(|threads| {
            with_threads(threads, || {
                let mut trainer = trainer(&dataset, &config(60, 3000));
                run(&mut trainer, &mut [], &AtomicBool::new(false)).unwrap();
                trainer.to_cloud().unwrap()
            })
            .unwrap()
        })
        .collect();
    assert!(clouds.windows(2).all(|w| w[0] == w[1]));
    assert_eq!(clouds[0].len(), 3000);
}

#[test]
fn a_stopped_run_continues_to_the_model_of_an_unbroken_one() {
    let (_scratch, dataset) = scene("stop", 9);
    let mut unbroken = trainer(&dataset, &config(40, 2500));
    run(&mut unbroken, &mut [], &AtomicBool::new(false)).unwrap();
    let mut stopped = trainer(&dataset, &config(40, 2500));
    for _ in 0..17 {
        stopped.step().unwrap();
    }
    assert_eq!(run(&mut stopped, &mut [], &AtomicBool::new(true)).unwrap(), Outcome::Stopped);
    assert_eq!(stopped.step_index(), 17);
    run(&mut stopped, &mut [], &AtomicBool::new(false)).unwrap();
    assert!(stopped.to_cloud().unwrap() == unbroken.to_cloud().unwrap());
}

#[test]
fn a_scene_without_points_starts_at_random_and_says_so() {
    let (_scratch, mut dataset) = scene("random", 9);
    dataset.points = SparsePoints::default();
    let mut settings = config(30, 4000);
    settings.init.random_points = 2000;
    let mut trainer = trainer(&dataset, &settings);
    assert_eq!(trainer.splats().len(), 2000);
    let mut log = Log::default();
    run(&mut trainer, &mut [&mut log], &AtomicBool::new(false)).unwrap();
    assert!(log.messages.iter().any(|m| m.contains("random")), "{:?}", log.messages);
    assert!(log.losses.last() < log.losses.first());
}

#[test]
fn a_loss_that_is_no_number_stops_the_run_and_keeps_the_model() {
    let (_scratch, dataset) = scene("nan", 4);
    let settings = config(10, 2500);
    let mut cloud = trainer(&dataset, &settings).to_cloud().unwrap();
    cloud.sh[16 * 7] = [f32::MAX; 3];
    let images = Arc::new(ImageCache::new(dataset.train.clone(), settings.data.cache_bytes));
    let mut trainer = Trainer::from_cloud(&cloud, &dataset, images, &settings, &cpu_device()).unwrap();
    // Views that do not see the Gaussian pass.
    let (before, error) = (0..10)
        .find_map(|_| {
            let before = trainer.to_cloud().unwrap();
            trainer.step().err().map(|error| (before, error))
        })
        .unwrap();
    let message = error.to_string();
    assert!(message.contains("view_00") && message.contains("sh of Gaussian 7"), "{message}");
    assert!(trainer.to_cloud().unwrap() == before);
}

#[cfg(feature = "flex")]
#[test]
fn both_cpu_backends_train_the_same_model() {
    let (_scratch, dataset) = scene("flex", 5);
    let settings = config(12, 2500);
    let train = |device: &burn::tensor::Device| {
        let images = Arc::new(ImageCache::new(dataset.train.clone(), settings.data.cache_bytes));
        let mut trainer = Trainer::new(&dataset, images, &settings, device).unwrap();
        run(&mut trainer, &mut [], &AtomicBool::new(false)).unwrap();
        trainer.to_cloud().unwrap()
    };
    assert!(train(&cpu_device()) == train(&gazesplat_render::flex_device()));
}

#[test]
fn a_scene_without_training_views_is_refused() {
    let (_scratch, mut dataset) = scene("empty", 2);
    dataset.train.clear();
    let images = Arc::new(ImageCache::new(Vec::new(), 0));
    let refused = Trainer::new(&dataset, images, &Config::default(), &cpu_device());
    assert!(matches!(refused, Err(Error::NoTrainingViews { .. })));
}
