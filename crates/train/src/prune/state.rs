//! What the loop does to a model between steps: count, rank, remove, clamp.

use super::criterion::{CriterionKind, RowValues};
use crate::error::Result;
use crate::host;
use crate::optim::ModelState;
use gazesplat_core::Camera;
use gazesplat_render::{RenderOptions, Splats, StatsMode, count};

/// Rows of a model, the least worthy first, and how many of them no view uses.
pub(super) struct Ranked {
    pub order: Vec<u32>,
    pub num_unseen: usize,
}

/// Ranks the rows of `splats` by what `cameras` see of them.
///
/// # Errors
/// When the renderer refuses, or the device does not answer.
pub(super) fn rank(
    kind: CriterionKind,
    splats: &Splats,
    cameras: &[Camera],
    options: &RenderOptions,
) -> Result<Ranked> {
    let mut criterion = kind.start(splats.len());
    let stats = criterion.stats();
    let mut num_unseen = 0;
    if stats != StatsMode::None {
        let options = RenderOptions { stats, ..options.clone() };
        let mut is_seen = vec![false; splats.len()];
        for camera in cameras {
            let counted = count(splats, camera, &options)?.splat_stats;
            for (seen, &used) in is_seen.iter_mut().zip(&counted.tiles_used) {
                *seen |= used > 0;
            }
            criterion.accumulate(&counted);
        }
        num_unseen = is_seen.iter().filter(|seen| !**seen).count();
    }
    let opacity_logits = host::read(splats.opacity_logits.clone())?;
    let log_scales = host::read(splats.log_scales.clone())?;
    let order = criterion.ranking(&RowValues { opacity_logits: &opacity_logits, log_scales: &log_scales });
    Ok(Ranked { order, num_unseen })
}

/// All rows but `removed`, in their order.
pub(super) fn kept(num_rows: usize, removed: &[u32]) -> Vec<u32> {
    let mut stays = vec![true; num_rows];
    for &row in removed {
        stays[row as usize] = false;
    }
    (0..num_rows as u32).filter(|&row| stays[row as usize]).collect()
}

/// Rows that a round removes of `num_rows`: the share, at least one, never below `min_points`.
pub(super) fn num_removed(num_rows: usize, share: f64, min_points: usize) -> usize {
    let wanted = if share > 0.0 { ((share * num_rows as f64) as usize).max(1) } else { 0 };
    wanted.min(num_rows.saturating_sub(min_points))
}

/// Removes rows whose opacity is below `min_opacity`, the most opaque of them staying where fewer than `min_points` would be
/// left. Returns their number.
///
/// # Errors
/// As the operations on the model.
pub(super) fn remove_faded(state: &mut ModelState, min_opacity: f32, min_points: usize) -> Result<usize> {
    let logits = host::read(state.lent().opacity_logits)?;
    let least = (min_opacity / (1.0 - min_opacity)).ln();
    // A logit that is not a number is below every bound.
    let is_faded = |logit: f32| logit.is_nan() || logit < least;
    let mut faded: Vec<u32> = (0..logits.len() as u32).filter(|&i| is_faded(logits[i as usize])).collect();
    let allowed = logits.len().saturating_sub(min_points);
    if faded.len() > allowed {
        // What is no number goes before all numbers: nothing can be drawn of it.
        let place = |i: u32| if logits[i as usize].is_nan() { f32::NEG_INFINITY } else { logits[i as usize] };
        faded.sort_by(|&a, &b| place(a).total_cmp(&place(b)));
        faded.truncate(allowed);
    }
    if !faded.is_empty() {
        state.select_rows(kept(logits.len(), &faded))?;
    }
    Ok(faded.len())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optim::{AdamSettings, Columns};
    use gazesplat_render::cpu_device;

    #[test]
    fn round_removes_its_share_but_keeps_the_least() {
        assert_eq!(num_removed(1000, 0.02, 1), 20);
        assert_eq!(num_removed(10, 0.02, 1), 1);
        assert_eq!(num_removed(1, 0.02, 1), 0);
        assert_eq!(num_removed(100, 0.5, 80), 20);
        assert_eq!(num_removed(100, 0.0, 1), 0);
        assert_eq!(num_removed(5, 0.9, 10), 0);
    }

    #[test]
    fn what_has_faded_goes_and_the_most_opaque_stays() {
        let faded = |opacities: &[f32], min_opacity, min_points| {
            let n = opacities.len();
            let logits: Vec<f32> = opacities.iter().map(|o| (o / (1.0 - o)).ln()).collect();
            let data = [vec![0.0; 3 * n], vec![1.0; 4 * n], vec![0.0; 3 * n], logits, vec![0.0; 3 * n]];
            let params = Columns { data, widths: [3, 4, 3, 1, 3] };
            let mut state = ModelState::new(params, AdamSettings::default(), &cpu_device()).expect("it fits");
            let removed = remove_faded(&mut state, min_opacity, min_points).expect("a CPU answers");
            let logits = host::read(state.lent().opacity_logits).expect("a CPU answers");
            (removed, logits.iter().map(|l| 1.0 / (1.0 + (-l).exp())).collect::<Vec<f32>>())
        };
        let (removed, left) = faded(&[0.5, 0.001, f32::NAN, 0.2], 0.005, 1);
        assert_eq!((removed, left.len()), (2, 2));
        let (removed, left) = faded(&[0.001, f32::NAN, 0.004, 0.002], 0.005, 2);
        assert_eq!(removed, 2);
        assert!((left[0] - 0.004).abs() < 1e-5 && (left[1] - 0.002).abs() < 1e-5, "{left:?}");
        assert_eq!(faded(&[0.001, 0.002], 0.0, 1).0, 0);
    }

    #[test]
    fn kept_rows_keep_their_order() {
        assert_eq!(kept(5, &[3, 0]), [1, 2, 4]);
    }
}
