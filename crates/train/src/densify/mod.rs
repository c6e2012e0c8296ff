//! How the number and the places of Gaussians change during training: one paper per file.

pub mod mcmc;
pub mod relocation;

pub use mcmc::Mcmc;

use crate::error::Result;
use crate::event::DensifyReport;
use crate::optim::{ModelState, Regularizers};

/// Where a run stands, for a strategy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepContext {
    /// Number of the step, counted from 1.
    pub step: u32,
    /// Seed of the run.
    pub seed: u64,
    /// Learning rate of the means in this step, world units.
    pub means_lr: f32,
}

/// A way to place Gaussians where they are needed. It acts through the operations of [`ModelState`], so that it works
/// wherever the model lives.
pub trait Strategy: Send {
    /// Terms it adds to the loss.
    fn regularizers(&self) -> Regularizers;

    /// Called after the optimiser's update. A report means that the step was one at which rows may have changed.
    ///
    /// # Errors
    /// As the operations it uses.
    fn after_update(&mut self, state: &mut ModelState, context: &StepContext) -> Result<Option<DensifyReport>>;
}

/// No densification: the initial Gaussians are only optimised.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fixed;

impl Strategy for Fixed {
    fn regularizers(&self) -> Regularizers {
        Regularizers::default()
    }

    fn after_update(&mut self, _state: &mut ModelState, _context: &StepContext) -> Result<Option<DensifyReport>> {
        Ok(None)
    }
}
