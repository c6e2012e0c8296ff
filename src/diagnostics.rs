//! What a person sees when something fails: one message, the place in the file when there is one, and a hint.
//!
//! Libraries return typed errors; here, and only here, they become text. Nothing is told by colour alone.

use miette::{Diagnostic, GraphicalReportHandler, GraphicalTheme, LabeledSpan, NamedSource, SourceCode, SourceSpan};
use std::fmt;
use std::io::{IsTerminal, Write};
use std::ops::Range;
use std::path::Path;
use std::process::ExitCode;

/// Result with [`Failure`].
pub type Result<T> = std::result::Result<T, Failure>;

/// Why a command ended early; [`Failure::exit_code`] says with which status.
pub struct Failure(Box<Inner>);

struct Inner {
    kind: FailureKind,
    message: String,
    hint: Option<String>,
    excerpt: Option<Excerpt>,
}

/// The part of a text file that is at fault.
struct Excerpt {
    source: NamedSource<String>,
    span: SourceSpan,
    label: String,
}

/// What kind of end a [`Failure`] is; decides the exit status.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FailureKind {
    /// Something went wrong: status 2.
    Error,
    /// Everything worked, but a check that was asked for did not hold: status 1.
    CheckFailed,
    /// The reader of our standard output went away (`gazesplat info X | head -1`): not a failure, status 0.
    BrokenPipe,
}

impl Failure {
    /// An error with a message of one sentence, without a full stop.
    pub fn new(message: impl Into<String>) -> Self {
        Self::of_kind(FailureKind::Error, message)
    }

    /// A check that the user asked for did not hold.
    pub fn check_failed(message: impl Into<String>) -> Self {
        Self::of_kind(FailureKind::CheckFailed, message)
    }

    /// The operating system refused `action` ("read", "write", "create") on `path`.
    pub fn io(action: &'static str, path: &Path, source: std::io::Error) -> Self {
        gazesplat_core::Error::io(action, path, source).into()
    }

    fn of_kind(kind: FailureKind, message: impl Into<String>) -> Self {
        Self(Box::new(Inner { kind, message: message.into(), hint: None, excerpt: None }))
    }

    /// Adds what the person can do about it.
    #[must_use]
    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        self.0.hint = Some(hint.into());
        self
    }

    /// Adds what the person can do about it, if there is something to suggest.
    #[must_use]
    pub fn hint_if(self, hint: Option<impl Into<String>>) -> Self {
        match hint {
            Some(hint) => self.hint(hint),
            None => self,
        }
    }

    /// Adds what the person should know first, before what they can do about it.
    #[must_use]
    pub fn hint_first(mut self, hint: impl Into<String>) -> Self {
        let hint = hint.into();
        self.0.hint = Some(match self.0.hint {
            Some(then) => format!("{hint}; {then}"),
            None => hint,
        });
        self
    }

    /// Points at bytes `span` of the text file `path`, whose content is `text`.
    #[must_use]
    pub fn excerpt(mut self, path: &Path, text: &str, span: Range<usize>, label: impl Into<String>) -> Self {
        self.0.excerpt = Some(Excerpt {
            source: NamedSource::new(path.display().to_string(), text.to_owned()).with_language("toml"),
            span: span.into(),
            label: label.into(),
        });
        self
    }

    /// The message alone.
    pub fn message(&self) -> &str {
        &self.0.message
    }

    /// What kind of end this is.
    pub fn kind(&self) -> FailureKind {
        self.0.kind
    }

    /// Exit status: 0 for a broken pipe, 1 for a failed check, 2 for an error.
    pub fn exit_code(&self) -> ExitCode {
        match self.0.kind {
            FailureKind::BrokenPipe => ExitCode::SUCCESS,
            FailureKind::CheckFailed => ExitCode::from(1),
            FailureKind::Error => ExitCode::from(2),
        }
    }

    /// Writes the report to standard error; says nothing about a broken pipe.
    pub fn print(&self) {
        if self.0.kind == FailureKind::BrokenPipe {
            return;
        }
        let stderr = std::io::stderr();
        let colour = stderr.is_terminal() && std::env::var_os("NO_COLOR").is_none();
        // Nobody is left to tell when standard error itself is closed.
        let _ = stderr.lock().write_all(self.report(colour).as_bytes());
    }

    /// The whole report as text: message, excerpt, hint.
    pub fn report(&self, colour: bool) -> String {
        let word = if self.0.kind == FailureKind::CheckFailed { "check failed:" } else { "error:" };
        let mut theme = if colour { GraphicalTheme::unicode() } else { GraphicalTheme::unicode_nocolor() };
        theme.characters.error = word.to_owned();
        let mut text = String::new();
        let handler = GraphicalReportHandler::new_themed(theme).with_wrap_lines(false).with_width(4096);
        if handler.render_report(&mut text, self.0.as_ref()).is_err() {
            text = format!("{word} {}\n", self.0.message);
        }
        // The handler indents its first line; ours stands at the margin like everything else the program says.
        let mut text = format!("{}\n", text.trim());
        if let Some(hint) = &self.0.hint {
            let lead = if colour { "\u{1b}[36mhint:\u{1b}[0m" } else { "hint:" };
            text.push_str(&format!("{lead} {hint}\n"));
        }
        text
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0.message)
    }
}

impl fmt::Debug for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.report(false).trim_end())
    }
}

impl std::error::Error for Failure {}

impl fmt::Display for Inner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl fmt::Debug for Inner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for Inner {}

impl Diagnostic for Inner {
    fn source_code(&self) -> Option<&dyn SourceCode> {
        self.excerpt.as_ref().map(|e| &e.source as &dyn SourceCode)
    }

    fn labels(&self) -> Option<Box<dyn Iterator<Item = LabeledSpan> + '_>> {
        let label = self.excerpt.as_ref().map(|e| LabeledSpan::new_with_span(Some(e.label.clone()), e.span))?;
        Some(Box::new(std::iter::once(label)))
    }
}

impl From<gazesplat_core::Error> for Failure {
    fn from(error: gazesplat_core::Error) -> Self {
        let hint = match &error {
            gazesplat_core::Error::Parameter { .. } => Some("`gazesplat COMMAND --help` says what each option takes"),
            other => other.hint(),
        };
        Self::new(error.to_string()).hint_if(hint)
    }
}

impl From<gazesplat_render::Error> for Failure {
    fn from(error: gazesplat_render::Error) -> Self {
        let hint = match &error {
            gazesplat_render::Error::Parameter { expected, .. } => {
                Some(format!("give {expected}; `gazesplat render --help` has the default"))
            }
            other => other.hint().map(str::to_owned),
        };
        Self::new(error.to_string()).hint_if(hint)
    }
}

impl From<gazesplat_train::Error> for Failure {
    fn from(error: gazesplat_train::Error) -> Self {
        match error {
            gazesplat_train::Error::Scene(error) => error.into(),
            gazesplat_train::Error::Render(error) => error.into(),
            other => Self::new(other.to_string()).hint_if(other.hint()),
        }
    }
}

/// Failure of a write to standard output: a closed pipe is a normal end.
pub(crate) fn stdout_failure(error: std::io::Error) -> Failure {
    if error.kind() == std::io::ErrorKind::BrokenPipe {
        Failure::of_kind(FailureKind::BrokenPipe, "standard output was closed")
    } else {
        Failure::new(format!("cannot write to standard output: {error}"))
    }
}

/// The nearest of `candidates` to `word`, when it is near enough to be a misspelling.
pub(crate) fn nearest<'a>(word: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    // 0.7 accepts one wrong letter in three (`seed`/`sed`, `steps`/`stpes`) and refuses unrelated words.
    candidates
        .into_iter()
        .map(|c| (strsim::jaro_winkler(word, c).max(strsim::normalized_damerau_levenshtein(word, c)), c))
        .filter(|(score, _)| *score >= 0.7)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, c)| c)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn report_has_message_place_and_hint() {
        let failure = Failure::new("`train.stpes` is not a setting").hint("did you mean `train.steps`?").excerpt(
            Path::new("a.toml"),
            "[train]\nstpes = 3\n",
            8..13,
            "unknown key",
        );
        let report = failure.report(false);
        assert!(report.starts_with("error: `train.stpes` is not a setting\n"), "{report}");
        assert!(report.contains("a.toml:2:1") && report.contains("stpes = 3"), "{report}");
        assert!(report.ends_with("hint: did you mean `train.steps`?\n"), "{report}");
    }

    #[test]
    fn nearest_suggests_misspellings_only() {
        let keys = ["train.steps", "train.seed", "densify.cap"];
        assert_eq!(nearest("train.stpes", keys), Some("train.steps"));
        assert_eq!(nearest("densify.cpa", keys), Some("densify.cap"));
        assert_eq!(nearest("xylophone", keys), None);
    }
}
