//! Scale decay (RTGS Eq. 4–6): the gradient that shrinks Gaussians in many tiles.
//!
//! A job takes 2048 rows; a row touches its own three values only, so nothing depends on the order. A row with a value that
//! is not finite is culled, in no tile, and left alone; an empty model has nothing to do.

use crate::math::excess_tiles;
use rayon::prelude::*;

/// Rows per job.
const ROWS: usize = 2048;

/// Adds `factor` · S_i · G_i to the gradient of the largest log scale of each row, the first on ties (RTGS Eq. 5);
/// S_i is the largest scale, G_i = max(U_i − T, 0). `log_scales` and `grads`: `[N, 3]`; `used`: U, `[N]`.
pub fn add_scale_decay(log_scales: &[f32], grads: &mut [f32], used: &[u32], factor: f32) {
    let jobs = grads.par_chunks_mut(3 * ROWS).zip(log_scales.par_chunks(3 * ROWS)).zip(used.par_chunks(ROWS));
    jobs.for_each(|((grads, log_scales), used)| {
        let rows = grads.as_chunks_mut::<3>().0.iter_mut().zip(log_scales.as_chunks::<3>().0);
        for ((grad, log_scale), &used) in rows.zip(used) {
            let excess = excess_tiles(used);
            if excess > 0.0 {
                let axis = largest_axis(log_scale);
                grad[axis] += factor * log_scale[axis].exp() * excess;
            }
        }
    });
}

/// The axis of the largest of three values, the first on ties.
pub fn largest_axis(values: &[f32; 3]) -> usize {
    let mut axis = 0;
    for (a, v) in values.iter().enumerate().skip(1) {
        if *v > values[axis] {
            axis = a;
        }
    }
    axis
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_of_equal_axes_decays() {
        assert_eq!(largest_axis(&[1.0, 1.0, 0.0]), 0);
        assert_eq!(largest_axis(&[-1.0, -0.5, -0.5]), 1);
        assert_eq!(largest_axis(&[0.0, 1.0, 3.0]), 2);
    }

    #[test]
    fn only_rows_in_more_than_four_tiles_decay() {
        let log_scales = [0.5f32, 0.2, 0.1, 0.1, 0.2, 0.3].map(f32::ln);
        let mut grads = [0.0; 6];
        add_scale_decay(&log_scales, &mut grads, &[10, 4], 1.0);
        assert!((grads[0] - 3.0).abs() < 1e-6 && grads[1..] == [0.0; 5], "{grads:?}");
    }
}
