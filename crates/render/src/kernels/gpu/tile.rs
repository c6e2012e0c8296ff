//! What the forward and backward rasterisers share: a tile's pixels, and its splats staged in workgroup memory.
//!
//! One workgroup per tile, one unit per pixel.

use crate::gpu::UNITS;
use crate::kernels::cpu::bin::TileGrid;
use crate::layout::{TILE, lane};
use crate::math::alpha::log2_conic;
use crate::math::vec::Sym2;
use crate::termination::ColorMax;
use cubecl::prelude::*;

const _: () = assert!(TILE * TILE == UNITS as usize, "one unit per pixel of a tile");

/// Values of a staged splat: mean relative to the tile's corner, scaled conic, log2 of the opacity, RGB, depth.
pub const STAGED: usize = 10;

/// What every kernel over tiles is told about the image and its options.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
pub struct TileArgs {
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Tiles per row.
    pub tiles_x: u32,
    /// Tiles.
    pub num_tiles: u32,
    /// Clamp of α.
    pub alpha_max: f32,
    /// A pixel stops before the splat that would bring T to this or below.
    pub t_stop: f32,
    /// Cells of the termination table along each axis; 0 without one.
    pub lut_size: u32,
    /// Its largest limit.
    pub lut_largest: f32,
    /// Bound of the hidden channels before those of the tile's splats are looked at: 1, and with the tile's the background.
    pub color_max: f32,
    /// Background, red.
    pub background_r: f32,
    /// Background, green.
    pub background_g: f32,
    /// Background, blue.
    pub background_b: f32,
}

/// The arguments for an image.
pub fn tile_args(grid: &TileGrid, options: &crate::kernels::cpu::rasterize::RasterOptions) -> TileArgsLaunch {
    let [r, g, b] = options.background;
    let (mut lut_size, mut lut_largest, mut color_max) = (0, 0.0, 1.0);
    if let Some(lut) = &options.lut {
        (lut_size, lut_largest) = (lut.size() as u32, lut.largest_limit());
        if lut.color_max() == ColorMax::Tile {
            color_max = options.background.iter().copied().fold(1.0, f32::max);
        }
    }
    TileArgsLaunch::new(
        grid.width,
        grid.height,
        grid.tiles_x,
        grid.len() as u32,
        options.alpha_max,
        options.t_stop,
        lut_size,
        lut_largest,
        color_max,
        r,
        g,
        b,
    )
}

/// The pixel of a unit.
#[derive(CubeType, Clone, Copy)]
pub struct Pixel {
    /// Left edge of the tile, pixels.
    pub x0: u32,
    /// Upper edge of the tile, pixels.
    pub y0: u32,
    /// Centre relative to the tile's corner, x.
    pub center_x: f32,
    /// Centre relative to the tile's corner, y.
    pub center_y: f32,
    /// Row-major index in the image.
    pub index: u32,
    /// Whether the pixel lies in the image.
    pub is_inside: bool,
}

/// The pixel of this unit in tile `tile`.
#[cube]
pub fn pixel(args: &TileArgs, tile: u32) -> Pixel {
    let side = TILE as u32;
    let x0 = (tile % args.tiles_x) * side;
    let y0 = (tile / args.tiles_x) * side;
    let (column, row) = (UNIT_POS % side, UNIT_POS / side);
    Pixel {
        x0,
        y0,
        center_x: f32::cast_from(column) + 0.5_f32,
        center_y: f32::cast_from(row) + 0.5_f32,
        index: (y0 + row) * args.width + x0 + column,
        is_inside: x0 + column < args.width && y0 + row < args.height,
    }
}

/// Stages splat `splat` in slot `slot` of `staged`, which holds `capacity` splats, value by value.
#[cube]
pub fn stage(
    lanes: &[f32],
    splat: u32,
    p: &Pixel,
    staged: &mut Shared<[f32]>,
    slot: usize,
    #[comptime] capacity: usize,
) {
    let row = splat as usize * lane::COUNT;
    let conic = log2_conic(Sym2 {
        xx: lanes[row + lane::CONIC_XX],
        xy: lanes[row + lane::CONIC_XY],
        yy: lanes[row + lane::CONIC_YY],
    });
    staged[slot] = lanes[row + lane::MEAN_X] - f32::cast_from(p.x0);
    staged[capacity + slot] = lanes[row + lane::MEAN_Y] - f32::cast_from(p.y0);
    staged[2 * capacity + slot] = conic.xx;
    staged[3 * capacity + slot] = conic.xy;
    staged[4 * capacity + slot] = conic.yy;
    staged[5 * capacity + slot] = lanes[row + lane::LOG2_OPACITY];
    staged[6 * capacity + slot] = lanes[row + lane::RED];
    staged[7 * capacity + slot] = lanes[row + lane::RED + 1];
    staged[8 * capacity + slot] = lanes[row + lane::RED + 2];
    staged[9 * capacity + slot] = lanes[row + lane::DEPTH];
}

/// One staged splat.
#[derive(CubeType, Clone, Copy)]
pub struct StagedSplat {
    /// Mean relative to the tile's corner, x, pixels.
    pub mean_x: f32,
    /// Mean relative to the tile's corner, y, pixels.
    pub mean_y: f32,
    /// Conic scaled to base-2 logarithms.
    pub conic: Sym2,
    /// log2 of the opacity.
    pub log2_opacity: f32,
}

/// The geometry of the splat in slot `slot`.
#[cube]
pub fn staged_splat(staged: &Shared<[f32]>, slot: usize, #[comptime] capacity: usize) -> StagedSplat {
    StagedSplat {
        mean_x: staged[slot],
        mean_y: staged[capacity + slot],
        conic: Sym2 {
            xx: staged[2 * capacity + slot],
            xy: staged[3 * capacity + slot],
            yy: staged[4 * capacity + slot],
        },
        log2_opacity: staged[5 * capacity + slot],
    }
}
