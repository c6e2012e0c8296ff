//! The training step: a view, its image, the loss, gradients, Adam, densification.
//!
//! Parameters live in one set of tensors. A step puts them on a fresh autodiff graph, and when the graph is gone moves
//! them to host vectors, updates them in place and moves them back: nothing of the model's size is copied. SH bands that
//! are not learned yet are not stored, so that a young model is a quarter of the size of a grown one.

use crate::config::{Background, Config, NamedBackground, StrategyKind};
use crate::densify::{Fixed, Mcmc, StepContext, Strategy};
use crate::error::{Error, Offender, Result};
use crate::evaluate::{EvalReport, evaluate};
use crate::event::{StageMs, StepReport};
use crate::init::{Initial, camera_center, initial_cloud, positive_extent};
use crate::losses::{L1Ssim, LossTarget, WeightedLosses};
use crate::optim::{Adam, AdamSettings, Columns, Group, LearningRates, Optimized, into_vec, schedule};
use crate::rng::{Stream, draw, permutation, uniform};
use burn::tensor::{Device, Tensor};
use gazesplat_core::dataset::Dataset;
use gazesplat_core::io::images::ImageCache;
use gazesplat_core::{Camera, GaussianCloud, sh};
use gazesplat_render::{Pass, RenderOptions, Splats, render};
use std::sync::Arc;
use std::time::Instant;

/// A model in training.
pub struct Trainer {
    config: Config,
    device: Device,
    images: Arc<ImageCache>,
    test_images: Arc<ImageCache>,
    /// `None` only while a step updates the parameters.
    splats: Option<Splats>,
    /// `None` only while a step updates the parameters.
    adam: Option<Adam>,
    strategy: Box<dyn Strategy>,
    /// Step at which the rows were last sorted.
    sorted_at: u32,
    losses: WeightedLosses,
    extent: f32,
    step: u32,
    view_order: Vec<usize>,
    messages: Vec<String>,
}

impl Trainer {
    /// A trainer at step 0. `images` holds the training views of `dataset`; those of the test views are cached apart.
    ///
    /// # Errors
    /// [`Error::Parameter`] for a setting out of its range, [`Error::NoTrainingViews`].
    pub fn new(dataset: &Dataset, images: Arc<ImageCache>, config: &Config, device: &Device) -> Result<Self> {
        config.validate()?;
        let Initial { cloud, messages } = initial_cloud(dataset, config)?;
        let mut trainer = Self::from_cloud(&cloud, dataset, images, config, device)?;
        trainer.messages = messages;
        Ok(trainer)
    }

    /// A trainer at step 0 that starts from an existing model, whose SH bands are all learned from the beginning.
    ///
    /// # Errors
    /// As [`Trainer::new`]; [`Error::Scene`] when the cloud's vectors differ in length.
    pub fn from_cloud(
        cloud: &GaussianCloud,
        dataset: &Dataset,
        images: Arc<ImageCache>,
        config: &Config,
        device: &Device,
    ) -> Result<Self> {
        config.validate()?;
        cloud.validate_shape()?;
        if images.is_empty() {
            return Err(Error::NoTrainingViews { num_test: dataset.test.len() });
        }
        let extent = positive_extent(dataset.scene_extent());
        let cameras: Vec<Camera> = images.views().iter().map(|v| v.camera).collect();
        let center = camera_center(&cameras).into();
        let strategy: Box<dyn Strategy> = match config.densify.strategy {
            StrategyKind::Mcmc => Box::new(Mcmc::new(&config.densify, config.train.steps, cloud.len(), center, extent)),
            StrategyKind::None => Box::new(Fixed),
        };
        let params = Columns::from_splats(Splats::from_cloud(cloud, device));
        let adam = Adam::new(&params, AdamSettings::default());
        let mut state = Optimized { params, adam };
        state.sort_spatially();
        let losses = WeightedLosses::default().with(1.0, Box::new(L1Ssim { ssim_weight: config.loss.ssim_weight }));
        Ok(Self {
            test_images: Arc::new(ImageCache::new(dataset.test.clone(), config.data.cache_bytes)),
            config: config.clone(),
            device: device.clone(),
            images,
            splats: Some(state.params.into_splats(device)),
            adam: Some(state.adam),
            strategy,
            sorted_at: 0,
            losses,
            extent,
            step: 0,
            view_order: Vec::new(),
            messages: Vec::new(),
        })
    }

    /// Adds `weight` times `loss` to what every step minimises.
    pub fn add_loss(&mut self, weight: f32, loss: Box<dyn crate::losses::ImageLoss>) {
        self.losses = std::mem::take(&mut self.losses).with(weight, loss);
    }

    /// The model as it is now.
    pub fn splats(&self) -> &Splats {
        self.splats.as_ref().expect("only a step in progress takes the model")
    }

    /// Steps done.
    pub fn step_index(&self) -> u32 {
        self.step
    }

    /// Settings of the run.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// The training images.
    pub fn images(&self) -> &Arc<ImageCache> {
        &self.images
    }

    /// The test images.
    pub fn test_images(&self) -> &Arc<ImageCache> {
        &self.test_images
    }

    /// What a person should know about how the run begins.
    pub fn messages(&self) -> &[String] {
        &self.messages
    }

    /// The model as it is exported: of the degree of the settings, Gaussians with a non-finite value left out.
    pub fn to_cloud(&self) -> GaussianCloud {
        let cloud = self.splats().to_cloud();
        let cloud = cloud.with_sh_degree(cloud.sh_degree.max(self.config.model.sh_degree));
        let valid: Vec<usize> = (0..cloud.len()).filter(|&i| cloud.is_row_valid(i)).collect();
        if valid.len() == cloud.len() { cloud } else { cloud.select(&valid) }
    }

    /// Quality on the test views.
    ///
    /// # Errors
    /// As [`evaluate`].
    pub fn evaluate(&self) -> Result<EvalReport> {
        evaluate(self.splats(), &self.test_images, &self.config.render_options(), &mut |_, _| {})
    }

    /// One step on the next view. Views come in a random order, each once before any comes again.
    ///
    /// # Errors
    /// [`Error::NonFiniteLoss`]; [`Error::Scene`] when the photograph cannot be read; [`Error::Render`]. The model is
    /// as it was before the step.
    pub fn step(&mut self) -> Result<StepReport> {
        let mut clock = Clock::start();
        let mut stage_ms = StageMs::default();
        let num_steps = self.config.train.steps;
        self.grow_sh();
        let view = self.view_at(self.step);
        let photo = self.images.get(view)?;
        let next = self.view_at(self.step + 1);
        self.images.prefetch(next);
        let background = self.background();
        let target = LossTarget::new(photo, background);
        stage_ms.image = clock.lap();

        let options = RenderOptions { background, pass: Pass::Train, ..self.config.render_options() };
        let leaves = tracked(self.splats());
        let rendered = render(&leaves, &self.images.views()[view].camera, &options)?;
        stage_ms.forward = clock.lap();

        let pending = self.losses.evaluate(rendered.image, &target).expect("a trainer has a loss");
        let report = pending.read()?;
        if !report.total.is_finite() {
            drop((pending, leaves));
            return Err(self.non_finite(view, report.total));
        }
        stage_ms.loss = clock.lap();

        let mut gradients = pending.loss.backward();
        let Splats { means, quats, log_scales, opacity_logits, sh } = leaves;
        let mut grads = Columns {
            data: [
                taken(means, &mut gradients),
                taken(quats, &mut gradients),
                taken(log_scales, &mut gradients),
                taken(opacity_logits, &mut gradients),
                taken(sh, &mut gradients),
            ],
            widths: [0; 5],
        };
        drop(gradients);
        stage_ms.backward = clock.lap();

        let params = Columns::from_splats(self.splats.take().expect("only a step in progress takes the model"));
        let adam = self.adam.take().expect("only a step in progress takes the optimiser");
        let mut state = Optimized { params, adam };
        grads.widths = state.params.widths;
        let mut terms = report.terms.clone();
        terms.extend(self.strategy.regularize(&state.params, &mut grads));
        let rates = LearningRates::at(&self.config.optim, self.step, num_steps, self.extent);
        state.adam.update(&mut state.params, &grads, &rates);
        drop(grads);
        stage_ms.optim = clock.lap();

        self.step += 1;
        let context = StepContext { step: self.step, seed: self.config.train.seed, means_lr: rates.means };
        let densified = self.strategy.after_update(&mut state, &context);
        if densified.is_some() && self.step >= self.sorted_at + SORT_INTERVAL {
            state.sort_spatially();
            self.sorted_at = self.step;
        }
        let num_gaussians = state.num_rows();
        let num_coefficients = state.params.widths[Group::Sh as usize] / 3;
        self.splats = Some(state.params.into_splats(&self.device));
        self.adam = Some(state.adam);
        stage_ms.densify = clock.lap();
        stage_ms.total = clock.total();
        Ok(StepReport {
            step: self.step,
            num_steps,
            loss: report.total,
            l1: report.get("l1").unwrap_or(f32::NAN),
            ssim: report.get("ssim").unwrap_or(f32::NAN),
            terms,
            num_gaussians,
            sh_degree: sh::degree_from_coefficients(num_coefficients).unwrap_or(0),
            stage_ms,
            view: self.images.views()[view].name.clone(),
            densified,
        })
    }

    /// Adds the SH bands that are due.
    fn grow_sh(&mut self) {
        let optim = &self.config.optim;
        let degree =
            schedule::sh_degree(self.step, self.config.train.steps, optim.sh_degree_every, self.config.model.sh_degree);
        let num_coefficients = sh::num_coefficients(degree);
        if num_coefficients <= self.splats().sh.dims()[1] {
            return;
        }
        let params = Columns::from_splats(self.splats.take().expect("only a step in progress takes the model"));
        let adam = self.adam.take().expect("only a step in progress takes the optimiser");
        let mut state = Optimized { params, adam };
        state.widen_sh(num_coefficients);
        self.splats = Some(state.params.into_splats(&self.device));
        self.adam = Some(state.adam);
    }

    /// The view of step `step`, counted from 0.
    fn view_at(&mut self, step: u32) -> usize {
        let num_views = self.images.len() as u32;
        let (epoch, position) = (step / num_views, (step % num_views) as usize);
        let seed = self.config.train.seed;
        if position == 0 && step != self.step {
            // A look ahead into the next epoch; the order of this one is still needed.
            return permutation(self.images.len(), seed, Stream::ViewOrder, epoch)[0];
        }
        if position == 0 || self.view_order.is_empty() {
            self.view_order = permutation(self.images.len(), seed, Stream::ViewOrder, epoch);
        }
        self.view_order[position]
    }

    fn background(&self) -> [f32; 3] {
        match self.config.data.background {
            Background::Named(NamedBackground::Random) => {
                let words = draw(self.config.train.seed, Stream::Background, self.step, 0);
                [uniform(words[0]), uniform(words[1]), uniform(words[2])]
            }
            fixed => fixed.fixed_rgb(),
        }
    }

    fn non_finite(&self, view: usize, loss: f32) -> Error {
        let suspect = Columns::from_splats(self.splats().clone()).most_suspect();
        Error::NonFiniteLoss {
            step: self.step + 1,
            view: self.images.views()[view].name.clone(),
            loss,
            offender: suspect.map(|(gaussian, group, value)| Offender { gaussian, parameter: group.name(), value }),
        }
    }
}

/// The parameters, shared, as leaves of a fresh graph.
fn tracked(splats: &Splats) -> Splats {
    Splats {
        means: splats.means.clone().autodiff(),
        quats: splats.quats.clone().autodiff(),
        log_scales: splats.log_scales.clone().autodiff(),
        opacity_logits: splats.opacity_logits.clone().autodiff(),
        sh: splats.sh.clone().autodiff(),
    }
    .require_grad()
}

/// The gradient of a leaf; empty when nothing reached it.
fn taken<const D: usize>(leaf: Tensor<D>, gradients: &mut burn::tensor::Gradients) -> Vec<f32> {
    leaf.grad_remove(gradients).map_or_else(Vec::new, into_vec)
}

/// Steps between two sortings of the rows. Densification puts new rows at the end and elsewhere in space; neighbours
/// in memory that are neighbours in the image halve the time of the backward pass, and one sorting costs about a step.
const SORT_INTERVAL: u32 = 200;

/// Milliseconds since the last lap and since the start.
struct Clock {
    start: Instant,
    last: Instant,
}

impl Clock {
    fn start() -> Self {
        let now = Instant::now();
        Self { start: now, last: now }
    }

    fn lap(&mut self) -> f32 {
        let now = Instant::now();
        let ms = (now - self.last).as_secs_f32() * 1e3;
        self.last = now;
        ms
    }

    fn total(&self) -> f32 {
        self.start.elapsed().as_secs_f32() * 1e3
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::StrategyKind;
    use gazesplat_core::synthetic::{SynthOptions, write_scene};

    #[test]
    fn a_step_updates_parameters_and_moments_where_they_are() {
        let dir = std::env::temp_dir().join(format!("gazesplat-train-in-place-{}", std::process::id()));
        let options = SynthOptions {
            num_views: 3,
            width: 60,
            height: 40,
            samples_per_side: 1,
            num_points: 500,
            ..SynthOptions::default()
        };
        let dataset = write_scene(&dir, &options).expect("the test sets this up");
        let mut config = Config::default();
        config.densify.strategy = StrategyKind::None;
        config.model.sh_degree = 0;
        let images = Arc::new(ImageCache::new(dataset.train.clone(), config.data.cache_bytes));
        let mut trainer =
            Trainer::new(&dataset, images, &config, &gazesplat_render::cpu_device()).expect("the test sets this up");
        let addresses = |trainer: &mut Trainer| {
            let params = Columns::from_splats(trainer.splats.take().expect("the test sets this up"));
            let adam = trainer.adam.as_ref().expect("the test sets this up");
            let found = [&params, &adam.first, &adam.second].map(|c| c.data.each_ref().map(|d| d.as_ptr() as usize));
            trainer.splats = Some(params.into_splats(&trainer.device));
            found
        };
        let before = addresses(&mut trainer);
        for _ in 0..3 {
            trainer.step().expect("the test sets this up");
        }
        assert_eq!(addresses(&mut trainer), before);
        std::fs::remove_dir_all(&dir).expect("the test sets this up");
    }
}
