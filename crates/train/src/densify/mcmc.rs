//! 3D Gaussian splatting as Markov chain Monte Carlo (Kheradmand 2024): dead Gaussians are moved onto live ones, the
//! number grows to a cap, positions carry noise, opacities and scales are kept small.
//!
//! Sources are drawn with probability proportional to opacity. Deviations, both ours: in runs that are too short for
//! 5 % growth to reach the cap by mid-run, growth is raised to what does, and refinements come more often (the paper
//! knows one length only); and Gaussians with a non-finite parameter, or of absurd size or distance ([`Bounds`]), count as dead.

use super::{Bounds, StepContext, Strategy, Sweeps, Timing};
use crate::backend::{NoiseUpdate, Refinement};
use crate::config::DensifySection;
use crate::error::Result;
use crate::event::DensifyReport;
use crate::optim::{ModelState, Regularizers};

/// When refinements happen and how much they add.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plan {
    /// When.
    pub timing: Timing,
    /// Growth factor of each, above 1.
    pub growth: f32,
}

impl Plan {
    /// The plan of a run of `num_steps` that begins with `num_initial` Gaussians.
    pub fn new(section: &DensifySection, num_steps: u32, num_initial: usize) -> Self {
        let timing = Timing::new(section, num_steps);
        let Timing { start, stop, every } = timing;
        let num_until_middle = (num_steps / 2).min(stop).saturating_sub(start) / every;
        let needed = section.cap as f64 / num_initial.max(1) as f64;
        let raised = if num_until_middle > 0 { needed.powf(1.0 / f64::from(num_until_middle)) } else { 1.0 };
        Self { timing, growth: (1.0 + section.growth).max(raised as f32) }
    }
}

/// The strategy and its constants.
#[derive(Debug, Clone)]
pub struct Mcmc {
    section: DensifySection,
    plan: Plan,
    sweeps: Sweeps,
}

impl Mcmc {
    /// A strategy for a run of `num_steps` from `num_initial` Gaussians in a scene of these bounds.
    pub fn new(section: &DensifySection, num_steps: u32, num_initial: usize, bounds: Bounds) -> Self {
        let plan = Plan::new(section, num_steps, num_initial);
        Self { section: section.clone(), plan, sweeps: Sweeps::new(0, num_steps, bounds) }
    }

    /// When refinements happen and how much they add.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// What a refinement at `context` does.
    fn refinement(&self, context: &StepContext) -> Refinement {
        Refinement {
            seed: context.seed,
            step: context.step,
            growth: self.plan.growth,
            cap: self.section.cap,
            min_opacity: self.section.min_opacity,
            bounds: self.sweeps.bounds(),
        }
    }
}

impl Strategy for Mcmc {
    fn regularizers(&self) -> Regularizers {
        Regularizers { opacity: self.section.opacity_regularizer, scale: self.section.scale_regularizer }
    }

    fn after_update(&mut self, state: &mut ModelState, context: &StepContext) -> Result<Option<DensifyReport>> {
        let report = match self.plan.timing.is_due(context.step) {
            true => Some(state.refine(self.refinement(context))?),
            false => None,
        };
        let strength = context.means_lr * self.section.noise;
        state.add_noise(NoiseUpdate { strength, seed: context.seed, step: context.step })?;
        self.sweeps.after(state, context.step, report)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn short_runs_refine_more_often_and_reach_the_cap_by_mid_run() {
        let section = DensifySection { cap: 60_000, ..DensifySection::default() };
        let plan = Plan::new(&section, 30_000, 13_302);
        assert_eq!(plan.timing, Timing { start: 500, stop: 25_000, every: 100 });
        assert!((plan.growth - 1.05).abs() < 1e-6);
        for steps in [100, 300, 3000] {
            let plan = Plan::new(&section, steps, 13_302);
            let mut n = 13_302.0;
            for step in 1..=steps / 2 {
                if plan.timing.is_due(step) {
                    n *= f64::from(plan.growth);
                }
            }
            assert!(n >= 59_000.0, "{steps}: {n} {plan:?}");
        }
        Plan::new(&section, 1, 13_302);
    }
}
