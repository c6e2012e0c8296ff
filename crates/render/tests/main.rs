//! Tests of the renderer, in one binary: every file links Burn only once that way. `simd_agreement` stands apart because it
//! switches the instruction set of the whole process.

mod antialiased;
mod common;
mod counters;
mod depth;
mod determinism;
mod finite_diff;
mod golden;
mod golden_work_stats;
mod gpu_equals_cpu;
mod lost_device;
mod pose;
mod random_values;
mod stability;
mod stability_limits;
mod termination;
