//! Learning rates as functions of the step.

use super::Group;
use crate::config::OptimSection;

/// Log-linear interpolation from `start` at progress 0 to `end` at progress 1 (3DGS, the means).
pub fn log_linear(start: f32, end: f32, progress: f32) -> f32 {
    let t = progress.clamp(0.0, 1.0);
    (start.ln() * (1.0 - t) + end.ln() * t).exp()
}

/// The rates of one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LearningRates {
    /// Means, world units.
    pub means: f32,
    /// Quaternions.
    pub quats: f32,
    /// Log scales.
    pub log_scales: f32,
    /// Opacity logits.
    pub opacity_logits: f32,
    /// Constant SH coefficient.
    pub sh_dc: f32,
    /// Other SH coefficients.
    pub sh_rest: f32,
}

impl LearningRates {
    /// Rates of 0.
    pub const NONE: Self =
        Self { means: 0.0, quats: 0.0, log_scales: 0.0, opacity_logits: 0.0, sh_dc: 0.0, sh_rest: 0.0 };

    /// Rates at `step` (counted from 0) of `num_steps`, in a scene of radius `extent` world units.
    pub fn at(section: &OptimSection, step: u32, num_steps: u32, extent: f32) -> Self {
        let progress = step as f32 / num_steps.saturating_sub(1).max(1) as f32;
        Self {
            means: log_linear(section.means_lr, section.means_lr_end, progress) * extent,
            quats: section.quats_lr,
            log_scales: section.log_scales_lr,
            opacity_logits: section.opacity_lr,
            sh_dc: section.sh_dc_lr,
            sh_rest: section.sh_dc_lr / section.sh_rest_divisor,
        }
    }

    /// The rate of each value of a row of `width` values.
    pub fn lanes(&self, group: Group, width: usize) -> Vec<f32> {
        let rate = match group {
            Group::Means => self.means,
            Group::Quats => self.quats,
            Group::LogScales => self.log_scales,
            Group::OpacityLogits => self.opacity_logits,
            Group::Sh => return (0..width).map(|i| if i < 3 { self.sh_dc } else { self.sh_rest }).collect(),
        };
        vec![rate; width]
    }
}

/// SH degree in use at `step` of `num_steps`: one more every `every` steps of a run of 30,000, up to `max_degree`.
pub fn sh_degree(step: u32, num_steps: u32, every: u32, max_degree: u32) -> u32 {
    let interval = (f64::from(every) * f64::from(num_steps) / 30_000.0).max(1.0);
    ((f64::from(step) / interval) as u32).min(max_degree)
}

/// How often the sides of the images of `step` of `num_steps`, counted from 0, are halved: `num_downscales` times at first,
/// once less every `every` steps of a run of 30,000; the last step has full size in any run.
pub fn num_halvings(step: u32, num_steps: u32, num_downscales: u32, every: u32) -> u32 {
    if step + 1 >= num_steps {
        return 0;
    }
    // In whole numbers: where a size begins depends on no rounding.
    let passed = u64::from(step) * 30_000 / (u64::from(every.max(1)) * u64::from(num_steps));
    u64::from(num_downscales).saturating_sub(passed) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_means_rate_meets_both_ends_and_the_geometric_middle() {
        let section = OptimSection::default();
        let at = |step| LearningRates::at(&section, step, 1001, 2.0).means;
        assert!((at(0) - 3.2e-4).abs() < 1e-9);
        assert!((at(1000) - 3.2e-6).abs() < 1e-11);
        assert!((at(500) - 3.2e-5).abs() < 1e-9);
        assert!(LearningRates::at(&section, 0, 1, 1.0).means.is_finite());
    }

    #[test]
    fn only_the_first_three_sh_lanes_learn_at_the_dc_rate() {
        let rates = LearningRates::at(&OptimSection::default(), 0, 10, 1.0);
        let lanes = rates.lanes(Group::Sh, 12);
        assert_eq!(lanes[..3], [2.5e-3; 3]);
        assert!(lanes[3..].iter().all(|&lr| (lr - 1.25e-4).abs() < 1e-10));
    }

    #[test]
    fn images_grow_to_full_size_at_the_same_share_of_every_run() {
        let at = |step, steps| num_halvings(step, steps, 2, 3000);
        let steps = [0, 2999, 3000, 5999, 6000, 29_999];
        assert_eq!(steps.map(|step| at(step, 30_000)), [2, 2, 1, 1, 0, 0]);
        assert_eq!([0, 29, 30, 59, 60, 299].map(|step| at(step, 300)), [2, 2, 1, 1, 0, 0]);
        // However short a run is and however late the schedule: its last step has full size.
        for num_steps in 1..50 {
            assert_eq!(num_halvings(num_steps - 1, num_steps, 8, 3700), 0);
            let levels: Vec<u32> = (0..num_steps).map(|step| num_halvings(step, num_steps, 8, 3700)).collect();
            assert!(levels.is_sorted_by(|a, b| a >= b), "{levels:?}");
        }
        assert!((0..100).all(|step| num_halvings(step, 100, 0, 3000) == 0));
    }

    #[test]
    fn the_sh_degree_rises_with_the_budget() {
        let at = |step, steps| sh_degree(step, steps, 1000, 3);
        assert_eq!([at(0, 30_000), at(999, 30_000), at(1000, 30_000), at(29_999, 30_000)], [0, 0, 1, 3]);
        assert_eq!([at(99, 3000), at(100, 3000), at(300, 3000)], [0, 1, 3]);
        assert_eq!(at(1, 5), 1);
    }
}
