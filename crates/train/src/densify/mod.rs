//! How the number and the places of Gaussians change during training: one paper per file.

pub mod mcmc;
mod noise;
pub mod relocation;

pub use mcmc::Mcmc;

use crate::event::DensifyReport;
use crate::losses::LossTerm;
use crate::optim::{Columns, Optimized};

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

/// A way to place Gaussians where they are needed.
pub trait Strategy: Send {
    /// Adds the gradients of regularisers to `grads`, before the optimiser's update, and reports their values.
    fn regularize(&mut self, params: &Columns, grads: &mut Columns) -> Vec<LossTerm>;
    /// Called after the optimiser's update. A report means that the step was one at which rows may have changed.
    fn after_update(&mut self, state: &mut Optimized, context: &StepContext) -> Option<DensifyReport>;
}

/// No densification: the initial Gaussians are only optimised.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fixed;

impl Strategy for Fixed {
    fn regularize(&mut self, _params: &Columns, _grads: &mut Columns) -> Vec<LossTerm> {
        Vec::new()
    }

    fn after_update(&mut self, _state: &mut Optimized, _context: &StepContext) -> Option<DensifyReport> {
        None
    }
}
