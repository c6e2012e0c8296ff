//! `gazesplat eval`: how close a model comes to the photographs of a scene.

use super::antialiased::AntialiasedArgs;
use super::device::ComputeDevice;
use super::hvsq_args::{self, HvsqArgs, Measured, Measures};
use super::perceptual::Perceptual;
use super::quality::{self, ImageFiles};
use super::termination::TerminationArgs;
use super::{Model, Split, layered, load_scene, log_machine};
use crate::cli::{DeviceArgs, SettingsArgs};
use crate::console::{Console, bytes, grouped};
use crate::diagnostics::{Failure, Result};
use crate::run_dir;
use clap::Args;
use gazesplat_core::ImageF32;
use gazesplat_core::io::images::ImageCache;
use gazesplat_render::{RenderOptions, Splats};
use gazesplat_train::losses::LossTarget;
use gazesplat_train::{EvalReport, ViewScore, with_threads};
use serde::Serialize;
use std::path::PathBuf;

/// Arguments of `eval`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat eval runs/fox-1 --scene fox
  gazesplat eval model.ply --scene fox --split all --set data.max_side=480 > eval.json
  gazesplat eval runs/fox-1 --scene fox --min-psnr 25 || echo worse than 25 dB
  gazesplat eval runs/fox-1 --scene fox --save-images looks
  gazesplat eval runs/fox-1 --scene fox --device gpu
  gazesplat eval runs/fox-1 --scene fox --antialiased --set data.max_side=240
  gazesplat eval runs/fox-1 --scene fox --hvsq 1,3,7,12 --gaze 0.5,0.5
  gazesplat eval runs/fox-1 --scene fox --lpips-weights lpips_vgg.safetensors

A run is measured with the settings it was trained with (image size, split, background,
antialiasing), a PLY file with the defaults.

Gaussians with a value that is not finite are left out, with a warning that names the file and
their number; a model without any other is refused.")]
pub struct EvalArgs {
    /// A model file (PLY, compressed PLY, `.splat`, SPZ), or the directory of a run
    pub model: PathBuf,
    /// The scene with the photographs
    #[arg(long, value_name = "SCENE")]
    pub scene: PathBuf,
    /// Settings
    #[command(flatten)]
    pub settings: SettingsArgs,
    /// Which views of the scene
    #[arg(long, value_enum, default_value = "test")]
    pub split: Split,
    /// When a pixel stops
    #[command(flatten)]
    pub termination: TerminationArgs,
    /// Antialiasing
    #[command(flatten)]
    pub antialiased: AntialiasedArgs,
    /// Device
    #[command(flatten)]
    pub device: DeviceArgs,
    /// HVSQ beside PSNR and SSIM
    #[command(flatten)]
    pub hvsq: HvsqArgs,
    /// Exit with status 1 when the mean PSNR is below this many dB
    #[arg(long, value_name = "DB")]
    pub min_psnr: Option<f64>,
    /// Measure LPIPS too, with the weights in this safetensors file (README.md says how to make it)
    #[arg(long, value_name = "FILE")]
    pub lpips_weights: Option<PathBuf>,
    /// Write the render of every view, a map of its errors and one of FLIP (black 0 to pale yellow 1) below this
    /// directory: `renders`, `errors`, `flip`
    #[arg(long, value_name = "DIR")]
    pub save_images: Option<PathBuf>,
    /// Write the JSON to this file too
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
}

/// Runs `eval`.
///
/// # Errors
/// When the device, the model or the scene cannot be used, or the quality is below `--min-psnr`.
pub fn command(args: &EvalArgs, console: &Console) -> Result<()> {
    args.termination.check()?;
    let device = ComputeDevice::open(args.device.device, console)?;
    eval(args, &device, console)
}

fn eval(args: &EvalArgs, device: &ComputeDevice, console: &Console) -> Result<()> {
    let model = Model::load_for_drawing(&args.model, console)?;
    let settings = layered(model.run_settings()?, &args.settings)?;
    let (mut config, terms) = (settings.resolve()?, settings.resolve_terms()?);
    config.model.antialiased = args.antialiased.or(config.model.antialiased);
    let weights = args.lpips_weights.as_ref().or(terms.eval.lpips_weights.as_ref());
    let perceptual = Perceptual::new(weights.map(PathBuf::as_path), device)?;
    let dataset = load_scene(&args.scene, &config, console)?;
    let measures = args.hvsq.measures()?;
    let images = ImageCache::new(args.split.views(&dataset, &args.scene)?, config.data.cache_bytes);
    let files = args.save_images.as_ref().map(|dir| ImageFiles::create(dir, &images)).transpose()?;
    let report = with_threads(config.train.threads, || {
        log_machine();
        let options = RenderOptions { termination: args.termination.termination()?, ..config.render_options() };
        device.guard(|| {
            let splats = Splats::from_cloud(&model.cloud, device.tensors())?;
            let each = Each { args, measures: measures.as_ref(), files: files.as_ref(), perceptual: &perceptual };
            measure(each, &splats, &images, &options, console)
        })
    })??;
    let (report, hvsq) = report;
    let hvsq = hvsq.map(|views| HvsqOfViews { mean: hvsq_args::mean(&views), views });
    let full = FullReport { report: &report, hvsq: hvsq.as_ref().map(HvsqReport::from) };
    tracing::info!("images in memory: {} of {}", bytes(images.num_bytes() as u64), images.len());
    if let Some(out) = &args.out {
        run_dir::write_text(out, &format!("{}\n", run_dir::to_json(&full)))?;
    }
    console.note(quality::table(&report));
    if let Some(hvsq) = &hvsq {
        console.note(hvsq_args::table(&hvsq.views, &hvsq.mean));
    }
    console.note(format_args!("{} Gaussians", grouped(report.num_gaussians)));
    console.json(&full)?;
    match args.min_psnr {
        Some(min) if report.psnr < min => {
            Err(Failure::check_failed(format!("mean PSNR is {:.2} dB, at least {min} dB was asked for", report.psnr)))
        }
        _ => Ok(()),
    }
}

/// The figures as data: those of [`EvalReport`], and HVSQ where it was asked for.
#[derive(Debug, Serialize)]
struct FullReport<'a> {
    #[serde(flatten)]
    report: &'a EvalReport,
    #[serde(skip_serializing_if = "Option::is_none")]
    hvsq: Option<HvsqReport<'a>>,
}

#[derive(Debug, Serialize)]
struct HvsqReport<'a> {
    mean: &'a [hvsq_args::Value],
    views: Vec<HvsqOfView<'a>>,
}

#[derive(Debug, Serialize)]
struct HvsqOfView<'a> {
    name: &'a str,
    #[serde(flatten)]
    measured: &'a Measured,
}

struct HvsqOfViews {
    mean: Measured,
    views: Vec<(String, Measured)>,
}

impl<'a> From<&'a HvsqOfViews> for HvsqReport<'a> {
    fn from(of: &'a HvsqOfViews) -> Self {
        let views = of.views.iter().map(|(name, measured)| HvsqOfView { name, measured }).collect();
        Self { mean: &of.mean.hvsq, views }
    }
}

/// Every view by name, with what HVSQ says of it.
type NamedMeasures = Vec<(String, Measured)>;

/// What is done with each view.
struct Each<'a> {
    args: &'a EvalArgs,
    measures: Option<&'a Measures>,
    files: Option<&'a ImageFiles>,
    perceptual: &'a Perceptual,
}

/// Measures every view in all ways that were asked for, keeps what was compared in `files`, and writes the map of the view
/// that differs most in the last measure.
fn measure(
    Each { args, measures, files, perceptual }: Each<'_>,
    splats: &Splats,
    images: &ImageCache,
    options: &RenderOptions,
    console: &Console,
) -> Result<(EvalReport, Option<NamedMeasures>)> {
    let mut views: Vec<(String, Measured)> = Vec::with_capacity(images.len());
    let mut worst: Option<(f64, ImageF32, LossTarget)> = None;
    let mut each = |index: usize, score: &ViewScore, image: &ImageF32| -> Result<()> {
        if files.is_none() && measures.is_none() {
            return Ok(());
        }
        let photo = images.get(index)?;
        if let Some(files) = files {
            files.write(index, image, &photo, options, &perceptual.flip)?;
        }
        if let Some(measures) = measures {
            let target = LossTarget::new(photo, options.background);
            let measured = measures.measure(image, &target)?;
            let value = measured.hvsq.last().map_or(0.0, |v| v.value);
            if args.hvsq.hvsq_map.is_some() && worst.as_ref().is_none_or(|(most, ..)| value > *most) {
                worst = Some((value, image.clone(), target));
            }
            views.push((score.name.clone(), measured));
        }
        Ok(())
    };
    let report = quality::measure_each(splats, images, options, &perceptual.metrics(), &mut each, console)?;
    if let (Some(measures), Some(path), Some((_, image, target))) = (measures, &args.hvsq.hvsq_map, &worst) {
        measures.write_map(path, image, target, console)?;
    }
    Ok((report, measures.map(|_| views)))
}
