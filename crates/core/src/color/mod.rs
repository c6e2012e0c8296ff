//! Colour encodings: the sRGB transfer curve and 8-bit quantisation.
//!
//! Images, SH colours and losses of this project are sRGB-encoded, as in Kerbl 2023; linear light appears only where
//! light is added physically (the synthetic scenes, vision models).
//!
//! The modules below are colour science in `f64`: tristimulus values ([`xyz`]), CIE Lab ([`lab`]), the colour difference
//! ΔE₀₀ ([`ciede2000`]) with its metric tensor in closed form ([`metric`]), cones and opponent axes ([`cones`]).

pub mod ciede2000;
pub mod cones;
pub mod lab;
pub mod metric;
pub mod xyz;

use serde::{Deserialize, Serialize};

/// How numbers of an image relate to light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ColorSpace {
    /// IEC 61966-2-1 transfer curve applied; what files and models hold.
    #[default]
    Srgb,
    /// Proportional to light, sRGB primaries.
    Linear,
}

impl ColorSpace {
    /// `value` in this space, expressed in the space `to`.
    pub fn convert(self, to: Self, value: f32) -> f32 {
        match (self, to) {
            (Self::Srgb, Self::Linear) => srgb_to_linear(value),
            (Self::Linear, Self::Srgb) => linear_to_srgb(value),
            _ => value,
        }
    }
}

/// Linear light of the sRGB-encoded `value` (IEC 61966-2-1). Odd around 0, so that values out of range keep their order.
pub fn srgb_to_linear(value: f32) -> f32 {
    let v = value.abs();
    let linear = if v <= 0.040_45 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) };
    linear.copysign(value)
}

/// sRGB encoding of the linear-light `value` (IEC 61966-2-1). Odd around 0; inverse of [`srgb_to_linear`].
pub fn linear_to_srgb(value: f32) -> f32 {
    let v = value.abs();
    let encoded = if v <= 0.003_130_8 { v * 12.92 } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
    encoded.copysign(value)
}

/// Nearest of the 256 levels of 0..1, halves rounded up; values out of range are clamped, NaN is 0.
pub fn to_u8(value: f32) -> u8 {
    // The cast saturates and sends NaN to 0.
    (value * 255.0 + 0.5) as u8
}

/// The level as a value in 0..1.
pub fn from_u8(level: u8) -> f32 {
    f32::from(level) / 255.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_level_survives_the_round_trip() {
        for level in 0..=255 {
            assert_eq!(to_u8(from_u8(level)), level);
            assert_eq!(to_u8(linear_to_srgb(srgb_to_linear(from_u8(level)))), level);
        }
    }

    #[test]
    fn quantisation_clamps_and_nan_is_black() {
        assert_eq!(to_u8(f32::NAN), 0);
        assert_eq!(to_u8(-1.0), 0);
        assert_eq!(to_u8(f32::INFINITY), 255);
        assert_eq!(to_u8(0.5 / 255.0), 1);
        assert_eq!(to_u8(0.499 / 255.0), 0);
    }

    #[test]
    fn curve_has_the_standard_values_and_is_odd() {
        assert!((srgb_to_linear(0.5) - 0.214_041).abs() < 1e-6);
        assert!((linear_to_srgb(0.18) - 0.461_356).abs() < 1e-6);
        assert_eq!(srgb_to_linear(1.0), 1.0);
        assert_eq!(srgb_to_linear(-0.3), -srgb_to_linear(0.3));
    }

    #[test]
    fn conversion_to_the_same_space_changes_nothing() {
        assert_eq!(ColorSpace::Srgb.convert(ColorSpace::Srgb, 0.3), 0.3);
        assert_eq!(ColorSpace::Linear.convert(ColorSpace::Srgb, 0.3), linear_to_srgb(0.3));
    }
}
