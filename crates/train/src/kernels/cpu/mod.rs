//! The kernels of training on the CPU: slices in, slices out.

pub mod adam;
pub mod densify;
pub mod l1_ssim;
pub mod noise;
pub mod regularize;
pub mod relocate;
pub mod rows;
pub mod scale_decay;
pub mod seen;
pub mod sweep;
