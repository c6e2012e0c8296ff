//! What a training run tells the outside.

use crate::evaluate::EvalReport;
use crate::losses::LossTerms;
use serde::Serialize;

/// Milliseconds spent in the stages of one step; on a GPU to queue their work, and to wait where something is read back.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct StageMs {
    /// Getting the photograph (decoding, when it was not in memory).
    pub image: f32,
    /// Rendering.
    pub forward: f32,
    /// The loss and its gradient by the image.
    pub loss: f32,
    /// Gradients by the parameters.
    pub backward: f32,
    /// Regularisers and Adam.
    pub optim: f32,
    /// Noise, relocation, growth.
    pub densify: f32,
    /// The whole step.
    pub total: f32,
}

/// What one step did.
#[derive(Debug, Clone, PartialEq)]
pub struct StepReport {
    /// Number of the step, counted from 1.
    pub step: u32,
    /// Steps of the whole run.
    pub num_steps: u32,
    /// The image loss that was minimised, and all terms, unweighted: those of the image, then the regularisers. On a GPU
    /// only in the steps that [`crate::config::TrainSection::is_reported`]: reading them waits for the device.
    pub losses: Option<LossTerms>,
    /// Gaussians after the step.
    pub num_gaussians: usize,
    /// SH degree that was rendered.
    pub sh_degree: u32,
    /// Where the time went.
    pub stage_ms: StageMs,
    /// Name of the view.
    pub view: String,
    /// What densification did, when it was its turn.
    pub densified: Option<DensifyReport>,
}

/// What a change in the number or places of Gaussians did.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct DensifyReport {
    /// Transparent Gaussians that were moved to live ones.
    pub num_relocated: usize,
    /// Gaussians that were moved because a parameter was not finite, or they were beyond any plausible size or distance.
    pub num_relocated_broken: usize,
    /// Gaussians added.
    pub num_added: usize,
    /// Gaussians afterwards.
    pub num_gaussians: usize,
}

/// An event of a run.
#[derive(Debug, Clone, Copy)]
pub enum TrainEvent<'a> {
    /// Something a person should know: how the model was initialised, what was left out.
    Message(&'a str),
    /// Photographs are being decoded before the first step.
    LoadingImages {
        /// Decoded so far.
        num_done: usize,
        /// To decode.
        num_total: usize,
    },
    /// The loop begins.
    Started {
        /// Steps of the whole run.
        num_steps: u32,
        /// First Gaussians.
        num_gaussians: usize,
        /// Training views.
        num_train: usize,
        /// Test views.
        num_test: usize,
    },
    /// The next step sees images of another size than the one before: of a part of theirs at the beginning of a run from
    /// coarse to fine, and of all of it later.
    Resolution {
        /// Number of that step, counted from 1.
        step: u32,
        /// How often the sides of the images are halved.
        num_halvings: u32,
        /// Width and height of the first view, pixels.
        size: [u32; 2],
    },
    /// A step is done. Sent for every step; logs take those that [`StepReport::is_logged`] accepts.
    Step(&'a StepReport),
    /// Gaussians were relocated or added.
    Densified {
        /// Number of the step, counted from 1.
        step: u32,
        /// What was done.
        report: &'a DensifyReport,
    },
    /// The test views were measured.
    Evaluated {
        /// Steps done.
        step: u32,
        /// The result.
        report: &'a EvalReport,
    },
    /// The loop is over.
    Finished {
        /// Steps done.
        step: u32,
        /// Final number of Gaussians.
        num_gaussians: usize,
    },
}

impl StepReport {
    /// Whether a log that takes every `log_every`-th step takes this one: multiples, the first and the last.
    pub fn is_logged(&self, log_every: u32) -> bool {
        is_logged(self.step, self.num_steps, log_every)
    }
}

/// [`StepReport::is_logged`] before there is a report.
pub(crate) fn is_logged(step: u32, num_steps: u32, log_every: u32) -> bool {
    step == 1 || step == num_steps || step.is_multiple_of(log_every.max(1))
}

/// Something that follows a run: progress bars, logs, reports.
pub trait Observer {
    /// Called for every event, in order.
    ///
    /// # Errors
    /// Anything that should stop the run, as a log that cannot be written.
    fn on_event(&mut self, event: &TrainEvent<'_>) -> Result<(), Box<dyn std::error::Error + Send + Sync>>;
}
