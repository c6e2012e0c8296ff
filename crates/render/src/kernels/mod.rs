//! The passes of the renderer, one file each, per kind of processor.

pub mod cpu;
