//! The one error type of this crate.

use std::path::PathBuf;

/// Result with this crate's [`Error`].
pub type Result<T> = std::result::Result<T, Error>;

/// What can go wrong while a model is trained or measured.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A scene, image or model file could not be used.
    #[error(transparent)]
    Scene(#[from] gazesplat_core::Error),
    /// The renderer refused.
    #[error(transparent)]
    Render(#[from] gazesplat_render::Error),
    /// A setting is out of its range.
    #[error("{key}: {message}")]
    Parameter {
        /// The configuration key, as in `train.steps`.
        key: String,
        /// The value found and the range expected.
        message: String,
    },
    /// There is nothing to train on.
    #[error("the scene has no training views ({num_test} test views)")]
    NoTrainingViews {
        /// Views that the split gave to the test set.
        num_test: usize,
    },
    /// The loss is not a number; the model is as it was before the step.
    #[error("the loss of step {step} on view `{view}` is {loss}{}", describe(offender.as_ref()))]
    NonFiniteLoss {
        /// The step that failed, counted from 1.
        step: u32,
        /// The view it was computed on.
        view: String,
        /// The value: NaN or an infinity.
        loss: f32,
        /// The first Gaussian with a non-finite parameter, else the one with the largest; `None` for an empty model.
        offender: Option<Offender>,
    },
    /// A model that cannot be pruned, or not under that guard.
    #[error("{0}")]
    Prune(String),
    /// A checkpoint cannot be taken up; it is still as it was.
    #[error("`{}` cannot be resumed: {message}", path.display())]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// Why.
        message: String,
    },
    /// An observer failed, for instance because a log could not be written.
    #[error("{0}")]
    Observer(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// The threads that were asked for could not be started.
    #[error("cannot start {threads} threads: {message}")]
    Threads {
        /// How many were asked for.
        threads: usize,
        /// The system's reason.
        message: String,
    },
}

impl Error {
    pub(crate) fn parameter(key: impl Into<String>, message: impl Into<String>) -> Self {
        Self::Parameter { key: key.into(), message: message.into() }
    }

    /// What a person can do about the error, if there is something to suggest.
    pub fn hint(&self) -> Option<String> {
        match self {
            Self::Scene(error) => error.hint().map(str::to_owned),
            Self::NoTrainingViews { .. } => Some("set data.test_every to 0 to train on all views".into()),
            Self::NonFiniteLoss { .. } => Some(
                "the model before this step is intact; check the image of the view, or lower the learning rates".into(),
            ),
            Self::Threads { .. } => Some("set train.threads to a smaller number, or to 0 for one per core".into()),
            Self::Parameter { .. } => Some("`gazesplat train --help` lists every setting with its default".into()),
            Self::Checkpoint { .. } => Some(
                "resume with the model, scene and settings the run began with, or begin anew in another directory"
                    .into(),
            ),
            Self::Prune(_) | Self::Render(_) | Self::Observer(_) => None,
        }
    }
}

/// A parameter that may be why a loss is not finite.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Offender {
    /// Row of the Gaussian.
    pub gaussian: usize,
    /// Tensor of the parameter, as in `log_scales`.
    pub parameter: &'static str,
    /// Its value.
    pub value: f32,
}

fn describe(offender: Option<&Offender>) -> String {
    match offender {
        Some(Offender { gaussian, parameter, value }) if value.is_finite() => {
            format!("; all parameters are finite, the largest is {parameter} of Gaussian {gaussian}: {value}")
        }
        Some(Offender { gaussian, parameter, value }) => {
            format!("; first non-finite parameter: {parameter} of Gaussian {gaussian}: {value}")
        }
        None => String::new(),
    }
}
