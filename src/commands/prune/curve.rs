//! Latency against what a model is made of (RTGS Fig. 4): levels of pruning, drawn in turn so that all meet the same machine.

use crate::console::Console;
use crate::diagnostics::Result;
use crate::progress;
use gazesplat_core::View;
use gazesplat_render::{RenderOptions, Splats, StatsMode, render};
use gazesplat_train::evaluate::rgb;
use serde::Serialize;
use std::time::Instant;

/// One model, measured.
#[derive(Debug, Clone, Copy, Serialize)]
pub(crate) struct Level {
    /// Gaussians.
    pub points: usize,
    /// Mean length of a tile's list.
    pub pairs_per_tile: f64,
    /// Mean number of entries of a tile that are worked through.
    pub pairs_used_per_tile: f64,
    /// Milliseconds per frame: mean over views of the median.
    pub ms: f64,
}

/// Frames of every view of every level, of which the median counts.
pub(crate) const REPEATS: usize = 5;

/// Counts and times `levels` on `views`, frame by frame in turn.
pub(crate) fn measure(
    levels: &[Splats],
    views: &[View],
    options: &RenderOptions,
    repeats: usize,
    console: &Console,
) -> Result<Vec<Level>> {
    let mut found = Vec::with_capacity(levels.len());
    let counting = RenderOptions { stats: StatsMode::Tiles, ..options.clone() };
    for splats in levels {
        let (mut pairs, mut used, mut tiles) = (0, 0, 0);
        for view in views {
            let counted = render(splats, &view.camera, &counting)?;
            let sum = |counts: &[u32]| counts.iter().map(|&n| u64::from(n)).sum::<u64>();
            pairs += sum(&counted.splat_stats.tiles.num_pairs);
            used += sum(&counted.splat_stats.tiles.num_pairs_used);
            tiles += counted.splat_stats.tiles.num_pairs.len();
        }
        let per_tile = |n: u64| n as f64 / tiles.max(1) as f64;
        let (pairs_per_tile, pairs_used_per_tile) = (per_tile(pairs), per_tile(used));
        found.push(Level { points: splats.len(), pairs_per_tile, pairs_used_per_tile, ms: 0.0 });
    }
    let bar = progress::counting_bar(console, "timing", views.len() * repeats);
    for view in views {
        let mut times = vec![Vec::with_capacity(repeats); levels.len()];
        for _ in 0..repeats {
            for (splats, times) in levels.iter().zip(&mut times) {
                let started = Instant::now();
                rgb(render(splats, &view.camera, options)?)?;
                times.push(started.elapsed().as_secs_f64() * 1e3);
            }
            bar.inc(1);
        }
        for (level, mut times) in found.iter_mut().zip(times) {
            times.sort_by(f64::total_cmp);
            level.ms += times[times.len() / 2] / views.len() as f64;
        }
    }
    bar.finish_and_clear();
    Ok(found)
}

/// Pearson's correlation of two quantities over the levels; `None` where one of them does not vary.
pub(crate) fn correlation(levels: &[Level], a: fn(&Level) -> f64, b: fn(&Level) -> f64) -> Option<f64> {
    let n = levels.len() as f64;
    let mean = |of: fn(&Level) -> f64| levels.iter().map(of).sum::<f64>() / n;
    let (mean_a, mean_b) = (mean(a), mean(b));
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for level in levels {
        let (da, db) = (a(level) - mean_a, b(level) - mean_b);
        ab += da * db;
        aa += da * da;
        bb += db * db;
    }
    (aa > 0.0 && bb > 0.0).then(|| ab / (aa * bb).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn correlation_of_what_follows_and_what_does_not() {
        let level = |points, used, ms| Level { points, pairs_per_tile: 0.0, pairs_used_per_tile: used, ms };
        let levels = [level(100, 40.0, 8.0), level(80, 20.0, 4.0), level(60, 10.0, 2.0)];
        let with_used = correlation(&levels, |l| l.ms, |l| l.pairs_used_per_tile).expect("they vary");
        assert!((with_used - 1.0).abs() < 1e-12);
        let with_points = correlation(&levels, |l| l.ms, |l| l.points as f64).expect("they vary");
        assert!(with_points > 0.9 && with_points < 1.0);
        assert_eq!(correlation(&levels, |l| l.ms, |l| l.pairs_per_tile), None);
    }
}
