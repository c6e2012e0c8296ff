//! Which Gaussians ADC clones, splits and removes: one decision on the host for every device.
//!
//! As in the code of 3DGS the growth comes first and what is left is judged, copies and parts included. Deviation, ours:
//! where the cap leaves no room for all that would grow, those with the largest statistic do, the lower row on ties.

use super::bounds::Broken;
use crate::backend::Densification;
use crate::event::{BrokenCounts, DensifyReport};

/// ln(0.8 · 2): the log scale that each of two parts loses (code of 3DGS).
pub const SPLIT_LOG_SCALE: f32 = 0.470_003_63;

/// What a decision reads of a row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Figures {
    /// Mean of the statistic over the views that saw the row; 0 for none.
    pub statistic: f32,
    /// Largest log scale.
    pub log_scale: f32,
    /// Opacity logit.
    pub opacity_logit: f32,
    /// What is wrong with it.
    pub broken: Option<Broken>,
}

/// What becomes of the rows.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Decision {
    /// Rows that stay, ascending.
    pub kept: Vec<u32>,
    /// Rows that get a copy, ascending; they stay too.
    pub cloned: Vec<u32>,
    /// Rows that two parts replace, ascending.
    pub split: Vec<u32>,
    /// Everything counted.
    pub report: DensifyReport,
}

impl Decision {
    /// The row that each new row begins as: the kept ones, the copies, the parts.
    pub fn sources(&self) -> Vec<u32> {
        let parts = self.split.iter().flat_map(|&row| [row; 2]);
        self.kept.iter().chain(&self.cloned).copied().chain(parts).collect()
    }

    /// First part.
    pub fn first_part(&self) -> usize {
        self.kept.len() + self.cloned.len()
    }

    /// Whether every row stays as it is.
    pub fn is_nothing(&self, num_rows: usize) -> bool {
        self.kept.len() == num_rows && self.cloned.is_empty()
    }
}

/// A row that would grow.
struct Candidate {
    row: u32,
    statistic: f32,
    is_clone: bool,
    /// Whether it goes unless it is split.
    is_large: bool,
}

/// The decision for rows of these figures; `None` when none would be left: such a model is left alone.
pub fn decide(rows: &[Figures], d: &Densification) -> Option<Decision> {
    let is_large = |log_scale: f32| d.max_log_scale.is_some_and(|max| log_scale > max);
    let mut report = DensifyReport::default();
    let mut stays = vec![false; rows.len()];
    let mut candidates = Vec::new();
    for (row, figures) in rows.iter().enumerate().filter(|(_, f)| f.broken.is_none()) {
        let &Figures { statistic, log_scale, opacity_logit, .. } = figures;
        let grows = statistic > d.grow_gradient;
        let is_clone = log_scale <= d.max_clone_log_scale;
        let becomes = if grows && !is_clone { log_scale - SPLIT_LOG_SCALE } else { log_scale };
        if opacity_logit < d.min_logit {
            report.num_transparent += 1;
        } else if is_large(becomes) {
            report.num_large += 1;
        } else {
            let is_large = is_large(log_scale);
            stays[row] = !is_large;
            if grows {
                candidates.push(Candidate { row: row as u32, statistic, is_clone, is_large });
            }
        }
    }
    report.broken = rows.iter().filter_map(|f| f.broken).collect::<BrokenCounts>();
    // One row more for each that grows; two where the row itself would go.
    let mut room = d.cap.saturating_sub(stays.iter().filter(|stays| **stays).count());
    let cost = |c: &Candidate| if c.is_large { 2 } else { 1 };
    if candidates.iter().map(cost).sum::<usize>() > room {
        candidates.sort_by(|a, b| b.statistic.total_cmp(&a.statistic).then(a.row.cmp(&b.row)));
    }
    let (mut cloned, mut split) = (Vec::new(), Vec::new());
    for candidate in candidates {
        let Some(left) = room.checked_sub(cost(&candidate)) else {
            report.num_large += usize::from(candidate.is_large);
            continue;
        };
        room = left;
        if candidate.is_clone {
            cloned.push(candidate.row);
        } else {
            split.push(candidate.row);
            stays[candidate.row as usize] = false;
        }
    }
    cloned.sort_unstable();
    split.sort_unstable();
    let kept: Vec<u32> = (0..rows.len() as u32).filter(|&row| stays[row as usize]).collect();
    report.num_cloned = cloned.len();
    report.num_split = split.len();
    report.num_added = cloned.len() + split.len();
    report.num_gaussians = kept.len() + cloned.len() + 2 * split.len();
    (report.num_gaussians > 0).then_some(Decision { kept, cloned, split, report })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::densify::Bounds;

    fn densification(cap: usize, max_log_scale: Option<f32>) -> Densification {
        Densification {
            seed: 1,
            step: 600,
            cap,
            grow_gradient: 2e-4,
            max_clone_log_scale: 0.01f32.ln(),
            min_logit: logit(0.005),
            max_log_scale,
            bounds: Bounds::of_scene([0.0; 3], 1.0),
            reset_logit: None,
        }
    }

    fn logit(opacity: f32) -> f32 {
        (opacity / (1.0 - opacity)).ln()
    }

    fn row(statistic: f32, scale: f32, opacity: f32) -> Figures {
        Figures { statistic, log_scale: scale.ln(), opacity_logit: logit(opacity), broken: None }
    }

    #[test]
    fn small_rows_are_cloned_large_ones_split_and_faint_ones_removed() {
        let broken = Figures { broken: Some(Broken::Huge), ..row(1.0, 0.5, 0.5) };
        let rows = [
            row(3e-4, 0.005, 0.5),  // cloned
            row(3e-4, 0.05, 0.5),   // split
            row(1e-4, 0.005, 0.5),  // stays
            row(3e-4, 0.05, 0.004), // would be split, and its parts removed
            broken,
            row(2e-4, 0.05, 0.5), // on the threshold, not above
            row(0.0, 0.5, 0.5),   // large, which is nothing yet
        ];
        let decision = decide(&rows, &densification(100, None)).expect("rows are left");
        assert_eq!(
            (&decision.kept[..], &decision.cloned[..], &decision.split[..]),
            (&[0, 2, 5, 6][..], &[0][..], &[1][..])
        );
        assert_eq!(decision.sources(), [0, 2, 5, 6, 0, 1, 1]);
        assert_eq!(decision.first_part(), 5);
        let report = decision.report;
        assert_eq!((report.num_cloned, report.num_split, report.num_added), (1, 1, 2));
        assert_eq!((report.num_transparent, report.num_large, report.broken.huge), (1, 0, 1));
        assert_eq!(report.num_gaussians, 7);
        assert!(!decision.is_nothing(7));
        assert!(decide(&rows[2..3], &densification(100, None)).expect("a row is left").is_nothing(1));
    }

    #[test]
    fn large_rows_go_unless_their_parts_are_small_enough() {
        let rows = [
            row(0.0, 0.11, 0.5),  // goes
            row(3e-4, 0.15, 0.5), // its parts of 0.094 stay
            row(3e-4, 0.17, 0.5), // its parts of 0.106 go, too
            row(0.0, 0.09, 0.5),  // stays
        ];
        let decision = decide(&rows, &densification(100, Some(0.1f32.ln()))).expect("rows are left");
        assert_eq!((&decision.kept[..], &decision.split[..]), (&[3][..], &[1][..]));
        assert_eq!((decision.report.num_large, decision.report.num_gaussians), (2, 3));
        // Without room for its parts the second goes, too.
        let decision = decide(&rows, &densification(2, Some(0.1f32.ln()))).expect("rows are left");
        assert_eq!((&decision.kept[..], &decision.split[..], decision.report.num_large), (&[3][..], &[][..], 3));
    }

    #[test]
    fn what_the_cap_has_room_for_goes_to_the_largest_statistics() {
        let rows: Vec<Figures> =
            [5e-4, 9e-4, 1e-4, 9e-4, 3e-4].map(|s| row(s, if s > 6e-4 { 0.05 } else { 0.005 }, 0.5)).to_vec();
        for (cap, cloned, split) in [
            (4, &[][..], &[][..]),
            (5, &[], &[]),
            (6, &[], &[1]),
            (7, &[], &[1, 3]),
            (8, &[0], &[1, 3]),
            (9, &[0, 4], &[1, 3]),
            (50, &[0, 4], &[1, 3]),
        ] {
            let decision = decide(&rows, &densification(cap, None)).expect("rows are left");
            assert_eq!((&decision.cloned[..], &decision.split[..]), (cloned, split), "{cap}");
            assert!(decision.report.num_gaussians <= cap.max(5), "{cap}");
            assert_eq!(decision.sources().len(), decision.report.num_gaussians);
        }
    }

    #[test]
    fn a_model_of_which_nothing_would_be_left_is_left_alone() {
        assert_eq!(decide(&[row(1.0, 0.5, 0.001); 3], &densification(10, None)), None);
        assert_eq!(decide(&[], &densification(10, None)), None);
    }
}
