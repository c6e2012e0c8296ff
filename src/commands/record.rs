//! Keeps what happens during a training: every logged step into `metrics.jsonl`, the same for the report.

use super::keeper::Follower;
use crate::console::{bytes, grouped};
use crate::json_lines::JsonLines;
use crate::memory::peak_resident_bytes;
use crate::report::StepPoint;
use gazesplat_core::io::images::ImageCache;
use gazesplat_train::{DensifyReport, EvalReport, Observer, StageMs, StepReport, TrainEvent};
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::Arc;

/// A stage's name and where its time is found.
type Stage = (&'static str, fn(&StageMs) -> f32);

/// The stages of a step in the order of execution, and where their time is found.
const STAGES: [Stage; NUM_STAGES] = [
    ("image", |s| s.image),
    ("forward", |s| s.forward),
    ("loss", |s| s.loss),
    ("backward", |s| s.backward),
    ("optimiser", |s| s.optim),
    ("densification", |s| s.densify),
];
const NUM_STAGES: usize = 6;

/// One line of `metrics.jsonl`.
#[derive(Debug, Serialize)]
struct Record {
    /// Steps done, from 1.
    step: u32,
    /// Total loss of this step's view.
    loss: f32,
    /// Mean absolute difference of the channels.
    l1: f32,
    /// SSIM, 1 for equal images.
    ssim: f32,
    /// Every term by name, unweighted, the regularisers among them.
    terms: BTreeMap<&'static str, f32>,
    /// Gaussians after the step.
    num_gaussians: usize,
    /// What densification did since the run began, by kind and reason.
    densified: DensifyReport,
    /// Milliseconds of the step.
    step_ms: StepMs,
    /// Memory when the line was written.
    #[serde(skip_serializing_if = "Option::is_none")]
    memory: Option<MemoryFigures>,
    /// Quality on the test views, in the steps after which it was measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    test: Option<TestScore>,
    #[serde(skip)]
    is_logged: bool,
}

/// Where the time of a step went, as far as it can be told.
#[derive(Debug, Clone, Copy, Serialize)]
#[serde(untagged)]
enum StepMs {
    /// On the CPU: its stages.
    Stages(StageMs),
    /// On a GPU, where stages are queued long before they are done: the mean of the steps since the line before. A step
    /// with a line waits for all of them.
    Total { total: f64 },
}

#[derive(Debug, Serialize)]
struct TestScore {
    psnr: f64,
    ssim: f64,
}

/// Where the memory of a run is looked up.
#[derive(Debug, Clone)]
pub(crate) struct Memory(pub Arc<ImageCache>);

/// Memory of a run: what its images take, and what the process has taken at most.
#[derive(Debug, Clone, Copy, Serialize)]
struct MemoryFigures {
    /// Bytes of decoded images that are held.
    image_bytes: usize,
    /// The most that were held and being decoded so far.
    image_bytes_peak: usize,
    /// Requests for images that were answered from memory.
    image_hits: u64,
    /// Images that were decoded.
    image_misses: u64,
    /// The most memory the process has had resident, bytes; `null` where the system does not tell.
    peak_resident_bytes: Option<u64>,
}

impl Memory {
    fn now(&self) -> MemoryFigures {
        let stats = self.0.stats();
        MemoryFigures {
            image_bytes: stats.num_bytes,
            image_bytes_peak: stats.peak_bytes,
            image_hits: stats.num_hits,
            image_misses: stats.num_misses,
            peak_resident_bytes: peak_resident_bytes(),
        }
    }

    /// The figures as a line for people.
    pub(crate) fn figures(&self) -> String {
        let MemoryFigures { image_bytes_peak, image_hits, image_misses, peak_resident_bytes, .. } = self.now();
        let budget = bytes(self.0.stats().byte_budget as u64);
        let peak = peak_resident_bytes.map_or_else(String::new, |peak| format!("at most {}, ", bytes(peak)));
        format!(
            "memory: {peak}images up to {} of {budget}, {} decoded, {} found in memory",
            bytes(image_bytes_peak as u64),
            grouped(image_misses as usize),
            grouped(image_hits as usize)
        )
    }
}

/// The observer that remembers.
#[derive(Debug)]
pub(crate) struct Recorder {
    log: JsonLines,
    log_every: u32,
    is_gpu: bool,
    /// The latest step: written when the next one comes, since its test score comes after it.
    pending: Option<Record>,
    num_steps: u32,
    stage_sum_ms: [f64; NUM_STAGES],
    total_sum_ms: f64,
    /// Steps since the last line, and their milliseconds.
    unwritten: (u32, f64),
    memory: Option<Memory>,
    /// Logged steps.
    pub(crate) steps: Vec<StepPoint>,
    /// (step, dB) of every measurement on the way.
    pub(crate) test_psnr: Vec<(u32, f64)>,
}

impl Recorder {
    /// Records every `log_every`-th step into `log`; on a GPU without the times of stages.
    pub(crate) fn new(log: JsonLines, log_every: u32, is_gpu: bool) -> Self {
        Self {
            log,
            log_every,
            is_gpu,
            pending: None,
            num_steps: 0,
            stage_sum_ms: [0.0; NUM_STAGES],
            total_sum_ms: 0.0,
            unwritten: (0, 0.0),
            memory: None,
            steps: Vec::new(),
            test_psnr: Vec::new(),
        }
    }

    /// Writes the figures of `memory` beside those of the steps.
    pub(crate) fn watching(self, memory: Memory) -> Self {
        Self { memory: Some(memory), ..self }
    }

    /// Remembers what stands in the log of a run that goes on: loss, Gaussians and quality; times are those of this part.
    pub(crate) fn recall(&mut self) -> crate::Result<()> {
        let path = self.log.path();
        let text = std::fs::read_to_string(path).map_err(|e| crate::Failure::io("read", path, e))?;
        for line in text.lines().filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok()) {
            let step = line["step"].as_u64().and_then(|step| u32::try_from(step).ok());
            let (Some(step), Some(loss), Some(num)) = (step, line["loss"].as_f64(), line["num_gaussians"].as_u64())
            else {
                continue;
            };
            self.steps.push(StepPoint { step, loss: loss as f32, num_gaussians: num as usize });
            self.test_psnr.extend(line["test"]["psnr"].as_f64().map(|psnr| (step, psnr)));
        }
        Ok(())
    }

    /// Mean milliseconds per step.
    pub(crate) fn mean_step_ms(&self) -> f64 {
        self.total_sum_ms / f64::from(self.num_steps.max(1))
    }

    /// Mean milliseconds per step by stage; none on a GPU.
    pub(crate) fn mean_stages(&self) -> Vec<(String, f64)> {
        if self.is_gpu {
            return Vec::new();
        }
        let n = f64::from(self.num_steps.max(1));
        STAGES.iter().zip(self.stage_sum_ms).map(|((name, _), ms)| ((*name).to_owned(), ms / n)).collect()
    }

    fn step(&mut self, report: &StepReport) -> crate::Result<()> {
        self.flush()?;
        self.num_steps += 1;
        for ((_, ms), sum) in STAGES.iter().zip(&mut self.stage_sum_ms) {
            *sum += f64::from(ms(&report.stage_ms));
        }
        let total_ms = f64::from(report.stage_ms.total);
        self.total_sum_ms += total_ms;
        self.unwritten = (self.unwritten.0 + 1, self.unwritten.1 + total_ms);
        let step_ms = match self.is_gpu {
            true => StepMs::Total { total: self.unwritten.1 / f64::from(self.unwritten.0) },
            false => StepMs::Stages(report.stage_ms),
        };
        let is_logged = report.is_logged(self.log_every);
        if let StepMs::Total { total } = step_ms
            && is_logged
        {
            tracing::debug!("step {} on `{}`, {total:.2} ms on average", report.step, report.view);
        } else if is_logged {
            let stages = || STAGES.iter().map(|(name, ms)| format!("{name} {:.2}", ms(&report.stage_ms)));
            tracing::debug!(
                "step {} on `{}`, ms: {}",
                report.step,
                report.view,
                stages().collect::<Vec<_>>().join(", ")
            );
        }
        // Steps that are logged or measured have their losses on every device.
        self.pending = report.losses.as_ref().map(|losses| Record {
            step: report.step,
            loss: losses.total,
            l1: losses.get("l1").unwrap_or(f32::NAN),
            ssim: losses.get("ssim").unwrap_or(f32::NAN),
            terms: losses.terms.iter().map(|term| (term.name, term.value)).collect(),
            num_gaussians: report.num_gaussians,
            densified: report.totals,
            step_ms,
            memory: None,
            test: None,
            is_logged,
        });
        Ok(())
    }

    fn evaluated(&mut self, report: &EvalReport, step: u32) {
        self.test_psnr.push((step, report.psnr));
        if let Some(record) = &mut self.pending {
            record.test = Some(TestScore { psnr: report.psnr, ssim: report.ssim });
        }
    }

    /// Writes the latest step, if it is one to log.
    pub(crate) fn flush(&mut self) -> crate::Result<()> {
        let Some(mut record) = self.pending.take() else { return Ok(()) };
        if record.is_logged || record.test.is_some() {
            self.steps.push(StepPoint { step: record.step, loss: record.loss, num_gaussians: record.num_gaussians });
            record.memory = self.memory.as_ref().map(Memory::now);
            self.log.append(&record)?;
            self.unwritten = (0, 0.0);
        }
        Ok(())
    }
}

impl Observer for Recorder {
    fn on_event(&mut self, event: &TrainEvent<'_>) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
        match event {
            TrainEvent::Step(report) => self.step(report)?,
            TrainEvent::Evaluated { report, step } => self.evaluated(report, *step),
            TrainEvent::Densified { step, report } => tracing::info!("step {step}: {report}"),
            TrainEvent::Finished { .. } => self.flush()?,
            _ => {}
        }
        Ok(())
    }
}

impl Follower for Recorder {
    fn catch_up(&mut self) -> crate::Result<()> {
        self.flush()?;
        self.log.sync()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run_dir::RunDir;
    use gazesplat_train::losses::LossTerms;
    use serde_json::{Value, json};

    fn step(step: u32, total: f32) -> StepReport {
        StepReport {
            step,
            num_steps: 6,
            losses: Some(LossTerms { total: 0.5, terms: Vec::new() }),
            num_gaussians: 7,
            sh_degree: 0,
            stage_ms: StageMs { forward: 0.25, total, ..StageMs::default() },
            view: "a".to_owned(),
            densified: None,
            totals: DensifyReport::default(),
        }
    }

    /// What is recorded of steps 1 to 6, of which 1 and every second are logged: `step_ms` of each line.
    fn recorded(is_gpu: bool) -> (Recorder, Vec<Value>) {
        let dir = tempfile::tempdir().expect("temporary directory");
        let run_dir = RunDir::create(dir.path(), false).expect("writable");
        let mut recorder = Recorder::new(run_dir.start_metrics().expect("writable"), 2, is_gpu);
        for (index, total) in (1..).zip([8.0, 1.0, 3.0, 1.0, 5.0, 6.0]) {
            recorder.on_event(&TrainEvent::Step(&step(index, total))).expect("writable");
        }
        recorder.flush().expect("writable");
        let lines = std::fs::read_to_string(run_dir.metrics_path()).expect("readable");
        let step_ms = |line| serde_json::from_str::<Value>(line).expect("JSON")["step_ms"].take();
        let step_ms = lines.lines().map(step_ms).collect();
        (recorder, step_ms)
    }

    #[test]
    fn steps_on_a_gpu_have_a_mean_and_no_stages() {
        let (recorder, step_ms) = recorded(true);
        let means = [8.0, 1.0, 2.0, 5.5].map(|total| json!({ "total": total }));
        assert_eq!(step_ms, means);
        assert!(recorder.mean_stages().is_empty());
        assert_eq!(recorder.mean_step_ms(), 4.0);
    }

    #[test]
    fn steps_on_the_cpu_have_their_stages() {
        let (recorder, step_ms) = recorded(false);
        assert!(step_ms.len() == 4 && step_ms[3]["total"] == 6.0 && step_ms[3]["forward"] == 0.25, "{step_ms:?}");
        assert_eq!((recorder.mean_stages()[1].1, recorder.mean_step_ms()), (0.25, 4.0));
    }
}
