//! The kernels of training on a GPU: the mirror of [`super::cpu`] file by file.

pub mod l1_ssim;
