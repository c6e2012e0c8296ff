//! A tiny seeded generator for test scenes: SplitMix64 (Steele, Lea, Flood 2014), the same numbers on every machine.

/// A seeded stream of random numbers. Not for anything but tests.
#[derive(Debug, Clone)]
pub struct Rng(u64);

impl Rng {
    /// Stream of this seed.
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0xD134_2543_DE82_EF95) ^ 0x9E37_79B9_7F4A_7C15)
    }

    /// Next 64 random bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Uniform in [0, 1).
    pub fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Uniform in [low, high), as float32.
    pub fn range(&mut self, low: f32, high: f32) -> f32 {
        (f64::from(low) + (f64::from(high) - f64::from(low)) * self.unit()) as f32
    }

    /// Uniform index below `end` (0 when `end` is 0).
    pub fn below(&mut self, end: usize) -> usize {
        ((self.unit() * end as f64) as usize).min(end.saturating_sub(1))
    }

    /// Standard normal (Box–Muller), as float32.
    pub fn normal(&mut self) -> f32 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        (radius * (std::f64::consts::TAU * self.unit()).cos()) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_of_the_streams() {
        let mut rng = Rng::new(7);
        let n = 40_000;
        let (mut mean, mut normal_mean, mut normal_square) = (0.0, 0.0, 0.0);
        for _ in 0..n {
            let u = rng.unit();
            assert!((0.0..1.0).contains(&u));
            let g = f64::from(rng.normal());
            (mean, normal_mean, normal_square) = (mean + u, normal_mean + g, normal_square + g * g);
        }
        let n = f64::from(n);
        assert!((mean / n - 0.5).abs() < 0.01);
        assert!((normal_mean / n).abs() < 0.02 && (normal_square / n - 1.0).abs() < 0.03);
    }

    #[test]
    fn seeds_give_different_streams() {
        assert_ne!(Rng::new(0).bits(), Rng::new(1).bits());
        assert_eq!(Rng::new(3).bits(), Rng::new(3).bits());
    }
}
