//! The one error type of this crate: variants by who is at fault.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Result with this crate's [`Error`].
pub type Result<T> = std::result::Result<T, Error>;

/// What can go wrong while scenes, models and images are read, checked or written.
///
/// Every variant that concerns a file names it; `hint` says what a person can do about it.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The operating system refused: missing file, no permission, full disk.
    #[error("cannot {action} `{}`: {source}", path.display())]
    Io {
        /// What was tried: "read", "write", "create".
        action: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The file is there but its content is not what its format promises.
    #[error("`{}`: {message}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// What was found and what was expected.
        message: String,
        /// What to do about it; empty when there is nothing to suggest.
        hint: String,
    },
    /// The file is valid but uses something this program does not implement.
    #[error("`{}`: {message}", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// What is not supported, and what is.
        message: String,
        /// What to do about it; empty when there is nothing to suggest.
        hint: String,
    },
    /// A value passed by the caller is out of its range.
    #[error("{name}: {message}")]
    Parameter {
        /// The parameter or configuration key.
        name: String,
        /// The value found and the range expected.
        message: String,
    },
}

impl Error {
    /// An [`Error::Io`] about `path`.
    pub fn io(action: &'static str, path: impl AsRef<Path>, source: std::io::Error) -> Self {
        Self::Io { action, path: path.as_ref().to_owned(), source }
    }

    /// An [`Error::Format`] about `path`.
    pub fn format(path: impl AsRef<Path>, message: impl Into<String>, hint: impl Into<String>) -> Self {
        Self::Format { path: path.as_ref().to_owned(), message: message.into(), hint: hint.into() }
    }

    /// An [`Error::Unsupported`] about `path`.
    pub fn unsupported(path: impl AsRef<Path>, message: impl Into<String>, hint: impl Into<String>) -> Self {
        Self::Unsupported { path: path.as_ref().to_owned(), message: message.into(), hint: hint.into() }
    }

    /// An [`Error::Parameter`] about the parameter `name`.
    pub fn parameter(name: impl Into<String>, message: impl Into<String>) -> Self {
        Self::Parameter { name: name.into(), message: message.into() }
    }

    /// What a person can do about the error, if there is something to suggest.
    pub fn hint(&self) -> Option<&str> {
        match self {
            Self::Format { hint, .. } | Self::Unsupported { hint, .. } => (!hint.is_empty()).then_some(hint.as_str()),
            Self::Io { source, .. } => match source.kind() {
                ErrorKind::NotFound => {
                    Some("check the spelling of the path; a relative one starts at the working directory")
                }
                ErrorKind::PermissionDenied => Some("check the permissions of the file and of its directory"),
                ErrorKind::IsADirectory => Some("a file is expected here, this is a directory"),
                ErrorKind::NotADirectory => Some("a directory is expected here, this is a file"),
                ErrorKind::StorageFull | ErrorKind::QuotaExceeded => Some("free some space and try again"),
                ErrorKind::FileTooLarge => Some(
                    "the disk or a limit of the shell (`ulimit -f`) takes no file of this size: choose another place",
                ),
                ErrorKind::ReadOnlyFilesystem => Some("choose a place that can be written"),
                _ => None,
            },
            Self::Parameter { .. } => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_names_the_file_and_the_hint_stays_separate() {
        let error = Error::format("a/b.bin", "found 3, expected 4", "do this");
        assert_eq!(error.to_string(), "`a/b.bin`: found 3, expected 4");
        assert_eq!(error.hint(), Some("do this"));
        assert_eq!(Error::unsupported("x", "y", "").hint(), None);
    }

    #[test]
    fn system_errors_that_a_person_can_mend_have_a_hint() {
        for kind in [
            ErrorKind::NotFound,
            ErrorKind::PermissionDenied,
            ErrorKind::IsADirectory,
            ErrorKind::StorageFull,
            ErrorKind::QuotaExceeded,
            ErrorKind::FileTooLarge,
        ] {
            assert!(Error::io("read", "x", kind.into()).hint().is_some(), "{kind:?}");
        }
        assert_eq!(Error::io("read", "x", ErrorKind::Interrupted.into()).hint(), None);
    }
}
