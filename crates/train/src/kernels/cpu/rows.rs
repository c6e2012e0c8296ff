//! Rows of the parameters and of both moments, added, replaced and widened together.

use crate::optim::{Columns, Group};
use gazesplat_render::cluster::morton_order;

/// Parameters with the moments of their optimiser: what densification works on.
#[derive(Debug, Clone, PartialEq)]
pub struct Rows {
    /// The parameters.
    pub params: Columns,
    /// First moments, one per parameter.
    pub first: Columns,
    /// Second moments, one per parameter.
    pub second: Columns,
}

impl Rows {
    /// Parameters whose moments are zero.
    pub fn new(params: Columns) -> Self {
        Self { first: params.zeros_like(), second: params.zeros_like(), params }
    }

    /// Number of rows N.
    pub fn num_rows(&self) -> usize {
        self.params.num_rows()
    }

    /// Appends a copy of each row in `sources`, with zero moments.
    ///
    /// # Panics
    /// If a source is not a row.
    pub fn append_copies(&mut self, sources: &[usize]) {
        for group in Group::ALL {
            let g = group as usize;
            let width = self.params.widths[g];
            let values = &mut self.params.data[g];
            values.reserve(sources.len() * width);
            for &source in sources {
                values.extend_from_within(source * width..(source + 1) * width);
            }
            let len = values.len();
            self.first.data[g].resize(len, 0.0);
            self.second.data[g].resize(len, 0.0);
        }
    }

    /// Puts row `order[i]` at place i, in parameters and moments; rows that `order` leaves out are gone.
    ///
    /// # Panics
    /// If `order` names something that is not a row.
    pub fn reorder(&mut self, order: &[u32]) {
        for columns in [&mut self.params, &mut self.first, &mut self.second] {
            for (data, &width) in columns.data.iter_mut().zip(&columns.widths) {
                let mut moved = Vec::with_capacity(order.len() * width);
                for &row in order {
                    moved.extend_from_slice(&data[row as usize * width..][..width]);
                }
                *data = moved;
            }
        }
    }

    /// Orders the rows along a Morton curve, so that neighbours in memory are neighbours in space.
    pub fn sort_spatially(&mut self) {
        let order = morton_order(self.params.data[Group::Means as usize].as_chunks().0);
        self.reorder(&order);
    }

    /// Overwrites row `target` with row `source`; both lose their moments.
    ///
    /// # Panics
    /// If one of them is not a row.
    pub fn replace(&mut self, target: usize, source: usize) {
        for g in 0..Group::ALL.len() {
            let width = self.params.widths[g];
            self.params.data[g].copy_within(source * width..(source + 1) * width, target * width);
        }
        self.zero_moments(target);
        self.zero_moments(source);
    }

    /// Forgets the moments of a row.
    ///
    /// # Panics
    /// If it is not a row.
    pub fn zero_moments(&mut self, row: usize) {
        for group in Group::ALL {
            self.first.row_mut(group, row).fill(0.0);
            self.second.row_mut(group, row).fill(0.0);
        }
    }

    /// Gives every row `num_coefficients` SH coefficients; new ones are zero, with zero moments.
    ///
    /// # Panics
    /// If the rows already have more.
    pub fn widen_sh(&mut self, num_coefficients: usize) {
        let g = Group::Sh as usize;
        let (old, new) = (self.params.widths[g], 3 * num_coefficients);
        for columns in [&mut self.params, &mut self.first, &mut self.second] {
            columns.data[g] = widened(&columns.data[g], old, new);
            columns.widths[g] = new;
        }
    }
}

/// Rows of `old` values as rows of `new`, zeros at the end of each.
///
/// # Panics
/// If `new` is smaller than `old`.
fn widened(values: &[f32], old: usize, new: usize) -> Vec<f32> {
    assert!(new >= old, "rows of {old} values cannot be widened to {new}");
    let mut wide = vec![0.0; values.len() / old * new];
    for (to, from) in wide.chunks_exact_mut(new).zip(values.chunks_exact(old)) {
        to[..old].copy_from_slice(from);
    }
    wide
}

#[cfg(test)]
mod tests {
    use super::*;

    fn three_rows() -> Rows {
        let widths = [3, 4, 3, 1, 3];
        let data = widths.map(|w| (0..3 * w).map(|i| (i / w) as f32).collect());
        let params = Columns { data, widths };
        let mut rows = Rows::new(params);
        for columns in [&mut rows.first, &mut rows.second] {
            columns.data.iter_mut().for_each(|d| d.fill(7.0));
        }
        rows
    }

    #[test]
    fn appended_rows_are_copies_without_moments() {
        let mut state = three_rows();
        state.append_copies(&[2, 0]);
        for group in Group::ALL {
            assert!(state.params.row(group, 3).iter().all(|v| *v == 2.0));
            assert!(state.params.row(group, 4).iter().all(|v| *v == 0.0));
            assert!(state.first.row(group, 3).iter().all(|v| *v == 0.0));
            assert!(state.second.row(group, 2).iter().all(|v| *v == 7.0));
        }
        assert_eq!(state.num_rows(), 5);
    }

    #[test]
    fn replacing_forgets_the_moments_of_both_rows() {
        let mut state = three_rows();
        state.replace(0, 2);
        for group in Group::ALL {
            assert!(state.params.row(group, 0).iter().all(|v| *v == 2.0));
            assert!([0, 2].iter().all(|&r| state.first.row(group, r).iter().all(|v| *v == 0.0)));
            assert!(state.second.row(group, 1).iter().all(|v| *v == 7.0));
        }
    }

    #[test]
    fn widened_rows_keep_their_first_values() {
        let mut state = three_rows();
        state.widen_sh(4);
        let row = state.params.row(Group::Sh, 2);
        assert_eq!(row[..3], [2.0; 3]);
        assert_eq!(row[3..], [0.0; 9]);
        assert_eq!(state.first.data[Group::Sh as usize].len(), 36);
    }
}
