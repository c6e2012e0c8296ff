//! How the number and the places of Gaussians change during training: one paper per file.

pub mod adc;
pub mod bounds;
pub mod fixed;
pub mod growth;
pub mod mcmc;
pub mod relocation;
pub mod sweep;
pub mod timing;

pub use adc::Adc;
pub use bounds::{Bounds, Broken};
pub use fixed::Fixed;
pub use mcmc::Mcmc;
pub use sweep::Sweeps;
pub use timing::Timing;

use crate::config::{DensifySection, StrategyKind};
use crate::error::Result;
use crate::event::DensifyReport;
use crate::optim::{ModelState, Regularizers};
use burn::tensor::{Device, Int, Tensor};

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

/// An image-plane gradient of the means that a strategy asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Watched {
    /// The gradient itself.
    Signed,
    /// With the sums of its per-pixel magnitudes (Ye 2024).
    Absolute,
}

/// What a step showed of the image-plane gradient of the means.
#[derive(Debug)]
pub struct Observation {
    /// `[N, 4]`, as a probe receives it ([`gazesplat_render::MeansProbe`]); pixels⁻¹.
    pub gradient: Tensor<2>,
    /// Rows in view: the first `num_visible` values.
    pub visible: Tensor<1, Int>,
    /// Number of rows in view.
    pub num_visible: usize,
    /// Width and height of the image, pixels.
    pub size: [u32; 2],
}

/// A way to place Gaussians where they are needed. It acts through the operations of [`ModelState`], so that it works
/// wherever the model lives.
pub trait Strategy: Send {
    /// Terms it adds to the loss.
    fn regularizers(&self) -> Regularizers;

    /// The gradient it wants to see of step `step`, counted from 1; unless it says so, none.
    fn watches(&self, step: u32) -> Option<Watched> {
        let _ = step;
        None
    }

    /// Takes what it asked for, before [`Strategy::after_update`] of the same step.
    fn observe(&mut self, seen: Observation) {
        drop(seen);
    }

    /// Called after the optimiser's update. A report means that the step was one at which rows may have changed.
    ///
    /// # Errors
    /// As the operations it uses.
    fn after_update(&mut self, state: &mut ModelState, context: &StepContext) -> Result<Option<DensifyReport>>;

    /// What it knows beside the settings, the model and the number of the step; unless it says so, nothing.
    ///
    /// # Errors
    /// When the device does not answer.
    fn memory(&self) -> Result<Option<Vec<f32>>> {
        Ok(None)
    }

    /// Takes up what [`Strategy::memory`] gave for a model of `num_rows` rows. False if it is not that.
    fn remember(&mut self, memory: Vec<f32>, num_rows: usize, device: &Device) -> bool {
        let _ = (num_rows, device);
        memory.is_empty()
    }
}

/// The strategy of the settings, for a run of `num_steps` from `num_initial` Gaussians in a scene of these bounds and of radius
/// `extent`.
pub fn strategy(
    section: &DensifySection,
    num_steps: u32,
    num_initial: usize,
    bounds: Bounds,
    extent: f32,
) -> Box<dyn Strategy> {
    match section.strategy {
        StrategyKind::Mcmc => Box::new(Mcmc::new(section, num_steps, num_initial, bounds)),
        StrategyKind::Adc => Box::new(Adc::new(section, num_steps, bounds, extent)),
        StrategyKind::None => Box::new(Fixed::swept(section, num_steps, bounds)),
    }
}

#[cfg(test)]
mod tests;
