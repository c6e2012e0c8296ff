//! `gazesplat demo`: the whole way once, on a scene that needs no download.

use super::device::ComputeDevice;
use super::frames::{self, NamedCamera};
use super::synth;
use super::train::{TrainJob, Trained, train};
use crate::cli::DeviceArgs;
use crate::console::{Console, duration, grouped};
use crate::diagnostics::{Failure, Result};
use crate::interrupt;
use crate::progress;
use crate::report::{html, pictures};
use crate::run_dir::cannot_write;
use crate::settings::Settings;
use crate::terms::TermSection;
use clap::Args;
use gazesplat_core::RgbImage8;
use gazesplat_core::camera::path::CameraPath;
use gazesplat_core::synthetic::SynthOptions;
use gazesplat_render::Splats;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Where the demo goes when it is not told; its own directory, replaced each time.
const DEFAULT_OUT: &str = "runs/demo";

/// Every how many frames of the orbit one is kept for the report: half of its 30 frames per second look smooth enough.
const FILM_STRIDE: usize = 2;

/// Longer side of a film frame, pixels.
const FILM_SIDE: u32 = 480;

/// Arguments of `demo`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat demo
  gazesplat demo --quick --out /tmp/demo

Makes a procedural room, trains a model of it, measures it on views kept for testing, renders an
orbit and writes a report. Takes two to three minutes on two cores; --quick some ten seconds.")]
pub struct DemoArgs {
    /// Directory for everything the demo makes; the default is replaced each time
    #[arg(long, value_name = "DIR", default_value = DEFAULT_OUT)]
    pub out: PathBuf,
    /// Device
    #[command(flatten)]
    pub device: DeviceArgs,
    /// A small scene and few steps: shows that everything works, not how good it gets
    #[arg(long)]
    pub quick: bool,
    /// Replace the run and the `scene` that are in the directory given with --out
    #[arg(long)]
    pub overwrite: bool,
}

/// Runs `demo`.
///
/// # Errors
/// When the device cannot be used, or the directory cannot be written.
pub fn command(args: &DemoArgs, console: &Console) -> Result<()> {
    let device = ComputeDevice::open(args.device.device, console)?;
    demo(args, &device, console)
}

fn demo(args: &DemoArgs, device: &ComputeDevice, console: &Console) -> Result<()> {
    let started = Instant::now();
    let stop = interrupt::stop_flag()?;
    let overwrite = args.overwrite || args.out == Path::new(DEFAULT_OUT);
    let scene = args.out.join("scene");
    make_way(&args.out, &scene, overwrite)?;
    let size = if args.quick { Size::QUICK } else { Size::FULL };

    console.note("1/3  a procedural room");
    let synth_started = Instant::now();
    synth::write(&scene, &size.scene, console)?;
    let synth_secs = synth_started.elapsed().as_secs_f64();

    console.note(format_args!("2/3  training, {} steps", grouped(size.num_steps as usize)));
    let config = Settings::new()
        .with_override(&format!("train.steps={}", size.num_steps))?
        .with_override(&format!("densify.cap={}", size.cap))?
        .resolve()?;
    let (terms, out) = (TermSection::default(), Some(args.out.as_path()));
    let job = TrainJob {
        scene: &scene,
        config,
        terms,
        init: None,
        out,
        overwrite,
        device,
        resume: None,
        is_resumable: false,
    };
    let mut trained = train(&job, stop, console)?;

    console.note("3/3  an orbit through the model");
    let orbit_started = Instant::now();
    let (orbit, film) = device.guard(|| write_orbit(&args.out, &trained, &job, size.num_frames, console))?;
    let orbit_secs = orbit_started.elapsed().as_secs_f64();

    let report = &mut trained.report;
    report.title = "A room that was never built".to_owned();
    let num_steps = if trained.num_steps == size.num_steps {
        size.num_steps.to_string()
    } else {
        format!("{} of {}", trained.num_steps, size.num_steps)
    };
    report.subtitle = format!(
        "{} photographs of a procedural room went in, this 3D Gaussian model came out after {num_steps} steps on the \
         {}.",
        size.scene.num_views,
        if device.is_gpu() { "graphics card" } else { "processor" }
    );
    report.film = film;
    report.durations.insert(0, ("making the scene".to_owned(), synth_secs));
    report.durations.push(("rendering the orbit".to_owned(), orbit_secs));
    trained.run_dir.write_report(&html::page(report))?;

    console.note("");
    let file = |name: &str| args.out.join(name).display().to_string();
    for (what, place) in [
        ("scene", scene.display().to_string()),
        ("model", file("point_cloud.ply")),
        ("video", orbit.display().to_string()),
        ("report", file("report.html")),
    ] {
        console.note(format_args!("{what:7} {place}"));
    }
    console.note(format_args!(
        "done: {:.2} dB PSNR on {} {} views, {} Gaussians, {} in all",
        trained.eval.psnr,
        trained.eval.views.len(),
        trained.report.measured.name(),
        grouped(trained.cloud.len()),
        duration(started.elapsed().as_secs_f64())
    ));
    Ok(())
}

/// Refuses to touch what is in `out` unless it may be replaced; then the old scene goes, whose images may be others.
fn make_way(out: &Path, scene: &Path, overwrite: bool) -> Result<()> {
    if out.is_file() {
        return Err(Failure::new(format!("`{}` is a file, expected a directory", out.display()))
            .hint("choose another directory with `--out`"));
    }
    let is_occupied = scene.symlink_metadata().is_ok();
    if !overwrite && (is_occupied || out.join("point_cloud.ply").exists()) {
        let what = if is_occupied { "a scene" } else { "a run" };
        return Err(Failure::new(format!("`{}` already holds {what}", out.display()))
            .hint("choose another directory with `--out`, or replace what is there with `--overwrite`"));
    }
    if scene.is_dir() {
        fs::remove_dir_all(scene).map_err(|e| cannot_write(scene, e))?;
    }
    Ok(())
}

/// How much the demo does.
struct Size {
    scene: SynthOptions,
    num_steps: u32,
    cap: usize,
    num_frames: usize,
}

impl Size {
    const FULL: Self = Self {
        scene: SynthOptions {
            seed: 0,
            num_views: 56,
            width: 480,
            height: 320,
            fov_x_deg: 75.0,
            samples_per_side: 3,
            num_points: 12_000,
        },
        num_steps: 3000,
        cap: 50_000,
        num_frames: 150,
    };
    const QUICK: Self = Self {
        scene: SynthOptions {
            seed: 0,
            num_views: 24,
            width: 192,
            height: 128,
            fov_x_deg: 75.0,
            samples_per_side: 2,
            num_points: 3000,
        },
        num_steps: 400,
        cap: 10_000,
        num_frames: 30,
    };
}

/// Renders a closed path through the training cameras into a video, beside the path itself; returns some of the frames.
fn write_orbit(
    out: &Path,
    trained: &Trained,
    job: &TrainJob<'_>,
    num_frames: usize,
    console: &Console,
) -> Result<(PathBuf, Vec<RgbImage8>)> {
    // Eight keys around the ring: enough to follow it, few enough that the path does not bob with every camera's height.
    let cameras: Vec<_> = trained.dataset.train.iter().map(|view| view.camera).collect();
    let keys: Vec<_> = cameras.iter().step_by((cameras.len() / 8).max(1)).copied().collect();
    let path = CameraPath::through(&keys, num_frames, true)?;
    path.save(out.join("orbit.json"))?;
    let file = out.join("orbit.y4m");
    let splats = Splats::from_cloud(&trained.cloud, job.device.tensors())?;
    let options = job.config.render_options();
    let bar = progress::counting_bar(console, "rendering", path.frames.len());
    let mut film = Vec::new();
    let mut index = 0;
    frames::write_video(&file, &path.frames, path.fps, |camera: &NamedCamera| {
        let (image, _) = frames::draw(&splats, &camera.1, &options)?;
        if index % FILM_STRIDE == 0 {
            film.push(pictures::fitted(&image, FILM_SIDE));
        }
        index += 1;
        bar.inc(1);
        Ok(image)
    })?;
    bar.finish_and_clear();
    Ok((file, film))
}
