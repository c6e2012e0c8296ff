//! Trains a model of a procedural room and measures it on views it has not seen.
//!
//! ```sh
//! cargo run --release --example 02_train_synthetic -- room
//! ```

use gazesplat_core::io::images::ImageCache;
use gazesplat_core::io::ply;
use gazesplat_core::synthetic::{SynthOptions, write_scene};
use gazesplat_render::cpu_device;
use gazesplat_train::{Config, Observer, TrainEvent, Trainer, run};
use std::error::Error;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Tells what a person would want to follow; a trainer itself says nothing.
struct Teller;

impl Observer for Teller {
    fn on_event(&mut self, event: &TrainEvent<'_>) -> Result<(), Box<dyn Error + Send + Sync>> {
        match event {
            TrainEvent::Step(report) if report.step.is_multiple_of(100) => {
                // On a GPU the losses are read back for logged steps only.
                let loss = report.losses.as_ref().map_or(f32::NAN, |losses| losses.total);
                eprintln!("step {}: loss {loss:.4}, {} Gaussians", report.step, report.num_gaussians);
            }
            TrainEvent::Evaluated { step, report } => eprintln!("step {step}: {:.2} dB on test views", report.psnr),
            _ => {}
        }
        Ok(())
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let dir = PathBuf::from(std::env::args().nth(1).ok_or("usage: 02_train_synthetic OUT_DIR")?);
    let scene = SynthOptions { num_views: 32, width: 240, height: 160, num_points: 4000, ..SynthOptions::default() };
    let dataset = write_scene(dir.join("scene"), &scene)?;

    let mut config = Config::default();
    config.train.steps = 800;
    config.train.eval_every = 200;
    config.densify.cap = 15_000;

    let images = Arc::new(ImageCache::new(dataset.train.clone(), config.data.cache_bytes));
    let mut trainer = Trainer::new(&dataset, images, &config, &cpu_device())?;
    run(&mut trainer, &mut [&mut Teller], &AtomicBool::new(false))?;

    let model = dir.join("model.ply");
    ply::save(&model, &trainer.to_cloud()?)?;
    eprintln!("wrote {}", model.display());
    Ok(())
}
