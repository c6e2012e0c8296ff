//! Models of human vision, foveated levels and their renderer.
//!
//! This crate is the last of the chain core → render → train → fovea: it gives perceptual meaning to shapes that its
//! upstream crates own.
//! [`termination_lut`] fills the tables by which the renderer stops compositing what cannot be seen, from the colour
//! discrimination of [`hvs::jnd`]. [`flip`] says what is seen of the difference between two images.

pub mod flip;
pub mod hvs;
pub mod termination_lut;
