//! `gazesplat bench termination`: the study of JND (Table 1, Fig. 7) on any model and scene.
//!
//! Every rule draws every view: against the photographs, against the image without any termination, and, interleaved frame
//! by frame so that all rules meet the same state of the machine, against the clock. The file is long because the list of
//! rules, what is measured of each and the order of the measurements are read together.

mod output;

use super::super::device::ComputeDevice;
use super::super::termination::constant;
use super::super::{Model, Split, load_scene, log_machine};
use crate::cli::{DeviceArgs, SettingsArgs};
use crate::console::Console;
use crate::diagnostics::{Failure, Result};
use crate::progress;
use clap::Args;
use gazesplat_core::View;
use gazesplat_core::color::ciede2000::delta_e;
use gazesplat_core::color::lab::lab_from_srgb;
use gazesplat_core::image::ImageF32;
use gazesplat_core::io::images::ImageCache;
use gazesplat_fovea::termination_lut::LutSpec;
use gazesplat_render::{
    ColorMax, RenderOptions, Rendered, Residual, Splats, StatsMode, Termination, TerminationLut, render,
};
use gazesplat_train::evaluate::rgb;
use gazesplat_train::losses::LossTarget;
use gazesplat_train::metrics;
use rayon::prelude::*;
use serde::Serialize;
use std::path::PathBuf;
use std::time::Instant;

/// Arguments of `bench termination`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat bench termination model.ply --scene fox --out study
  gazesplat bench termination runs/fox-1 --scene fox --views 4 --repeats 9 --device gpu

Writes termination.csv, termination.json, error_over_time.svg, quality_over_gamma.svg, and of the
first view two maps for the strict table at γ = 1: delta_e.png, the difference from the full image
(0 black, 1 just-noticeable difference pale yellow), and left.png, the transmittance left over.")]
pub struct StudyArgs {
    /// A 3DGS PLY file, or the directory of a run
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
    /// Settings
    #[command(flatten)]
    pub settings: SettingsArgs,
    /// Device
    #[command(flatten)]
    pub device: DeviceArgs,
    /// Directory for the results
    #[arg(long, value_name = "DIR", default_value = "bench/termination")]
    pub out: PathBuf,
}

/// γ of the study (JND Sec. 5).
const GAMMAS: [f32; 6] = [0.5, 1.0, 2.0, 5.0, 10.0, 20.0];

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
    /// Splats blended per pixel.
    pub blends_per_pixel: f64,
    /// Milliseconds per frame: mean over views of the median.
    pub ms: f64,
    /// Times as many frames per second as with the fixed 1e-4.
    pub speed_up: f64,
    #[serde(skip)]
    termination: Termination,
}

/// What the rules are measured on.
struct Bench<'a> {
    splats: Splats,
    views: Vec<View>,
    images: ImageCache,
    options: RenderOptions,
    is_gpu: bool,
    console: &'a Console,
}

/// Runs the study.
///
/// # Errors
/// When the device, the model or the scene cannot be used, or the results cannot be written.
pub fn command(args: &StudyArgs, console: &Console) -> Result<()> {
    if args.repeats == 0 || args.views == Some(0) {
        return Err(Failure::new("nothing would be measured").hint("give 1 or more with `--repeats` and `--views`"));
    }
    let device = ComputeDevice::open(args.device.device, console)?;
    device.guard(|| study(args, &device, console))
}

fn study(args: &StudyArgs, device: &ComputeDevice, console: &Console) -> Result<()> {
    log_machine();
    let model = Model::load_for_drawing(&args.model, console)?;
    let config = model.settings(&args.settings)?;
    let all = args.split.views(&load_scene(&args.scene, &config, console)?, &args.scene)?;
    let num = args.views.unwrap_or(all.len()).min(all.len());
    let views: Vec<View> = (0..num).map(|i| all[i * all.len() / num].clone()).collect();
    let bench = Bench {
        splats: Splats::from_cloud(&model.cloud, device.tensors())?,
        images: ImageCache::new(views.clone(), config.data.cache_bytes),
        views,
        options: config.render_options(),
        is_gpu: device.is_gpu(),
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
    rules.push(table_rule("naive, work of strict", constant(&strict)?, matched)?);
    for (name, table) in [("strict", &strict), ("paper", &paper)] {
        for gamma in GAMMAS {
            rules.push(table_rule(name, table.clone(), gamma)?);
        }
    }
    let mut rows = bench.measure(&rules)?;
    bench.time(&mut rows, args.repeats)?;
    let ratio = bench.limit_ratio(&strict)?;
    let maps = bench.maps(&strict)?;
    output::write(
        &args.out,
        &output::Results { model: &args.model, device, views: &bench.views, rows: &rows, ratio, maps },
    )?;
    console.note(output::table(&rows));
    console.note(format_args!("{} views; results in `{}`", bench.views.len(), args.out.display()));
    console.json(&rows)
}

type Rule = (String, Option<f32>, Termination);

fn table_rule(name: &str, table: TerminationLut, gamma: f32) -> Result<Rule> {
    Ok((name.to_owned(), Some(gamma), Termination::Lut(table.with_gamma(gamma)?)))
}

/// Differences of the pixels of several images, in bins of a thousandth.
struct Differences {
    bins: Vec<u64>,
    largest: f64,
    num: u64,
}

impl Differences {
    const PER_UNIT: f64 = 1000.0;

    fn new() -> Self {
        Self { bins: vec![0; 200_000], largest: 0.0, num: 0 }
    }

    fn add(&mut self, differences: &[f64]) {
        for &d in differences {
            let bin = ((d * Self::PER_UNIT) as usize).min(self.bins.len() - 1);
            self.bins[bin] += 1;
            self.largest = self.largest.max(d);
        }
        self.num += differences.len() as u64;
    }

    /// The value that `share` of all exceed, to a thousandth.
    fn exceeded_by(&self, share: f64) -> f64 {
        let allowed = (share * self.num as f64) as u64;
        let mut above = 0;
        for (bin, count) in self.bins.iter().enumerate().rev() {
            above += count;
            if above > allowed {
                return (bin + 1) as f64 / Self::PER_UNIT;
            }
        }
        0.0
    }

    /// The share above `value`, to a bin.
    fn above(&self, value: f64) -> f64 {
        let first = (value * Self::PER_UNIT) as usize;
        self.bins[first.min(self.bins.len())..].iter().sum::<u64>() as f64 / self.num.max(1) as f64
    }
}

/// ΔE₀₀ of each pixel of two images of one size, clamped to 0…1.
fn differences(a: &ImageF32, b: &ImageF32) -> Vec<f64> {
    let lab =
        |p: &[f32]| lab_from_srgb(glam::DVec3::from_array(std::array::from_fn(|c| f64::from(p[c].clamp(0.0, 1.0)))));
    let pixels = a.data.par_chunks_exact(3).zip(b.data.par_chunks_exact(3));
    pixels.map(|(p, q)| if p == q { 0.0 } else { delta_e(lab(p), lab(q)) }).collect()
}

/// PSNR of two images of one size, clamped to 0…1; at most [`metrics::MAX_PSNR_DB`].
fn psnr_between(a: &ImageF32, b: &ImageF32) -> f64 {
    let squares = a.data.iter().zip(&b.data).map(|(p, q)| {
        let d = f64::from(p.clamp(0.0, 1.0)) - f64::from(q.clamp(0.0, 1.0));
        d * d
    });
    let mse = squares.sum::<f64>() / a.data.len().max(1) as f64;
    (-10.0 * mse.log10()).min(metrics::MAX_PSNR_DB)
}

impl Bench<'_> {
    fn options(&self, termination: &Termination, stats: StatsMode) -> RenderOptions {
        RenderOptions { termination: termination.clone(), stats, ..self.options.clone() }
    }

    /// An image and the splats blended in it.
    fn draw(&self, view: &View, termination: &Termination) -> Result<(ImageF32, u64)> {
        let frame = render(&self.splats, &view.camera, &self.options(termination, StatsMode::All))?;
        let blended = frame.stats.num_blended;
        Ok((rgb(frame)?, blended))
    }

    fn num_pixels(&self) -> f64 {
        let size = |v: &View| u64::from(v.camera.intrinsics.width) * u64::from(v.camera.intrinsics.height);
        self.views.iter().map(size).sum::<u64>() as f64
    }

    /// Mean PSNR to the untruncated images, and splats blended per pixel.
    fn quality(&self, termination: &Termination) -> Result<(f64, f64)> {
        let (mut psnr, mut blended) = (0.0, 0);
        for view in &self.views {
            let (full, _) = self.draw(view, &Termination::Fixed(0.0))?;
            let (image, num) = self.draw(view, termination)?;
            psnr += psnr_between(&image, &full);
            blended += num;
        }
        Ok((psnr / self.views.len() as f64, blended as f64 / self.num_pixels()))
    }

    /// The γ at which `table` turns from more than wanted to less, by bisection of its logarithm.
    fn matched(&self, table: &TerminationLut, is_more: impl Fn(f64, f64) -> bool) -> Result<f32> {
        let (mut low, mut high) = (1e-3_f32, 1e2_f32);
        let bar = progress::counting_bar(self.console, "matching", 14);
        for _ in 0..14 {
            let gamma = (low * high).sqrt();
            let (psnr, blends) = self.quality(&Termination::Lut(table.clone().with_gamma(gamma)?))?;
            if is_more(psnr, blends) {
                low = gamma;
            } else {
                high = gamma;
            }
            bar.inc(1);
        }
        bar.finish_and_clear();
        Ok((low * high).sqrt())
    }

    /// Every rule against photographs and untruncated images.
    fn measure(&self, rules: &[Rule]) -> Result<Vec<Row>> {
        let mut rows: Vec<Row> = rules.iter().map(empty_row).collect();
        let mut all: Vec<Differences> = rules.iter().map(|_| Differences::new()).collect();
        let bar = progress::counting_bar(self.console, "measuring", self.views.len() * rules.len());
        for (index, view) in self.views.iter().enumerate() {
            let target = LossTarget::new(self.images.get(index)?, self.options.background);
            let (full, _) = self.draw(view, &Termination::Fixed(0.0))?;
            for (row, all) in rows.iter_mut().zip(&mut all) {
                let (image, blended) = self.draw(view, &row.termination)?;
                let share = 1.0 / self.views.len() as f64;
                row.psnr += share * metrics::psnr(&image, &target);
                row.ssim += share * metrics::ssim(&image, &target);
                row.psnr_to_full += share * psnr_between(&image, &full);
                row.blends_per_pixel += blended as f64 / self.num_pixels();
                all.add(&differences(&image, &full));
                bar.inc(1);
            }
        }
        bar.finish_and_clear();
        for (row, all) in rows.iter_mut().zip(&all) {
            row.delta_e_max = all.largest;
            row.delta_e_p999 = all.exceeded_by(1e-3);
            row.above_one = all.above(1.0);
        }
        Ok(rows)
    }

    /// Times every rule: frame by frame one after the other, so that a busy moment of the machine meets all alike.
    fn time(&self, rows: &mut [Row], repeats: usize) -> Result<()> {
        let bar = progress::counting_bar(self.console, "timing", self.views.len() * repeats);
        for view in &self.views {
            let mut times = vec![Vec::with_capacity(repeats); rows.len()];
            for _ in 0..repeats {
                for (row, times) in rows.iter().zip(&mut times) {
                    let options = self.options(&row.termination, StatsMode::None);
                    let start = Instant::now();
                    let frame = render(&self.splats, &view.camera, &options)?;
                    if self.is_gpu {
                        // Work on a GPU is queued: reading the image waits for it.
                        rgb(frame)?;
                    }
                    times.push(1e3 * start.elapsed().as_secs_f64());
                }
                bar.inc(1);
            }
            for (row, times) in rows.iter_mut().zip(&mut times) {
                times.sort_by(f64::total_cmp);
                row.ms += times[times.len() / 2] / self.views.len() as f64;
            }
        }
        bar.finish_and_clear();
        let vanilla = rows[0].ms;
        for row in rows {
            row.speed_up = vanilla / row.ms;
        }
        Ok(())
    }

    /// How many times larger the limits of the centred residual are than those of the dropped one, mean over the pixels
    /// that stop under the strict table.
    fn limit_ratio(&self, strict: &TerminationLut) -> Result<f64> {
        let dropped = LutSpec { residual: Residual::Drop, ..LutSpec::strict() }.build()?;
        // Without the residual and over black, the image is the colour that decided.
        let table = strict.clone().with_residual(Residual::Drop).with_color_max(ColorMax::One);
        let mut options = self.options(&Termination::Lut(table), StatsMode::None);
        options.background = [0.0; 3];
        let (mut sum, mut num) = (0.0, 0_u64);
        for view in &self.views {
            let (image, t) = color_and_transmittance(render(&self.splats, &view.camera, &options)?)?;
            for (pixel, t) in image.data.chunks_exact(3).zip(t) {
                let color = [pixel[0], pixel[1], pixel[2]];
                if t <= strict.limit(color) {
                    sum += f64::from(strict.limit(color) / dropped.limit(color));
                    num += 1;
                }
            }
        }
        Ok(sum / num.max(1) as f64)
    }

    /// Of the first view under the strict table: ΔE₀₀, and the transmittance left beyond what the full image leaves.
    fn maps(&self, strict: &TerminationLut) -> Result<output::Maps> {
        let Some(view) = self.views.first() else { return Err(Failure::new("there is no view")) };
        let draw = |termination| -> Result<(ImageF32, Vec<f32>)> {
            let frame = render(&self.splats, &view.camera, &self.options(&termination, StatsMode::None))?;
            color_and_transmittance(frame)
        };
        let (full, full_t) = draw(Termination::Fixed(0.0))?;
        let (image, t) = draw(Termination::Lut(strict.clone()))?;
        let left = t.iter().zip(&full_t).map(|(a, b)| (a - b) / strict.largest_limit()).collect();
        let delta_e = differences(&image, &full).into_iter().map(|d| d as f32).collect();
        Ok(output::Maps { width: image.width, height: image.height, delta_e, left })
    }
}

/// The colours of a frame, and the transmittance left at each pixel.
fn color_and_transmittance(frame: Rendered) -> Result<(ImageF32, Vec<f32>)> {
    let stopped = |error: &dyn std::fmt::Display| gazesplat_render::Error::device(error);
    let [height, width, channels] = frame.image.dims();
    let data = frame.image.try_into_data().map_err(|e| stopped(&e))?;
    let values: Vec<f32> = data.try_into_vec().map_err(|e| stopped(&e))?;
    let pixels = || values.chunks_exact(channels);
    let data = pixels().flat_map(|p| [p[0], p[1], p[2]]).collect();
    Ok((ImageF32 { width: width as u32, height: height as u32, data }, pixels().map(|p| 1.0 - p[3]).collect()))
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
        blends_per_pixel: 0.0,
        ms: 0.0,
        speed_up: 0.0,
        termination: termination.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_of_differences_are_exact_to_a_bin() {
        let mut all = Differences::new();
        all.add(&(0..1000).map(|i| f64::from(i) / 100.0).collect::<Vec<_>>());
        assert_eq!(all.largest, 9.99);
        assert!((all.exceeded_by(0.1) - 9.0).abs() < 0.02);
        assert!((all.above(5.0) - 0.5).abs() < 0.002);
    }

    #[test]
    fn equal_images_do_not_differ() {
        let image = ImageF32 { width: 2, height: 1, data: vec![0.1, 0.5, 2.0, 0.0, -1.0, 1.0] };
        assert_eq!(differences(&image, &image), [0.0, 0.0]);
        assert_eq!(psnr_between(&image, &image), metrics::MAX_PSNR_DB);
        // 2 and 1 are both white.
        let other = ImageF32 { data: vec![0.1, 0.5, 1.0, 0.0, -1.0, 1.0], ..image.clone() };
        assert_eq!(differences(&image, &other), [0.0, 0.0]);
    }
}
