//! Termination tables from colour science: what is built, how, and the file it is kept in.
//!
//! A table gives for each cell of the colour cube the transmittance at which the rest of a pixel cannot be seen any more
//! ([`crate::hvs::jnd`]); [`gazesplat_render::TerminationLut`] is what the renderer makes of it.

use crate::hvs::jnd::{Observer, Region, Rule};
use gazesplat_core::color::ColorSpace;
use gazesplat_render::{ColorMax, Error, Residual, Result, TerminationLut};
use glam::DVec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Which colours of a cell its entry answers for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Sample {
    /// The smallest limit over 17³ colours of the cell, its corners included: keeps the bound under nearest lookup.
    VoxelMin,
    /// That of its centre (JND).
    Centre,
}

/// Samples of a cell along each axis.
const SAMPLES: u32 = 17;

/// A named choice of everything.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// Ours: an image never differs by more than one JND from the full one.
    Strict,
    /// As published: derived in linear light, applied to encoded colours, with the fixed rule kept beside it.
    Paper,
}

/// What a table is built from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LutSpec {
    /// Cells along each axis, 1 to [`MAX_SIZE`].
    pub size: usize,
    /// How limits are found.
    pub rule: Rule,
    /// Whether every entry is the cubic mean of the table: the naive baseline of JND.
    pub is_constant: bool,
    /// The space in which limits are derived.
    pub space: ColorSpace,
    /// The space whose colours the table is applied to. JND derives in linear light and applies to encoded colours.
    pub read_as: ColorSpace,
    /// Which colours of a cell count.
    pub sample: Sample,
    /// What the pixels that stopped receive for the rest; [`Residual::Centre`] has larger limits.
    pub residual: Residual,
    /// What hidden colours are bounded by.
    pub color_max: ColorMax,
    /// The fixed rule beside the table.
    pub also_fixed: Option<f32>,
    /// One just-noticeable difference in units of ΔE₀₀.
    pub jnd_de: f64,
}

/// Most cells along an axis that are built: 64³ of them take minutes.
pub const MAX_SIZE: usize = 64;

impl LutSpec {
    /// The choice that bounds the error.
    pub fn strict() -> Self {
        Self {
            size: 8,
            rule: Rule::Exact,
            is_constant: false,
            space: ColorSpace::Srgb,
            read_as: ColorSpace::Srgb,
            sample: Sample::VoxelMin,
            residual: Residual::Centre,
            color_max: ColorMax::Tile,
            also_fixed: None,
            jnd_de: 1.0,
        }
    }

    /// The choice of JND (Sec. 3.3 and 4).
    pub fn paper() -> Self {
        Self {
            rule: Rule::DklDiagonal,
            space: ColorSpace::Linear,
            sample: Sample::Centre,
            residual: Residual::Drop,
            color_max: ColorMax::One,
            also_fixed: Some(1e-4),
            ..Self::strict()
        }
    }

    /// The choice of this name.
    pub fn preset(preset: Preset) -> Self {
        match preset {
            Preset::Strict => Self::strict(),
            Preset::Paper => Self::paper(),
        }
    }

    /// The limits, `[size³]`, red slowest. Cells are worked on in parallel; the result does not depend on it.
    ///
    /// # Errors
    /// [`Error::Parameter`] if the size or the just-noticeable difference is out of its range.
    pub fn limits(&self) -> Result<Vec<f64>> {
        let n = self.size;
        if !(1..=MAX_SIZE).contains(&n) {
            return Err(Error::Parameter { name: "size", found: n.to_string(), expected: "1 to 64 cells per axis" });
        }
        if !(self.jnd_de.is_finite() && self.jnd_de > 0.0) {
            let found = self.jnd_de.to_string();
            return Err(Error::Parameter { name: "jnd_de", found, expected: "a finite difference above 0" });
        }
        let region = if self.residual == Residual::Centre { Region::Centred } else { Region::Corner };
        let observer = Observer { rule: self.rule, space: self.space, region, jnd_de: self.jnd_de };
        let limit = |i: usize| {
            let corner = DVec3::new((i / (n * n)) as f64, (i / n % n) as f64, (i % n) as f64);
            let at = |offset: DVec3| (corner + offset) / n as f64;
            match self.sample {
                Sample::Centre => observer.limit(at(DVec3::splat(0.5))),
                Sample::VoxelMin => observer.smallest_limit((0..SAMPLES.pow(3)).map(|k| {
                    let step = |k: u32| f64::from(k % SAMPLES) / f64::from(SAMPLES - 1);
                    at(DVec3::new(step(k / (SAMPLES * SAMPLES)), step(k / SAMPLES), step(k)))
                })),
            }
        };
        let limits: Vec<f64> = (0..n.pow(3)).into_par_iter().map(limit).collect();
        match self.is_constant {
            true => Ok(vec![cubic_mean(&limits); limits.len()]),
            false => Ok(limits),
        }
    }

    /// Builds the table, γ = 1.
    ///
    /// # Errors
    /// As [`LutSpec::limits`], and [`Error::Parameter`] if [`LutSpec::also_fixed`] is out of [0, 1).
    pub fn build(&self) -> Result<TerminationLut> {
        self.table(self.limits()?.iter().map(|&t| t as f32).collect())
    }

    /// These entries, used as the spec says.
    fn table(&self, values: Vec<f32>) -> Result<TerminationLut> {
        let lut = TerminationLut::new(self.size, values, self.space)?.with_also_fixed(self.also_fixed)?;
        Ok(lut.read_as(self.read_as).with_residual(self.residual).with_color_max(self.color_max))
    }
}

/// The cubic mean (mean x³)^⅓: the constant that JND compares with.
pub fn cubic_mean(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v * v).sum::<f64>() / values.len() as f64).cbrt()
}

/// Smallest, median and largest entry, and the cubic mean.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LutRange {
    /// The smallest.
    pub min: f64,
    /// The median.
    pub median: f64,
    /// The largest.
    pub max: f64,
    /// The cubic mean.
    pub cubic_mean: f64,
}

impl LutRange {
    /// Of these entries; NaN for none.
    pub fn of(values: &[f32]) -> Self {
        let mut sorted: Vec<f64> = values.iter().map(|&v| f64::from(v)).collect();
        sorted.sort_by(f64::total_cmp);
        let at = |i: usize| sorted.get(i).copied().unwrap_or(f64::NAN);
        let last = sorted.len().saturating_sub(1);
        let median = 0.5 * (at(last / 2) + at(last.div_ceil(2)));
        Self { min: at(0), median, max: at(last), cubic_mean: cubic_mean(&sorted) }
    }
}

/// A table with what it was built from: the content of a table file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LutFile {
    /// [`LutFile::FORMAT`].
    pub format: String,
    /// [`LutFile::VERSION`].
    pub version: u32,
    /// What the table was built from.
    pub spec: LutSpec,
    /// Range of the entries, for people.
    pub range: LutRange,
    /// The entries, `[size³]`, red slowest.
    pub values: Vec<f32>,
}

impl LutFile {
    /// Name of the format.
    pub const FORMAT: &'static str = "gazesplat termination table";
    /// Version of the format.
    pub const VERSION: u32 = 1;

    /// Builds the table of `spec`.
    ///
    /// # Errors
    /// As [`LutSpec::build`].
    pub fn build(spec: LutSpec) -> Result<Self> {
        let values = spec.build()?.values().to_vec();
        Ok(Self { format: Self::FORMAT.to_owned(), version: Self::VERSION, spec, range: LutRange::of(&values), values })
    }

    /// The file as text.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("a table file holds numbers and names only")
    }

    /// Reads a file and the table in it.
    ///
    /// # Errors
    /// [`Error::Parameter`] if the text is no table file of this version, or the table cannot be used: its size is wrong,
    /// an entry is not finite or not positive, or it is for colours that the renderer does not composite.
    pub fn from_json(text: &str) -> Result<(Self, TerminationLut)> {
        let refuse = |found: String, expected| Error::Parameter { name: "termination table", found, expected };
        let file: Self = serde_json::from_str(text)
            .map_err(|e| refuse(e.to_string(), "a table that `gazesplat lut` wrote; JSON has no NaN"))?;
        if file.format != Self::FORMAT || file.version != Self::VERSION {
            let found = format!("{}, version {}", file.format, file.version);
            return Err(refuse(found, "`gazesplat termination table`, version 1"));
        }
        let lut = file.spec.table(file.values.clone())?;
        gazesplat_render::Termination::Lut(lut.clone()).validate()?;
        Ok((file, lut))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_survive_the_round_trip_and_broken_ones_are_refused_with_the_reason() {
        let spec = LutSpec { size: 2, sample: Sample::Centre, ..LutSpec::strict() };
        let file = LutFile::build(spec.clone()).expect("builds");
        let text = file.to_json();
        let (read, lut) = LutFile::from_json(&text).expect("reads");
        // The range is for people, and JSON may lose its last digit.
        assert_eq!((&read.spec, &read.values), (&file.spec, &file.values));
        assert_eq!(lut, spec.build().expect("builds"));
        let broken = |from: &str, to: &str| LutFile::from_json(&text.replacen(from, to, 1)).expect_err(to).to_string();
        assert!(broken("\"size\": 2", "\"size\": 3").contains("8 entries for 3 cells"));
        let last = file.values[7].to_string();
        assert!(broken(&last, "NaN").contains("termination table"));
        assert!(broken(&last, "-1.0").contains("-1 at entry 7"));
        assert!(broken("\"read_as\": \"srgb\"", "\"read_as\": \"linear\"").contains("linear light"));
        assert!(broken("table\"", "tables\"").contains("version 1"));
        assert!(LutFile::from_json("{}").is_err());
    }

    #[test]
    fn specs_out_of_range_are_refused() {
        let strict = LutSpec::strict();
        for spec in [
            LutSpec { size: 0, ..strict.clone() },
            LutSpec { size: 65, ..strict.clone() },
            LutSpec { jnd_de: 0.0, ..strict.clone() },
            LutSpec { jnd_de: f64::NAN, ..strict.clone() },
        ] {
            assert!(spec.limits().is_err(), "{spec:?}");
        }
    }

    #[test]
    fn a_constant_table_is_filled_with_the_cubic_mean() {
        let spec = LutSpec { rule: Rule::Vertex, sample: Sample::Centre, ..LutSpec::strict() };
        let mean = cubic_mean(&spec.limits().expect("builds"));
        let constant = LutSpec { is_constant: true, ..spec.clone() }.build().expect("builds");
        assert_eq!(constant, spec.table(vec![mean as f32; 512]).expect("legal"));
    }

    #[test]
    fn ranges_are_those_of_the_values() {
        let range = LutRange::of(&[4.0, 1.0, 2.0, 3.0]);
        assert_eq!((range.min, range.median, range.max), (1.0, 2.5, 4.0));
        assert!((range.cubic_mean - 25f64.cbrt()).abs() < 1e-12);
    }
}
