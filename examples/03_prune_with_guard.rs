//! Trains a small model of a procedural room, then prunes it under a guard that no gradient step sees.
//!
//! ```sh
//! cargo run --release --example 03_prune_with_guard -- room
//! ```

use gazesplat_core::dataset::Holdout;
use gazesplat_core::io::images::ImageCache;
use gazesplat_core::io::ply;
use gazesplat_core::synthetic::{SynthOptions, write_scene};
use gazesplat_core::{Dataset, View};
use gazesplat_render::cpu_device;
use gazesplat_train::prune::{GuardViews, Job, Progress, Provenance, PruneConfig, Pruner, split};
use gazesplat_train::{Config, Trainer, run};
use std::error::Error;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

fn main() -> Result<(), Box<dyn Error>> {
    let dir = PathBuf::from(std::env::args().nth(1).ok_or("usage: 03_prune_with_guard OUT_DIR")?);
    let scene = SynthOptions { num_views: 32, width: 240, height: 160, num_points: 4000, ..SynthOptions::default() };
    let dataset = write_scene(dir.join("scene"), &scene)?;

    // Views that judge take part in neither training nor pruning.
    let trained = Provenance::Trained(Holdout::Every8);
    let views = split(&dataset, GuardViews::Holdout, trained)?;
    let cache = |views: &[View]| Arc::new(ImageCache::new(views.to_vec(), 1 << 30));

    let mut config = Config::default();
    config.train.steps = 800;
    config.densify.cap = 15_000;
    let kept_out = Dataset { train: views.gradient.clone(), ..dataset.clone() };
    let mut trainer = Trainer::new(&kept_out, cache(&views.gradient), &config, &cpu_device())?;
    run(&mut trainer, &mut [], &AtomicBool::new(false))?;
    let dense = trainer.to_cloud()?;

    let config = PruneConfig::default();
    let mut pruner = Pruner::new(&Job {
        cloud: &dense,
        dataset: &dataset,
        images: cache(&views.gradient),
        guard_images: cache(&views.guard),
        counted: views.counted.iter().map(|view| (view.name.clone(), view.camera)).collect(),
        config: &config,
        more_settings: &serde_json::Value::Null,
        device: &cpu_device(),
    })?;
    loop {
        match pruner.advance()? {
            Progress::Step(_) => {}
            Progress::Check(check) => {
                let m = check.measured;
                let verdict = if check.accepted { "passed" } else { "failed" };
                eprintln!(
                    "{:?} {}: {} Gaussians, {:.2} dB, {:.1} per tile, {verdict}",
                    check.phase, check.iteration, m.points, m.psnr, m.pairs_used_per_tile
                );
            }
            Progress::Finished(_) => break,
        }
    }
    let model = dir.join("pruned.ply");
    ply::save(&model, &pruner.result()?)?;
    eprintln!("wrote {}", model.display());
    Ok(())
}
