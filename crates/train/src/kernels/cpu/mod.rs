//! The kernels of training on the CPU: slices in, slices out.

pub mod l1_ssim;
