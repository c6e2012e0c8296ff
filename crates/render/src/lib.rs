//! The differentiable Gaussian renderer: kernels, gradients, statistics.
//!
//! [`render`] draws [`Splats`] as a camera sees them: project → bin → sort → rasterise (Kerbl 2023). The whole frame is
//! one differentiable operation for Burn's autodiff, with a hand-written backward pass. [`kernels`] holds the passes,
//! [`math`] the formulas they share across processors, [`layout`] the constants.

#![recursion_limit = "256"]
#![expect(deprecated, reason = "burn-ndarray is the CPU backend of Burn 0.22, its last line; Flex stands ready")]

pub mod backend;
pub mod cluster;
pub mod depth;
pub mod device;
pub mod error;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod kernels;
pub mod layout;
#[cfg_attr(
    feature = "gpu",
    expect(missing_docs, reason = "the device-side twins that the macros generate carry no documentation")
)]
pub mod math;
pub mod options;
pub mod renderer;
pub mod simd;
pub mod splats;
pub mod stats;
pub mod termination;
pub mod view_params;

pub use backend::host;
#[cfg(feature = "flex")]
pub use device::flex_device;
pub use device::{DeviceChoice, cpu_device, is_gpu};
pub use error::{Error, Result};
pub use options::{Pass, RenderOptions, StatsMode};
pub use renderer::{Counted, MeansProbe, PoseProbe, Probes, Rendered, count, render, render_probed, render_with};
pub use splats::Splats;
pub use stats::{RenderStats, SplatStats, TileStats};
pub use termination::{ColorMax, Residual, Termination, TerminationLut};
