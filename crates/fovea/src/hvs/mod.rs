//! Models of human vision.

pub mod jnd;
