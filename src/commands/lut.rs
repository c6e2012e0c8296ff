//! `gazesplat lut`: a termination table with its provenance, its range and its picture.

use crate::console::Console;
use crate::diagnostics::{Failure, Result};
use crate::report::pictures::heat;
use crate::run_dir::write_text;
use clap::{Args, ValueEnum};
use gazesplat_core::color::{ColorSpace, to_u8};
use gazesplat_core::{RgbImage8, io};
use gazesplat_fovea::hvs::jnd::Rule;
use gazesplat_fovea::termination_lut::{LutFile, LutSpec, Preset, Sample};
use gazesplat_render::Residual;
use serde_json::json;
use std::path::PathBuf;

/// Names of [`Preset`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PresetName {
    /// No pixel differs from the full image by more than one just-noticeable difference
    Strict,
    /// As Ji, Wang and Zhang published it
    Paper,
}

/// Names of [`Rule`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
pub enum RuleName {
    /// The metric of ΔE₀₀ over the corners of what the rest can be
    Vertex,
    /// ΔE₀₀ itself
    Exact,
    /// The smallest half axis in cone-opponent space
    DklDiagonal,
    /// The ellipsoid along the cone-opponent axes over the corners
    DklVertex,
}

/// Names of [`ColorSpace`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum SpaceName {
    /// The encoded values that 3DGS composites
    Srgb,
    /// Linear light; the renderer refuses such a table, unless it is the paper's
    Linear,
}

/// Names of [`Sample`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
pub enum SampleName {
    /// The smallest limit in the cell
    VoxelMin,
    /// That of its centre
    Centre,
}

/// Names of [`Residual`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ResidualName {
    /// Nothing
    Drop,
    /// The background
    Background,
    /// The mean colour seen so far
    Mean,
    /// The middle of what the rest can be
    Centre,
}

/// Arguments of `lut`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat lut --out strict.json
  gazesplat lut --preset paper --out paper.json
  gazesplat lut --rule vertex --size 16 --out vertex16.json
  gazesplat render model.ply --scene fox --lut paper.json --gamma 2 --out frames

Beside FILE.json a picture FILE.png is written: one panel per cell of red, green downwards, blue
to the right; above the colours, below the transmittances from 0 to the largest.")]
pub struct LutArgs {
    /// What everything else starts from
    #[arg(long, value_enum, default_value = "strict")]
    pub preset: PresetName,
    /// How the limit at a colour is found
    #[arg(long, value_enum)]
    pub rule: Option<RuleName>,
    /// The space in which limits are derived
    #[arg(long, value_enum)]
    pub space: Option<SpaceName>,
    /// Which colours of a cell count
    #[arg(long, value_enum)]
    pub sample: Option<SampleName>,
    /// What pixels that stopped receive for the rest
    #[arg(long, value_enum)]
    pub residual: Option<ResidualName>,
    /// Cells along each axis, 1 to 64
    #[arg(long, value_name = "N")]
    pub size: Option<usize>,
    /// One just-noticeable difference in units of ΔE₀₀
    #[arg(long, value_name = "DE", allow_hyphen_values = true)]
    pub jnd_de: Option<f64>,
    /// The cubic mean of the table everywhere: the naive baseline
    #[arg(long)]
    pub constant: bool,
    /// The table file
    #[arg(long, value_name = "FILE.json")]
    pub out: PathBuf,
}

impl LutArgs {
    fn spec(&self) -> LutSpec {
        let mut spec = LutSpec::preset(match self.preset {
            PresetName::Strict => Preset::Strict,
            PresetName::Paper => Preset::Paper,
        });
        if let Some(rule) = self.rule {
            spec.rule = match rule {
                RuleName::Vertex => Rule::Vertex,
                RuleName::Exact => Rule::Exact,
                RuleName::DklDiagonal => Rule::DklDiagonal,
                RuleName::DklVertex => Rule::DklVertex,
            };
        }
        if let Some(space) = self.space {
            let space = match space {
                SpaceName::Srgb => ColorSpace::Srgb,
                SpaceName::Linear => ColorSpace::Linear,
            };
            // Only the paper's own choice applies a table for one space to another: naming it again changes nothing.
            if space != spec.space {
                (spec.space, spec.read_as) = (space, space);
            }
        }
        if let Some(sample) = self.sample {
            spec.sample = match sample {
                SampleName::VoxelMin => Sample::VoxelMin,
                SampleName::Centre => Sample::Centre,
            };
        }
        if let Some(residual) = self.residual {
            spec.residual = match residual {
                ResidualName::Drop => Residual::Drop,
                ResidualName::Background => Residual::Background,
                ResidualName::Mean => Residual::Mean,
                ResidualName::Centre => Residual::Centre,
            };
        }
        spec.size = self.size.unwrap_or(spec.size);
        spec.jnd_de = self.jnd_de.unwrap_or(spec.jnd_de);
        spec.is_constant = self.constant;
        spec
    }
}

/// Runs `lut`.
///
/// # Errors
/// When an option is out of its range or a file cannot be written.
pub fn command(args: &LutArgs, console: &Console) -> Result<()> {
    let picture = args.out.with_extension("png");
    if picture == args.out {
        return Err(Failure::new(format!("`{}` is where the picture goes", args.out.display()))
            .hint("give a file that ends in `.json` with `--out`"));
    }
    let file = LutFile::build(args.spec())
        .map_err(|e| Failure::new(e.to_string()).hint("`gazesplat lut --help` says what each option takes"))?;
    write_text(&args.out, &format!("{}\n", file.to_json()))?;
    io::save_png(&picture, &slices(&file))?;
    let r = file.range;
    console.note(format_args!(
        "transmittances {:.2e} to {:.2e}, median {:.2e}, cubic mean {:.2e}; `{}` and `{}`",
        r.min,
        r.max,
        r.median,
        r.cubic_mean,
        args.out.display(),
        picture.display()
    ));
    console.json(&json!({ "spec": file.spec, "range": file.range }))
}

/// Side of a panel in pixels, about.
const PANEL: usize = 96;

/// The picture of a table.
fn slices(file: &LutFile) -> RgbImage8 {
    let n = file.spec.size;
    let cell = (PANEL / n).max(1);
    let (panel, gap) = (n * cell, 4);
    let (width, height) = (n * (panel + gap) - gap, 2 * panel + gap);
    let mut image = RgbImage8 { width: width as u32, height: height as u32, data: vec![32; width * height * 3] };
    for (i, &value) in file.values.iter().enumerate() {
        let [red, green, blue] = [i / (n * n), i / n % n, i % n];
        let color = [red, green, blue].map(|c| to_u8((c as f32 + 0.5) / n as f32));
        let limit = heat(value / file.range.max as f32);
        for (top, pixel) in [(0, color), (panel + gap, limit)] {
            for y in 0..cell {
                let row = top + green * cell + y;
                let at = row * width + red * (panel + gap) + blue * cell;
                for slot in image.data[at * 3..(at + cell) * 3].chunks_exact_mut(3) {
                    slot.copy_from_slice(&pixel);
                }
            }
        }
    }
    image
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn picture_holds_every_cell() {
        let spec = LutSpec { size: 2, rule: Rule::Vertex, sample: Sample::Centre, ..LutSpec::strict() };
        let image = slices(&LutFile::build(spec).expect("builds"));
        assert_eq!((image.width, image.height), (2 * 96 + 4, 2 * 96 + 4));
        assert_eq!(image.data[..3], [64, 64, 64]);
    }
}
