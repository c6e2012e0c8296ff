//! What a training run tells the outside.

use crate::evaluate::EvalReport;
use crate::losses::LossTerms;
use serde::{Deserialize, Serialize};
use std::fmt;

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
    /// What densification did since the run began.
    pub totals: DensifyReport,
}

/// Gaussians that no viewer can do anything with, each counted under the first reason that applies.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct BrokenCounts {
    /// A value is not finite.
    pub non_finite: usize,
    /// A standard deviation is larger than anything a scene holds.
    pub huge: usize,
    /// The centre is farther away than anything a scene shows.
    pub far: usize,
}

impl BrokenCounts {
    /// All of them.
    pub fn total(&self) -> usize {
        self.non_finite + self.huge + self.far
    }
}

/// `2 not finite, 1 huge`: the reasons that apply.
impl fmt::Display for BrokenCounts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let named = [(self.non_finite, "not finite"), (self.huge, "huge"), (self.far, "far away")];
        let mut separator = "";
        for (count, name) in named.into_iter().filter(|(count, _)| *count > 0) {
            write!(f, "{separator}{count} {name}")?;
            separator = ", ";
        }
        Ok(())
    }
}

/// What a change in the number or places of Gaussians did, or several of them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DensifyReport {
    /// Transparent Gaussians that were moved to live ones (MCMC).
    pub num_relocated: usize,
    /// Gaussians that were removed, or moved to live ones (MCMC), because nothing could be done with them.
    pub broken: BrokenCounts,
    /// Gaussians removed because hardly anything is seen of them (ADC).
    pub num_transparent: usize,
    /// Gaussians removed because they are large for the scene (ADC).
    pub num_large: usize,
    /// Gaussians copied to where they are (ADC).
    pub num_cloned: usize,
    /// Gaussians replaced by two smaller ones (ADC).
    pub num_split: usize,
    /// Gaussians added by any of these.
    pub num_added: usize,
    /// Times that all opacities were lowered (ADC).
    pub num_opacity_resets: usize,
    /// Gaussians afterwards.
    pub num_gaussians: usize,
}

impl DensifyReport {
    /// Adds what a later change did.
    pub fn add(&mut self, later: &Self) {
        self.num_relocated += later.num_relocated;
        self.broken.non_finite += later.broken.non_finite;
        self.broken.huge += later.broken.huge;
        self.broken.far += later.broken.far;
        self.num_transparent += later.num_transparent;
        self.num_large += later.num_large;
        self.num_cloned += later.num_cloned;
        self.num_split += later.num_split;
        self.num_added += later.num_added;
        self.num_opacity_resets += later.num_opacity_resets;
        self.num_gaussians = later.num_gaussians;
    }
}

/// `12 added (8 cloned, 4 split), 3 transparent removed, 1 broken (1 huge), 96 Gaussians`: what happened, the rest left out.
impl fmt::Display for DensifyReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} added", self.num_added)?;
        if self.num_cloned + self.num_split > 0 {
            write!(f, " ({} cloned, {} split)", self.num_cloned, self.num_split)?;
        }
        let named = [
            (self.num_relocated, "relocated"),
            (self.num_transparent, "transparent removed"),
            (self.num_large, "large removed"),
        ];
        for (count, name) in named.into_iter().filter(|(count, _)| *count > 0) {
            write!(f, ", {count} {name}")?;
        }
        if self.broken.total() > 0 {
            write!(f, ", {} broken ({})", self.broken.total(), self.broken)?;
        }
        if self.num_opacity_resets > 0 {
            f.write_str(", opacities lowered")?;
        }
        write!(f, ", {} Gaussians", self.num_gaussians)
    }
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
    /// Gaussians were relocated, added or removed.
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
