//! Tests on a GPU: skipped aloud where there is none, a failure where one is required.

use std::fmt::Display;

/// Environment variable that turns a missing GPU into a failure.
pub const REQUIRE_GPU_VARIABLE: &str = "GAZESPLAT_REQUIRE_GPU";

/// The GPU that was opened; `None`, said on stderr, where there is none.
///
/// # Panics
/// If there is none and `GAZESPLAT_REQUIRE_GPU` is set to something other than `0`.
#[track_caller]
pub fn required_gpu<D, E: Display>(opened: Result<D, E>) -> Option<D> {
    match opened {
        Ok(device) => Some(device),
        Err(error) => {
            let required = std::env::var(REQUIRE_GPU_VARIABLE).is_ok_and(|v| !v.is_empty() && v != "0");
            assert!(!required, "{REQUIRE_GPU_VARIABLE} is set, but no GPU can be used: {error}");
            eprintln!("SKIPPED on the GPU: {error}");
            None
        }
    }
}

#[cfg(test)]
mod tests {
    use super::required_gpu;

    #[test]
    fn what_was_opened_is_handed_on() {
        assert_eq!(required_gpu(Ok::<_, String>(3)), Some(3));
    }
}
