//! What a pruning run delivers: the model, its quality and speed beside the dense one's, and the report.

use super::super::quality;
use super::Run;
use super::curve::{self, Level, REPEATS, correlation};
use crate::console::{bytes, duration, grouped};
use crate::diagnostics::Result;
use crate::report::pictures::heat;
use crate::report::study::{TwoAxes, two_axes};
use crate::report::{Figure, Measured as Views, PictureRow, Report, Section, html};
use crate::run_dir::RunDir;
use crate::settings;
use gazesplat_core::io::model::ANTIALIASED_COMMENT;
use gazesplat_core::io::ply;
use gazesplat_core::{GaussianCloud, RgbImage8, View};
use gazesplat_render::cluster::morton_order;
use gazesplat_render::{RenderOptions, Splats, StatsMode, render};
use gazesplat_train::EvalReport;
use gazesplat_train::prune::{Basis, GuardViews, Outcome, Plan, Reference, Status};
use serde::Serialize;

/// Views shown with pictures.
const NUM_PANELS: usize = 3;

/// The last line of `prune.jsonl`, and what is told on standard output.
#[derive(Debug, Serialize)]
struct ResultLine {
    phase: &'static str,
    status: Status,
    points_dense: usize,
    points: usize,
    /// Size of the model as a share of the dense one's.
    size_share: f64,
    /// Frames per second over those of the dense model, interleaved.
    speed_up: f64,
    dense: Quality,
    pruned: Quality,
    /// What the bounds were relative to.
    basis: Option<Basis>,
    /// Correlation of latency with points, and with intersections per tile, over the levels.
    correlation_points: Option<f64>,
    correlation_pairs_used: Option<f64>,
    levels: Vec<Level>,
    elapsed_s: f64,
}

/// A model's quality on the views that were kept from training (or judged, without such), and its work and time.
#[derive(Debug, Clone, Copy, Serialize)]
struct Quality {
    psnr: f64,
    ssim: f64,
    #[serde(flatten)]
    level: Level,
}

impl Run<'_> {
    /// Measures and writes everything.
    pub(super) fn finish(mut self, outcome: &Outcome) -> Result<()> {
        let run_secs = self.elapsed_s();
        let cloud = self.pruner.result()?;
        if outcome.status == Status::NoPass {
            let text = "no state of the run held the quality: the model delivered is the dense one".to_owned();
            self.console.warn(&text);
            self.warnings.push(text);
        }
        let options = self.stage.train_config.render_options();
        let device = self.device.tensors();
        let upload = |cloud: &GaussianCloud| Splats::from_cloud(&for_drawing(cloud), device);
        // The dense model, what was kept on the way, and the result: the first and the last are compared.
        let mut models = vec![upload(&self.model.cloud)?];
        for (points, path) in self.dir.levels() {
            if points < self.model.cloud.len() && points > cloud.len() {
                models.push(upload(&ply::load(&path)?)?);
            }
        }
        models.push(upload(&cloud)?);
        let views: Vec<View> = self.stage.split.guard.clone();
        let levels = curve::measure(&models, &views, &options, REPEATS, self.console)?;
        let (which, images) = match self.stage.dataset.test.is_empty() {
            false => (Views::Test, &self.stage.test_images),
            // Views that are kept out judge like test views.
            true if self.stage.split.views == GuardViews::Holdout => (Views::Test, &self.stage.guard_images),
            true => (Views::Training, &self.stage.guard_images),
        };
        let (first, last) = (&models[0], &models[models.len() - 1]);
        let dense = quality::measure(first, images, &options, self.console)?;
        let pruned = quality::measure(last, images, &options, self.console)?;
        let quality = |eval: &EvalReport, level: &Level| Quality { psnr: eval.psnr, ssim: eval.ssim, level: *level };
        let (level_dense, level_pruned) = (levels[0], levels[levels.len() - 1]);
        let result = ResultLine {
            phase: "result",
            status: outcome.status,
            points_dense: outcome.points_dense,
            points: cloud.len(),
            size_share: cloud.len() as f64 / outcome.points_dense.max(1) as f64,
            speed_up: level_dense.ms / level_pruned.ms,
            basis: self.pruner.reference().map(|(_, basis)| basis),
            dense: quality(&dense, &level_dense),
            pruned: quality(&pruned, &level_pruned),
            correlation_points: correlation(&levels, |l| l.ms, |l| l.points as f64),
            correlation_pairs_used: correlation(&levels, |l| l.ms, |l| l.pairs_used_per_tile),
            levels,
            elapsed_s: self.elapsed_s(),
        };
        let panels = self.load_panels(first, last, images.views(), &options)?;
        let views = quality::panels(last, images, &options, &pruned)?;
        let curve = curve_svg(&result);
        let report = Report {
            measured: which,
            title: format!("{}, pruned", super::scene_name(&self.scene)),
            subtitle: format!(
                "{} of {} Gaussians draw {:.1} times as many frames per second.",
                grouped(result.points),
                grouped(result.points_dense),
                result.speed_up
            ),
            headline: headline(&result, run_secs),
            views,
            sections: self.sections(&result, curve.clone(), panels),
            scores: pruned.views.iter().map(|v| (v.name.clone(), v.psnr, v.ssim)).collect(),
            facts: self.facts(&result, which),
            durations: vec![("pruning".to_owned(), run_secs)],
            warnings: self.warnings.clone(),
            settings: settings::run_to_toml(&self.config, &self.terms),
            ..Report::default()
        };
        // The model last but one: what says "finished" stands only when the rest is there, and then the scaffolding goes.
        let run_dir: &RunDir = self.dir.run_dir();
        run_dir.write_eval(&pruned)?;
        if let Some(svg) = &curve {
            self.dir.write_curve(svg)?;
        }
        run_dir.write_report(&html::page(&report))?;
        run_dir.write_model_with(&cloud, &self.provenance(&result))?;
        self.dir.append_result(&result)?;
        self.dir.remove_scaffolding()?;
        self.console.note(format_args!(
            "{}: {} of {} Gaussians, {:.2}× as fast ({:.1} → {:.1} ms), {:.2} → {:.2} dB and SSIM {:.4} → {:.4} on {} {} \
             views, {}",
            self.dir.path().display(),
            grouped(result.points),
            grouped(result.points_dense),
            result.speed_up,
            level_dense.ms,
            level_pruned.ms,
            dense.psnr,
            pruned.psnr,
            dense.ssim,
            pruned.ssim,
            pruned.views.len(),
            which.name(),
            duration(run_secs)
        ));
        self.console.note(format_args!("look at `{}`", self.dir.run_dir().report_path().display()));
        self.console.json(&result)
    }

    /// Where the model comes from, for the header of its file: equal runs give equal files.
    fn provenance(&self, result: &ResultLine) -> Vec<String> {
        let Plan { prune, adapt, .. } = *self.pruner.plan();
        let mut lines = vec![
            format!("Scene: {}, {}", super::scene_name(&self.scene), self.stage.dataset.source),
            format!(
                "Pruned: {} of {} Gaussians by {}, {} steps, seed {}, at most {} of the quality lost on {} views ({})",
                result.points,
                result.points_dense,
                self.config.prune.criterion,
                prune + adapt,
                self.config.prune.seed,
                self.config.guard.loss,
                self.stage.split.guard.len(),
                self.stage.split.views.name()
            ),
        ];
        lines.extend(self.config.model.antialiased.then(|| ANTIALIASED_COMMENT.to_owned()));
        lines
    }

    fn sections(&self, result: &ResultLine, curve: Option<String>, panels: Vec<PictureRow>) -> Vec<Section> {
        let mut sections = Vec::new();
        if let Some(svg) = curve {
            sections.push(Section {
                heading: "Latency, points and intersections".to_owned(),
                text:
                    "Models on the way from the dense one to the result, drawn in turn: what a frame costs, how many \
                       Gaussians there are, and how many of them a tile works through."
                        .to_owned(),
                plots: vec![(format!("{} levels of pruning", result.levels.len()), svg)],
                ..Section::default()
            });
        }
        sections.push(Section {
            heading: "Work of the tiles".to_owned(),
            text: "What is drawn, before and after, and how many Gaussians each tile works through.".to_owned(),
            rows: panels,
            legend: "Gaussians worked through per tile: 0 to the largest of the dense model".to_owned(),
            ..Section::default()
        });
        sections
    }

    /// Renders of both models and how much each tile works, for some views.
    fn load_panels(
        &self,
        dense: &Splats,
        pruned: &Splats,
        views: &[View],
        options: &RenderOptions,
    ) -> Result<Vec<PictureRow>> {
        let options = RenderOptions { stats: StatsMode::Tiles, ..options.clone() };
        let num = NUM_PANELS.min(views.len());
        let mut rows = Vec::new();
        for view in (0..num).map(|i| &views[i * views.len() / num]) {
            let mut drawn = Vec::new();
            for splats in [dense, pruned] {
                let rendered = render(splats, &view.camera, &options)?;
                let used = rendered.splat_stats.tiles.num_pairs_used.clone();
                drawn.push((gazesplat_train::evaluate::rgb(rendered)?.to_rgb8(), used));
            }
            let largest = drawn[0].1.iter().copied().max().unwrap_or(0).max(1);
            let mean = |used: &[u32]| used.iter().map(|&n| f64::from(n)).sum::<f64>() / used.len().max(1) as f64;
            let caption = |name: &str, used: &[u32]| format!("{}, {name}: {:.1} per tile", view.name, mean(used));
            for (name, (image, used)) in ["dense", "pruned"].into_iter().zip(drawn) {
                let load = load_map(&used, largest, image.width, image.height);
                let pictures = vec![(name.to_owned(), image), ("work per tile".to_owned(), load)];
                rows.push(PictureRow { caption: caption(name, &used), pictures });
            }
        }
        Ok(rows)
    }

    fn facts(&self, result: &ResultLine, which: Views) -> Vec<(String, String)> {
        let mut facts = vec![
            ("model".to_owned(), self.model.path.display().to_string()),
            ("scene".to_owned(), self.scene.display().to_string()),
        ];
        let row = |name: &str, q: &Quality| {
            let text = format!(
                "{} Gaussians, {:.1} intersections per tile, {:.1} worked through, {:.2} ms per frame; {:.3} dB, SSIM {:.4} \
                 on the {} views",
                grouped(q.level.points),
                q.level.pairs_per_tile,
                q.level.pairs_used_per_tile,
                q.level.ms,
                q.psnr,
                q.ssim,
                which.name()
            );
            (name.to_owned(), text)
        };
        facts.push(row("dense", &result.dense));
        facts.push(row("pruned", &result.pruned));
        if let Some((measured, basis)) = self.pruner.reference() {
            let reference = Reference { psnr: measured.psnr, ssim: measured.ssim };
            let least = basis.bounds(reference, self.config.guard.loss);
            let why = match basis {
                Basis::Share => format!("{:.1} % may be lost", 100.0 * self.config.guard.loss),
                Basis::Floor => "the views are renders of the model, so there are floors".to_owned(),
            };
            let (num, views) = (self.stage.split.guard.len(), self.stage.split.views.name());
            facts.push((
                "reference".to_owned(),
                format!("{:.3} dB, SSIM {:.4} on {num} views that judge ({views})", reference.psnr, reference.ssim),
            ));
            facts.push(("to hold".to_owned(), format!("{:.3} dB, SSIM {:.4}: {why}", least.psnr, least.ssim)));
        }
        if let Ok(file) = std::fs::metadata(&self.model.path) {
            facts.push(("dense model file".to_owned(), bytes(file.len())));
        }
        facts.push(("computed on".to_owned(), self.device.describe()));
        facts
    }
}

/// Neighbours in space as neighbours in memory, and no SH band that is 0 throughout: as models are drawn.
fn for_drawing(cloud: &GaussianCloud) -> GaussianCloud {
    let order: Vec<usize> = morton_order(&cloud.means).into_iter().map(|row| row as usize).collect();
    let sorted = cloud.select(&order);
    let degree = sorted.highest_nonzero_degree();
    if degree < sorted.sh_degree { sorted.with_sh_degree(degree) } else { sorted }
}

fn headline(result: &ResultLine, secs: f64) -> Vec<Figure> {
    vec![
        Figure::new(format!("{:.2}", result.speed_up), "×", "frames per second over the dense model"),
        Figure::new(format!("{:.0}", 100.0 * result.size_share), "%", "of its Gaussians"),
        Figure::new(format!("{:.2}", result.pruned.psnr), "dB", &format!("PSNR, dense {:.2}", result.dense.psnr)),
        Figure::new(format!("{:.3}", result.pruned.ssim), "", &format!("SSIM, dense {:.3}", result.dense.ssim)),
        Figure::new(duration(secs), "", "pruning time"),
    ]
}

/// RTGS Fig. 4 of this run; `None` without a level between the ends.
fn curve_svg(result: &ResultLine) -> Option<String> {
    if result.levels.len() < 3 {
        return None;
    }
    let points: Vec<(f64, f64)> = result.levels.iter().map(|l| (l.ms, l.points as f64)).collect();
    let used: Vec<(f64, f64)> = result.levels.iter().map(|l| (l.ms, l.pairs_used_per_tile)).collect();
    let show = |r: Option<f64>| r.map_or_else(|| "undefined".to_owned(), |r| format!("{r:.3}"));
    let note = format!(
        "correlation of latency with points {}, with intersections {}",
        show(result.correlation_points),
        show(result.correlation_pairs_used)
    );
    two_axes(&TwoAxes {
        title: "Levels of pruning",
        x: "latency, ms per frame",
        left: ("points", &points),
        right: ("intersections per tile", &used),
        note: &note,
    })
}

/// One colour per tile.
fn load_map(used: &[u32], largest: u32, width: u32, height: u32) -> RgbImage8 {
    let tile = gazesplat_render::layout::TILE as u32;
    let tiles_x = width.div_ceil(tile);
    let color = |x: u32, y: u32| {
        let at = (y / tile * tiles_x + x / tile) as usize;
        heat(used.get(at).map_or(0.0, |&n| n as f32 / largest as f32))
    };
    let data = (0..height).flat_map(|y| (0..width).flat_map(move |x| color(x, y))).collect();
    RgbImage8 { width, height, data }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pixel_has_the_colour_of_its_tile() {
        let map = load_map(&[0, 10, 5, 10], 10, 20, 17);
        let at = |x: usize, y: usize| <[u8; 3]>::try_from(&map.data[3 * (20 * y + x)..][..3]).expect("three channels");
        assert_eq!([at(0, 0), at(16, 0), at(15, 16), at(19, 16)], [heat(0.0), heat(1.0), heat(0.5), heat(1.0)]);
    }
}
