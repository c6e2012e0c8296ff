//! A model in training: parameters and moments as tensors on one device, and how many updates they have seen.
//!
//! The file is long because every change of a model is one method here, of a few lines each.

use super::{AdamSettings, Columns, LearningRates, Regularizers, ShRates};
use crate::backend::{
    AdamUpdate, Changed, Densification, MissedUpdates, NoiseUpdate, OptimOps, Refinement, State, Status,
};
use crate::densify::Bounds;
use crate::error::Result;
use crate::event::DensifyReport;
use crate::kernels::cpu::rows::Rows;
use burn::backend::Dispatch;
use burn::tensor::{DType, Device, Int, Tensor, TensorData};
use gazesplat_render::Splats;
use gazesplat_render::backend::Parameters;
#[cfg(feature = "gpu")]
use gazesplat_render::gpu::packed::PackedLayout;
use std::sync::atomic::{AtomicBool, Ordering};

pub(crate) mod lag;

use lag::{placeholder, words_tensor};

/// A model with its optimiser as it was at some moment.
#[derive(Debug, Clone)]
pub struct Snapshot {
    tensors: State<Dispatch>,
    num_updates: u32,
    /// What rows that lag are brought up to before anybody sees them.
    missed: MissedUpdates,
    is_lagging: bool,
}

impl Snapshot {
    /// Number of rows N.
    pub fn num_rows(&self) -> usize {
        Tensor::<1>::from_dispatch(self.tensors.params.opacity_logits.clone()).dims()[0]
    }

    /// Reads everything back.
    ///
    /// # Errors
    /// [`crate::Error::Render`] when the device does not answer.
    pub fn to_host(&self) -> Result<HostState> {
        let State { params, first, second, last, .. } = &self.tensors;
        let last = if self.is_lagging { lag::words_of(last.clone())? } else { Vec::new() };
        let [params, first, second] = [params, first, second].map(|p| Columns::from_splats(splats(p.clone())));
        let rows = Rows { params: params?, first: first?, second: second? };
        Ok(HostState { rows, num_updates: self.num_updates, last })
    }

    /// Uploads `state`.
    ///
    /// # Errors
    /// As [`ModelState::new`].
    pub fn from_host(state: HostState, device: &Device) -> Result<Self> {
        let HostState { rows: Rows { params, first, second }, num_updates, last } = state;
        check_size(&params, device)?;
        let [params, first, second] = [params, first, second].map(|columns| dispatched(columns.into_splats(device)));
        let status = status_tensor(Status::default(), device);
        let is_lagging = !last.is_empty();
        let last = if is_lagging { words_tensor(last, device) } else { placeholder(device) };
        let missed = MissedUpdates { through: num_updates, settings: AdamSettings::default(), rates: ShRates::NONE };
        Ok(Self { tensors: State { params, first, second, status, last }, num_updates, missed, is_lagging })
    }
}

/// A snapshot on the host: what a checkpoint holds.
#[derive(Debug, Clone, PartialEq)]
pub struct HostState {
    /// Parameters and moments.
    pub rows: Rows,
    /// Updates done.
    pub num_updates: u32,
    /// The last update that the SH moments of each row have seen, where rows lag; else empty.
    pub last: Vec<u32>,
}

/// Refuses what a GPU takes in no single buffer.
fn check_size(params: &Columns, device: &Device) -> Result<()> {
    #[cfg(feature = "gpu")]
    if let Some(gpu) = gazesplat_render::gpu::Gpu::from_device(device) {
        let layout = PackedLayout::new(params.num_rows(), params.num_coefficients());
        gpu.check_size("bytes of packed parameters", &[layout.len()], DType::F32)?;
    }
    #[cfg(not(feature = "gpu"))]
    let _ = (params, device);
    Ok(())
}

fn copied(state: State<Dispatch>) -> Result<State<Dispatch>> {
    let Changed { state, outcome } = <Dispatch as OptimOps>::copied(state);
    outcome?;
    Ok(state)
}

/// Parameters and their optimiser, changed by one operation at a time.
///
/// The device works in place where nobody else holds the parameters; [`ModelState::splats`] hands them out, and then
/// the next operation works on a copy. Moments are never handed out.
#[derive(Debug)]
pub struct ModelState {
    /// `None` only during an operation.
    tensors: Option<State<Dispatch>>,
    settings: AdamSettings,
    num_updates: u32,
    is_handed_out: AtomicBool,
    device: Device,
    /// Rates of what may lag; `None` = nothing may.
    lag: Option<ShRates>,
    /// Whether rows lag: the state then has their words.
    is_lagging: bool,
    /// Updates done when the words were made: none of them is smaller.
    words_since: u32,
    /// Whether what the next update will see has been brought up to date.
    is_prepared: bool,
}

impl ModelState {
    /// The parameters `params` on `device`, with zero moments.
    ///
    /// # Errors
    /// [`crate::Error::Render`] when a GPU takes no model of that size.
    pub fn new(params: Columns, settings: AdamSettings, device: &Device) -> Result<Self> {
        check_size(&params, device)?;
        let zeros = || dispatched(params.zeros_like().into_splats(device));
        let tensors = State {
            first: zeros(),
            second: zeros(),
            status: status_tensor(Status::default(), device),
            last: placeholder(device),
            params: dispatched(params.into_splats(device)),
        };
        Ok(Self {
            tensors: Some(tensors),
            settings,
            num_updates: 0,
            is_handed_out: AtomicBool::new(false),
            device: device.clone(),
            lag: None,
            is_lagging: false,
            words_since: 0,
            is_prepared: false,
        })
    }

    /// The model of `state` on `device`, with its moments.
    ///
    /// # Errors
    /// As [`ModelState::new`].
    pub(crate) fn from_host(state: HostState, settings: AdamSettings, device: &Device) -> Result<Self> {
        let Snapshot { tensors, num_updates, is_lagging, .. } = Snapshot::from_host(state, device)?;
        Ok(Self {
            tensors: Some(tensors),
            settings,
            num_updates,
            is_handed_out: AtomicBool::new(false),
            device: device.clone(),
            lag: None,
            is_lagging,
            words_since: 0,
            is_prepared: false,
        })
    }

    fn tensors(&self) -> &State<Dispatch> {
        self.tensors.as_ref().expect("only an operation in progress takes the tensors")
    }

    fn tensors_mut(&mut self) -> &mut State<Dispatch> {
        self.tensors.as_mut().expect("only an operation in progress takes the tensors")
    }

    /// Number of rows N.
    pub fn num_rows(&self) -> usize {
        Tensor::<1>::from_dispatch(self.tensors().params.opacity_logits.clone()).dims()[0]
    }

    /// SH coefficients stored per row and channel.
    pub fn num_coefficients(&self) -> usize {
        Tensor::<3>::from_dispatch(self.tensors().params.sh.clone()).dims()[1]
    }

    /// Updates done.
    pub fn num_updates(&self) -> u32 {
        self.num_updates
    }

    /// Where the tensors live.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// The parameters, to keep: later operations leave these tensors as they are. Rows that lag do so here;
    /// [`ModelState::current`] brings them up to date.
    pub fn splats(&self) -> Splats {
        self.is_handed_out.store(true, Ordering::Relaxed);
        self.lent()
    }

    /// The parameters, for a caller that drops them before the next operation: that one may overwrite them.
    pub(crate) fn lent(&self) -> Splats {
        splats(self.tensors().params.clone())
    }

    /// Reads the moments back: first, second.
    ///
    /// # Errors
    /// [`crate::Error::Render`] when the device does not answer.
    pub fn moments(&self) -> Result<[Columns; 2]> {
        let State { first, second, .. } = self.tensors();
        Ok([Columns::from_splats(splats(first.clone()))?, Columns::from_splats(splats(second.clone()))?])
    }

    /// Reads the status back; waits for all work queued before.
    ///
    /// # Errors
    /// [`crate::Error::Render`] when the device does not answer.
    pub fn status(&self) -> Result<Status> {
        let words = Tensor::<1, Int>::from_dispatch(self.tensors().status.clone());
        let data = words.try_into_data().map_err(|e| gazesplat_render::Error::device(&e))?;
        // A GPU copies on the first access: that can fail, too.
        let words: Vec<i32> = data.try_into_vec().map_err(|e| gazesplat_render::Error::device(&e))?;
        Ok(Status::from_words(std::array::from_fn(|i| words[i].cast_unsigned())))
    }

    /// Opens a state again that a loss closed, at the number of updates it has really seen.
    pub(crate) fn reopen(&mut self, num_updates: u32) {
        self.num_updates = num_updates;
        if self.is_lagging && self.words_since > num_updates {
            // Made while the state was closed: they speak of updates that were never done.
            self.tensors_mut().last = placeholder(&self.device);
            (self.is_lagging, self.is_prepared) = (false, false);
        }
        let status = status_tensor(Status::default(), &self.device);
        if let Some(tensors) = &mut self.tensors {
            tensors.status = status;
        }
    }

    /// Runs `operation`; its second argument says that the parameters may be held outside. None does afterwards: every
    /// operation hands back parameters of its own.
    fn apply(&mut self, operation: impl FnOnce(State<Dispatch>, bool) -> Changed<Dispatch>) -> Result<DensifyReport> {
        let shared = std::mem::take(self.is_handed_out.get_mut());
        let tensors = self.tensors.take().expect("only an operation in progress takes the tensors");
        let Changed { state, outcome } = operation(tensors, shared);
        self.tensors = Some(state);
        *self.is_handed_out.get_mut() = shared && outcome.is_err();
        Ok(outcome?)
    }

    /// One update of all parameters by `gradients` of `loss`, `[1]`. Nothing changes if the loss is not finite or the
    /// state is closed: see [`ModelState::status`].
    ///
    /// # Errors
    /// [`crate::Error::Render`] when the device lacks the memory.
    pub fn update(
        &mut self,
        gradients: Splats,
        loss: Tensor<1>,
        rates: LearningRates,
        regularizers: Regularizers,
        report: bool,
    ) -> Result<()> {
        let marked_only = std::mem::take(&mut self.is_prepared);
        if !marked_only {
            self.catch_up()?;
        }
        let number = self.num_updates + 1;
        let update = AdamUpdate { number, settings: self.settings, rates, regularizers, report, marked_only };
        let (gradients, loss) = (dispatched(gradients), loss.into_dispatch());
        self.apply(|state, shared| <Dispatch as OptimOps>::adam(state, gradients, loss, update, shared))?;
        self.num_updates = number;
        Ok(())
    }

    /// Adds position noise to the means (MCMC, Eq. 8).
    ///
    /// # Errors
    /// As [`ModelState::update`].
    pub fn add_noise(&mut self, noise: NoiseUpdate) -> Result<()> {
        if noise.strength <= 0.0 {
            return Ok(());
        }
        self.apply(|state, shared| <Dispatch as OptimOps>::add_noise(state, noise, shared)).map(drop)
    }

    /// Moves dead rows onto live ones and adds rows (MCMC, Sec. 3.4).
    ///
    /// # Errors
    /// As [`ModelState::update`], or when the device does not answer.
    pub fn refine(&mut self, refinement: Refinement) -> Result<DensifyReport> {
        self.catch_up()?;
        self.apply(|state, shared| <Dispatch as OptimOps>::refine(state, refinement, shared))
    }

    /// Clones, splits and removes rows by the mean of `statistic`, `[N, 2]`: sum and number of views (3DGS, Sec. 5.2).
    ///
    /// # Errors
    /// As [`ModelState::refine`].
    pub fn densify(&mut self, statistic: Tensor<2>, densification: Densification) -> Result<DensifyReport> {
        self.catch_up()?;
        let statistic = statistic.into_dispatch();
        self.apply(|state, shared| <Dispatch as OptimOps>::densify(state, statistic, densification, shared))
    }

    /// Removes the rows beyond `bounds`, unless all are.
    ///
    /// # Errors
    /// As [`ModelState::refine`].
    pub fn sweep(&mut self, bounds: Bounds) -> Result<DensifyReport> {
        self.catch_up()?;
        self.apply(|state, shared| <Dispatch as OptimOps>::sweep(state, bounds, shared))
    }

    /// Orders the rows along a Morton curve through the cube of `half` world units around `center`.
    ///
    /// # Errors
    /// As [`ModelState::update`].
    pub fn sort_spatially(&mut self, center: [f32; 3], half: f32) -> Result<()> {
        self.catch_up()?;
        self.apply(|state, _| <Dispatch as OptimOps>::sort_spatially(state, center, half)).map(drop)
    }

    /// Keeps the listed rows, in that order, with their moments; the others are gone.
    ///
    /// # Errors
    /// As [`ModelState::update`].
    ///
    /// # Panics
    /// If `rows` names something that is not a row.
    pub fn select_rows(&mut self, rows: Vec<u32>) -> Result<()> {
        let num_rows = self.num_rows();
        assert!(rows.iter().all(|&row| (row as usize) < num_rows), "rows of {num_rows} are selected");
        self.catch_up()?;
        self.apply(|state, _| <Dispatch as OptimOps>::select_rows(state, rows)).map(drop)
    }

    /// Lowers opacities above `max_opacity`, in (0, 1), to it, and forgets the moments of all opacities.
    ///
    /// # Errors
    /// As [`ModelState::update`].
    pub fn clamp_opacities(&mut self, max_opacity: f32) -> Result<()> {
        let max_logit = (max_opacity / (1.0 - max_opacity)).ln();
        self.apply(|state, shared| <Dispatch as OptimOps>::clamp_opacities(state, max_logit, shared)).map(drop)
    }

    /// A copy of parameters, moments and the number of updates, to go back to.
    ///
    /// # Errors
    /// As [`ModelState::update`].
    pub fn snapshot(&self) -> Result<Snapshot> {
        let (num_updates, is_lagging) = (self.num_updates, self.is_lagging);
        Ok(Snapshot {
            tensors: copied(self.tensors().clone())?,
            num_updates,
            missed: self.missed_updates(),
            is_lagging,
        })
    }

    /// Goes back to `snapshot`, which stays as it is; a closed state is open again.
    ///
    /// # Errors
    /// As [`ModelState::update`]; the state is then as it was.
    pub fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        let mut tensors = copied(snapshot.tensors.clone())?;
        tensors.status = status_tensor(Status::default(), &self.device);
        self.tensors = Some(tensors);
        self.num_updates = snapshot.num_updates;
        (self.is_lagging, self.is_prepared, self.words_since) = (snapshot.is_lagging, false, 0);
        *self.is_handed_out.get_mut() = false;
        Ok(())
    }

    /// Gives every row `num_coefficients` SH coefficients; new ones are zero, with zero moments.
    ///
    /// # Errors
    /// As [`ModelState::update`].
    ///
    /// # Panics
    /// If the rows already have more.
    pub fn widen_sh(&mut self, num_coefficients: usize) -> Result<()> {
        self.catch_up()?;
        self.apply(|state, _| <Dispatch as OptimOps>::widen_sh(state, num_coefficients)).map(drop)
    }
}

#[cfg(test)]
impl ModelState {
    /// Where the values of parameters and moments lie in the memory of a CPU.
    pub(crate) fn addresses(&mut self) -> [[usize; 5]; 3] {
        let State { params, first, second, status, last } = self.tensors.take().expect("the test sets this up");
        let mut columns = [params, first, second].map(|p| Columns::from_splats(splats(p)).expect("a CPU answers"));
        let found = columns.each_ref().map(|c| c.data.each_ref().map(|d| d.as_ptr() as usize));
        let [params, first, second] =
            columns.each_mut().map(|c| dispatched(std::mem::take(c).into_splats(&self.device)));
        self.tensors = Some(State { params, first, second, status, last });
        found
    }
}

fn status_tensor(status: Status, device: &Device) -> burn::backend::tensor::IntTensor<Dispatch> {
    let words = status.to_words().map(u32::cast_signed).to_vec();
    Tensor::<1, Int>::from_data(TensorData::new(words, [Status::NUM_WORDS]), (device, DType::I32)).into_dispatch()
}

fn dispatched(s: Splats) -> Parameters<Dispatch> {
    Parameters {
        means: s.means.into_dispatch(),
        quats: s.quats.into_dispatch(),
        log_scales: s.log_scales.into_dispatch(),
        opacity_logits: s.opacity_logits.into_dispatch(),
        sh: s.sh.into_dispatch(),
    }
}

fn splats(p: Parameters<Dispatch>) -> Splats {
    Splats {
        means: Tensor::from_dispatch(p.means),
        quats: Tensor::from_dispatch(p.quats),
        log_scales: Tensor::from_dispatch(p.log_scales),
        opacity_logits: Tensor::from_dispatch(p.opacity_logits),
        sh: Tensor::from_dispatch(p.sh),
    }
}

#[cfg(test)]
#[path = "state_tests.rs"]
mod tests;
