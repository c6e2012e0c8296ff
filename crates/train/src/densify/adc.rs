//! Adaptive density control (Kerbl 2023, Sec. 5.2, with the numbers of its code; absolute gradients: Ye 2024): Gaussians whose
//! place in the image still moves are cloned where they are small and split where they are large, faint and large ones go,
//! and opacities are lowered now and then, so that what is not needed becomes faint.
//!
//! The statistic is the norm of the image-plane gradient in half images, averaged over the steps in which a Gaussian was in
//! view, since the last refinement. Deviations, all ours: steps scale with the length of the run as for MCMC
//! ([`Timing`]), the interval of opacity resets likewise, down to 300 steps, which is what an opacity needs to come back; the
//! cap holds, and what it has room for goes to the largest statistics; Gaussians that are broken ([`Bounds`]) go. Gaussians
//! that are large on the screen stay: the code of 3DGS has a rule against them, but forgets the radii before it reads them,
//! so that no published figure was made with it. Backgrounds that are white get no reset of their own.

use super::{Bounds, Observation, StepContext, Strategy, Sweeps, Timing, Watched};
use crate::backend::{Densification, OptimOps, StatisticStep};
use crate::config::DensifySection;
use crate::error::Result;
use crate::event::DensifyReport;
use crate::host::read;
use crate::optim::{ModelState, Regularizers};
use burn::backend::Dispatch;
use burn::tensor::{Device, Tensor, TensorData};

/// Statistic above which a Gaussian grows (3DGS).
const GROW_GRADIENT: f32 = 2e-4;
/// The same with absolute gradients, whose sums do not cancel.
const GROW_GRADIENT_ABSOLUTE: f32 = 8e-4;
/// Shortest interval of opacity resets. From 0.01 the logit has 4.6 to go to an opacity of one half; at the default rate of
/// 0.05 that takes a hundred visits, and a view sees a part of the scene.
const MIN_RESET_INTERVAL: u32 = 300;

/// The strategy, its constants and its statistic.
#[derive(Debug)]
pub struct Adc {
    section: DensifySection,
    timing: Timing,
    /// Steps between two opacity resets; 0 = none.
    reset_every: u32,
    extent: f32,
    sweeps: Sweeps,
    /// Sum of the norms and number of views of each row, `[N, 2]`; `None` = zero. Never handed out: a GPU overwrites it.
    statistic: Option<Tensor<2>>,
}

impl Adc {
    /// A strategy for a run of `num_steps` in a scene of these bounds and of radius `extent`.
    pub fn new(section: &DensifySection, num_steps: u32, bounds: Bounds, extent: f32) -> Self {
        Self {
            section: section.clone(),
            timing: Timing::new(section, num_steps),
            reset_every: section.reset_every.min((num_steps / 10).max(MIN_RESET_INTERVAL)),
            extent,
            sweeps: Sweeps::new(0, num_steps, bounds),
            statistic: None,
        }
    }

    /// When refinements happen.
    pub fn timing(&self) -> Timing {
        self.timing
    }

    /// Whether the refinement at `step` ends by lowering the opacities: the first of each interval, while another refinement
    /// follows that removes what stays faint.
    pub fn resets_at(&self, step: u32) -> bool {
        let Timing { stop, every, .. } = self.timing;
        let intervals = |step: u32| step.checked_div(self.reset_every).unwrap_or(0);
        self.timing.is_due(step) && step + every <= stop && intervals(step) > intervals(step.saturating_sub(every))
    }

    /// Statistic above which a Gaussian grows.
    fn grow_gradient(&self) -> f32 {
        let default = if self.section.absolute_gradients { GROW_GRADIENT_ABSOLUTE } else { GROW_GRADIENT };
        self.section.grow_gradient.unwrap_or(default)
    }

    /// What a refinement at `context` does.
    fn densification(&self, context: &StepContext) -> Densification {
        let section = &self.section;
        // Before the first reset large Gaussians may be all there is of a place (code of 3DGS).
        let is_reset = self.reset_every > 0 && context.step > self.reset_every;
        Densification {
            seed: context.seed,
            step: context.step,
            cap: section.cap,
            grow_gradient: self.grow_gradient(),
            max_clone_log_scale: (section.clone_scale * self.extent).ln(),
            min_logit: logit(section.min_opacity),
            max_log_scale: is_reset.then(|| (section.max_scale * self.extent).ln()),
            bounds: self.sweeps.bounds(),
            reset_logit: self.resets_at(context.step).then(|| logit(section.reset_opacity)),
        }
    }
}

fn logit(opacity: f32) -> f32 {
    (opacity / (1.0 - opacity)).ln()
}

impl Strategy for Adc {
    fn regularizers(&self) -> Regularizers {
        Regularizers::default()
    }

    fn watches(&self, step: u32) -> Option<Watched> {
        let watched = if self.section.absolute_gradients { Watched::Absolute } else { Watched::Signed };
        // After the last refinement nobody reads the statistic, and a sweep may take rows from under it.
        self.timing.last().is_some_and(|last| step <= last).then_some(watched)
    }

    fn observe(&mut self, seen: Observation) {
        let Observation { gradient, visible, num_visible, size } = seen;
        let [num_rows, _] = gradient.dims();
        let statistic = self.statistic.take().unwrap_or_else(|| Tensor::zeros([num_rows, 2], &gradient.device()));
        let step = StatisticStep {
            num_visible,
            half_size: size.map(|side| 0.5 * side as f32),
            absolute: self.section.absolute_gradients,
        };
        let sum = <Dispatch as OptimOps>::add_statistic(
            statistic.into_dispatch(),
            gradient.into_dispatch(),
            visible.into_dispatch(),
            step,
        );
        self.statistic = Some(Tensor::from_dispatch(sum));
    }

    fn after_update(&mut self, state: &mut ModelState, context: &StepContext) -> Result<Option<DensifyReport>> {
        let report = match self.timing.is_due(context.step) {
            true => {
                let zeros = || Tensor::zeros([state.num_rows(), 2], state.device());
                let statistic = self.statistic.take().unwrap_or_else(zeros);
                Some(state.densify(statistic, self.densification(context))?)
            }
            false => None,
        };
        self.sweeps.after(state, context.step, report)
    }

    fn memory(&self) -> Result<Option<Vec<f32>>> {
        self.statistic.clone().map(read).transpose()
    }

    fn remember(&mut self, memory: Vec<f32>, num_rows: usize, device: &Device) -> bool {
        let fits = memory.len() == 2 * num_rows;
        if fits {
            self.statistic = Some(Tensor::from_data(TensorData::new(memory, [num_rows, 2]), device));
        }
        fits
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::StrategyKind;

    fn adc(num_steps: u32, change: impl FnOnce(&mut DensifySection)) -> Adc {
        let mut section = DensifySection { strategy: StrategyKind::Adc, ..DensifySection::default() };
        change(&mut section);
        Adc::new(&section, num_steps, Bounds::of_scene([0.0; 3], 2.0), 2.0)
    }

    fn resets(adc: &Adc, num_steps: u32) -> Vec<u32> {
        (1..=num_steps).filter(|&step| adc.resets_at(step)).collect()
    }

    #[test]
    fn opacities_are_lowered_when_the_paper_does_and_in_short_runs_in_proportion() {
        assert_eq!(resets(&adc(30_000, |_| ()), 30_000), [3000, 6000, 9000, 12_000]);
        // 3500 steps of refinement at every 70th: each is the first at or after a multiple of 700.
        assert_eq!(resets(&adc(7000, |_| ()), 7000), [700, 1400, 2100, 2800]);
        assert_eq!(resets(&adc(1000, |_| ()), 1000), [300]);
        assert!(resets(&adc(300, |_| ()), 300).is_empty());
        assert!(resets(&adc(30_000, |s| s.reset_every = 0), 30_000).is_empty());
    }

    #[test]
    fn a_refinement_has_the_numbers_of_the_paper() {
        let at = |adc: &Adc, step| adc.densification(&StepContext { step, seed: 3, means_lr: 0.0 });
        let adc_of_paper = adc(30_000, |_| ());
        let found = at(&adc_of_paper, 600);
        assert_eq!(
            (found.grow_gradient, found.cap, found.max_log_scale, found.reset_logit),
            (2e-4, 300_000, None, None)
        );
        assert_eq!(found.max_clone_log_scale, 0.02f32.ln());
        assert!((found.min_logit - (0.005f32 / 0.995).ln()).abs() < 1e-6);
        // Large Gaussians go once opacities have been lowered, which happens after the removal.
        let reset = at(&adc_of_paper, 3000);
        assert_eq!(reset.max_log_scale, None);
        assert!((reset.reset_logit.expect("a reset") - (0.01f32 / 0.99).ln()).abs() < 1e-6);
        assert_eq!(at(&adc_of_paper, 3100).max_log_scale, Some(0.2f32.ln()));
        assert_eq!(at(&adc(30_000, |s| s.absolute_gradients = true), 600).grow_gradient, 8e-4);
        assert_eq!(at(&adc(30_000, |s| s.grow_gradient = Some(4e-4)), 600).grow_gradient, 4e-4);
    }

    #[test]
    fn gradients_are_watched_until_the_last_refinement() {
        let signed = adc(30_000, |_| ());
        assert_eq!(
            [1, 15_000, 15_001].map(|step| signed.watches(step)),
            [Some(Watched::Signed), Some(Watched::Signed), None]
        );
        assert_eq!(adc(30_000, |s| s.absolute_gradients = true).watches(1), Some(Watched::Absolute));
    }
}
