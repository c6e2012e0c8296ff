//! Binning: the front-to-back list of splats of every 16 × 16 tile.
//!
//! [`crate::math::tile`] defines what a pair is; counting and emitting read the same spans, so they cannot disagree.
//! The visible splats are sorted by depth first; from then on a splat's index is its rank. Each emits its pairs one
//! behind the other (its records), in that order, and a stable sort by tile makes front-to-back lists of them. The
//! frame's one read-back lies between counting and emitting: buffers of pairs are sized by what is there.
//!
//! One unit per splat, or per pair. No splats, no pairs, no visible Gaussian: empty lists.

use super::project::{GaussianBuffers, NON_FINITE_DEPTH, Projected};
use super::scan::exclusive_scan;
use super::sort::{depth_order, radix_sort};
use crate::error::{Error, Result};
use crate::gpu::{Gpu, UNITS, cube_dim};
use crate::kernels::cpu::bin::TileGrid;
use crate::layout::{MAX_PAIRS, lane};
use crate::math::alpha::contour_power2;
use crate::math::conic::{Boundary, boundary};
use crate::math::tile::{TileSpan, tile_span, tiles_touched};
use crate::math::vec::Sym2;
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Most tiles of an image: 256 splats that reach all of them still have less than 2³² pairs.
const MAX_TILES: usize = (1 << 24) - 1;

/// Places in the buffer of counters that is read back.
mod counter {
    /// Visible splats V.
    pub const VISIBLE: usize = 0;
    /// Gaussians culled for values that are not finite.
    pub const NON_FINITE: usize = 1;
    /// Pairs, low word; the high word follows.
    pub const PAIRS: usize = 2;
    /// Pairs of bounding boxes, low word; the high word follows.
    pub const PAIRS_BOX: usize = 4;
    /// Words in all.
    pub const COUNT: usize = 6;
}

/// Front-to-back lists of all tiles.
pub struct TileLists {
    /// The tiles.
    pub grid: TileGrid,
    /// Lanes of the visible splats, by depth, `[V, 12]`.
    pub lanes: CubeTensor,
    /// Gaussian of each splat, `[V]`.
    pub global_from_compact: CubeTensor,
    /// Start of each tile's list, row-major tiles, `[tiles + 1]`.
    pub tile_offsets: CubeTensor,
    /// Splat and record of each pair, `[P, 2]`.
    pub pairs: CubeTensor,
    /// Bits of the largest colour channel of each tile's splats where it exceeds 1, else 0, `[tiles]`. Empty unless asked
    /// for.
    pub color_max: CubeTensor,
    /// First record of each splat, `[V + 1]` or longer.
    pub record_offsets: CubeTensor,
    /// Number of splats V.
    pub num_visible: usize,
    /// Number of pairs P.
    pub num_pairs: usize,
    /// Pairs a test of bounding boxes would give.
    pub num_pairs_box: u64,
    /// Gaussians culled for values that are not finite.
    pub num_non_finite: u64,
}

/// Builds the lists of all tiles; `wants_maximum` fills [`TileLists::color_max`].
///
/// # Errors
/// [`Error::Limit`] if there are more pairs than indices, or a buffer would be larger than the adapter takes;
/// [`Error::Device`] when the adapter does not answer.
pub fn bin(
    gpu: &Gpu,
    g: &GaussianBuffers,
    projected: &Projected,
    grid: TileGrid,
    wants_maximum: bool,
) -> Result<TileLists> {
    let n = g.len;
    let Projected { lanes, visible_offsets } = projected;
    if grid.len() > MAX_TILES {
        return Err(Error::Limit { what: "tiles of an image", needed: grid.len() as u64, limit: MAX_TILES as u64 });
    }
    let counters = gpu.zeros("bytes of counters", &[counter::COUNT], DType::U32)?;
    // 1. The visible splats, front to back.
    let keys = gpu.empty("bytes of sort keys", &[n], DType::U32)?;
    let ids = gpu.empty("bytes of splat indices", &[n], DType::U32)?;
    compact::launch(
        &gpu.client,
        gpu.units(n.max(1)),
        cube_dim(),
        lanes.clone().into_buffer_arg(),
        visible_offsets.clone().into_buffer_arg(),
        keys.clone().into_buffer_arg(),
        ids.clone().into_buffer_arg(),
        counters.clone().into_buffer_arg(),
        n as u32,
    );
    let global_from_compact = depth_order(gpu, keys, ids, n, visible_offsets, n)?;
    // 2. Pairs of each splat; their records begin where those of the splats before end.
    let num_tiles = gpu.empty("bytes of tile counts", &[n], DType::U32)?;
    count_tiles::launch(
        &gpu.client,
        gpu.units(n.max(1)),
        cube_dim(),
        lanes.clone().into_buffer_arg(),
        visible_offsets.clone().into_buffer_arg(),
        global_from_compact.clone().into_buffer_arg(),
        num_tiles.clone().into_buffer_arg(),
        counters.clone().into_buffer_arg(),
        n as u32,
        grid.width as f32,
        grid.height as f32,
        grid.tiles_x as f32,
        grid.tiles_y as f32,
    );
    let record_offsets = exclusive_scan(gpu, &num_tiles, n)?;
    // 3. The one read-back of a frame.
    let counted = gpu.read_u32(&counters)?;
    let wide = |at: usize| u64::from(counted[at]) | u64::from(counted[at + 1]) << 32;
    let (needed, num_pairs_box) = (wide(counter::PAIRS), wide(counter::PAIRS_BOX));
    if needed.max(num_pairs_box) > MAX_PAIRS {
        let needed = needed.max(num_pairs_box);
        return Err(Error::Limit { what: "(Gaussian, tile) pairs", needed, limit: MAX_PAIRS });
    }
    let (num_visible, num_pairs) = (counted[counter::VISIBLE] as usize, needed as usize);
    // 4. Pairs in the order of their splats, then by tile.
    let compact_lanes = gpu.empty("bytes of visible lanes", &[num_visible, lane::COUNT], DType::F32)?;
    let pair_tiles = gpu.empty("bytes of pairs", &[num_pairs], DType::U32)?;
    let pair_splats = gpu.empty("bytes of pairs", &[num_pairs], DType::U32)?;
    let pair_records = gpu.empty("bytes of pairs", &[num_pairs], DType::U32)?;
    if num_visible > 0 {
        emit::launch(
            &gpu.client,
            gpu.units(num_visible),
            cube_dim(),
            lanes.clone().into_buffer_arg(),
            global_from_compact.clone().into_buffer_arg(),
            record_offsets.clone().into_buffer_arg(),
            compact_lanes.clone().into_buffer_arg(),
            pair_tiles.clone().into_buffer_arg(),
            pair_splats.clone().into_buffer_arg(),
            pair_records.clone().into_buffer_arg(),
            num_visible as u32,
            grid.width as f32,
            grid.height as f32,
            grid.tiles_x as f32,
            grid.tiles_y as f32,
        );
    }
    // One number more than there are tiles: see `emit`.
    let tile_bits = usize::BITS - grid.len().leading_zeros();
    let (pair_tiles, pair_records) =
        radix_sort(gpu, pair_tiles, pair_records, num_pairs, &record_offsets, n, tile_bits)?;
    // 5. Lists: where each tile's begins, and what stands in them.
    let tile_offsets = gpu.zeros("bytes of tile offsets", &[grid.len() + 1], DType::U32)?;
    let pairs = gpu.empty("bytes of pairs", &[num_pairs, 2], DType::U32)?;
    let num_maxima = if wants_maximum { grid.len() } else { 0 };
    let color_max = gpu.zeros("bytes of tile maxima", &[num_maxima], DType::U32)?;
    if num_pairs > 0 {
        list_pairs::launch(
            &gpu.client,
            gpu.units(num_pairs),
            cube_dim(),
            pair_tiles.into_buffer_arg(),
            pair_records.into_buffer_arg(),
            pair_splats.into_buffer_arg(),
            pairs.clone().into_buffer_arg(),
            tile_offsets.clone().into_buffer_arg(),
            compact_lanes.clone().into_buffer_arg(),
            color_max.clone().into_buffer_arg(),
            num_pairs as u32,
            grid.len() as u32,
            wants_maximum,
        );
    }
    Ok(TileLists {
        grid,
        lanes: compact_lanes,
        global_from_compact,
        tile_offsets,
        pairs,
        color_max,
        record_offsets,
        num_visible,
        num_pairs,
        num_pairs_box,
        num_non_finite: u64::from(counted[counter::NON_FINITE]),
    })
}

/// The visible Gaussians one behind the other: depth bits (positive, so they order like the depths) and index.
#[cube(launch)]
fn compact(
    lanes: &[f32],
    visible_offsets: &[u32],
    keys: &mut [u32],
    ids: &mut [u32],
    counters: &[Atomic<u32>],
    num_splats: u32,
) {
    let i = ABSOLUTE_POS;
    let n = num_splats as usize;
    if i == 0 {
        counters[counter::VISIBLE].store(visible_offsets[n]);
    }
    if i < n {
        let depth = lanes[i * lane::COUNT + lane::DEPTH];
        if depth == NON_FINITE_DEPTH {
            counters[counter::NON_FINITE].fetch_add(1u32);
        }
        let to = visible_offsets[i];
        if visible_offsets[i + 1] > to {
            keys[to as usize] = u32::reinterpret(depth);
            ids[to as usize] = i as u32;
        }
    }
}

/// The lanes of a splat that say where it lies.
#[derive(CubeType, Clone, Copy)]
struct Place {
    contour: Boundary,
    mean_x: f32,
    mean_y: f32,
    extent_x: f32,
    extent_y: f32,
}

/// The boundary of a splat's contour α = 1/255, around its mean.
#[cube]
fn place(lanes: &[f32], row: usize) -> Place {
    let conic =
        Sym2 { xx: lanes[row + lane::CONIC_XX], xy: lanes[row + lane::CONIC_XY], yy: lanes[row + lane::CONIC_YY] };
    let extent_x = lanes[row + lane::EXTENT_X];
    let extent_y = lanes[row + lane::EXTENT_Y];
    let power2 = contour_power2(lanes[row + lane::LOG2_OPACITY]);
    Place {
        contour: boundary(conic, power2, extent_x, extent_y),
        mean_x: lanes[row + lane::MEAN_X],
        mean_y: lanes[row + lane::MEAN_Y],
        extent_x,
        extent_y,
    }
}

/// Rows of tiles the ellipse of a splat meets.
#[cube]
fn tile_rows(p: &Place, height: f32, tiles_y: f32) -> TileSpan {
    tiles_touched(p.mean_y - p.extent_y, p.mean_y + p.extent_y, height, tiles_y)
}

/// Tiles of each splat; their sum and that of the bounding boxes, in 64 bits.
#[cube(launch)]
fn count_tiles(
    lanes: &[f32],
    visible_offsets: &[u32],
    ids: &[u32],
    num_tiles: &mut [u32],
    counters: &[Atomic<u32>],
    num_splats: u32,
    width: f32,
    height: f32,
    tiles_x: f32,
    tiles_y: f32,
) {
    let sums = Shared::<[Atomic<u32>]>::new_slice(2usize);
    if UNIT_POS < 2 {
        sums[UNIT_POS as usize].store(0u32);
    }
    sync_cube();
    let r = ABSOLUTE_POS;
    let n = num_splats as usize;
    if r < n {
        let mut count = 0u32;
        if r < visible_offsets[n] as usize {
            let p = place(lanes, ids[r] as usize * lane::COUNT);
            let rows = tile_rows(&p, height, tiles_y);
            for row in u32::cast_from(rows.first)..u32::cast_from(rows.end) {
                let span = tile_span(p.contour, p.mean_x, p.mean_y, f32::cast_from(row), width, height, tiles_x);
                count += u32::cast_from(span.end - span.first);
            }
            let columns = tiles_touched(p.mean_x - p.extent_x, p.mean_x + p.extent_x, width, tiles_x);
            let in_box = u32::cast_from(columns.end - columns.first) * u32::cast_from(rows.end - rows.first);
            sums[0].fetch_add(count);
            sums[1].fetch_add(in_box);
        }
        num_tiles[r] = count;
    }
    sync_cube();
    // The sum of 256 splats fits 32 bits: an image has at most MAX_TILES tiles. A wrapped low word carries.
    if UNIT_POS < 2 {
        let sum = sums[UNIT_POS as usize].load();
        let low = (UNIT_POS * 2) as usize + counter::PAIRS;
        let before = counters[low].fetch_add(sum);
        // Device arithmetic wraps: the sum is smaller than what was there iff it has.
        let after = before + sum;
        if after < before {
            counters[low + 1].fetch_add(1u32);
        }
    }
}

/// Lanes of each splat in the order of depths, and its pairs.
#[cube(launch)]
fn emit(
    lanes: &[f32],
    ids: &[u32],
    record_offsets: &[u32],
    compact_lanes: &mut [f32],
    pair_tiles: &mut [u32],
    pair_splats: &mut [u32],
    pair_records: &mut [u32],
    num_visible: u32,
    width: f32,
    height: f32,
    tiles_x: f32,
    tiles_y: f32,
) {
    let r = ABSOLUTE_POS;
    if r < num_visible as usize {
        let from = ids[r] as usize * lane::COUNT;
        for l in 0..lane::COUNT {
            compact_lanes[r * lane::COUNT + l] = lanes[from + l];
        }
        let p = place(lanes, from);
        let rows = tile_rows(&p, height, tiles_y);
        let mut record = record_offsets[r];
        let end = record_offsets[r + 1];
        for row in u32::cast_from(rows.first)..u32::cast_from(rows.end) {
            let span = tile_span(p.contour, p.mean_x, p.mean_y, f32::cast_from(row), width, height, tiles_x);
            for column in u32::cast_from(span.first)..u32::cast_from(span.end) {
                // Counting and emitting are compiled apart: should a compiler round them differently, no pair may land
                // in another splat's records.
                if record < end {
                    pair_tiles[record as usize] = row * u32::cast_from(tiles_x) + column;
                    pair_splats[record as usize] = r as u32;
                    pair_records[record as usize] = record;
                    record += 1u32;
                }
            }
        }
        // For the same reason none may stay unwritten: they go behind the last tile, into no list.
        while record < end {
            pair_tiles[record as usize] = u32::cast_from(tiles_x) * u32::cast_from(tiles_y);
            pair_splats[record as usize] = r as u32;
            pair_records[record as usize] = record;
            record += 1u32;
        }
    }
}

/// Splat and record of each pair in list order, the start of each tile's list, and the largest channel in it.
#[cube(launch)]
fn list_pairs(
    pair_tiles: &[u32],
    pair_records: &[u32],
    pair_splats: &[u32],
    pairs: &mut [u32],
    tile_offsets: &mut [u32],
    lanes: &[f32],
    color_max: &[Atomic<u32>],
    num_pairs: u32,
    num_tiles: u32,
    #[comptime] wants_maximum: bool,
) {
    let p = ABSOLUTE_POS;
    if p < num_pairs as usize {
        let record = pair_records[p];
        pairs[p * 2] = pair_splats[record as usize];
        pairs[p * 2 + 1] = record;
        // A list begins behind the last pair of an earlier tile; tiles between two pairs are empty. The number behind the
        // last tile ends the last list.
        let tile = pair_tiles[p];
        if comptime!(wants_maximum) {
            let at = pair_splats[record as usize] as usize * lane::COUNT + lane::RED;
            let largest = f32::max(f32::max(lanes[at], lanes[at + 1]), lanes[at + 2]);
            // The bits of positive floats order like the floats. Pairs behind the last tile have no maximum.
            if largest > 1.0_f32 && tile < num_tiles {
                color_max[tile as usize].fetch_max(u32::reinterpret(largest));
            }
        }
        let mut first = 0u32;
        if p > 0 {
            first = pair_tiles[p - 1] + 1;
        }
        for t in first..tile + 1 {
            tile_offsets[t as usize] = p as u32;
        }
        if p + 1 == num_pairs as usize {
            for t in tile + 1..num_tiles + 1 {
                tile_offsets[t as usize] = num_pairs;
            }
        }
    }
}

const _: () = assert!(UNITS >= 2, "two units carry the sums of a workgroup");
