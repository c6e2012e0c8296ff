//! Binning: the front-to-back list of splats of every 16 × 16 tile.
//!
//! [`crate::math::tile`] defines what a pair is; counting and emitting read the same spans, so they cannot disagree.
//!
//! A splat's pairs are also numbered consecutively, in the order of its tiles (its records): the backward pass sums the
//! partial gradients of a splat's pairs in that fixed order.

use super::project::ProjectedSplats;
use super::scan::exclusive_scan;
use super::sort::depth_order;
use crate::error::{Error, Result};
use crate::layout::{MAX_PAIRS, TILE, lane};
use crate::math::alpha::contour_power2;
use crate::math::conic::{Boundary, boundary};
use crate::math::tile::{TileSpan, tile_span, tiles_touched};
use crate::math::vec::Sym2;
use crate::simd::vectorize;
use rayon::prelude::*;
use std::borrow::Cow;
use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering};

/// The tiles of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TileGrid {
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Tiles per row.
    pub tiles_x: u32,
    /// Rows of tiles.
    pub tiles_y: u32,
}

impl TileGrid {
    /// The grid that covers `width` × `height` pixels.
    pub fn new(width: u32, height: u32) -> Self {
        Self { width, height, tiles_x: width.div_ceil(TILE as u32), tiles_y: height.div_ceil(TILE as u32) }
    }

    /// Number of tiles.
    pub fn len(&self) -> usize {
        self.tiles_x as usize * self.tiles_y as usize
    }

    /// True for an image without pixels.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Front-to-back lists of all tiles; owned when binned, borrowed when a backward pass reads them again.
#[derive(Debug, Clone)]
pub struct TileLists<'a> {
    /// The tiles.
    pub grid: TileGrid,
    /// Start of each tile's list in the pair arrays, row-major tiles, `[tiles + 1]`.
    pub tile_offsets: Cow<'a, [u32]>,
    /// Compact index of the splat of each pair, `[P]`.
    pub pair_splats: Cow<'a, [u32]>,
    /// First record of each splat, `[V + 1]`.
    pub record_offsets: Cow<'a, [u32]>,
    /// Position of each record in the pair arrays, `[P]`: a permutation of 0..P. Empty unless asked for.
    pub record_pairs: Cow<'a, [u32]>,
    /// Largest colour channel of each tile's splats where it exceeds 1, else 0, `[tiles]`. Empty unless asked for.
    pub color_max: Cow<'a, [f32]>,
    /// Pairs a test of bounding boxes would give.
    pub num_pairs_box: u64,
}

/// What is wanted beside the lists.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct BinExtras {
    /// [`TileLists::record_pairs`], which only gradients need.
    pub records: bool,
    /// [`TileLists::color_max`], which only tables of termination need.
    pub color_max: bool,
}

/// One splat in one row of tiles.
#[derive(Debug, Clone, Copy, Default)]
struct Entry {
    splat: u32,
    first_tile: u32,
    end_tile: u32,
    record: u32,
}

/// Rows of tiles the ellipse of a splat meets.
#[inline(always)]
fn tile_rows(splat: &[f32; lane::COUNT], grid: &TileGrid) -> Range<u32> {
    let (mean, extent) = (splat[lane::MEAN_Y], splat[lane::EXTENT_Y]);
    indices(tiles_touched(mean - extent, mean + extent, grid.height as f32, grid.tiles_y as f32))
}

/// The largest channel of a splat if it exceeds 1, else 0.
#[inline(always)]
fn above_one(splat: &[f32; lane::COUNT]) -> f32 {
    let largest = splat[lane::RED..lane::RED + 3].iter().copied().fold(1.0, f32::max);
    if largest > 1.0 { largest } else { 0.0 }
}

/// A span of tiles as indices.
#[inline(always)]
fn indices(span: TileSpan) -> Range<u32> {
    span.first as u32..span.end as u32
}

/// The boundary of a splat's contour α = 1/255.
#[inline(always)]
pub fn contour(splat: &[f32; lane::COUNT]) -> Boundary {
    let conic = Sym2 { xx: splat[lane::CONIC_XX], xy: splat[lane::CONIC_XY], yy: splat[lane::CONIC_YY] };
    let power2 = contour_power2(splat[lane::LOG2_OPACITY]);
    boundary(conic, power2, splat[lane::EXTENT_X], splat[lane::EXTENT_Y])
}

/// Disjoint mutable pieces of `slice` that end at the given ascending offsets.
pub(super) fn split_at_offsets<T>(mut slice: &mut [T], ends: impl IntoIterator<Item = usize>) -> Vec<&mut [T]> {
    let mut start = 0;
    ends.into_iter()
        .map(|end| {
            let (piece, rest) = std::mem::take(&mut slice).split_at_mut(end - start);
            (slice, start) = (rest, end);
            piece
        })
        .collect()
}

/// Splats handled by one task while spans are computed.
const CHUNK: usize = 1024;

/// Bins the splats of one view.
///
/// # Errors
/// [`Error::Limit`] if there are more pairs than indices.
pub fn bin(splats: &ProjectedSplats, grid: TileGrid, extras: BinExtras) -> Result<TileLists<'static>> {
    let rows = splats.rows();
    // 1. Rows of tiles per splat, one entry each; and its largest channel while its lanes are at hand.
    let (mut tile_row_ranges, mut brightness) = (Vec::new(), Vec::new());
    let chunks = rows.par_iter().with_min_len(CHUNK);
    match extras.color_max {
        true => {
            chunks.map(|s| (tile_rows(s, &grid), above_one(s))).unzip_into_vecs(&mut tile_row_ranges, &mut brightness);
        }
        false => chunks.map(|s| tile_rows(s, &grid)).collect_into_vec(&mut tile_row_ranges),
    }
    let mut entry_offsets = Vec::with_capacity(rows.len() + 1);
    let (mut num_entries, mut num_pairs_box) = (0u64, 0u64);
    entry_offsets.push(0usize);
    for (range, s) in tile_row_ranges.iter().zip(rows) {
        num_entries += range.len() as u64;
        entry_offsets.push(num_entries as usize);
        let (mean, extent) = (s[lane::MEAN_X], s[lane::EXTENT_X]);
        num_pairs_box += range.len() as u64
            * indices(tiles_touched(mean - extent, mean + extent, grid.width as f32, grid.tiles_x as f32)).len() as u64;
    }
    let limit = |needed: u64| match needed > MAX_PAIRS {
        true => Err(Error::Limit { what: "(Gaussian, tile) pairs", needed, limit: MAX_PAIRS }),
        false => Ok(()),
    };
    limit(num_entries.max(num_pairs_box))?;
    // 2. Tiles of each entry.
    let mut entries = vec![Entry::default(); num_entries as usize];
    let ends = (0..rows.len().div_ceil(CHUNK)).map(|c| entry_offsets[((c + 1) * CHUNK).min(rows.len())]);
    split_at_offsets(&mut entries, ends).into_par_iter().enumerate().for_each(|(chunk, entries)| {
        let mut entries = entries.iter_mut();
        vectorize(
            #[inline(always)]
            || {
                for splat in chunk * CHUNK..((chunk + 1) * CHUNK).min(rows.len()) {
                    let s = &rows[splat];
                    let contour = contour(s);
                    for (row, entry) in tile_row_ranges[splat].clone().zip(&mut entries) {
                        let span = indices(tile_span(
                            contour,
                            s[lane::MEAN_X],
                            s[lane::MEAN_Y],
                            row as f32,
                            grid.width as f32,
                            grid.height as f32,
                            grid.tiles_x as f32,
                        ));
                        *entry = Entry { splat: splat as u32, first_tile: span.start, end_tile: span.end, record: 0 };
                    }
                }
            },
        );
    });
    // 3. Records: the pairs in splat order.
    let mut record_offsets = Vec::with_capacity(rows.len() + 1);
    record_offsets.push(0u32);
    let mut num_pairs = 0u64;
    for range in entry_offsets.windows(2) {
        for entry in &mut entries[range[0]..range[1]] {
            entry.record = num_pairs as u32;
            num_pairs += u64::from(entry.end_tile.saturating_sub(entry.first_tile));
        }
        record_offsets.push(num_pairs as u32);
    }
    limit(num_pairs)?;
    // 4. Entries of each row of tiles, front to back.
    let depths: Vec<f32> = rows.iter().map(|s| s[lane::DEPTH]).collect();
    let mut row_ends = vec![0usize; grid.tiles_y as usize];
    for range in &tile_row_ranges {
        for row in range.clone() {
            row_ends[row as usize] += 1;
        }
    }
    let mut cursors = Vec::with_capacity(row_ends.len());
    let mut total = 0;
    for end in &mut row_ends {
        cursors.push(total);
        total += *end;
        *end = total;
    }
    let mut by_row = vec![0u32; entries.len()];
    for splat in depth_order(&depths) {
        let first = entry_offsets[splat as usize];
        for (k, row) in tile_row_ranges[splat as usize].clone().enumerate() {
            let cursor = &mut cursors[row as usize];
            by_row[*cursor] = (first + k) as u32;
            *cursor += 1;
        }
    }
    // 5. Lists: count, then emit, each row of tiles by itself.
    let row_lists = split_at_offsets(&mut by_row, row_ends.iter().copied());
    let counts: Vec<Vec<u32>> =
        row_lists.par_iter().map(|list| tile_counts(list, &entries, grid.tiles_x as usize)).collect();
    let tile_offsets = exclusive_scan(counts.iter().flatten().copied());
    let mut pair_splats = vec![0u32; num_pairs as usize];
    let tiles_x = grid.tiles_x as usize;
    let pair_ends = (1..=grid.tiles_y as usize).map(|r| tile_offsets[r * tiles_x] as usize);
    let splat_rows = split_at_offsets(&mut pair_splats, pair_ends);
    // Rows of tiles write interleaved records, each exactly once: atomics keep that safe and cost a plain store.
    let record_pairs: Vec<AtomicU32> =
        (0..if extras.records { num_pairs } else { 0 }).map(|_| AtomicU32::new(0)).collect();
    let mut color_max = vec![0.0f32; if extras.color_max { grid.len() } else { 0 }];
    let maxima = split_at_offsets(
        &mut color_max,
        (1..=grid.tiles_y as usize).map(|r| if extras.color_max { r * tiles_x } else { 0 }),
    );
    row_lists.into_par_iter().zip(splat_rows).zip(maxima).enumerate().for_each(|(row, ((list, splats), maxima))| {
        let starts = &tile_offsets[row * tiles_x..][..tiles_x];
        let mut cursors = starts.to_vec();
        for &e in list.iter() {
            let entry = entries[e as usize];
            // Most splats stay below 1.
            let largest = if extras.color_max { brightness[entry.splat as usize] } else { 0.0 };
            if largest > 0.0 {
                for maximum in &mut maxima[entry.first_tile as usize..entry.end_tile.max(entry.first_tile) as usize] {
                    *maximum = maximum.max(largest);
                }
            }
            for (record, tile) in (entry.record..).zip(entry.first_tile..entry.end_tile) {
                let pair = cursors[tile as usize];
                cursors[tile as usize] += 1;
                splats[(pair - starts[0]) as usize] = entry.splat;
                if extras.records {
                    record_pairs[record as usize].store(pair, Ordering::Relaxed);
                }
            }
        }
    });
    let record_pairs: Vec<u32> = record_pairs.into_iter().map(AtomicU32::into_inner).collect();
    Ok(TileLists {
        grid,
        tile_offsets: tile_offsets.into(),
        pair_splats: pair_splats.into(),
        record_offsets: record_offsets.into(),
        record_pairs: record_pairs.into(),
        color_max: color_max.into(),
        num_pairs_box,
    })
}

/// Pairs of each tile of one row: +1 where a span starts, −1 behind its end, summed.
fn tile_counts(list: &[u32], entries: &[Entry], tiles_x: usize) -> Vec<u32> {
    let mut steps = vec![0i64; tiles_x + 1];
    for &e in list {
        let entry = entries[e as usize];
        if entry.first_tile < entry.end_tile {
            steps[entry.first_tile as usize] += 1;
            steps[entry.end_tile as usize] -= 1;
        }
    }
    let mut running = 0;
    steps[..tiles_x]
        .iter()
        .map(|step| {
            running += step;
            running as u32
        })
        .collect()
}
