//! The `gazesplat` program as a library: settings, run directories, reports and the commands behind the command line.
//!
//! The work itself is done by the crates below this one: [`gazesplat_core`] (scenes and models), [`gazesplat_render`]
//! (the differentiable renderer) and [`gazesplat_train`] (optimisation). Here they meet files, terminals and people.

pub mod allocator;
pub mod cli;
pub mod commands;
pub mod console;
pub mod diagnostics;
pub mod interrupt;
pub mod json_lines;
pub mod memory;
pub mod npy;
pub mod progress;
pub mod report;
pub mod run_dir;
pub mod settings;
pub mod terms;
pub mod y4m;

pub use console::Console;
pub use diagnostics::{Failure, FailureKind, Result};
pub use run_dir::RunDir;
pub use settings::Settings;
