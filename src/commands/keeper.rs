//! Trains on a device that can be lost, and keeps a copy of the model on the host and on the disk: what is left when the
//! device is gone, or takes the whole process with it.

use gazesplat_core::GaussianCloud;
use gazesplat_train::{Observer, Outcome, TrainEvent, Trainer};
use std::sync::atomic::{AtomicBool, Ordering};

use super::device::ComputeDevice;
use crate::diagnostics::Result;
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
}

/// Trains as [`gazesplat_train::run`] does. On a GPU the model is copied into `kept` and the `unfinished.ply` of `run_dir`
/// whenever the test views have been measured, and panics become errors; reading back changes nothing of the result. Who
/// has saved the model removes the file.
///
/// # Errors
/// As [`gazesplat_train::run`]; `kept` then holds the last copy.
pub(crate) fn run(
    trainer: &mut Trainer,
    observers: &mut [&mut dyn Observer],
    stop: &AtomicBool,
    device: &ComputeDevice,
    run_dir: &RunDir,
    kept: &mut Option<Kept>,
) -> Result<Outcome> {
    if !device.is_gpu() {
        return Ok(gazesplat_train::run(trainer, observers, stop)?);
    }
    device.guard(|| in_legs(trainer, observers, stop, run_dir, kept))
}

/// A run in several legs, each ended by a pause in which the model is copied.
fn in_legs(
    trainer: &mut Trainer,
    observers: &mut [&mut dyn Observer],
    stop: &AtomicBool,
    run_dir: &RunDir,
    kept: &mut Option<Kept>,
) -> Result<Outcome> {
    let config = &trainer.config().train;
    let num_test = trainer.test_images().len();
    let measured = config.eval_interval(num_test).filter(|_| num_test > 0);
    let interval = measured.unwrap_or((config.steps / COPIES_PER_RUN).max(1));
    let pause = AtomicBool::new(false);
    let mut relay = Relay { observers, stop, pause: &pause, interval, has_started: false };
    loop {
        let outcome = gazesplat_train::run(trainer, &mut [&mut relay], &pause)?;
        if outcome == Outcome::Finished || stop.load(Ordering::Relaxed) {
            return Ok(outcome);
        }
        let copy = Kept { step: trainer.step_index(), cloud: trainer.to_cloud()? };
        // Drivers have been seen to end the process. A disk that is full today may not be at the end of the run.
        if let Err(failure) = run_dir.write_unfinished(&copy.cloud) {
            tracing::error!("no copy of step {}: {failure}", copy.step);
        }
        *kept = Some(copy);
        pause.store(false, Ordering::Relaxed);
    }
}

/// Hands events on, so that the legs look like one run, and asks for a pause when a copy is due or the run is to stop.
struct Relay<'a, 'b> {
    observers: &'a mut [&'b mut dyn Observer],
    stop: &'a AtomicBool,
    pause: &'a AtomicBool,
    interval: u32,
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
            TrainEvent::Step(report) => report.step.is_multiple_of(self.interval),
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
