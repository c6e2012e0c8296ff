//! `gazesplat bench ablation`: what scale decay and removal each contribute (RTGS Fig. 10).

use super::super::antialiased::{AntialiasedArgs, carried_to_pruning};
use super::super::device::ComputeDevice;
use super::super::prune::curve::{self, Level};
use super::super::prune::stage::{Stage, with_terms};
use super::super::{Model, log_machine, quality};
use crate::cli::DeviceArgs;
use crate::console::{Console, grouped};
use crate::diagnostics::{Failure, Result};
use crate::progress::TrainProgress;
use crate::run_dir::{create_all, to_json, write_text};
use clap::Args;
use gazesplat_core::GaussianCloud;
use gazesplat_core::io::ply;
use gazesplat_render::Splats;
use gazesplat_train::prune::{Progress, PruneConfig, Pruner, Status};
use gazesplat_train::with_threads;
use serde::Serialize;
use std::path::PathBuf;

/// Arguments of `bench ablation`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat bench ablation runs/fox-1 --scene fox --out study
  gazesplat bench ablation model.ply --scene fox --set prune.budget=0.1 --set guard.loss=0.02

Runs the pruning loop twice, without rounds of removal and with them, under the same guard, and
draws all models in turn. What has faded goes in both. Writes ablation.csv, ablation.json and the models.")]
pub struct AblationArgs {
    /// The dense model: a 3DGS PLY file, or the directory of a run
    pub model: PathBuf,
    /// The scene with the photographs
    #[arg(long, value_name = "SCENE")]
    pub scene: PathBuf,
    /// One setting of `gazesplat prune`; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub overrides: Vec<String>,
    /// Frames timed per view and model, of which the median counts
    #[arg(long, value_name = "N", default_value_t = 5)]
    pub repeats: usize,
    /// Antialiasing
    #[command(flatten)]
    pub antialiased: AntialiasedArgs,
    /// Device
    #[command(flatten)]
    pub device: DeviceArgs,
    /// Directory for the results
    #[arg(long, value_name = "DIR", default_value = "bench/ablation")]
    pub out: PathBuf,
}

/// One model.
#[derive(Debug, Clone, Serialize)]
struct Row {
    name: &'static str,
    /// Whether a state passed the guard; true for the dense model.
    passed: bool,
    psnr: f64,
    ssim: f64,
    #[serde(flatten)]
    level: Level,
    /// Bytes of the PLY file.
    bytes: u64,
    /// Frames per second over those of the dense model.
    speed_up: f64,
}

/// Runs the study.
///
/// # Errors
/// When the device, the model, the scene or the settings cannot be used, or the results cannot be written.
pub fn command(args: &AblationArgs, console: &Console) -> Result<()> {
    if args.repeats == 0 {
        return Err(Failure::new("nothing would be measured").hint("give 1 or more with `--repeats`"));
    }
    let device = ComputeDevice::open(args.device.device, console)?;
    device.guard(|| study(args, &device, console))
}

fn study(args: &AblationArgs, device: &ComputeDevice, console: &Console) -> Result<()> {
    log_machine();
    let model = Model::load(&args.model, console)?;
    let recorded = model.run_settings()?;
    let settings = args.antialiased.over(carried_to_pruning(&recorded)?.with_overrides(&args.overrides)?)?;
    let (config, terms) = settings.resolve_pruning()?;
    let stage = Stage::new(&model, &args.scene, &config, &recorded, device.tensors(), console)?;
    let without_removal = {
        let mut config = config.clone();
        config.prune.rounds = 0;
        config
    };
    let run = |config: &PruneConfig| -> Result<(GaussianCloud, bool)> {
        let recorded_terms = serde_json::to_value(&terms).expect("settings are plain data");
        let pruner = Pruner::new(&stage.job(&model, config, &recorded_terms, device.tensors()))?;
        let mut pruner = with_terms(pruner, config, &terms, &stage, device.tensors())?;
        let plan = *pruner.plan();
        let mut bar = TrainProgress::new(console, plan.reference + plan.num_steps());
        loop {
            match pruner.advance()? {
                Progress::Step(step) => bar.step(step.step, &step),
                Progress::Check(_) => {}
                Progress::Finished(outcome) => return Ok((pruner.result()?, outcome.status == Status::Ok)),
            }
        }
    };
    let (decayed, pruned) =
        with_threads(config.prune.threads, || Ok::<_, Failure>((run(&without_removal)?, run(&config)?)))??;
    let models = [("dense", (model.cloud.clone(), true)), ("SD only", decayed), ("SD + CE", pruned)];
    create_all(&args.out)?;
    let options = stage.train_config.render_options();
    let mut splats = Vec::new();
    let mut sizes = Vec::new();
    for ((_, (cloud, _)), file) in models.iter().zip(["dense", "sd", "sd_ce"]) {
        let path = args.out.join(format!("{file}.ply"));
        ply::save(&path, cloud)?;
        sizes.push(std::fs::metadata(&path).map_or(0, |file| file.len()));
        let drawn = Model::load_for_drawing(&path, console)?;
        splats.push(Splats::from_cloud(&drawn.cloud, device.tensors())?);
    }
    let (views, images) = match stage.dataset.test.is_empty() {
        false => (&stage.dataset.test, &stage.test_images),
        true => (&stage.split.guard, &stage.guard_images),
    };
    let levels = curve::measure(&splats, views, &options, args.repeats, console)?;
    let mut rows = Vec::new();
    for ((((name, (_, passed)), splats), level), bytes) in models.iter().zip(&splats).zip(&levels).zip(sizes) {
        let eval = quality::measure(splats, images, &options, console)?;
        let (psnr, ssim, speed_up) = (eval.psnr, eval.ssim, levels[0].ms / level.ms);
        rows.push(Row { name, passed: *passed, psnr, ssim, level: *level, bytes, speed_up });
    }
    let mut csv = "model,passed,points,psnr,ssim,pairs_per_tile,pairs_used_per_tile,ms,bytes,speed_up\n".to_owned();
    for r in &rows {
        let l = &r.level;
        csv.push_str(&format!(
            "{},{},{},{},{},{},{},{},{},{}\n",
            r.name,
            r.passed,
            l.points,
            r.psnr,
            r.ssim,
            l.pairs_per_tile,
            l.pairs_used_per_tile,
            l.ms,
            r.bytes,
            r.speed_up
        ));
    }
    write_text(&args.out.join("ablation.csv"), &csv)?;
    let report = serde_json::json!({
        "model": args.model.display().to_string(),
        "scene": args.scene.display().to_string(),
        "device": device.describe(),
        "settings": config,
        "rows": rows,
    });
    write_text(&args.out.join("ablation.json"), &format!("{}\n", to_json(&report)))?;
    console.note(table(&rows));
    console.note(format_args!("{} views; results in `{}`", views.len(), args.out.display()));
    console.json(&rows)
}

/// The rows for people.
fn table(rows: &[Row]) -> String {
    let mut lines = vec![format!(
        "{:8}  {:>9}  {:>7}  {:>6}  {:>8}  {:>8}  {:>8}  {:>6}",
        "model", "Gaussians", "PSNR", "SSIM", "per tile", "ms", "speed-up", "size"
    )];
    for r in rows {
        lines.push(format!(
            "{:8}  {:>9}  {:>7.2}  {:>6.4}  {:>8.1}  {:>8.2}  {:>7.2}×  {:>5.0}%{}",
            r.name,
            grouped(r.level.points),
            r.psnr,
            r.ssim,
            r.level.pairs_used_per_tile,
            r.level.ms,
            r.speed_up,
            100.0 * r.bytes as f64 / rows[0].bytes.max(1) as f64,
            if r.passed { "" } else { "  no state passed the guard" }
        ));
    }
    lines.join("\n")
}
