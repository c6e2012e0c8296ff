//! What a person sees while training runs: a bar on a terminal, a plain line every few seconds elsewhere.

use crate::console::{Console, duration, grouped};
use gazesplat_train::{Observer, StepReport, TrainEvent};
use indicatif::{ProgressBar, ProgressStyle};
use std::time::{Duration, Instant};

/// Time between plain lines: a log of an hour's run stays readable.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// The shown rate is that of windows of this length, so that it follows a model that grows.
const RATE_WINDOW: Duration = Duration::from_secs(2);

/// Weight of the latest window in the shown rate.
const RATE_WEIGHT: f64 = 0.3;

/// Weight of a new step in the shown loss: single views differ a lot, their mean over some fifty is readable.
const LOSS_WEIGHT: f32 = 0.02;

/// Shows the training events of one run.
#[derive(Debug)]
pub struct TrainProgress<'a> {
    console: &'a Console,
    bar: ProgressBar,
    num_steps: u32,
    first: u32,
    window_start: (Instant, u32),
    steps_per_sec: Option<f64>,
    last_line: Instant,
    /// Running mean of the loss and the step it was last fed at.
    loss: Option<(f32, u32)>,
}

impl<'a> TrainProgress<'a> {
    /// Progress over `num_steps` steps, on the console's standard error.
    pub fn new(console: &'a Console, num_steps: u32) -> Self {
        let bar = bar(console, u64::from(num_steps), "{bar:28} {pos}/{len} {msg}");
        let now = Instant::now();
        Self {
            console,
            bar,
            num_steps,
            first: 0,
            window_start: (now, 0),
            steps_per_sec: None,
            last_line: now,
            loss: None,
        }
    }

    /// Of a run that goes on after `first` steps.
    #[must_use]
    pub fn after(mut self, first: u32) -> Self {
        (self.first, self.window_start) = (first, (Instant::now(), first));
        self
    }

    /// Tells that `done` steps are done, `report` being of the last.
    pub fn step(&mut self, done: u32, report: &StepReport) {
        // A GPU reads the loss of some steps only: one stands for those since the last.
        if let Some(loss) = report.losses.as_ref().map(|losses| losses.total) {
            let (mean, fed) = self.loss.unwrap_or((loss, done));
            let weight = 1.0 - (1.0 - LOSS_WEIGHT).powf((done - fed.min(done)) as f32);
            self.loss = Some((mean + weight * (loss - mean), done));
        }
        self.measure_rate(done);
        if self.console.is_live() {
            self.bar.set_position(u64::from(done));
            self.bar.set_message(self.figures(report, done));
        } else if self.last_line.elapsed() >= LINE_EVERY {
            self.last_line = Instant::now();
            self.console.note(format_args!("step {done}/{} {}", self.num_steps, self.figures(report, done)));
        }
    }

    fn measure_rate(&mut self, done: u32) {
        let (started, first) = self.window_start;
        let elapsed = started.elapsed();
        if elapsed >= RATE_WINDOW {
            let rate = f64::from(done - first) / elapsed.as_secs_f64();
            self.steps_per_sec = Some(self.steps_per_sec.map_or(rate, |mean| mean + RATE_WEIGHT * (rate - mean)));
            self.window_start = (Instant::now(), done);
        }
    }

    fn figures(&self, report: &StepReport, done: u32) -> String {
        let (started, first) = self.window_start;
        let since = f64::from(done - first) / started.elapsed().as_secs_f64().max(1e-9);
        let rate = self.steps_per_sec.unwrap_or(since);
        let left = f64::from(self.num_steps.saturating_sub(done)) / rate.max(1e-9);
        format!(
            "loss {:.4}  {} Gaussians  {rate:.0} it/s  {} left",
            self.loss.map_or(f32::NAN, |(mean, _)| mean),
            grouped(report.num_gaussians),
            duration(left)
        )
    }
}

impl Observer for TrainProgress<'_> {
    fn on_event(&mut self, event: &TrainEvent<'_>) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
        match event {
            TrainEvent::Started { .. } => self.window_start = (Instant::now(), self.first),
            TrainEvent::Step(report) => self.step(report.step, report),
            TrainEvent::Evaluated { step, report } => {
                self.console.note(format_args!(
                    "step {step}: {:.2} dB PSNR, {:.3} SSIM on {} test views",
                    report.psnr,
                    report.ssim,
                    report.views.len()
                ));
            }
            TrainEvent::Resolution { step, num_halvings, size: [width, height] } => {
                let share =
                    if *num_halvings == 0 { "full".to_owned() } else { format!("1/{} of the", 1 << num_halvings) };
                self.console.note(format_args!(
                    "step {step}: images have {share} size from here on, {width} × {height} pixels"
                ));
            }
            TrainEvent::Message(text) => self.console.warn(text),
            TrainEvent::Finished { .. } => self.bar.finish_and_clear(),
            TrainEvent::LoadingImages { .. } | TrainEvent::Densified { .. } => {}
        }
        Ok(())
    }
}

impl Drop for TrainProgress<'_> {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}

/// A bar over `len` things on the console's standard error; hidden when that is no terminal.
pub fn bar(console: &Console, len: u64, template: &str) -> ProgressBar {
    if !console.is_live() {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template(template).expect("our templates are valid").progress_chars("━╸─");
    console.bars().add(ProgressBar::new(len).with_style(style))
}

/// A bar for `name`, counting to `len`.
pub fn counting_bar(console: &Console, name: &'static str, len: usize) -> ProgressBar {
    bar(console, len as u64, "{msg} {bar:28} {pos}/{len}").with_message(name)
}
