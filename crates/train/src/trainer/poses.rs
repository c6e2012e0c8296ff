//! Corrections of camera poses in a run: which camera a step sees by, and when the host learns what it should become.
//!
//! A step leaves six numbers per view on its device. They matter when the view comes again, which is in the next epoch: so the
//! host reads them all at once, at the beginning of an epoch, or when there are many. A GPU is waited for once per epoch, and
//! nothing of the result depends on when.

use super::Trainer;
use crate::error::Result;
use crate::host::read;
use crate::poses::{PoseChange, PoseRefiner, ViewPose};
use burn::tensor::{Gradients, Tensor};
use gazesplat_core::{Camera, View};
use gazesplat_render::{PoseProbe, is_gpu};

/// Gradients that wait for the host at most: captures of thousands of views should not pile up buffers.
const MAX_WAITING: usize = 256;

/// The corrections of a run and the gradients that have not been read yet.
pub(super) struct Poses {
    refiner: PoseRefiner,
    waiting: Vec<Waiting>,
}

/// The gradient of a step, `[6]` on its device.
struct Waiting {
    step: u32,
    view: usize,
    gradient: Tensor<1>,
}

impl Poses {
    /// No correction yet of the views of a trainer, if its settings ask for any.
    pub fn of(trainer: &Trainer) -> Option<Self> {
        let config = &trainer.config;
        let cameras: Vec<Camera> = trainer.images.views().iter().map(|view| view.camera).collect();
        let refiner = || PoseRefiner::new(&cameras, &config.poses, config.train.steps, trainer.extent);
        config.train.refine_poses.then(|| Self { refiner: refiner(), waiting: Vec::new() })
    }
}

impl Trainer {
    /// The camera by which the next step sees `view`, `given` being the one of its photograph, and the probe that its
    /// gradient asks, once poses move.
    pub(super) fn camera_of(&mut self, view: usize, given: Camera) -> Result<(Camera, Option<PoseProbe>)> {
        if self.poses.is_none() {
            return Ok((given, None));
        }
        let begins_epoch = self.step.is_multiple_of(self.images.len() as u32);
        if begins_epoch {
            self.settle_poses()?;
        }
        let device = self.state.device().clone().autodiff();
        let Some(Poses { refiner, .. }) = &mut self.poses else { return Ok((given, None)) };
        if begins_epoch {
            refiner.fix_gauge();
        }
        let probe = refiner.is_moving(self.step).then(|| PoseProbe::new(&device));
        Ok((given.moved(refiner.poses()[view].twist), probe))
    }

    /// Keeps what the step on `view` found, before it is counted.
    pub(super) fn note_pose(&mut self, view: usize, probe: Option<PoseProbe>, gradients: &Gradients) {
        let gradient = probe.and_then(|probe| probe.gradient(gradients));
        if let (Some(poses), Some(gradient)) = (&mut self.poses, gradient) {
            poses.waiting.push(Waiting { step: self.step, view, gradient });
        }
    }

    /// Reads what waits, if that is much, or lies on the host anyway.
    pub(super) fn ease_poses(&mut self) -> Result<()> {
        let num_waiting = self.poses.as_ref().map_or(0, |poses| poses.waiting.len());
        let is_due = num_waiting >= MAX_WAITING || !is_gpu(self.state.device());
        if is_due { self.settle_poses() } else { Ok(()) }
    }

    /// Reads every gradient that waits and moves the views by them.
    ///
    /// # Errors
    /// As [`Trainer::settle`]: no pose moves by what followed a loss that is not finite.
    pub(super) fn settle_poses(&mut self) -> Result<()> {
        if self.poses.as_ref().is_none_or(|poses| poses.waiting.is_empty()) {
            return Ok(());
        }
        self.settle()?;
        let Some(Poses { refiner, waiting }) = &mut self.poses else { return Ok(()) };
        let values = read(Tensor::cat(waiting.iter().map(|entry| entry.gradient.clone()).collect(), 0))?;
        for (Waiting { step, view, .. }, gradient) in waiting.drain(..).zip(values.as_chunks::<6>().0) {
            refiner.update(view, step, *gradient);
        }
        Ok(())
    }

    /// Forgets what was found at `step`, counted from 0, and later.
    pub(super) fn forget_poses_from(&mut self, step: u32) {
        if let Some(poses) = &mut self.poses {
            poses.waiting.retain(|entry| entry.step < step);
        }
    }

    /// The corrections, for a checkpoint.
    pub(super) fn recorded_poses(&self) -> Option<Vec<ViewPose>> {
        self.poses.as_ref().map(|poses| poses.refiner.poses().to_vec())
    }

    /// Goes on with recorded corrections; `false` when they are of another run.
    pub(super) fn restore_poses(&mut self, recorded: Option<Vec<ViewPose>>) -> bool {
        match (&mut self.poses, recorded) {
            (Some(poses), Some(recorded)) => poses.refiner.restore(recorded),
            (None, None) => true,
            _ => false,
        }
    }

    /// The training views with the poses they have been refined to, and how far those are from the given ones; `None` when
    /// poses are not refined.
    ///
    /// # Errors
    /// As [`Trainer::evaluate`].
    pub fn refined_views(&mut self) -> Result<Option<(Vec<View>, PoseChange)>> {
        self.settle_poses()?;
        let Some(Poses { refiner, .. }) = &self.poses else { return Ok(None) };
        let views = self.images.views();
        let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
        let moved = |(view, pose): (&View, &ViewPose)| View { camera: view.camera.moved(pose.twist), ..view.clone() };
        Ok(Some((views.iter().zip(refiner.poses()).map(moved).collect(), refiner.change(&cameras))))
    }
}
