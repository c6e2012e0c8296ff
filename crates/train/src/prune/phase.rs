//! Where the loop stands, and what a checkpoint records of it.

use super::config::PruneConfig;
use super::guard::Basis;
use super::report::Measured;
use serde::{Deserialize, Serialize};

/// Where the loop stands; a flag says that the check after the last step is still to be made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Phase {
    /// Training before the reference is measured.
    Reference,
    /// Steps with events.
    Prune {
        /// An event follows the last step.
        due: bool,
    },
    /// Rounds without training; 0 is the check before the first.
    Final {
        /// The next round.
        round: u32,
    },
    /// Steps without removal.
    Adapt {
        /// A check follows the last step.
        due: bool,
    },
    /// The result stands.
    Done,
}

/// A state that passed the guard, as it was measured; the dense model before any has.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct Passed {
    pub measured: Measured,
    /// False for the dense model that stands in until a state passes.
    pub is_real: bool,
}

/// What a checkpoint holds beside the models.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Record {
    pub config: PruneConfig,
    /// Identifies model and scene: a checkpoint of others is refused.
    pub origin: Origin,
    pub phase: Phase,
    pub step: u32,
    pub decay_exponent: Option<u32>,
    pub reference: Option<(Measured, Basis)>,
    pub best: Option<Passed>,
    /// Bytes of the report that belong to this checkpoint: what a caller wrote after it is written again.
    pub report_bytes: u64,
}

/// Model and scene of a run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Origin {
    /// Fingerprint of the dense model.
    pub model: String,
    /// Gaussians of the dense model.
    pub points: usize,
    /// Names of the views of gradient steps, of those counted, and of the guard's.
    pub views: [Vec<String>; 3],
}
