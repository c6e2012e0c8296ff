//! Settings of a training run: plain data with defaults in place, unknown keys rejected.
//!
//! Keys with a step count say how they behave in runs shorter than the 30,000 steps the published defaults are made for. The
//! file is long because all keys stand in one file, each with its default beside it.

use crate::error::{Error, Result};
pub use gazesplat_core::dataset::Holdout;
use gazesplat_render::RenderOptions;
use gazesplat_render::layout::ALPHA_MIN;
use serde::{Deserialize, Serialize};

/// All settings of a training run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Length, seed and reporting of the run.
    pub train: TrainSection,
    /// Which images, at which size.
    pub data: DataSection,
    /// Shape of the model.
    pub model: ModelSection,
    /// The first Gaussians.
    pub init: InitSection,
    /// Learning rates.
    pub optim: OptimSection,
    /// How the number of Gaussians changes.
    pub densify: DensifySection,
    /// Terms of the loss.
    pub loss: LossSection,
    /// Refinement of the camera poses, where `train.refine_poses` asks for it.
    pub poses: PosesSection,
    /// The renderer.
    pub render: RenderSection,
}

/// Length, seed and reporting of the run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainSection {
    /// Optimiser steps, one view each; at least 1. Default 30000.
    pub steps: u32,
    /// Seed of every random number of the run. Default 0.
    pub seed: u64,
    /// Worker threads; 0 = one per core. The result does not depend on it. Default 0.
    pub threads: usize,
    /// A step is reported to logs every this many steps, and after the last; at least 1. Default 10.
    pub log_every: u32,
    /// The test views are measured every this many steps, and after the last; 0 = only after the last. At most 1/6 of
    /// the run, unless measuring that often would take more than some 5 % of its time. Default 5000.
    pub eval_every: u32,
    /// A checkpoint is written every this many steps, and when the run is stopped; 0 = only then. Default 5000.
    pub checkpoint_every: u32,
    /// So many of the latest checkpoints stay while the run is under way; a run that finishes removes them. At least 1.
    /// Default 1.
    pub checkpoint_keep: u32,
    /// Corrects the poses of the training views along with the model, and writes them to `poses.json`. For captures whose
    /// poses are not exact: test views keep the ones they are given. Default false.
    pub refine_poses: bool,
    /// Train from coarse to fine: at first the sides of the images are halved so often, at most 8; 0 = images of full size
    /// from the beginning. Measurements are always of full size. Default 0.
    pub num_downscales: u32,
    /// Steps between two doublings of the image size, for a run of 30,000 steps; scaled with `train.steps`. Times
    /// `train.num_downscales` it is less than 30000, and the last step has full size in any run. Default 3000.
    pub resolution_schedule: u32,
}

impl Default for TrainSection {
    fn default() -> Self {
        Self {
            steps: 30_000,
            seed: 0,
            threads: 0,
            log_every: 10,
            eval_every: 5000,
            checkpoint_every: 5000,
            checkpoint_keep: 1,
            refine_poses: false,
            num_downscales: 0,
            resolution_schedule: 3000,
        }
    }
}

impl TrainSection {
    /// Steps between two measurements of `num_test` test views on the way; `None` = only after the last step.
    pub fn eval_interval(&self, num_test: usize) -> Option<u32> {
        // Measuring a view takes about half as long as a step: ten steps per view keep it at 5 % of the time.
        let least = u32::try_from(num_test).unwrap_or(u32::MAX).saturating_mul(10);
        let upper = (self.steps / 6).max(least).max(1);
        (self.eval_every > 0).then(|| self.eval_every.min(upper))
    }

    /// Whether step `step`, counted from 1, is logged or followed by a measurement of `num_test` test views.
    pub fn is_reported(&self, step: u32, num_test: usize) -> bool {
        let is_measured = self.eval_interval(num_test).is_some_and(|interval| step.is_multiple_of(interval));
        is_measured || crate::event::is_logged(step, self.steps, self.log_every)
    }
}

/// Which images, at which size.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DataSection {
    /// Longest image side in pixels; larger images are downscaled with an area filter. 0 = as they are. Default 1600.
    pub max_side: u32,
    /// Image directory beside `sparse`, as in `images_4`; unset = `images`.
    pub images: Option<String>,
    /// A `poses.json` of an earlier run: the views it names are seen by its poses instead of those of the scene; unset = none.
    pub poses: Option<String>,
    /// Every n-th view in name order, from the first, is a test view; 0 = all views train. Default 8 (3DGS).
    pub test_every: u32,
    /// Training views kept out of gradient steps, for a guard that judges the model later: `"none"`, or `"every8"`, those
    /// whose index among the training views in name order is 4 modulo 8. Default `"none"`.
    pub holdout: Holdout,
    /// Bytes of decoded images kept in memory. Default 4 GiB.
    pub cache_bytes: usize,
    /// What shows through transparent pixels of images and where no Gaussian is:
    /// `"black"`, `"white"`, `"random"` (a new colour each step) or `[r, g, b]` in 0..1. Default `"black"`.
    pub background: Background,
}

impl Default for DataSection {
    fn default() -> Self {
        Self {
            max_side: 1600,
            images: None,
            poses: None,
            test_every: 8,
            holdout: Holdout::None,
            cache_bytes: 4 << 30,
            background: Background::default(),
        }
    }
}

/// A named background or an RGB triple in 0..1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Background {
    /// One of the names.
    Named(NamedBackground),
    /// RGB in 0..1, sRGB-encoded.
    Rgb([f32; 3]),
}

/// Backgrounds with a name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NamedBackground {
    /// (0, 0, 0).
    Black,
    /// (1, 1, 1).
    White,
    /// A new uniformly random colour each training step; black in evaluation. Keeps transparent scenes from painting
    /// the background with Gaussians.
    Random,
}

impl Default for Background {
    fn default() -> Self {
        Self::Named(NamedBackground::Black)
    }
}

impl Background {
    /// The colour used in evaluation and, unless random, in training.
    pub fn fixed_rgb(&self) -> [f32; 3] {
        match self {
            Self::Named(NamedBackground::White) => [1.0; 3],
            Self::Named(NamedBackground::Black | NamedBackground::Random) => [0.0; 3],
            Self::Rgb(rgb) => *rgb,
        }
    }
}

/// Shape of the model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ModelSection {
    /// Degree of the spherical harmonics, 0 to 3. Default 3.
    pub sh_degree: u32,
    /// Train for antialiased rendering: opacities are lowered by what the least width of a splat adds to its area, so that the
    /// model looks alike at other resolutions and distances (Mip-Splatting, Yu 2024). Recorded in the model. Default false.
    pub antialiased: bool,
}

impl Default for ModelSection {
    fn default() -> Self {
        Self { sh_degree: 3, antialiased: false }
    }
}

/// The first Gaussians.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct InitSection {
    /// Initial opacity, in (0, 1). Default 0.1 (3DGS).
    pub opacity: f32,
    /// Initial scale as a multiple of the root mean square distance to the three nearest neighbours. Default 1 (3DGS).
    pub scale: f32,
    /// Number of random Gaussians when the scene has no points; never more than `densify.cap`. Default 50000.
    pub random_points: usize,
}

impl Default for InitSection {
    fn default() -> Self {
        Self { opacity: 0.1, scale: 1.0, random_points: 50_000 }
    }
}

/// Learning rates of Adam (β 0.9 and 0.999, ε 1e-15), per group; 3DGS, Sec. 7.1 and its code.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OptimSection {
    /// Rate of the means at the first step, in units of the scene extent. Default 1.6e-4.
    pub means_lr: f32,
    /// Rate of the means at the last step, reached log-linearly. Default 1.6e-6.
    pub means_lr_end: f32,
    /// Rate of the log scales. Default 5e-3.
    pub log_scales_lr: f32,
    /// Rate of the quaternions. Default 1e-3.
    pub quats_lr: f32,
    /// Rate of the opacity logits. Default 5e-2.
    pub opacity_lr: f32,
    /// Rate of the constant SH coefficient. Default 2.5e-3.
    pub sh_dc_lr: f32,
    /// The other SH coefficients learn this many times slower. Default 20.
    pub sh_rest_divisor: f32,
    /// Steps between two rises of the SH degree, for a run of 30,000 steps; scaled with `train.steps`. Default 1000.
    pub sh_degree_every: u32,
    /// Leave the SH coefficients of Gaussians that no view sees as they are until one does, and then do what they have
    /// missed in closed form: the result is that of `false` but for rounding, in less time and memory traffic where a view
    /// sees a part of the model only. From update 512 on. Default false.
    pub visible_only: bool,
}

impl Default for OptimSection {
    fn default() -> Self {
        Self {
            means_lr: 1.6e-4,
            means_lr_end: 1.6e-6,
            log_scales_lr: 5e-3,
            quats_lr: 1e-3,
            opacity_lr: 5e-2,
            sh_dc_lr: 2.5e-3,
            sh_rest_divisor: 20.0,
            sh_degree_every: 1000,
            visible_only: false,
        }
    }
}

/// How the number of Gaussians changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StrategyKind {
    /// Relocation, growth and position noise of Kheradmand 2024.
    Mcmc,
    /// Clone, split, prune and opacity reset of Kerbl 2023.
    Adc,
    /// The initial Gaussians are only optimised.
    None,
}

/// How the number of Gaussians changes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DensifySection {
    /// `"mcmc"`, `"adc"` or `"none"`. Default `"mcmc"`.
    pub strategy: StrategyKind,
    /// Largest number of Gaussians. Default 300000.
    pub cap: usize,
    /// First step at which Gaussians are relocated and added; at most 1/20 of the run. Default 500.
    pub start: u32,
    /// Share of the run after which the number stays as it is, in (0, 1]. Default 5/6, with `"adc"` 1/2.
    pub stop: Option<f32>,
    /// Steps between two refinements; at most 1/100 of the run, at least 5. Default 100.
    pub every: u32,
    /// Growth per refinement (`"mcmc"`). Where this would not reach `cap` by the middle of the run, as in short runs, it is
    /// raised to what does. Default 0.05.
    pub growth: f32,
    /// A Gaussian of at most this opacity is dead and moved to a live one (`"mcmc"`), below it is removed (`"adc"`).
    /// Default 0.005.
    pub min_opacity: f32,
    /// Position noise as a multiple of the rate of the means (MCMC, Eq. 8). Default 5e5.
    pub noise: f32,
    /// Weight of the mean opacity in the loss (MCMC, Eq. 10). Default 0.01.
    pub opacity_regularizer: f32,
    /// Weight of the mean scale in the loss (MCMC, Eq. 10). Default 0.01.
    pub scale_regularizer: f32,
    /// A Gaussian whose image-plane gradient, in half images and averaged over the steps that saw it, is above this is
    /// cloned or split (`"adc"`). Default 2e-4 (3DGS), with `absolute_gradients` 8e-4.
    pub grow_gradient: Option<f32>,
    /// Take the sums of the magnitudes of per-pixel gradients, which do not cancel within a large Gaussian (`"adc"`;
    /// Ye 2024). Default false.
    pub absolute_gradients: bool,
    /// A Gaussian that grows is cloned if its largest scale is at most this, in scene extents, else split (`"adc"`).
    /// Default 0.01 (3DGS).
    pub clone_scale: f32,
    /// A Gaussian with a larger scale, in scene extents, is removed once opacities have been lowered (`"adc"`). Default 0.1
    /// (3DGS).
    pub max_scale: f32,
    /// Steps between two lowerings of all opacities (`"adc"`); 0 = never. At most 1/10 of the run, but not below 300 for
    /// that. Default 3000 (3DGS).
    pub reset_every: u32,
    /// What opacities are lowered to (`"adc"`); above `min_opacity` and 1/255, below which nothing is drawn. Default 0.01
    /// (3DGS).
    pub reset_opacity: f32,
}

impl Default for DensifySection {
    fn default() -> Self {
        Self {
            strategy: StrategyKind::Mcmc,
            cap: 300_000,
            start: 500,
            stop: None,
            every: 100,
            growth: 0.05,
            min_opacity: 0.005,
            noise: 5e5,
            opacity_regularizer: 0.01,
            scale_regularizer: 0.01,
            grow_gradient: None,
            absolute_gradients: false,
            clone_scale: 0.01,
            max_scale: 0.1,
            reset_every: 3000,
            reset_opacity: 0.01,
        }
    }
}

/// Terms of the loss.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LossSection {
    /// λ of (1 − λ) L1 + λ (1 − SSIM), in 0..1. Default 0.2 (3DGS, Eq. 7).
    pub ssim_weight: f32,
}

impl Default for LossSection {
    fn default() -> Self {
        Self { ssim_weight: 0.2 }
    }
}

/// Refinement of the camera poses: Adam (β 0.9 and 0.999, ε 1e-15) on one rigid correction per training view.
///
/// The defaults lie between gsplat's (1e-5, `pose_opt_lr`) and what photographs need whose poses are off by some pixels: a view
/// comes a few hundred times in a run, and moves by at most the sum of the rates then.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PosesSection {
    /// Rate when poses begin to move: radians, and for the translation scene extents. Default 1e-4 (nerfstudio).
    pub lr: f32,
    /// Rate at the last step, reached log-linearly. Default 1e-6.
    pub lr_end: f32,
    /// First step at which poses move, in a run of 30,000 steps; scaled with `train.steps`. Before that the model is too coarse
    /// to tell where a camera is. Default 1000.
    pub start: u32,
}

impl Default for PosesSection {
    fn default() -> Self {
        Self { lr: 1e-4, lr_end: 1e-6, start: 1000 }
    }
}

/// The renderer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RenderSection {
    /// Gaussians nearer than this, in world units along the viewing axis, are not drawn. Default 0.01.
    pub near: f32,
    /// Largest opacity of one Gaussian at one pixel. Default 0.999.
    pub alpha_max: f32,
}

impl Default for RenderSection {
    fn default() -> Self {
        let options = RenderOptions::default();
        Self { near: options.near, alpha_max: options.alpha_max }
    }
}

impl Config {
    /// Options of the renderer in evaluation: all SH bands, fixed background.
    pub fn render_options(&self) -> RenderOptions {
        RenderOptions {
            near: self.render.near,
            alpha_max: self.render.alpha_max,
            antialiased: self.model.antialiased,
            background: self.data.background.fixed_rgb(),
            ..RenderOptions::default()
        }
    }

    /// Checks every range.
    ///
    /// # Errors
    /// [`Error::Parameter`] naming the first key that is out of its range.
    pub fn validate(&self) -> Result<()> {
        let check = |ok: bool, key: &str, found: &dyn std::fmt::Display, expected: &str| {
            if ok { Ok(()) } else { Err(Error::parameter(key, format!("found {found}, expected {expected}"))) }
        };
        let positive =
            |key: &str, value: f32| check(value > 0.0 && value.is_finite(), key, &value, "a positive number");
        let non_negative =
            |key: &str, value: f32| check(value >= 0.0 && value.is_finite(), key, &value, "a number of at least 0");
        let open_unit = |key: &str, value: f32| check(value > 0.0 && value < 1.0, key, &value, "a number in (0, 1)");
        check(self.train.steps >= 1, "train.steps", &self.train.steps, "at least 1")?;
        check(self.train.log_every >= 1, "train.log_every", &self.train.log_every, "at least 1")?;
        check(self.train.checkpoint_keep >= 1, "train.checkpoint_keep", &self.train.checkpoint_keep, "at least 1")?;
        let (halvings, every) = (self.train.num_downscales, self.train.resolution_schedule);
        check(halvings <= 8, "train.num_downscales", &halvings, "0 to 8")?;
        check(every >= 1, "train.resolution_schedule", &every, "at least 1")?;
        let coarse = u64::from(halvings) * u64::from(every);
        let expected = "less than 30000 steps, of 30000, before images have full size";
        check(coarse < 30_000, "train.num_downscales times train.resolution_schedule", &coarse, expected)?;
        if let Background::Rgb(rgb) = self.data.background {
            for value in rgb {
                check((0.0..=1.0).contains(&value), "data.background", &value, "three numbers in 0..1")?;
            }
        }
        check(self.model.sh_degree <= 3, "model.sh_degree", &self.model.sh_degree, "0, 1, 2 or 3")?;
        open_unit("init.opacity", self.init.opacity)?;
        positive("init.scale", self.init.scale)?;
        check(self.init.random_points >= 1, "init.random_points", &self.init.random_points, "at least 1")?;
        positive("optim.means_lr", self.optim.means_lr)?;
        positive("optim.means_lr_end", self.optim.means_lr_end)?;
        non_negative("optim.log_scales_lr", self.optim.log_scales_lr)?;
        non_negative("optim.quats_lr", self.optim.quats_lr)?;
        non_negative("optim.opacity_lr", self.optim.opacity_lr)?;
        non_negative("optim.sh_dc_lr", self.optim.sh_dc_lr)?;
        positive("optim.sh_rest_divisor", self.optim.sh_rest_divisor)?;
        check(self.densify.cap >= 1, "densify.cap", &self.densify.cap, "at least 1")?;
        check(self.densify.every >= 1, "densify.every", &self.densify.every, "at least 1")?;
        if let Some(stop) = self.densify.stop {
            check(stop > 0.0 && stop <= 1.0, "densify.stop", &stop, "a number in (0, 1]")?;
        }
        non_negative("densify.growth", self.densify.growth)?;
        open_unit("densify.min_opacity", self.densify.min_opacity)?;
        non_negative("densify.noise", self.densify.noise)?;
        non_negative("densify.opacity_regularizer", self.densify.opacity_regularizer)?;
        non_negative("densify.scale_regularizer", self.densify.scale_regularizer)?;
        for (key, rate) in [("poses.lr", self.poses.lr), ("poses.lr_end", self.poses.lr_end)] {
            // A turn by a radian per step is no refinement.
            check(rate > 0.0 && rate <= 1.0, key, &rate, "a number above 0 and at most 1")?;
        }
        if let Some(gradient) = self.densify.grow_gradient {
            positive("densify.grow_gradient", gradient)?;
        }
        positive("densify.clone_scale", self.densify.clone_scale)?;
        positive("densify.max_scale", self.densify.max_scale)?;
        let (lowered, least) = (self.densify.reset_opacity, self.densify.min_opacity.max(ALPHA_MIN));
        let expected = "a number below 1, above `densify.min_opacity` and above 1/255, where nothing is drawn";
        check(lowered > least && lowered < 1.0, "densify.reset_opacity", &lowered, expected)?;
        let ssim_weight = self.loss.ssim_weight;
        check((0.0..=1.0).contains(&ssim_weight), "loss.ssim_weight", &ssim_weight, "a number in 0..1")?;
        self.render_options().validate().map_err(|error| match error {
            gazesplat_render::Error::Parameter { name, found, expected } => {
                Error::parameter(format!("render.{name}"), format!("found {found}, expected {expected}"))
            }
            other => Error::Render(other),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid() {
        Config::default().validate().expect("the test sets this up");
    }

    #[test]
    fn what_the_renderer_refuses_is_refused_by_its_key() {
        for (near, alpha_max, key) in
            [(0.01, 0.99999, "render.alpha_max"), (0.01, 0.001, "render.alpha_max"), (-1.0, 0.99, "render.near")]
        {
            let mut config = Config::default();
            (config.render.near, config.render.alpha_max) = (near, alpha_max);
            let message = config.validate().expect_err("the test expects a refusal").to_string();
            assert!(message.starts_with(key), "{message}");
        }
    }

    #[test]
    fn short_runs_are_measured_on_the_way_but_not_all_the_time() {
        let section = |steps, eval_every| TrainSection { steps, eval_every, ..TrainSection::default() };
        assert_eq!(section(30_000, 5000).eval_interval(30), Some(5000));
        assert_eq!(section(3000, 5000).eval_interval(7), Some(500));
        assert_eq!(section(300, 5000).eval_interval(20), Some(200));
        assert_eq!(section(3000, 100).eval_interval(7), Some(100));
        assert_eq!(section(3000, 0).eval_interval(7), None);
    }

    #[test]
    fn coarse_sizes_that_never_end_are_refused() {
        let refused = |num_downscales, resolution_schedule| {
            let mut config = Config::default();
            config.train = TrainSection { num_downscales, resolution_schedule, ..config.train };
            config.validate().err().map(|error| error.to_string()).unwrap_or_default()
        };
        assert_eq!(refused(2, 3000), "");
        assert!(refused(9, 100).starts_with("train.num_downscales"));
        assert!(refused(1, 0).starts_with("train.resolution_schedule"));
        assert!(refused(3, 10_000).contains("found 30000"), "{}", refused(3, 10_000));
    }

    #[test]
    fn values_out_of_range_are_named() {
        let mut config = Config::default();
        config.densify.stop = Some(f32::NAN);
        let message = config.validate().expect_err("the test expects a refusal").to_string();
        assert!(message.starts_with("densify.stop") && message.contains("NaN"), "{message}");
        let refused = |change: fn(&mut DensifySection)| {
            let mut config = Config::default();
            change(&mut config.densify);
            config.validate().expect_err("the test expects a refusal").to_string()
        };
        for (message, key, found) in [
            (refused(|s| s.grow_gradient = Some(0.0)), "densify.grow_gradient", "0"),
            (refused(|s| s.clone_scale = -1.0), "densify.clone_scale", "-1"),
            (refused(|s| s.max_scale = f32::INFINITY), "densify.max_scale", "inf"),
            (refused(|s| s.reset_opacity = 0.0039), "densify.reset_opacity", "0.0039"),
            (refused(|s| s.min_opacity = 0.02), "densify.reset_opacity", "0.01"),
        ] {
            assert!(message.starts_with(key) && message.contains(&format!("found {found},")), "{message}");
        }
    }
}
