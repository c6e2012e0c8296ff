//! The checkpoints of a training in its run directory: written on the way, taken up by `--resume`, gone when it is finished.

use crate::diagnostics::{Failure, Result};
use crate::json_lines::JsonLines;
use crate::run_dir::{RunDir, checkpoint_path, checkpoints, remove};
use gazesplat_core::Dataset;
use gazesplat_core::io::images::ImageCache;
use gazesplat_render::device::Device;
use gazesplat_train::checkpoint::differences;
use gazesplat_train::{Config, Error, Trainer};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Settings of this program that change nothing of the model.
const FREE: &[&str] = &["loss.hvsq.cache_mb", "eval.lpips_weights"];

/// What this program finds again in a checkpoint.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Noted {
    /// Settings beside those of the library, and which model the run began with: both have to be the same again.
    beside: serde_json::Value,
    /// Where the run computed.
    device: String,
    /// Bytes of `metrics.jsonl` that belong to the checkpoint: what was written after it is written again.
    metrics_bytes: u64,
    /// Seconds of training.
    elapsed_s: f64,
}

/// Writes the checkpoints of one run.
#[derive(Debug)]
pub(crate) struct Checkpoints {
    dir: PathBuf,
    keep: usize,
    beside: serde_json::Value,
    device: String,
    started: Instant,
    earlier: Duration,
}

/// A run that goes on.
pub(crate) struct Resumed {
    pub trainer: Trainer,
    /// The report, cut to what the checkpoint knows of.
    pub metrics: JsonLines,
    /// Training time before the interruption.
    pub earlier: Duration,
    /// What a person should know about it.
    pub warning: Option<String>,
}

impl Checkpoints {
    /// Those of a run in `run_dir`. `beside` is what has to be the same again beside the settings of the library.
    pub fn new(run_dir: &RunDir, config: &Config, beside: serde_json::Value, device: String) -> Self {
        Self {
            dir: run_dir.path().to_owned(),
            keep: config.train.checkpoint_keep as usize,
            beside,
            device,
            started: Instant::now(),
            earlier: Duration::ZERO,
        }
    }

    /// Training begins, or goes on after `earlier`.
    pub fn start(&mut self, earlier: Duration) {
        (self.started, self.earlier) = (Instant::now(), earlier);
    }

    /// Writes the state of `trainer`; then those go that are older than the latest few, or later than this one.
    ///
    /// # Errors
    /// When the device does not answer or the disk refuses; what was there is then still there.
    pub fn save(&self, trainer: &mut Trainer, metrics: &Path) -> Result<()> {
        let step = trainer.step_index();
        let metrics_bytes = std::fs::metadata(metrics).map_err(|e| Failure::io("read", metrics, e))?.len();
        let elapsed_s = (self.earlier + self.started.elapsed()).as_secs_f64();
        let noted = Noted { beside: self.beside.clone(), device: self.device.clone(), metrics_bytes, elapsed_s };
        trainer.save(&checkpoint_path(&self.dir, step), &noted)?;
        let (mine, later): (Vec<_>, Vec<_>) = checkpoints(&self.dir).into_iter().partition(|(at, _)| *at <= step);
        // Later ones are of the way that a run took before it went back to an earlier one.
        mine.iter().skip(self.keep).chain(&later).try_for_each(|(_, path)| remove(path))
    }

    /// Takes the run up at the checkpoint of step `from`, or at the latest one. Until the trainer stands, nothing is changed.
    ///
    /// # Errors
    /// When there is no such checkpoint, or it is damaged, or of another run.
    pub fn resume(
        &self,
        from: Option<u32>,
        dataset: &Dataset,
        images: Arc<ImageCache>,
        config: &Config,
        device: &Device,
        metrics: PathBuf,
    ) -> Result<Resumed> {
        let found = checkpoints(&self.dir);
        let steps: Vec<String> = found.iter().map(|(step, _)| step.to_string()).collect();
        let Some((step, path)) = found.iter().find(|(step, _)| from.is_none_or(|from| from == *step)) else {
            let message = format!("`{}` holds no checkpoint of step {}", self.dir.display(), from.unwrap_or(0));
            return Err(Failure::new(message).hint(format!("there are those of steps {}", steps.join(", "))));
        };
        let earlier = found.iter().map(|(step, _)| step).find(|other| *other < step);
        let refused = |error: Error| {
            let failure = Failure::from(error);
            match earlier {
                Some(step) => failure.hint_first(format!("`--resume={step}` goes on from the checkpoint before")),
                None => failure,
            }
        };
        let (trainer, noted): (_, Noted) = Trainer::resume(dataset, images, config, device, path).map_err(refused)?;
        let differences = differences(&noted.beside, &self.beside, FREE);
        if !differences.is_empty() {
            let message = format!("its settings differ: {}", differences.join(", "));
            return Err(refused(Error::Checkpoint { path: path.clone(), message }));
        }
        let warning = (noted.device != self.device).then(|| {
            format!("the run computed on {} before, now on {}: results differ in rounding", noted.device, self.device)
        });
        let metrics = JsonLines::go_on(metrics, noted.metrics_bytes)?;
        Ok(Resumed { trainer, metrics, earlier: Duration::from_secs_f64(noted.elapsed_s.clamp(0.0, 1e9)), warning })
    }

    /// Removes them all.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn clear(&self) -> Result<()> {
        checkpoints(&self.dir).iter().try_for_each(|(_, path)| remove(path))
    }
}
