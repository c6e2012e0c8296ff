//! `gazesplat train`: photographs in, a model with its measured quality out.
//!
//! The file is long because a run is one sequence from the scene to the report, and is read as one.

use super::checkpoints::{Checkpoints, Resumed};
use super::device::ComputeDevice;
use super::keeper::{Keeper, Kept};
use super::perceptual::Perceptual;
use super::record::{Memory, Recorder};
use super::refined::Refined;
use super::{Model, antialiased, layered, load_scene, log_machine, quality, scene_name};
use crate::cli::{DeviceArgs, SettingsArgs};
use crate::console::{Console, bytes, duration, grouped};
use crate::diagnostics::{Failure, Result};
use crate::interrupt;
use crate::progress::{self, TrainProgress};
use crate::report::{Figure, Measured, Report, html};
use crate::run_dir::{RunDir, checkpoints};
use crate::settings::{self, Settings};
use crate::terms::TermSection;
use clap::Args;
use gazesplat_core::io::images::ImageCache;
use gazesplat_core::io::model::ANTIALIASED_COMMENT;
use gazesplat_core::{Dataset, GaussianCloud};
use gazesplat_fovea::hvsq::ReferenceCache;
use gazesplat_render::Splats;
use gazesplat_train::checkpoint::fingerprint;
use gazesplat_train::trainer::Exported;
use gazesplat_train::{Config, EvalReport, Outcome, Trainer, with_threads};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

/// Arguments of `train`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat train my_capture --config quick
  gazesplat train my_capture --set train.steps=3000 --set data.max_side=480 --out runs/small
  gazesplat train my_capture --config my.toml --set train.seed=1
  gazesplat train my_capture --set model.antialiased=true
  gazesplat train my_capture --device gpu
  gazesplat train my_capture --init runs/my_capture-1 --config finetune --set loss.hvsq.weight=100
  gazesplat train my_capture --out runs/mine --resume

Ctrl-C stops after the current step and keeps what there is, with a checkpoint that the same command
goes on from with `--out DIR --resume`; a second Ctrl-C ends at once. So does a run that is killed,
from its last checkpoint (`train.checkpoint_every`). On the CPU the result is that of a run that was
never interrupted, byte for byte. A run that finishes removes its checkpoints. A run that fails leaves its last good model in `unfinished.ply`; on a GPU copies go there on the way.")]
pub struct TrainArgs {
    /// The scene: a COLMAP directory or one with `transforms.json`
    pub scene: PathBuf,
    /// Settings
    #[command(flatten)]
    pub settings: SettingsArgs,
    /// Start from this model, a PLY file or the directory of a run, instead of the points of the scene
    #[arg(long, value_name = "MODEL")]
    pub init: Option<PathBuf>,
    /// Directory for the run [default: runs/SCENE-N]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Device
    #[command(flatten)]
    pub device: DeviceArgs,
    /// Go on with the interrupted run in the directory given with --out, from its latest checkpoint or that of STEP
    #[arg(long, value_name = "STEP", num_args = 0..=1, require_equals = true)]
    #[arg(requires = "out", conflicts_with = "overwrite")]
    pub resume: Option<Option<u32>>,
    /// Replace the run that is in the directory given with --out
    #[arg(long)]
    pub overwrite: bool,
}

/// Runs `train`.
///
/// # Errors
/// When the scene, the settings, the device or the directory cannot be used, or the training fails.
pub fn command(args: &TrainArgs, console: &Console) -> Result<()> {
    let mut settings = layered(Settings::new(), &args.settings)?;
    settings.resolve()?;
    let device = &ComputeDevice::open(args.device.device, console)?;
    let init = args.init.as_deref().map(|path| Model::load_to_train(path, console)).transpose()?;
    if let Some(model) = &init
        && model.is_antialiased()?
    {
        // It is trained on as what it was trained for, unless the settings say otherwise.
        settings = layered(antialiased::with(Settings::new(), true)?, &args.settings)?;
    }
    let (config, terms) = (settings.resolve()?, settings.resolve_terms()?);
    let (out, overwrite) = (args.out.as_deref(), args.overwrite);
    let resume = args.resume;
    let job = TrainJob { scene: &args.scene, config, terms, init, out, overwrite, device, resume, is_resumable: true };
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
    /// Terms of the loss that crate `train` knows nothing of.
    pub terms: TermSection,
    /// The model to start from; `None` = the points of the scene.
    pub init: Option<Model>,
    /// The run directory; `None` = the next free `runs/<scene>-<n>`.
    pub out: Option<&'a Path>,
    /// Whether a run that is already in `out` is replaced.
    pub overwrite: bool,
    /// Where to compute.
    pub device: &'a ComputeDevice,
    /// Whether the interrupted run in `out` goes on, and from the checkpoint of which step; `Some(None)` = the latest.
    pub resume: Option<Option<u32>>,
    /// Whether the run leaves checkpoints.
    pub is_resumable: bool,
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
/// When the scene or the directory cannot be used, an image does not decode, the loss is no longer finite, or the GPU
/// stops. Of a training that fails after its first step the last model that can be had is in `unfinished.ply`.
pub fn train(job: &TrainJob<'_>, stop: &AtomicBool, console: &Console) -> Result<Trained> {
    with_threads(job.config.train.threads, || train_here(job, stop, console))?
}

/// Refuses to remove, with a run that is replaced, the poses that the new one is to see by.
fn check_poses_stay(config: &Config, out: &Path, overwrite: bool) -> Result<()> {
    let Some(poses) = config.data.poses.as_ref().filter(|_| overwrite) else { return Ok(()) };
    match (Path::new(poses).canonicalize(), out.canonicalize()) {
        (Ok(poses), Ok(out)) if poses.starts_with(&out) => {
            Err(Failure::new(format!("`--overwrite` would remove `{}`, which `data.poses` names", poses.display()))
                .hint("choose another directory with `--out`, or copy the file elsewhere first"))
        }
        _ => Ok(()),
    }
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
    let all_settings = settings::run_to_toml(config, &job.terms);
    tracing::debug!("all settings:\n{all_settings}");
    let mut durations = Vec::new();
    let started = Instant::now();
    let dataset = load_scene(job.scene, config, console)?;
    console.note(format_args!(
        "{}: {} training views{}, {} test views, {} points",
        scene_name(job.scene),
        dataset.train.len(),
        held_out(&dataset),
        dataset.test.len(),
        grouped(dataset.points.positions.len())
    ));
    let mut warnings = dataset.warnings.clone();
    // Weights that cannot be read are found before the hours of training, not after them.
    let perceptual = Perceptual::new(job.terms.eval.lpips_weights.as_deref(), job.device)?;
    let run_dir = match job.out {
        Some(out) if job.resume.is_some() => RunDir::open_interrupted(out)?,
        Some(out) => {
            check_poses_stay(config, out, job.overwrite)?;
            RunDir::create(out, job.overwrite)?
        }
        None => RunDir::create_numbered(&scene_name(job.scene))?,
    };

    let images = Arc::new(ImageCache::new(dataset.train.clone(), config.data.cache_bytes));
    let memory = Memory(Arc::clone(&images));
    preload(&images, console)?;
    let mut saved = Checkpoints::new(&run_dir, config, beside(job), job.device.describe());
    let (mut trainer, earlier, cache) = job.device.guard(|| {
        let (images, device) = (Arc::clone(&images), job.device.tensors());
        let (mut trainer, earlier) = match (&job.resume, &job.init) {
            (Some(from), _) => {
                let metrics = run_dir.metrics_path();
                let Resumed { trainer, metrics, earlier, warning } =
                    saved.resume(*from, &dataset, images, config, device, metrics)?;
                console.note(format_args!(
                    "resuming `{}` at step {} of {}",
                    run_dir.path().display(),
                    trainer.step_index(),
                    config.train.steps
                ));
                if let Some(warning) = warning {
                    console.warn(&warning);
                    warnings.push(warning);
                }
                (trainer, Some((metrics, earlier)))
            }
            (None, Some(model)) => (Trainer::from_cloud(&model.cloud, &dataset, images, config, device)?, None),
            (None, None) => (Trainer::new(&dataset, images, config, device)?, None),
        };
        let cache = job.terms.loss.hvsq.register(&mut trainer)?;
        Ok((trainer, earlier, cache))
    })?;
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
        "images in memory: {} training ({}), {} measured ({}), at most {} together",
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
    run_dir.write_settings(&all_settings, job.scene, &job.device.describe())?;
    let is_resumed = earlier.is_some();
    let (log, earlier) = match earlier {
        Some(earlier) => earlier,
        None => (run_dir.start_metrics()?, Duration::ZERO),
    };
    let mut recorder = Recorder::new(log, config.train.log_every, job.device.is_gpu()).watching(memory.clone());
    if is_resumed {
        recorder.recall()?;
    }
    let mut bar = TrainProgress::new(console, config.train.steps).after(trainer.step_index());
    let started = Instant::now();
    saved.start(earlier);
    let mut kept = None;
    let keeper = Keeper { run_dir: &run_dir, checkpoints: job.is_resumable.then_some(&saved), console };
    let ended = keeper.run(&mut trainer, &mut [&mut recorder, &mut bar], stop, job.device, &mut kept);
    drop(bar);
    recorder.flush()?;
    let train_secs = (earlier + started.elapsed()).as_secs_f64();
    durations.push(("training".to_owned(), train_secs));
    let num_steps = trainer.step_index();
    // A lost GPU takes the model with it; what a person waited for is then the last copy.
    let latest = job.device.guard(|| Ok(trainer.export()?));
    let refined = job.device.guard(|| Ok(trainer.refined_views()?));
    // Giving back what is on a lost GPU may panic, too; there is nothing to lose by it.
    let _ = job.device.guard(|| {
        drop(trainer);
        Ok(())
    });
    let latest = latest.map(|Exported { cloud, left_out }| {
        if left_out.total() > 0 {
            let text = format!("{} broken Gaussians are left out of the model: {left_out}", left_out.total());
            console.warn(&text);
            warnings.push(text);
        }
        cloud
    });
    let (outcome, cloud) = match (ended, latest) {
        (Ok(outcome), Ok(cloud)) => (outcome, cloud),
        (Err(failure), Ok(cloud)) if !cloud.is_empty() => {
            return Err(salvage(
                failure,
                &run_dir,
                Some(Kept { step: num_steps, cloud, antialiased: config.model.antialiased }),
            ));
        }
        (Err(failure), _) | (Ok(_), Err(failure)) => return Err(salvage(failure, &run_dir, kept)),
    };
    run_dir.write_model_with(&cloud, &provenance(job, &dataset, num_steps))?;
    let refined = Refined::keep(refined?, &run_dir, console)?;
    run_dir.remove_unfinished()?;
    if outcome == Outcome::Stopped {
        console.note(format_args!("stopped after {num_steps} of {} steps, saving what there is", config.train.steps));
        if !checkpoints(run_dir.path()).is_empty() {
            console.note(format_args!("go on with the same command and `--out {} --resume`", run_dir.path().display()));
        }
    }

    let started = Instant::now();
    let measured_images = match &refined {
        Some(refined) if measured == Measured::Training => Arc::new(measured_images.beside(refined.views.clone())),
        _ => measured_images,
    };
    let options = config.render_options();
    let (eval, views) = job.device.guard(|| {
        let splats = Splats::from_cloud(&cloud, job.device.tensors())?;
        let metrics = perceptual.metrics();
        let eval =
            quality::measure_each(&splats, &measured_images, &options, &metrics, &mut |_, _, _| Ok(()), console)?;
        run_dir.write_eval(&eval)?;
        let views = quality::panels(&splats, &measured_images, &options, &eval)?;
        Ok((eval, views))
    })?;
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
            Figure::new(format!("{:.3}", eval.more.get("flip").copied().unwrap_or(f64::NAN)), "", "FLIP"),
            Figure::new(grouped(eval.num_gaussians), "", "Gaussians"),
            Figure::new(duration(train_secs), "", "training time"),
        ],
        step_ms: recorder.mean_step_ms(),
        stages: recorder.mean_stages(),
        steps: std::mem::take(&mut recorder.steps),
        test_psnr,
        views,
        scores: eval.views.iter().map(|v| (v.name.clone(), v.psnr, v.ssim)).collect(),
        sections: Vec::new(),
        film: Vec::new(),
        facts: facts(job, &dataset, &run_dir, cache.as_deref(), refined.as_ref()),
        durations,
        warnings,
        settings: all_settings,
    };
    run_dir.write_report(&html::page(&report))?;
    if outcome == Outcome::Finished {
        saved.clear()?;
    }
    console.note(format_args!(
        "{}: {:.2} dB PSNR, {:.3} SSIM on {} {measured_name} views, {} Gaussians, {}",
        run_dir.path().display(),
        eval.psnr,
        eval.ssim,
        eval.views.len(),
        grouped(eval.num_gaussians),
        duration(train_secs)
    ));
    console.note(memory.figures());
    console.note(format_args!("look at `{}`", run_dir.report_path().display()));
    Ok(Trained { run_dir, dataset, cloud, num_steps, eval, report })
}

/// What has to be the same in a resumed run beside the settings of the library.
fn beside(job: &TrainJob<'_>) -> serde_json::Value {
    let mut beside = serde_json::to_value(&job.terms).expect("settings are plain data");
    beside["init"] = job.init.as_ref().map(|model| fingerprint(&model.cloud)).into();
    beside
}

/// How many views are kept out of gradient steps, to stand behind the number of training views; nothing for none.
fn held_out(dataset: &Dataset) -> String {
    match dataset.holdout.len() {
        0 => String::new(),
        n => format!(" and {n} held out of training"),
    }
}

/// Decodes what fits into the cache, so that an image that cannot be read ends the run before it begins.
fn preload(images: &ImageCache, console: &Console) -> Result<()> {
    let bar = progress::counting_bar(console, "reading images", images.len());
    images.preload(|done, _| bar.set_position(done as u64))?;
    bar.finish_and_clear();
    Ok(())
}

/// A training that failed half-way keeps its last good model, under a name that no one takes for a finished one.
fn salvage(failure: Failure, run_dir: &RunDir, last: Option<Kept>) -> Failure {
    let Some(Kept { step, cloud, antialiased }) = last.filter(|kept| kept.step > 0 && !kept.cloud.is_empty()) else {
        return failure;
    };
    let path = run_dir.unfinished_path();
    let failure = match checkpoints(run_dir.path()).first() {
        Some((_, path)) => failure.hint_first(format!("`--resume` goes on from `{}`", path.display())),
        None => failure,
    };
    match run_dir.write_unfinished(&cloud, antialiased) {
        Ok(()) => failure.hint_first(format!("the model as it was after step {step} is in `{}`", path.display())),
        Err(_) => failure,
    }
}

/// Where a model comes from, for the header of its file. The frame is that of the reconstruction; the extent is what
/// learning rates and distances were measured in. Nothing of the machine and no time: equal runs give equal files.
fn provenance(job: &TrainJob<'_>, dataset: &Dataset, num_steps: u32) -> Vec<String> {
    let mut lines = vec![
        format!("Scene: {}, {}", scene_name(job.scene), dataset.source),
        format!(
            "Trained: {num_steps} steps, seed {}, on {} views; {} test views{}",
            job.config.train.seed,
            dataset.train.len(),
            dataset.test.len(),
            held_out(dataset)
        ),
        format!("Extent of the cameras: {} world units", dataset.scene_extent()),
    ];
    lines.extend(job.config.model.antialiased.then(|| ANTIALIASED_COMMENT.to_owned()));
    lines
}

fn facts(
    job: &TrainJob<'_>,
    dataset: &Dataset,
    run_dir: &RunDir,
    cache: Option<&ReferenceCache>,
    refined: Option<&Refined>,
) -> Vec<(String, String)> {
    let mut facts = vec![
        ("scene".to_owned(), job.scene.display().to_string()),
        (
            "views".to_owned(),
            format!("{} for training{}, {} for testing", dataset.train.len(), held_out(dataset), dataset.test.len()),
        ),
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
    if let Some(refined) = refined {
        facts.push(("camera poses".to_owned(), refined.described.clone()));
    }
    facts.push(("computed on".to_owned(), job.device.describe()));
    if let Some(model) = &job.init {
        facts.push(("started from".to_owned(), model.path.display().to_string()));
    }
    if let Some(cache) = cache {
        // More than one per view: the cache is too small for the scene.
        facts.push(("statistics of photographs".to_owned(), format!("computed {} times", cache.num_misses())));
    }
    facts.push(("spherical harmonics".to_owned(), format!("degree {}", job.config.model.sh_degree)));
    facts
}

#[cfg(test)]
mod tests {
    use super::*;
    use gazesplat_core::io::ply;

    fn one_gaussian() -> GaussianCloud {
        GaussianCloud {
            means: vec![[0.0; 3]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]],
            log_scales: vec![[0.0; 3]],
            opacity_logits: vec![0.0],
            sh_degree: 0,
            sh: vec![[0.0; 3]],
        }
    }

    #[test]
    fn failed_training_leaves_its_last_model_and_says_of_which_step_it_is() {
        let dir = tempfile::tempdir().expect("temporary directory");
        let run_dir = RunDir::create(dir.path(), false).expect("writable");
        let lost = || Failure::from(gazesplat_render::Error::Device { message: "device lost".to_owned() });
        for nothing in [None, Some(Kept { step: 0, cloud: one_gaussian(), antialiased: false })] {
            salvage(lost(), &run_dir, nothing);
            assert!(!run_dir.unfinished_path().exists(), "a model without a step is none");
        }
        let report =
            salvage(lost(), &run_dir, Some(Kept { step: 20, cloud: one_gaussian(), antialiased: false })).report(false);
        assert_eq!(ply::load(run_dir.unfinished_path()).expect("readable"), one_gaussian());
        assert!(report.contains("hint: the model as it was after step 20 is in `"), "{report}");
        assert!(report.contains("unfinished.ply`; what was saved is intact; free memory of the card"), "{report}");
        assert!(!run_dir.model_path().exists(), "nobody takes it for a finished run");
    }
}
