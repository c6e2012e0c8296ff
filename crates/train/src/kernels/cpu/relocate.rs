//! Relocation and growth of MCMC (Kheradmand 2024, Sec. 3.4): dead Gaussians take the place of parts of live ones, new
//! ones are added the same way.
//!
//! A survey weighs every row (a job of rows per thread), sources are drawn by weight, drawn rows are divided (Eq. 9),
//! copies are written. A row with a value that is not finite, or absurd, counts as dead; a model in which no row is
//! alive, or that has none, is left alone. Reads and writes parameters and moments. Draws depend on seed, step and the
//! number of the copy only.

use super::rows::Rows;
use super::sweep::broken;
use crate::backend::Refinement;
use crate::densify::Broken;
use crate::densify::relocation::{MAX_PARTS, RelocationTable};
use crate::event::{BrokenCounts, DensifyReport};
use crate::optim::{Columns, Group};
use crate::rng::{Stream, draw, uniform_f64};
use rayon::prelude::*;

/// Weights of the rows as sources (their opacities, 0 for dead ones), the dead rows, and what is wrong with the broken ones.
fn survey(params: &Columns, refinement: &Refinement) -> (Vec<f64>, Vec<usize>, BrokenCounts) {
    let states: Vec<(f64, Option<Broken>)> = (0..params.num_rows())
        .into_par_iter()
        .map(|i| {
            if let Some(reason) = broken(params, i, &refinement.bounds) {
                return (0.0, Some(reason));
            }
            let opacity = sigmoid(f64::from(params.of(Group::OpacityLogits)[i]));
            (if opacity <= f64::from(refinement.min_opacity) { 0.0 } else { opacity }, None)
        })
        .collect();
    let dead = (0..states.len()).filter(|&i| states[i].0 == 0.0).collect();
    let broken = states.iter().filter_map(|s| s.1).collect();
    (states.into_iter().map(|s| s.0).collect(), dead, broken)
}

/// `count` rows drawn by weight, and the division of the drawn ones done: each keeps its place with the opacity and
/// scale of one of its parts. Empty when no row has a weight.
fn draw_sources(
    rows: &mut Rows,
    weights: &[f64],
    count: usize,
    refinement: &Refinement,
    first_index: usize,
) -> Vec<usize> {
    let mut cumulative = Vec::with_capacity(weights.len());
    let mut total = 0.0;
    for weight in weights {
        total += weight;
        cumulative.push(total);
    }
    if total <= 0.0 {
        return Vec::new();
    }
    let last = weights.iter().rposition(|w| *w > 0.0).expect("the total is positive");
    let sources: Vec<usize> = (0..count)
        .into_par_iter()
        .map(|i| {
            let words = draw(refinement.seed, Stream::Sampling, refinement.step, (first_index + i) as u64);
            let u = uniform_f64(words[0], words[1]) * total;
            cumulative.partition_point(|c| *c <= u).min(last)
        })
        .collect();
    let table = RelocationTable::shared();
    let mut num_drawn = vec![0usize; weights.len()];
    for &source in &sources {
        num_drawn[source] += 1;
    }
    for (row, &drawn) in num_drawn.iter().enumerate().filter(|(_, drawn)| **drawn > 0) {
        let (opacity, factor) = table.split(weights[row], (drawn + 1).min(MAX_PARTS));
        // Never below the threshold of death: a part has to get the chance to grow.
        let opacity = opacity.clamp(f64::from(refinement.min_opacity), 1.0 - 1e-6);
        rows.params.of_mut(Group::OpacityLogits)[row] = (opacity / (1.0 - opacity)).ln() as f32;
        let shift = factor.ln() as f32;
        rows.params.row_mut(Group::LogScales, row).iter_mut().for_each(|s| *s += shift);
        rows.zero_moments(row);
    }
    sources
}

/// Moves the dead rows onto live ones, then adds rows.
pub fn refine(rows: &mut Rows, refinement: &Refinement) -> DensifyReport {
    let (weights, dead, broken) = survey(&rows.params, refinement);
    let sources = draw_sources(rows, &weights, dead.len(), refinement, 0);
    for (&target, &source) in dead.iter().zip(&sources) {
        rows.replace(target, source);
    }
    let num_added = refinement.num_added(rows.num_rows());
    let mut num_appended = 0;
    if num_added > 0 {
        let (weights, ..) = survey(&rows.params, refinement);
        let sources = draw_sources(rows, &weights, num_added, refinement, dead.len());
        rows.append_copies(&sources);
        num_appended = sources.len();
    }
    // Either every dead row was moved, or there was no source and none was.
    let broken = if sources.is_empty() { BrokenCounts::default() } else { broken };
    DensifyReport {
        num_relocated: sources.len() - broken.total(),
        broken,
        num_added: num_appended,
        num_gaussians: rows.num_rows(),
        ..DensifyReport::default()
    }
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::densify::Bounds;

    fn rows(opacities: &[f32]) -> Rows {
        let n = opacities.len();
        let logits = opacities.iter().map(|o| (o / (1.0 - o)).ln()).collect();
        let means = (0..3 * n).map(|i| i as f32).collect();
        let data = [means, [1.0, 0.0, 0.0, 0.0].repeat(n), vec![-2.0; 3 * n], logits, vec![0.1; 3 * n]];
        Rows::new(Columns { data, widths: [3, 4, 3, 1, 3] })
    }

    fn refinement(cap: usize) -> Refinement {
        Refinement {
            seed: 3,
            step: 500,
            growth: 1.05,
            cap,
            min_opacity: 0.005,
            bounds: Bounds { center: [0.0; 3], max_log_scale: 1000f32.ln(), max_distance: 1e5 },
        }
    }

    #[test]
    fn relocation_keeps_the_composited_opacity_at_every_place() {
        let mut opacities = vec![0.6f32; 50];
        opacities.extend([0.001; 30]);
        let mut rows = rows(&opacities);
        let report = refine(&mut rows, &refinement(80));
        assert_eq!((report.num_relocated, report.num_added, report.num_gaussians), (30, 0, 80));
        for row in 0..50 {
            let place = rows.params.row(Group::Means, row).to_vec();
            let transmittance: f64 = (0..80)
                .filter(|&i| rows.params.row(Group::Means, i) == place)
                .map(|i| 1.0 - sigmoid(f64::from(rows.params.of(Group::OpacityLogits)[i])))
                .product();
            assert!((1.0 - transmittance - 0.6).abs() < 1e-5, "{row}: {transmittance}");
        }
    }

    #[test]
    fn growth_ends_at_the_cap() {
        let mut rows = rows(&[0.5; 100]);
        assert_eq!(refine(&mut rows, &refinement(108)).num_added, 5);
        assert_eq!(refine(&mut rows, &refinement(108)).num_added, 3);
        assert_eq!(refine(&mut rows, &refinement(108)).num_added, 0);
        assert_eq!(rows.first.num_rows(), 108);
    }

    #[test]
    fn broken_gaussians_are_replaced_and_counted() {
        let mut rows = rows(&[0.5; 10]);
        rows.params.row_mut(Group::Sh, 2)[1] = f32::NAN;
        rows.params.row_mut(Group::LogScales, 4)[0] = 40.0;
        rows.params.row_mut(Group::Means, 6)[2] = 1e7;
        let report = refine(&mut rows, &refinement(10));
        assert_eq!((report.num_relocated, report.broken), (0, BrokenCounts { non_finite: 1, huge: 1, far: 1 }));
        assert!(rows.params.data.iter().flatten().all(|v| v.is_finite()));
    }

    #[test]
    fn a_model_without_live_gaussians_is_left_alone() {
        let mut rows = rows(&[0.001; 10]);
        let before = rows.clone();
        assert_eq!(refine(&mut rows, &refinement(20)).num_relocated, 0);
        assert_eq!(rows, before);
    }
}
