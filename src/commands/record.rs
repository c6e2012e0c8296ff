//! Keeps what happens during a training: every logged step into `metrics.jsonl`, the same for the report.

use crate::report::StepPoint;
use crate::run_dir::MetricsLog;
use gazesplat_train::{EvalReport, Observer, StageMs, StepReport, TrainEvent};
use serde::Serialize;
use std::collections::BTreeMap;

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
    /// Milliseconds by stage.
    step_ms: StageMs,
    /// Quality on the test views, in the steps after which it was measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    test: Option<TestScore>,
    #[serde(skip)]
    is_logged: bool,
}

#[derive(Debug, Serialize)]
struct TestScore {
    psnr: f64,
    ssim: f64,
}

/// The observer that remembers.
#[derive(Debug)]
pub(crate) struct Recorder {
    log: MetricsLog,
    log_every: u32,
    /// The latest step: written when the next one comes, since its test score comes after it.
    pending: Option<Record>,
    num_steps: u32,
    stage_sum_ms: [f64; NUM_STAGES],
    last_evaluation: Option<(u32, EvalReport)>,
    /// Logged steps.
    pub(crate) steps: Vec<StepPoint>,
    /// (step, dB) of every measurement on the way.
    pub(crate) test_psnr: Vec<(u32, f64)>,
}

impl Recorder {
    /// Records every `log_every`-th step into `log`.
    pub(crate) fn new(log: MetricsLog, log_every: u32) -> Self {
        Self {
            log,
            log_every,
            pending: None,
            num_steps: 0,
            stage_sum_ms: [0.0; NUM_STAGES],
            last_evaluation: None,
            steps: Vec::new(),
            test_psnr: Vec::new(),
        }
    }

    /// Mean milliseconds per step by stage.
    pub(crate) fn mean_stages(&self) -> Vec<(String, f64)> {
        let n = f64::from(self.num_steps.max(1));
        STAGES.iter().zip(self.stage_sum_ms).map(|((name, _), ms)| ((*name).to_owned(), ms / n)).collect()
    }

    fn step(&mut self, report: &StepReport) -> crate::Result<()> {
        self.flush()?;
        self.num_steps += 1;
        for ((_, ms), sum) in STAGES.iter().zip(&mut self.stage_sum_ms) {
            *sum += f64::from(ms(&report.stage_ms));
        }
        let is_logged = report.is_logged(self.log_every);
        if is_logged {
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
            step_ms: report.stage_ms,
            test: None,
            is_logged,
        });
        Ok(())
    }

    fn evaluated(&mut self, report: &EvalReport, step: u32) {
        self.test_psnr.push((step, report.psnr));
        self.last_evaluation = Some((step, report.clone()));
        if let Some(record) = &mut self.pending {
            record.test = Some(TestScore { psnr: report.psnr, ssim: report.ssim });
        }
    }

    /// What was measured after exactly `step` steps, if it was.
    pub(crate) fn take_evaluation(&mut self, step: u32) -> Option<EvalReport> {
        self.last_evaluation.take().filter(|(measured, _)| *measured == step).map(|(_, report)| report)
    }

    /// Writes the latest step, if it is one to log.
    pub(crate) fn flush(&mut self) -> crate::Result<()> {
        let Some(record) = self.pending.take() else { return Ok(()) };
        if record.is_logged || record.test.is_some() {
            self.steps.push(StepPoint { step: record.step, loss: record.loss, num_gaussians: record.num_gaussians });
            self.log.append(&record)?;
        }
        Ok(())
    }
}

impl Observer for Recorder {
    fn on_event(&mut self, event: &TrainEvent<'_>) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
        match event {
            TrainEvent::Step(report) => self.step(report)?,
            TrainEvent::Evaluated { report, step } => self.evaluated(report, *step),
            TrainEvent::Densified { step, report } => tracing::info!(
                "step {step}: {} added, {} relocated, {} of them broken, {} Gaussians",
                report.num_added,
                report.num_relocated + report.num_relocated_broken,
                report.num_relocated_broken,
                report.num_gaussians
            ),
            TrainEvent::Finished { .. } => self.flush()?,
            _ => {}
        }
        Ok(())
    }
}
