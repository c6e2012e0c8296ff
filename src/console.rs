//! The two channels of the program: standard output is data, standard error is for people.

use crate::diagnostics::{Result, stdout_failure};
use indicatif::MultiProgress;
use std::fmt::Display;
use std::io::{IsTerminal, Write};

/// Where notes, warnings, progress and data go.
#[derive(Debug, Clone)]
pub struct Console {
    quiet: bool,
    live: bool,
    bars: MultiProgress,
}

impl Console {
    /// Notes and progress on standard error, unless `quiet`; bars when standard error is a terminal.
    pub fn new(quiet: bool) -> Self {
        let live = !quiet && std::io::stderr().is_terminal();
        Self { quiet, live, bars: MultiProgress::new() }
    }

    /// Plain lines instead of bars: a log on the same terminal would break them.
    #[must_use]
    pub fn without_bars(self) -> Self {
        Self { live: false, ..self }
    }

    /// Nothing but warnings: for use as a library.
    pub fn quiet() -> Self {
        Self::new(true)
    }

    /// True when progress may redraw its line; otherwise it is told in plain lines.
    pub fn is_live(&self) -> bool {
        self.live
    }

    /// The bars that share the terminal with the notes.
    pub(crate) fn bars(&self) -> &MultiProgress {
        &self.bars
    }

    /// One line for people, left out under `--quiet`.
    pub fn note(&self, line: impl Display) {
        if !self.quiet {
            self.stderr(format_args!("{line}"));
        }
    }

    /// One line for people about something that is probably not what they meant; `--quiet` keeps it.
    pub fn warn(&self, line: impl Display) {
        self.stderr(format_args!("warning: {line}"));
    }

    fn stderr(&self, line: std::fmt::Arguments<'_>) {
        // A closed standard error leaves nobody to tell.
        self.bars.suspend(|| {
            let _ = writeln!(std::io::stderr().lock(), "{line}");
        });
    }

    /// Text on standard output: the result that another program may read.
    ///
    /// # Errors
    /// When standard output refuses; a closed pipe is reported as such and ends the program with success.
    pub fn data(&self, text: &str) -> Result<()> {
        let mut stdout = std::io::stdout().lock();
        stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()).map_err(stdout_failure)
    }

    /// A value as indented JSON with a line end, on standard output.
    ///
    /// # Errors
    /// As [`Console::data`].
    pub fn json(&self, value: &impl serde::Serialize) -> Result<()> {
        let mut text = crate::run_dir::to_json(value);
        text.push('\n');
        self.data(&text)
    }
}

/// `12345` as `12,345`: counts of Gaussians and points are read by people.
pub fn grouped(n: usize) -> String {
    let digits = n.to_string();
    let mut out = String::with_capacity(digits.len() + digits.len() / 3);
    for (i, c) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            out.push(',');
        }
        out.push(c);
    }
    out
}

/// Seconds as `8.4 s`, `2 m 05 s` or `1 h 03 m`.
pub fn duration(secs: f64) -> String {
    if secs < 60.0 {
        return format!("{secs:.1} s");
    }
    let whole = secs.round() as u64;
    match whole / 3600 {
        0 => format!("{} m {:02} s", whole / 60, whole % 60),
        hours => format!("{hours} h {:02} m", whole % 3600 / 60),
    }
}

/// Bytes as `1.8 GB`, `37.2 MB`, `5.0 kB` or `80 B`, powers of 1000.
pub fn bytes(n: u64) -> String {
    match n {
        0..1_000 => format!("{n} B"),
        1_000..1_000_000 => format!("{:.1} kB", n as f64 / 1e3),
        1_000_000..1_000_000_000 => format!("{:.1} MB", n as f64 / 1e6),
        _ => format!("{:.1} GB", n as f64 / 1e9),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_are_grouped_by_thousands() {
        assert_eq!(
            ["7", "999", "1,000", "1,234,567"],
            [7, 999, 1000, 1_234_567].map(grouped).each_ref().map(|s| s.as_str())
        );
    }

    #[test]
    fn durations_keep_two_units() {
        assert_eq!(
            ["8.4 s", "2 m 05 s", "1 h 03 m"],
            [8.4, 125.0, 3780.0].map(duration).each_ref().map(|s| s.as_str())
        );
    }
}
