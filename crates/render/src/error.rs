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
    /// A frame, a model or a kernel needs more of something than the backend has.
    #[error("{what}: {needed} needed, the limit is {limit}")]
    Limit {
        /// The resource.
        what: &'static str,
        /// What is needed.
        needed: u64,
        /// What there is.
        limit: u64,
    },
    /// The GPU that was asked for cannot be used.
    #[error("no GPU: {message}")]
    NoAdapter {
        /// What was asked for and what there is.
        message: String,
    },
    /// The GPU stopped answering: it was lost, has no memory left, or refused a kernel.
    #[error("the GPU stopped: {message}")]
    Device {
        /// What its driver says.
        message: String,
    },
}

impl Error {
    /// What the driver of a GPU says: what failed first and why in the end, without what lies between and the backtrace.
    pub fn device(cause: &dyn std::fmt::Display) -> Self {
        const MAX_CHARS: usize = 160;
        let brief = |text: &str| {
            let mut text = text.split_whitespace().collect::<Vec<_>>().join(" ");
            if let Some((end, _)) = text.char_indices().nth(MAX_CHARS) {
                text.truncate(end);
                text.push('…');
            }
            text
        };
        let text = cause.to_string();
        let first = text.split("\nBacktrace").next().unwrap_or_default();
        let mut causes = first.split("Caused by:");
        let failed = brief(causes.next().unwrap_or_default());
        let message = match causes.last() {
            Some(last) => format!("{failed}: {}", brief(last)),
            None => failed,
        };
        Self::Device { message }
    }

    /// What a person can do about the error, if there is something to suggest.
    pub fn hint(&self) -> Option<&'static str> {
        match self {
            Self::NoAdapter { .. } => Some(
                "`gazesplat info --devices` lists what can be used; install the driver of your card (or, on Debian, the \
                 software driver `mesa-vulkan-drivers`), or work with `--device cpu`",
            ),
            Self::Device { .. } => Some(
                "what was saved is intact; free memory of the card, ask for fewer Gaussians or smaller images \
                 (`densify.cap`, `data.max_side`), or work with `--device cpu`",
            ),
            Self::Limit { .. } => Some(
                "ask for fewer Gaussians or a smaller image; on a GPU, `--device cpu` has no such limits of \
                 buffers",
            ),
            Self::Shape { .. } | Self::Parameter { .. } => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Error;

    #[test]
    fn what_a_driver_says_is_cut_to_its_first_sentences() {
        let said = |text: &str| Error::device(&text).to_string();
        assert_eq!(
            said("lost\nCaused by:\n  a push\nCaused by:\n  a fall\nBacktrace:\n 1 2 3"),
            "the GPU stopped: lost: a fall"
        );
        assert!(said(&"ä ".repeat(500)).ends_with('…') && said(&"ä ".repeat(500)).chars().count() < 300);
    }
}
