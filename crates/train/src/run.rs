//! The loop around the trainer: loading, steps, evaluation, events, the stop flag.

use crate::error::{Error, Result};
use crate::event::{Observer, TrainEvent};
use crate::trainer::Trainer;
use gazesplat_core::io::images::ImageCache;
use rayon::prelude::*;
use std::sync::atomic::{AtomicBool, Ordering};

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// All steps are done.
    Finished,
    /// The stop flag was set; the trainer holds the model of the last step.
    Stopped,
}

/// Images decoded between two looks at the stop flag.
const LOAD_BATCH: usize = 16;

/// Trains to the end of the budget, or until `stop` is set, and measures the test views as `train.eval_every` says and
/// after the last step. Continues where the trainer is, so a stopped run can be taken up again.
///
/// # Errors
/// As [`Trainer::step`]; the trainer then holds the last good model. [`Error::Observer`] when an observer fails.
pub fn run(trainer: &mut Trainer, observers: &mut [&mut dyn Observer], stop: &AtomicBool) -> Result<Outcome> {
    let num_steps = trainer.config().train.steps;
    for message in trainer.messages() {
        emit(observers, &TrainEvent::Message(message))?;
    }
    load_images(trainer.images(), observers, stop)?;
    let num_test = trainer.test_images().len();
    let eval_interval = trainer.config().train.eval_interval(num_test);
    emit(
        observers,
        &TrainEvent::Started {
            num_steps,
            num_gaussians: trainer.num_gaussians(),
            num_train: trainer.images().len(),
            num_test,
        },
    )?;
    while trainer.step_index() < num_steps {
        if stop.load(Ordering::Relaxed) {
            return Ok(Outcome::Stopped);
        }
        if let Some((num_halvings, size)) = trainer.resolution_change() {
            emit(observers, &TrainEvent::Resolution { step: trainer.step_index() + 1, num_halvings, size })?;
        }
        let report = trainer.step()?;
        emit(observers, &TrainEvent::Step(&report))?;
        if let Some(densified) = &report.densified {
            emit(observers, &TrainEvent::Densified { step: report.step, report: densified })?;
        }
        let is_due = eval_interval.is_some_and(|interval| report.step.is_multiple_of(interval));
        if num_test > 0 && (is_due || report.step == num_steps) {
            let evaluated = trainer.evaluate()?;
            emit(observers, &TrainEvent::Evaluated { step: report.step, report: &evaluated })?;
        }
    }
    let finished = TrainEvent::Finished { step: trainer.step_index(), num_gaussians: trainer.num_gaussians() };
    emit(observers, &finished)?;
    Ok(Outcome::Finished)
}

/// Runs `job` on `threads` worker threads of its own; 0 = one per core.
///
/// # Errors
/// [`Error::Threads`] when they cannot be started.
pub fn with_threads<R: Send>(threads: usize, job: impl FnOnce() -> R + Send) -> Result<R> {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|e| Error::Threads { threads, message: e.to_string() })?;
    Ok(pool.install(job))
}

/// Decodes what fits the cache before the first step, so that a missing photograph is found at once.
fn load_images(images: &ImageCache, observers: &mut [&mut dyn Observer], stop: &AtomicBool) -> Result<()> {
    let num_total = images.len();
    emit(observers, &TrainEvent::LoadingImages { num_done: 0, num_total })?;
    let mut held = 0;
    for first in (0..num_total).step_by(LOAD_BATCH) {
        if stop.load(Ordering::Relaxed) {
            return Ok(());
        }
        let last = (first + LOAD_BATCH).min(num_total);
        (first..last).into_par_iter().try_for_each(|index| images.get(index).map(drop))?;
        emit(observers, &TrainEvent::LoadingImages { num_done: last, num_total })?;
        if images.num_bytes() <= held {
            // The budget is full: more would only push out what is there.
            break;
        }
        held = images.num_bytes();
    }
    Ok(())
}

fn emit(observers: &mut [&mut dyn Observer], event: &TrainEvent<'_>) -> Result<()> {
    observers.iter_mut().try_for_each(|observer| observer.on_event(event)).map_err(Error::Observer)
}
