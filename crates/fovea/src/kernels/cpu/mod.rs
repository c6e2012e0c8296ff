//! The passes on the CPU.

pub mod hvsq;
pub mod pooling;
pub mod pyramid;
