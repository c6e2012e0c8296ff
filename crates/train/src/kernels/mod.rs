//! The kernels of training, one file each, per kind of processor.

pub mod cpu;
#[cfg(feature = "gpu")]
#[expect(missing_docs, reason = "what the kernel macros generate carries no documentation")]
pub mod gpu;
