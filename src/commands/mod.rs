//! The commands of the program, one file each, and what several of them share: scenes, models, threads.

pub mod bench;
pub mod convert;
pub mod demo;
pub mod device;
pub mod eval;
pub mod hvsq;
pub mod hvsq_args;
pub mod info;
pub mod lut;
pub mod prune;
pub mod render;
pub mod synth;
pub mod termination;
pub mod train;

mod antialiased;
mod checkpoints;
mod devices;
mod frames;
mod keeper;
mod perceptual;
mod quality;
mod record;
mod refined;

use crate::cli::SettingsArgs;
use crate::console::{Console, grouped};
use crate::diagnostics::{Failure, Result};
use crate::run_dir::RunDir;
use crate::settings::Settings;
use gazesplat_core::dataset::LoadOptions;
use gazesplat_core::io::model::{self, ModelReport};
use gazesplat_core::{Dataset, GaussianCloud, View};
use gazesplat_render::cluster::morton_order;
use gazesplat_render::simd::{self, SimdLevel};
use gazesplat_train::Config;
use std::path::{Path, PathBuf};

/// Which views of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Split {
    /// The views training uses
    Train,
    /// The views kept for measurement
    Test,
    /// Every view
    All,
}

impl Split {
    /// The views of `dataset` in this split, sorted by name.
    ///
    /// # Errors
    /// When there is none.
    pub fn views(self, dataset: &Dataset, scene: &Path) -> Result<Vec<View>> {
        let views = match self {
            Self::Train => dataset.train.clone(),
            Self::Test => dataset.test.clone(),
            Self::All => dataset.all_views().into_iter().cloned().collect(),
        };
        if views.is_empty() {
            let (name, hint) = match self {
                Self::Train => ("training views", "`--split all` takes every view"),
                Self::Test => {
                    ("test views", "`--split all` takes every view; `data.test_every = 8` keeps every 8th for testing")
                }
                Self::All => ("views", "check that the scene lists images with cameras: `gazesplat info SCENE`"),
            };
            return Err(Failure::new(format!("`{}` has no {name}", scene.display())).hint(hint));
        }
        Ok(views)
    }
}

/// Loads a scene as the settings ask, and tells what was odd about it.
///
/// # Errors
/// When the scene cannot be read.
pub fn load_scene(scene: &Path, config: &Config, console: &Console) -> Result<Dataset> {
    let options = LoadOptions {
        max_side: config.data.max_side,
        images: config.data.images.clone(),
        test_every: config.data.test_every,
        holdout: config.data.holdout,
    };
    let mut dataset = Dataset::load(scene, &options)?;
    if let Some(file) = &config.data.poses {
        let num_applied = gazesplat_core::io::poses::apply(&mut dataset, file)?;
        console.note(format_args!("{num_applied} of {} camera poses are those of `{file}`", dataset.all_views().len()));
    }
    for warning in &dataset.warnings {
        console.warn(warning);
    }
    Ok(dataset)
}

/// Name of the scene in directory `scene`: `captures/fox/` is `fox`.
pub fn scene_name(scene: &Path) -> String {
    let absolute = std::path::absolute(scene).unwrap_or_else(|_| scene.to_owned());
    let mut normal = absolute.components().filter_map(|c| match c {
        std::path::Component::Normal(name) => Some(name.to_string_lossy().into_owned()),
        _ => None,
    });
    normal.next_back().unwrap_or_else(|| "scene".to_owned())
}

/// A model as given on the command line.
#[derive(Debug)]
pub struct Model {
    /// The Gaussians.
    pub cloud: GaussianCloud,
    /// The file it was read from.
    pub path: PathBuf,
    /// What the file held besides.
    pub report: ModelReport,
    /// The run it was given as, if it was a directory.
    pub run: Option<RunDir>,
}

impl Model {
    /// Reads a model file of any format, or the model of a run directory.
    ///
    /// # Errors
    /// When there is no model at `path`, or it cannot be read.
    pub fn load(path: &Path, console: &Console) -> Result<Self> {
        let run = if path.is_dir() { Some(RunDir::open(path)?) } else { None };
        let file = run.as_ref().map_or_else(|| path.to_owned(), RunDir::model_path);
        let (cloud, report) = model::load_with_report(&file)?;
        for note in &report.notes {
            console.warn(format_args!("`{}`: {note}", file.display()));
        }
        if let Some(poses) = run.as_ref().map(RunDir::poses_path).filter(|poses| poses.is_file()) {
            let poses = poses.display();
            console.note(format_args!("camera poses were refined: `--set data.poses={poses}` sees the scene by them"));
        }
        if report.num_dropped_non_finite > 0 {
            console.warn(format_args!(
                "`{}`: left out {} of {} Gaussians with values that are not finite",
                file.display(),
                grouped(report.num_dropped_non_finite),
                grouped(report.num_rows)
            ));
        }
        if report.num_dropped_zero_quat > 0 {
            console.warn(format_args!(
                "`{}`: left out {} of {} Gaussians without a rotation",
                file.display(),
                grouped(report.num_dropped_zero_quat),
                grouped(report.num_rows)
            ));
        }
        Ok(Self { cloud, path: file, report, run })
    }

    /// Reads a model as [`Model::load`] does, to go on training it.
    ///
    /// # Errors
    /// As [`Model::load`]; when there is no Gaussian to train.
    pub fn load_to_train(path: &Path, console: &Console) -> Result<Self> {
        let model = Self::load(path, console)?;
        model.check_not_empty("trained")?;
        Ok(model)
    }

    fn check_not_empty(&self, what_for: &str) -> Result<()> {
        if !self.cloud.is_empty() {
            return Ok(());
        }
        Err(Failure::new(format!("`{}` holds no Gaussian that can be {what_for}", self.path.display()))
            .hint("the model is empty or all its values are broken: export or train it again"))
    }

    /// Reads a model as [`Model::load`] does and prepares it for drawing: neighbours in space become neighbours in
    /// memory, so that whole clusters of them can be passed over, and SH bands that are 0 throughout are cut off.
    ///
    /// # Errors
    /// As [`Model::load`]; when there is no Gaussian to draw.
    pub fn load_for_drawing(path: &Path, console: &Console) -> Result<Self> {
        let mut model = Self::load(path, console)?;
        model.check_not_empty("drawn")?;
        let order: Vec<usize> = morton_order(&model.cloud.means).into_iter().map(|row| row as usize).collect();
        model.cloud = model.cloud.select(&order);
        let degree = model.cloud.highest_nonzero_degree();
        tracing::info!(
            "`{}`: {} Gaussians, SH degree {}, {degree} in use",
            model.path.display(),
            grouped(model.cloud.len()),
            model.cloud.sh_degree
        );
        if degree < model.cloud.sh_degree {
            model.cloud = model.cloud.with_sh_degree(degree);
        }
        Ok(model)
    }

    /// Settings for working with this model: those of [`Model::run_settings`] under those of the command line.
    ///
    /// # Errors
    /// When a settings file or value is wrong.
    pub fn settings(&self, args: &SettingsArgs) -> Result<Config> {
        layered(self.run_settings()?, args)?.resolve()
    }

    /// The settings of its run, if it was given as one; else what its file says: whether it is to be drawn antialiased.
    ///
    /// # Errors
    /// When the settings file is wrong.
    pub fn run_settings(&self) -> Result<Settings> {
        match self.run.as_ref().map(RunDir::settings_path).filter(|p| p.is_file()) {
            Some(file) => Settings::new().with_file(&file),
            None if self.report.is_antialiased() => antialiased::with(Settings::new(), true),
            None => Ok(Settings::new()),
        }
    }

    /// Whether it was trained for antialiased rendering, by its run or its file.
    ///
    /// # Errors
    /// As [`Model::run_settings`].
    pub fn is_antialiased(&self) -> Result<bool> {
        Ok(self.run_settings()?.resolve()?.model.antialiased)
    }
}

/// `--config` and `--set` over `settings`.
pub(crate) fn layered(settings: Settings, args: &SettingsArgs) -> Result<Settings> {
    let settings = match &args.config {
        Some(config) => settings.with_config(config)?,
        None => settings,
    };
    settings.with_overrides(&args.overrides)
}

/// Tells what the machine works with, at `-v`.
pub(crate) fn log_machine() {
    tracing::info!("{} threads, vector instructions {}", rayon::current_num_threads(), vector_instructions());
}

/// The vector instructions the CPU kernels use on this machine.
pub(crate) fn vector_instructions() -> &'static str {
    match simd::level() {
        SimdLevel::Avx512 => "AVX-512",
        SimdLevel::Avx2 => "AVX2 + FMA",
        SimdLevel::Scalar => "portable",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scene_is_named_by_its_directory() {
        assert_eq!(scene_name(Path::new("captures/fox/")), "fox");
        assert_eq!(scene_name(Path::new("/")), "scene");
    }
}
