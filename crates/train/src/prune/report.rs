//! What a pruning run tells: one record per check, as in `prune.jsonl` (spec/pruning.md, Sec. 8).

use super::guard::Reference;
use serde::{Deserialize, Serialize};

/// A model measured on the guard's views.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// Gaussians.
    pub points: usize,
    /// Mean PSNR, dB.
    pub psnr: f64,
    /// Mean SSIM.
    pub ssim: f64,
    /// Mean length of a tile's list.
    pub pairs_per_tile: f64,
    /// Mean number of entries of a tile that are worked through.
    pub pairs_used_per_tile: f64,
    /// Scale decay WS, mean over views.
    pub ws: f64,
    /// Median time of a frame, ms; with its tile counters, on a machine that may do other things.
    pub render_ms: f64,
    /// Whether every bound of the guard holds.
    pub passed: bool,
}

/// Which part of the loop a check belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Part {
    /// The measurement of the reference.
    Reference,
    /// An event of the pruning phase.
    Prune,
    /// A round of the final phase.
    Final,
    /// A check of the adaptation.
    Adapt,
}

/// One check, and what was done about it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Check {
    /// Part of the loop.
    pub phase: Part,
    /// Steps done since the reference.
    pub iteration: u32,
    /// The model that was judged.
    #[serde(flatten)]
    pub measured: Measured,
    /// Gaussians removed because of their opacity, before the check; after the last of the final phase.
    pub faded: usize,
    /// Gaussians removed after the check, or in the round that was checked.
    pub removed: usize,
    /// Gaussians that no training view used when the last ranking was made: the first to go.
    pub unseen: usize,
    /// The reference.
    pub psnr_ref: f64,
    /// The reference.
    pub ssim_ref: f64,
    /// γ of scale decay in the steps that follow.
    pub gamma: f32,
    /// Whether the guard passed.
    pub accepted: bool,
    /// Whether the model went back to an earlier state.
    pub rolled_back: bool,
}

impl Check {
    pub(super) fn new(phase: Part, iteration: u32, measured: Measured, reference: Reference, gamma: f32) -> Self {
        Self {
            phase,
            iteration,
            measured,
            faded: 0,
            removed: 0,
            unseen: 0,
            psnr_ref: reference.psnr,
            ssim_ref: reference.ssim,
            gamma,
            accepted: measured.passed,
            rolled_back: false,
        }
    }
}

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Status {
    /// The delivered model passed the guard.
    Ok,
    /// No state ever passed; the delivered model is the dense one.
    NoPass,
}

/// The delivered model.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Outcome {
    /// How the run ended.
    pub status: Status,
    /// Gaussians of the dense model.
    pub points_dense: usize,
    /// The delivered model as it was measured when it passed.
    pub measured: Measured,
}
