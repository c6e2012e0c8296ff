//! The passes on a GPU: CubeCL kernels, one file per pass, named as on the CPU.

pub mod hvsq;
pub mod pooling;
pub mod pyramid;

use cubecl::prelude::*;
use gazesplat_render::gpu::UNITS;

/// Units of a workgroup, as a length.
pub(crate) const NUM_UNITS: usize = UNITS as usize;

/// Sum of `value` over the units of a workgroup, by halves; every unit must call it. `shared` holds a value per unit.
#[cube]
pub(crate) fn reduced(shared: &mut Shared<[f32]>, value: f32) -> f32 {
    let unit = UNIT_POS as usize;
    sync_cube();
    shared[unit] = value;
    sync_cube();
    let mut half = (NUM_UNITS / 2).runtime();
    while half > 0 {
        if unit < half {
            shared[unit] += shared[unit + half];
        }
        sync_cube();
        half /= 2;
    }
    shared[0]
}
