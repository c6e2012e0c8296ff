//! The scalar formulas of the renderer: one text for CPU and GPU.
//!
//! Every function here is plain Rust on the CPU and, with feature `gpu`, a device function through `#[cube]`. They keep
//! to `f32` scalars and plain structs, have no early return and no slice, so that both readings stay the same.

/// Makes the device-side twins of plain structs as copyable as the structs are.
#[cfg(feature = "gpu")]
macro_rules! copy_on_device {
    ($($twin:ty),+) => {$(
        impl Clone for $twin {
            fn clone(&self) -> Self {
                *self
            }
        }
        impl Copy for $twin {}
    )+};
}
#[cfg(feature = "gpu")]
use copy_on_device;

pub mod alpha;
pub mod compensation;
pub mod conic;
pub mod covariance;
pub mod ewa;
pub mod footprint;
pub mod frustum;
pub mod pose;
pub mod quat;
pub mod sh;
pub mod tile;
pub mod vec;
