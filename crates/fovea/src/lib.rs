//! Models of human vision, foveated levels and their renderer.
//!
//! This crate is the last of the chain core → render → train → fovea: it gives perceptual meaning to shapes that its
//! upstream crates own. [`hvsq`] says how different two images look to an eye that does not look straight at them, and
//! [`termination_lut`] fills the tables by which the renderer stops compositing what cannot be seen, from the colour
//! discrimination of [`hvs::jnd`]. [`flip`] says what is seen of the difference between two images, [`lpips`] what a network
//! that has learned to see makes of it. Sources, as cited in the
//! code: `RTGS` = Lin, Feng, Zhu 2024; Walton 2021 (*Beyond Blur*).

pub mod error;
pub mod flip;
pub mod hvs;
pub mod hvsq;
pub mod kernels;
pub mod lpips;
mod real;
pub mod termination_lut;

pub use error::{Error, Result};
pub use hvsq::{Hvsq, HvsqReference};
