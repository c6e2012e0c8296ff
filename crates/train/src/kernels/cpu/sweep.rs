//! Removal of broken rows: those with a value that is not finite, or beyond the bounds of the scene.
//!
//! Every row is judged by itself (a job of rows per thread); the sound ones stay, in their order, with their moments. A model
//! of which no row would stay is left alone, and so is one that has none.

use super::rows::Rows;
use crate::densify::{Bounds, Broken};
use crate::event::DensifyReport;
use crate::optim::{Columns, Group};
use rayon::prelude::*;

/// What is wrong with a row.
///
/// # Panics
/// If it is not a row.
pub fn broken(params: &Columns, row: usize, bounds: &Bounds) -> Option<Broken> {
    let is_finite = Group::ALL.into_iter().all(|g| params.row(g, row).iter().all(|v| v.is_finite()));
    bounds.judge(is_finite, params.row(Group::LogScales, row), params.row(Group::Means, row))
}

/// Removes the rows beyond `bounds`.
pub fn sweep(rows: &mut Rows, bounds: &Bounds) -> DensifyReport {
    let n = rows.num_rows();
    let params = &rows.params;
    let verdicts: Vec<Option<Broken>> = (0..n).into_par_iter().map(|row| broken(params, row, bounds)).collect();
    let sound: Vec<u32> = (0..n as u32).filter(|&row| verdicts[row as usize].is_none()).collect();
    if sound.len() == n || sound.is_empty() {
        return DensifyReport { num_gaussians: n, ..DensifyReport::default() };
    }
    rows.reorder(&sound);
    let broken = verdicts.into_iter().flatten().collect();
    DensifyReport { broken, num_gaussians: sound.len(), ..DensifyReport::default() }
}
