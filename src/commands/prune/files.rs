//! The directory of a pruning run.
//!
//! | file | content |
//! |---|---|
//! | `settings.toml` | settings the model is measured with, as a training run has them |
//! | `prune.toml` | resolved settings of the pruning |
//! | `prune.jsonl` | one JSON object per event and check, appended as the run goes |
//! | `checkpoint.safetensors` | only of a run that is under way or interrupted |
//! | `levels/` | likewise: some of the models on the way, for the curve |
//! | `point_cloud.ply`, `eval.json`, `prune_curve.svg`, `report.html` | the result |

use super::super::device::ComputeDevice;
use crate::diagnostics::{Failure, Result};
use crate::json_lines::JsonLines;
use crate::run_dir::{RunDir, cannot_write, create_all, remove, write_text};
use crate::settings;
use crate::terms::PruneTerms;
use gazesplat_core::GaussianCloud;
use gazesplat_core::io::ply;
use gazesplat_train::Config;
use gazesplat_train::prune::{Check, Noted, PruneConfig, Pruner};
use serde::Serialize;
use std::fs;
use std::path::{Path, PathBuf};

/// A level is kept when the model has shrunk to this share of the last one kept: some ten levels down to a quarter.
const LEVEL_STEP: f64 = 0.87;

/// The directory, and its growing report.
pub(super) struct PruneDir {
    run_dir: RunDir,
    report: Option<JsonLines>,
    last_level: Option<usize>,
    replaces: bool,
}

impl PruneDir {
    /// A directory for a new run.
    pub fn create(out: Option<&Path>, name: &str, overwrite: bool) -> Result<Self> {
        if let Some(out) = out
            && !overwrite
            && out.join(CHECKPOINT).exists()
        {
            return Err(Failure::new(format!("`{}` holds an interrupted run", out.display()))
                .hint("go on with `--resume`, or replace the run with `--overwrite`"));
        }
        let run_dir = match out {
            Some(out) => RunDir::create(out, overwrite)?,
            None => RunDir::create_numbered(name)?,
        };
        Ok(Self { run_dir, report: None, last_level: None, replaces: overwrite })
    }

    /// The directory of a run that was interrupted.
    pub fn open_interrupted(out: &Path) -> Result<Self> {
        if !out.join(CHECKPOINT).is_file() {
            let finished = out.join("point_cloud.ply").is_file();
            let why = if finished { "the run in it is finished" } else { "no run was interrupted in it" };
            return Err(Failure::new(format!("`{}` holds no `{CHECKPOINT}`: {why}", out.display()))
                .hint("without `--resume` a new run begins"));
        }
        let run_dir = RunDir::create(out, true)?;
        let mut dir = Self { run_dir, report: None, last_level: None, replaces: false };
        dir.last_level = dir.levels().into_iter().map(|(points, _)| points).min();
        Ok(dir)
    }

    pub fn path(&self) -> &Path {
        self.run_dir.path()
    }

    pub fn run_dir(&self) -> &RunDir {
        &self.run_dir
    }

    pub fn checkpoint_path(&self) -> PathBuf {
        self.path().join(CHECKPOINT)
    }

    pub fn report_path(&self) -> PathBuf {
        self.path().join("prune.jsonl")
    }

    pub fn is_new_report(&self) -> bool {
        self.report.is_none()
    }

    /// Writes both files of settings, after the files of a run that is replaced have gone.
    pub fn write_settings(
        &mut self,
        train: &Config,
        config: &PruneConfig,
        terms: &PruneTerms,
        scene: &Path,
        device: &ComputeDevice,
    ) -> Result<()> {
        if self.replaces {
            self.run_dir.clear()?;
            self.remove_scaffolding()?;
            ["prune.toml", "prune.jsonl", CURVE].iter().try_for_each(|name| remove(&self.path().join(name)))?;
        }
        self.run_dir.write_settings(&settings::to_toml(train), scene, &device.describe())?;
        let text = format!(
            "# Resolved settings of a pruning by gazesplat {} on `{}`.\n\n{}",
            env!("CARGO_PKG_VERSION"),
            scene.display(),
            settings::run_to_toml(config, terms)
        );
        write_text(&self.path().join("prune.toml"), &text)
    }

    /// Starts `prune.jsonl` with `header`.
    pub fn begin_report(&mut self, header: &impl Serialize) -> Result<()> {
        self.report = Some(JsonLines::create(self.report_path())?);
        self.append_line(header)
    }

    /// Cuts the report to what the checkpoint knows of, and goes on behind it.
    pub fn continue_report(&mut self, len: u64) -> Result<()> {
        self.report = Some(JsonLines::go_on(self.report_path(), len)?);
        Ok(())
    }

    fn append_line(&mut self, record: &impl Serialize) -> Result<()> {
        self.report.as_mut().expect("the report was begun").append(record)
    }

    /// Appends a check.
    pub fn append(&mut self, check: &Check, elapsed_s: f64) -> Result<()> {
        #[derive(Serialize)]
        struct Line<'a> {
            #[serde(flatten)]
            check: &'a Check,
            elapsed_s: f64,
        }
        self.append_line(&Line { check, elapsed_s })
    }

    /// Appends the last line.
    pub fn append_result(&mut self, result: &impl Serialize) -> Result<()> {
        self.append_line(result)
    }

    /// Writes the checkpoint.
    pub fn save(&self, pruner: &mut Pruner, elapsed_s: f64) -> Result<()> {
        let mut report_bytes = 0;
        if let Some(report) = &self.report {
            report.sync()?;
            report_bytes = report.num_bytes();
        }
        Ok(pruner.save(&self.checkpoint_path(), Noted { report_bytes, elapsed_s })?)
    }

    /// A failure of a step, with what is left to go on from.
    pub fn failure(&self, error: gazesplat_train::Error) -> Failure {
        let failure = Failure::from(error);
        match self.checkpoint_path().is_file() {
            true => {
                failure.hint_first(format!("`{}` holds the state of the last check", self.checkpoint_path().display()))
            }
            false => failure,
        }
    }

    /// Whether a model of `points` Gaussians is far enough from the last level.
    pub fn wants_level(&self, points: usize) -> bool {
        self.last_level.is_none_or(|last| points as f64 <= LEVEL_STEP * last as f64)
    }

    /// Keeps a model of the way.
    pub fn write_level(&mut self, cloud: &GaussianCloud) -> Result<()> {
        let dir = self.path().join(LEVELS);
        create_all(&dir)?;
        ply::save(dir.join(format!("{:09}.ply", cloud.len())), cloud)?;
        self.last_level = Some(cloud.len());
        Ok(())
    }

    /// The levels kept: Gaussians and file, the largest first.
    pub fn levels(&self) -> Vec<(usize, PathBuf)> {
        let entries = fs::read_dir(self.path().join(LEVELS)).into_iter().flatten().flatten();
        let level = |entry: fs::DirEntry| {
            let path = entry.path();
            let points = path.file_stem()?.to_str()?.parse().ok()?;
            Some((points, path))
        };
        let mut levels: Vec<(usize, PathBuf)> = entries.filter_map(level).collect();
        levels.sort_by_key(|(points, _)| std::cmp::Reverse(*points));
        levels
    }

    /// Removes what only an unfinished run needs.
    pub fn remove_scaffolding(&self) -> Result<()> {
        for (_, path) in self.levels() {
            fs::remove_file(&path).map_err(|e| cannot_write(&path, e))?;
        }
        // Not empty when a person put something there.
        let _ = fs::remove_dir(self.path().join(LEVELS));
        remove(&self.checkpoint_path())
    }

    /// Writes `prune_curve.svg`.
    pub fn write_curve(&self, svg: &str) -> Result<()> {
        write_text(&self.path().join(CURVE), svg)
    }
}

const CHECKPOINT: &str = "checkpoint.safetensors";
const LEVELS: &str = "levels";
const CURVE: &str = "prune_curve.svg";
