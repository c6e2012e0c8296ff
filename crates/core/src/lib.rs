//! Scenes, cameras, Gaussian clouds, images and the files they live in.
//!
//! This crate knows no tensors: everything here is plain host data. Frames, quaternion order, SH order and
//! pixel centres are those of `CONVENTIONS.md` (OpenCV camera: +x right, +y down, +z forward; quaternions w x y z;
//! pixel (0, 0) has its centre at (0.5, 0.5)).

pub mod camera;
pub mod color;
pub mod dataset;
pub mod display;
pub mod error;
pub mod gaussian_cloud;
pub mod gaze;
pub mod image;
pub mod io;
pub mod rng;
pub mod sh;
pub mod synthetic;
pub mod view;

pub use camera::{Camera, Pinhole};
pub use dataset::{Dataset, SparsePoints};
pub use display::{Display, PixelGrid};
pub use error::{Error, Result};
pub use gaussian_cloud::GaussianCloud;
pub use gaze::Gaze;
pub use image::{ImageF32, RgbImage8};
pub use view::View;
