//! The antialiased mode, as commands that draw take it: `--antialiased`. Without it the model decides.

use crate::diagnostics::Result;
use crate::settings::{PRUNE, Settings};
use clap::Args;

/// The setting of `train` and `prune`.
const KEY: &str = "model.antialiased";

/// Arguments of commands that draw.
#[derive(Debug, Clone, Copy, Default, Args)]
pub struct AntialiasedArgs {
    /// Lower opacities by what the least width of a splat adds to its area (Mip-Splatting): for models trained so. `=false`
    /// draws without [default: as the model says: its run, its PLY comment or SPZ flag]
    #[arg(long, value_name = "BOOL", num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    pub antialiased: Option<bool>,
}

impl AntialiasedArgs {
    /// What was asked for, else what the model says.
    pub fn or(self, of_model: bool) -> bool {
        self.antialiased.unwrap_or(of_model)
    }

    /// What was asked for, over `settings`.
    ///
    /// # Errors
    /// Never for settings that have the key.
    pub fn over(self, settings: Settings) -> Result<Settings> {
        match self.antialiased {
            Some(antialiased) => with(settings, antialiased),
            None => Ok(settings),
        }
    }
}

/// `settings` in that mode.
///
/// # Errors
/// Never for settings that have the key.
pub(super) fn with(settings: Settings, antialiased: bool) -> Result<Settings> {
    settings.with_override(&format!("{KEY}={antialiased}"))
}

/// What pruning shares of the settings of a model's run.
///
/// # Errors
/// When the settings contradict each other.
pub(super) fn carried_to_pruning(recorded: &Settings) -> Result<Settings> {
    let carried = recorded.carried_to(&PRUNE, &["data", "render"]);
    // Of `model` the degree is no setting of pruning: it is that of the model.
    if recorded.resolve()?.model.antialiased { with(carried, true) } else { Ok(carried) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_asked_for_wins_over_the_model() {
        let asked = |antialiased| AntialiasedArgs { antialiased };
        assert!(asked(None).or(true) && !asked(None).or(false) && asked(Some(true)).or(false));
        assert!(!asked(Some(false)).or(true));
        let mode = |settings: Settings| settings.resolve().expect("valid").model.antialiased;
        let of_run = with(Settings::new(), true).expect("a setting");
        assert!(mode(asked(None).over(of_run.clone()).expect("valid")));
        assert!(!mode(asked(Some(false)).over(of_run.clone()).expect("valid")));
        let pruning = carried_to_pruning(&of_run).and_then(|s| s.resolve_pruning()).expect("valid").0;
        assert!(pruning.model.antialiased);
        let plain = carried_to_pruning(&Settings::new()).and_then(|s| s.resolve_pruning()).expect("valid").0;
        assert!(!plain.model.antialiased);
    }
}
