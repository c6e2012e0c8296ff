//! Measuring a model on the photographs of some views, and choosing a few of them to look at.

use super::frames::{self, NamedCamera};
use crate::console::Console;
use crate::diagnostics::Result;
use crate::progress;
use crate::report::ViewPanel;
use crate::report::pictures::{error_map, heat};
use crate::run_dir::create_all;
use gazesplat_core::io::images::{ImageCache, TrainingImage};
use gazesplat_core::io::save_png;
use gazesplat_core::{ImageF32, RgbImage8};
use gazesplat_fovea::flip::FlipMetric;
use gazesplat_render::{RenderOptions, Splats};
use gazesplat_train::losses::LossTarget;
use gazesplat_train::metrics::ImageMetric;
use gazesplat_train::{EvalReport, ViewScore};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Views shown with pictures, as ranks among all by PSNR from the worst (0) to the best (1): the typical one first.
const PANEL_RANKS: [f64; 5] = [0.5, 0.0, 1.0, 0.25, 0.75];

/// Measures every view of `images`.
pub(crate) fn measure(
    splats: &Splats,
    images: &ImageCache,
    options: &RenderOptions,
    console: &Console,
) -> Result<EvalReport> {
    measure_each(splats, images, options, &[], &mut |_, _, _| Ok(()), console)
}

/// Measures every view of `images`, with further `metrics`; `each` gets its number, its score and its render, and is not called again after it has
/// failed: a disk that refuses one file refuses the next.
///
/// # Errors
/// Those of the measurement, else that of `each`.
pub(crate) fn measure_each(
    splats: &Splats,
    images: &ImageCache,
    options: &RenderOptions,
    metrics: &[&dyn ImageMetric],
    each: &mut dyn FnMut(usize, &ViewScore, &ImageF32) -> Result<()>,
    console: &Console,
) -> Result<EvalReport> {
    let bar = progress::counting_bar(console, "measuring", images.len());
    let (mut index, mut done) = (0, Ok(()));
    let report = gazesplat_train::evaluate_with(splats, images, options, metrics, &mut |score, render| {
        if done.is_ok() {
            done = each(index, score, render);
        }
        index += 1;
        bar.inc(1);
    })?;
    bar.finish_and_clear();
    done.map(|()| report)
}

/// Where renders, error maps and FLIP maps of measured views go.
pub(crate) struct ImageFiles {
    renders: PathBuf,
    errors: PathBuf,
    flips: PathBuf,
    names: Vec<String>,
}

impl ImageFiles {
    /// Makes `dir/renders`, `dir/errors` and `dir/flip` for the views of `images`, before anything is measured.
    ///
    /// # Errors
    /// When a directory cannot be made, or two views would share a file.
    pub(crate) fn create(dir: &Path, images: &ImageCache) -> Result<Self> {
        let cameras: Vec<NamedCamera> = images.views().iter().map(|v| (v.name.clone(), v.camera)).collect();
        let names = frames::png_names(&cameras).map_err(|failure| failure.hint("rename one of the two images"))?;
        let [renders, errors, flips] = ["renders", "errors", "flip"].map(|name| dir.join(name));
        for made in [&renders, &errors, &flips] {
            create_all(made)?;
        }
        Ok(Self { renders, errors, flips, names })
    }

    /// Writes the render of view `index`, its difference to `photo`, and what FLIP says of it from 0 to 1; both maps are dark
    /// where the mask leaves no loss.
    pub(crate) fn write(
        &self,
        index: usize,
        render: &ImageF32,
        photo: &Arc<TrainingImage>,
        options: &RenderOptions,
        flip: &FlipMetric,
    ) -> Result<()> {
        let seen = flip.map(render, &LossTarget::new(Arc::clone(photo), options.background))?;
        let data = seen.iter().flat_map(|&v| heat(v as f32)).collect();
        let seen = RgbImage8 { width: render.width, height: render.height, data };
        let render = render.to_rgb8();
        let mut errors = error_map(&photo.composited(options.background), &render);
        if let Some(mask) = &photo.mask {
            let hidden = errors.data.chunks_exact_mut(3).zip(mask).filter(|(_, counts)| **counts == 0);
            hidden.for_each(|(pixel, _)| pixel.fill(0));
        }
        let name = &self.names[index];
        save_png(self.renders.join(name), &render)?;
        save_png(self.flips.join(name), &seen)?;
        Ok(save_png(self.errors.join(name), &errors)?)
    }
}

/// Some of the measured views of `images` beside their renders: the typical, the worst, the best and two between.
pub(crate) fn panels(
    splats: &Splats,
    images: &ImageCache,
    options: &RenderOptions,
    report: &EvalReport,
) -> Result<Vec<ViewPanel>> {
    let mut by_psnr: Vec<usize> = (0..report.views.len()).collect();
    by_psnr.sort_by(|&a, &b| report.views[a].psnr.total_cmp(&report.views[b].psnr));
    let mut chosen: Vec<usize> = Vec::new();
    for rank in PANEL_RANKS {
        let place = (rank * by_psnr.len().saturating_sub(1) as f64).round() as usize;
        match by_psnr.get(place) {
            Some(&index) if !chosen.contains(&index) => chosen.push(index),
            _ => {}
        }
    }
    let mut panels = Vec::with_capacity(chosen.len());
    for index in chosen {
        let truth = images.get(index)?.composited(options.background);
        let (render, _) = frames::draw(splats, &images.views()[index].camera, options)?;
        let score = &report.views[index];
        panels.push(ViewPanel { name: score.name.clone(), truth, render, psnr: score.psnr, ssim: score.ssim });
    }
    Ok(panels)
}

/// The scores as a table for people.
pub(crate) fn table(report: &EvalReport) -> String {
    let width = report.views.iter().map(|v| v.name.chars().count()).max().unwrap_or(0).max("mean".len());
    let names: String = report.more.keys().map(|name| format!("  {:>7}", name.to_uppercase())).collect();
    let mut lines = vec![format!("{:width$}  {:>9}  {:>7}{names}", "view", "PSNR", "SSIM")];
    let row = |name: &str, psnr: f64, ssim: f64, more: &BTreeMap<String, f64>| {
        let more: String = more.values().map(|value| format!("  {value:>7.4}")).collect();
        format!("{name:width$}  {psnr:>6.2} dB  {ssim:>7.4}{more}")
    };
    lines.extend(report.views.iter().map(|v| row(&v.name, v.psnr, v.ssim, &v.more)));
    lines.push(row("mean", report.psnr, report.ssim, &report.more));
    lines.join("\n")
}
