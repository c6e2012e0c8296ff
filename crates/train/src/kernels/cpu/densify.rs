//! Adaptive density control (3DGS, Sec. 5.2): the statistic by which Gaussians grow, and the clones, parts and removals that
//! follow from it.
//!
//! The statistic takes the rows in view (a job of rows per thread); gradients that are not finite were zeroed by the
//! renderer. The change surveys every row, decides on the whole, copies the rows that stay, are cloned or split, and moves
//! the parts of the latter apart. Kept rows keep their moments, new ones have none. Draws depend on seed, step and row only.
//! A model of which no row would be left is left alone, and so is an empty one.

use super::rows::Rows;
use super::sweep::broken;
use crate::backend::{Densification, StatisticStep};
use crate::densify::growth::{Decision, Figures, SPLIT_LOG_SCALE, decide};
use crate::event::DensifyReport;
use crate::math::{image_norm, shaped};
use crate::optim::Group;
use crate::rng::{Stream, draw, normals};
use gazesplat_render::math::{quat::Quat, vec::Vec3};
use rayon::prelude::*;

/// Rows per job.
const CHUNK: usize = 4096;

/// Adds the gradients of one view, `[N, 4]`, to the statistic, `[N, 2]`: norm and count of the rows `visible`, ascending.
///
/// # Panics
/// If `visible` names something that is not a row.
pub fn add_statistic(statistic: &mut [f32], gradient: &[f32], visible: &[u32], step: &StatisticStep) {
    let [half_width, half_height] = step.half_size;
    let first = if step.absolute { 2 } else { 0 };
    statistic.par_chunks_mut(2 * CHUNK).enumerate().for_each(|(chunk, statistic)| {
        let start = chunk * CHUNK;
        let place = |row: usize| visible.partition_point(|&v| (v as usize) < row);
        for &row in &visible[place(start)..place(start + statistic.len() / 2)] {
            let g = &gradient[4 * row as usize + first..][..2];
            let sums = &mut statistic[2 * (row as usize - start)..][..2];
            sums[0] += image_norm(half_width * g[0], half_height * g[1]);
            sums[1] += 1.0;
        }
    });
}

/// What the decision reads of every row.
fn survey(rows: &Rows, statistic: &[f32], d: &Densification) -> Vec<Figures> {
    let params = &rows.params;
    (0..params.num_rows())
        .into_par_iter()
        .map(|row| {
            let [sum, count] = [statistic[2 * row], statistic[2 * row + 1]];
            let log_scales = params.row(Group::LogScales, row);
            Figures {
                statistic: if count > 0.0 { sum / count } else { 0.0 },
                log_scale: log_scales[0].max(log_scales[1]).max(log_scales[2]),
                opacity_logit: params.of(Group::OpacityLogits)[row],
                broken: broken(params, row, &d.bounds),
            }
        })
        .collect()
}

/// Clones, splits and removes rows, then lowers the opacities when it is time.
///
/// # Panics
/// If `statistic` is not `[N, 2]`.
pub fn densify(rows: &mut Rows, statistic: &[f32], d: &Densification) -> DensifyReport {
    let n = rows.num_rows();
    assert_eq!(statistic.len(), 2 * n, "two values of the statistic per row");
    // 1. What becomes of the rows.
    let Some(decision) = decide(&survey(rows, statistic, d), d) else {
        return DensifyReport { num_gaussians: n, ..DensifyReport::default() };
    };
    let mut report = decision.report;
    if !decision.is_nothing(n) {
        // 2. Copies, of which only the kept rows have moments.
        rows.reorder(&decision.sources());
        for row in decision.kept.len()..rows.num_rows() {
            rows.zero_moments(row);
        }
        // 3. Parts.
        part(rows, &decision, d);
    }
    // 4. Opacities.
    if let Some(logit) = d.reset_logit {
        rows.clamp_opacities(logit);
        report.num_opacity_resets = 1;
    }
    report
}

/// Moves the parts of split rows to places drawn from the Gaussian they replace, and makes them smaller.
fn part(rows: &mut Rows, decision: &Decision, d: &Densification) {
    for (k, &source) in decision.split.iter().flat_map(|row| [row; 2]).enumerate() {
        let row = decision.first_part() + k;
        let words = draw(d.seed, Stream::Sampling, d.step, 2 * u64::from(source) + (k % 2) as u64);
        let [x, y, z] = normals(words);
        let (q, s) = (rows.params.row(Group::Quats, row), rows.params.row(Group::LogScales, row));
        let offset =
            shaped(Quat { w: q[0], x: q[1], y: q[2], z: q[3] }, Vec3 { x: s[0], y: s[1], z: s[2] }, Vec3 { x, y, z });
        let mean = rows.params.row_mut(Group::Means, row);
        for (value, offset) in mean.iter_mut().zip([offset.x, offset.y, offset.z]) {
            *value += offset;
        }
        rows.params.row_mut(Group::LogScales, row).iter_mut().for_each(|s| *s -= SPLIT_LOG_SCALE);
    }
}
