//! Efficiency-aware pruning (RTGS Sec. 3): remove what earns little per tile it costs, shrink what is in many tiles, and let
//! measured quality decide how far to go.
//!
//! [`Pruner`] is the loop of RTGS Fig. 6, one step or check at a time; it prints nothing and writes nothing. A
//! [`Criterion`] says what goes, a [`crate::metrics::Guard`] whether the model may get smaller. [`one_shot`] removes without
//! retraining, which is how criteria are compared.

pub mod ce;
pub mod config;
pub mod criterion;
pub mod decay;
pub mod guard;
mod phase;
pub mod pruner;
pub mod report;
pub mod significance;
pub mod simple;
pub mod split;
mod state;
#[cfg(test)]
mod tests;

pub use config::{GuardViews, Plan, PruneConfig, ScaleUnit};
pub use criterion::{Criterion, CriterionKind, RowValues};
pub use guard::{Basis, Reference};
pub use phase::Noted;
pub use pruner::{Job, Progress, Pruner, one_shot};
pub use report::{Check, Measured, Outcome, Part, Status};
pub use split::{Provenance, Split, split};
