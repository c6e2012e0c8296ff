//! Metrics with bounds: what a model must hold while something else is made better.

use super::ImageMetric;
use crate::error::Result;
use crate::losses::LossTarget;
use gazesplat_core::image::ImageF32;

/// What a mean over views must hold.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Bound {
    /// Higher is better: at least this.
    AtLeast(f64),
    /// Lower is better: at most this.
    AtMost(f64),
}

impl std::fmt::Display for Bound {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::AtLeast(bound) => write!(f, "of at least {bound:.4}"),
            Self::AtMost(bound) => write!(f, "of at most {bound:.3e}"),
        }
    }
}

impl Bound {
    /// Whether `value` holds it; NaN holds none.
    pub fn holds(self, value: f64) -> bool {
        match self {
            Self::AtLeast(bound) => value >= bound,
            Self::AtMost(bound) => value <= bound,
        }
    }
}

/// Metrics with bounds, all of which must hold on their mean over views.
#[derive(Default)]
pub struct Guard {
    metrics: Vec<(Box<dyn ImageMetric>, Bound)>,
}

impl Guard {
    /// Adds a metric with its bound.
    pub fn with(mut self, metric: Box<dyn ImageMetric>, bound: Bound) -> Self {
        self.metrics.push((metric, bound));
        self
    }

    /// Names of the metrics with their bounds, in the order they were added.
    pub fn bounds(&self) -> impl Iterator<Item = (&str, Bound)> {
        self.metrics.iter().map(|(metric, bound)| (metric.name(), *bound))
    }

    /// The values of one view, in the order of the metrics.
    ///
    /// # Errors
    /// As [`ImageMetric::measure`].
    pub fn measure(&self, image: &ImageF32, target: &LossTarget) -> Result<Vec<f64>> {
        self.metrics.iter().map(|(metric, _)| metric.measure(image, target)).collect()
    }

    /// Whether the mean over `views`, each as [`Guard::measure`] gives it, holds every bound. Without views nothing holds.
    pub fn holds(&self, views: &[Vec<f64>]) -> bool {
        let mean = |i: usize| views.iter().map(|v| v[i]).sum::<f64>() / views.len() as f64;
        self.metrics.iter().enumerate().all(|(i, (_, bound))| bound.holds(mean(i)))
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Psnr, Ssim};
    use super::*;

    #[test]
    fn every_bound_must_hold_on_the_mean() {
        let guard =
            Guard::default().with(Box::new(Psnr), Bound::AtLeast(30.0)).with(Box::new(Ssim), Bound::AtMost(0.9));
        assert_eq!(guard.bounds().map(|(name, _)| name).collect::<Vec<_>>(), ["psnr", "ssim"]);
        assert!(guard.holds(&[vec![29.0, 0.95], vec![31.0, 0.8]]));
        assert!(!guard.holds(&[vec![29.0, 0.8], vec![30.0, 0.8]]));
        assert!(!guard.holds(&[vec![31.0, 0.91]]));
        assert!(!guard.holds(&[vec![f64::NAN, 0.5]]) && !guard.holds(&[]));
    }
}
