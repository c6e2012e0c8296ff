//! Regularisers of MCMC (Kheradmand 2024, Eq. 10): the mean opacity and the mean scale, each with a weight.
//!
//! A job adds the gradients of 8192 values and sums their terms in a fixed order; the sums are added in `f64`. NaN goes
//! into the gradient of its value and the mean; an empty model has means of 0.

use crate::optim::{Columns, Group, Regularizers};
use crate::simd::{dispatch_simd, exp, sum_lanes};
use rayon::prelude::*;

/// Adds the gradients of the regularisers to `grads`. Returns the mean opacity and the mean scale; 0 for one whose
/// weight is 0.
pub fn regularize(params: &Columns, grads: &mut Columns, weights: Regularizers) -> [f32; 2] {
    let mut means = [0.0; 2];
    if weights.opacity > 0.0 {
        let (values, grads) = (params.of(Group::OpacityLogits), grads.of_mut(Group::OpacityLogits));
        means[0] = add_gradient(values, grads, weights.opacity, opacity_chunk);
    }
    if weights.scale > 0.0 {
        let (values, grads) = (params.of(Group::LogScales), grads.of_mut(Group::LogScales));
        means[1] = add_gradient(values, grads, weights.scale, scale_chunk);
    }
    means
}

/// Values per job of a regulariser.
const CHUNK: usize = 8192;

/// Mean of f(value), with `weight` times its gradient added to `grads`; `chunk` adds weight · f' and returns Σ f.
fn add_gradient(values: &[f32], grads: &mut [f32], weight: f32, chunk: fn(&[f32], &mut [f32], f32) -> f64) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let factor = weight / values.len() as f32;
    let sums: Vec<f64> = grads
        .par_chunks_mut(CHUNK)
        .zip(values.par_chunks(CHUNK))
        .map(|(grads, values)| chunk(values, grads, factor))
        .collect();
    (sums.iter().sum::<f64>() / values.len() as f64) as f32
}

dispatch_simd! {
    fn opacity_chunk(values: &[f32], grads: &mut [f32], factor: f32) -> f64 = opacity_kernel;
}

dispatch_simd! {
    fn scale_chunk(values: &[f32], grads: &mut [f32], factor: f32) -> f64 = scale_kernel;
}

/// f = σ(logit).
#[inline(always)]
fn opacity_kernel<const FMA: bool>(values: &[f32], grads: &mut [f32], factor: f32) -> f64 {
    let mut buffer = [0.0f32; 256];
    let mut sum = 0.0;
    for (values, grads) in values.chunks(256).zip(grads.chunks_mut(256)) {
        let opacities = &mut buffer[..values.len()];
        for ((o, v), g) in opacities.iter_mut().zip(values).zip(grads) {
            *o = 1.0 / (1.0 + exp::<FMA>(-v));
            *g += factor * *o * (1.0 - *o);
        }
        sum += sum_lanes(opacities);
    }
    sum
}

/// f = exp(log scale).
#[inline(always)]
fn scale_kernel<const FMA: bool>(values: &[f32], grads: &mut [f32], factor: f32) -> f64 {
    let mut buffer = [0.0f32; 256];
    let mut sum = 0.0;
    for (values, grads) in values.chunks(256).zip(grads.chunks_mut(256)) {
        let scales = &mut buffer[..values.len()];
        for ((s, v), g) in scales.iter_mut().zip(values).zip(grads) {
            *s = exp::<FMA>(*v);
            *g += factor * *s;
        }
        sum += sum_lanes(scales);
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_equal_finite_differences() {
        let logits = [0.3f32, 0.7, 0.01, 0.5].map(|o| (o / (1.0 - o)).ln()).to_vec();
        let data = [vec![0.0; 12], [1.0, 0.0, 0.0, 0.0].repeat(4), vec![-2.0; 12], logits, vec![0.1; 12]];
        let params = Columns { data, widths: [3, 4, 3, 1, 3] };
        let value = |params: &Columns| {
            let mut grads = params.zeros_like();
            let means = regularize(params, &mut grads, Regularizers { opacity: 0.01, scale: 0.01 });
            (0.01 * f64::from(means[0]) + 0.01 * f64::from(means[1]), grads)
        };
        let (_, grads) = value(&params);
        for group in [Group::OpacityLogits, Group::LogScales] {
            let (mut up, mut down) = (params.clone(), params.clone());
            up.of_mut(group)[1] += 0.05;
            down.of_mut(group)[1] -= 0.05;
            let expected = (value(&up).0 - value(&down).0) / 0.1;
            assert!((f64::from(grads.of(group)[1]) - expected).abs() < 2e-6, "{group:?}");
        }
    }
}
