//! What the passes of the loss share: tiles and their reach in workgroup memory, windows along both axes, sums.
//!
//! A plane of raw values has 26 rows of 26; windowed along columns it has 16 rows of 26, along rows as well 16 of 16. Units
//! that have no window to compute skip it; barriers are left to the callers, except in [`reduced`].

use super::TargetFormat;
use crate::kernels::cpu::l1_ssim::{RADIUS, TAPS, WINDOW};
use cubecl::prelude::*;
use gazesplat_render::gpu::UNITS;

/// Side of the tile of a workgroup, pixels.
pub(super) const TILE: usize = 16;
/// Side of what its windows reach.
pub(super) const HALO: usize = TILE + 2 * RADIUS;
/// Pixels that its windows reach.
pub(super) const REACHED: usize = HALO * HALO;
/// Values windowed along columns: 16 rows of 26.
pub(super) const BLURRED: usize = TILE * HALO;
/// Pixels of a tile.
pub(super) const TILE_PIXELS: usize = TILE * TILE;
/// Neighbouring windows of one unit: they share what they load, 14 values instead of 44.
pub(super) const RUN: usize = 4;
/// Values that a run of windows reaches.
pub(super) const RUN_REACHED: usize = RUN + 2 * RADIUS;
/// Runs of a column or row of a tile.
pub(super) const RUNS: usize = TILE / RUN;
/// Units, as a length.
pub(super) const NUM_UNITS: usize = UNITS as usize;

/// The upper left pixel of a workgroup's tile.
#[derive(CubeType)]
pub(super) struct Tile {
    pub(super) x: usize,
    pub(super) y: usize,
}

/// The tile of this workgroup; outside the image for those beyond the last.
#[cube]
pub(super) fn own_tile(width: u32) -> Tile {
    let tiles_across = (width as usize).div_ceil(TILE);
    Tile { x: CUBE_POS % tiles_across * TILE, y: CUBE_POS / tiles_across * TILE }
}

/// A pixel, if the image has it.
#[derive(CubeType)]
pub(super) struct Place {
    pub(super) pixel: usize,
    pub(super) in_image: bool,
}

/// Value `i` of the reach of a tile, whose upper left corner lies 5 pixels outside.
#[cube]
pub(super) fn place_of(i: usize, tile: &Tile, width: u32, height: u32) -> Place {
    let (width, height) = (width as usize, height as usize);
    let x = tile.x + i % HALO;
    let y = tile.y + i / HALO;
    let in_image = x >= RADIUS && y >= RADIUS && x < width + RADIUS && y < height + RADIUS;
    let pixel = select(in_image, (y - RADIUS) * width + x - RADIUS, 0usize);
    Place { pixel, in_image }
}

/// A component of the target's colour on the scale 0..1.
#[cube]
pub(super) fn target_value(target: &[u32], pixel: usize, channel: u32, #[comptime] format: TargetFormat) -> f32 {
    if comptime![format == TargetFormat::Floats] {
        f32::reinterpret(target[pixel * 3 + channel as usize])
    } else {
        f32::cast_from((target[pixel] >> (8 * channel)) & 0xffu32) * (1.0_f32 / 255.0_f32)
    }
}

/// True if the pixel carries no loss.
#[cube]
pub(super) fn is_masked(target: &[u32], pixel: usize, #[comptime] format: TargetFormat) -> bool {
    if comptime![format == TargetFormat::Floats] { false.runtime() } else { (target[pixel] >> 24u32) == 0u32 }
}

/// Two sums over the units of a workgroup.
#[derive(CubeType)]
pub(super) struct Sums {
    pub(super) l1: f32,
    pub(super) ssim: f32,
}

/// Sums over the units of a workgroup, by halves; every unit must call it. `shared` holds two values per unit.
#[cube]
pub(super) fn reduced(shared: &mut Shared<[f32]>, l1: f32, ssim: f32) -> Sums {
    let unit = UNIT_POS as usize;
    sync_cube();
    shared[unit] = l1;
    shared[NUM_UNITS + unit] = ssim;
    sync_cube();
    let mut half = (NUM_UNITS / 2).runtime();
    while half > 0 {
        if unit < half {
            shared[unit] += shared[unit + half];
            shared[NUM_UNITS + unit] += shared[NUM_UNITS + unit + half];
        }
        sync_cube();
        half /= 2;
    }
    Sums { l1: shared[0], ssim: shared[NUM_UNITS] }
}

/// Windows along columns of x, y, x² + y² and xy: planes of 26 × 26 become planes of 16 rows of 26.
#[cube]
pub(super) fn blur_moments(raw: &Shared<[f32]>, blurred: &mut Shared<[f32]>) {
    let unit = UNIT_POS as usize;
    if unit < HALO * RUNS {
        let column = unit % HALO;
        let first = unit / HALO * RUN;
        let mut a = Array::<f32>::new(RUN);
        let mut b = Array::<f32>::new(RUN);
        let mut q = Array::<f32>::new(RUN);
        let mut p = Array::<f32>::new(RUN);
        #[unroll]
        for o in 0..RUN {
            a[o] = 0.0_f32;
            b[o] = 0.0_f32;
            q[o] = 0.0_f32;
            p[o] = 0.0_f32;
        }
        #[unroll]
        for k in 0..RUN_REACHED {
            let x = raw[(first + k) * HALO + column];
            let y = raw[REACHED + (first + k) * HALO + column];
            let squares = x * x + y * y;
            let product = x * y;
            #[unroll]
            for o in 0..RUN {
                if comptime![k >= o && k - o < TAPS] {
                    let w = comptime![WINDOW[k - o]];
                    a[o] += w * x;
                    b[o] += w * y;
                    q[o] += w * squares;
                    p[o] += w * product;
                }
            }
        }
        #[unroll]
        for o in 0..RUN {
            let to = (first + o) * HALO + column;
            blurred[to] = a[o];
            blurred[BLURRED + to] = b[o];
            blurred[2 * BLURRED + to] = q[o];
            blurred[3 * BLURRED + to] = p[o];
        }
    }
}

/// Windows along columns of three maps: planes of 26 × 26 become planes of 16 rows of 26.
#[cube]
pub(super) fn blur_maps(maps: &Shared<[f32]>, blurred: &mut Shared<[f32]>) {
    let mut run = UNIT_POS as usize;
    while run < 3 * HALO * RUNS {
        let map = run / (HALO * RUNS);
        let column = run % HALO;
        let first = run / HALO % RUNS * RUN;
        let mut sums = Array::<f32>::new(RUN);
        #[unroll]
        for o in 0..RUN {
            sums[o] = 0.0_f32;
        }
        #[unroll]
        for k in 0..RUN_REACHED {
            let value = maps[map * REACHED + (first + k) * HALO + column];
            #[unroll]
            for o in 0..RUN {
                if comptime![k >= o && k - o < TAPS] {
                    sums[o] += comptime![WINDOW[k - o]] * value;
                }
            }
        }
        #[unroll]
        for o in 0..RUN {
            blurred[map * BLURRED + (first + o) * HALO + column] = sums[o];
        }
        run += NUM_UNITS;
    }
}

/// Windows along rows of at most four planes of 16 rows of 26, which become planes of 16 × 16.
#[cube]
pub(super) fn blur_rows(blurred: &Shared<[f32]>, windowed: &mut Shared<[f32]>, #[comptime] num_planes: usize) {
    let unit = UNIT_POS as usize;
    if unit < num_planes * TILE * RUNS {
        let plane = unit / (TILE * RUNS);
        let row = unit / RUNS % TILE;
        let first = unit % RUNS * RUN;
        let mut sums = Array::<f32>::new(RUN);
        #[unroll]
        for o in 0..RUN {
            sums[o] = 0.0_f32;
        }
        #[unroll]
        for k in 0..RUN_REACHED {
            let value = blurred[plane * BLURRED + row * HALO + first + k];
            #[unroll]
            for o in 0..RUN {
                if comptime![k >= o && k - o < TAPS] {
                    sums[o] += comptime![WINDOW[k - o]] * value;
                }
            }
        }
        #[unroll]
        for o in 0..RUN {
            windowed[plane * TILE_PIXELS + row * TILE + first + o] = sums[o];
        }
    }
}
