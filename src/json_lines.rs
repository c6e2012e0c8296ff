//! A report that grows: one JSON object per line, flushed so that it can be followed, cut and gone on with by a resumed run.

use crate::diagnostics::{Failure, Result};
use crate::run_dir::cannot_write;
use serde::Serialize;
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

/// The file, whole lines only unless the process is killed.
#[derive(Debug)]
pub struct JsonLines {
    path: PathBuf,
    file: File,
    num_bytes: u64,
}

impl JsonLines {
    /// Starts an empty file at `path`.
    ///
    /// # Errors
    /// When the file cannot be created.
    pub fn create(path: PathBuf) -> Result<Self> {
        let file = File::create(&path).map_err(|e| cannot_write(&path, e))?;
        Ok(Self { path, file, num_bytes: 0 })
    }

    /// Cuts the file at `path` to the `num_bytes` that a checkpoint knows of, and goes on behind them.
    ///
    /// # Errors
    /// When the file is shorter or cannot be written; it is then as it was.
    pub fn go_on(path: PathBuf, num_bytes: u64) -> Result<Self> {
        let file = OpenOptions::new().append(true).open(&path).map_err(|e| cannot_write(&path, e))?;
        let found = file.metadata().map_err(|e| cannot_write(&path, e))?.len();
        if found < num_bytes {
            return Err(Failure::new(format!(
                "`{}` has {found} bytes, the checkpoint knows of {num_bytes}",
                path.display()
            ))
            .hint("the report was changed after the run was interrupted: begin anew with `--overwrite`"));
        }
        file.set_len(num_bytes).map_err(|e| cannot_write(&path, e))?;
        Ok(Self { path, file, num_bytes })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Bytes so far.
    pub fn num_bytes(&self) -> u64 {
        self.num_bytes
    }

    /// Appends one object as a line and flushes it.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn append(&mut self, record: &impl Serialize) -> Result<()> {
        let mut line = serde_json::to_vec(record).expect("records are plain numbers and text");
        line.push(b'\n');
        self.file.write_all(&line).and_then(|()| self.file.flush()).map_err(|e| cannot_write(&self.path, e))?;
        self.num_bytes += line.len() as u64;
        Ok(())
    }

    /// Waits until all lines are on the disk: a checkpoint that says how long the file is must not get there first.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn sync(&self) -> Result<()> {
        self.file.sync_data().map_err(|e| cannot_write(&self.path, e))
    }
}
