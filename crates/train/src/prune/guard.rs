//! What the model must hold: bounds on the quality of some views, relative to the model it began as (RTGS Sec. 3.4).

use super::report::Measured;
use crate::error::{Error, Result};
use crate::losses::LossTarget;
use crate::losses::scale_decay::scale_decay;
use crate::metrics::{Bound, Guard, Psnr, Ssim};
use crate::{evaluate, host};
use gazesplat_core::io::images::ImageCache;
use gazesplat_render::{RenderOptions, Splats, StatsMode, render};
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Quality of the model before anything was removed, on the guard's views.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Reference {
    /// Mean PSNR, dB.
    pub psnr: f64,
    /// Mean SSIM.
    pub ssim: f64,
}

/// What the bounds are relative to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Basis {
    /// Photographs: a share of the reference's PSNR and SSIM.
    Share,
    /// Views that the model itself drew: absolute floors, since shares of a reference at the level of rounding errors mean
    /// nothing.
    Floor,
}

/// A reference above this is a model measured on its own renders, dB.
pub const OWN_RENDERS_DB: f64 = 45.0;

/// Floors for views that the model itself drew: share that may be lost, PSNR in dB, SSIM (spec/pruning.md, Sec. 6.2).
const FLOORS: [(f64, f64, f64); 3] = [(0.01, 38.0, 0.98), (0.02, 36.0, 0.97), (0.03, 34.0, 0.96)];

impl Basis {
    /// What suits views on which the reference measures `psnr`.
    pub fn for_reference(psnr: f64) -> Self {
        if psnr > OWN_RENDERS_DB { Self::Floor } else { Self::Share }
    }

    /// The least PSNR and SSIM when the share `loss` may be lost. Floors between the three of the specification are on
    /// the line through them; no share leads beyond the first and the last.
    pub fn bounds(self, reference: Reference, loss: f64) -> Reference {
        match self {
            Self::Share => Reference { psnr: reference.psnr * (1.0 - loss), ssim: reference.ssim * (1.0 - loss) },
            Self::Floor => {
                let [(r, psnr, ssim), ..] = FLOORS;
                let levels = ((loss - r) / r).clamp(0.0, (FLOORS.len() - 1) as f64);
                Reference { psnr: psnr - 2.0 * levels, ssim: ssim - 0.01 * levels }
            }
        }
    }

    /// The guard of those bounds.
    pub fn guard(self, reference: Reference, loss: f64) -> Guard {
        let least = self.bounds(reference, loss);
        Guard::default()
            .with(Box::new(Psnr), Bound::AtLeast(least.psnr))
            .with(Box::new(Ssim), Bound::AtLeast(least.ssim))
    }
}

/// Draws the views of `images` and measures them: the metrics of `guard`, PSNR and SSIM, work and time.
///
/// # Errors
/// When a photograph cannot be read, the renderer refuses, or the device stopped.
pub(super) fn measure(
    splats: &Splats,
    images: &ImageCache,
    options: &RenderOptions,
    guard: &Guard,
    scale_unit: f32,
) -> Result<Measured> {
    let options = RenderOptions { stats: StatsMode::Tiles, ..options.clone() };
    let log_scales = host::read(splats.log_scales.clone())?;
    let base = Guard::default().with(Box::new(Psnr), Bound::AtLeast(0.0)).with(Box::new(Ssim), Bound::AtLeast(0.0));
    let (mut values, mut quality, mut times) = (Vec::new(), Vec::new(), Vec::new());
    let (mut num_pairs, mut num_used, mut num_tiles, mut ws) = (0, 0, 0, 0.0);
    for (index, view) in images.views().iter().enumerate() {
        let target = LossTarget::new(images.get(index)?, options.background);
        let started = Instant::now();
        let rendered = render(splats, &view.camera, &options)?;
        let tiles = rendered.splat_stats.tiles.clone();
        ws += scale_decay(&log_scales, &rendered.splat_stats.tiles_used, scale_unit);
        let image = evaluate::rgb(rendered)?;
        times.push(started.elapsed().as_secs_f64() * 1e3);
        let sum = |counts: &[u32]| counts.iter().map(|&n| u64::from(n)).sum::<u64>();
        num_pairs += sum(&tiles.num_pairs);
        num_used += sum(&tiles.num_pairs_used);
        num_tiles += tiles.num_pairs.len() as u64;
        values.push(guard.measure(&image, &target)?);
        quality.push(base.measure(&image, &target)?);
    }
    let mean = |of: fn(&Vec<f64>) -> f64| quality.iter().map(of).sum::<f64>() / quality.len().max(1) as f64;
    times.sort_by(f64::total_cmp);
    let per_tile = |n: u64| n as f64 / num_tiles.max(1) as f64;
    Ok(Measured {
        points: splats.len(),
        psnr: mean(|q| q[0]),
        ssim: mean(|q| q[1]),
        pairs_per_tile: per_tile(num_pairs),
        pairs_used_per_tile: per_tile(num_used),
        ws: ws / images.len().max(1) as f64,
        render_ms: times.get(times.len() / 2).copied().unwrap_or(0.0),
        passed: guard.holds(&values),
    })
}

/// Refuses a reference that is no number: nothing could be held against it.
pub(super) fn check_reference(measured: &Measured) -> Result<Reference> {
    if measured.psnr.is_finite() && measured.ssim.is_finite() {
        return Ok(Reference { psnr: measured.psnr, ssim: measured.ssim });
    }
    Err(Error::Prune(format!(
        "the model's quality on the guard's views is {} dB and an SSIM of {}: nothing can be held against it",
        measured.psnr, measured.ssim
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_are_shares_of_the_reference_or_floors() {
        let reference = Reference { psnr: 27.0, ssim: 0.8 };
        let least = Basis::for_reference(27.0).bounds(reference, 0.01);
        assert!((least.psnr - 26.73).abs() < 1e-9 && (least.ssim - 0.792).abs() < 1e-9);
        assert_eq!(Basis::for_reference(63.0), Basis::Floor);
        for (loss, psnr, ssim) in FLOORS {
            let least = Basis::Floor.bounds(reference, loss);
            assert!((least.psnr - psnr).abs() < 1e-9 && (least.ssim - ssim).abs() < 1e-9, "{least:?}");
        }
        assert_eq!(Basis::Floor.bounds(reference, 0.2), Basis::Floor.bounds(reference, 0.03));
        assert_eq!(Basis::Floor.bounds(reference, 0.0), Basis::Floor.bounds(reference, 0.01));
    }
}
