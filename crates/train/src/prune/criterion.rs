//! What a Gaussian is worth: criteria by which the least worthy are removed, one idea per file.

use super::ce::CostEfficiency;
use super::significance::Significance;
use super::simple::{MaxContribution, Opacity, Surface};
use gazesplat_render::{SplatStats, StatsMode};
use serde::{Deserialize, Serialize};

/// A way to rank Gaussians. It sees every training view once, then ranks.
pub trait Criterion: Send {
    /// Counters it needs of every view; [`StatsMode::None`] = it needs no views.
    fn stats(&self) -> StatsMode;

    /// Takes in the counters of a view.
    fn accumulate(&mut self, stats: &SplatStats);

    /// All rows, the least worthy first.
    fn ranking(self: Box<Self>, rows: &RowValues<'_>) -> Vec<u32>;
}

/// Parameters of N Gaussians that a ranking may read.
#[derive(Debug, Clone, Copy)]
pub struct RowValues<'a> {
    /// Logits of the opacities, `[N]`.
    pub opacity_logits: &'a [f32],
    /// Logarithms of the scales, `[N, 3]`.
    pub log_scales: &'a [f32],
}

impl RowValues<'_> {
    /// Number of Gaussians N.
    pub fn len(&self) -> usize {
        self.opacity_logits.len()
    }

    /// True when there is no Gaussian.
    pub fn is_empty(&self) -> bool {
        self.opacity_logits.is_empty()
    }
}

/// The criteria by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CriterionKind {
    /// Pixels dominated per tile used, the largest over views (RTGS Eq. 3).
    #[default]
    Ce,
    /// Pixels dominated, the largest over views.
    Surface,
    /// Opacity.
    Opacity,
    /// Largest weight in any pixel of any view.
    MaxContribution,
    /// Global significance of LightGaussian: opacity times pixels blended times a power of the volume.
    Significance,
}

impl CriterionKind {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Ce, Self::Surface, Self::Opacity, Self::MaxContribution, Self::Significance];

    /// Name, as in settings and tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ce => "ce",
            Self::Surface => "surface",
            Self::Opacity => "opacity",
            Self::MaxContribution => "max_contribution",
            Self::Significance => "significance",
        }
    }

    /// A fresh criterion for `num_rows` Gaussians.
    pub fn start(self, num_rows: usize) -> Box<dyn Criterion> {
        match self {
            Self::Ce => Box::new(CostEfficiency::new(num_rows)),
            Self::Surface => Box::new(Surface::new(num_rows)),
            Self::Opacity => Box::new(Opacity),
            Self::MaxContribution => Box::new(MaxContribution::new(num_rows)),
            Self::Significance => Box::new(Significance::new(num_rows)),
        }
    }
}

impl std::str::FromStr for CriterionKind {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|kind| kind.name() == text).ok_or_else(|| {
            format!("`{text}` is no criterion: expected one of {}", Self::ALL.map(Self::name).join(", "))
        })
    }
}

impl std::fmt::Display for CriterionKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// Orders Gaussians of equal score in a way that does not depend on the order of the rows: those that show least in any
/// view first, among them those in most tiles. Many Gaussians of a dense model have a score of exactly 0.
#[derive(Debug, Clone)]
pub(super) struct Ties {
    weight_max: Vec<f32>,
    tiles_used: Vec<u32>,
}

impl Ties {
    pub(super) fn new(num_rows: usize) -> Self {
        Self { weight_max: vec![0.0; num_rows], tiles_used: vec![0; num_rows] }
    }

    pub(super) fn accumulate(&mut self, stats: &SplatStats) {
        for (kept, &w) in self.weight_max.iter_mut().zip(&stats.weight_max) {
            *kept = kept.max(w);
        }
        for (kept, &n) in self.tiles_used.iter_mut().zip(&stats.tiles_used) {
            *kept = (*kept).max(n);
        }
    }

    /// Rows by (score, largest weight, −most tiles, row), ascending; a score that is not a number comes first.
    pub(super) fn ranking(&self, score: impl Fn(usize) -> f64) -> Vec<u32> {
        let scores: Vec<f64> = (0..self.weight_max.len())
            .map(|i| {
                let score = score(i);
                if score.is_nan() { f64::NEG_INFINITY } else { score }
            })
            .collect();
        let mut order: Vec<u32> = (0..scores.len() as u32).collect();
        order.sort_unstable_by(|&a, &b| {
            let (i, j) = (a as usize, b as usize);
            scores[i]
                .total_cmp(&scores[j])
                .then(self.weight_max[i].total_cmp(&self.weight_max[j]))
                .then(self.tiles_used[j].cmp(&self.tiles_used[i]))
                .then(a.cmp(&b))
        });
        order
    }

    /// The largest weight of a row.
    pub(super) fn weight_max(&self, row: usize) -> f32 {
        self.weight_max[row]
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Counters of one view, `[N]` each: Val, Comp, largest weight.
    pub(crate) fn view(dominated: &[u32], used: &[u32], weight: &[f32]) -> SplatStats {
        SplatStats {
            tiles_used: used.to_vec(),
            pixels_dominated: dominated.to_vec(),
            weight_max: weight.to_vec(),
            ..SplatStats::default()
        }
    }

    #[test]
    fn ties_are_broken_by_what_shows_then_by_what_costs() {
        let mut ties = Ties::new(4);
        ties.accumulate(&view(&[0; 4], &[1, 5, 2, 5], &[0.1, 0.0, 0.0, 0.0]));
        assert_eq!(ties.ranking(|_| 0.0), [1, 3, 2, 0]);
        assert_eq!(ties.ranking(|i| if i == 0 { f64::NAN } else { 1.0 }), [0, 1, 3, 2]);
    }

    #[test]
    fn names_read_back() {
        for kind in CriterionKind::ALL {
            assert_eq!(kind.name().parse(), Ok(kind));
        }
        assert!("cf".parse::<CriterionKind>().expect_err("unknown").contains("max_contribution"));
    }
}
