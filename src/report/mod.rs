//! The report of a run: one HTML file with everything in it, no network, light and dark.
//!
//! [`Report`] is what there is to show, gathered while a run goes on; [`html`] lays it out, [`plots`] draws the curves,
//! [`pictures`] turns images into something a page can hold.

pub mod html;
pub mod pictures;
pub mod plots;
pub mod study;

use gazesplat_core::RgbImage8;

/// Which views the quality was measured on.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Measured {
    /// Views kept from training.
    #[default]
    Test,
    /// The very views the model was trained on, for want of others.
    Training,
}

impl Measured {
    /// `test` or `training`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Test => "test",
            Self::Training => "training",
        }
    }
}

/// Everything a report shows. Empty parts are left out of the page.
#[derive(Debug, Clone, Default)]
pub struct Report {
    /// Which views `test_psnr`, `views` and `scores` are about.
    pub measured: Measured,
    /// Name of the scene.
    pub title: String,
    /// One sentence under the title.
    pub subtitle: String,
    /// The figures to see first: value with unit, and what it is.
    pub headline: Vec<Figure>,
    /// Logged steps, in order.
    pub steps: Vec<StepPoint>,
    /// PSNR of the measured views over the run, (step, dB).
    pub test_psnr: Vec<(u32, f64)>,
    /// Mean milliseconds of a training step; 0 without one.
    pub step_ms: f64,
    /// The same by stage, in the order of execution; empty where stages cannot be told apart, on a GPU.
    pub stages: Vec<(String, f64)>,
    /// Some of the measured views with their renders.
    pub views: Vec<ViewPanel>,
    /// Every measured view: name, PSNR in dB, SSIM.
    pub scores: Vec<(String, f64, f64)>,
    /// Frames of a camera path through the model, to play.
    pub film: Vec<RgbImage8>,
    /// What is known about the scene and the model, name and value.
    pub facts: Vec<(String, String)>,
    /// How long each part took, name and seconds.
    pub durations: Vec<(String, f64)>,
    /// What went unusually, as told on standard error.
    pub warnings: Vec<String>,
    /// The resolved settings, TOML.
    pub settings: String,
}

/// One large figure on top of the page.
#[derive(Debug, Clone)]
pub struct Figure {
    /// The number, formatted.
    pub value: String,
    /// Unit, may be empty.
    pub unit: String,
    /// What it is.
    pub label: String,
}

impl Figure {
    /// A figure from its three texts.
    pub fn new(value: impl Into<String>, unit: &str, label: &str) -> Self {
        Self { value: value.into(), unit: unit.to_owned(), label: label.to_owned() }
    }
}

/// One logged training step.
#[derive(Debug, Clone, Copy)]
pub struct StepPoint {
    /// Step index.
    pub step: u32,
    /// Total loss of its view.
    pub loss: f32,
    /// Gaussians after it.
    pub num_gaussians: usize,
}

/// A measured view: the photograph, what the model makes of it, and how well.
#[derive(Debug, Clone)]
pub struct ViewPanel {
    /// Name of the view.
    pub name: String,
    /// The photograph.
    pub truth: RgbImage8,
    /// The model's render of the same view, same size.
    pub render: RgbImage8,
    /// PSNR in dB.
    pub psnr: f64,
    /// SSIM.
    pub ssim: f64,
}
