//! Constants of Adam (Kingma 2015, Algorithm 1); the update is [`crate::kernels`]'.

/// Constants of the update.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamSettings {
    /// Decay of the first moment. Default 0.9.
    pub beta1: f64,
    /// Decay of the second moment. Default 0.999.
    pub beta2: f64,
    /// Added to the denominator. Default 1e-15 (3DGS).
    pub epsilon: f64,
    /// Factor of the parameter added to its gradient. Default 0.
    pub weight_decay: f64,
}

impl Default for AdamSettings {
    fn default() -> Self {
        Self { beta1: 0.9, beta2: 0.999, epsilon: 1e-15, weight_decay: 0.0 }
    }
}

/// Terms that a strategy adds to the loss: weights of the mean opacity and of the mean scale (MCMC, Eq. 10); 0 = none.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Regularizers {
    /// Weight of the mean opacity.
    pub opacity: f32,
    /// Weight of the mean scale, per world unit.
    pub scale: f32,
}
