//! Adam (Kingma 2015, Algorithm 1) over all parameter groups, in place, one pass over each tensor.
//!
//! The update is torch's: bias corrections m / (1 − β1ᵗ), √v / √(1 − β2ᵗ), ε added after the square root, weight decay
//! added to the gradient. Memory bound: 28 bytes per value (read p, g, m, v; write p, m, v). Moments below 1e-37 are
//! set to zero, because arithmetic on denormal numbers is a hundred times slower; with ε = 1e-15 a moment of that size
//! moves a parameter by less than 1e-22 of its learning rate.

use super::rows::Rows;
use crate::optim::{AdamSettings, Columns, Group, LearningRates};
use crate::simd::{dispatch_simd, fma};
use rayon::prelude::*;

/// One update of all groups. A group with an empty gradient is left alone.
///
/// # Panics
/// If shapes differ.
pub fn update_all(rows: &mut Rows, grads: &Columns, rates: &LearningRates, step: &Step) {
    for group in Group::ALL {
        let g = group as usize;
        if grads.data[g].is_empty() {
            continue;
        }
        let lanes = rates.lanes(group, rows.params.widths[g]);
        let (first, second) = (&mut rows.first.data[g], &mut rows.second.data[g]);
        update(&mut rows.params.data[g], &grads.data[g], first, second, &lanes, step);
    }
}

/// Constants of one step.
#[derive(Debug, Clone, Copy)]
pub struct Step {
    pub(crate) beta1: f32,
    pub(crate) one_minus_beta1: f32,
    pub(crate) beta2: f32,
    pub(crate) one_minus_beta2: f32,
    pub(crate) epsilon: f32,
    pub(crate) weight_decay: f32,
    pub(crate) inverse_bias1: f64,
    pub(crate) inverse_sqrt_bias2: f32,
}

impl Step {
    /// Constants of update number `t`, counted from 1.
    pub fn new(settings: &AdamSettings, t: u32) -> Self {
        let &AdamSettings { beta1, beta2, epsilon, weight_decay } = settings;
        Self {
            beta1: beta1 as f32,
            one_minus_beta1: (1.0 - beta1) as f32,
            beta2: beta2 as f32,
            one_minus_beta2: (1.0 - beta2) as f32,
            epsilon: epsilon as f32,
            weight_decay: weight_decay as f32,
            inverse_bias1: 1.0 / (1.0 - beta1.powf(f64::from(t))),
            inverse_sqrt_bias2: (1.0 / (1.0 - beta2.powf(f64::from(t))).sqrt()) as f32,
        }
    }
}

impl Step {
    /// A learning rate with the bias correction of the first moment.
    pub(crate) fn rate(&self, lr: f32) -> f32 {
        (f64::from(lr) * self.inverse_bias1) as f32
    }
}

/// Values per job: 28 bytes each, a few times what a core's private cache holds.
const CHUNK: usize = 1 << 16;

/// Updates one tensor whose rows have `lanes.len()` values; `lanes` holds the learning rate of each.
///
/// # Panics
/// If lengths differ or are no multiple of the row length.
pub fn update(params: &mut [f32], grads: &[f32], first: &mut [f32], second: &mut [f32], lanes: &[f32], step: &Step) {
    let n = params.len();
    assert!(grads.len() == n && first.len() == n && second.len() == n, "one gradient and two moments per parameter");
    assert!(!lanes.is_empty() && n.is_multiple_of(lanes.len()), "whole rows");
    // The rates repeated until they fill whole vectors, so that the inner loop needs no index arithmetic.
    let period = lanes.len() * 16;
    let rates: Vec<f32> = lanes.iter().cycle().take(period).map(|&lr| step.rate(lr)).collect();
    let chunk = (CHUNK / period).max(1) * period;
    params
        .par_chunks_mut(chunk)
        .zip(grads.par_chunks(chunk))
        .zip(first.par_chunks_mut(chunk))
        .zip(second.par_chunks_mut(chunk))
        .for_each(|(((p, g), m), v)| update_chunk(p, g, m, v, &rates, step));
}

dispatch_simd! {
    fn update_chunk(params: &mut [f32], grads: &[f32], first: &mut [f32], second: &mut [f32], rates: &[f32], step: &Step) = chunk_kernel;
}

#[inline(always)]
fn chunk_kernel<const FMA: bool>(
    params: &mut [f32],
    grads: &[f32],
    first: &mut [f32],
    second: &mut [f32],
    rates: &[f32],
    step: &Step,
) {
    let period = rates.len();
    let blocks = params
        .chunks_mut(period)
        .zip(grads.chunks(period))
        .zip(first.chunks_mut(period))
        .zip(second.chunks_mut(period));
    for (((p, g), m), v) in blocks {
        let values = p.iter_mut().zip(g).zip(m.iter_mut()).zip(v.iter_mut()).zip(rates);
        for ((((p, &g), m), v), &rate) in values {
            (*p, *m, *v) = updated::<FMA>(*p, g, (*m, *v), rate, step);
        }
    }
}

/// The value and its moments `(m, v)` after an update by the gradient `g`; `rate` has the bias correction of the first moment.
#[inline(always)]
pub(super) fn updated<const FMA: bool>(p: f32, g: f32, (m, v): (f32, f32), rate: f32, step: &Step) -> (f32, f32, f32) {
    let g = fma::<FMA>(step.weight_decay, p, g);
    let m = flushed(fma::<FMA>(step.beta1, m, step.one_minus_beta1 * g));
    let v = flushed(fma::<FMA>(step.beta2, v, step.one_minus_beta2 * g * g));
    let denominator = fma::<FMA>(v.sqrt(), step.inverse_sqrt_bias2, step.epsilon);
    (p - rate * m / denominator, m, v)
}

/// 0 for what arithmetic would be slow on.
#[inline(always)]
pub(super) fn flushed(v: f32) -> f32 {
    if v.abs() < 1e-37 { 0.0 } else { v }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_step_is_the_learning_rate_times_the_sign() {
        let mut params = vec![1.0f32; 300];
        let grads: Vec<f32> = (0..300).map(|i| if i % 2 == 0 { 1e-6 } else { -3.0 }).collect();
        let (mut m, mut v) = (vec![0.0; 300], vec![0.0; 300]);
        let lanes = [0.1, 0.01, 0.001];
        update(&mut params, &grads, &mut m, &mut v, &lanes, &Step::new(&AdamSettings::default(), 1));
        for (i, p) in params.iter().enumerate() {
            let expected = 1.0 - lanes[i % 3] * grads[i].signum();
            assert!((p - expected).abs() < 1e-6, "{i}: {p} {expected}");
        }
    }

    #[test]
    fn a_value_that_never_had_a_gradient_stays() {
        let mut params = vec![0.25f32; 27 * 40];
        let grads = vec![0.0; 27 * 40];
        let (mut m, mut v) = (grads.clone(), grads.clone());
        update(&mut params, &grads, &mut m, &mut v, &[1.0; 27], &Step::new(&AdamSettings::default(), 3));
        assert!(params.iter().all(|p| *p == 0.25) && m.iter().chain(&v).all(|x| *x == 0.0));
    }

    #[test]
    fn the_result_does_not_depend_on_the_number_of_threads() {
        let n = 48 * 5000;
        let grads: Vec<f32> = (0..n).map(|i| ((i * 37 % 101) as f32 - 50.0) * 1e-3).collect();
        let results: Vec<_> = [1, 2, 5]
            .into_iter()
            .map(|threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("the test sets this up");
                let (mut p, mut m, mut v) = (vec![0.5f32; n], vec![0.0; n], vec![0.0; n]);
                let lanes: Vec<f32> = (0..48).map(|i| if i < 3 { 2.5e-3 } else { 1.25e-4 }).collect();
                pool.install(|| {
                    for t in 1..4 {
                        update(&mut p, &grads, &mut m, &mut v, &lanes, &Step::new(&AdamSettings::default(), t));
                    }
                });
                (p, m, v)
            })
            .collect();
        assert!(results.windows(2).all(|w| w[0] == w[1]));
    }
}
