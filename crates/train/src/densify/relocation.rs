//! What n Gaussians at the place of one must look like so that the image stays the same (MCMC, Eq. 9).

use std::sync::LazyLock;

/// Largest number of Gaussians one is divided into at once: keeps the alternating sums exact in `f64`.
pub const MAX_PARTS: usize = 51;

/// Binomial coefficients and 1/√(k + 1), computed once.
#[derive(Debug, Clone)]
pub struct RelocationTable {
    /// Σ_{i=1..n} C(i−1, k) = C(n, k + 1), `[n − 1][k]`.
    binomials: Vec<Vec<f64>>,
    inverse_sqrt: Vec<f64>,
}

impl Default for RelocationTable {
    fn default() -> Self {
        let mut binomials: Vec<Vec<f64>> = Vec::with_capacity(MAX_PARTS);
        let mut row = vec![1.0];
        for n in 1..=MAX_PARTS {
            // C(n, 0..=n) from C(n − 1, ·).
            let next: Vec<f64> = (0..=n).map(|k| if k == 0 || k == n { 1.0 } else { row[k - 1] + row[k] }).collect();
            binomials.push(next[1..].to_vec());
            row = next;
        }
        Self { binomials, inverse_sqrt: (0..MAX_PARTS).map(|k| 1.0 / ((k + 1) as f64).sqrt()).collect() }
    }
}

impl RelocationTable {
    /// The one table there is.
    pub fn shared() -> &'static Self {
        static TABLE: LazyLock<RelocationTable> = LazyLock::new(RelocationTable::default);
        &TABLE
    }

    /// Opacity of each of `num_parts` Gaussians that replace one of `opacity`, and the factor of their scales.
    ///
    /// The opacity keeps the transmittance through the centre: (1 − o')ⁿ = 1 − o. The scale keeps the integral of the
    /// composited opacity along a line through the centre: σ' / σ = o / Σ_{k<n} C(n, k + 1) (−1)ᵏ o'^{k+1} / √(k + 1),
    /// which is the paper's double sum with the outer one done (hockey-stick identity).
    pub fn split(&self, opacity: f64, num_parts: usize) -> (f64, f64) {
        let n = num_parts.clamp(1, MAX_PARTS);
        if n == 1 {
            return (opacity, 1.0);
        }
        let part = 1.0 - (1.0 - opacity).powf(1.0 / n as f64);
        let mut sum = 0.0;
        let mut power = part;
        for (k, binomial) in self.binomials[n - 1].iter().enumerate() {
            sum += binomial * self.inverse_sqrt[k] * power;
            power *= -part;
        }
        (part, opacity / sum)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_keep_the_opacity_of_the_whole() {
        let table = RelocationTable::default();
        for opacity in [0.006, 0.1, 0.5, 0.9, 0.999, 0.999_99] {
            for n in 1..=MAX_PARTS {
                let (part, scale) = table.split(opacity, n);
                assert!((1.0 - (1.0 - part).powi(n as i32) - opacity).abs() < 1e-12);
                assert!(scale > 0.0 && scale.is_finite(), "{opacity} {n} {scale}");
            }
        }
    }

    #[test]
    fn parts_keep_the_integral_along_a_line() {
        let table = RelocationTable::default();
        for (opacity, n) in [(0.3, 2), (0.8, 3), (0.95, 7), (0.999, 20)] {
            let (part, scale) = table.split(opacity, n);
            // ∫ 1 − (1 − o' g(x/σ'))ⁿ dx against ∫ o g(x) dx, by the trapezoidal rule.
            let (mut composited, mut whole) = (0.0, 0.0);
            for i in -4000..=4000 {
                let x = f64::from(i) * 0.005;
                composited += 1.0 - (1.0 - part * (-0.5 * (x / scale).powi(2)).exp()).powi(n as i32);
                whole += opacity * (-0.5 * x * x).exp();
            }
            assert!((composited / whole - 1.0).abs() < 1e-6, "{opacity} {n}: {composited} {whole}");
        }
    }

    #[test]
    fn the_closed_sum_equals_the_double_sum_of_the_paper() {
        let table = RelocationTable::default();
        let binomial = |n: usize, k: usize| (0..k).fold(1.0, |a, i| a * (n - i) as f64 / (i + 1) as f64);
        let (opacity, n) = (0.7, 6);
        let (part, scale) = table.split(opacity, n);
        let mut sum = 0.0;
        for i in 1..=n {
            for k in 0..i {
                let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
                sum += binomial(i - 1, k) * sign / ((k + 1) as f64).sqrt() * part.powi(k as i32 + 1);
            }
        }
        assert!((opacity / sum - scale).abs() < 1e-12);
    }
}
