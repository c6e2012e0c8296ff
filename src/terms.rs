//! Terms of the training loss and guards of pruning that crate `train` knows nothing of: what they are called, their
//! settings, and how they are made. This is where models of vision meet the trainer.

use crate::diagnostics::{Failure, Result};
use gazesplat_core::View;
use gazesplat_fovea::Hvsq;
use gazesplat_fovea::hvs::pooling::Pooling;
use gazesplat_fovea::hvsq::{Distance, HvsqLoss, HvsqMetric, ReferenceCache};
use gazesplat_render::device::Device;
use gazesplat_train::Trainer;
use gazesplat_train::losses::ImageLoss;
use gazesplat_train::metrics::{Bound, Guard};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::sync::Arc;

/// The section of [`TermSection`] that is registered as a loss, as in settings files.
pub const HVSQ_LOSS: &str = "loss.hvsq";

/// Settings of the terms that this program adds to those of training.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TermSection {
    /// Terms of the loss.
    pub loss: LossTerms,
    /// What is measured beside PSNR and SSIM.
    pub eval: EvalTerms,
}

/// What is measured of test views beside PSNR, SSIM and FLIP.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EvalTerms {
    /// A safetensors file with the weights of LPIPS over VGG16, which is then measured after training and by `eval`; unset =
    /// it is not.
    pub lpips_weights: Option<PathBuf>,
}

/// Terms of the loss by name.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LossTerms {
    /// Statistics of early vision over pools of pixels (RTGS Eq. 2).
    pub hvsq: HvsqTerm,
}

/// HVSQ as a term of the loss.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct HvsqTerm {
    /// Weight beside the other terms; 0 = not computed. HVSQ of L1 distances is about a hundredth of L1 + SSIM. Default 0.
    pub weight: f32,
    /// Side of the pools in pixels, at least 1 and at most the shorter side of the images. Default 3.
    pub pooling_px: f64,
    /// `"l1"` or `"mse"`. Default `"l1"` (training as in RTGS).
    pub distance: TermDistance,
    /// Megabytes of statistics of photographs that are kept. Default 512.
    pub cache_mb: usize,
}

/// Distance between two statistics.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TermDistance {
    /// Absolute difference.
    #[default]
    L1,
    /// Squared difference.
    Mse,
}

impl Default for HvsqTerm {
    fn default() -> Self {
        Self { weight: 0.0, pooling_px: 3.0, distance: TermDistance::default(), cache_mb: 512 }
    }
}

/// The term, and the cache that its statistics are kept in.
pub type HvsqLossAndCache = (Box<dyn ImageLoss>, Arc<ReferenceCache>);

impl HvsqTerm {
    /// Whether the loss has this term.
    pub fn is_used(&self) -> bool {
        self.weight != 0.0
    }

    fn refuse(key: &str, found: impl std::fmt::Display, expected: &str) -> Failure {
        Failure::new(format!("`{HVSQ_LOSS}.{key}`: found {found}, expected {expected}"))
            .hint(format!("for example `--set {HVSQ_LOSS}.{key}={}`", if key == "weight" { "100" } else { "3" }))
    }

    /// Checks every range that does not depend on images.
    ///
    /// # Errors
    /// Naming the first key that is out of its range.
    pub fn validate(&self) -> Result<()> {
        if !(self.weight >= 0.0 && self.weight.is_finite()) {
            return Err(Self::refuse("weight", self.weight, "a number of at least 0"));
        }
        if !(self.pooling_px >= 1.0 && self.pooling_px.is_finite()) {
            return Err(Self::refuse("pooling_px", self.pooling_px, "a number of pixels from 1 on"));
        }
        Ok(())
    }

    /// Adds the term to what `trainer` minimises, if it has a weight; the cache that its statistics are kept in.
    ///
    /// # Errors
    /// When the pools are larger than a photograph.
    pub fn register(&self, trainer: &mut Trainer) -> Result<Option<Arc<ReferenceCache>>> {
        let device = trainer.splats()?.means.device();
        let Some((loss, cache)) = self.make(&trainer.smallest_views(), &device)? else { return Ok(None) };
        trainer.add_loss(self.weight, loss);
        Ok(Some(cache))
    }

    /// The term for the photographs of `views` on `device`, if it has a weight, and the cache that its statistics are kept in.
    ///
    /// # Errors
    /// When the pools are larger than a photograph.
    pub fn make(&self, views: &[View], device: &Device) -> Result<Option<HvsqLossAndCache>> {
        if !self.is_used() {
            return Ok(None);
        }
        self.validate()?;
        let distance = match self.distance {
            TermDistance::L1 => Distance::L1,
            TermDistance::Mse => Distance::Mse,
        };
        let hvsq = Hvsq::new(Pooling::Uniform { size_px: self.pooling_px }, distance)?;
        for view in views {
            let pinhole = view.camera.intrinsics;
            hvsq.check_size_on((pinhole.width as usize, pinhole.height as usize), device).map_err(|error| {
                Failure::new(format!("`{HVSQ_LOSS}.pooling_px` and the photograph `{}`: {error}", view.name))
                    .hint("choose other pools, or another size of the images with `data.max_side`")
            })?;
        }
        let cache = Arc::new(ReferenceCache::new(hvsq, self.cache_mb.saturating_mul(1 << 20)));
        Ok(Some((Box::new(HvsqLoss::new(Arc::clone(&cache))), cache)))
    }
}

/// Settings of the terms that this program adds to those of pruning.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PruneTerms {
    /// Terms of the loss.
    pub loss: LossTerms,
    /// Bounds beside those of PSNR and SSIM.
    pub guard: GuardTerms,
}

/// Bounds by name.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GuardTerms {
    /// Statistics of early vision over pools of pixels (RTGS Eq. 2).
    pub hvsq: HvsqBound,
}

/// HVSQ as a bound.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct HvsqBound {
    /// Mean HVSQ of squared differences that the guard's views may have; 0 = it is not measured. Default 0.
    pub at_most: f64,
    /// Side of the pools in pixels, at least 1. Default 3.
    pub pooling_px: f64,
    /// Megabytes of statistics of photographs that are kept. Default 512.
    pub cache_mb: usize,
}

impl Default for HvsqBound {
    fn default() -> Self {
        Self { at_most: 0.0, pooling_px: 3.0, cache_mb: 512 }
    }
}

impl PruneTerms {
    /// Checks every range that does not depend on images.
    ///
    /// # Errors
    /// Naming the first key that is out of its range.
    pub fn validate(&self) -> Result<()> {
        self.loss.hvsq.validate()?;
        let HvsqBound { at_most, pooling_px, .. } = self.guard.hvsq;
        let refuse = |key: &str, found: f64, expected: &str| {
            Err(Failure::new(format!("`guard.hvsq.{key}`: found {found}, expected {expected}")))
        };
        if !(at_most >= 0.0 && at_most.is_finite()) {
            return refuse("at_most", at_most, "a number of at least 0");
        }
        if !(pooling_px >= 1.0 && pooling_px.is_finite()) {
            return refuse("pooling_px", pooling_px, "a number of pixels from 1 on");
        }
        Ok(())
    }
}

impl HvsqBound {
    /// Checks that the photographs of `views` are not smaller than the pools, if this is a bound.
    ///
    /// # Errors
    /// Naming the first that is.
    pub fn check_views(&self, views: &[View]) -> Result<()> {
        if self.at_most == 0.0 {
            return Ok(());
        }
        let hvsq = Hvsq::new(Pooling::Uniform { size_px: self.pooling_px }, Distance::Mse)?;
        for view in views {
            let pinhole = view.camera.intrinsics;
            hvsq.check_size((pinhole.width as usize, pinhole.height as usize)).map_err(|error| {
                Failure::new(format!("`guard.hvsq.pooling_px` and the photograph `{}`: {error}", view.name))
                    .hint("choose other pools, or another size of the images with `data.max_side`")
            })?;
        }
        Ok(())
    }

    /// `guard` with this bound, if it is one.
    ///
    /// # Errors
    /// When the pools are no number of pixels from 1 on.
    pub fn add_to(&self, guard: Guard) -> Result<Guard> {
        if self.at_most == 0.0 {
            return Ok(guard);
        }
        let metric = hvsq_metric(self.pooling_px, self.cache_mb.saturating_mul(1 << 20))?;
        Ok(guard.with(Box::new(metric), Bound::AtMost(self.at_most)))
    }
}

/// HVSQ (squared differences, over uniform pools of `pooling_px`) as a metric.
///
/// # Errors
/// When the pools are no number of pixels from 1 on.
fn hvsq_metric(pooling_px: f64, cache_bytes: usize) -> Result<HvsqMetric> {
    let hvsq = Hvsq::new(Pooling::Uniform { size_px: pooling_px }, Distance::Mse)?;
    Ok(HvsqMetric::new(Arc::new(ReferenceCache::new(hvsq, cache_bytes))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_checked_by_key() {
        HvsqTerm::default().validate().expect("defaults are valid");
        for (term, key) in [
            (HvsqTerm { weight: -1.0, ..HvsqTerm::default() }, "`loss.hvsq.weight`: found -1"),
            (HvsqTerm { weight: f32::NAN, ..HvsqTerm::default() }, "`loss.hvsq.weight`: found NaN"),
            (HvsqTerm { pooling_px: 0.5, ..HvsqTerm::default() }, "`loss.hvsq.pooling_px`: found 0.5"),
            (HvsqTerm { pooling_px: f64::INFINITY, ..HvsqTerm::default() }, "`loss.hvsq.pooling_px`: found inf"),
        ] {
            let said = format!("{:?}", term.validate().expect_err("must be refused"));
            assert!(said.contains(key), "{said}");
        }
    }

    #[test]
    fn a_guard_names_its_pools_and_holds_up_to_its_bound() {
        let bound = |at_most, pooling_px| HvsqBound { at_most, pooling_px, cache_mb: 1 };
        let guard = bound(0.25, 3.0).add_to(Guard::default()).expect("valid");
        assert_eq!(guard.bounds().collect::<Vec<_>>(), [("hvsq@3", Bound::AtMost(0.25))]);
        assert!(guard.holds(&[vec![0.25]]) && !guard.holds(&[vec![0.26]]) && !guard.holds(&[vec![f64::NAN]]));
        assert!(bound(0.25, 0.5).add_to(Guard::default()).is_err());
        assert_eq!(bound(0.0, 3.0).add_to(Guard::default()).expect("valid").bounds().count(), 0);
        let terms = |at_most, pooling_px| PruneTerms {
            guard: GuardTerms { hvsq: bound(at_most, pooling_px) },
            ..PruneTerms::default()
        };
        terms(0.0, 3.0).validate().expect("the defaults are valid");
        assert!(terms(f64::NAN, 3.0).validate().is_err() && terms(0.1, 0.9).validate().is_err());
    }
}
