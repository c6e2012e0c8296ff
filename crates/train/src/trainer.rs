//! The training step: a view, its image, the loss, gradients, Adam, densification.
//!
//! The model and its moments stay on their device. A step puts the parameters on a fresh autodiff graph, and when the
//! graph is gone updates them where they are: nothing of the model's size is copied. SH bands that are not learned yet
//! are not stored, so that a young model is a quarter of the size of a grown one.
//!
//! On a GPU a step only queues work, unless scales decay: the counters that takes are read back, and so are the counts of
//! the steps that add, move or remove Gaussians. The host reads the loss in the steps that are reported, and before it
//! measures or ends; a loss that is not finite stops the model on the device at once, and the run at the next such read.
//!
//! The file is long because the state of a run and the step over it are read together; checkpoints are in `resume`, what
//! strategies see in `watch`, what leaves in `export`.

use crate::backend::Status;
use crate::config::Config;
use crate::densify::{self, Bounds, Fixed, StepContext, Strategy, Watched};
use crate::error::{Error, Offender, Result};
use crate::evaluate::{EvalReport, evaluate};
use crate::event::{DensifyReport, StageMs, StepReport};
use crate::init::{Initial, camera_center, initial_cloud, positive_extent};
use crate::kernels::cpu::rows::Rows;
use crate::limits::check_limits;
use crate::losses::{L1Ssim, LossTarget, LossTerm, WeightedLosses, scale_decay};
use crate::optim::{AdamSettings, Columns, LearningRates, ModelState, Regularizers, ShRates, Snapshot, schedule};
use burn::tensor::{Device, Gradients, Tensor};
use gazesplat_core::dataset::Dataset;
use gazesplat_core::io::images::ImageCache;
use gazesplat_core::io::reduced_images::ReducedImages;
use gazesplat_core::{Camera, GaussianCloud, sh};
use gazesplat_render::{Pass, Probes, RenderOptions, Rendered, Splats, StatsMode, is_gpu, render_with};
use std::sync::Arc;

mod clock;
mod export;
mod poses;
mod resume;
mod views;
mod watch;

use clock::Clock;
pub use export::Exported;
use poses::Poses;
use watch::Watch;

/// γ of scale decay (RTGS Eq. 4).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ScaleDecay {
    /// γ.
    pub weight: f32,
    /// Unit of the scales, world units.
    pub scale_unit: f32,
}

/// A model in training.
pub struct Trainer {
    config: Config,
    images: Arc<ImageCache>,
    test_images: Arc<ImageCache>,
    state: ModelState,
    strategy: Box<dyn Strategy>,
    /// What densification did since step 0.
    totals: DensifyReport,
    /// Gaussians at step 0, of which the schedule of growth is a function.
    num_initial: usize,
    /// Step at which the rows were last sorted.
    sorted_at: u32,
    losses: WeightedLosses,
    scale_decay: Option<ScaleDecay>,
    /// Corrections of the poses, if they are refined.
    poses: Option<Poses>,
    center: [f32; 3],
    extent: f32,
    step: u32,
    /// The epoch whose order is held, and the order.
    view_order: Option<(u32, Vec<usize>)>,
    /// The photographs of a coarse beginning, and how often their sides are halved.
    coarse: Option<(u32, Arc<ReducedImages>)>,
    messages: Vec<String>,
}

impl Trainer {
    /// A trainer at step 0. `images` holds the training views of `dataset`; those of the test views share its budget.
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
        check_scene(dataset, &images, (cloud.len(), cloud.num_coefficients()), config, device)?;
        // Sorted before they are uploaded: the host's order follows the box around the means, however far they reach.
        let mut rows = Rows::new(Columns::from_cloud(cloud));
        rows.sort_spatially();
        let state = ModelState::new(rows.params, AdamSettings::default(), device)?;
        Ok(Self::around(state, cloud.len(), dataset, images, config))
    }

    /// A trainer at step 0 of a run that began with `num_initial` Gaussians.
    fn around(
        state: ModelState,
        num_initial: usize,
        dataset: &Dataset,
        images: Arc<ImageCache>,
        config: &Config,
    ) -> Self {
        let extent = positive_extent(dataset.scene_extent());
        let cameras: Vec<Camera> = images.views().iter().map(|v| v.camera).collect();
        let center: [f32; 3] = camera_center(&cameras).into();
        let bounds = Bounds::of_scene(center, extent);
        let strategy = densify::strategy(&config.densify, config.train.steps, num_initial, bounds, extent);
        let losses = WeightedLosses::default().with(1.0, Box::new(L1Ssim { ssim_weight: config.loss.ssim_weight }));
        let mut state = state;
        if config.optim.visible_only {
            let LearningRates { sh_dc: dc, sh_rest: rest, .. } = LearningRates::at(&config.optim, 0, 1, extent);
            state.let_unseen_lag(ShRates { dc, rest });
        }
        let mut trainer = Self {
            test_images: Arc::new(images.beside(dataset.test.clone())),
            config: config.clone(),
            images,
            state,
            strategy,
            totals: DensifyReport { num_gaussians: num_initial, ..DensifyReport::default() },
            num_initial,
            sorted_at: 0,
            losses,
            scale_decay: None,
            poses: None,
            center,
            extent,
            step: 0,
            view_order: None,
            coarse: None,
            messages: Vec::new(),
        };
        trainer.poses = Poses::of(&trainer);
        trainer
    }

    /// Adds `weight` times `loss` to what every step minimises.
    pub fn add_loss(&mut self, weight: f32, loss: Box<dyn crate::losses::ImageLoss>) {
        self.losses = std::mem::take(&mut self.losses).with(weight, loss);
    }

    /// Shrinks Gaussians in many tiles from now on, or no longer (RTGS Eq. 4).
    pub(crate) fn set_scale_decay(&mut self, decay: Option<ScaleDecay>) {
        self.scale_decay = decay;
    }

    /// Radius of the scene, world units.
    pub(crate) fn extent(&self) -> f32 {
        self.extent
    }

    /// The model with its optimiser, for operations between steps.
    pub(crate) fn state(&mut self) -> &mut ModelState {
        &mut self.state
    }

    /// Waits for all steps so far.
    ///
    /// # Errors
    /// [`Error::NonFiniteLoss`] of the first that failed.
    pub(crate) fn settle(&mut self) -> Result<()> {
        self.checked_status().map(drop)
    }

    /// A trainer at step 0 for `cloud` with a fresh optimiser, on the same views and with the same losses.
    ///
    /// # Errors
    /// As [`Trainer::from_cloud`].
    pub(crate) fn restarted(&mut self, cloud: &GaussianCloud, config: Config) -> Result<Self> {
        let mut rows = Rows::new(Columns::from_cloud(cloud));
        rows.sort_spatially();
        Ok(Self {
            config,
            images: Arc::clone(&self.images),
            test_images: Arc::clone(&self.test_images),
            state: ModelState::new(rows.params, AdamSettings::default(), self.state.device())?,
            strategy: Box::new(Fixed::untouched()),
            totals: DensifyReport { num_gaussians: cloud.len(), ..DensifyReport::default() },
            num_initial: cloud.len(),
            sorted_at: 0,
            losses: std::mem::take(&mut self.losses),
            scale_decay: None,
            poses: None,
            center: self.center,
            extent: self.extent,
            step: 0,
            view_order: None,
            coarse: None,
            messages: Vec::new(),
        })
    }

    /// This trainer, with every row left to its caller.
    pub(crate) fn keeping_rows(self) -> Self {
        Self { strategy: Box::new(Fixed::untouched()), ..self }
    }

    /// Goes on at step `step` with the model of `snapshot`.
    ///
    /// # Errors
    /// As [`ModelState::restore`].
    pub(crate) fn resume_at(&mut self, step: u32, snapshot: &Snapshot) -> Result<()> {
        self.state.restore(snapshot)?;
        (self.step, self.view_order) = (step, None);
        Ok(())
    }

    /// The model as it is now; later steps leave these tensors as they are.
    ///
    /// # Errors
    /// [`Error::Render`] when the device lacks the memory to bring rows that lag up to date.
    pub fn splats(&self) -> Result<Splats> {
        self.state.current()
    }

    /// Number of Gaussians N.
    pub fn num_gaussians(&self) -> usize {
        self.state.num_rows()
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

    /// Quality on the test views.
    ///
    /// # Errors
    /// As [`evaluate`]; on a GPU, [`Error::NonFiniteLoss`] of an earlier step.
    pub fn evaluate(&mut self) -> Result<EvalReport> {
        self.checked_status()?;
        evaluate(&self.state.current_lent()?, &self.test_images, &self.config.render_options(), &mut |_, _| {})
    }

    /// One step on the next view. Views come in a random order, each once before any comes again.
    ///
    /// # Errors
    /// [`Error::NonFiniteLoss`], on a GPU of this step or one since the last report; [`Error::Scene`] when the photograph
    /// cannot be read; [`Error::Render`]. The model is as it was before the step that failed.
    pub fn step(&mut self) -> Result<StepReport> {
        let mut clock = Clock::start();
        let mut stage_ms = StageMs::default();
        let num_steps = self.config.train.steps;
        self.grow_sh()?;
        let view = self.view_at(self.step);
        let (photo, camera) = self.photo(view)?;
        let (camera, pose) = self.camera_of(view, camera)?;
        let background = self.background();
        let target = LossTarget::new(photo, background);
        stage_ms.image = clock.lap();

        let stats = if self.scale_decay.is_some() { StatsMode::Tiles } else { StatsMode::None };
        let watched = self.strategy.watches(self.step + 1);
        let options = RenderOptions {
            background,
            pass: Pass::Train,
            stats,
            absolute_gradients: watched == Some(Watched::Absolute),
            ..self.config.render_options()
        };
        self.state.prepare(&camera, options.near)?;
        let leaves = tracked(&self.state.lent());
        let watch = watched.map(|_| Watch::new(&leaves));
        let probes = Probes { means: watch.as_ref().map(Watch::probe), pose: pose.as_ref() };
        let Rendered { image, splat_stats, visible, stats } = render_with(&leaves, probes, &camera, &options)?;
        stage_ms.forward = clock.lap();

        let pending = self.losses.evaluate(image, &target).expect("a trainer has a loss");
        stage_ms.loss = clock.lap();

        let gradients = pending.loss.backward();
        self.note_pose(view, pose, &gradients);
        let observation = watch.and_then(|watch| watch.observation(&gradients, visible, &stats, &camera));
        let mut gradients = taken(leaves, gradients);
        if let Some(ScaleDecay { weight, scale_unit }) = self.scale_decay {
            let log_scales = self.state.lent().log_scales;
            let used = &splat_stats.tiles_used;
            gradients.log_scales =
                scale_decay::add_gradient(log_scales, gradients.log_scales, used, weight, scale_unit);
        }
        stage_ms.backward = clock.lap();

        // On the CPU the values are there; a GPU is waited for only when somebody will see them.
        let is_read =
            !is_gpu(self.state.device()) || self.config.train.is_reported(self.step + 1, self.test_images.len());
        let rates = LearningRates::at(&self.config.optim, self.step, num_steps, self.extent);
        let regularizers = self.strategy.regularizers();
        self.state.update(gradients, pending.total(), rates, regularizers, is_read)?;
        self.step += 1;
        let losses = if is_read {
            let status = self.checked_status()?;
            let mut losses = pending.read()?;
            losses.terms.extend(regularizer_terms(regularizers, &status));
            Some(losses)
        } else {
            None
        };
        drop(pending);
        self.ease_poses()?;
        stage_ms.optim = clock.lap();

        if let Some(seen) = observation {
            self.strategy.observe(seen);
        }
        let context = StepContext { step: self.step, seed: self.config.train.seed, means_lr: rates.means };
        let densified = self.strategy.after_update(&mut self.state, &context)?;
        if densified.is_some() && self.step >= self.sorted_at + SORT_INTERVAL {
            self.state.sort_spatially(self.center, SORT_EXTENTS * self.extent)?;
            self.sorted_at = self.step;
        }
        if let Some(report) = &densified {
            self.totals.add(report);
        }
        stage_ms.densify = clock.lap();
        stage_ms.total = clock.total();
        Ok(StepReport {
            step: self.step,
            num_steps,
            losses,
            num_gaussians: self.state.num_rows(),
            sh_degree: sh::degree_from_coefficients(self.state.num_coefficients()).unwrap_or(0),
            stage_ms,
            view: self.images.views()[view].name.clone(),
            densified,
            totals: self.totals,
        })
    }

    /// The status of the model.
    ///
    /// # Errors
    /// [`Error::NonFiniteLoss`] of the step that closed it; the trainer is then where it was before that step.
    fn checked_status(&mut self) -> Result<Status> {
        let status = self.state.status()?;
        let Some((number, loss)) = status.failed else { return Ok(status) };
        // The model may have gone back to an earlier state: its updates are then fewer than the steps.
        let step = self.step + number - self.state.num_updates();
        self.step = step - 1;
        self.forget_poses_from(step - 1);
        self.state.reopen(number - 1);
        let view = self.view_at(step - 1);
        let suspect = Columns::from_splats(self.state.lent())?.most_suspect();
        Err(Error::NonFiniteLoss {
            step,
            view: self.images.views()[view].name.clone(),
            loss,
            offender: suspect.map(|(gaussian, group, value)| Offender { gaussian, parameter: group.name(), value }),
        })
    }

    /// Adds the SH bands that are due.
    fn grow_sh(&mut self) -> Result<()> {
        let optim = &self.config.optim;
        let degree =
            schedule::sh_degree(self.step, self.config.train.steps, optim.sh_degree_every, self.config.model.sh_degree);
        let num_coefficients = sh::num_coefficients(degree);
        match num_coefficients > self.state.num_coefficients() {
            true => self.state.widen_sh(num_coefficients),
            false => Ok(()),
        }
    }
}

/// Refuses a scene without views, and what the device cannot hold of `size`: Gaussians, and coefficients of each.
fn check_scene(
    dataset: &Dataset,
    images: &ImageCache,
    size: (usize, usize),
    config: &Config,
    device: &Device,
) -> Result<()> {
    if images.is_empty() {
        return Err(Error::NoTrainingViews { num_test: dataset.test.len() });
    }
    check_limits(size, images, config, device)
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

/// The gradients of the leaves; zero for one that nothing reached. The graph is gone afterwards.
fn taken(leaves: Splats, mut gradients: Gradients) -> Splats {
    fn of<const D: usize>(leaf: Tensor<D>, gradients: &mut Gradients) -> Tensor<D> {
        leaf.grad_remove(gradients).unwrap_or_else(|| leaf.inner().zeros_like())
    }
    Splats {
        means: of(leaves.means, &mut gradients),
        quats: of(leaves.quats, &mut gradients),
        log_scales: of(leaves.log_scales, &mut gradients),
        opacity_logits: of(leaves.opacity_logits, &mut gradients),
        sh: of(leaves.sh, &mut gradients),
    }
}

/// What the regularisers in use come to, unweighted.
fn regularizer_terms(weights: Regularizers, status: &Status) -> impl Iterator<Item = LossTerm> {
    let opacity = LossTerm { name: "opacity_regularizer", value: status.mean_opacity };
    let scale = LossTerm { name: "scale_regularizer", value: status.mean_scale };
    [(weights.opacity, opacity), (weights.scale, scale)].into_iter().filter(|(w, _)| *w > 0.0).map(|(_, term)| term)
}

/// Steps between two sortings of the rows. Densification puts new rows at the end and elsewhere in space; neighbours
/// in memory that are neighbours in the image halve the time of the backward pass, and one sorting costs about a step.
const SORT_INTERVAL: u32 = 200;
/// Half the cube a GPU sorts in, in scene extents: its cells are then a hundredth of an extent wide, about a tile's
/// reach, and what is farther is rarely near anything in the image.
const SORT_EXTENTS: f32 = 4.0;

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
        let addresses = |trainer: &mut Trainer| trainer.state.addresses();
        let before = addresses(&mut trainer);
        for _ in 0..3 {
            trainer.step().expect("the test sets this up");
        }
        assert_eq!(addresses(&mut trainer), before);
        std::fs::remove_dir_all(&dir).expect("the test sets this up");
    }
}
