//! Per-Gaussian counters from per-pair counters (definitions: [`SplatStats`]).
//!
//! Tiles fill one [`PairStats`] per list entry, which are then summed per Gaussian. All sums are integers and all maxima
//! exact, so the order of tiles does not matter.

use super::bin::TileLists;
use super::project::ProjectedSplats;
use super::rasterize::Raster;
use crate::options::StatsMode;
use crate::simd::LANES;
use crate::stats::{SplatStats, TileStats};

/// Which counters the rasteriser fills.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StatsLevel {
    /// None: it draws the image.
    None,
    /// Largest weights and dominated pixels.
    Dominance,
    /// Those, and what is blended.
    All,
}

impl StatsLevel {
    /// The level whose pixel counters `mode` asks for. [`StatsMode::Tiles`] needs none: the ends of the tiles do.
    pub fn from_mode(mode: StatsMode) -> Self {
        match mode {
            StatsMode::None | StatsMode::Tiles => Self::None,
            StatsMode::Dominance => Self::Dominance,
            StatsMode::All => Self::All,
        }
    }
}

/// Counters of one (Gaussian, tile) pair.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PairStats {
    /// Sum of the weights over the tile's pixels, units of 2⁻³².
    pub weight_sum: u64,
    /// Largest weight.
    pub weight_max: f32,
    /// Pixels in which the pair is blended.
    pub pixels_blended: u16,
    /// Pixels it dominates.
    pub pixels_dominated: u16,
}

impl PairStats {
    /// Stores what the All level counts: blended pixels and the sum of their weights.
    #[inline(always)]
    pub(super) fn set_blended(&mut self, num: u32, weight_sum: f32) {
        self.pixels_blended = num as u16;
        self.weight_sum = (f64::from(weight_sum) * 4_294_967_296.0) as u64;
    }
}

/// Credits each pixel to the entry with its largest weight; `winners` are the rows of a tile with their widths.
#[inline(always)]
pub(super) fn credit_winners<'a>(counters: &mut [PairStats], winners: impl Iterator<Item = (&'a [i32; LANES], usize)>) {
    for (row, width) in winners {
        for &index in &row[..width] {
            // −1: a pixel without any blended entry counts for nobody.
            if let Some(counter) = usize::try_from(index).ok().and_then(|i| counters.get_mut(i)) {
                counter.pixels_dominated += 1;
            }
        }
    }
}

/// Counters per Gaussian; `num_splats` is N, `raster` the pass whose [`StatsLevel`] is that of `mode`.
pub fn splat_stats(
    mode: StatsMode,
    num_splats: usize,
    splats: &ProjectedSplats<'_>,
    lists: &TileLists<'_>,
    raster: &Raster<'_>,
) -> SplatStats {
    let rows = |wanted: StatsMode| if mode >= wanted { num_splats } else { 0 };
    let mut out = SplatStats {
        tiles_used: vec![0; rows(StatsMode::Tiles)],
        pixels_dominated: vec![0; rows(StatsMode::Dominance)],
        weight_max: vec![0.0; rows(StatsMode::Dominance)],
        pixels_blended: vec![0; rows(StatsMode::All)],
        weight_sum: vec![0; rows(StatsMode::All)],
        tiles_blended: vec![0; rows(StatsMode::All)],
        tiles: TileStats::default(),
        blends_of_pixels: raster.blends.clone(),
    };
    if mode >= StatsMode::Tiles {
        out.tiles = TileStats {
            num_pairs: lists.tile_offsets.windows(2).map(|w| w[1] - w[0]).collect(),
            num_pairs_used: raster.tile_ends.to_vec(),
        };
        for (&start, &end) in lists.tile_offsets.iter().zip(raster.tile_ends.iter()) {
            for &splat in &lists.pair_splats[start as usize..][..end as usize] {
                out.tiles_used[splats.global_from_compact[splat as usize] as usize] += 1;
            }
        }
    }
    for (&splat, pair) in lists.pair_splats.iter().zip(&raster.pair_stats) {
        let i = splats.global_from_compact[splat as usize] as usize;
        if mode >= StatsMode::Dominance {
            out.pixels_dominated[i] += u32::from(pair.pixels_dominated);
            out.weight_max[i] = out.weight_max[i].max(pair.weight_max);
        }
        if mode >= StatsMode::All {
            out.pixels_blended[i] += u32::from(pair.pixels_blended);
            out.tiles_blended[i] += u32::from(pair.pixels_blended > 0);
            out.weight_sum[i] += pair.weight_sum;
        }
    }
    out
}
