//! The program as a person meets it: every command run as a process in a directory of its own.
//!
//! One binary for all commands, so that the scene and the run most tests start from are made once.

mod antialiased;
mod bad_input;
mod convert;
mod demo;
mod device;
mod eval;
mod help;
mod hvsq;
mod info;
mod memory;
mod prune;
mod render;
mod resume;
mod settings;
mod support;
mod synth;
mod termination;
mod train;
