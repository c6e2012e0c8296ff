//! `gazesplat eval`: how close a model comes to the photographs of a scene.

use super::device::ComputeDevice;
use super::hvsq_args::{self, HvsqArgs, Measured, Measures};
use super::termination::TerminationArgs;
use super::{Model, Split, load_scene, log_machine, quality};
use crate::cli::{DeviceArgs, SettingsArgs};
use crate::console::{Console, bytes, grouped};
use crate::diagnostics::{Failure, Result};
use crate::progress;
use crate::run_dir;
use clap::Args;
use gazesplat_core::ImageF32;
use gazesplat_core::io::images::ImageCache;
use gazesplat_render::{RenderOptions, Splats};
use gazesplat_train::losses::LossTarget;
use gazesplat_train::{EvalReport, with_threads};
use serde::Serialize;
use std::path::PathBuf;

/// Arguments of `eval`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat eval runs/fox-1 --scene fox
  gazesplat eval model.ply --scene fox --split all --set data.max_side=480 > eval.json
  gazesplat eval runs/fox-1 --scene fox --min-psnr 25 || echo worse than 25 dB
  gazesplat eval runs/fox-1 --scene fox --device gpu
  gazesplat eval runs/fox-1 --scene fox --hvsq 1,3,7,12 --gaze 0.5,0.5

A run is measured with the settings it was trained with (image size, split, background), a PLY
file with the defaults.

Gaussians with a value that is not finite are left out, with a warning that names the file and
their number; a model without any other is refused.")]
pub struct EvalArgs {
    /// A 3DGS PLY file, or the directory of a run
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
    /// Device
    #[command(flatten)]
    pub device: DeviceArgs,
    /// HVSQ beside PSNR and SSIM
    #[command(flatten)]
    pub hvsq: HvsqArgs,
    /// Exit with status 1 when the mean PSNR is below this many dB
    #[arg(long, value_name = "DB")]
    pub min_psnr: Option<f64>,
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
    let config = model.settings(&args.settings)?;
    let dataset = load_scene(&args.scene, &config, console)?;
    let measures = args.hvsq.measures()?;
    let images = ImageCache::new(args.split.views(&dataset, &args.scene)?, config.data.cache_bytes);
    let report = with_threads(config.train.threads, || {
        log_machine();
        let options = RenderOptions { termination: args.termination.termination()?, ..config.render_options() };
        device.guard(|| {
            let splats = Splats::from_cloud(&model.cloud, device.tensors())?;
            match &measures {
                None => Ok((quality::measure(&splats, &images, &options, console)?, None)),
                Some(measures) => {
                    let (report, hvsq) = measure_hvsq(args, measures, &splats, &images, &options, console)?;
                    Ok::<_, Failure>((report, Some(hvsq)))
                }
            }
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

/// Measures every view in both ways; writes the map of the view that differs most in the last measure.
fn measure_hvsq(
    args: &EvalArgs,
    measures: &Measures,
    splats: &Splats,
    images: &ImageCache,
    options: &RenderOptions,
    console: &Console,
) -> Result<(EvalReport, Vec<(String, Measured)>)> {
    let bar = progress::counting_bar(console, "measuring", images.len());
    let mut views: Vec<(String, Measured)> = Vec::with_capacity(images.len());
    let mut worst: Option<(f64, ImageF32, LossTarget)> = None;
    let mut failure = None;
    let report = gazesplat_train::evaluate(splats, images, options, &mut |score, image| {
        bar.inc(1);
        if failure.is_some() {
            return;
        }
        let measured = images
            .get(views.len())
            .map_err(Failure::from)
            .map(|photo| LossTarget::new(photo, options.background))
            .and_then(|target| Ok((measures.measure(image, &target)?, target)));
        match measured {
            Ok((measured, target)) => {
                let value = measured.hvsq.last().map_or(0.0, |v| v.value);
                if args.hvsq.hvsq_map.is_some() && worst.as_ref().is_none_or(|(most, ..)| value > *most) {
                    worst = Some((value, image.clone(), target));
                }
                views.push((score.name.clone(), measured));
            }
            Err(error) => failure = Some(error),
        }
    })?;
    bar.finish_and_clear();
    if let Some(failure) = failure {
        return Err(failure);
    }
    if let (Some(path), Some((_, image, target))) = (&args.hvsq.hvsq_map, &worst) {
        measures.write_map(path, image, target, console)?;
    }
    Ok((report, views))
}
