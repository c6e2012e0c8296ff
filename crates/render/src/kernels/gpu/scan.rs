//! Exclusive prefix sum of `u32`.
//!
//! Workgroups of 256 units scan 1024 values each, four per unit; the sums of the workgroups are scanned in turn and
//! added. Values beyond the end count as 0. The sum of all values comes out behind the last of them, so the output is
//! one longer than the input. Sums wrap at 2³².

use crate::error::Result;
use crate::gpu::{Gpu, UNITS, cube_dim};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Values of one unit.
const PER_UNIT: u32 = 4;
/// Values of one workgroup.
const PER_CUBE: u32 = UNITS * PER_UNIT;

/// Sums of everything before each value, `[len + 1]`; `values` has at least `len`.
///
/// # Errors
/// [`crate::Error::Limit`] when the output is larger than the adapter takes.
pub fn exclusive_scan(gpu: &Gpu, values: &CubeTensor, len: usize) -> Result<CubeTensor> {
    let num_cubes = (len + 1).div_ceil(PER_CUBE as usize);
    let sums = gpu.empty("bytes of a prefix sum", &[len + 1], DType::U32)?;
    let cube_sums = gpu.empty("bytes of a prefix sum", &[num_cubes], DType::U32)?;
    scan_cubes::launch(
        &gpu.client,
        gpu.cubes(num_cubes),
        cube_dim(),
        values.clone().into_buffer_arg(),
        sums.clone().into_buffer_arg(),
        cube_sums.clone().into_buffer_arg(),
        len as u32,
    );
    if num_cubes > 1 {
        let offsets = exclusive_scan(gpu, &cube_sums, num_cubes)?;
        add_offsets::launch(
            &gpu.client,
            gpu.cubes(num_cubes),
            cube_dim(),
            sums.clone().into_buffer_arg(),
            offsets.into_buffer_arg(),
            len as u32,
        );
    }
    Ok(sums)
}

/// Inclusive scan of one value per unit of a workgroup, in `shared` of [`UNITS`] values. Every unit must call it.
#[cube]
pub fn scan_units(shared: &mut Shared<[u32]>, value: u32) -> u32 {
    let unit = UNIT_POS as usize;
    shared[unit] = value;
    sync_cube();
    let mut distance = 1usize;
    while distance < UNITS as usize {
        let mut sum = shared[unit];
        if unit >= distance {
            sum += shared[unit - distance];
        }
        sync_cube();
        shared[unit] = sum;
        sync_cube();
        distance *= 2;
    }
    shared[unit]
}

/// Scans 1024 values per workgroup and leaves their sum.
#[cube(launch)]
fn scan_cubes(values: &[u32], sums: &mut [u32], cube_sums: &mut [u32], len: u32) {
    let mut shared = Shared::<[u32]>::new_slice(UNITS as usize);
    let len = len as usize;
    let first = CUBE_POS * PER_CUBE as usize + UNIT_POS as usize * PER_UNIT as usize;
    let mut own = 0u32;
    for k in 0..PER_UNIT as usize {
        if first + k < len {
            own += values[first + k];
        }
    }
    let through = scan_units(&mut shared, own);
    let mut sum = through - own;
    for k in 0..PER_UNIT as usize {
        if first + k <= len {
            sums[first + k] = sum;
        }
        if first + k < len {
            sum += values[first + k];
        }
    }
    if UNIT_POS == UNITS - 1 && CUBE_POS < cube_sums.len() {
        cube_sums[CUBE_POS] = through;
    }
}

/// Adds to each workgroup's sums what came before it.
#[cube(launch)]
fn add_offsets(sums: &mut [u32], offsets: &[u32], len: u32) {
    let first = CUBE_POS * PER_CUBE as usize + UNIT_POS as usize;
    if CUBE_POS < offsets.len() {
        let offset = offsets[CUBE_POS];
        for k in 0..PER_UNIT as usize {
            let at = first + k * UNITS as usize;
            if at <= len as usize {
                sums[at] += offset;
            }
        }
    }
}
