//! The training state as a Burn backend extension: every change of a model is one operation on the device it lives on.
//!
//! An operation consumes the state and hands it back, so that a CPU backend can work where the values are: nothing is
//! copied unless something else shares them. A GPU backend queues kernels and reads nothing back, except where an
//! operation says so. A loss that is not finite closes the state: until [`Status`] is cleared every operation that
//! would change a parameter leaves the model as it is. So the host may look at the loss when it likes.

#![expect(deprecated, reason = "burn-ndarray is this project's default CPU backend until its successor replaces it")]

mod cpu;
#[cfg(feature = "gpu")]
mod gpu;

use crate::densify::Bounds;
use crate::event::DensifyReport;
use crate::optim::{AdamSettings, LearningRates, Regularizers, SeenBy, ShRates};
use burn::backend::{
    Backend, ExtensionType, backend_extension,
    tensor::{FloatTensor, IntTensor},
};
use gazesplat_render::Result;
use gazesplat_render::backend::Parameters;

/// A model in training.
#[derive(Debug, Clone, ExtensionType)]
pub struct State<B: Backend> {
    /// The parameters.
    #[extension_type]
    pub params: Parameters<B>,
    /// First moments of Adam, one per parameter. Overwritten in place on a GPU: never handed out.
    #[extension_type]
    pub first: Parameters<B>,
    /// Second moments, as the first.
    #[extension_type]
    pub second: Parameters<B>,
    /// [`Status`], `[4]` words. Overwritten in place on a GPU: never handed out.
    pub status: IntTensor<B>,
    /// Where rows lag: the last update that the SH moments of each row have seen, `[N]`, with
    /// [`crate::optim::missed::PREPARED`] while an update is under way; else one unused word. Overwritten in place on a GPU: never
    /// handed out.
    pub last: IntTensor<B>,
}

/// A state after an operation.
#[derive(Debug, Clone, ExtensionType)]
pub struct Changed<B: Backend> {
    /// The state; as it was if `outcome` is an error.
    #[extension_type]
    pub state: State<B>,
    /// Rows moved and added, or why nothing was done.
    pub outcome: Result<DensifyReport>,
}

/// What the host learns of the state when it reads four words back.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Status {
    /// The update whose loss was not finite, counted from 1, and that loss. No update was done since.
    pub failed: Option<(u32, f32)>,
    /// Mean opacity before the last update that was to report it.
    pub mean_opacity: f32,
    /// Mean scale before the last update that was to report it, world units.
    pub mean_scale: f32,
}

impl Status {
    /// Number of words.
    pub const NUM_WORDS: usize = 4;

    /// From words: number of the failed update or 0, bits of its loss, bits of both means.
    pub fn from_words(words: [u32; Self::NUM_WORDS]) -> Self {
        Self {
            failed: (words[0] > 0).then(|| (words[0], f32::from_bits(words[1]))),
            mean_opacity: f32::from_bits(words[2]),
            mean_scale: f32::from_bits(words[3]),
        }
    }

    /// The words of [`Status::from_words`].
    pub fn to_words(self) -> [u32; Self::NUM_WORDS] {
        let (number, loss) = self.failed.unwrap_or((0, 0.0));
        [number, loss.to_bits(), self.mean_opacity.to_bits(), self.mean_scale.to_bits()]
    }
}

/// One update of Adam.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamUpdate {
    /// Number of the update, counted from 1.
    pub number: u32,
    /// Constants.
    pub settings: AdamSettings,
    /// Learning rates.
    pub rates: LearningRates,
    /// Regularisers whose gradients are added to those of the loss.
    pub regularizers: Regularizers,
    /// Put the means that the regularisers weigh into the status; a CPU does it anyway.
    pub report: bool,
    /// Change the SH coefficients of the rows that [`OptimOps::prepare_seen`] marked only.
    pub marked_only: bool,
}

/// What rows that lag are brought up to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MissedUpdates {
    /// Number of the last update that they are to have seen.
    pub through: u32,
    /// Constants.
    pub settings: AdamSettings,
    /// Learning rates of what lags.
    pub rates: ShRates,
}

/// One addition of position noise (MCMC, Eq. 8).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NoiseUpdate {
    /// Learning rate of the means times the noise multiple, world units; 0 = no noise.
    pub strength: f32,
    /// Seed of the run.
    pub seed: u64,
    /// Number of the step, counted from 1.
    pub step: u32,
}

/// One relocation and growth (MCMC, Sec. 3.4).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Refinement {
    /// Seed of the run.
    pub seed: u64,
    /// Number of the step, counted from 1.
    pub step: u32,
    /// Factor of the number of rows.
    pub growth: f32,
    /// Largest number of rows.
    pub cap: usize,
    /// A row of at most this opacity is dead.
    pub min_opacity: f32,
    /// A row beyond these is broken.
    pub bounds: Bounds,
}

impl Refinement {
    /// Rows to add to `num_rows`.
    pub fn num_added(&self, num_rows: usize) -> usize {
        let grown = (num_rows as f64 * f64::from(self.growth)).round() as usize;
        grown.min(self.cap).saturating_sub(num_rows)
    }
}

/// The part of one view in the statistic of ADC.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StatisticStep {
    /// Rows that the view saw.
    pub num_visible: usize,
    /// Half the width and half the height of the image, pixels.
    pub half_size: [f32; 2],
    /// Take the sums of magnitudes instead of the gradient (Ye 2024).
    pub absolute: bool,
}

/// One clone, split, prune and opacity reset (3DGS, Sec. 5.2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Densification {
    /// Seed of the run.
    pub seed: u64,
    /// Number of the step, counted from 1.
    pub step: u32,
    /// Largest number of rows.
    pub cap: usize,
    /// A row whose mean statistic is above this grows.
    pub grow_gradient: f32,
    /// A row that grows is cloned if its largest log scale is at most this, else split.
    pub max_clone_log_scale: f32,
    /// A row with a lower opacity logit is removed.
    pub min_logit: f32,
    /// A row with a larger log scale is removed, once that is asked for.
    pub max_log_scale: Option<f32>,
    /// A row beyond these is removed.
    pub bounds: Bounds,
    /// Lower opacity logits to this and forget their moments, when it is time.
    pub reset_logit: Option<f32>,
}

/// The operations of training. No default bodies: a backend without a kernel does not compile.
///
/// `shared` says that something outside the state may hold its parameters. A CPU backend sees that for itself; on a GPU
/// all five tensors are views of one allocation, which hides it, so it works on a copy when told.
#[backend_extension(NdArray, Flex: cfg(feature = "flex"), Cube: cfg(feature = "gpu"))]
pub trait OptimOps: Backend {
    /// Closes the state if `loss`, `[1]`, is not finite; else adds the gradients of the regularisers to `gradients` and
    /// does one update of all parameters. Every group has its gradient.
    fn adam(
        #[extension_type] state: State<Self>,
        #[extension_type] gradients: Parameters<Self>,
        loss: FloatTensor<Self>,
        update: AdamUpdate,
        shared: bool,
    ) -> Changed<Self>;

    /// Marks the rows that `view` may see and brings their SH coefficients up to date, not their moments. Rows lag: the state
    /// has a word for each.
    fn prepare_seen(
        #[extension_type] state: State<Self>,
        view: SeenBy,
        missed: MissedUpdates,
        shared: bool,
    ) -> Changed<Self>;

    /// Brings SH coefficients and moments of all rows up to date; their words mean nothing afterwards. Rows lag.
    fn catch_up(#[extension_type] state: State<Self>, missed: MissedUpdates, shared: bool) -> Changed<Self>;

    /// The state with its SH coefficients brought up to date on a copy, everything else as it is. Rows lag.
    fn advanced(#[extension_type] state: State<Self>, missed: MissedUpdates) -> Changed<Self>;

    /// Adds position noise to the means.
    fn add_noise(#[extension_type] state: State<Self>, noise: NoiseUpdate, shared: bool) -> Changed<Self>;

    /// Moves dead rows onto live ones and adds rows. On a GPU with one read-back of four counts: the report names them,
    /// and nothing may grow out of a model without live rows.
    fn refine(#[extension_type] state: State<Self>, refinement: Refinement, shared: bool) -> Changed<Self>;

    /// `statistic`, `[N, 2]`, with what one view adds: to its first column the norm of the image-plane gradient of the rows
    /// it saw, in half images, to its second the number of views. `gradient`: `[N, 4]` as a probe receives it; `visible`:
    /// the rows. On a GPU `statistic` is overwritten in place.
    fn add_statistic(
        statistic: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
        visible: IntTensor<Self>,
        step: StatisticStep,
    ) -> FloatTensor<Self>;

    /// Clones, splits and removes rows by the mean of `statistic`, `[N, 2]`, and lowers the opacities when it is time. On a
    /// GPU four words per row are read back; nothing is done to a model of which no row would be left.
    fn densify(
        #[extension_type] state: State<Self>,
        statistic: FloatTensor<Self>,
        densification: Densification,
        shared: bool,
    ) -> Changed<Self>;

    /// Removes the rows beyond `bounds`, unless all are. On a GPU with one read-back of four counts, and of a word per row
    /// if there are any.
    fn sweep(#[extension_type] state: State<Self>, bounds: Bounds, shared: bool) -> Changed<Self>;

    /// Orders the rows along a Morton curve, so that neighbours in memory are neighbours in space: by the box around
    /// the means on a CPU, on a GPU by the cube of `half` world units around `center`, which needs no read-back.
    fn sort_spatially(#[extension_type] state: State<Self>, center: [f32; 3], half: f32) -> Changed<Self>;

    /// Keeps the listed rows, in that order, with their moments; the others are gone.
    fn select_rows(#[extension_type] state: State<Self>, rows: Vec<u32>) -> Changed<Self>;

    /// Lowers opacity logits above `max_logit` to it, and forgets the moments of all opacities.
    fn clamp_opacities(#[extension_type] state: State<Self>, max_logit: f32, shared: bool) -> Changed<Self>;

    /// A state whose parameters and moments later operations on the given one leave as they are; the status stays shared. A
    /// CPU backend copies what is shared when it is written to, so there it is the same.
    fn copied(#[extension_type] state: State<Self>) -> Changed<Self>;

    /// `gradients` of the log scales, `[N, 3]`, with `factor` times those of scale decay added (RTGS Eq. 5); `used`: tiles
    /// each row is used in, `[N]`. On a GPU `gradients` is overwritten in place.
    fn add_scale_decay(
        log_scales: FloatTensor<Self>,
        gradients: FloatTensor<Self>,
        used: IntTensor<Self>,
        factor: f32,
    ) -> FloatTensor<Self>;

    /// Gives every row `num_coefficients` SH coefficients; new ones are zero, with zero moments.
    fn widen_sh(#[extension_type] state: State<Self>, num_coefficients: usize) -> Changed<Self>;
}
