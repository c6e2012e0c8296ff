//! Ctrl-C: the first asks the training to stop after the current step, the second ends the program at once.

use crate::diagnostics::{Failure, Result};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

static STOP: AtomicBool = AtomicBool::new(false);

/// Status of a program that was interrupted: 128 + SIGINT, as shells report it.
const INTERRUPTED: i32 = 130;

/// The flag that Ctrl-C raises. The handler is set on the first call and stays for the life of the process.
///
/// # Errors
/// When the system refuses a signal handler.
pub fn stop_flag() -> Result<&'static AtomicBool> {
    static HANDLER: OnceLock<std::result::Result<(), String>> = OnceLock::new();
    let handler = HANDLER.get_or_init(|| {
        ctrlc::set_handler(|| {
            // Files are written under temporary names, so ending here leaves nothing half-written behind.
            if STOP.swap(true, Ordering::SeqCst) {
                std::process::exit(INTERRUPTED);
            }
        })
        .map_err(|e| e.to_string())
    });
    match handler {
        Ok(()) => Ok(&STOP),
        Err(reason) => Err(Failure::new(format!("cannot watch for Ctrl-C: {reason}"))),
    }
}
