//! What refinement of the camera poses leaves: a file, and a sentence.

use crate::console::Console;
use crate::diagnostics::Result;
use crate::run_dir::RunDir;
use gazesplat_core::View;
use gazesplat_train::poses::PoseChange;

/// The training views of a run where they turned out to be.
#[derive(Debug)]
pub(crate) struct Refined {
    /// The views, in the order of the run.
    pub views: Vec<View>,
    /// How far they are from where they were given.
    pub described: String,
}

impl Refined {
    /// Writes `poses.json` and tells how far the poses moved; nothing for a run that refines none.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn keep(found: Option<(Vec<View>, PoseChange)>, run_dir: &RunDir, console: &Console) -> Result<Option<Self>> {
        let Some((views, change)) = found else { return Ok(None) };
        run_dir.write_poses(&views)?;
        let described = describe(&change);
        console.note(format_args!("camera poses: {described}; `{}` holds them", run_dir.poses_path().display()));
        Ok(Some(Self { views, described }))
    }
}

fn describe(change: &PoseChange) -> String {
    let PoseChange { degrees: [turn, most_turn], extents: [shift, most_shift] } = *change;
    format!(
        "turned by {turn:.3}° and moved by {:.2} % of the extent on average, by {most_turn:.3}° and {:.2} % at most",
        100.0 * shift,
        100.0 * most_shift
    )
}
