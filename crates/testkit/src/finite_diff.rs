//! Central finite differences of scalar functions.

/// ∂f/∂x_i by a central difference with step `step`, error O(step²).
pub fn central(f: &mut dyn FnMut(&[f64]) -> f64, x: &[f64], i: usize, step: f64) -> f64 {
    let mut at = x.to_vec();
    at[i] = x[i] + step;
    let high = f(&at);
    at[i] = x[i] - step;
    (high - f(&at)) / (2.0 * step)
}

/// The whole gradient of `f` at `x` by [`central`] differences.
pub fn gradient(f: &mut dyn FnMut(&[f64]) -> f64, x: &[f64], step: f64) -> Vec<f64> {
    (0..x.len()).map(|i| central(f, x, i, step)).collect()
}

/// ∂f/∂x_i of a function of float32 values: divides by the step that was taken after rounding, and extrapolates from
/// the steps h and h/2 (Richardson), error O(h⁴).
pub fn central_f32(f: &mut dyn FnMut(&[f32]) -> f64, x: &[f32], i: usize, step: f32) -> f64 {
    let mut at = x.to_vec();
    let mut slope = |h: f32| {
        let (high, low) = (x[i] + h, x[i] - h);
        at[i] = high;
        let f_high = f(&at);
        at[i] = low;
        (f_high - f(&at)) / (f64::from(high) - f64::from(low))
    };
    let (coarse, fine) = (slope(step), slope(0.5 * step));
    (4.0 * fine - coarse) / 3.0
}

/// The whole gradient of a float32 function by [`central_f32`].
pub fn gradient_f32(f: &mut dyn FnMut(&[f32]) -> f64, x: &[f32], step: f32) -> Vec<f64> {
    (0..x.len()).map(|i| central_f32(f, x, i, step)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradient_of_a_quadratic_is_exact() {
        let g = gradient(&mut |x| x[0] * x[0] + 3.0 * x[0] * x[1], &[2.0, -1.0], 1e-3);
        assert!((g[0] - 1.0).abs() < 1e-9 && (g[1] - 6.0).abs() < 1e-9);
    }

    #[test]
    fn extrapolation_removes_the_cubic_error() {
        let mut f = |x: &[f32]| f64::from(x[0]).powi(3);
        assert!((central_f32(&mut f, &[1.5], 0, 0.25) - 6.75).abs() < 1e-6);
    }
}
