//! Training of 3D Gaussian models: losses, optimiser, densification, the loop, evaluation.
//!
//! A [`Trainer`] owns a model and advances it one view at a time; it prints nothing. [`run()`] drives it to the end of its
//! budget, evaluates on the way and tells [`Observer`]s what happens. Sources, as cited in the code: `3DGS` = Kerbl 2023,
//! `MCMC` = Kheradmand 2024, Wang 2004 (SSIM), Kingma 2015 (Adam).

pub mod backend;
pub mod checkpoint;
pub mod config;
pub mod densify;
pub mod error;
pub mod evaluate;
pub mod event;
mod host;
pub mod init;
pub mod kernels;
mod limits;
pub mod losses;
#[cfg_attr(
    feature = "gpu",
    expect(missing_docs, reason = "the device-side twins that the macros generate carry no documentation")
)]
pub mod math;
pub mod metrics;
pub mod optim;
pub mod poses;
pub mod prune;
pub mod rng;
pub mod run;
mod simd;
pub mod trainer;

pub use config::Config;
pub use error::{Error, Result};
pub use evaluate::{EvalReport, ViewScore, evaluate, evaluate_with};
pub use event::{BrokenCounts, DensifyReport, Observer, StageMs, StepReport, TrainEvent};
pub use run::{Outcome, run, with_threads};
pub use trainer::Trainer;
