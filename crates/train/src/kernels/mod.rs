//! The kernels of training, one file each, per kind of processor.

pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
