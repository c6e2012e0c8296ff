//! `gazesplat bench prune-curve`: criteria of pruning against each other, one shot per share that is kept (RTGS Sec. 3.2).
//!
//! Every criterion ranks the dense model once, by all training views; every share is cut from that ranking, trained on for
//! the same steps if that is asked for, measured, and timed frame by frame in turn with all others.

use super::super::antialiased::AntialiasedArgs;
use super::super::device::ComputeDevice;
use super::super::prune::curve::{self, Level, correlation};
use super::super::{Model, Split, load_scene, log_machine, quality};
use crate::cli::{DeviceArgs, SettingsArgs};
use crate::console::{Console, grouped};
use crate::diagnostics::{Failure, Result};
use crate::progress;
use crate::report::plots::Curve;
use crate::report::study::{Plot, TwoAxes, svg, two_axes};
use crate::run_dir::{create_all, to_json, write_text};
use clap::Args;
use gazesplat_core::io::images::ImageCache;
use gazesplat_core::{Camera, Dataset, GaussianCloud};
use gazesplat_render::{RenderOptions, Splats};
use gazesplat_train::config::StrategyKind;
use gazesplat_train::prune::{CriterionKind, one_shot};
use gazesplat_train::{Config, Trainer};
use serde::Serialize;
use std::path::PathBuf;
use std::sync::Arc;

/// Arguments of `bench prune-curve`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat bench prune-curve model.ply --scene fox --out study
  gazesplat bench prune-curve runs/fox-1 --scene fox --criteria ce,opacity --keep 0.5,0.25 --fine-tune 500

Writes prune_curve.csv, prune_curve.json, quality_over_time.svg and latency.svg (latency against
points and intersections of all models).")]
pub struct CurveArgs {
    /// The dense model: a 3DGS PLY file, or the directory of a run
    pub model: PathBuf,
    /// The scene with the photographs
    #[arg(long, value_name = "SCENE")]
    pub scene: PathBuf,
    /// Criteria to compare
    #[arg(
        long,
        value_name = "LIST",
        value_delimiter = ',',
        default_value = "ce,significance,opacity,max_contribution,surface"
    )]
    pub criteria: Vec<CriterionKind>,
    /// Shares of the Gaussians to keep, each above 0 and at most 1
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "0.5,0.25,0.12,0.06,0.03")]
    pub keep: Vec<f64>,
    /// Train every model on for this many steps after the cut
    #[arg(long, value_name = "STEPS", default_value_t = 0)]
    pub fine_tune: u32,
    /// Which views measure quality and time
    #[arg(long, value_enum, default_value = "test")]
    pub split: Split,
    /// Frames timed per view and model, of which the median counts
    #[arg(long, value_name = "N", default_value_t = 5)]
    pub repeats: usize,
    /// Settings
    #[command(flatten)]
    pub settings: SettingsArgs,
    /// Antialiasing
    #[command(flatten)]
    pub antialiased: AntialiasedArgs,
    /// Device
    #[command(flatten)]
    pub device: DeviceArgs,
    /// Directory for the results
    #[arg(long, value_name = "DIR", default_value = "bench/prune-curve")]
    pub out: PathBuf,
}

/// One model.
#[derive(Debug, Clone, Serialize)]
struct Row {
    criterion: String,
    keep: f64,
    psnr: f64,
    ssim: f64,
    #[serde(flatten)]
    level: Level,
    /// Frames per second over those of the dense model.
    speed_up: f64,
}

/// How much more another criterion's model of the same PSNR takes.
#[derive(Debug, Clone, Serialize)]
struct AtEqualQuality {
    criterion: String,
    psnr: f64,
    /// Its time per frame, interpolated, over that of CE.
    time_over_ce: f64,
    /// Its intersections worked through, likewise: the same on every machine.
    work_over_ce: f64,
}

/// Runs the study.
///
/// # Errors
/// When the device, the model or the scene cannot be used, or the results cannot be written.
pub fn command(args: &CurveArgs, console: &Console) -> Result<()> {
    if args.repeats == 0 || args.criteria.is_empty() || args.keep.is_empty() {
        return Err(
            Failure::new("nothing would be measured").hint("name criteria and shares, and repeat at least once")
        );
    }
    if let Some(bad) = args.keep.iter().find(|share| !(**share > 0.0 && **share <= 1.0)) {
        return Err(Failure::new(format!("`--keep`: found {bad}, expected shares above 0 and at most 1"))
            .hint("for example `--keep 0.5,0.25`"));
    }
    let device = ComputeDevice::open(args.device.device, console)?;
    device.guard(|| study(args, &device, console))
}

fn study(args: &CurveArgs, device: &ComputeDevice, console: &Console) -> Result<()> {
    log_machine();
    let model = Model::load_for_drawing(&args.model, console)?;
    let mut config = model.settings(&args.settings)?;
    config.model.antialiased = args.antialiased.or(config.model.antialiased);
    let dataset = load_scene(&args.scene, &config, console)?;
    let views = args.split.views(&dataset, &args.scene)?;
    let images = ImageCache::new(views.clone(), config.data.cache_bytes);
    let options = config.render_options();
    let dense = Splats::from_cloud(&model.cloud, device.tensors())?;
    let mut names = vec![("dense".to_owned(), 1.0)];
    let mut models = vec![dense];
    for cut in cuts(args, &model.cloud, &models[0], &dataset, &options, console)? {
        let cloud = tuned(args, cut.cloud, &dataset, &config, device)?;
        models.push(Splats::from_cloud(&cloud, device.tensors())?);
        names.push((cut.criterion.name().to_owned(), cut.keep));
    }
    let levels = curve::measure(&models, &views, &options, args.repeats, console)?;
    let mut rows = Vec::new();
    for (((criterion, keep), splats), level) in names.into_iter().zip(&models).zip(&levels) {
        let eval = quality::measure(splats, &images, &options, console)?;
        let speed_up = levels[0].ms / level.ms;
        rows.push(Row { criterion, keep, psnr: eval.psnr, ssim: eval.ssim, level: *level, speed_up });
    }
    let equal = at_equal_quality(&rows);
    write(args, device, &rows, &levels, &equal)?;
    console.note(table(&rows));
    for e in &equal {
        console.note(format_args!(
            "at {:.2} dB {} takes {:.2} × the time and {:.2} × the intersections of ce",
            e.psnr, e.criterion, e.time_over_ce, e.work_over_ce
        ));
    }
    console.note(format_args!("{} views; results in `{}`", views.len(), args.out.display()));
    console.json(&rows)
}

struct Cut {
    criterion: CriterionKind,
    keep: f64,
    cloud: GaussianCloud,
}

/// What every criterion leaves of the dense model at every share.
fn cuts(
    args: &CurveArgs,
    cloud: &GaussianCloud,
    dense: &Splats,
    dataset: &Dataset,
    options: &RenderOptions,
    console: &Console,
) -> Result<Vec<Cut>> {
    // What only a view sees that was kept out of training is worth no less.
    let cameras: Vec<Camera> = dataset.train.iter().chain(&dataset.holdout).map(|view| view.camera).collect();
    let bar = progress::counting_bar(console, "ranking", args.criteria.len());
    let mut found = Vec::new();
    for &criterion in &args.criteria {
        let kept = one_shot(criterion, dense, &cameras, options, &args.keep)?;
        for (rows, &keep) in kept.into_iter().zip(&args.keep) {
            let rows: Vec<usize> = rows.into_iter().map(|row| row as usize).collect();
            found.push(Cut { criterion, keep, cloud: cloud.select(&rows) });
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(found)
}

/// `cloud` after the steps that were asked for.
fn tuned(
    args: &CurveArgs,
    cloud: GaussianCloud,
    dataset: &Dataset,
    config: &Config,
    device: &ComputeDevice,
) -> Result<GaussianCloud> {
    if args.fine_tune == 0 {
        return Ok(cloud);
    }
    let mut config = config.clone();
    config.train.steps = args.fine_tune;
    config.densify.strategy = StrategyKind::None;
    config.model.sh_degree = cloud.sh_degree;
    // The rates of the pruning loop.
    (config.optim.means_lr, config.optim.means_lr_end) = (1.6e-5, 1.6e-6);
    let images = Arc::new(ImageCache::new(dataset.train.clone(), config.data.cache_bytes));
    let mut trainer = Trainer::from_cloud(&cloud, dataset, images, &config, device.tensors())?;
    while trainer.step_index() < args.fine_tune {
        trainer.step()?;
    }
    Ok(trainer.to_cloud()?)
}

/// For every model of CE, time and work of the others at its PSNR, where their curves reach it.
fn at_equal_quality(rows: &[Row]) -> Vec<AtEqualQuality> {
    let of = |name: &str, value: fn(&Level) -> f64| {
        let mut points: Vec<(f64, f64)> = rows
            .iter()
            .filter(|r| r.criterion == name || r.criterion == "dense")
            .map(|r| (r.psnr, value(&r.level)))
            .collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        points
    };
    let mut others: Vec<&str> =
        rows.iter().map(|r| r.criterion.as_str()).filter(|n| !["ce", "dense"].contains(n)).collect();
    others.dedup();
    let mut found = Vec::new();
    for ce in rows.iter().filter(|r| r.criterion == "ce") {
        for name in &others {
            let at_ce = |value: fn(&Level) -> f64| {
                interpolated(&of(name, value), ce.psnr).map(|found| found / value(&ce.level).max(f64::MIN_POSITIVE))
            };
            if let (Some(time_over_ce), Some(work_over_ce)) = (at_ce(|l| l.ms), at_ce(|l| l.pairs_used_per_tile)) {
                found.push(AtEqualQuality { criterion: (*name).to_owned(), psnr: ce.psnr, time_over_ce, work_over_ce });
            }
        }
    }
    found
}

/// The second value at `x` on the line through `points`, which ascend; `None` beyond them.
fn interpolated(points: &[(f64, f64)], x: f64) -> Option<f64> {
    points.windows(2).find(|w| w[0].0 <= x && x <= w[1].0).map(|w| {
        let span = w[1].0 - w[0].0;
        let t = if span > 0.0 { (x - w[0].0) / span } else { 0.0 };
        w[0].1 + t * (w[1].1 - w[0].1)
    })
}

const COLORS: [[u8; 3]; 5] = [[0, 114, 178], [213, 94, 0], [110, 110, 110], [0, 158, 115], [204, 121, 167]];

fn write(
    args: &CurveArgs,
    device: &ComputeDevice,
    rows: &[Row],
    levels: &[Level],
    equal: &[AtEqualQuality],
) -> Result<()> {
    create_all(&args.out)?;
    let mut csv = "criterion,keep,points,psnr,ssim,pairs_per_tile,pairs_used_per_tile,ms,speed_up\n".to_owned();
    for r in rows {
        let l = &r.level;
        csv.push_str(&format!(
            "{},{},{},{},{},{},{},{},{}\n",
            r.criterion, r.keep, l.points, r.psnr, r.ssim, l.pairs_per_tile, l.pairs_used_per_tile, l.ms, r.speed_up
        ));
    }
    write_text(&args.out.join("prune_curve.csv"), &csv)?;
    let with_points = correlation(levels, |l| l.ms, |l| l.points as f64);
    let with_used = correlation(levels, |l| l.ms, |l| l.pairs_used_per_tile);
    let report = serde_json::json!({
        "model": args.model.display().to_string(),
        "scene": args.scene.display().to_string(),
        "device": device.describe(),
        "fine_tune_steps": args.fine_tune,
        "correlation_of_latency_with_points": with_points,
        "correlation_of_latency_with_pairs_used": with_used,
        "at_equal_quality": equal,
        "rows": rows,
    });
    write_text(&args.out.join("prune_curve.json"), &format!("{}\n", to_json(&report)))?;
    let names: Vec<&str> = args.criteria.iter().map(|kind| kind.name()).collect();
    let curves: Vec<(&str, Curve)> = names
        .iter()
        .zip(COLORS.iter().cycle())
        .map(|(&name, &color)| {
            let points = rows.iter().filter(|r| r.criterion == name || r.criterion == "dense");
            let points = points.map(|r| (r.level.ms, r.psnr)).collect();
            (name, Curve { points, color, opacity: 1.0, width: 2, dots: true })
        })
        .collect();
    let plot = Plot { title: "Criteria, one shot", x: "ms per frame", y: "PSNR, dB", curves: &curves };
    if let Some(svg) = svg(&plot) {
        write_text(&args.out.join("quality_over_time.svg"), &svg)?;
    }
    let points: Vec<(f64, f64)> = levels.iter().map(|l| (l.ms, l.points as f64)).collect();
    let used: Vec<(f64, f64)> = levels.iter().map(|l| (l.ms, l.pairs_used_per_tile)).collect();
    let show = |r: Option<f64>| r.map_or_else(|| "undefined".to_owned(), |r| format!("{r:.3}"));
    let note = format!("correlation with points {}, with intersections {}", show(with_points), show(with_used));
    let plot = TwoAxes {
        title: "Latency of all models",
        x: "latency, ms per frame",
        left: ("points", &points),
        right: ("intersections per tile", &used),
        note: &note,
    };
    if let Some(svg) = two_axes(&plot) {
        write_text(&args.out.join("latency.svg"), &svg)?;
    }
    Ok(())
}

/// The rows for people.
fn table(rows: &[Row]) -> String {
    let mut lines = vec![format!(
        "{:16}  {:>5}  {:>9}  {:>7}  {:>6}  {:>8}  {:>8}  {:>8}",
        "criterion", "keep", "Gaussians", "PSNR", "SSIM", "per tile", "ms", "speed-up"
    )];
    for r in rows {
        lines.push(format!(
            "{:16}  {:>5.2}  {:>9}  {:>7.2}  {:>6.4}  {:>8.1}  {:>8.2}  {:>7.2}×",
            r.criterion,
            r.keep,
            grouped(r.level.points),
            r.psnr,
            r.ssim,
            r.level.pairs_used_per_tile,
            r.level.ms,
            r.speed_up
        ));
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(criterion: &str, psnr: f64, ms: f64) -> Row {
        let level = Level { points: 1, pairs_per_tile: 1.0, pairs_used_per_tile: 1.0, ms };
        Row { criterion: criterion.to_owned(), keep: 1.0, psnr, ssim: 1.0, level, speed_up: 1.0 }
    }

    #[test]
    fn times_are_compared_at_equal_quality_where_the_curves_meet() {
        let rows = [
            row("dense", 30.0, 10.0),
            row("ce", 28.0, 4.0),
            row("ce", 20.0, 1.0),
            row("opacity", 26.0, 6.0),
            row("opacity", 24.0, 5.0),
        ];
        let found = at_equal_quality(&rows);
        assert_eq!(found.len(), 1, "20 dB is beyond the other's curve");
        assert_eq!((found[0].criterion.as_str(), found[0].psnr, found[0].time_over_ce), ("opacity", 28.0, 2.0));
    }
}
