//! Measuring a model on the photographs of some views, and choosing a few of them to look at.

use super::frames;
use crate::console::Console;
use crate::diagnostics::Result;
use crate::progress;
use crate::report::ViewPanel;
use gazesplat_core::io::images::ImageCache;
use gazesplat_render::{RenderOptions, Splats};
use gazesplat_train::EvalReport;

/// Views shown with pictures, as ranks among all by PSNR from the worst (0) to the best (1): the typical one first.
const PANEL_RANKS: [f64; 5] = [0.5, 0.0, 1.0, 0.25, 0.75];

/// Measures every view of `images`.
pub(crate) fn measure(
    splats: &Splats,
    images: &ImageCache,
    options: &RenderOptions,
    console: &Console,
) -> Result<EvalReport> {
    let bar = progress::counting_bar(console, "measuring", images.len());
    let report = gazesplat_train::evaluate(splats, images, options, &mut |_, _| bar.inc(1))?;
    bar.finish_and_clear();
    Ok(report)
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
