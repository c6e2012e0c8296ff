//! γ of scale decay, controlled by the guard (spec/pruning.md, Sec. 5).

use super::config::ScaleDecaySection;

/// γ ∈ {0, start · factorᵏ}: the whole number k is kept, so that going up and down loses nothing to rounding.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DecayControl {
    start: f64,
    factor: f64,
    constant: Option<f64>,
    /// k; `None` = γ is 0.
    pub exponent: Option<u32>,
}

impl DecayControl {
    /// γ = 0.
    pub fn new(section: &ScaleDecaySection) -> Self {
        let ScaleDecaySection { start, factor, constant, .. } = *section;
        Self { start, factor, constant, exponent: None }
    }

    /// γ.
    pub fn gamma(&self) -> f32 {
        let controlled = || self.exponent.map_or(0.0, |k| self.start * self.factor.powi(k.cast_signed()));
        self.constant.unwrap_or_else(controlled) as f32
    }

    /// After an event: up when the guard passed, down when it failed, to 0 below the start.
    pub fn after_event(&mut self, passed: bool) {
        self.exponent = match (passed, self.exponent) {
            (true, None) => Some(0),
            (true, Some(k)) => Some(k + 1),
            (false, None | Some(0)) => None,
            (false, Some(k)) => Some(k - 1),
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// spec/pruning.md, Sec. 10, test 6.
    #[test]
    fn gamma_goes_up_and_down_without_loss() {
        let mut control = DecayControl::new(&ScaleDecaySection::default());
        assert_eq!(control.gamma(), 0.0);
        let gammas = [true, true, true, false, false, false, true].map(|passed| {
            control.after_event(passed);
            control.gamma()
        });
        assert_eq!(gammas, [1e-4, 3e-4, 9e-4, 3e-4, 1e-4, 0.0, 1e-4]);
    }

    #[test]
    fn constant_gamma_ignores_the_guard() {
        let section = ScaleDecaySection { constant: Some(0.01), ..ScaleDecaySection::default() };
        let mut control = DecayControl::new(&section);
        control.after_event(false);
        assert_eq!(control.gamma(), 0.01);
    }
}
