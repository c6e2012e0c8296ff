//! When a pixel stops compositing: at a fixed transmittance, or at one that a table gives for the colour composited so
//! far.
//!
//! Here is the shape only: a table, how it is looked at, and what happens to the rest of a pixel that stopped. What the
//! entries mean is for whoever fills it (`gazesplat_fovea::termination_lut` does, from colour science). Equations: JND (Ji,
//! Wang, Zhang, *Color-Aware Early Termination for Efficient 3DGS*), Sec. 3, with the deviations named at each item.

use crate::error::{Error, Result};
use gazesplat_core::color::ColorSpace;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// When a pixel stops compositing.
#[derive(Debug, Clone, PartialEq)]
pub enum Termination {
    /// Before the splat that would bring the transmittance T(1−α) to this value or below; 0 = never
    /// (down to [`crate::layout::T_FLOOR`], where f32 ends).
    Fixed(f32),
    /// Before the splat that would be blended while T·c_max ≤ γ·LUT(C), C being the colour composited so far. For
    /// inference only: a pass with gradients refuses it.
    Lut(TerminationLut),
}

/// What the pixels that stopped receive for what they did not composite; T is the transmittance left.
///
/// Pixels that worked through their whole list receive T · background, whatever is chosen here.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Residual {
    /// Nothing, not even the background (JND). The image never gets brighter than the full one.
    Drop,
    /// T · background, as without a table. The error is not bounded by the table.
    Background,
    /// T · C / (1 − T): as if the rest had the mean colour of what was seen. The error is not bounded by the table.
    Mean,
    /// T · c_max / 2 in every channel: the middle of what the rest can be, so that the error points every way alike.
    Centre,
}

/// Largest channel that what is still hidden may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ColorMax {
    /// The largest of 1, the channels of the tile's splats and those of the background: SH colours exceed 1.
    Tile,
    /// 1, as JND assumes.
    One,
}

/// A table of the transmittances that do not matter any more, by colour, and how it is used.
#[derive(Debug, Clone, PartialEq)]
pub struct TerminationLut {
    size: usize,
    values: Arc<[f32]>,
    /// γ times the values: what kernels read, shared by all frames.
    limits: Arc<[f32]>,
    /// The largest of `limits`: above it no colour stops, and the table is not looked at.
    largest_limit: f32,
    /// For each set of axes and each cell the largest limit of the cells up to `ahead` farther along them.
    limits_ahead: Arc<[f32]>,
    ahead: usize,
    gamma: f32,
    space: ColorSpace,
    residual: Residual,
    color_max: ColorMax,
    also_fixed: Option<f32>,
}

/// Largest number of cells along each axis: indices of entries stay exact in f32.
pub const MAX_LUT_SIZE: usize = 256;

/// Largest number of cells along each axis for which [`TerminationLut::limits_ahead`] is made: its indices stay exact too.
const MAX_SIZE_AHEAD: usize = 64;

/// The largest value below 1: a channel is clamped to it, so that 1 falls into the last cell.
pub const BELOW_ONE: f32 = 1.0 - f32::EPSILON / 2.0;

impl TerminationLut {
    /// A table of `size`³ transmittances, red slowest, over cells of equal size of the colours 0…1 in `space`. γ is 1,
    /// the residual [`Residual::Centre`], the bound [`ColorMax::Tile`], and no fixed rule stands beside it.
    ///
    /// # Errors
    /// [`Error::Parameter`] if the number of entries is not `size`³, `size` is 0 or above [`MAX_LUT_SIZE`], or an entry is
    /// not finite or not positive.
    pub fn new(size: usize, values: Vec<f32>, space: ColorSpace) -> Result<Self> {
        let check = |ok: bool, found: String, expected| match ok {
            true => Ok(()),
            false => Err(Error::Parameter { name: "termination table", found, expected }),
        };
        check((1..=MAX_LUT_SIZE).contains(&size), format!("{size} cells per axis"), "1 to 256 cells per axis")?;
        check(
            values.len() == size.pow(3),
            format!("{} entries for {size} cells per axis", values.len()),
            "cells per axis to the power of three entries",
        )?;
        let bad = values.iter().position(|v| !(v.is_finite() && *v > 0.0));
        check(
            bad.is_none(),
            bad.map_or_else(String::new, |i| format!("{} at entry {i}", values[i])),
            "finite transmittances above 0",
        )?;
        let values: Arc<[f32]> = values.into();
        let lut = Self {
            size,
            limits: values.clone(),
            values,
            largest_limit: 0.0,
            limits_ahead: Arc::from([]),
            ahead: 0,
            gamma: 1.0,
            space,
            residual: Residual::Centre,
            color_max: ColorMax::Tile,
            also_fixed: None,
        };
        lut.with_gamma(1.0)
    }

    /// The table used with every entry times γ: how many just-noticeable differences are admitted (JND Sec. 3.2).
    /// 0 is [`Termination::Fixed`] at 0, or at what [`TerminationLut::with_also_fixed`] says.
    ///
    /// # Errors
    /// [`Error::Parameter`] if γ is negative or not finite.
    pub fn with_gamma(mut self, gamma: f32) -> Result<Self> {
        if !(gamma.is_finite() && gamma >= 0.0) {
            return Err(Error::Parameter {
                name: "gamma",
                found: gamma.to_string(),
                expected: "0 or a finite value above",
            });
        }
        self.gamma = gamma;
        self.limits = if gamma == 1.0 { self.values.clone() } else { self.values.iter().map(|v| gamma * v).collect() };
        self.largest_limit = self.limits.iter().copied().fold(0.0, f32::max);
        // Colours only grow while a pixel composites, and by no more than what is left of it: from where a table is first
        // looked at, by its largest limit.
        self.ahead = ((self.size as f32 * self.largest_limit) as usize + 1).min(self.size);
        self.limits_ahead = match self.size <= MAX_SIZE_AHEAD {
            true => (0..8).flat_map(|axes| largest_ahead(&self.limits, self.size, self.ahead, axes)).collect(),
            false => Arc::from([]),
        };
        Ok(self)
    }

    /// The table with this treatment of the rest.
    pub fn with_residual(self, residual: Residual) -> Self {
        Self { residual, ..self }
    }

    /// The table with this bound of hidden colours.
    pub fn with_color_max(self, color_max: ColorMax) -> Self {
        Self { color_max, ..self }
    }

    /// The table with the rule of [`Termination::Fixed`] beside it. JND keeps its 1e-4; that look-ahead drops whatever
    /// opaque splat would end a pixel, so that the table bounds the error no longer.
    ///
    /// # Errors
    /// [`Error::Parameter`] unless the transmittance is in [0, 1).
    pub fn with_also_fixed(mut self, also_fixed: Option<f32>) -> Result<Self> {
        if let Some(t) = also_fixed.filter(|t| !(0.0..1.0).contains(t)) {
            return Err(Error::Parameter {
                name: "also_fixed",
                found: t.to_string(),
                expected: "a transmittance in [0, 1)",
            });
        }
        self.also_fixed = also_fixed;
        Ok(self)
    }

    /// The table with the same entries, taken to be for colours in `space`. JND applies a table made for linear light to
    /// the encoded colours that 3DGS composites; saying so is this call.
    pub fn read_as(self, space: ColorSpace) -> Self {
        Self { space, ..self }
    }

    /// The table looked at before every splat, and not only once T·c_max is within reach of its largest entry. For
    /// tests: the image is the same, the time is not.
    pub fn with_eager_lookup(self) -> Self {
        Self { largest_limit: f32::INFINITY, ..self }
    }

    /// Cells along each axis.
    pub fn size(&self) -> usize {
        self.size
    }

    /// The entries as given, `[size³]`, red slowest.
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// γ times the entries, `[size³]`.
    pub fn limits(&self) -> &[f32] {
        &self.limits
    }

    /// The largest of [`TerminationLut::limits`].
    pub fn largest_limit(&self) -> f32 {
        self.largest_limit
    }

    /// The smallest of [`TerminationLut::limits`].
    pub fn smallest_limit(&self) -> f32 {
        self.limits.iter().copied().fold(f32::INFINITY, f32::min)
    }

    /// For each set of axes, red 4, green 2, blue 1, and each cell the largest limit of the cells that are up to
    /// [`TerminationLut::ahead`] farther along these axes: what a colour of the cell can ever be compared with if it can
    /// leave the cell along them only. `[8 · size³]`; empty for more than 64 cells per axis.
    pub fn limits_ahead(&self) -> &[f32] {
        &self.limits_ahead
    }

    /// Cells that a colour can advance along an axis after T·c_max has come down to the largest limit.
    pub fn ahead(&self) -> usize {
        self.ahead
    }

    /// γ.
    pub fn gamma(&self) -> f32 {
        self.gamma
    }

    /// The space whose colours index the table.
    pub fn space(&self) -> ColorSpace {
        self.space
    }

    /// What becomes of the rest.
    pub fn residual(&self) -> Residual {
        self.residual
    }

    /// What hidden colours are bounded by.
    pub fn color_max(&self) -> ColorMax {
        self.color_max
    }

    /// The fixed rule beside the table.
    pub fn also_fixed(&self) -> Option<f32> {
        self.also_fixed
    }

    /// γ times the entry for a colour: that of its cell, without interpolation. Channels out of 0…1 are clamped.
    pub fn limit(&self, color: [f32; 3]) -> f32 {
        let cell = |c: f32| ((self.size as f32 * c.clamp(0.0, BELOW_ONE)) as usize).min(self.size - 1);
        self.limits[(cell(color[0]) * self.size + cell(color[1])) * self.size + cell(color[2])]
    }
}

/// For each cell the largest value of those up to `ahead` farther along `axes`: red 4, green 2, blue 1.
fn largest_ahead(values: &[f32], size: usize, ahead: usize, axes: usize) -> Vec<f32> {
    let mut largest = values.to_vec();
    for (axis, stride) in [(1, 1), (2, size), (4, size * size)] {
        if axes & axis == 0 {
            continue;
        }
        // Ascending, so that what lies ahead has not been replaced yet.
        for i in 0..largest.len() {
            let cell = i / stride % size;
            let reach = ahead.min(size - 1 - cell);
            largest[i] = (0..=reach).map(|k| largest[i + k * stride]).fold(0.0, f32::max);
        }
    }
    largest
}

impl Termination {
    /// # Errors
    /// [`Error::Parameter`] for a fixed transmittance out of [0, 1), or a table for colours other than those composited.
    pub fn validate(&self) -> Result<()> {
        match self {
            Self::Fixed(t) if !(0.0..1.0).contains(t) => Err(Error::Parameter {
                name: "termination",
                found: t.to_string(),
                expected: "a transmittance in [0, 1)",
            }),
            Self::Lut(lut) if lut.space != ColorSpace::Srgb => Err(Error::Parameter {
                name: "termination table",
                found: "a table for linear light".to_owned(),
                expected: "a table for sRGB-encoded colours, which 3DGS composites",
            }),
            _ => Ok(()),
        }
    }

    /// What kernels go by: the transmittance of the fixed rule, and the table if it ever stops anything.
    pub(crate) fn resolve(&self) -> (f32, Option<TerminationLut>) {
        match self {
            Self::Fixed(t) => (*t, None),
            Self::Lut(lut) => (lut.also_fixed.unwrap_or(0.0), (lut.gamma > 0.0).then(|| lut.clone())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lut(values: Vec<f32>) -> Result<TerminationLut> {
        TerminationLut::new(2, values, ColorSpace::Srgb)
    }

    #[test]
    fn tables_that_cannot_be_used_are_refused_with_the_reason() {
        for (values, part) in [
            (vec![0.1; 7], "7 entries"),
            (vec![], "0 entries"),
            (vec![f32::NAN; 8], "NaN at entry 0"),
            (vec![0.1, 0.1, 0.0, 0.1, 0.1, 0.1, 0.1, 0.1], "0 at entry 2"),
            (vec![-0.1; 8], "-0.1 at entry 0"),
            (vec![f32::INFINITY; 8], "inf at entry 0"),
        ] {
            let error = lut(values).expect_err("refused").to_string();
            assert!(error.contains(part), "{error}");
        }
        assert!(TerminationLut::new(0, vec![], ColorSpace::Srgb).is_err());
        assert!(TerminationLut::new(257, vec![], ColorSpace::Srgb).is_err());
        let good = lut(vec![0.1; 8]).expect("legal");
        for gamma in [-1.0, f32::NAN, f32::INFINITY] {
            assert!(good.clone().with_gamma(gamma).is_err(), "{gamma}");
        }
        for t in [-0.1, 1.0, f32::NAN] {
            assert!(good.clone().with_also_fixed(Some(t)).is_err(), "{t}");
        }
        assert!(Termination::Lut(good.clone()).validate().is_ok());
        assert!(Termination::Lut(good.read_as(ColorSpace::Linear)).validate().is_err());
    }

    #[test]
    fn colours_fall_into_their_cell_and_out_of_range_into_the_nearest() {
        let good = lut((1..=8).map(|v| v as f32).collect()).expect("legal");
        for (color, expected) in [
            ([0.0, 0.0, 0.0], 1.0),
            ([0.0, 0.0, 0.5], 2.0),
            ([0.0, 0.5, 0.499], 3.0),
            ([0.5, 0.0, 0.0], 5.0),
            ([1.0, 1.0, 1.0], 8.0),
            ([9.0, -1.0, f32::NAN], 5.0),
        ] {
            assert_eq!(good.limit(color), expected, "{color:?}");
        }
        for size in 1..=MAX_LUT_SIZE {
            assert_eq!((size as f32 * BELOW_ONE) as usize, size - 1, "{size}");
        }
    }

    #[test]
    fn limits_ahead_are_the_largest_of_the_block_ahead() {
        let size = 4;
        let values: Vec<f32> = (0..64).map(|i| ((i * 37) % 64 + 1) as f32 / 4096.0).collect();
        for (gamma, ahead) in [(1.0, 1), (20.0, 2), (1e6, 4)] {
            let lut = TerminationLut::new(size, values.clone(), ColorSpace::Srgb).and_then(|lut| lut.with_gamma(gamma));
            let lut = lut.expect("legal");
            assert_eq!(lut.ahead(), ahead);
            for i in 0..8 * 64 {
                let (axes, at) = (i / 64, i % 64);
                let cell = [at / 16, at / 4 % 4, at % 4];
                let block = (0..64).filter(|j| {
                    let other = [j / 16, j / 4 % 4, j % 4];
                    let reach = |c: usize| if axes >> (2 - c) & 1 == 1 { ahead } else { 0 };
                    (0..3).all(|c| (cell[c]..=cell[c] + reach(c)).contains(&other[c]))
                });
                assert_eq!(lut.limits_ahead()[i], block.map(|j| lut.limits()[j]).fold(0.0, f32::max), "{i}");
            }
        }
        let lut = TerminationLut::new(65, vec![0.1; 65 * 65 * 65], ColorSpace::Srgb).expect("legal");
        assert!(lut.limits_ahead().is_empty());
    }

    #[test]
    fn limits_grow_with_gamma_and_share_the_table_at_one() {
        let good = lut((1..=8).map(|v| v as f32 / 64.0).collect()).expect("legal");
        assert!(Arc::ptr_eq(&good.values, &good.limits));
        let mut before = vec![0.0; 8];
        for gamma in [0.0, 0.5, 1.0, 1.5, 20.0] {
            let scaled = good.clone().with_gamma(gamma).expect("legal");
            assert!(scaled.limits().iter().zip(&before).all(|(a, b)| a >= b));
            assert_eq!(scaled.largest_limit(), gamma * 0.125);
            before = scaled.limits().to_vec();
        }
    }
}
