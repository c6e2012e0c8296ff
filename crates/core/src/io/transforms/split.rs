//! The split that nerfstudio writes into a `transforms.json`: `train_filenames`, `val_filenames`, `test_filenames`.
//!
//! Each lists frames by their `file_path`. Test views are those of `test_filenames`, without it those of `val_filenames`;
//! training views are those of `train_filenames`, without it all that no list names. What is left over takes no part.

use super::{Frame, relative_image_path};
use crate::error::{Error, Result};
use serde_json::{Map, Value};
use std::collections::HashSet;
use std::path::{Path, PathBuf};

/// The lists of a file, of which one at least is there.
#[derive(Debug, Default)]
pub(super) struct Lists {
    train: Option<HashSet<PathBuf>>,
    val: Option<HashSet<PathBuf>>,
    test: Option<HashSet<PathBuf>>,
}

const HINT: &str = "correct the lists, or remove all three to split by `data.test_every`";

impl Lists {
    /// The lists among the keys `globals` of `file`, if there are any; `listed` has the paths of all frames.
    ///
    /// # Errors
    /// [`Error::Format`] for a list that is none, a name that no frame has, and a frame that is in two lists.
    pub(super) fn read(file: &Path, globals: &Map<String, Value>, listed: &HashSet<PathBuf>) -> Result<Option<Self>> {
        let list = |key: &str| -> Result<Option<HashSet<PathBuf>>> {
            let Some(value) = globals.get(key) else { return Ok(None) };
            let wrong = |message: String| Error::format(file, format!("`{key}`: {message}"), HINT);
            let names = value.as_array().ok_or_else(|| wrong("found no array, expected one of file names".into()))?;
            let mut paths = HashSet::with_capacity(names.len());
            for name in names {
                let Some(text) = name.as_str() else {
                    return Err(wrong(format!("found {name}, expected a file name")));
                };
                let path = relative_image_path(text, None);
                if !listed.contains(&path) {
                    return Err(wrong(format!("no frame has the `file_path` `{text}`")));
                }
                paths.insert(path);
            }
            Ok(Some(paths))
        };
        let lists =
            Self { train: list("train_filenames")?, val: list("val_filenames")?, test: list("test_filenames")? };
        let named = [("train", &lists.train), ("val", &lists.val), ("test", &lists.test)];
        // Views that judge must not be among those that train; the two that judge may well be the same.
        for (name, other) in &named[1..] {
            let both =
                lists.train.iter().flatten().filter(|path| other.as_ref().is_some_and(|o| o.contains(*path))).min();
            if let Some(path) = both {
                let message = format!("`{}` is in `train_filenames` and in `{name}_filenames`", path.display());
                return Err(Error::format(file, message, HINT));
            }
        }
        Ok(named.iter().any(|(_, list)| list.is_some()).then_some(lists))
    }

    /// The training frames and behind them the test frames, and how many the former are.
    ///
    /// # Errors
    /// [`Error::Format`] when no frame is left to train on.
    pub(super) fn divide(
        &self,
        file: &Path,
        frames: Vec<Frame>,
        warnings: &mut Vec<String>,
    ) -> Result<(Vec<Frame>, usize)> {
        let is_in =
            |list: &Option<HashSet<PathBuf>>, frame: &Frame| list.as_ref().is_some_and(|l| l.contains(&frame.listed));
        let judges = if self.test.is_some() { &self.test } else { &self.val };
        let num_frames = frames.len();
        let (test, rest): (Vec<Frame>, Vec<Frame>) = frames.into_iter().partition(|frame| is_in(judges, frame));
        let trains = |frame: &Frame| match &self.train {
            Some(_) => is_in(&self.train, frame),
            None => !is_in(&self.val, frame),
        };
        let mut train: Vec<Frame> = rest.into_iter().filter(trains).collect();
        let num_train = train.len();
        if num_train == 0 {
            let message = "its split leaves no frame with an image file to train on";
            return Err(Error::format(file, message, HINT));
        }
        let num_left_out = num_frames - num_train - test.len();
        if num_left_out > 0 {
            warnings.push(format!(
                "{num_left_out} of {num_frames} frames are neither training nor test views in the split of `{}` and were \
                 left out",
                file.display()
            ));
        }
        train.extend(test);
        Ok((train, num_train))
    }
}
