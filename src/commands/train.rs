//! `gazesplat train`: photographs in, a model with its measured quality out.

use super::record::Recorder;
use super::{layered, load_scene, log_machine, quality, scene_name};
use crate::cli::SettingsArgs;
use crate::console::{Console, bytes, duration, grouped};
use crate::diagnostics::{Failure, Result};
use crate::interrupt;
use crate::progress::{self, TrainProgress};
use crate::report::{Figure, Measured, Report, html};
use crate::run_dir::RunDir;
use crate::settings::{self, Settings};
use clap::{Args, ValueEnum};
use gazesplat_core::io::images::ImageCache;
use gazesplat_core::{Dataset, GaussianCloud};
use gazesplat_render::{Splats, cpu_device};
use gazesplat_train::{Config, EvalReport, Outcome, Trainer, with_threads};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// Arguments of `train`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat train my_capture --config quick
  gazesplat train my_capture --set train.steps=3000 --set data.max_side=480 --out runs/small
  gazesplat train my_capture --config my.toml --set train.seed=1

Ctrl-C stops after the current step and keeps what there is; a second Ctrl-C ends at once.")]
pub struct TrainArgs {
    /// The scene: a COLMAP directory or one with `transforms.json`
    pub scene: PathBuf,
    /// Settings
    #[command(flatten)]
    pub settings: SettingsArgs,
    /// Directory for the run [default: runs/SCENE-N]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Where to compute
    #[arg(long, value_enum, default_value = "cpu")]
    pub device: DeviceArg,
    /// Replace the run that is in the directory given with --out
    #[arg(long)]
    pub overwrite: bool,
}

/// Where to compute.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum DeviceArg {
    /// The processor, all its cores unless train.threads says otherwise
    Cpu,
    /// A graphics card: not in this version yet
    Gpu,
}

/// Runs `train`.
///
/// # Errors
/// When the scene, the settings or the directory cannot be used, or the training fails.
pub fn command(args: &TrainArgs, console: &Console) -> Result<()> {
    if args.device == DeviceArg::Gpu {
        return Err(Failure::new(
            "this version of gazesplat computes on the CPU only, `--device gpu` is not there yet",
        )
        .hint("use `--device cpu`"));
    }
    let config = layered(Settings::new(), &args.settings)?.resolve()?;
    let job = TrainJob { scene: &args.scene, config, out: args.out.as_deref(), overwrite: args.overwrite };
    train(&job, interrupt::stop_flag()?, console)?;
    Ok(())
}

/// What to train, how, and where to put it.
#[derive(Debug)]
pub struct TrainJob<'a> {
    /// The scene directory.
    pub scene: &'a Path,
    /// Resolved settings.
    pub config: Config,
    /// The run directory; `None` = the next free `runs/<scene>-<n>`.
    pub out: Option<&'a Path>,
    /// Whether a run that is already in `out` is replaced.
    pub overwrite: bool,
}

/// What a training left behind.
#[derive(Debug)]
pub struct Trained {
    /// Its directory, with every file written.
    pub run_dir: RunDir,
    /// The scene.
    pub dataset: Dataset,
    /// The model.
    pub cloud: GaussianCloud,
    /// Steps done: fewer than the settings say when the training was stopped.
    pub num_steps: u32,
    /// Its quality, as in `eval.json`.
    pub eval: EvalReport,
    /// What `report.html` was made of.
    pub report: Report,
}

/// Trains a model and writes the whole run directory. Raising `stop` ends the training after the current step; what
/// there is by then is saved and measured like a finished model.
///
/// # Errors
/// When the scene or the directory cannot be used, an image does not decode, or the loss is no longer finite.
pub fn train(job: &TrainJob<'_>, stop: &AtomicBool, console: &Console) -> Result<Trained> {
    with_threads(job.config.train.threads, || train_here(job, stop, console))?
}

fn train_here(job: &TrainJob<'_>, stop: &AtomicBool, console: &Console) -> Result<Trained> {
    let config = &job.config;
    log_machine();
    tracing::info!(
        "settings: {} steps, seed {}, at most {} Gaussians, SH degree {}",
        config.train.steps,
        config.train.seed,
        config.densify.cap,
        config.model.sh_degree
    );
    tracing::debug!("all settings:\n{}", settings::to_toml(config));
    let mut durations = Vec::new();
    let started = Instant::now();
    let dataset = load_scene(job.scene, config, console)?;
    console.note(format_args!(
        "{}: {} training views, {} test views, {} points",
        scene_name(job.scene),
        dataset.train.len(),
        dataset.test.len(),
        grouped(dataset.points.positions.len())
    ));
    let mut warnings = dataset.warnings.clone();
    let run_dir = match job.out {
        Some(out) => RunDir::create(out, job.overwrite)?,
        None => RunDir::create_numbered(&scene_name(job.scene))?,
    };

    let images = Arc::new(ImageCache::new(dataset.train.clone(), config.data.cache_bytes));
    preload(&images, console)?;
    let mut trainer = Trainer::new(&dataset, Arc::clone(&images), config, &cpu_device())?;
    warnings.extend_from_slice(trainer.messages());
    let (measured, measured_images) = match dataset.test.is_empty() {
        false => (Measured::Test, Arc::clone(trainer.test_images())),
        true => (Measured::Training, Arc::clone(&images)),
    };
    if measured == Measured::Training {
        let text = "no view is kept for testing: quality is measured on the training views".to_owned();
        console.warn(&text);
        warnings.push(text);
    }
    preload(&measured_images, console)?;
    tracing::info!(
        "images in memory: {} training ({}), {} measured ({}), at most {} each",
        images.len(),
        bytes(images.num_bytes() as u64),
        measured_images.len(),
        bytes(measured_images.num_bytes() as u64),
        bytes(config.data.cache_bytes as u64)
    );
    durations.push(("reading the scene".to_owned(), started.elapsed().as_secs_f64()));

    if job.overwrite {
        run_dir.clear()?;
    }
    run_dir.write_settings(config, job.scene)?;
    let mut recorder = Recorder::new(run_dir.start_metrics()?, config.train.log_every);
    let mut bar = TrainProgress::new(console, config.train.steps);
    let started = Instant::now();
    let ended = gazesplat_train::run(&mut trainer, &mut [&mut recorder, &mut bar], stop);
    drop(bar);
    recorder.flush()?;
    let train_secs = started.elapsed().as_secs_f64();
    durations.push(("training".to_owned(), train_secs));
    let cloud = trainer.to_cloud()?;
    let num_steps = trainer.step_index();
    let outcome = match ended {
        Ok(outcome) => outcome,
        Err(error) => return Err(salvage(error.into(), &run_dir, &cloud, num_steps)),
    };
    run_dir.write_model(&cloud)?;
    if outcome == Outcome::Stopped {
        console.note(format_args!("stopped after {num_steps} of {} steps, saving what there is", config.train.steps));
    }

    let started = Instant::now();
    let options = config.render_options();
    let splats = Splats::from_cloud(&cloud, &cpu_device());
    let eval = match recorder.take_evaluation(num_steps) {
        // The run has just measured this very model.
        Some(eval) if eval.num_gaussians == cloud.len() => eval,
        _ => quality::measure(&splats, &measured_images, &options, console)?,
    };
    run_dir.write_eval(&eval)?;
    let views = quality::panels(&splats, &measured_images, &options, &eval)?;
    durations.push(("measuring".to_owned(), started.elapsed().as_secs_f64()));

    let mut test_psnr = std::mem::take(&mut recorder.test_psnr);
    if test_psnr.last().is_none_or(|last| last.0 != num_steps) {
        test_psnr.push((num_steps, eval.psnr));
    }
    let measured_name = measured.name();
    let report = Report {
        measured,
        title: scene_name(job.scene),
        subtitle: format!("A 3D Gaussian model, trained in {num_steps} steps on {} photographs.", dataset.train.len()),
        headline: vec![
            Figure::new(
                format!("{:.2}", eval.psnr),
                "dB",
                &format!("PSNR on {} {measured_name} views", eval.views.len()),
            ),
            Figure::new(format!("{:.3}", eval.ssim), "", "SSIM"),
            Figure::new(grouped(eval.num_gaussians), "", "Gaussians"),
            Figure::new(duration(train_secs), "", "training time"),
        ],
        stages: recorder.mean_stages(),
        steps: std::mem::take(&mut recorder.steps),
        test_psnr,
        views,
        scores: eval.views.iter().map(|v| (v.name.clone(), v.psnr, v.ssim)).collect(),
        film: Vec::new(),
        facts: facts(job, &dataset, &run_dir),
        durations,
        warnings,
        settings: settings::to_toml(config),
    };
    run_dir.write_report(&html::page(&report))?;
    console.note(format_args!(
        "{}: {:.2} dB PSNR, {:.3} SSIM on {} {measured_name} views, {} Gaussians, {}",
        run_dir.path().display(),
        eval.psnr,
        eval.ssim,
        eval.views.len(),
        grouped(eval.num_gaussians),
        duration(train_secs)
    ));
    console.note(format_args!("look at `{}`", run_dir.report_path().display()));
    Ok(Trained { run_dir, dataset, cloud, num_steps, eval, report })
}

/// Decodes what fits into the cache, so that an image that cannot be read ends the run before it begins.
fn preload(images: &ImageCache, console: &Console) -> Result<()> {
    let bar = progress::counting_bar(console, "reading images", images.len());
    images.preload(|done, _| bar.set_position(done as u64))?;
    bar.finish_and_clear();
    Ok(())
}

/// A training that failed half-way keeps its last good model, under a name that no one takes for a finished one.
fn salvage(failure: Failure, run_dir: &RunDir, cloud: &GaussianCloud, num_steps: u32) -> Failure {
    if num_steps == 0 || cloud.is_empty() {
        return failure;
    }
    let path = run_dir.unfinished_path();
    match gazesplat_core::io::ply::save(&path, cloud) {
        Ok(()) => failure.hint(format!("the model as it was after step {num_steps} is in `{}`", path.display())),
        Err(_) => failure,
    }
}

fn facts(job: &TrainJob<'_>, dataset: &Dataset, run_dir: &RunDir) -> Vec<(String, String)> {
    let mut facts = vec![
        ("scene".to_owned(), job.scene.display().to_string()),
        ("views".to_owned(), format!("{} for training, {} for testing", dataset.train.len(), dataset.test.len())),
    ];
    if let Some(view) = dataset.train.first() {
        let pinhole = view.camera.intrinsics;
        facts.push(("image size".to_owned(), format!("{} × {} pixels", pinhole.width, pinhole.height)));
    }
    facts.push(("sparse points".to_owned(), grouped(dataset.points.positions.len())));
    facts.push(("extent of the cameras".to_owned(), format!("{:.3} world units", dataset.scene_extent())));
    if let Ok(file) = std::fs::metadata(run_dir.model_path()) {
        facts.push(("model file".to_owned(), format!("point_cloud.ply, {}", bytes(file.len()))));
    }
    facts.push(("spherical harmonics".to_owned(), format!("degree {}", job.config.model.sh_degree)));
    facts
}
