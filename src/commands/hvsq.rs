//! `gazesplat hvsq`: how different two pictures look to an eye that does not look straight at them.

use super::hvsq_args::{HvsqArgs, Measured};
use crate::console::Console;
use crate::diagnostics::{Failure, Result};
use clap::Args;
use gazesplat_core::RgbImage8;
use gazesplat_core::io::images::{TrainingImage, decode_rgb};
use gazesplat_train::losses::LossTarget;
use gazesplat_train::metrics::{psnr, ssim};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Arguments of `hvsq`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat hvsq render.png photo.png
  gazesplat hvsq render.png photo.png --hvsq 3 --hvsq-map difference.png
  gazesplat hvsq render.png photo.png --gaze 0.25,0.75 --display-fov 100 --hvsq-regions

HVSQ compares means and deviations of what early vision sees over pools of pixels: 0 = they look
the same, lower is better. Without --gaze the pools are as large everywhere as --hvsq says.")]
pub struct HvsqCommandArgs {
    /// The altered picture, PNG or JPEG
    #[arg(value_name = "A.png")]
    pub altered: PathBuf,
    /// What it is compared with, of the same size
    #[arg(value_name = "B.png")]
    pub reference: PathBuf,
    /// What is measured
    #[command(flatten)]
    pub hvsq: HvsqArgs,
}

#[derive(Debug, Serialize)]
struct Report {
    width: u32,
    height: u32,
    psnr: f64,
    ssim: f64,
    #[serde(flatten)]
    measured: Measured,
}

/// Runs `hvsq`.
///
/// # Errors
/// When a picture cannot be read, their sizes differ, or a pool or display is impossible.
pub fn command(args: &HvsqCommandArgs, console: &Console) -> Result<()> {
    let measures = args.hvsq.measures()?.unwrap_or_default();
    let altered = decode_rgb(&args.altered)?;
    let reference = decode_rgb(&args.reference)?;
    check_sizes((&args.altered, &altered), (&args.reference, &reference))?;
    let (width, height) = (altered.width, altered.height);
    let image = altered.to_f32();
    let photo = TrainingImage { image: reference, alpha: None, mask: None };
    let target = LossTarget::new(Arc::new(photo), [0.0; 3]);
    let measured = measures.measure(&image, &target)?;
    if let Some(path) = &args.hvsq.hvsq_map {
        measures.write_map(path, &image, &target, console)?;
    }
    console.json(&Report { width, height, psnr: psnr(&image, &target), ssim: ssim(&image, &target), measured })
}

fn check_sizes(a: (&Path, &RgbImage8), b: (&Path, &RgbImage8)) -> Result<()> {
    let size = |i: &RgbImage8| (i.width, i.height);
    if size(a.1) == size(b.1) {
        return Ok(());
    }
    let ((wa, ha), (wb, hb)) = (size(a.1), size(b.1));
    Err(Failure::new(format!(
        "`{}` is {wa}x{ha} and `{}` is {wb}x{hb}: pictures of one size are compared",
        a.0.display(),
        b.0.display()
    ))
    .hint("render at the size of the photograph, or scale one of the pictures first"))
}
