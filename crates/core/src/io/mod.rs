//! Files: scenes, models and images in, models and images out.
//!
//! Readers take nothing a file says on trust: counts are checked against the bytes that are there before anything is
//! allocated, numbers for being finite, and every error names the file and the place in it. Writers are atomic: a file
//! appears under its final name complete or not at all.

pub mod colmap;
pub mod colmap_bin;
pub mod colmap_txt;
mod file_bytes;
mod image_cache;
pub mod images;
mod jpeg;
mod locate;
pub mod model;
pub mod ply;
pub mod poses;
mod quantize;
pub mod reduced_images;
pub mod splat;
pub mod spz;
pub mod transforms;
mod write;

pub use write::{save_png, write_atomically};
