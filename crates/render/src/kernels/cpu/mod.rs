//! The passes on the CPU: slices in, slices out, rayon across chunks and tile rows, sixteen lanes per tile row.
//!
//! Order of a frame: [`project`] → [`bin`] (with [`sort`] and [`scan`]) → [`rasterize`]; backwards [`rasterize_bwd`] →
//! [`project_bwd`]. Work is split by the data, never by the number of threads, and every sum has a fixed order: results
//! are the same bits on any number of threads.

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
