//! A run directory: everything one training leaves behind, each file complete or absent.
//!
//! | file | content |
//! |---|---|
//! | `settings.toml` | resolved settings with the seed |
//! | `metrics.jsonl` | one JSON object per logged step, appended as the run goes |
//! | `point_cloud.ply` | the model, 3DGS layout |
//! | `eval.json` | test-view quality |
//! | `report.html` | all of it to look at |
//! | `poses.json` | only of a run with `train.refine_poses`: where its training views turned out to be |
//! | `checkpoint-STEP.safetensors` | only of a run that is under way or was interrupted: what `--resume` goes on from |
//! | `unfinished.ply` | only of a training that failed, or is under way on a GPU: its last good model |

use crate::diagnostics::{Failure, Result};
use crate::json_lines::JsonLines;
use gazesplat_core::GaussianCloud;
use gazesplat_core::io::model::ANTIALIASED_COMMENT;
use serde::Serialize;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

/// A directory that holds, or will hold, one run.
#[derive(Debug)]
pub struct RunDir {
    path: PathBuf,
    /// Directories made for this run, outermost first.
    created: Vec<PathBuf>,
}

impl RunDir {
    /// Prepares `path` for a new run, and proves that it can be written before hours of work depend on it.
    ///
    /// # Errors
    /// When `path` already holds a model or a checkpoint and `overwrite` is false, when it is a file, or when it cannot be written.
    pub fn create(path: &Path, overwrite: bool) -> Result<Self> {
        if path.is_file() {
            return Err(Failure::new(format!("`{}` is a file, expected a directory", path.display()))
                .hint("choose another directory with `--out`"));
        }
        if !overwrite && !checkpoints(path).is_empty() {
            return Err(Failure::new(format!("`{}` holds an interrupted run", path.display()))
                .hint("go on with `--resume`, or replace the run with `--overwrite`"));
        }
        if !overwrite && path.join(MODEL).exists() {
            return Err(Failure::new(format!("`{}` already holds a run", path.display()))
                .hint("choose another directory with `--out`, or replace the run with `--overwrite`"));
        }
        let created = create_all(path)?;
        let run_dir = Self { path: path.to_owned(), created };
        tempfile::NamedTempFile::new_in(path).map_err(|e| cannot_write(path, e))?;
        Ok(run_dir)
    }

    /// Prepares the first free `runs/<name>-<n>` for a new run.
    ///
    /// # Errors
    /// When `runs` cannot be written.
    pub fn create_numbered(name: &str) -> Result<Self> {
        let mut n = 1;
        loop {
            let path = Path::new("runs").join(format!("{name}-{n}"));
            if !path.exists() {
                return Self::create(&path, false);
            }
            n += 1;
        }
    }

    /// The directory of a training that was interrupted.
    ///
    /// # Errors
    /// When it holds no checkpoint, or cannot be written.
    pub fn open_interrupted(path: &Path) -> Result<Self> {
        if checkpoints(path).is_empty() {
            let is_finished = path.join(MODEL).is_file();
            let why = if is_finished { "the run in it is finished" } else { "no run left one in it" };
            let how =
                if is_finished { "`--init` goes on from its model" } else { "without `--resume` a new run begins" };
            return Err(Failure::new(format!("`{}` holds no checkpoint: {why}", path.display())).hint(how));
        }
        Self::create(path, true)
    }

    /// A directory that holds a finished run.
    ///
    /// # Errors
    /// When there is no model in it.
    pub fn open(path: &Path) -> Result<Self> {
        let run_dir = Self { path: path.to_owned(), created: Vec::new() };
        if run_dir.model_path().is_file() {
            return Ok(run_dir);
        }
        Err(Failure::new(format!("`{}` holds no `{MODEL}`", path.display()))
            .hint("give a model file, or a directory that `gazesplat train` wrote"))
    }

    /// The directory.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// `point_cloud.ply`.
    pub fn model_path(&self) -> PathBuf {
        self.path.join(MODEL)
    }

    /// `settings.toml`.
    pub fn settings_path(&self) -> PathBuf {
        self.path.join("settings.toml")
    }

    /// `metrics.jsonl`.
    pub fn metrics_path(&self) -> PathBuf {
        self.path.join("metrics.jsonl")
    }

    /// `eval.json`.
    pub fn eval_path(&self) -> PathBuf {
        self.path.join("eval.json")
    }

    /// `unfinished.ply`: the last good model of a training that failed or is under way.
    pub fn unfinished_path(&self) -> PathBuf {
        self.path.join("unfinished.ply")
    }

    /// `poses.json`.
    pub fn poses_path(&self) -> PathBuf {
        self.path.join("poses.json")
    }

    /// `report.html`.
    pub fn report_path(&self) -> PathBuf {
        self.path.join("report.html")
    }

    /// Removes the files of the run that was here, so that none of them stands beside those of the next.
    ///
    /// # Errors
    /// When a file cannot be removed.
    pub fn clear(&self) -> Result<()> {
        let unfinished = self.unfinished_path();
        let files = [self.model_path(), self.eval_path(), self.report_path(), self.metrics_path(), unfinished];
        let checkpoints = checkpoints(&self.path).into_iter().map(|(_, path)| path);
        files
            .into_iter()
            .chain([self.settings_path(), self.poses_path()])
            .chain(checkpoints)
            .try_for_each(|file| remove(&file))
    }

    /// Writes `settings.toml`: the resolved settings as TOML under lines that say where they come from, and on which device the
    /// run computes, which is no setting: it is of the machine.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write_settings(&self, settings: &str, scene: &Path, device: &str) -> Result<()> {
        let text = format!(
            "# Resolved settings of a run of gazesplat {} on `{}`.\n# Computed on: {device}.\n\n{}",
            env!("CARGO_PKG_VERSION"),
            scene.display(),
            settings
        );
        write_text(&self.settings_path(), &text)
    }

    /// Writes `point_cloud.ply`, whose header names the program.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write_model(&self, cloud: &GaussianCloud) -> Result<()> {
        self.write_model_with(cloud, &[])
    }

    /// As [`RunDir::write_model`]; the header also holds `provenance`, a comment line each.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write_model_with(&self, cloud: &GaussianCloud, provenance: &[String]) -> Result<()> {
        let comments = [&[generator()], provenance].concat();
        Ok(gazesplat_core::io::ply::save_with_comments(self.model_path(), cloud, &comments)?)
    }

    /// Writes `unfinished.ply`, with the comment of a model that is trained for antialiased rendering.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub(crate) fn write_unfinished(&self, cloud: &GaussianCloud, antialiased: bool) -> Result<()> {
        let comments: Vec<String> = antialiased.then(|| ANTIALIASED_COMMENT.to_owned()).into_iter().collect();
        Ok(gazesplat_core::io::ply::save_with_comments(self.unfinished_path(), cloud, &comments)?)
    }

    /// Removes `unfinished.ply`, when the model itself is there.
    ///
    /// # Errors
    /// When it cannot be removed.
    pub(crate) fn remove_unfinished(&self) -> Result<()> {
        remove(&self.unfinished_path())
    }

    /// Writes `poses.json`.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write_poses(&self, views: &[gazesplat_core::View]) -> Result<()> {
        Ok(gazesplat_core::io::poses::save(self.poses_path(), views)?)
    }

    /// Writes `eval.json`.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write_eval(&self, report: &gazesplat_train::EvalReport) -> Result<()> {
        write_text(&self.eval_path(), &format!("{}\n", to_json(report)))
    }

    /// Writes `report.html`.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write_report(&self, html: &str) -> Result<()> {
        write_text(&self.report_path(), html)
    }

    /// Starts `metrics.jsonl`.
    ///
    /// # Errors
    /// When the file cannot be created.
    pub fn start_metrics(&self) -> Result<JsonLines> {
        JsonLines::create(self.metrics_path())
    }
}

impl Drop for RunDir {
    /// A run that stopped before it wrote anything leaves no empty directory; a directory with files stays.
    fn drop(&mut self) {
        for path in self.created.iter().rev() {
            if fs::remove_dir(path).is_err() {
                break;
            }
        }
    }
}

const MODEL: &str = "point_cloud.ply";

/// The comment line of every PLY file of this program.
pub(crate) fn generator() -> String {
    format!("Generated by gazesplat {}", env!("CARGO_PKG_VERSION"))
}

/// Removes a file that may not be there.
pub(crate) fn remove(file: &Path) -> Result<()> {
    match fs::remove_file(file) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(cannot_write(file, e)),
        _ => Ok(()),
    }
}

/// The checkpoint of step `step` in a run directory.
pub(crate) fn checkpoint_path(dir: &Path, step: u32) -> PathBuf {
    dir.join(format!("{CHECKPOINT_PREFIX}{step}{CHECKPOINT_SUFFIX}"))
}

/// Steps and files of the checkpoints in `dir`, the latest first.
pub(crate) fn checkpoints(dir: &Path) -> Vec<(u32, PathBuf)> {
    let entries = fs::read_dir(dir).into_iter().flatten().flatten();
    let checkpoint = |entry: fs::DirEntry| {
        let name = entry.file_name().into_string().ok()?;
        let step = name.strip_prefix(CHECKPOINT_PREFIX)?.strip_suffix(CHECKPOINT_SUFFIX)?.parse().ok()?;
        Some((step, entry.path()))
    };
    let mut found: Vec<_> = entries.filter_map(checkpoint).collect();
    found.sort_by_key(|(step, _)| std::cmp::Reverse(*step));
    found
}

const CHECKPOINT_PREFIX: &str = "checkpoint-";
const CHECKPOINT_SUFFIX: &str = ".safetensors";

/// Indented JSON of a value of ours.
pub(crate) fn to_json(value: &impl Serialize) -> String {
    serde_json::to_string_pretty(value).expect("our reports are plain numbers and text")
}

/// Writes a text file under a temporary name and renames it, so that a reader never sees half of it.
pub(crate) fn write_text(path: &Path, text: &str) -> Result<()> {
    Ok(gazesplat_core::io::write_atomically(path, |file| file.write_all(text.as_bytes()))?)
}

/// Makes `path` and its missing parents; returns those that were made, outermost first.
pub(crate) fn create_all(path: &Path) -> Result<Vec<PathBuf>> {
    let mut created: Vec<PathBuf> =
        path.ancestors().filter(|p| !p.as_os_str().is_empty() && !p.exists()).map(Path::to_owned).collect();
    created.reverse();
    fs::create_dir_all(path).map_err(|e| cannot_write(path, e))?;
    Ok(created)
}

/// The refusal to write at `path`, with what to do.
pub(crate) fn cannot_write(path: &Path, error: std::io::Error) -> Failure {
    Failure::io("write", path, error).hint("choose a place that can be written with `--out`")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unused_run_leaves_no_directory() {
        let root = tempfile::tempdir().expect("temporary directory");
        let path = root.path().join("a/b");
        drop(RunDir::create(&path, false).expect("writable"));
        assert!(!root.path().join("a").exists());
    }

    #[test]
    fn finished_run_is_not_replaced_unasked() {
        let root = tempfile::tempdir().expect("temporary directory");
        fs::write(root.path().join(MODEL), b"ply").expect("writable");
        let failure = RunDir::create(root.path(), false).expect_err("must be refused");
        assert!(failure.report(false).contains("--overwrite"));
        let run_dir = RunDir::create(root.path(), true).expect("asked for");
        assert!(root.path().join(MODEL).exists(), "the old run stays until the next has passed its checks");
        fs::write(root.path().join("mine.txt"), b"notes").expect("writable");
        run_dir.clear().expect("writable");
        assert!(!root.path().join(MODEL).exists() && root.path().join("mine.txt").exists());
    }
}
