//! `gazesplat synth`: a furnished room, ray-cast, with exact cameras: a capture that nobody had to take.

use crate::cli::{Size, parse_fov_deg, parse_size};
use crate::console::{Console, duration, grouped};
use crate::diagnostics::{Failure, Result};
use crate::run_dir::cannot_write;
use clap::Args;
use gazesplat_core::Dataset;
use gazesplat_core::synthetic::{self, SynthOptions};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Arguments of `synth`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat synth --out room
  gazesplat synth --out room7 --seed 7 --views 60 --size 960x640

The directory then holds `images`, a COLMAP text model in `sparse/0`, `transforms.json` and `points3D.ply`.")]
pub struct SynthArgs {
    /// Directory for the scene; must be empty or not exist
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Number of photographs
    #[arg(long, value_name = "N", default_value_t = SynthOptions::default().num_views, value_parser = parse_views)]
    pub views: usize,
    /// Size of the photographs in pixels
    #[arg(long, value_name = "WxH", default_value = "480x320", value_parser = parse_size)]
    pub size: Size,
    /// Horizontal field of view in degrees
    #[arg(long, value_name = "DEG", default_value_t = SynthOptions::default().fov_x_deg, value_parser = parse_fov_deg)]
    pub fov: f32,
    /// Number of sparse points; 0 leaves training to start from random Gaussians
    #[arg(long, value_name = "N", default_value_t = SynthOptions::default().num_points)]
    pub points: usize,
    /// Changes the colours of the room and where its small things stand
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
}

/// More photographs than this are a slip of the finger.
const MAX_VIEWS: usize = 100_000;

fn parse_views(text: &str) -> std::result::Result<usize, String> {
    text.parse().ok().filter(|n| (1..=MAX_VIEWS).contains(n)).ok_or_else(|| format!("expected 1 to {MAX_VIEWS}"))
}

/// Runs `synth`.
///
/// # Errors
/// When the directory is not empty or cannot be written.
pub fn command(args: &SynthArgs, console: &Console) -> Result<()> {
    let is_occupied = match std::fs::read_dir(&args.out) {
        Ok(mut entries) => entries.next().is_some(),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => false,
        Err(e) => return Err(cannot_write(&args.out, e)),
    };
    if is_occupied {
        return Err(
            Failure::new(format!("`{}` is not empty", args.out.display())).hint("choose a new directory with `--out`")
        );
    }
    let options = SynthOptions {
        seed: args.seed,
        num_views: args.views,
        width: args.size.width,
        height: args.size.height,
        fov_x_deg: args.fov,
        num_points: args.points,
        ..SynthOptions::default()
    };
    write(&args.out, &options, console)?;
    Ok(())
}

/// Writes the scene into `dir` and tells about it.
pub(crate) fn write(dir: &Path, options: &SynthOptions, console: &Console) -> Result<Dataset> {
    let started = Instant::now();
    let dataset = synthetic::write_scene(dir, options).map_err(|error| match &error {
        gazesplat_core::Error::Io { .. } => {
            Failure::from(error).hint("choose a place that can be written with `--out`")
        }
        _ => error.into(),
    })?;
    console.note(format_args!(
        "{}: {} views of {}x{}, {} points, {}",
        dir.display(),
        options.num_views,
        options.width,
        options.height,
        grouped(dataset.points.len()),
        duration(started.elapsed().as_secs_f64())
    ));
    Ok(dataset)
}
