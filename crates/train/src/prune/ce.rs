//! Computational efficiency (RTGS Eq. 3): what a Gaussian earns per tile it costs.

use super::criterion::{Criterion, RowValues, Ties};
use gazesplat_render::{SplatStats, StatsMode};

/// CE_i = max over views of Val / Comp: pixels dominated over tiles used, 0 where it is used in none. The largest over
/// views, because what matters in one place need not show anywhere else; every training view counts, since a view left
/// out would take all worth from what only it sees.
#[derive(Debug, Clone)]
pub struct CostEfficiency {
    score: Vec<f64>,
    ties: Ties,
}

impl CostEfficiency {
    /// All scores 0.
    pub fn new(num_rows: usize) -> Self {
        Self { score: vec![0.0; num_rows], ties: Ties::new(num_rows) }
    }

    /// The scores so far, `[N]`.
    pub fn scores(&self) -> &[f64] {
        &self.score
    }
}

impl Criterion for CostEfficiency {
    fn stats(&self) -> StatsMode {
        StatsMode::Dominance
    }

    fn accumulate(&mut self, stats: &SplatStats) {
        self.ties.accumulate(stats);
        let counters = stats.pixels_dominated.iter().zip(&stats.tiles_used);
        for (score, (&dominated, &used)) in self.score.iter_mut().zip(counters) {
            if used > 0 {
                *score = score.max(f64::from(dominated) / f64::from(used));
            }
        }
    }

    fn ranking(self: Box<Self>, _rows: &RowValues<'_>) -> Vec<u32> {
        self.ties.ranking(|i| self.score[i])
    }
}

#[cfg(test)]
mod tests {
    use super::super::criterion::tests::view;
    use super::*;

    /// spec/pruning.md, Sec. 10, test 4.
    #[test]
    fn ratio_per_view_and_largest_over_views() {
        let mut ce = CostEfficiency::new(2);
        for (val, comp) in [(10, 5), (0, 3), (6, 2)] {
            ce.accumulate(&view(&[val, 7], &[comp, 0], &[0.5, 0.0]));
        }
        assert_eq!(ce.scores(), [3.0, 0.0]);
    }
}
