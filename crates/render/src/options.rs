//! What can be asked of a frame.

use crate::error::{Error, Result};
use crate::layout;
use crate::termination::Termination;

/// Which per-Gaussian counters a frame fills (see [`crate::SplatStats`]). Each costs time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum StatsMode {
    /// None: the plain kernel.
    None,
    /// `tiles_used`.
    Tiles,
    /// `tiles_used`, `pixels_dominated`, `weight_max`.
    Dominance,
    /// Everything.
    All,
}

/// What a frame is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pass {
    /// An image only: nothing is kept for a gradient.
    Inference,
    /// An image whose gradient may be asked for.
    Train,
    /// As `Train`, with the cut at α = 1/255 smoothed to a C¹ function, so that finite differences can be trusted.
    /// For tests: the image is not the image of the model.
    SmoothCutoff,
}

/// Options of one frame; [`Default`] is what every 3DGS viewer shows.
#[derive(Debug, Clone, PartialEq)]
pub struct RenderOptions {
    /// Gaussians with camera-space z at or below this are culled; world units, > 0, default 0.01.
    pub near: f32,
    /// Clamp of α, in (1/255, 0.9999], default 0.999.
    pub alpha_max: f32,
    /// When a pixel stops.
    pub termination: Termination,
    /// Colour behind everything, sRGB-encoded like the splat colours.
    pub background: [f32; 3],
    /// SH degree evaluated, at most the degree stored; `None` = all that is stored.
    pub sh_degree: Option<u32>,
    /// Adds a fifth channel, Σ T α z: depth weighted by what is seen of it, world units; see
    /// [`crate::Rendered::expected_depth`].
    pub depth: bool,
    /// Opacities are lowered by what the dilation adds to the area of their footprints, so that a model looks alike at every
    /// distance and resolution (Yu 2024, the 2D Mip filter). For models that were trained so; default false.
    pub antialiased: bool,
    /// Counters to fill.
    pub stats: StatsMode,
    /// What the frame is for.
    pub pass: Pass,
    /// Whether the gradient that a [`crate::MeansProbe`] receives has the sums of per-pixel magnitudes (Ye 2024); else
    /// those are zero and cost nothing. Without a probe it says nothing.
    pub absolute_gradients: bool,
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self {
            near: layout::NEAR,
            alpha_max: layout::ALPHA_MAX,
            termination: Termination::Fixed(layout::T_STOP),
            background: [0.0; 3],
            sh_degree: None,
            depth: false,
            antialiased: false,
            stats: StatsMode::None,
            pass: Pass::Inference,
            absolute_gradients: true,
        }
    }
}

impl RenderOptions {
    /// The options for a training step: [`Pass::Train`], the rest as default.
    pub fn train() -> Self {
        Self { pass: Pass::Train, ..Self::default() }
    }

    /// Channels of the image: RGB and alpha, and depth if asked for.
    pub fn num_channels(&self) -> usize {
        if self.depth { 5 } else { 4 }
    }

    /// # Errors
    /// [`Error::Parameter`] for the first value out of its range.
    pub fn validate(&self) -> Result<()> {
        let check = |ok: bool, name, found: String, expected| {
            if ok { Ok(()) } else { Err(Error::Parameter { name, found, expected }) }
        };
        check(self.near.is_finite() && self.near > 0.0, "near", self.near.to_string(), "a finite distance above 0")?;
        check(
            self.alpha_max > layout::ALPHA_MIN && self.alpha_max <= layout::ALPHA_MAX_LIMIT,
            "alpha_max",
            self.alpha_max.to_string(),
            "a value above 1/255 and at most 0.9999",
        )?;
        self.termination.validate()?;
        check(
            self.pass == Pass::Inference || matches!(self.termination, Termination::Fixed(_)),
            "termination",
            "a table in a pass with gradients".to_owned(),
            "a fixed transmittance: tables are for inference",
        )?;
        check(
            self.background.iter().all(|c| c.is_finite()),
            "background",
            format!("{:?}", self.background),
            "three finite values",
        )?;
        check(
            matches!(self.termination, Termination::Fixed(_)) || self.background.iter().all(|&c| c >= 0.0),
            "background",
            format!("{:?} with a termination table", self.background),
            "no negative channel: a table bounds what is hidden from 0 upwards",
        )
    }
}
