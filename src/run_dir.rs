//! A run directory: everything one training leaves behind, each file complete or absent.
//!
//! | file | content |
//! |---|---|
//! | `settings.toml` | resolved settings with the seed |
//! | `metrics.jsonl` | one JSON object per logged step, appended as the run goes |
//! | `point_cloud.ply` | the model, 3DGS layout |
//! | `eval.json` | test-view quality |
//! | `report.html` | all of it to look at |
//! | `unfinished.ply` | only of a training that failed, or is under way on a GPU: its last good model |

use crate::diagnostics::{Failure, Result};
use crate::settings;
use gazesplat_core::GaussianCloud;
use gazesplat_train::Config;
use serde::Serialize;
use std::fs;
use std::io::{BufWriter, Write};
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
    /// When `path` already holds a model and `overwrite` is false, when it is a file, or when it cannot be written.
    pub fn create(path: &Path, overwrite: bool) -> Result<Self> {
        if path.is_file() {
            return Err(Failure::new(format!("`{}` is a file, expected a directory", path.display()))
                .hint("choose another directory with `--out`"));
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
            .hint("give a PLY file, or a directory that `gazesplat train` wrote"))
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
        files.into_iter().chain([self.settings_path()]).try_for_each(|file| remove(&file))
    }

    /// Writes `settings.toml`: the resolved settings under lines that say where they come from, and on which device the
    /// run computes, which is no setting: it is of the machine.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write_settings(&self, config: &Config, scene: &Path, device: &str) -> Result<()> {
        let text = format!(
            "# Resolved settings of a run of gazesplat {} on `{}`.\n# Computed on: {device}.\n\n{}",
            env!("CARGO_PKG_VERSION"),
            scene.display(),
            settings::to_toml(config)
        );
        write_text(&self.settings_path(), &text)
    }

    /// Writes `point_cloud.ply`.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write_model(&self, cloud: &GaussianCloud) -> Result<()> {
        Ok(gazesplat_core::io::ply::save(self.model_path(), cloud)?)
    }

    /// Writes `unfinished.ply`.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub(crate) fn write_unfinished(&self, cloud: &GaussianCloud) -> Result<()> {
        Ok(gazesplat_core::io::ply::save(self.unfinished_path(), cloud)?)
    }

    /// Removes `unfinished.ply`, when the model itself is there.
    ///
    /// # Errors
    /// When it cannot be removed.
    pub(crate) fn remove_unfinished(&self) -> Result<()> {
        remove(&self.unfinished_path())
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
    pub fn start_metrics(&self) -> Result<MetricsLog> {
        let path = self.metrics_path();
        let file = fs::File::create(&path).map_err(|e| cannot_write(&path, e))?;
        Ok(MetricsLog { path, writer: BufWriter::new(file) })
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

/// Removes a file that may not be there.
fn remove(file: &Path) -> Result<()> {
    match fs::remove_file(file) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(cannot_write(file, e)),
        _ => Ok(()),
    }
}

/// The growing `metrics.jsonl`. The one file that is appended to: whole lines, flushed, so that it can be followed.
#[derive(Debug)]
pub struct MetricsLog {
    path: PathBuf,
    writer: BufWriter<fs::File>,
}

impl MetricsLog {
    /// Appends one object as a line and flushes it.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn append(&mut self, record: &impl Serialize) -> Result<()> {
        let mut line = serde_json::to_vec(record).expect("metrics are plain numbers and text");
        line.push(b'\n');
        self.writer.write_all(&line).and_then(|()| self.writer.flush()).map_err(|e| cannot_write(&self.path, e))
    }
}

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
