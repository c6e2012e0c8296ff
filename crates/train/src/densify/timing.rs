//! When refinements happen: the steps of the papers, which know runs of 30,000 steps, scaled to shorter ones.

use crate::config::{DensifySection, StrategyKind};

/// Shortest interval of refinements in steps: new Gaussians need a few views before opacity says which of them live.
const MIN_INTERVAL: u32 = 5;
/// Shares of a run after which the number of Gaussians stays as it is: 25,000 (MCMC) and 15,000 (3DGS) of 30,000 steps.
const STOP_MCMC: f32 = 5.0 / 6.0;
const STOP_ADC: f32 = 0.5;

/// The steps at which Gaussians are added, moved and removed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timing {
    /// First refinement, counted from step 1.
    pub start: u32,
    /// No refinement after this step.
    pub stop: u32,
    /// Steps between two.
    pub every: u32,
}

impl Timing {
    /// That of a run of `num_steps`: it begins after at most a twentieth, and has at least a hundred intervals unless those
    /// would be shorter than five steps.
    pub fn new(section: &DensifySection, num_steps: u32) -> Self {
        let share = section.stop.unwrap_or(match section.strategy {
            StrategyKind::Adc => STOP_ADC,
            StrategyKind::Mcmc | StrategyKind::None => STOP_MCMC,
        });
        Self {
            every: (num_steps / 100).clamp(MIN_INTERVAL.min(section.every), section.every),
            start: section.start.min(num_steps / 20).max(1),
            stop: (f64::from(num_steps) * f64::from(share)).round() as u32,
        }
    }

    /// The last of them, if there is one.
    pub fn last(&self) -> Option<u32> {
        let span = self.stop.checked_sub(self.start)?;
        Some(self.stop - span.checked_rem(self.every)?)
    }

    /// Whether step `step`, counted from 1, is one.
    pub fn is_due(&self, step: u32) -> bool {
        step >= self.start && step <= self.stop && (step - self.start).is_multiple_of(self.every)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn published_lengths_have_the_published_steps_and_short_runs_scale() {
        let of = |strategy, num_steps| {
            let Timing { start, stop, every } =
                Timing::new(&DensifySection { strategy, ..DensifySection::default() }, num_steps);
            (start, stop, every)
        };
        assert_eq!(of(StrategyKind::Mcmc, 30_000), (500, 25_000, 100));
        assert_eq!(of(StrategyKind::Adc, 30_000), (500, 15_000, 100));
        assert_eq!(of(StrategyKind::Adc, 7000), (350, 3500, 70));
        assert_eq!(of(StrategyKind::Adc, 300), (15, 150, 5));
        let section = DensifySection { stop: Some(0.25), strategy: StrategyKind::Adc, ..DensifySection::default() };
        assert_eq!(Timing::new(&section, 30_000).stop, 7500);
        for (start, stop, every) in [(38, 389, 7), (500, 15_000, 100), (5, 5, 3), (6, 5, 3)] {
            let timing = Timing { start, stop, every };
            assert_eq!(timing.last(), (1..=stop).rev().find(|&step| timing.is_due(step)), "{timing:?}");
        }
    }
}
