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
    /// Rounds without training, after the check that ends the pruning phase.
    Final {
        /// The next round, counted from 1.
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
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Passed {
    pub measured: Measured,
    /// False for the dense model that stands in until a state passes.
    pub is_real: bool,
}

/// What the caller of the loop wants to find again when a run is resumed.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Noted {
    /// Bytes of the report that belong to the checkpoint: what was written after it is written again.
    pub report_bytes: u64,
    /// Seconds that the run has taken.
    pub elapsed_s: f64,
}

/// Measured values with their bits: reading a decimal number back may cost its last digit, and a resumed run has to make
/// the very decisions of the uninterrupted one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct Stored {
    measured: Measured,
    bits: [u64; 6],
}

impl From<Measured> for Stored {
    fn from(measured: Measured) -> Self {
        let Measured { psnr, ssim, pairs_per_tile, pairs_used_per_tile, ws, render_ms, .. } = measured;
        Self { measured, bits: [psnr, ssim, pairs_per_tile, pairs_used_per_tile, ws, render_ms].map(f64::to_bits) }
    }
}

impl Stored {
    /// What was stored, to the last bit.
    pub fn exact(self) -> Measured {
        let [psnr, ssim, pairs_per_tile, pairs_used_per_tile, ws, render_ms] = self.bits.map(f64::from_bits);
        Measured { psnr, ssim, pairs_per_tile, pairs_used_per_tile, ws, render_ms, ..self.measured }
    }
}

/// [`Passed`] as it is stored.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct StoredPassed {
    stored: Stored,
    is_real: bool,
}

impl From<Passed> for StoredPassed {
    fn from(passed: Passed) -> Self {
        Self { stored: passed.measured.into(), is_real: passed.is_real }
    }
}

impl StoredPassed {
    /// What was stored, to the last bit.
    pub fn exact(self) -> Passed {
        Passed { measured: self.stored.exact(), is_real: self.is_real }
    }
}

/// What a checkpoint holds beside the models.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Record {
    pub config: PruneConfig,
    pub more_settings: serde_json::Value,
    /// Identifies model and scene: a checkpoint of others is refused.
    pub origin: Origin,
    pub phase: Phase,
    pub step: u32,
    pub decay_exponent: Option<u32>,
    pub reference: Option<(Stored, Basis)>,
    pub best: Option<StoredPassed>,
    pub noted: Noted,
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
    /// Fingerprint of their cameras.
    pub cameras: String,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn measured_values_survive_a_text_to_the_last_bit() {
        let mut value = 27.123_456_789_012_3_f64;
        for _ in 0..200 {
            value = f64::from_bits(value.to_bits() + 12_345_678_901);
            let measured = Measured {
                points: 3,
                psnr: value,
                ssim: value / 40.0,
                pairs_per_tile: value * 3.0,
                pairs_used_per_tile: value * 2.0,
                ws: value / 3e3,
                render_ms: value / 7.0,
                passed: true,
            };
            let text = serde_json::to_string(&Stored::from(measured)).expect("plain numbers");
            let back: Stored = serde_json::from_str(&text).expect("our own text");
            assert_eq!(back.exact(), measured);
        }
    }
}
