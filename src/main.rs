//! The `gazesplat` program: parse, run, exit status.

use std::process::ExitCode;

fn main() -> ExitCode {
    gazesplat::allocator::keep_freed_memory();
    match gazesplat::cli::run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            failure.print();
            failure.exit_code()
        }
    }
}
