//! When a pixel stops, as `render` and `eval` take it: `--termination`, `--lut`, `--gamma`.

use crate::diagnostics::{Failure, Result};
use clap::{Args, ValueEnum};
use gazesplat_core::color::ColorSpace;
use gazesplat_fovea::termination_lut::{LutFile, LutSpec, cubic_mean};
use gazesplat_render::{RenderOptions, Termination, TerminationLut};
use std::path::{Path, PathBuf};

/// What decides when a pixel stops.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Kind {
    /// A transmittance of 1e-4, as every 3DGS viewer
    Fixed,
    /// One transmittance for all colours: the cubic mean of the table
    Naive,
    /// The table: what is hidden cannot be seen
    Jnd,
}

/// Arguments of commands that draw.
#[derive(Debug, Clone, Default, Args)]
pub struct TerminationArgs {
    /// When a pixel stops [default: fixed; jnd with --lut]
    #[arg(long, value_enum, value_name = "RULE")]
    pub termination: Option<Kind>,
    /// Table of `gazesplat lut` for jnd and naive [default: that of `--preset strict`]
    #[arg(long, value_name = "FILE")]
    pub lut: Option<PathBuf>,
    /// Just-noticeable differences that jnd and naive admit [default: 1]
    #[arg(long, value_name = "GAMMA", allow_hyphen_values = true)]
    pub gamma: Option<f32>,
}

impl TerminationArgs {
    fn kind(&self) -> Kind {
        self.termination.unwrap_or(if self.lut.is_some() { Kind::Jnd } else { Kind::Fixed })
    }

    /// Whether any of the options was given.
    pub fn is_given(&self) -> bool {
        self.termination.is_some() || self.lut.is_some() || self.gamma.is_some()
    }

    /// Checks what can be checked before any work.
    ///
    /// # Errors
    /// For a γ that is negative or no number, and for a table or γ that the rule has no use for.
    pub fn check(&self) -> Result<()> {
        if let Some(gamma) = self.gamma.filter(|g| !(g.is_finite() && *g >= 0.0)) {
            return Err(Failure::new(format!("`--gamma {gamma}` is no number of just-noticeable differences"))
                .hint("give 0 or more; 1 is what the eye just misses"));
        }
        if self.kind() == Kind::Fixed && (self.lut.is_some() || self.gamma.is_some()) {
            let option = if self.lut.is_some() { "--lut" } else { "--gamma" };
            return Err(Failure::new(format!("`{option}` has no meaning for `--termination fixed`"))
                .hint("say `--termination jnd` too"));
        }
        Ok(())
    }

    /// The rule; builds or reads the table if it needs one.
    ///
    /// # Errors
    /// As [`TerminationArgs::check`]; when the table cannot be read or used.
    pub fn termination(&self) -> Result<Termination> {
        self.check()?;
        if self.kind() == Kind::Fixed {
            return Ok(RenderOptions::default().termination);
        }
        let lut = match &self.lut {
            Some(file) => load(file)?,
            None => LutSpec::strict().build()?,
        };
        let lut = if self.kind() == Kind::Naive { constant(&lut)? } else { lut };
        Ok(Termination::Lut(lut.with_gamma(self.gamma.unwrap_or(1.0))?))
    }
}

/// The table with its cubic mean everywhere, used alike.
///
/// # Errors
/// Never for a table that could be made.
pub(crate) fn constant(lut: &TerminationLut) -> Result<TerminationLut> {
    let values: Vec<f64> = lut.values().iter().map(|&v| v.into()).collect();
    let mean = cubic_mean(&values) as f32;
    Ok(TerminationLut::new(lut.size(), vec![mean; values.len()], ColorSpace::Srgb)?
        .with_also_fixed(lut.also_fixed())?
        .with_residual(lut.residual())
        .with_color_max(lut.color_max()))
}

/// Reads a table file.
///
/// # Errors
/// When it cannot be read, is no table, or its table cannot be used, naming the file.
fn load(path: &Path) -> Result<TerminationLut> {
    let text = std::fs::read_to_string(path).map_err(|e| {
        Failure::io("read", path, e)
            .hint("`gazesplat lut --out FILE` writes a table; without `--lut` the strict one is used")
    })?;
    let (_, lut) = LutFile::from_json(&text).map_err(|e| {
        Failure::new(format!("`{}`: {e}", path.display()))
            .hint("write it again with `gazesplat lut --out FILE`; tables must be for sRGB-encoded colours")
    })?;
    Ok(lut)
}
