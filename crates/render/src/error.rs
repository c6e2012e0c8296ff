//! The one error type of this crate.

/// Result with this crate's [`Error`].
pub type Result<T> = std::result::Result<T, Error>;

/// Why a frame cannot be rendered. Values of single Gaussians are never an error: they are culled and counted.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// A tensor does not have the shape the others imply.
    #[error("{name} has shape {found:?}, expected {expected:?}")]
    Shape {
        /// The tensor.
        name: &'static str,
        /// Its shape.
        found: Vec<usize>,
        /// The shape expected.
        expected: Vec<usize>,
    },
    /// An option or camera value is out of its range.
    #[error("{name}: found `{found}`, expected {expected}")]
    Parameter {
        /// The option.
        name: &'static str,
        /// Its value.
        found: String,
        /// The range.
        expected: &'static str,
    },
    /// The frame needs more of something than the backend has.
    #[error("{what}: this frame needs {needed}, the limit is {limit}")]
    Limit {
        /// The resource.
        what: &'static str,
        /// What the frame needs.
        needed: u64,
        /// What there is.
        limit: u64,
    },
}
