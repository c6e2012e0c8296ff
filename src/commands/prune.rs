//! `gazesplat prune`: a model that draws several times faster at a quality that is held, and a report of where the time went.

pub(super) mod curve;
mod files;
mod outcome;
pub(super) mod stage;

use super::antialiased::{AntialiasedArgs, carried_to_pruning};
use super::device::ComputeDevice;
use super::{Model, log_machine, scene_name};
use crate::cli::DeviceArgs;
use crate::console::{Console, grouped};
use crate::diagnostics::{Failure, Result};
use crate::interrupt;
use crate::progress::TrainProgress;
use crate::settings::{self, Settings};
use crate::terms::PruneTerms;
use clap::Args;
use files::PruneDir;
use gazesplat_train::prune::{Basis, Check, Plan, Progress, PruneConfig, Pruner};
use gazesplat_train::with_threads;
use stage::{Stage, with_terms};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Arguments of `prune`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat prune runs/fox-1 --scene fox
  gazesplat prune model.ply --scene fox --quality m --out runs/fox-pruned
  gazesplat prune runs/fox-1 --scene fox --preset paper --budget 0.2
  gazesplat prune runs/fox-1 --scene fox --out runs/fox-pruned --resume

Removes the Gaussians that earn the fewest pixels per tile they cost, shrinks those in many tiles,
and trains on, as long as quality on the guard's views holds: `h` keeps 99 % of PSNR and SSIM, `m`
98 %, `l` 97 %, or give the share that may be lost, such as 0.015. Views that are renders of the
model itself are held to floors instead: 38, 36, 34 dB.

For guard views that no gradient step ever saw, train the dense model with
`--set data.holdout=every8`. Ctrl-C stops after the current step and leaves a checkpoint that
`--resume` goes on from; so does a run that is killed, from its last event.")]
pub struct PruneArgs {
    /// The dense model: a 3DGS PLY file, or the directory of a run
    pub model: PathBuf,
    /// The scene with the photographs
    #[arg(long, value_name = "SCENE")]
    pub scene: PathBuf,
    /// What is held: h, m, l, or the share of PSNR and SSIM that may be lost [default: h]
    #[arg(long, value_name = "h|m|l|SHARE", value_parser = parse_quality)]
    pub quality: Option<f64>,
    /// `quick` (minutes) or `paper` (the published schedule)
    #[arg(long, value_name = "PRESET", value_parser = ["quick", "paper"])]
    pub preset: Option<String>,
    /// Scale of the schedule: 1 is the published one, quick is 0.04
    #[arg(long, value_name = "B")]
    pub budget: Option<f64>,
    /// Settings that differ from the preset: a TOML file
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// One setting over those of --config; may be repeated. Example: --set prune.criterion=opacity
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub overrides: Vec<String>,
    /// Directory for the run [default: runs/SCENE-pruned-N]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Antialiasing
    #[command(flatten)]
    pub antialiased: AntialiasedArgs,
    /// Device
    #[command(flatten)]
    pub device: DeviceArgs,
    /// Go on with the interrupted run in the directory given with --out
    #[arg(long, requires = "out", conflicts_with = "overwrite")]
    pub resume: bool,
    /// Replace the run that is in the directory given with --out
    #[arg(long)]
    pub overwrite: bool,
}

/// Reads `h`, `m`, `l` or a share.
fn parse_quality(text: &str) -> std::result::Result<f64, String> {
    match text.to_ascii_lowercase().as_str() {
        "h" => Ok(0.01),
        "m" => Ok(0.02),
        "l" => Ok(0.03),
        share => share
            .parse()
            .ok()
            .filter(|share| (0.0..1.0).contains(share))
            .ok_or_else(|| "expected h, m, l, or a share of at least 0 and below 1, such as 0.015".to_owned()),
    }
}

/// Runs `prune`.
///
/// # Errors
/// When the model, the scene, the settings, the device or the directory cannot be used, or the run fails.
pub fn command(args: &PruneArgs, console: &Console) -> Result<()> {
    let device = ComputeDevice::open(args.device.device, console)?;
    let model = Model::load(&args.model, console)?;
    let recorded = model.run_settings()?;
    let (config, terms) = resolved(args, &recorded)?;
    let stop = interrupt::stop_flag()?;
    with_threads(config.prune.threads, || {
        device.guard(|| Run::new(args, &model, config, terms, &recorded, &device, console)?.complete(stop))
    })?
}

/// Settings: those of the model's run where both have them, the preset, the file, `--set`, and the options on top.
fn resolved(args: &PruneArgs, recorded: &Settings) -> Result<(PruneConfig, PruneTerms)> {
    let mut settings = carried_to_pruning(recorded)?;
    if let Some(preset) = &args.preset {
        settings = settings.with_config(preset.as_ref())?;
    }
    if let Some(config) = &args.config {
        settings = settings.with_config(config)?;
    }
    settings = settings.with_overrides(&args.overrides)?;
    if let Some(budget) = args.budget {
        settings = settings.with_override(&format!("prune.budget={budget:?}"))?;
    }
    if let Some(loss) = args.quality {
        settings = settings.with_override(&format!("guard.loss={loss:?}"))?;
    }
    args.antialiased.over(settings)?.resolve_pruning()
}

/// Whether both paths lead to the same directory.
fn is_same_place(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b)
}

/// Everything of one run.
struct Run<'a> {
    model: &'a Model,
    config: PruneConfig,
    terms: PruneTerms,
    stage: Stage,
    device: &'a ComputeDevice,
    console: &'a Console,
    dir: PruneDir,
    pruner: Pruner,
    warnings: Vec<String>,
    scene: PathBuf,
    started: Instant,
    /// Time that the run took before it was interrupted.
    earlier: Duration,
}

impl<'a> Run<'a> {
    fn new(
        args: &PruneArgs,
        model: &'a Model,
        config: PruneConfig,
        terms: PruneTerms,
        recorded: &Settings,
        device: &'a ComputeDevice,
        console: &'a Console,
    ) -> Result<Self> {
        log_machine();
        tracing::debug!("all settings:\n{}", settings::run_to_toml(&config, &terms));
        let stage = Stage::new(model, &args.scene, &config, recorded, device.tensors(), console)?;
        let mut warnings = stage.dataset.warnings.clone();
        warnings.extend(stage.split.note.clone());
        let recorded_terms = serde_json::to_value(&terms).expect("settings are plain data");
        let job = stage.job(model, &config, &recorded_terms, device.tensors());
        let mut earlier = Duration::ZERO;
        let (pruner, dir) = if args.resume {
            let out = args.out.as_deref().unwrap_or(&args.model);
            let mut dir = PruneDir::open_interrupted(out)?;
            let (pruner, noted) = Pruner::resume(&job, &dir.checkpoint_path())?;
            dir.continue_report(noted.report_bytes)?;
            earlier = Duration::from_secs_f64(noted.elapsed_s.clamp(0.0, 1e9));
            console.note(format_args!("resuming `{}` at step {}", out.display(), pruner.iteration()));
            (pruner, dir)
        } else {
            if let (Some(out), Some(run), true) = (&args.out, &model.run, args.overwrite)
                && is_same_place(out, run.path())
            {
                return Err(Failure::new(format!("`{}` is the dense model itself", out.display()))
                    .hint("the run that is pruned is not replaced: choose another directory with `--out`"));
            }
            let pruner = Pruner::new(&job)?;
            let name = format!("{}-pruned", scene_name(&args.scene));
            (pruner, PruneDir::create(args.out.as_deref(), &name, args.overwrite)?)
        };
        let pruner = with_terms(pruner, &config, &terms, &stage, device.tensors())?;
        let run = Self {
            model,
            config,
            terms,
            stage,
            device,
            console,
            dir,
            pruner,
            warnings,
            scene: args.scene.clone(),
            started: Instant::now(),
            earlier,
        };
        run.tell_plan();
        Ok(run)
    }

    /// What is ahead, before it begins.
    fn tell_plan(&self) {
        let Plan { reference, prune, adapt, event_every, .. } = *self.pruner.plan();
        let (events, rounds) = (self.pruner.plan().num_events(), self.config.prune.rounds as usize);
        // Every event and every final round; the checks of the reference and of the adaptation.
        let (guard, counted) = (self.stage.split.guard.len(), self.stage.split.counted.len());
        let checks = 2 + events as usize + 1 + rounds + adapt.div_ceil(event_every) as usize;
        let frames = checks * guard + (events as usize + 1) * rounds * counted;
        self.console.note(format_args!(
            "{} Gaussians; {} training views, {} of {} judge ({}), {} test views",
            grouped(self.model.cloud.len()),
            self.stage.split.gradient.len(),
            self.stage.split.guard.len(),
            self.stage.split.counted.len(),
            self.stage.split.views.name(),
            self.stage.dataset.test.len(),
        ));
        self.console.note(format_args!(
            "{} steps with an event every {event_every}, {adapt} of adaptation{}; about {} frames are counted or judged",
            grouped(prune as usize),
            if reference > 0 { format!(", after {reference} for the reference") } else { String::new() },
            grouped(frames)
        ));
    }

    /// Runs to the end or until `stop` is raised.
    fn complete(mut self, stop: &AtomicBool) -> Result<()> {
        if self.dir.is_new_report() {
            self.dir.write_settings(&self.stage.train_config, &self.config, &self.terms, &self.scene, self.device)?;
            self.dir.begin_report(&self.header())?;
        }
        let Plan { reference, prune, adapt, .. } = *self.pruner.plan();
        let mut bar = TrainProgress::new(self.console, reference + prune + adapt);
        loop {
            if stop.load(Ordering::Relaxed) {
                let elapsed_s = self.elapsed_s();
                self.dir.save(&mut self.pruner, elapsed_s)?;
                drop(bar);
                self.console.note(format_args!(
                    "stopped after step {} of {}; go on with the same command and `--out {} --resume`",
                    self.pruner.iteration(),
                    prune + adapt,
                    self.dir.path().display()
                ));
                return Ok(());
            }
            match self.pruner.advance().map_err(|error| self.dir.failure(error))? {
                Progress::Step(step) => {
                    let done = if self.pruner.reference().is_none() { step.step } else { reference + step.step };
                    bar.step(done, &step);
                }
                Progress::Check(check) => self.check(&check)?,
                Progress::Finished(outcome) => {
                    drop(bar);
                    return self.finish(&outcome);
                }
            }
        }
    }

    /// Seconds that the run has taken, before an interruption too.
    fn elapsed_s(&self) -> f64 {
        (self.earlier + self.started.elapsed()).as_secs_f64()
    }

    /// The first line of the report.
    fn header(&self) -> serde_json::Value {
        let names = |views: &[gazesplat_core::View]| views.iter().map(|v| v.name.clone()).collect::<Vec<_>>();
        serde_json::json!({
            "phase": "settings",
            "model": self.model.path.display().to_string(),
            "scene": self.scene.display().to_string(),
            "points": self.model.cloud.len(),
            "model_hash": self.pruner.model_fingerprint(),
            "seed": self.config.prune.seed,
            "guard": self.stage.split.views.name(),
            "guard_views": names(&self.stage.split.guard),
            "training_views": names(&self.stage.split.gradient),
            "note": self.stage.split.note,
            "device": self.device.describe(),
            "settings": self.config,
            "terms": self.terms,
        })
    }

    /// Records a check, keeps its level, and saves.
    fn check(&mut self, check: &Check) -> Result<()> {
        let elapsed_s = self.elapsed_s();
        self.dir.append(check, elapsed_s)?;
        self.tell(check);
        if check.accepted && self.dir.wants_level(check.measured.points) {
            self.dir.write_level(&self.pruner.result()?)?;
        }
        self.dir.save(&mut self.pruner, elapsed_s)
    }

    fn tell(&self, check: &Check) {
        let m = &check.measured;
        let what = match (check.accepted, check.rolled_back) {
            (_, true) => "failed, back to the last that passed".to_owned(),
            (false, _) => "failed, training on".to_owned(),
            (true, _) if check.removed > 0 => format!("passed, {} removed", grouped(check.removed)),
            (true, _) => "passed".to_owned(),
        };
        self.console.note(format_args!(
            "{:?} {}: {} Gaussians, {:.2} dB, SSIM {:.4}, {:.1} of {:.1} per tile used, {:.1} ms; {what}",
            check.phase,
            check.iteration,
            grouped(m.points),
            m.psnr,
            m.ssim,
            m.pairs_used_per_tile,
            m.pairs_per_tile,
            m.render_ms
        ));
        if let Some((measured, basis)) = self.pruner.reference()
            && check.iteration == 0
        {
            let reference = gazesplat_train::prune::Reference { psnr: measured.psnr, ssim: measured.ssim };
            let least = basis.bounds(reference, self.config.guard.loss);
            let why = if basis == Basis::Floor { ", since the views are renders of the model" } else { "" };
            self.console.note(format_args!("to hold: {:.2} dB and an SSIM of {:.4}{why}", least.psnr, least.ssim));
            if measured.psnr < gazesplat_train::prune::pruner::POOR_REFERENCE_DB {
                self.console.warn(format_args!(
                    "the model reaches {:.1} dB on the guard's views: the guard measures noise. Is this its scene?",
                    measured.psnr
                ));
            }
        }
    }
}
