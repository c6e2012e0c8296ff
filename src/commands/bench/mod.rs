//! `gazesplat bench`: what a part of the program gains and costs, one file per study.

pub mod ablation;
pub mod memory;
pub mod prune_curve;
pub mod termination;

use crate::console::Console;
use crate::diagnostics::Result;
use clap::{Args, Subcommand};

/// Arguments of `bench`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat bench termination model.ply --scene fox --out study
  gazesplat bench prune-curve model.ply --scene fox
  gazesplat bench ablation runs/fox-1 --scene fox
  gazesplat bench memory --steps 300")]
pub struct BenchArgs {
    /// What to measure
    #[command(subcommand)]
    pub study: Study,
}

/// The studies.
#[derive(Debug, Subcommand)]
pub enum Study {
    /// Error against time of every termination rule: fixed, naive, and the tables at several γ
    Termination(termination::StudyArgs),
    /// Quality against time of every criterion of pruning, one shot per share that is kept
    PruneCurve(prune_curve::CurveArgs),
    /// What scale decay and removal each contribute to a pruning under a guard
    Ablation(ablation::AblationArgs),
    /// Memory that training on a capture much larger than its image cache takes, against a bound
    Memory(memory::MemoryArgs),
}

/// Runs `bench`.
///
/// # Errors
/// Whatever the study fails with.
pub fn command(args: &BenchArgs, console: &Console) -> Result<()> {
    match &args.study {
        Study::Termination(args) => termination::command(args, console),
        Study::PruneCurve(args) => prune_curve::command(args, console),
        Study::Ablation(args) => ablation::command(args, console),
        Study::Memory(args) => memory::command(args, console),
    }
}
