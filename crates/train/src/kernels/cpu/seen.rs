//! Adam for the SH coefficients of the Gaussians that a view may see; the others' are left until they are needed.
//!
//! Each row has a word: the number of the last update that its moments have seen. [`prepare`] comes before a view is
//! drawn: it marks the rows that the view may see and brings their values up to date ([`crate::optim::missed`]), reading
//! the moments and writing the values only. [`update_seen`] comes with the gradients: it lets the moments of the marked
//! rows decay by what they missed and does the update in the same pass. A row whose word is up to date takes the very
//! update of [`super::adam`]. A job is 256 rows; rows do not depend on each other. NaN stays in its value; a row with a
//! mean that is not finite counts as seen; an empty model has nothing to do.

use super::adam::{Step, flushed, updated};
use super::rows::Rows;
use crate::math::may_be_seen;
use crate::optim::missed::{Missed, PREPARED};
use crate::optim::{Columns, Group, SeenBy};
use crate::simd::{dispatch_simd, fma};
use gazesplat_render::math::vec::Vec3;
use rayon::prelude::*;

/// Rows per job.
const CHUNK: usize = 256;

/// What rows have missed up to one update.
#[derive(Debug, Clone)]
pub struct Missing<'a> {
    /// By the number of missed updates.
    pub table: &'a [Missed],
    /// Number of the update up to which rows are brought.
    pub through: u32,
    /// Learning rate of each value of a row, without bias correction.
    pub lanes: &'a [f32],
}

/// An update of rows that may have missed some before it.
#[derive(Debug, Clone)]
struct Update<'a> {
    missing: &'a Missing<'a>,
    /// Learning rate of each value of a row with the bias correction of the first moment.
    rates: &'a [f32],
    step: &'a Step,
}

impl Missing<'_> {
    /// Updates that the moments of a row with this word have missed.
    fn of_moments(&self, word: u32) -> u32 {
        self.through.saturating_sub(word & !PREPARED)
    }

    /// Updates that its values have missed.
    fn of_values(&self, word: u32) -> u32 {
        if word & PREPARED > 0 { 0 } else { self.of_moments(word) }
    }
}

/// Marks the rows that `view` may see, and brings their SH coefficients up to date.
///
/// # Panics
/// If lengths differ.
pub fn prepare(
    params: &mut Columns,
    first: &Columns,
    second: &Columns,
    last: &mut [u32],
    view: &SeenBy,
    missing: &Missing<'_>,
) {
    let width = params.widths[Group::Sh as usize];
    let (means, log_scales) = (params.data[0].as_chunks::<3>().0, params.data[2].as_chunks::<3>().0);
    let gaps: Vec<u32> = last
        .par_chunks_mut(CHUNK)
        .zip(means.par_chunks(CHUNK))
        .zip(log_scales.par_chunks(CHUNK))
        .flat_map_iter(|((words, means), log_scales)| {
            words.iter_mut().zip(means).zip(log_scales).map(|((word, &[x, y, z]), s)| {
                let scale = s[0].max(s[1]).max(s[2]).exp();
                if !may_be_seen(view.sides, view.front, Vec3 { x, y, z }, scale) {
                    return 0;
                }
                let gap = missing.of_values(*word);
                *word |= PREPARED;
                gap
            })
        })
        .collect();
    let values = params.of_mut(Group::Sh);
    advance_by(values, first.of(Group::Sh), second.of(Group::Sh), &gaps, width, missing);
}

/// Brings values up to date, whatever sees them, and nothing else: rows of `width` values, their moments and words.
///
/// # Panics
/// If lengths differ.
pub fn advance(values: &mut [f32], first: &[f32], second: &[f32], last: &[u32], missing: &Missing<'_>) {
    let gaps: Vec<u32> = last.iter().map(|&word| missing.of_values(word)).collect();
    advance_by(values, first, second, &gaps, missing.lanes.len(), missing);
}

fn advance_by(values: &mut [f32], first: &[f32], second: &[f32], gaps: &[u32], width: usize, missing: &Missing<'_>) {
    assert!(values.len() == gaps.len() * width && first.len() == values.len() && second.len() == values.len());
    let chunk = CHUNK * width;
    values
        .par_chunks_mut(chunk)
        .zip(first.par_chunks(chunk))
        .zip(second.par_chunks(chunk))
        .zip(gaps.par_chunks(CHUNK))
        .for_each(|(((p, m), v), gaps)| advance_chunk(p, m, v, gaps, missing));
}

/// Brings values and moments of all rows up to date; their words mean nothing afterwards.
///
/// # Panics
/// If lengths differ.
pub fn catch_up(rows: &mut Rows, last: &[u32], missing: &Missing<'_>) {
    let sh = Group::Sh as usize;
    let (first, second) = (&mut rows.first.data[sh], &mut rows.second.data[sh]);
    advance(&mut rows.params.data[sh], first, second, last, missing);
    let chunk = CHUNK * missing.lanes.len();
    first
        .par_chunks_mut(chunk)
        .zip(second.par_chunks_mut(chunk))
        .zip(last.par_chunks(CHUNK))
        .for_each(|((m, v), words)| decay_chunk(m, v, words, missing));
}

/// Update number `through` + 1 of the SH coefficients of the marked rows, by the gradients `grads`.
///
/// # Panics
/// If lengths differ.
pub fn update_seen(rows: &mut Rows, grads: &[f32], last: &mut [u32], missing: &Missing<'_>, step: &Step) {
    let sh = Group::Sh as usize;
    let rates: Vec<f32> = missing.lanes.iter().map(|&lr| step.rate(lr)).collect();
    let (params, first, second) = (&mut rows.params.data[sh], &mut rows.first.data[sh], &mut rows.second.data[sh]);
    assert!(params.len() == last.len() * rates.len() && grads.len() == params.len());
    let chunk = CHUNK * rates.len();
    let update = Update { missing, rates: &rates, step };
    params
        .par_chunks_mut(chunk)
        .zip(grads.par_chunks(chunk))
        .zip(first.par_chunks_mut(chunk))
        .zip(second.par_chunks_mut(chunk))
        .zip(last.par_chunks_mut(CHUNK))
        .for_each(|((((p, g), m), v), words)| update_chunk(p, g, m, v, words, &update));
}

dispatch_simd! {
    fn advance_chunk(values: &mut [f32], first: &[f32], second: &[f32], gaps: &[u32], missing: &Missing<'_>) = advance_kernel;
}

#[inline(always)]
fn advance_kernel<const FMA: bool>(
    values: &mut [f32],
    first: &[f32],
    second: &[f32],
    gaps: &[u32],
    missing: &Missing<'_>,
) {
    let width = missing.lanes.len();
    let rows = values.chunks_exact_mut(width).zip(first.chunks_exact(width)).zip(second.chunks_exact(width));
    for (((p, m), v), &gap) in rows.zip(gaps) {
        if gap == 0 {
            continue;
        }
        let Missed { weights: [w0, w1], epsilons: [e0, e1], .. } = missing.table[gap as usize];
        for (((p, &m), &v), &lr) in p.iter_mut().zip(m).zip(v).zip(missing.lanes) {
            let root = v.sqrt();
            // Both fractions over one denominator: it is 1e-30 at least.
            let (a, b) = (root + e0, root + e1);
            *p -= lr * (m * (fma::<FMA>(w0, b, w1 * a) / (a * b)));
        }
    }
}

dispatch_simd! {
    fn decay_chunk(first: &mut [f32], second: &mut [f32], words: &[u32], missing: &Missing<'_>) = decay_kernel;
}

#[inline(always)]
fn decay_kernel<const FMA: bool>(first: &mut [f32], second: &mut [f32], words: &[u32], missing: &Missing<'_>) {
    let width = missing.lanes.len();
    for ((m, v), &word) in first.chunks_exact_mut(width).zip(second.chunks_exact_mut(width)).zip(words) {
        let gap = missing.of_moments(word);
        if gap > 0 {
            let Missed { decay1, decay2, .. } = missing.table[gap as usize];
            m.iter_mut().for_each(|m| *m = flushed(*m * decay1));
            v.iter_mut().for_each(|v| *v = flushed(*v * decay2));
        }
    }
}

dispatch_simd! {
    fn update_chunk(params: &mut [f32], grads: &[f32], first: &mut [f32], second: &mut [f32], words: &mut [u32], update: &Update<'_>) = update_kernel;
}

#[inline(always)]
fn update_kernel<const FMA: bool>(
    params: &mut [f32],
    grads: &[f32],
    first: &mut [f32],
    second: &mut [f32],
    words: &mut [u32],
    update: &Update<'_>,
) {
    let &Update { missing, rates, step } = update;
    let width = rates.len();
    let rows = params
        .chunks_exact_mut(width)
        .zip(grads.chunks_exact(width))
        .zip(first.chunks_exact_mut(width))
        .zip(second.chunks_exact_mut(width));
    for ((((p, g), m), v), word) in rows.zip(words) {
        if *word & PREPARED == 0 {
            continue;
        }
        let Missed { decay1, decay2, .. } = missing.table[missing.of_moments(*word) as usize];
        for ((((p, &g), m), v), &rate) in p.iter_mut().zip(g).zip(m.iter_mut()).zip(v.iter_mut()).zip(rates) {
            // Without a missed update both decays are 1: the update is then that of the dense optimiser to the bit.
            let before = (flushed(*m * decay1), flushed(*v * decay2));
            (*p, *m, *v) = updated::<FMA>(*p, g, before, rate, step);
        }
        *word = missing.through + 1;
    }
}
