//! Models of human vision, foveated levels and their renderer.
//!
//! This crate is the last of the chain core → render → train → fovea: it gives perceptual meaning to shapes that its
//! upstream crates own. It is empty so far; quality metrics for peripheral vision and levels of detail belong here.
