//! The renderer once more, in float64 and as plainly as possible: what the fast one is judged by.
//!
//! Written from the specification of the renderer (conventions, α rule, stop rule) and of the counters, with loops over all
//! Gaussians, all tiles and all pixels. Kerbl 2023 (3DGS) and Zwicker 2001 (EWA) for the equations. No gradients: differences
//! of this function ([`crate::finite_diff`]) give them to about ten digits away from branches.

mod composite;
pub mod hvsq;
mod project;

pub use composite::render;
pub use project::{Projected, project, sh_basis};

/// Gaussians, values as stored: log scales, opacity logits, quaternions (w, x, y, z) of any length.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Gaussians {
    /// Centres in world units, `[N, 3]`.
    pub means: Vec<[f64; 3]>,
    /// Rotations (w, x, y, z), `[N, 4]`.
    pub quats: Vec<[f64; 4]>,
    /// Natural logarithms of the standard deviations, `[N, 3]`.
    pub log_scales: Vec<[f64; 3]>,
    /// Opacity logits, `[N]`.
    pub opacity_logits: Vec<f64>,
    /// SH coefficients per Gaussian: K = (stored degree + 1)².
    pub num_coefficients: usize,
    /// SH coefficients, `[N, K, 3]`, 3DGS order and signs.
    pub sh: Vec<[f64; 3]>,
}

/// A pinhole camera, OpenCV axes; pixel (0, 0) has its centre at (0.5, 0.5).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Image width in pixels.
    pub width: usize,
    /// Image height in pixels.
    pub height: usize,
    /// Focal lengths in pixels.
    pub focal: [f64; 2],
    /// Principal point in pixels.
    pub center: [f64; 2],
    /// World to camera, rows of the 4×4 matrix.
    pub camera_from_world: [[f64; 4]; 4],
}

/// How α falls to nothing at 1/255.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cutoff {
    /// α below 1/255 is skipped: the renderer's rule.
    Hard,
    /// No cut at all and no clamp: for differences across the cut, with opacities of at least 1/255.
    None,
}

/// What a pixel that a table stopped receives for the rest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TableResidual {
    /// Nothing.
    Drop,
    /// T · background.
    Background,
    /// T · C / (1 − T).
    Mean,
    /// T · c_max / 2.
    Centre,
}

/// A table of the transmittance at which each colour stops (JND).
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    /// Cells per axis.
    pub size: usize,
    /// Limits, γ included, `[size³]`, red slowest.
    pub limits: Vec<f64>,
    /// What becomes of the rest.
    pub residual: TableResidual,
    /// Whether hidden colours are bounded by the tile's largest channel instead of 1.
    pub is_tile_bound: bool,
}

/// Parameters of a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Depths up to this are culled.
    pub near: f64,
    /// Upper bound of α.
    pub alpha_max: f64,
    /// A ray stops before the Gaussian that would take its transmittance to this or below.
    pub stop: f64,
    /// The table a ray stops by too.
    pub table: Option<Table>,
    /// Colour behind everything.
    pub background: [f64; 3],
    /// SH degree that is evaluated.
    pub sh_degree: u32,
    /// Opacity compensation of Yu 2024 (Mip-Splatting).
    pub antialiased: bool,
    /// Rule at 1/255.
    pub cutoff: Cutoff,
    /// Relative distance to a threshold below which float32 may decide otherwise.
    pub fragile_rel: f64,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            near: 0.01,
            alpha_max: 0.999,
            stop: 1e-4,
            table: None,
            background: [0.0; 3],
            sh_degree: 0,
            antialiased: false,
            cutoff: Cutoff::Hard,
            fragile_rel: 1e-4,
        }
    }
}

/// Smallest α that is blended.
pub const ALPHA_MIN: f64 = 1.0 / 255.0;

/// Side of a tile in pixels, as far as counters are concerned.
pub const TILE: usize = 16;

/// What one view of the scene gives: images are row-major, row 0 on top.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Frame {
    /// Colour over the background, `[H·W, 3]`.
    pub color: Vec<[f64; 3]>,
    /// 1 − transmittance, `[H·W]`.
    pub alpha: Vec<f64>,
    /// Σ T α z, `[H·W]`.
    pub depth: Vec<f64>,
    /// Gaussians blended, `[H·W]`.
    pub num_blended: Vec<u32>,
    /// Pixels in which float32 rounding could take another branch, `[H·W]`.
    pub fragile: Vec<bool>,
    /// Counters of each Gaussian, `[N]`.
    pub counters: Vec<Counters>,
    /// Sums over the frame.
    pub totals: Totals,
    /// Tile lists: for each tile in row-major order, indices of Gaussians front to back.
    pub tile_lists: Vec<Vec<u32>>,
    /// E_t of each tile: list position at which its last pixel stopped.
    pub tile_ends: Vec<u32>,
}

/// Work of one Gaussian in one view, and how far float32 may be off because of pixels or pairs at a threshold.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Counters {
    /// Tiles in whose list the Gaussian stands before the end E_t.
    pub tiles_used: u32,
    /// Pixels in which its weight is the largest; the nearer wins a tie.
    pub pixels_dominated: u32,
    /// Pixels in which it is blended.
    pub pixels_blended: u32,
    /// Largest weight T·α.
    pub weight_max: f64,
    /// Sum of weights.
    pub weight_sum: f64,
    /// Tiles with at least one pixel in which it is blended.
    pub tiles_blended: u32,
    /// Fragile pixels it reaches: `pixels_blended` may differ by this many.
    pub slack_pixels: u32,
    /// Fragile pixels, or pixels with nearly a tie, it reaches: `pixels_dominated` may differ by this many.
    pub slack_dominated: u32,
    /// Tiles it reaches that hold a fragile pixel or in which the pair itself is fragile.
    pub slack_tiles: u32,
}

/// Sums over a frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Totals {
    /// Gaussians that pass the culls and have at least one pair.
    pub num_visible: u64,
    /// (Gaussian, tile) pairs.
    pub num_pairs: u64,
    /// Pairs before the end of their tile: Σ E_t.
    pub num_pairs_used: u64,
    /// Blended (Gaussian, pixel) pairs.
    pub num_blended: u64,
    /// Tiles of the image.
    pub num_tiles: u64,
    /// Tiles without a pair.
    pub num_tiles_empty: u64,
    /// Pairs whose existence float32 rounding could flip.
    pub fragile_pairs: u64,
}

impl Gaussians {
    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// True when there is none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }
}

#[cfg(test)]
mod tests;
