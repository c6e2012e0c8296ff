//! The passes: one file per pass and device, slices in and slices out.

pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
