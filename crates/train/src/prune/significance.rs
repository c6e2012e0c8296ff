//! Global significance (Fan 2023, LightGaussian): the count-based criterion that CE is compared with.

use super::criterion::{Criterion, RowValues, Ties};
use gazesplat_render::{SplatStats, StatsMode};

/// o · Σ_v pixels blended · (s_x s_y s_z)^0.1. The normaliser of the volume is the same for all and cannot change the
/// ranking.
#[derive(Debug, Clone)]
pub struct Significance {
    pixels: Vec<u64>,
    ties: Ties,
}

/// Power of the volume (Fan 2023, β).
const VOLUME_POWER: f64 = 0.1;

impl Significance {
    /// No pixels yet.
    pub fn new(num_rows: usize) -> Self {
        Self { pixels: vec![0; num_rows], ties: Ties::new(num_rows) }
    }
}

impl Criterion for Significance {
    fn stats(&self) -> StatsMode {
        StatsMode::All
    }

    fn accumulate(&mut self, stats: &SplatStats) {
        self.ties.accumulate(stats);
        for (sum, &pixels) in self.pixels.iter_mut().zip(&stats.pixels_blended) {
            *sum += u64::from(pixels);
        }
    }

    fn ranking(self: Box<Self>, rows: &RowValues<'_>) -> Vec<u32> {
        let scales = rows.log_scales.as_chunks::<3>().0;
        self.ties.ranking(|i| {
            let opacity = 1.0 / (1.0 + (-f64::from(rows.opacity_logits[i])).exp());
            let log_volume: f64 = scales[i].iter().map(|&s| f64::from(s)).sum();
            opacity * self.pixels[i] as f64 * (VOLUME_POWER * log_volume).exp()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_opacity_and_volume_multiply() {
        let mut significance = Significance::new(3);
        for pixels in [[10, 30, 20], [10, 0, 20]] {
            significance.accumulate(&SplatStats { pixels_blended: pixels.to_vec(), ..SplatStats::default() });
        }
        // Pixels 20, 30, 40; opacities 1/2, 1/2, 1/4; volumes 1, 2⁻¹⁰ (a factor of 1/2), 1: 10, 7.5, 10.
        let thin = -10.0 * std::f32::consts::LN_2;
        let log_scales = [0.0, 0.0, 0.0, thin, 0.0, 0.0, 0.0, 0.0, 1e-3];
        let rows = RowValues { opacity_logits: &[0.0, 0.0, -(3.0f32.ln())], log_scales: &log_scales };
        assert_eq!(Box::new(significance).ranking(&rows), [1, 0, 2]);
    }
}
