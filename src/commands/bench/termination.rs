//! `gazesplat bench termination`: the study of JND (Table 1, Fig. 7) on any model and scene.
//!
//! Every rule draws every view: against the photographs, against the image without any termination, and, interleaved frame
//! by frame so that all rules meet the same state of the machine, against the clock. Here is the list of rules; what is
//! measured of each is in `measure`, where the strict table stops is in `stops`.

mod differences;
mod measure;
mod output;
mod stops;

use super::super::antialiased::AntialiasedArgs;
use super::super::device::ComputeDevice;
use super::super::perceptual::lpips;
use super::super::termination::{TerminationArgs, constant};
use super::super::{Model, Split, load_scene, log_machine};
use crate::cli::{DeviceArgs, SettingsArgs};
use crate::console::Console;
use crate::diagnostics::{Failure, Result};
use clap::Args;
use gazesplat_core::View;
use gazesplat_core::color::ColorSpace;
use gazesplat_core::io::images::ImageCache;
use gazesplat_fovea::flip::{Flip, PIXELS_PER_DEGREE};
use gazesplat_fovea::termination_lut::LutSpec;
use gazesplat_render::{Residual, Splats, Termination, TerminationLut};
use measure::Bench;
use serde::Serialize;
use std::path::PathBuf;

/// Arguments of `bench termination`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat bench termination model.ply --scene fox --out study
  gazesplat bench termination runs/fox-1 --scene fox --views 4 --repeats 9 --device gpu
  gazesplat bench termination model.ply --scene fox --lut mine.json --gamma 2

Writes termination.csv, termination.json, error_over_time.svg, flip_over_time.svg,
quality_over_gamma.svg, and of the first view three maps for the strict table at γ = 1, black to pale
yellow: delta_e.png, the difference from the full image (0 to 1 just-noticeable difference); flip.png,
what FLIP says of it (0 to 0.1); saved.png, the part of the blends of `fixed 1e-4` that each pixel
saves (0 to 1). LPIPS is measured where its weights are given.")]
pub struct StudyArgs {
    /// A model file (PLY, compressed PLY, `.splat`, SPZ), or the directory of a run
    pub model: PathBuf,
    /// The scene with the photographs
    #[arg(long, value_name = "SCENE")]
    pub scene: PathBuf,
    /// Which views of the scene
    #[arg(long, value_enum, default_value = "test")]
    pub split: Split,
    /// Take this many views, evenly spread [default: all]
    #[arg(long, value_name = "N")]
    pub views: Option<usize>,
    /// Frames timed per view and rule, of which the median counts
    #[arg(long, value_name = "N", default_value_t = 5)]
    pub repeats: usize,
    /// Pixels per degree of visual angle, for FLIP
    #[arg(long, value_name = "N", default_value_t = PIXELS_PER_DEGREE)]
    pub pixels_per_degree: f64,
    /// A rule of one's own beside the others
    #[command(flatten)]
    pub termination: TerminationArgs,
    /// Settings
    #[command(flatten)]
    pub settings: SettingsArgs,
    /// Antialiasing
    #[command(flatten)]
    pub antialiased: AntialiasedArgs,
    /// Device
    #[command(flatten)]
    pub device: DeviceArgs,
    /// Measure LPIPS to the untruncated image too, with the weights in this safetensors file (README.md says how to make it)
    #[arg(long, value_name = "FILE")]
    pub lpips_weights: Option<PathBuf>,
    /// Directory for the results
    #[arg(long, value_name = "DIR", default_value = "bench/termination")]
    pub out: PathBuf,
}

/// γ of the study (JND Sec. 5).
const GAMMAS: [f32; 6] = [0.5, 1.0, 2.0, 5.0, 10.0, 20.0];

/// Fixed transmittances beside the usual one.
const CONSTANTS: [f32; 4] = [0.002, 0.004, 0.008, 0.016];

/// Values of ΔE₀₀ of which the shares of pixels above are told.
pub(super) const THRESHOLDS: [f64; 10] = [0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.75, 1.0, 2.0];

/// One rule and what came of it; means over views unless said otherwise.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Row {
    /// Name of the rule.
    pub rule: String,
    /// γ; `None` for a fixed transmittance.
    pub gamma: Option<f32>,
    /// Against the photographs, dB.
    pub psnr: f64,
    /// Against the photographs.
    pub ssim: f64,
    /// Against the untruncated image, dB, at most 100.
    pub psnr_to_full: f64,
    /// Largest ΔE₀₀ of any pixel of any view to the untruncated image, colours clamped to 0…1.
    pub delta_e_max: f64,
    /// ΔE₀₀ that a thousandth of all pixels exceed.
    pub delta_e_p999: f64,
    /// Share of all pixels above ΔE₀₀ = 1.
    pub above_one: f64,
    /// Shares of all pixels above each of [`THRESHOLDS`].
    pub delta_e_above: [f64; THRESHOLDS.len()],
    /// FLIP to the untruncated image, mean over all pixels.
    pub flip: f64,
    /// FLIP that a thousandth of all pixels exceed.
    pub flip_p999: f64,
    /// LPIPS to the untruncated image; `None` without weights.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f64>,
    /// Pixels that the kernel computed for each pixel of the image, blended or not: see
    /// [`gazesplat_render::RenderStats::num_lane_pixels`].
    pub lane_pixels_per_pixel: f64,
    /// Splats blended per pixel.
    pub blends_per_pixel: f64,
    /// Milliseconds per frame: mean over views of the median.
    pub ms: f64,
    /// Times as many frames per second as with the fixed 1e-4: median over all rounds of the ratio within a round.
    pub speed_up: f64,
    #[serde(skip)]
    termination: Termination,
}

/// Runs the study.
///
/// # Errors
/// When the device, the model or the scene cannot be used, or the results cannot be written.
pub fn command(args: &StudyArgs, console: &Console) -> Result<()> {
    if args.repeats == 0 || args.views == Some(0) {
        return Err(Failure::new("nothing would be measured").hint("give 1 or more with `--repeats` and `--views`"));
    }
    args.termination.check()?;
    let flip = Flip::new(args.pixels_per_degree)?;
    let device = ComputeDevice::open(args.device.device, console)?;
    device.guard(|| study(args, flip, &device, console))
}

fn study(args: &StudyArgs, flip: Flip, device: &ComputeDevice, console: &Console) -> Result<()> {
    log_machine();
    let model = Model::load_for_drawing(&args.model, console)?;
    let mut config = model.settings(&args.settings)?;
    config.model.antialiased = args.antialiased.or(config.model.antialiased);
    let all = args.split.views(&load_scene(&args.scene, &config, console)?, &args.scene)?;
    let num = args.views.unwrap_or(all.len()).min(all.len());
    let views: Vec<View> = (0..num).map(|i| all[i * all.len() / num].clone()).collect();
    // A table that cannot be used is refused before hours of work depend on it.
    let given = if args.termination.is_given() { Some(args.termination.termination()?) } else { None };
    let bench = Bench {
        splats: Splats::from_cloud(&model.cloud, device.tensors())?,
        images: ImageCache::new(views.clone(), config.data.cache_bytes),
        views,
        options: config.render_options(),
        is_gpu: device.is_gpu(),
        flip,
        lpips: lpips(args.lpips_weights.as_deref(), device)?,
        console,
    };
    let (strict, paper) = (LutSpec::strict().build()?, LutSpec::paper().build()?);
    let mut rules =
        vec![("fixed 1e-4".to_owned(), None, Termination::Fixed(1e-4)), table_rule("naive", constant(&paper)?, 1.0)?];
    let (wanted, _) = bench.quality(&Termination::Lut(paper.clone()))?;
    let matched = bench.matched(&constant(&paper)?, |psnr, _| psnr > wanted)?;
    rules.push(table_rule("naive, quality of paper", constant(&paper)?, matched)?);
    let (_, wanted) = bench.quality(&Termination::Lut(strict.clone()))?;
    let matched = bench.matched(&constant(&strict)?, |_, blends| blends > wanted)?;
    rules.push(table_rule("naive, blends of strict", constant(&strict)?, matched)?);
    let same_work = constant(&strict)?.with_gamma(matched)?;
    // The one constant that no colour may see: the smallest limit of all.
    rules.push(table_rule("naive, bound of strict", smallest(&strict)?, 1.0)?);
    // One transmittance without a table, as cheap as a rule can be: what the tables meet at equal speed.
    for t in CONSTANTS {
        rules.push((format!("fixed {t}"), None, Termination::Fixed(t)));
    }
    // What the centred residual costs and gains: the bounded table of the paper's, and the mean one without a bound.
    let dropping = LutSpec { residual: Residual::Drop, ..LutSpec::strict() }.build()?;
    rules.push(table_rule("strict, residual dropped", dropping, 1.0)?);
    rules.push(table_rule("strict, residual of the mean", strict.clone().with_residual(Residual::Mean), 1.0)?);
    for (name, table) in [("strict", &strict), ("paper", &paper)] {
        for gamma in GAMMAS {
            rules.push(table_rule(name, table.clone(), gamma)?);
        }
    }
    if let Some(given) = given {
        let gamma = match &given {
            Termination::Fixed(_) => None,
            Termination::Lut(lut) => Some(lut.gamma()),
        };
        rules.push(("given".to_owned(), gamma, given));
    }
    let mut rows = bench.measure(&rules)?;
    bench.time(&mut rows, args.repeats)?;
    let stops = bench.stops(&strict, &same_work)?;
    let maps = bench.maps(&strict)?;
    let results = output::Results {
        model: &args.model,
        device,
        views: &bench.views,
        pixels_per_degree: args.pixels_per_degree,
        rows: &rows,
        stops: &stops,
        maps,
    };
    output::write(&args.out, &results)?;
    console.note(output::table(&rows));
    console.note(format_args!("{} views; results in `{}`", bench.views.len(), args.out.display()));
    console.json(&rows)
}

/// The table with its smallest entry everywhere.
fn smallest(strict: &TerminationLut) -> Result<TerminationLut> {
    let entries = vec![strict.smallest_limit(); strict.values().len()];
    let table = TerminationLut::new(strict.size(), entries, ColorSpace::Srgb)?;
    Ok(table.with_residual(strict.residual()).with_color_max(strict.color_max()))
}

type Rule = (String, Option<f32>, Termination);

fn table_rule(name: &str, table: TerminationLut, gamma: f32) -> Result<Rule> {
    Ok((name.to_owned(), Some(gamma), Termination::Lut(table.with_gamma(gamma)?)))
}

fn empty_row((rule, gamma, termination): &Rule) -> Row {
    Row {
        rule: rule.clone(),
        gamma: *gamma,
        psnr: 0.0,
        ssim: 0.0,
        psnr_to_full: 0.0,
        delta_e_max: 0.0,
        delta_e_p999: 0.0,
        above_one: 0.0,
        delta_e_above: [0.0; THRESHOLDS.len()],
        flip: 0.0,
        flip_p999: 0.0,
        lpips: None,
        lane_pixels_per_pixel: 0.0,
        blends_per_pixel: 0.0,
        ms: 0.0,
        speed_up: 0.0,
        termination: termination.clone(),
    }
}
