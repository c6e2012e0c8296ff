//! What every rule is measured by: photographs, the image without any termination, and the clock.

use super::differences::{Differences, differences, psnr_between};
use super::{Row, Rule, THRESHOLDS, empty_row};
use crate::console::Console;
use crate::diagnostics::Result;
use crate::progress;
use gazesplat_core::View;
use gazesplat_core::image::ImageF32;
use gazesplat_core::io::images::ImageCache;
use gazesplat_core::rng::Rng;
use gazesplat_fovea::flip::Flip;
use gazesplat_fovea::lpips::Lpips;
use gazesplat_render::{RenderOptions, RenderStats, Splats, StatsMode, Termination, TerminationLut, render};
use gazesplat_train::evaluate::rgb;
use gazesplat_train::losses::LossTarget;
use gazesplat_train::metrics;
use std::time::Instant;

/// Seed of the order in which rules are timed.
const ORDER_SEED: u64 = 0x006f_7264_6572;

/// What the rules are measured on.
pub(super) struct Bench<'a> {
    pub splats: Splats,
    pub views: Vec<View>,
    pub images: ImageCache,
    pub options: RenderOptions,
    pub is_gpu: bool,
    pub flip: Flip,
    pub lpips: Option<Lpips>,
    pub console: &'a Console,
}

impl Bench<'_> {
    /// The options of a frame under this rule.
    pub fn options(&self, termination: &Termination, stats: StatsMode) -> RenderOptions {
        RenderOptions { termination: termination.clone(), stats, ..self.options.clone() }
    }

    /// An image and the counters of its frame.
    fn draw(&self, view: &View, termination: &Termination) -> Result<(ImageF32, RenderStats)> {
        let frame = render(&self.splats, &view.camera, &self.options(termination, StatsMode::All))?;
        let stats = frame.stats;
        Ok((rgb(frame)?, stats))
    }

    fn num_pixels(&self) -> f64 {
        let size = |v: &View| u64::from(v.camera.intrinsics.width) * u64::from(v.camera.intrinsics.height);
        self.views.iter().map(size).sum::<u64>() as f64
    }

    /// Mean PSNR to the untruncated images, and splats blended per pixel.
    pub fn quality(&self, termination: &Termination) -> Result<(f64, f64)> {
        let (mut psnr, mut blended) = (0.0, 0);
        for view in &self.views {
            let (full, _) = self.draw(view, &Termination::Fixed(0.0))?;
            let (image, stats) = self.draw(view, termination)?;
            psnr += psnr_between(&image, &full);
            blended += stats.num_blended;
        }
        Ok((psnr / self.views.len() as f64, blended as f64 / self.num_pixels()))
    }

    /// The γ at which `table` turns from more than wanted to less, by bisection of its logarithm; the nearer end of the
    /// interval, said aloud, when it does neither inside.
    pub fn matched(&self, table: &TerminationLut, is_more: impl Fn(f64, f64) -> bool) -> Result<f32> {
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
        if low == 1e-3 || high == 1e2 {
            self.console.note("no γ of 0.001 to 100 matches: the row named after the match is only the nearest");
        }
        Ok((low * high).sqrt())
    }

    /// Every rule against photographs and untruncated images.
    pub fn measure(&self, rules: &[Rule]) -> Result<Vec<Row>> {
        let mut rows: Vec<Row> = rules.iter().map(empty_row).collect();
        let mut all: Vec<[Differences; 2]> =
            rules.iter().map(|_| [Differences::of_delta_e(), Differences::of_flip()]).collect();
        let bar = progress::counting_bar(self.console, "measuring", self.views.len() * rules.len());
        for (index, view) in self.views.iter().enumerate() {
            let target = LossTarget::new(self.images.get(index)?, self.options.background);
            let (full, _) = self.draw(view, &Termination::Fixed(0.0))?;
            let seen = self.flip.appearance(&full)?;
            for (row, [delta_e, flip]) in rows.iter_mut().zip(&mut all) {
                let (image, stats) = self.draw(view, &row.termination)?;
                let share = 1.0 / self.views.len() as f64;
                row.psnr += share * metrics::psnr(&image, &target);
                row.ssim += share * metrics::ssim(&image, &target);
                row.psnr_to_full += share * psnr_between(&image, &full);
                row.blends_per_pixel += stats.num_blended as f64 / self.num_pixels();
                row.lane_pixels_per_pixel += stats.num_lane_pixels as f64 / self.num_pixels();
                if let Some(lpips) = &self.lpips {
                    *row.lpips.get_or_insert(0.0) += share * lpips.distance(&image, &full)?;
                }
                delta_e.add(&differences(&image, &full));
                flip.add(&self.flip.difference(&seen, &self.flip.appearance(&image)?)?);
                bar.inc(1);
            }
        }
        bar.finish_and_clear();
        for (row, [delta_e, flip]) in rows.iter_mut().zip(&all) {
            row.delta_e_max = delta_e.largest;
            row.delta_e_p999 = delta_e.exceeded_by(1e-3);
            row.above_one = delta_e.above(1.0);
            row.delta_e_above = THRESHOLDS.map(|value| delta_e.above(value));
            row.flip = flip.mean();
            row.flip_p999 = flip.exceeded_by(1e-3);
        }
        Ok(rows)
    }

    /// Times every rule: frame by frame one after the other, so that a busy moment of the machine meets all alike. Every
    /// round has an order of its own, so that no rule always inherits the memory and caches of the same other; the
    /// first of each view, which meets a cold machine, does not count.
    pub fn time(&self, rows: &mut [Row], repeats: usize) -> Result<()> {
        let bar = progress::counting_bar(self.console, "timing", self.views.len() * repeats);
        let mut ratios = vec![Vec::new(); rows.len()];
        let (mut rng, mut order) = (Rng::new(ORDER_SEED), (0..rows.len()).collect::<Vec<_>>());
        for view in &self.views {
            let mut times = vec![Vec::with_capacity(repeats); rows.len()];
            for round in 0..=repeats {
                rng.shuffle(&mut order);
                for &rule in &order {
                    let options = self.options(&rows[rule].termination, StatsMode::None);
                    let start = Instant::now();
                    let frame = render(&self.splats, &view.camera, &options)?;
                    if self.is_gpu {
                        // Work on a GPU is queued: reading one pixel waits for it.
                        frame.image.slice([0..1, 0..1]).into_data();
                    }
                    if round > 0 {
                        times[rule].push(1e3 * start.elapsed().as_secs_f64());
                    }
                }
                if round == 0 {
                    continue;
                }
                let vanilla = times[0][times[0].len() - 1];
                for (ratios, times) in ratios.iter_mut().zip(&times) {
                    ratios.extend(times.last().map(|time| vanilla / time));
                }
                bar.inc(1);
            }
            for (row, times) in rows.iter_mut().zip(&mut times) {
                row.ms += median(times) / self.views.len() as f64;
            }
        }
        bar.finish_and_clear();
        for (row, ratios) in rows.iter_mut().zip(&mut ratios) {
            row.speed_up = median(ratios);
        }
        Ok(())
    }
}

/// The median, the upper one of two; 0 of nothing.
pub(super) fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}
