//! The passes on a GPU: CubeCL kernels, the mirror of [`cpu`](super::cpu) file by file.
//!
//! Order of a frame: [`project`] → [`sort`] (with [`scan`]) → [`bin`] → [`rasterize`]; backwards [`rasterize_bwd`] →
//! [`project_bwd`] and, where asked for, [`pose_bwd`]. No float is ever added atomically: every sum has a fixed order, so one adapter gives the same bits
//! on every run. No kernel depends on the size of a subgroup.

pub mod bin;
pub mod lut;
pub mod pose_bwd;
pub mod project;
pub mod project_bwd;
pub mod rasterize;
pub mod rasterize_bwd;
pub mod scan;
pub mod sort;
pub mod stats;
pub mod tile;
