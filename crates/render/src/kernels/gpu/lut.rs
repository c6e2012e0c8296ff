//! What the rasterisers do with a termination table: reading it, asking it, and what becomes of the rest.
//!
//! Device functions; one unit per pixel. A table of up to 512 entries is copied into workgroup memory, where
//! the 256 pixels of a tile read different entries at no cost; a larger one stays in its buffer.

use super::tile::TileArgs;
use crate::gpu::{Gpu, UNITS};
use crate::kernels::cpu::rasterize::RasterOptions;
use crate::termination::{BELOW_ONE, ColorMax, Residual, TerminationLut};
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Entries that are kept in workgroup memory: 8³, 2 KiB beside the staged splats.
const IN_WORKGROUP: usize = 512;

/// How kernels are compiled for a table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct LutUse {
    residual: Residual,
    color_max: ColorMax,
    is_in_workgroup: bool,
}

impl LutUse {
    /// For the table of these options; `None` without one.
    pub fn of(options: &RasterOptions) -> Option<Self> {
        options.lut.as_ref().map(|lut| Self {
            residual: lut.residual(),
            color_max: lut.color_max(),
            is_in_workgroup: lut.values().len() <= IN_WORKGROUP,
        })
    }

    fn uses_tile_maximum(self) -> bool {
        self.color_max == ColorMax::Tile
    }
}

/// The limits of a table as a buffer.
pub fn limits(gpu: &Gpu, lut: &TerminationLut) -> CubeTensor {
    gpu.upload_f32(lut.limits(), &[lut.limits().len()])
}

/// The table as a tile sees it.
#[derive(CubeType)]
pub struct TileLut {
    /// The entries, where they fit; else one unused word.
    entries: Shared<[f32]>,
    /// Bound of the hidden channels.
    color_max: f32,
}

/// Copies the table for the tile of this workgroup; ends with a barrier.
#[cube]
pub fn tile_lut(limits: &[f32], color_max: &[u32], args: &TileArgs, #[comptime] lut: Option<LutUse>) -> TileLut {
    let in_workgroup = comptime!(lut.is_some_and(|l| l.is_in_workgroup));
    let mut entries = Shared::<[f32]>::new_slice(comptime!(if in_workgroup { IN_WORKGROUP } else { 1usize }));
    let mut bound = args.color_max;
    if comptime!(lut.is_some_and(LutUse::uses_tile_maximum)) {
        bound = f32::max(bound, f32::reinterpret(color_max[CUBE_POS]));
    }
    if comptime!(in_workgroup) {
        let count = args.lut_size * args.lut_size * args.lut_size;
        for i in range_stepped(UNIT_POS, count, UNITS) {
            entries[i as usize] = limits[i as usize];
        }
        sync_cube();
    }
    TileLut { entries, color_max: bound }
}

/// Whether a pixel stops because the rest cannot be seen: T·c_max ≤ γ·LUT(C) (JND Sec. 3).
#[cube]
pub fn below_limit(
    table: &TileLut,
    limits: &[f32],
    args: &TileArgs,
    t: f32,
    red: f32,
    green: f32,
    blue: f32,
    #[comptime] lut: Option<LutUse>,
) -> bool {
    let left = t * table.color_max;
    let mut is_below = false;
    // No entry is larger, so above this line no pixel stops, whatever its colour.
    if left <= args.lut_largest {
        let size = args.lut_size;
        let at = (cell(red, size) * size + cell(green, size)) * size + cell(blue, size);
        if comptime!(lut.is_some_and(|l| l.is_in_workgroup)) {
            is_below = left <= table.entries[at as usize];
        } else {
            is_below = left <= limits[at as usize];
        }
    }
    is_below
}

/// Cell of a channel.
#[cube]
fn cell(value: f32, size: u32) -> u32 {
    let clamped = f32::clamp(value, 0.0_f32, BELOW_ONE);
    u32::min(u32::cast_from(clamped * f32::cast_from(size)), size - 1u32)
}

/// What a pixel that stopped receives per unit of the transmittance left; `color` is what it has composited.
#[cube]
pub fn residual(table: &TileLut, t: f32, color: f32, background: f32, #[comptime] lut: Option<LutUse>) -> f32 {
    let mut rest = background;
    match comptime!(lut.map_or(Residual::Background, |l| l.residual)) {
        Residual::Drop => {
            rest = 0.0_f32;
        }
        Residual::Background => {}
        // A pixel that stopped at once has seen nothing: 0 / ε.
        Residual::Mean => {
            rest = color / f32::max(1.0_f32 - t, f32::EPSILON);
        }
        Residual::Centre => {
            rest = 0.5_f32 * table.color_max;
        }
    }
    rest
}
