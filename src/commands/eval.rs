//! `gazesplat eval`: how close a model comes to the photographs of a scene.

use super::device::ComputeDevice;
use super::termination::TerminationArgs;
use super::{Model, Split, load_scene, log_machine, quality};
use crate::cli::{DeviceArgs, SettingsArgs};
use crate::console::{Console, bytes, grouped};
use crate::diagnostics::{Failure, Result};
use crate::run_dir;
use clap::Args;
use gazesplat_core::io::images::ImageCache;
use gazesplat_render::{RenderOptions, Splats};
use gazesplat_train::with_threads;
use std::path::PathBuf;

/// Arguments of `eval`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat eval runs/fox-1 --scene fox
  gazesplat eval model.ply --scene fox --split all --set data.max_side=480 > eval.json
  gazesplat eval runs/fox-1 --scene fox --min-psnr 25 || echo worse than 25 dB
  gazesplat eval runs/fox-1 --scene fox --device gpu

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
    let images = ImageCache::new(args.split.views(&dataset, &args.scene)?, config.data.cache_bytes);
    let report = with_threads(config.train.threads, || {
        log_machine();
        let options = RenderOptions { termination: args.termination.termination()?, ..config.render_options() };
        device.guard(|| {
            let splats = Splats::from_cloud(&model.cloud, device.tensors())?;
            quality::measure(&splats, &images, &options, console)
        })
    })??;
    tracing::info!("images in memory: {} of {}", bytes(images.num_bytes() as u64), images.len());
    if let Some(out) = &args.out {
        run_dir::write_text(out, &format!("{}\n", run_dir::to_json(&report)))?;
    }
    console.note(quality::table(&report));
    console.note(format_args!("{} Gaussians", grouped(report.num_gaussians)));
    console.json(&report)?;
    match args.min_psnr {
        Some(min) if report.psnr < min => {
            Err(Failure::check_failed(format!("mean PSNR is {:.2} dB, at least {min} dB was asked for", report.psnr)))
        }
        _ => Ok(()),
    }
}
