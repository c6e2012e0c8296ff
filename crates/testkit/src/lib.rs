//! Test helpers shared by all crates of the workspace: where test files lie, golden files, closeness with a message that
//! says how far off a value is, finite differences, and a plain float64 renderer to compare with.
//!
//! This crate knows none of our crates, on purpose: the references in it are written from the specification and share no
//! line with what they judge. It is the one library that prints and reads the environment, because tests have to say
//! aloud what they skip.

pub mod close;
pub mod data;
pub mod devices;
pub mod finite_diff;
pub mod golden;
pub mod reference;
pub mod rng;

pub use close::{Difference, Tolerance, assert_close, difference};
pub use data::{data_dir, data_path, workspace_root};
pub use golden::{Golden, GoldenFile};
pub use rng::Rng;
