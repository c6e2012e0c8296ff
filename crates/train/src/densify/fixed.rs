//! No densification: the initial Gaussians are only optimised.

use super::{Bounds, StepContext, Strategy, Sweeps, Timing};
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
    /// Broken Gaussians go, as often as another strategy would look at them, to the end of the run.
    pub fn swept(section: &DensifySection, num_steps: u32, bounds: Bounds) -> Self {
        let every = Timing::new(section, num_steps).every;
        Self { sweeps: Some(Sweeps::new(every, num_steps, bounds)) }
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
