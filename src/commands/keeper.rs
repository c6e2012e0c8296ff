//! Trains and keeps what is left when a run is cut off: checkpoints, and of a device that can be lost a copy of the model,
//! on the host and on the disk.

use gazesplat_core::GaussianCloud;
use gazesplat_train::{Observer, Outcome, TrainEvent, Trainer};
use std::sync::atomic::{AtomicBool, Ordering};

use super::checkpoints::Checkpoints;
use super::device::ComputeDevice;
use crate::console::Console;
use crate::diagnostics::Result;
use crate::progress::TrainProgress;
use crate::run_dir::RunDir;

/// Copies in a run whose settings never measure the test views: as often as such a measurement is made at least.
const COPIES_PER_RUN: u32 = 6;

/// A model read back from the device.
#[derive(Debug)]
pub(crate) struct Kept {
    /// Steps done when it was read.
    pub step: u32,
    /// The model.
    pub cloud: GaussianCloud,
    /// Whether it is trained for antialiased rendering.
    pub antialiased: bool,
}

/// An observer whose files can be brought up to date between two steps.
pub(crate) trait Follower: Observer {
    /// Everything told so far is on the disk afterwards.
    ///
    /// # Errors
    /// When the disk refuses.
    fn catch_up(&mut self) -> Result<()> {
        Ok(())
    }
}

impl Follower for TrainProgress<'_> {}

/// What is kept of a run, and where.
#[derive(Clone, Copy)]
pub(crate) struct Keeper<'a> {
    /// Its directory.
    pub run_dir: &'a RunDir,
    /// Its checkpoints, if it can be resumed.
    pub checkpoints: Option<&'a Checkpoints>,
    /// Where failures to write are told: they end no run.
    pub console: &'a Console,
}

impl Keeper<'_> {
    /// Trains as [`gazesplat_train::run`] does, with checkpoints as `train.checkpoint_every` says and when it is stopped. On a
    /// GPU the model is also copied into `kept` and the `unfinished.ply` of the run whenever the test views have been
    /// measured, and panics become errors. Reading back changes nothing of the result. Who has saved the model removes the
    /// file.
    ///
    /// # Errors
    /// As [`gazesplat_train::run`]; `kept` then holds the last copy.
    pub fn run(
        &self,
        trainer: &mut Trainer,
        observers: &mut [&mut dyn Follower],
        stop: &AtomicBool,
        device: &ComputeDevice,
        kept: &mut Option<Kept>,
    ) -> Result<Outcome> {
        let copy_every = device.is_gpu().then(|| copy_interval(trainer));
        device.guard(|| self.in_legs(trainer, observers, stop, copy_every, kept))
    }

    /// A run in several legs, each ended by a pause in which the state is read back.
    fn in_legs(
        &self,
        trainer: &mut Trainer,
        observers: &mut [&mut dyn Follower],
        stop: &AtomicBool,
        copy_every: Option<u32>,
        kept: &mut Option<Kept>,
    ) -> Result<Outcome> {
        let every = Some(trainer.config().train.checkpoint_every);
        let checkpoint_every = every.filter(|&every| every > 0 && self.checkpoints.is_some());
        let pause = AtomicBool::new(false);
        let mut relay =
            Relay { observers, stop, pause: &pause, due: [copy_every, checkpoint_every], has_started: false };
        loop {
            let outcome = gazesplat_train::run(trainer, &mut [&mut relay], &pause)?;
            if outcome == Outcome::Finished {
                return Ok(outcome);
            }
            let step = trainer.step_index();
            let is_stopped = stop.load(Ordering::Relaxed);
            if is_stopped || is_due(checkpoint_every, step) {
                relay.observers.iter_mut().try_for_each(|observer| observer.catch_up())?;
                // A disk that is full now may not be at the end of the run.
                if let Some(checkpoints) = self.checkpoints
                    && let Err(failure) = checkpoints.save(trainer, &self.run_dir.metrics_path())
                {
                    self.console.warn(format_args!("no checkpoint of step {step}: {failure}"));
                }
            }
            if is_stopped {
                return Ok(outcome);
            }
            if is_due(copy_every, step) {
                let antialiased = trainer.config().model.antialiased;
                let copy = Kept { step, cloud: trainer.to_cloud()?, antialiased };
                // Drivers have been seen to end the process.
                if let Err(failure) = self.run_dir.write_unfinished(&copy.cloud, antialiased) {
                    tracing::error!("no copy of step {step}: {failure}");
                }
                *kept = Some(copy);
            }
            pause.store(false, Ordering::Relaxed);
        }
    }
}

/// Steps between two copies.
fn copy_interval(trainer: &Trainer) -> u32 {
    let config = &trainer.config().train;
    let num_test = trainer.test_images().len();
    let measured = config.eval_interval(num_test).filter(|_| num_test > 0);
    measured.unwrap_or((config.steps / COPIES_PER_RUN).max(1))
}

fn is_due(every: Option<u32>, step: u32) -> bool {
    every.is_some_and(|every| step.is_multiple_of(every))
}

/// Hands events on, so that the legs look like one run, and asks for a pause when something is due or the run is to stop.
struct Relay<'a, 'b> {
    observers: &'a mut [&'b mut dyn Follower],
    stop: &'a AtomicBool,
    pause: &'a AtomicBool,
    due: [Option<u32>; 2],
    has_started: bool,
}

impl Observer for Relay<'_, '_> {
    fn on_event(
        &mut self,
        event: &TrainEvent<'_>,
    ) -> std::result::Result<(), Box<dyn std::error::Error + Send + Sync>> {
        let is_opening =
            matches!(event, TrainEvent::Message(_) | TrainEvent::LoadingImages { .. } | TrainEvent::Started { .. });
        if !(is_opening && self.has_started) {
            self.observers.iter_mut().try_for_each(|observer| observer.on_event(event))?;
        }
        let is_due = match event {
            TrainEvent::Started { .. } => {
                self.has_started = true;
                false
            }
            // The measurement of this step comes before the loop looks at the flag.
            TrainEvent::Step(report) => self.due.iter().any(|&every| is_due(every, report.step)),
            _ => false,
        };
        if is_due || self.stop.load(Ordering::Relaxed) {
            self.pause.store(true, Ordering::Relaxed);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gazesplat_core::io::images::ImageCache;
    use gazesplat_core::io::ply;
    use gazesplat_core::synthetic::{SynthOptions, write_scene};
    use gazesplat_train::Config;
    use std::sync::Arc;

    /// Notes every event by name; fails at step `fails_at`, raises `stop` at step `stops_at`.
    #[derive(Default)]
    struct Script<'a> {
        told: Vec<String>,
        fails_at: Option<u32>,
        stops_at: Option<(u32, &'a AtomicBool)>,
    }

    impl Observer for Script<'_> {
        fn on_event(
            &mut self,
            event: &TrainEvent<'_>,
        ) -> std::result::Result<(), Box<dyn std::error::Error + Send + Sync>> {
            let TrainEvent::Step(report) = event else {
                self.told.push(format!("{event:?}").split([' ', '(']).next().unwrap_or_default().to_owned());
                return Ok(());
            };
            if let Some((step, stop)) = self.stops_at
                && step == report.step
            {
                stop.store(true, Ordering::Relaxed);
            }
            if self.fails_at == Some(report.step) { Err("the device is gone".into()) } else { Ok(()) }
        }
    }

    impl Follower for Script<'_> {}

    /// Trains with copies and without checkpoints, as on a GPU.
    fn in_legs(
        trainer: &mut Trainer,
        observers: &mut [&mut dyn Follower],
        stop: &AtomicBool,
        run_dir: &RunDir,
        kept: &mut Option<Kept>,
    ) -> Result<Outcome> {
        let copy_every = Some(copy_interval(trainer));
        let keeper = Keeper { run_dir, checkpoints: None, console: &Console::quiet() };
        keeper.in_legs(trainer, observers, stop, copy_every, kept)
    }

    fn trainer(dir: &std::path::Path, eval_every: u32) -> Trainer {
        let options = SynthOptions {
            num_views: 9,
            width: 48,
            height: 32,
            samples_per_side: 1,
            num_points: 200,
            ..SynthOptions::default()
        };
        let dataset = write_scene(dir, &options).expect("writable");
        let mut config = Config::default();
        config.train.steps = 30;
        config.train.eval_every = eval_every;
        config.densify.cap = 300;
        let images = Arc::new(ImageCache::new(dataset.train.clone(), config.data.cache_bytes));
        Trainer::new(&dataset, images, &config, &gazesplat_render::cpu_device()).expect("valid")
    }

    fn run_dir(dir: &std::path::Path) -> RunDir {
        RunDir::create(&dir.join("run"), false).expect("writable")
    }

    #[test]
    fn legs_look_like_one_run_and_give_its_model() {
        let dir = tempfile::tempdir().expect("temporary directory");
        let never = AtomicBool::new(false);
        let (mut whole, mut legs) = (Script::default(), Script::default());
        let mut reference = trainer(&dir.path().join("a"), 10);
        gazesplat_train::run(&mut reference, &mut [&mut whole], &never).expect("trains");
        let mut trainer = trainer(&dir.path().join("b"), 10);
        let mut kept = None;
        let outcome = in_legs(&mut trainer, &mut [&mut legs], &never, &run_dir(dir.path()), &mut kept).expect("trains");
        assert_eq!(outcome, Outcome::Finished);
        assert_eq!(legs.told, whole.told);
        assert_eq!(trainer.to_cloud().expect("readable"), reference.to_cloud().expect("readable"));
        assert!(kept.is_some());
    }

    #[test]
    fn run_that_fails_leaves_the_copy_of_the_last_measurement() {
        let dir = tempfile::tempdir().expect("temporary directory");
        for (eval_every, fails_at, copied_at) in [(20, 29, 20), (0, 29, 25)] {
            let mut trainer = trainer(dir.path(), eval_every);
            let mut script = Script { fails_at: Some(fails_at), ..Script::default() };
            let (run_dir, mut kept) = (run_dir(dir.path()), None);
            let failure = in_legs(&mut trainer, &mut [&mut script], &AtomicBool::new(false), &run_dir, &mut kept);
            assert_eq!(failure.expect_err("it fails").message(), "the device is gone");
            let kept = kept.expect("a copy");
            assert_eq!(kept.step, copied_at);
            assert!(!kept.cloud.is_empty());
            assert_eq!(ply::load(run_dir.unfinished_path()).expect("on the disk, too"), kept.cloud);
            run_dir.remove_unfinished().expect("writable");
            assert!(!run_dir.unfinished_path().exists());
        }
    }

    #[test]
    fn stop_ends_the_run_after_the_step() {
        let dir = tempfile::tempdir().expect("temporary directory");
        let stop = AtomicBool::new(false);
        let mut trainer = trainer(dir.path(), 20);
        let mut script = Script { stops_at: Some((7, &stop)), ..Script::default() };
        let outcome =
            in_legs(&mut trainer, &mut [&mut script], &stop, &run_dir(dir.path()), &mut None).expect("trains");
        assert_eq!((outcome, trainer.step_index()), (Outcome::Stopped, 7));
    }
}
