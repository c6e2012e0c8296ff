//! Criteria of one quantity: what CE is compared with.

use super::criterion::{Criterion, RowValues, Ties};
use gazesplat_render::{SplatStats, StatsMode};

/// Pixels dominated, the largest over views: CE without its denominator.
#[derive(Debug, Clone)]
pub struct Surface {
    dominated: Vec<u32>,
    ties: Ties,
}

impl Surface {
    /// No pixels yet.
    pub fn new(num_rows: usize) -> Self {
        Self { dominated: vec![0; num_rows], ties: Ties::new(num_rows) }
    }
}

impl Criterion for Surface {
    fn stats(&self) -> StatsMode {
        StatsMode::Dominance
    }

    fn accumulate(&mut self, stats: &SplatStats) {
        self.ties.accumulate(stats);
        for (kept, &pixels) in self.dominated.iter_mut().zip(&stats.pixels_dominated) {
            *kept = (*kept).max(pixels);
        }
    }

    fn ranking(self: Box<Self>, _rows: &RowValues<'_>) -> Vec<u32> {
        self.ties.ranking(|i| f64::from(self.dominated[i]))
    }
}

/// Opacity; needs no view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Opacity;

impl Criterion for Opacity {
    fn stats(&self) -> StatsMode {
        StatsMode::None
    }

    fn accumulate(&mut self, _stats: &SplatStats) {}

    fn ranking(self: Box<Self>, rows: &RowValues<'_>) -> Vec<u32> {
        Ties::new(rows.len()).ranking(|i| f64::from(rows.opacity_logits[i]))
    }
}

/// Largest weight T·α in any pixel of any view.
#[derive(Debug, Clone)]
pub struct MaxContribution(Ties);

impl MaxContribution {
    /// No weight yet.
    pub fn new(num_rows: usize) -> Self {
        Self(Ties::new(num_rows))
    }
}

impl Criterion for MaxContribution {
    fn stats(&self) -> StatsMode {
        StatsMode::Dominance
    }

    fn accumulate(&mut self, stats: &SplatStats) {
        self.0.accumulate(stats);
    }

    fn ranking(self: Box<Self>, _rows: &RowValues<'_>) -> Vec<u32> {
        self.0.ranking(|i| f64::from(self.0.weight_max(i)))
    }
}

#[cfg(test)]
mod tests {
    use super::super::criterion::{CriterionKind, tests::view};
    use super::*;

    #[test]
    fn one_view_in_which_it_matters_is_enough() {
        let rows = RowValues { opacity_logits: &[0.0, -1.0, 2.0], log_scales: &[0.0; 9] };
        let ranked = |kind: CriterionKind| {
            let mut criterion = kind.start(3);
            criterion.accumulate(&view(&[9, 0, 3], &[9, 1, 1], &[0.2, 0.9, 0.3]));
            criterion.accumulate(&view(&[0, 8, 3], &[1, 8, 1], &[0.0, 0.1, 0.5]));
            criterion.ranking(&rows)
        };
        assert_eq!(ranked(CriterionKind::Surface), [2, 1, 0]);
        assert_eq!(ranked(CriterionKind::MaxContribution), [0, 2, 1]);
        assert_eq!(ranked(CriterionKind::Opacity), [1, 0, 2]);
        // Per tile the small one is worth most: 1, 1, 3; of the two others the fainter goes first.
        assert_eq!(ranked(CriterionKind::Ce), [0, 1, 2]);
    }
}
