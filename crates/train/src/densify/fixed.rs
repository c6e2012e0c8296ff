//! No densification: the initial Gaussians are only optimised.

use super::{Bounds, StepContext, Strategy, Sweeps};
use crate::config::DensifySection;
use crate::error::Result;
use crate::event::DensifyReport;
use crate::optim::{ModelState, Regularizers};

/// The strategy that adds nothing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fixed {
    sweeps: Option<Sweeps>,
}

impl Fixed {
    /// Broken Gaussians go every `section.every` steps, to the end of the run. A GPU is waited for then, so that short runs
    /// do not look more often.
    pub fn swept(section: &DensifySection, num_steps: u32, bounds: Bounds) -> Self {
        Self { sweeps: Some(Sweeps::new(section.every, num_steps, bounds)) }
    }

    /// Every row stays: for a caller that removes rows itself.
    pub fn untouched() -> Self {
        Self { sweeps: None }
    }
}

impl Strategy for Fixed {
    fn regularizers(&self) -> Regularizers {
        Regularizers::default()
    }

    fn after_update(&mut self, state: &mut ModelState, context: &StepContext) -> Result<Option<DensifyReport>> {
        match &self.sweeps {
            Some(sweeps) => sweeps.after(state, context.step, None),
            None => Ok(None),
        }
    }
}
