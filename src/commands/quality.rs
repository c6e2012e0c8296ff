//! Measuring a model on the photographs of some views, and choosing a few of them to look at.

use super::frames::{self, NamedCamera};
use crate::console::Console;
use crate::diagnostics::Result;
use crate::progress;
use crate::report::ViewPanel;
use crate::report::pictures::error_map;
use crate::run_dir::create_all;
use gazesplat_core::ImageF32;
use gazesplat_core::io::images::{ImageCache, TrainingImage};
use gazesplat_core::io::save_png;
use gazesplat_render::{RenderOptions, Splats};
use gazesplat_train::{EvalReport, ViewScore};
use std::path::{Path, PathBuf};

/// Views shown with pictures, as ranks among all by PSNR from the worst (0) to the best (1): the typical one first.
const PANEL_RANKS: [f64; 5] = [0.5, 0.0, 1.0, 0.25, 0.75];

/// Measures every view of `images`.
pub(crate) fn measure(
    splats: &Splats,
    images: &ImageCache,
    options: &RenderOptions,
    console: &Console,
) -> Result<EvalReport> {
    measure_each(splats, images, options, &mut |_, _, _| Ok(()), console)
}

/// Measures every view of `images`; `each` gets its number, its score and its render, and is not called again after it has
/// failed: a disk that refuses one file refuses the next.
///
/// # Errors
/// Those of the measurement, else that of `each`.
pub(crate) fn measure_each(
    splats: &Splats,
    images: &ImageCache,
    options: &RenderOptions,
    each: &mut dyn FnMut(usize, &ViewScore, &ImageF32) -> Result<()>,
    console: &Console,
) -> Result<EvalReport> {
    let bar = progress::counting_bar(console, "measuring", images.len());
    let (mut index, mut done) = (0, Ok(()));
    let report = gazesplat_train::evaluate(splats, images, options, &mut |score, render| {
        if done.is_ok() {
            done = each(index, score, render);
        }
        index += 1;
        bar.inc(1);
    })?;
    bar.finish_and_clear();
    done.map(|()| report)
}

/// Where renders and error maps of measured views go.
pub(crate) struct ImageFiles {
    renders: PathBuf,
    errors: PathBuf,
    names: Vec<String>,
}

impl ImageFiles {
    /// Makes `dir/renders` and `dir/errors` for the views of `images`, before anything is measured.
    ///
    /// # Errors
    /// When a directory cannot be made, or two views would share a file.
    pub(crate) fn create(dir: &Path, images: &ImageCache) -> Result<Self> {
        let cameras: Vec<NamedCamera> = images.views().iter().map(|v| (v.name.clone(), v.camera)).collect();
        let names = frames::png_names(&cameras).map_err(|failure| failure.hint("rename one of the two images"))?;
        let [renders, errors] = ["renders", "errors"].map(|name| dir.join(name));
        create_all(&renders)?;
        create_all(&errors)?;
        Ok(Self { renders, errors, names })
    }

    /// Writes the render of view `index` and its difference to `photo`, dark where the mask leaves no loss.
    pub(crate) fn write(
        &self,
        index: usize,
        render: &ImageF32,
        photo: &TrainingImage,
        options: &RenderOptions,
    ) -> Result<()> {
        let render = render.to_rgb8();
        let mut errors = error_map(&photo.composited(options.background), &render);
        if let Some(mask) = &photo.mask {
            let hidden = errors.data.chunks_exact_mut(3).zip(mask).filter(|(_, counts)| **counts == 0);
            hidden.for_each(|(pixel, _)| pixel.fill(0));
        }
        let name = &self.names[index];
        save_png(self.renders.join(name), &render)?;
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
    let mut lines = vec![format!("{:width$}  {:>9}  {:>7}", "view", "PSNR", "SSIM")];
    let row = |name: &str, psnr: f64, ssim: f64| format!("{name:width$}  {psnr:>6.2} dB  {ssim:>7.4}");
    lines.extend(report.views.iter().map(|v| row(&v.name, v.psnr, v.ssim)));
    lines.push(row("mean", report.psnr, report.ssim));
    lines.join("\n")
}
