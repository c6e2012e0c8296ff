//! Where pixels stop under the strict table, what the table grants them there, and maps of it.

use super::differences::{Differences, differences};
use super::measure::{Bench, median};
use super::output::Maps;
use crate::diagnostics::{Failure, Result};
use gazesplat_core::View;
use gazesplat_core::image::ImageF32;
use gazesplat_fovea::termination_lut::LutSpec;
use gazesplat_render::{Rendered, Residual, StatsMode, Termination, TerminationLut, render};
use gazesplat_train::evaluate::rgb;
use serde::Serialize;

/// Smallest, median, mean and largest of many values.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(super) struct Spread {
    pub min: f64,
    pub median: f64,
    pub mean: f64,
    pub max: f64,
}

impl Spread {
    fn of(mut values: Vec<f64>) -> Self {
        let middle = median(&mut values);
        let at = |v: Option<&f64>| v.copied().unwrap_or(0.0);
        let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
        Self { min: at(values.first()), median: middle, mean, max: at(values.last()) }
    }
}

/// Differences of one rule from the untruncated image in a group of pixels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(super) struct Errors {
    pub mean: f64,
    pub p999: f64,
    pub max: f64,
}

impl From<&Differences> for Errors {
    fn from(all: &Differences) -> Self {
        Self { mean: all.mean(), p999: all.exceeded_by(1e-3), max: all.largest }
    }
}

/// The pixels that stop under the strict table where its limit is on one side of the constant.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(super) struct Group {
    /// Share of all pixels that stop.
    pub share: f64,
    /// ΔE₀₀ under the strict table.
    pub strict: Errors,
    /// ΔE₀₀ under the constant that blends as much.
    pub naive: Errors,
}

/// What becomes of the pixels of all views under the strict table at γ = 1.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct Stops {
    /// Share of the pixels that stop before the end of their list.
    pub share: f64,
    /// Their limits.
    pub limits: Spread,
    /// Limits of the centred residual over those of the dropped one.
    pub centred_over_dropped: Spread,
    /// The constant that blends as much.
    pub constant: f64,
    /// Pixels whose limit is below the constant: the table is stricter there.
    pub below_constant: Group,
    /// The other pixels.
    pub above_constant: Group,
}

impl Bench<'_> {
    /// Colour over black without any residual, and whether it stopped, of each pixel of a view under the strict table.
    fn stopped(&self, view: &View, strict: &TerminationLut) -> Result<(ImageF32, Vec<bool>)> {
        let draw = |residual| -> Result<ImageF32> {
            let table = Termination::Lut(strict.clone().with_residual(residual));
            let mut options = self.options(&table, StatsMode::None);
            options.background = [0.0; 3];
            Ok(rgb(render(&self.splats, &view.camera, &options)?)?)
        };
        let (color, centred) = (draw(Residual::Drop)?, draw(Residual::Centre)?);
        // Only a pixel that stopped receives a residual.
        let is_stopped = color.data.chunks_exact(3).zip(centred.data.chunks_exact(3)).map(|(a, b)| a != b).collect();
        Ok((color, is_stopped))
    }

    /// Where pixels stop; `naive` is the constant table that blends as much.
    pub fn stops(&self, strict: &TerminationLut, naive: &TerminationLut) -> Result<Stops> {
        let dropped = LutSpec { residual: Residual::Drop, ..LutSpec::strict() }.build()?;
        let constant = naive.largest_limit();
        let (mut limits, mut ratios, mut num_pixels) = (Vec::new(), Vec::new(), 0);
        let mut groups: [[Differences; 2]; 2] =
            std::array::from_fn(|_| [Differences::of_delta_e(), Differences::of_delta_e()]);
        for view in &self.views {
            let (colors, is_stopped) = self.stopped(view, strict)?;
            let image = |termination: Termination| -> Result<ImageF32> {
                Ok(rgb(render(&self.splats, &view.camera, &self.options(&termination, StatsMode::None))?)?)
            };
            let full = image(Termination::Fixed(0.0))?;
            let of_strict = differences(&image(Termination::Lut(strict.clone()))?, &full);
            let of_naive = differences(&image(Termination::Lut(naive.clone()))?, &full);
            num_pixels += is_stopped.len();
            for (i, pixel) in colors.data.chunks_exact(3).enumerate().filter(|(i, _)| is_stopped[*i]) {
                let color = [pixel[0], pixel[1], pixel[2]];
                let limit = strict.limit(color);
                limits.push(f64::from(limit));
                ratios.push(f64::from(limit / dropped.limit(color)));
                let [strict, naive] = &mut groups[usize::from(limit >= constant)];
                strict.add(&of_strict[i..=i]);
                naive.add(&of_naive[i..=i]);
            }
        }
        let num = limits.len().max(1) as f64;
        let [below, above] = groups.each_ref().map(|[strict, naive]| Group {
            share: strict.num as f64 / num,
            strict: strict.into(),
            naive: naive.into(),
        });
        Ok(Stops {
            share: limits.len() as f64 / num_pixels.max(1) as f64,
            limits: Spread::of(limits),
            centred_over_dropped: Spread::of(ratios),
            constant: constant.into(),
            below_constant: below,
            above_constant: above,
        })
    }

    /// Of the first view under the strict table: ΔE₀₀ and FLIP to the full image, and the part of the blends of the fixed
    /// 1e-4 that each pixel saves. A pixel that blends more than under the fixed rule, which looks ahead, saves nothing.
    pub fn maps(&self, strict: &TerminationLut) -> Result<Maps> {
        let Some(view) = self.views.first() else { return Err(Failure::new("there is no view")) };
        let draw = |termination| -> Result<Rendered> {
            Ok(render(&self.splats, &view.camera, &self.options(&termination, StatsMode::All))?)
        };
        let full = rgb(draw(Termination::Fixed(0.0))?)?;
        let (fixed, frame) = (draw(Termination::Fixed(1e-4))?, draw(Termination::Lut(strict.clone()))?);
        let counts = fixed.splat_stats.blends_of_pixels.iter().zip(&frame.splat_stats.blends_of_pixels);
        let saved = counts.map(|(&before, &now)| before.saturating_sub(now) as f32 / before.max(1) as f32).collect();
        let image = rgb(frame)?;
        let delta_e = differences(&image, &full).into_iter().map(|d| d as f32).collect();
        let flip = self.flip.difference(&self.flip.appearance(&full)?, &self.flip.appearance(&image)?)?;
        let flip = flip.into_iter().map(|d| d as f32).collect();
        Ok(Maps { width: image.width, height: image.height, delta_e, flip, saved })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spreads_are_those_of_the_values() {
        let spread = Spread::of(vec![4.0, 1.0, 2.0]);
        assert_eq!((spread.min, spread.median, spread.max), (1.0, 2.0, 4.0));
        assert!((spread.mean - 7.0 / 3.0).abs() < 1e-12);
        assert_eq!(Spread::of(Vec::new()), Spread { min: 0.0, median: 0.0, mean: 0.0, max: 0.0 });
    }
}
