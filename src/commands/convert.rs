//! `gazesplat convert`: a model in another file format.

use super::Model;
use crate::console::{Console, bytes, grouped};
use crate::diagnostics::{Failure, Result};
use crate::run_dir::generator;
use clap::Args;
use gazesplat_core::io::model::{self, ModelFormat, SaveOptions};
use gazesplat_render::cluster::morton_order;
use std::path::{Path, PathBuf};

/// Arguments of `convert`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat convert runs/fox-1 fox.spz
  gazesplat convert model.ply model.compressed.ply
  gazesplat convert model.splat model.ply --overwrite
  gazesplat convert model.ply small.spz --sh-degree 1 --sh-bits 6
  gazesplat convert model.ply model.spz --format spz4

Formats, and the names that choose them:
  ply             exact, 32-bit floats                                     x.ply
  compressed-ply  16 bytes per Gaussian and 1 per SH coefficient           x.compressed.ply
  splat           32 bytes per Gaussian, no spherical harmonics            x.splat
  spz             SPZ 3: 20 bytes and 1 per SH coefficient, then gzip      x.spz
  spz4            SPZ 4: the same, then zstd; not every reader takes it

MODEL may have any of them, SPZ of the versions 2 to 4. What each costs in precision is stated in the
documentation of `gazesplat_core::io`; values beyond the range of a format are clamped and counted.
The file appears complete or not at all: a full disk leaves the old one as it was.")]
pub struct ConvertArgs {
    /// A model file (PLY, compressed PLY, `.splat`, SPZ), or the directory of a run
    #[arg(value_name = "MODEL")]
    pub model: PathBuf,
    /// The file to write
    #[arg(value_name = "OUT")]
    pub out: PathBuf,
    /// Format of the file, if its name is not to choose it
    #[arg(long, value_name = "FORMAT")]
    pub format: Option<ModelFormat>,
    /// Leave out spherical harmonics above this degree, 0 to 4
    #[arg(long, value_name = "DEGREE", value_parser = clap::value_parser!(u32).range(0..=4))]
    pub sh_degree: Option<u32>,
    /// Bits per SH coefficient in SPZ, 1 to 8 [default: 5 for degree 1, 4 above]
    #[arg(long, value_name = "BITS", value_parser = clap::value_parser!(u32).range(1..=8))]
    pub sh_bits: Option<u32>,
    /// Replace the file if it exists
    #[arg(long)]
    pub overwrite: bool,
}

/// Runs `convert`.
///
/// # Errors
/// When the model cannot be read, the format is not known or does not hold it, or the file exists or cannot be written.
pub fn command(args: &ConvertArgs, console: &Console) -> Result<()> {
    let format = format(args)?;
    let is_spz = matches!(format, ModelFormat::Spz3 | ModelFormat::Spz4);
    if args.sh_bits.is_some() && !is_spz {
        return Err(Failure::new(format!("`--sh-bits` is for SPZ, the file becomes {}", format.kind()))
            .hint("leave it out, or choose `--format spz`"));
    }
    refuse_existing(&args.out, args.overwrite)?;
    let mut model = Model::load(&args.model, console)?;
    if format == ModelFormat::Splat && model.report.is_antialiased() {
        console.warn(format_args!(
            "`.splat` has no place to say that the model was trained for antialiased rendering: draw `{}` with \
             `--antialiased`",
            args.out.display()
        ));
    }
    if model.cloud.is_empty() {
        return Err(Failure::new(format!("`{}` holds no Gaussian", model.path.display()))
            .hint("the model is empty or all its values are broken: export or train it again"));
    }
    let degree = model.cloud.sh_degree;
    let kept = args.sh_degree.unwrap_or(degree).min(degree);
    if kept > format.max_sh_degree() {
        let highest = format.max_sh_degree();
        console.warn(format_args!(
            "{} holds spherical harmonics up to degree {highest}, those above it (up to {kept}) are left out",
            format.kind()
        ));
    }
    let kept = kept.min(format.max_sh_degree());
    if kept < degree {
        model.cloud = model.cloud.with_sh_degree(kept);
    }
    if format == ModelFormat::CompressedPly {
        // A chunk of rows shares its bounds: the nearer they are, the finer the steps.
        let order: Vec<usize> = morton_order(&model.cloud.means).into_iter().map(|row| row as usize).collect();
        model.cloud = model.cloud.select(&order);
    }
    let options = SaveOptions { format, sh_bits: args.sh_bits, comments: comments(&model) };
    let report = model::save(&args.out, &model.cloud, &options).map_err(|error| match &error {
        gazesplat_core::Error::Io { .. } => Failure::from(error),
        _ => {
            Failure::from(error).hint("remove such Gaussians first, or choose `--format ply`, which holds every value")
        }
    })?;
    if report.num_clamped > 0 {
        console.warn(format_args!(
            "`{}`: {} values lay outside the range of {} and were clamped",
            args.out.display(),
            grouped(report.num_clamped),
            format.kind()
        ));
    }
    let size = |path: &Path| std::fs::metadata(path).map(|file| file.len()).map_err(|e| Failure::io("read", path, e));
    console.note(format_args!(
        "{}: {}, {} Gaussians, SH degree {kept}, {} (was {} as {})",
        args.out.display(),
        format.kind(),
        grouped(model.cloud.len()),
        bytes(size(&args.out)?),
        bytes(size(&model.path)?),
        model.report.format.kind()
    ));
    Ok(())
}

fn format(args: &ConvertArgs) -> Result<ModelFormat> {
    args.format.or_else(|| ModelFormat::of_path(&args.out)).ok_or_else(|| {
        Failure::new(format!("the name of `{}` says no format of models", args.out.display())).hint(
            "end it in `.ply`, `.compressed.ply`, `.splat` or `.spz`, or choose one with `--format`: ply, \
             compressed-ply, splat, spz, spz4",
        )
    })
}

/// Said before anything is read.
fn refuse_existing(out: &Path, overwrite: bool) -> Result<()> {
    match std::fs::symlink_metadata(out) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(Failure::io("write", out, error)),
        Ok(metadata) if metadata.is_dir() => Err(Failure::new(format!("`{}` is a directory", out.display()))
            .hint("name the file to write, such as `model.spz`")),
        Ok(_) if overwrite => Ok(()),
        Ok(_) => Err(Failure::new(format!("`{}` exists", out.display()))
            .hint("choose another name, or replace it with `--overwrite`")),
    }
}

/// Where the file comes from, above what the file before it said.
fn comments(model: &Model) -> Vec<String> {
    let name = model.path.file_name().unwrap_or(model.path.as_os_str()).to_string_lossy();
    let ours = [generator(), format!("Converted from {name} ({})", model.report.format.kind())];
    ours.into_iter().chain(model.report.comments.iter().cloned()).collect()
}
