//! Planes, filters with reflected borders, halving, colour and resizing, each with its adjoint, on a GPU. The mathematics
//! is that of [`crate::kernels::cpu::pyramid`].
//!
//! Planes are `[planes, height, width]` without reflected columns. Of a filter one workgroup computes 16 × 16 values, one
//! per unit, from 20 × 20 that it loads into workgroup memory, for all filters of a group at once; of everything else a unit
//! computes one value. Adjoints are gathers, so that sums have a fixed order.
//!
//! **Ends.** Workgroups beyond the last tile end at once; units of a tile that lie outside the plane load for the others
//! and write nothing. NaN spreads as arithmetic spreads it. No plane is empty.

mod resize;
#[cfg(test)]
mod tests;

pub(crate) use resize::Resize;

use crate::hvs::pyramid::FilterBank;
use crate::kernels::cpu::pyramid::{Filters as HostFilters, Kernel, RADIUS, flipped};
use crate::kernels::gpu::NUM_UNITS;
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::Result;
use gazesplat_render::gpu::{Gpu, cube_dim};

/// Side of the tile of a workgroup.
const TILE: usize = 16;
/// Side of what its filters reach.
const HALO: usize = TILE + 2 * RADIUS;
/// Values that they reach.
const REACHED: usize = HALO * HALO;
/// Taps of a filter.
const TAPS: usize = 25;
/// Filters that one pass applies: three make the most of what a tile loads, and their responses with everything that is
/// made of them stay within twelve planes.
pub(crate) const GROUP: usize = 3;

/// Planes of one level: `[num_planes, height, width]`.
#[derive(Debug, Clone)]
pub(crate) struct Planes {
    pub width: usize,
    pub height: usize,
    pub num_planes: usize,
    pub data: CubeTensor,
}

impl Planes {
    /// With undefined content.
    pub fn empty(gpu: &Gpu, width: usize, height: usize, num_planes: usize) -> Result<Self> {
        let data = gpu.empty("bytes of planes of a pyramid", &[num_planes, height, width], DType::F32)?;
        Ok(Self { width, height, num_planes, data })
    }

    /// Filled with zeros.
    pub fn zeros(gpu: &Gpu, width: usize, height: usize, num_planes: usize) -> Result<Self> {
        let data = gpu.zeros("bytes of planes of a pyramid", &[num_planes, height, width], DType::F32)?;
        Ok(Self { width, height, num_planes, data })
    }

    /// Number of values.
    pub fn len(&self) -> usize {
        self.width * self.height * self.num_planes
    }

    /// Memory of the values, bytes.
    pub fn num_bytes(&self) -> usize {
        self.len() * size_of::<f32>()
    }

    fn num_tiles(&self) -> usize {
        self.width.div_ceil(TILE) * self.height.div_ceil(TILE) * self.num_planes
    }
}

/// Filters that one pass applies, as they are and flipped.
#[derive(Debug, Clone)]
pub(crate) struct Group {
    pub num_filters: usize,
    antisymmetric: bool,
    taps: CubeTensor,
    flipped: CubeTensor,
}

impl Group {
    fn new(gpu: &Gpu, kernels: &[Kernel<f32>], antisymmetric: bool) -> Self {
        let shape = [kernels.len(), TAPS];
        let taps: Vec<f32> = kernels.iter().flatten().copied().collect();
        let turned: Vec<f32> = kernels.iter().flat_map(flipped).collect();
        Self {
            num_filters: kernels.len(),
            antisymmetric,
            taps: gpu.upload_f32(&taps, &shape),
            flipped: gpu.upload_f32(&turned, &shape),
        }
    }
}

/// A bank in groups.
#[derive(Debug, Clone)]
pub(crate) struct Filters {
    pub low: Group,
    pub high: Group,
    pub bands: Vec<Group>,
    /// The bands one by one.
    pub single_bands: Vec<Group>,
}

impl Filters {
    pub fn new(gpu: &Gpu, bank: &FilterBank) -> Self {
        let host = HostFilters::<f32>::new(bank);
        let groups = |size: usize| host.bands.chunks(size).map(|k| Group::new(gpu, k, host.antisymmetric)).collect();
        Self {
            low: Group::new(gpu, &[host.low], false),
            high: Group::new(gpu, &[host.high], false),
            bands: groups(GROUP),
            single_bands: groups(1),
        }
    }
}

/// Responses of a group of filters, filter by filter: `[num_filters × num_planes, height, width]`.
///
/// # Errors
/// [`gazesplat_render::Error::Limit`] when a buffer would be larger than the adapter takes.
pub(crate) fn correlate(gpu: &Gpu, planes: &Planes, group: &Group) -> Result<Planes> {
    let out = Planes::empty(gpu, planes.width, planes.height, group.num_filters * planes.num_planes)?;
    correlate_kernel::launch(
        &gpu.client,
        gpu.cubes(planes.num_tiles()),
        cube_dim(),
        planes.data.clone().into_buffer_arg(),
        group.taps.clone().into_buffer_arg(),
        out.data.clone().into_buffer_arg(),
        planes.width as u32,
        planes.height as u32,
        planes.num_planes as u32,
        group.num_filters,
        group.antisymmetric,
    );
    Ok(out)
}

/// Adds to `v_planes` the gradients by them, given those by the responses of a group, as [`correlate`] returns these.
pub(crate) fn correlate_bwd(gpu: &Gpu, v_out: &Planes, group: &Group, v_planes: &Planes) {
    correlate_bwd_kernel::launch(
        &gpu.client,
        gpu.cubes(v_planes.num_tiles()),
        cube_dim(),
        v_out.data.clone().into_buffer_arg(),
        group.flipped.clone().into_buffer_arg(),
        v_planes.data.clone().into_buffer_arg(),
        v_planes.width as u32,
        v_planes.height as u32,
        v_planes.num_planes as u32,
        group.num_filters as u32,
    );
}

/// 2 × 2 means.
///
/// # Errors
/// As [`correlate`].
pub(crate) fn halve(gpu: &Gpu, planes: &Planes) -> Result<Planes> {
    let half = Planes::empty(gpu, planes.width / 2, planes.height / 2, planes.num_planes)?;
    halve_kernel::launch(
        &gpu.client,
        gpu.units(half.len()),
        cube_dim(),
        planes.data.clone().into_buffer_arg(),
        half.data.clone().into_buffer_arg(),
        half.width as u32,
        half.len() as u32,
    );
    Ok(half)
}

/// The adjoint of [`halve`]: a quarter of every value of `v_half` for each of four.
///
/// # Errors
/// As [`correlate`].
pub(crate) fn halve_bwd(gpu: &Gpu, v_half: &Planes) -> Result<Planes> {
    let v_planes = Planes::empty(gpu, 2 * v_half.width, 2 * v_half.height, v_half.num_planes)?;
    halve_bwd_kernel::launch(
        &gpu.client,
        gpu.units(v_planes.len()),
        cube_dim(),
        v_half.data.clone().into_buffer_arg(),
        v_planes.data.clone().into_buffer_arg(),
        v_planes.width as u32,
        v_planes.len() as u32,
    );
    Ok(v_planes)
}

/// A tile and the pixel of this unit in it.
#[derive(CubeType)]
struct Tile {
    plane: usize,
    x: usize,
    y: usize,
    own_x: usize,
    own_y: usize,
}

/// The tile of this workgroup; `plane` is beyond the last for workgroups that have none.
#[cube]
fn own_tile(width: usize, height: usize) -> Tile {
    let across = width.div_ceil(TILE);
    let down = height.div_ceil(TILE);
    let unit = UNIT_POS as usize;
    let x = CUBE_POS % across * TILE;
    let y = CUBE_POS / across % down * TILE;
    Tile { plane: CUBE_POS / (across * down), x, y, own_x: x + unit % TILE, own_y: y + unit / TILE }
}

/// The index that lies `e` − 2 places from the first of `n` values, reflected at both ends without repeating them. What
/// lies farther out than a filter reaches is never used; it is read from some place inside.
#[cube]
fn reflected(e: usize, n: usize) -> usize {
    let d = select(e < RADIUS, RADIUS - e, e - RADIUS);
    let last = 2 * (n - 1);
    select(d < n, d, select(d <= last, last - d, 0usize))
}

#[cube(launch)]
fn correlate_kernel(
    planes: &[f32],
    taps: &[f32],
    out: &mut [f32],
    width: u32,
    height: u32,
    num_planes: u32,
    #[comptime] num_filters: usize,
    #[comptime] antisymmetric: bool,
) {
    let mut reached = Shared::<[f32]>::new_slice(REACHED);
    let mut shared_taps = Shared::<[f32]>::new_slice(comptime![num_filters * TAPS]);
    let (width, height) = (width as usize, height as usize);
    let tile = own_tile(width, height);
    if tile.plane >= num_planes as usize {
        terminate!();
    }
    let unit = UNIT_POS as usize;
    let size = width * height;
    // 1. The tile with what its filters reach, and the taps.
    let mut i = unit;
    while i < REACHED {
        let x = reflected(tile.x + i % HALO, width);
        let y = reflected(tile.y + i / HALO, height);
        reached[i] = planes[tile.plane * size + y * width + x];
        i += NUM_UNITS;
    }
    if unit < comptime![num_filters * TAPS] {
        shared_taps[unit] = taps[unit];
    }
    sync_cube();
    // 2. Responses. Opposite taps of bands differ in sign: twelve differences serve all filters.
    if tile.own_x < width && tile.own_y < height {
        let at = unit / TILE * HALO + unit % TILE;
        let pixel = tile.own_y * width + tile.own_x;
        let mut sums = Array::<f32>::new(num_filters);
        #[unroll]
        for o in 0..num_filters {
            sums[o] = 0.0_f32;
        }
        #[unroll]
        for t in 0..comptime!(if antisymmetric { TAPS / 2 } else { TAPS }) {
            let mut value = reached[at + comptime![t / 5 * HALO + t % 5]];
            if comptime![antisymmetric] {
                value -= reached[at + comptime![(24 - t) / 5 * HALO + (24 - t) % 5]];
            }
            #[unroll]
            for o in 0..num_filters {
                sums[o] += shared_taps[comptime![o * TAPS + t]] * value;
            }
        }
        #[unroll]
        for o in 0..num_filters {
            out[(o * num_planes as usize + tile.plane) * size + pixel] = sums[o];
        }
    }
}

#[cube(launch)]
fn correlate_bwd_kernel(
    v_out: &[f32],
    flipped: &[f32],
    v_planes: &mut [f32],
    width: u32,
    height: u32,
    num_planes: u32,
    num_filters: u32,
) {
    let mut reached = Shared::<[f32]>::new_slice(REACHED);
    let (width, height) = (width as usize, height as usize);
    let tile = own_tile(width, height);
    if tile.plane >= num_planes as usize {
        terminate!();
    }
    let unit = UNIT_POS as usize;
    let size = width * height;
    let is_inside = tile.own_x < width && tile.own_y < height;
    let mut sum = 0.0_f32;
    for o in 0..num_filters as usize {
        // 1. Gradients by the responses of one filter around the tile, zero outside the plane.
        sync_cube();
        let mut i = unit;
        while i < REACHED {
            let x = tile.x + i % HALO;
            let y = tile.y + i / HALO;
            let is_value = x >= RADIUS && y >= RADIUS && x < width + RADIUS && y < height + RADIUS;
            let mut value = 0.0_f32;
            if is_value {
                let plane = o * num_planes as usize + tile.plane;
                value = v_out[plane * size + (y - RADIUS) * width + x - RADIUS];
            }
            reached[i] = value;
            i += NUM_UNITS;
        }
        sync_cube();
        // 2. The flipped filter at the pixel itself and at the places beyond the borders that mirror it. Places are
        // counted from the corner of what the tile reaches, so that those beyond the border are not negative.
        if is_inside {
            for b in 0..3usize {
                let row = mirror(b, tile.own_y, height);
                for a in 0..3usize {
                    let column = mirror(a, tile.own_x, width);
                    if row.exists && column.exists {
                        for t in 0..TAPS {
                            // In coordinates that are four more than those of the plane.
                            let y = row.place + t / 5;
                            let x = column.place + t % 5;
                            let is_reached =
                                y >= tile.y + 4 && x >= tile.x + 4 && y < tile.y + HALO + 4 && x < tile.x + HALO + 4;
                            if is_reached {
                                sum += flipped[o * TAPS + t] * reached[(y - tile.y - 4) * HALO + x - tile.x - 4];
                            }
                        }
                    }
                }
            }
        }
    }
    if is_inside {
        v_planes[tile.plane * size + tile.own_y * width + tile.own_x] += sum;
    }
}

/// A place along one axis that takes the value at some index.
#[derive(CubeType)]
struct Mirror {
    exists: bool,
    /// Four more than the place, which may be −2.
    place: usize,
}

/// Place `which` of three that take the value at `i` of `n`: itself, beyond the first end, beyond the last.
#[cube]
fn mirror(which: usize, i: usize, n: usize) -> Mirror {
    let is_first = which == 1 && i != 0 && i <= RADIUS;
    let is_last = which == 2 && i + RADIUS + 1 >= n && i + 2 <= n;
    let place = select(is_first, 4 - select(is_first, i, 0usize), select(is_last, 2 * (n - 1) + 4 - i, i + 4));
    Mirror { exists: which == 0 || is_first || is_last, place }
}

#[cube(launch)]
fn halve_kernel(planes: &[f32], half: &mut [f32], half_width: u32, len: u32) {
    if ABSOLUTE_POS < len as usize {
        let half_width = half_width as usize;
        // Rows of all planes lie one behind the other and every plane has an even number of them.
        let upper = ABSOLUTE_POS / half_width * (4 * half_width) + ABSOLUTE_POS % half_width * 2;
        let lower = upper + 2 * half_width;
        half[ABSOLUTE_POS] = ((planes[upper] + planes[upper + 1]) + (planes[lower] + planes[lower + 1])) * 0.25_f32;
    }
}

#[cube(launch)]
fn halve_bwd_kernel(v_half: &[f32], v_planes: &mut [f32], width: u32, len: u32) {
    if ABSOLUTE_POS < len as usize {
        let width = width as usize;
        let (x, y) = (ABSOLUTE_POS % width, ABSOLUTE_POS / width);
        v_planes[ABSOLUTE_POS] = 0.25_f32 * v_half[y / 2 * (width / 2) + x / 2];
    }
}
