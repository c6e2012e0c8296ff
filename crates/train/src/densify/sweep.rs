//! Removal of broken Gaussians, whatever the strategy: what the optimiser has thrown out of the scene no view shows, but
//! other viewers stumble over it.

use super::Bounds;
use crate::error::Result;
use crate::event::DensifyReport;
use crate::optim::ModelState;

/// When broken Gaussians are looked for, and what they are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sweeps {
    /// Steps between two looks; 0 = only after the last step, so that what is measured is what is exported.
    every: u32,
    num_steps: u32,
    bounds: Bounds,
}

impl Sweeps {
    /// Every `every` steps of a run of `num_steps`, 0 = never, and after the last.
    pub fn new(every: u32, num_steps: u32, bounds: Bounds) -> Self {
        Self { every, num_steps, bounds }
    }

    /// What is broken.
    pub fn bounds(&self) -> Bounds {
        self.bounds
    }

    /// Removes what is broken if step `step`, counted from 1, is one to look at; `done` is what was done in it before.
    ///
    /// # Errors
    /// As [`ModelState::sweep`].
    pub fn after(
        &self,
        state: &mut ModelState,
        step: u32,
        done: Option<DensifyReport>,
    ) -> Result<Option<DensifyReport>> {
        if step != self.num_steps && (self.every == 0 || !step.is_multiple_of(self.every)) {
            return Ok(done);
        }
        let swept = state.sweep(self.bounds)?;
        Ok(match (done, swept.broken.total()) {
            (Some(mut done), _) => {
                done.add(&swept);
                Some(done)
            }
            (None, 0) => None,
            (None, _) => Some(swept),
        })
    }
}
