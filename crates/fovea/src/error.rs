//! The one error type of this crate.

use std::path::PathBuf;

/// Result with this crate's [`Error`].
pub type Result<T> = std::result::Result<T, Error>;

/// What can go wrong in models of vision.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// Two things that belong together differ in size.
    #[error("{name} is {found:?}, expected {expected:?}")]
    Shape {
        /// What has the wrong size.
        name: &'static str,
        /// Its size.
        found: Vec<usize>,
        /// The size expected.
        expected: Vec<usize>,
    },
    /// A value is out of its range.
    #[error("{name}: found {found}, expected {expected}")]
    Parameter {
        /// The parameter.
        name: &'static str,
        /// Its value.
        found: String,
        /// The range.
        expected: String,
    },
    /// A file is not what it has to be.
    #[error("`{}`: {message}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What was found and what was expected.
        message: String,
        /// What to do about it.
        hint: &'static str,
    },
    /// A GPU cannot do it.
    #[error(transparent)]
    Render(#[from] gazesplat_render::Error),
}

impl Error {
    /// What a person can do about the error, if there is something to suggest.
    pub fn hint(&self) -> Option<&str> {
        match self {
            Self::File { hint, .. } => Some(hint),
            Self::Shape { .. } | Self::Parameter { .. } | Self::Render(_) => None,
        }
    }

    pub(crate) fn parameter(name: &'static str, found: impl ToString, expected: impl Into<String>) -> Self {
        Self::Parameter { name, found: found.to_string(), expected: expected.into() }
    }
}
