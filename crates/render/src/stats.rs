//! Counters: what a frame did and what it skipped, and what each Gaussian earned and cost in it.

use serde::Serialize;

/// What one frame did and what it could skip.
///
/// On a GPU [`num_pairs_used`](Self::num_pairs_used), [`num_lane_pixels`](Self::num_lane_pixels) and
/// [`num_tiles_empty`](Self::num_tiles_empty) are counted only where [`crate::StatsMode`] asks for counters, and 0 otherwise:
/// they would cost every frame a second read-back.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct RenderStats {
    /// Gaussians in the model.
    pub num_splats: u64,
    /// Gaussians culled because a parameter, or what was computed from it, is not finite.
    pub num_culled_non_finite: u64,
    /// Gaussians that were skipped with their whole cluster, without being read; on a CPU only.
    pub num_culled_by_cluster: u64,
    /// Gaussians whose box around the contour α = 1/255 reaches a pixel centre.
    pub num_visible: u64,
    /// (Gaussian, tile) pairs a test of bounding boxes would give.
    pub num_pairs_box: u64,
    /// (Gaussian, tile) pairs of the exact test.
    pub num_pairs: u64,
    /// Pairs worked through before their tile had stopped.
    pub num_pairs_used: u64,
    /// Lane-pixels computed: on a CPU 16 for every tile row that a pair visits, which leaves out rows whose pixels have all
    /// stopped; on a GPU, where a unit is a pixel, 256 for every pair in use.
    pub num_lane_pixels: u64,
    /// Pixels blended, over all pairs; filled by [`crate::StatsMode::All`] only.
    pub num_blended: u64,
    /// Tiles of the image.
    pub num_tiles: u64,
    /// Tiles without any pair.
    pub num_tiles_empty: u64,
}

impl RenderStats {
    /// Adds the per-tile counters of `other`, the result of another part of the image.
    pub(crate) fn add_tiles(&mut self, other: &Self) {
        self.num_pairs_used += other.num_pairs_used;
        self.num_lane_pixels += other.num_lane_pixels;
        self.num_blended += other.num_blended;
        self.num_tiles_empty += other.num_tiles_empty;
    }
}

/// Work and worth of each Gaussian in one view, `[N]` each, and work of each tile and pixel; empty where the
/// [`crate::StatsMode`] does not fill it.
///
/// A tile's list is walked front to back until its last pixel has stopped, at position E; a pixel blends an entry iff
/// α ≥ 1/255 and T(1−α) is above the stopping transmittance. All counters are integers or maxima, so they do not depend
/// on the order in which tiles are worked.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SplatStats {
    /// Tiles in which the Gaussian stands at a list position below E (RTGS: Comp).
    pub tiles_used: Vec<u32>,
    /// Pixels in which it has the largest weight T·α of all blended entries; the nearer wins a tie (RTGS: Val).
    pub pixels_dominated: Vec<u32>,
    /// Pixels in which it is blended.
    pub pixels_blended: Vec<u32>,
    /// Largest weight T·α over the pixels of the view.
    pub weight_max: Vec<f32>,
    /// Sum of the weights over the pixels, fixed point in units of 2⁻³².
    pub weight_sum: Vec<u64>,
    /// Tiles in which it is blended in at least one pixel.
    pub tiles_blended: Vec<u32>,
    /// Gaussians blended in each pixel, `[H·W]`; with [`crate::StatsMode::All`].
    pub blends_of_pixels: Vec<u32>,
    /// Lengths and ends of the tiles' lists; filled from [`crate::StatsMode::Tiles`] on.
    pub tiles: TileStats,
}

/// Work of each tile in one view, row-major, `[tiles]` each.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TileStats {
    /// Entries of the tile's list, n.
    pub num_pairs: Vec<u32>,
    /// Position E at which its last pixel stopped: entries that were worked through.
    pub num_pairs_used: Vec<u32>,
}
