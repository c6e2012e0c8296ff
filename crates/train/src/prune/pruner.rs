//! The loop (RTGS Fig. 6; spec/pruning.md, Sec. 6): train, check, remove, clamp, go back where the guard says so.
//!
//! One call of [`Pruner::advance`] is one step or one check, so that the caller owns progress, files and interruption. The
//! file is long because the order of these steps is the algorithm, and it is read as one.

use super::config::{Plan, PruneConfig, ScaleUnit};
use super::criterion::CriterionKind;
use super::decay::DecayControl;
use super::guard::{Basis, Reference, check_reference, measure};
use super::phase::{Noted, Origin, Passed, Phase, Record};
use super::report::{Check, Measured, Outcome, Part, Status};
use super::state::{kept, num_removed, rank, remove_faded};
use crate::checkpoint::{self, differences, fingerprint, fingerprint_of_cameras};
use crate::error::{Error, Result};
use crate::event::StepReport;
use crate::metrics::Guard;
use crate::optim::{HostState, Snapshot};
use crate::trainer::{ScaleDecay, Trainer};
use burn::tensor::Device;
use gazesplat_core::io::images::ImageCache;
use gazesplat_core::{Camera, Dataset, GaussianCloud};
use gazesplat_render::{RenderOptions, Splats};
use std::path::Path;
use std::sync::Arc;

/// What to prune, and on what.
#[derive(Debug)]
pub struct Job<'a> {
    /// The dense model.
    pub cloud: &'a GaussianCloud,
    /// The scene, for its extent.
    pub dataset: &'a Dataset,
    /// Views of gradient steps.
    pub images: Arc<ImageCache>,
    /// Views that judge.
    pub guard_images: Arc<ImageCache>,
    /// Names and cameras of all training views, those of the guard included: what a Gaussian earns is counted in them.
    pub counted: Vec<(String, Camera)>,
    /// Settings.
    pub config: &'a PruneConfig,
    /// Settings of what the caller adds to loss and guard: a run is resumed with the same only. `Null` = none.
    pub more_settings: &'a serde_json::Value,
    /// Where to compute.
    pub device: &'a Device,
}

/// What a call of [`Pruner::advance`] did.
#[derive(Debug)]
pub enum Progress {
    /// A training step.
    Step(Box<StepReport>),
    /// A check, and what followed from it.
    Check(Check),
    /// The run is over; [`Pruner::result`] has the model.
    Finished(Outcome),
}

/// Makes the guard of a run from the reference; the default holds PSNR and SSIM. For further metrics with bounds.
pub type GuardFactory = Box<dyn Fn(Reference, Basis) -> Guard + Send>;

/// A model that is being pruned.
pub struct Pruner {
    config: PruneConfig,
    more_settings: serde_json::Value,
    plan: Plan,
    trainer: Trainer,
    guard_images: Arc<ImageCache>,
    cameras: Vec<Camera>,
    options: RenderOptions,
    origin: Origin,
    decay: DecayControl,
    guard_factory: GuardFactory,
    guard: Guard,
    reference: Option<(Measured, Basis)>,
    phase: Phase,
    /// The latest state that passed, which is also the smallest; the dense model before the first.
    best: Option<(Snapshot, Passed)>,
}

/// Fewer Gaussians than this are not worth a run.
pub const MIN_DENSE_POINTS: usize = 100;
/// A reference below this measures noise, dB.
pub const POOR_REFERENCE_DB: f64 = 10.0;
/// Kind of run, as checkpoints name it.
const KIND: &str = "prune";
/// Settings that change nothing of the result.
const FREE: &[&str] = &["prune.threads"];

impl Pruner {
    /// A run at its beginning.
    ///
    /// # Errors
    /// [`Error::Parameter`] for a setting out of its range; [`Error::Prune`] for a model that is empty or too small, or a
    /// scene without views to train on or to judge by, or whose views use nothing of the model; as [`Trainer::from_cloud`].
    pub fn new(job: &Job<'_>) -> Result<Self> {
        job.config.validate()?;
        let cloud = job.cloud;
        cloud.validate_shape()?;
        if cloud.len() < MIN_DENSE_POINTS {
            return Err(Error::Prune(format!(
                "nothing to prune: the model has {} Gaussians, fewer than {MIN_DENSE_POINTS}",
                cloud.len()
            )));
        }
        if job.images.is_empty() || job.counted.is_empty() {
            return Err(Error::NoTrainingViews { num_test: job.dataset.test.len() });
        }
        if job.guard_images.is_empty() {
            return Err(Error::Prune("there is no view to judge the model by".to_owned()));
        }
        let is_counted = |name: &String| job.counted.iter().any(|(counted, _)| counted == name);
        if let Some(view) = job.images.views().iter().find(|view| !is_counted(&view.name)) {
            return Err(Error::Prune(format!(
                "view `{}` trains but is not among the {} views that are counted: what only it sees would have no worth",
                view.name,
                job.counted.len()
            )));
        }
        let plan = job.config.plan();
        let is_first_reference = plan.reference > 0;
        let steps = if is_first_reference { plan.reference } else { plan.num_steps() };
        let trainer = trainer(job, cloud, steps, is_first_reference)?;
        let names = |images: &ImageCache| images.views().iter().map(|v| v.name.clone()).collect();
        let origin = Origin {
            model: fingerprint(cloud),
            points: cloud.len(),
            views: [
                names(&job.images),
                job.counted.iter().map(|(name, _)| name.clone()).collect(),
                names(&job.guard_images),
            ],
            cameras: fingerprint_of_cameras(
                job.counted.iter().map(|(_, camera)| camera).chain(job.guard_images.views().iter().map(|v| &v.camera)),
            ),
        };
        let loss = job.config.guard.loss;
        let mut pruner = Self {
            config: job.config.clone(),
            more_settings: job.more_settings.clone(),
            plan,
            trainer,
            guard_images: Arc::clone(&job.guard_images),
            cameras: job.counted.iter().map(|(_, camera)| *camera).collect(),
            options: job.config.training(1, 0).render_options(),
            origin,
            decay: DecayControl::new(&job.config.scale_decay),
            guard_factory: Box::new(move |reference, basis| basis.guard(reference, loss)),
            guard: Guard::default(),
            reference: None,
            phase: Phase::Reference,
            best: None,
        };
        pruner.check_view_of_model()?;
        Ok(pruner)
    }

    /// Takes up the run that left the checkpoint at `path`. Also returns what its caller had noted.
    ///
    /// # Errors
    /// As [`Pruner::new`]; [`Error::Checkpoint`] when the file is damaged, or of another model, scene or settings, each
    /// difference named.
    pub fn resume(job: &Job<'_>, path: &Path) -> Result<(Self, Noted)> {
        let mut pruner = Self::new(job)?;
        let mut loaded: checkpoint::Loaded<Record> = checkpoint::load(path, KIND, &["state", "best"])?;
        let record = loaded.meta.clone();
        let refuse = |message: String| Error::Checkpoint { path: path.to_owned(), message };
        if record.origin != pruner.origin {
            let same_views = record.origin.views == pruner.origin.views;
            let what = match record.origin.model == pruner.origin.model {
                false => "of another model",
                true if same_views => "with other cameras",
                true => "on other views",
            };
            return Err(refuse(format!("it is of a run {what}")));
        }
        let mut found = differences(&record.config, job.config, FREE);
        found.extend(differences(&record.more_settings, job.more_settings, FREE));
        if !found.is_empty() {
            return Err(refuse(format!("its settings differ: {}", found.join(", "))));
        }
        let incomplete = || refuse("damaged: a model is missing".to_owned());
        let state: HostState = loaded.take("state").ok_or_else(incomplete)?;
        let is_begun = !matches!(record.phase, Phase::Reference);
        if is_begun && (record.reference.is_none() || record.best.is_none()) {
            return Err(refuse("damaged: the reference is missing".to_owned()));
        }
        let state = Snapshot::from_host(state, job.device)?;
        if is_begun && pruner.plan.reference > 0 {
            pruner.trainer = trainer(job, job.cloud, pruner.plan.num_steps(), false)?;
        }
        pruner.trainer.resume_at(record.step, &state)?;
        pruner.best = match record.best {
            Some(passed) => {
                let best = loaded.take("best").ok_or_else(incomplete)?;
                Some((Snapshot::from_host(best, job.device)?, passed.exact()))
            }
            None => None,
        };
        pruner.phase = record.phase;
        pruner.decay.exponent = record.decay_exponent;
        if let Some((measured, basis)) = record.reference {
            pruner.hold(measured.exact(), basis);
        }
        Ok((pruner, record.noted))
    }

    /// Writes everything the run needs to go on, and what the caller wants to find again.
    ///
    /// # Errors
    /// When the device does not answer or the file cannot be written; one that was there before is then still there.
    pub fn save(&mut self, path: &Path, noted: Noted) -> Result<()> {
        self.trainer.settle()?;
        let record = Record {
            config: self.config.clone(),
            more_settings: self.more_settings.clone(),
            origin: self.origin.clone(),
            phase: self.phase,
            step: self.trainer.step_index(),
            decay_exponent: self.decay.exponent,
            reference: self.reference.map(|(measured, basis)| (measured.into(), basis)),
            best: self.best.as_ref().map(|(_, passed)| (*passed).into()),
            noted,
        };
        let state = self.trainer.state().snapshot()?.to_host()?;
        let best = self.best.as_ref().map(|(snapshot, _)| snapshot.to_host()).transpose()?;
        let mut states = vec![("state", &state)];
        states.extend(best.as_ref().map(|best| ("best", best)));
        checkpoint::save(path, KIND, &record, &states)
    }

    /// Replaces what makes the guard of the reference.
    pub fn with_guard(mut self, factory: GuardFactory) -> Self {
        self.guard_factory = factory;
        if let Some((measured, basis)) = self.reference {
            self.hold(measured, basis);
        }
        self
    }

    /// Adds `weight` times `loss` to what every step minimises.
    pub fn add_loss(&mut self, weight: f32, loss: Box<dyn crate::losses::ImageLoss>) {
        self.trainer.add_loss(weight, loss);
    }

    /// Fingerprint of the dense model.
    pub fn model_fingerprint(&self) -> &str {
        &self.origin.model
    }

    /// The schedule.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Gaussians of the model as it is now.
    pub fn num_points(&self) -> usize {
        self.trainer.num_gaussians()
    }

    /// Steps done since the reference; before it, 0.
    pub fn iteration(&self) -> u32 {
        if self.phase == Phase::Reference { 0 } else { self.trainer.step_index() }
    }

    /// The reference and what the bounds are relative to, once measured.
    pub fn reference(&self) -> Option<(Measured, Basis)> {
        self.reference
    }

    /// The model as it is now.
    ///
    /// # Errors
    /// When the device does not answer.
    pub fn to_cloud(&self) -> Result<GaussianCloud> {
        self.trainer.to_cloud()
    }

    /// The model to deliver: the best so far.
    ///
    /// # Errors
    /// When the device does not answer.
    pub fn result(&self) -> Result<GaussianCloud> {
        match &self.best {
            Some((snapshot, _)) => Ok(self.trainer.exported(&snapshot.splats()?)?.cloud),
            None => self.trainer.to_cloud(),
        }
    }

    /// One step or one check.
    ///
    /// # Errors
    /// As [`Trainer::step`]; the model is then that before the step. A check that fails half-way may leave a model cut short;
    /// the best state and the last checkpoint are as they were. [`Error::Prune`] when the reference is no number, or misses
    /// the guard itself.
    pub fn advance(&mut self) -> Result<Progress> {
        match self.phase {
            Phase::Reference if self.trainer.step_index() < self.plan.reference => self.step(),
            Phase::Reference => self.begin(),
            Phase::Prune { due: true } => self.event(),
            Phase::Prune { .. } if self.iteration() < self.plan.prune => {
                let step = self.step()?;
                self.phase = Phase::Prune { due: self.plan.is_event(self.iteration()) };
                Ok(step)
            }
            Phase::Prune { .. } => self.final_check(),
            Phase::Final { round } => self.final_round(round),
            Phase::Adapt { due: true } => self.adapt_check(),
            Phase::Adapt { .. } if self.iteration() < self.plan.num_steps() => {
                let step = self.step()?;
                let done = self.iteration() - self.plan.prune;
                let due = done == self.plan.adapt || done.is_multiple_of(self.plan.event_every);
                self.phase = Phase::Adapt { due };
                Ok(step)
            }
            Phase::Adapt { .. } | Phase::Done => self.finish(),
        }
    }

    /// Where the loop stands, for tests.
    #[cfg(test)]
    pub(super) fn phase(&self) -> Phase {
        self.phase
    }

    /// The model with its optimiser, for tests.
    #[cfg(test)]
    pub(super) fn model(&mut self) -> &mut crate::optim::ModelState {
        self.trainer.state()
    }

    /// The trainer, for tests.
    #[cfg(test)]
    pub(super) fn trainer(&mut self) -> &mut Trainer {
        &mut self.trainer
    }

    fn step(&mut self) -> Result<Progress> {
        let gamma = if matches!(self.phase, Phase::Prune { .. }) { self.decay.gamma() } else { 0.0 };
        let scale_unit = self.scale_unit();
        self.trainer.set_scale_decay((gamma > 0.0).then_some(ScaleDecay { weight: gamma, scale_unit }));
        Ok(Progress::Step(Box::new(self.trainer.step()?)))
    }

    /// World units of a scale that scale decay takes as 1.
    fn scale_unit(&self) -> f32 {
        match self.config.scale_decay.unit {
            ScaleUnit::World => 1.0,
            ScaleUnit::Extent => self.trainer.extent(),
        }
    }

    /// Measures the reference, and the loop begins with a fresh optimiser.
    fn begin(&mut self) -> Result<Progress> {
        if self.plan.reference > 0 {
            let cloud = self.trainer.to_cloud()?;
            self.trainer =
                self.trainer.restarted(&cloud, self.config.training(self.plan.num_steps(), cloud.sh_degree))?;
        }
        let measured = self.measure()?;
        if measured.pairs_per_tile == 0.0 {
            return Err(Error::Prune(format!(
                "none of the {} views that judge sees anything of the model: it belongs to another scene",
                self.guard_images.len()
            )));
        }
        let reference = check_reference(&measured)?;
        let basis = Basis::for_reference(reference.psnr);
        self.hold(measured, basis);
        // Shares hold for the reference by definition; floors and further metrics need not.
        let measured = self.measure()?;
        if !measured.passed {
            let bounds: Vec<String> = self.guard.bounds().map(|(name, bound)| format!("{name} {bound}")).collect();
            return Err(Error::Prune(format!(
                "the model misses the guard before anything is removed: it has {:.2} dB and an SSIM of {:.4}, asked for are {}",
                reference.psnr,
                reference.ssim,
                bounds.join(", ")
            )));
        }
        self.best = Some((self.trainer.state().snapshot()?, Passed { measured, is_real: false }));
        self.phase = Phase::Prune { due: false };
        Ok(Progress::Check(Check::new(Part::Reference, 0, measured, reference, self.decay.gamma())))
    }

    fn hold(&mut self, measured: Measured, basis: Basis) {
        let reference = Reference { psnr: measured.psnr, ssim: measured.ssim };
        self.guard = (self.guard_factory)(reference, basis);
        self.reference = Some((measured, basis));
    }

    fn measure(&mut self) -> Result<Measured> {
        self.trainer.settle()?;
        let scale_unit = self.scale_unit();
        let splats = self.trainer.state().lent();
        measure(&splats, &self.guard_images, &self.options, &self.guard, scale_unit)
    }

    /// The record of a check of the model as it is.
    fn check(&mut self, part: Part) -> Result<Check> {
        let measured = self.measure()?;
        let (reference, _) = self.reference.expect("nothing is checked before the reference");
        let reference = Reference { psnr: reference.psnr, ssim: reference.ssim };
        // Scales decay while Gaussians are removed, and not afterwards.
        let gamma = if part == Part::Prune { self.decay.gamma() } else { 0.0 };
        Ok(Check::new(part, self.iteration(), measured, reference, gamma))
    }

    /// One event: if the guard passes, keep the state and remove; else train on with a smaller γ.
    fn event(&mut self) -> Result<Progress> {
        let section = self.config.prune.clone();
        let faded = remove_faded(self.trainer.state(), section.min_opacity, section.min_points)?;
        let mut check = self.check(Part::Prune)?;
        check.faded = faded;
        if check.accepted {
            // Before the removal; the latest passing state is also the smallest.
            self.keep_best(check.measured)?;
            for _ in 0..section.rounds {
                let (removed, unseen) = self.remove_round()?;
                check.removed += removed;
                check.unseen = unseen;
            }
        }
        if self.config.scale_decay.start > 0.0 {
            self.decay.after_event(check.accepted);
        }
        if check.accepted && section.rounds > 0 {
            self.clamp()?;
        }
        check.gamma = self.decay.gamma();
        self.phase = Phase::Prune { due: false };
        Ok(Progress::Check(check))
    }

    /// The check before the final rounds: what fails it goes back to the best state.
    fn final_check(&mut self) -> Result<Progress> {
        let mut check = self.check(Part::Final)?;
        if check.accepted {
            self.keep_best(check.measured)?;
        } else {
            self.restore_best()?;
            check.rolled_back = true;
        }
        self.phase = Phase::Final { round: 1 };
        if self.config.prune.rounds == 0 {
            check.faded = self.end_final()?;
        }
        Ok(Progress::Check(check))
    }

    /// One final round: remove, check, go back if that was too much.
    fn final_round(&mut self, round: u32) -> Result<Progress> {
        let before = self.trainer.state().snapshot()?;
        let (removed, unseen) = self.remove_round()?;
        let mut check = self.check(Part::Final)?;
        (check.removed, check.unseen) = (removed, unseen);
        if check.accepted {
            self.keep_best(check.measured)?;
            self.phase = Phase::Final { round: round + 1 };
        } else {
            self.trainer.state().restore(&before)?;
            check.rolled_back = true;
        }
        if !check.accepted || round >= self.config.prune.rounds || removed == 0 {
            check.faded = self.end_final()?;
        }
        Ok(Progress::Check(check))
    }

    /// In every case: what has faded goes, opacities are clamped if asked for, and adaptation begins. Returns the number of
    /// Gaussians gone.
    fn end_final(&mut self) -> Result<usize> {
        let section = self.config.prune.clone();
        let faded = remove_faded(self.trainer.state(), section.min_opacity, section.min_points)?;
        if section.final_clamp {
            self.clamp()?;
        }
        self.phase = Phase::Adapt { due: false };
        Ok(faded)
    }

    /// A check of the adaptation: of the states that pass, the one with the fewest Gaussians, then the highest PSNR, stays.
    fn adapt_check(&mut self) -> Result<Progress> {
        let check = self.check(Part::Adapt)?;
        let best = self.best.as_ref().map(|(_, passed)| *passed).filter(|passed| passed.is_real);
        let is_better = best.is_none_or(|best| {
            let (found, best) = (&check.measured, &best.measured);
            found.points < best.points || (found.points == best.points && found.psnr > best.psnr)
        });
        if check.accepted && is_better {
            self.keep_best(check.measured)?;
        }
        self.phase = Phase::Adapt { due: false };
        Ok(Progress::Check(check))
    }

    fn finish(&mut self) -> Result<Progress> {
        if self.phase != Phase::Done {
            self.restore_best()?;
            self.phase = Phase::Done;
        }
        let (_, passed) = self.best.as_ref().expect("the reference has been measured");
        let status = if passed.is_real { Status::Ok } else { Status::NoPass };
        Ok(Progress::Finished(Outcome { status, points_dense: self.origin.points, measured: passed.measured }))
    }

    fn keep_best(&mut self, measured: Measured) -> Result<()> {
        self.best = Some((self.trainer.state().snapshot()?, Passed { measured, is_real: true }));
        Ok(())
    }

    fn restore_best(&mut self) -> Result<()> {
        let (snapshot, _) = self.best.as_ref().expect("the reference has been measured");
        self.trainer.state().restore(snapshot)
    }

    /// One round of removal. Returns the Gaussians removed, and those that no view used.
    fn remove_round(&mut self) -> Result<(usize, usize)> {
        let section = &self.config.prune;
        let num_rows = self.trainer.num_gaussians();
        let num = num_removed(num_rows, section.share, section.min_points);
        if num == 0 {
            return Ok((0, 0));
        }
        let splats = self.trainer.state().lent();
        let ranked = rank(section.criterion, &splats, &self.cameras, &self.options)?;
        drop(splats);
        self.trainer.state().select_rows(kept(num_rows, &ranked.order[..num]))?;
        Ok((num, ranked.num_unseen))
    }

    fn clamp(&mut self) -> Result<()> {
        match self.plan.opacity_clamp {
            clamp if clamp < 1.0 => self.trainer.state().clamp_opacities(clamp),
            _ => Ok(()),
        }
    }

    /// Refuses a scene whose cameras see nothing of the model: everything would be removed.
    fn check_view_of_model(&mut self) -> Result<()> {
        let splats = self.trainer.state().lent();
        for camera in &self.cameras {
            if gazesplat_render::count(&splats, camera, &self.options)?.stats.num_pairs > 0 {
                return Ok(());
            }
        }
        Err(Error::Prune(format!(
            "none of the {} training views sees anything of the model: it belongs to another scene",
            self.cameras.len()
        )))
    }
}

/// A trainer for `steps` steps; those before the reference keep the rate of the means at its last value.
fn trainer(job: &Job<'_>, cloud: &GaussianCloud, steps: u32, is_reference: bool) -> Result<Trainer> {
    let mut config = job.config.training(steps, cloud.sh_degree);
    if is_reference {
        config.optim.means_lr = config.optim.means_lr_end;
    }
    Ok(Trainer::from_cloud(cloud, job.dataset, Arc::clone(&job.images), &config, job.device)?.keeping_rows())
}

/// Rows of `splats` that stay when the share `keep` of them is kept in one shot, ascending: how criteria are compared.
///
/// # Errors
/// When the renderer refuses, or the device does not answer.
pub fn one_shot(
    kind: CriterionKind,
    splats: &Splats,
    cameras: &[Camera],
    options: &RenderOptions,
    keep: &[f64],
) -> Result<Vec<Vec<u32>>> {
    let ranked = rank(kind, splats, cameras, options)?;
    let num_rows = splats.len();
    let rows = |share: &f64| {
        let num = ((share * num_rows as f64).round() as usize).clamp(1, num_rows.max(1));
        kept(num_rows, &ranked.order[..num_rows.saturating_sub(num)])
    };
    Ok(keep.iter().map(rows).collect())
}
