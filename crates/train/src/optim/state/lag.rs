//! `optim.visible_only`: SH coefficients of Gaussians that no view sees lag behind, and are caught up with when they are
//! needed.
//!
//! Only they lag. Means, quaternions, scales and opacities, 11 of 59 values, are updated in every update: who is seen is a
//! function of them, the noise of MCMC reads and moves them, and its regularisers give a gradient to each of them. So
//! nothing that the dense optimiser does is left out: what a view may see is up to date before the view is drawn, and the
//! rest before rows are moved or looked at.

use super::{ModelState, Snapshot, splats};
use crate::backend::{Changed, MissedUpdates, OptimOps};
use crate::error::Result;
use crate::optim::missed::{DENSE_UPDATES, MAX_MISSED};
use burn::backend::Dispatch;
use burn::backend::tensor::IntTensor;
use burn::tensor::{DType, Device, Int, Tensor, TensorData};
use gazesplat_core::Camera;
use gazesplat_render::Splats;
use gazesplat_render::cluster::Frustum;
use gazesplat_render::math::frustum::{Side, Sides};
use gazesplat_render::view_params::view_params;

/// Learning rates of the SH coefficients; the same in every update of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShRates {
    /// Of the constant coefficient.
    pub dc: f32,
    /// Of the others.
    pub rest: f32,
}

impl ShRates {
    /// Rates of 0.
    pub const NONE: Self = Self { dc: 0.0, rest: 0.0 };
}

/// Half-spaces outside which a view sees nothing for certain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeenBy {
    /// The sides of the image.
    pub sides: Sides,
    /// What lies in front of the camera.
    pub front: Side,
}

impl SeenBy {
    /// What `camera` may see beyond `near`, world units: every Gaussian that the renderer draws, and few others.
    ///
    /// # Errors
    /// As [`view_params`].
    pub fn new(camera: &Camera, near: f32) -> Result<Self> {
        let view = view_params(camera)?;
        let (width, height) = (camera.intrinsics.width as f32, camera.intrinsics.height as f32);
        let sides = Frustum::new(&view, width, height, near).sides;
        // Half the near plane: a device may round a depth differently in the kernel that draws.
        let offset = view.translation.z - 0.5 * near;
        Ok(Self { sides, front: Side { normal: view.rotation.row2, offset, pad: 0.0 } })
    }
}

impl ModelState {
    /// From now on rows whose SH coefficients no view sees may lag; `rates` are those that every update will have.
    ///
    /// # Panics
    /// With weight decay, which gives every value a gradient, or moments that decay too slowly for a closed form.
    pub fn let_unseen_lag(&mut self, rates: ShRates) {
        let settings = &self.settings;
        assert!(settings.weight_decay == 0.0 && settings.beta1 * settings.beta1 < settings.beta2);
        self.lag = Some(rates);
    }

    /// Brings up to date what `camera` may see beyond `near`, so that it can be drawn. The next update then changes the SH
    /// coefficients of these rows only. Without [`ModelState::let_unseen_lag`], or early in a run, it does nothing: every
    /// row is up to date then.
    ///
    /// # Errors
    /// As [`ModelState::update`]; [`crate::Error::Render`] for a camera out of range.
    pub fn prepare(&mut self, camera: &Camera, near: f32) -> Result<()> {
        let can_lag = self.lag.is_some() && self.num_coefficients() > 1 && self.num_rows() > 0;
        if !can_lag || self.num_updates < DENSE_UPDATES {
            return Ok(());
        }
        let view = SeenBy::new(camera, near)?;
        if self.num_updates.is_multiple_of(MAX_MISSED) {
            self.catch_up()?;
        }
        if !self.is_lagging {
            let words = vec![self.num_updates; self.num_rows()];
            self.tensors_mut().last = words_tensor(words, &self.device);
            (self.is_lagging, self.words_since) = (true, self.num_updates);
        }
        let missed = self.missed_updates();
        self.apply(|state, shared| <Dispatch as OptimOps>::prepare_seen(state, view, missed, shared))?;
        self.is_prepared = true;
        Ok(())
    }

    /// Brings every row up to date.
    ///
    /// # Errors
    /// As [`ModelState::update`].
    pub fn catch_up(&mut self) -> Result<()> {
        if !self.is_lagging {
            return Ok(());
        }
        let missed = self.missed_updates();
        self.apply(|state, shared| <Dispatch as OptimOps>::catch_up(state, missed, shared))?;
        // A GPU whose state a loss has closed has done nothing of it, and what it had left to do is lost with the failed
        // run: the last few per mille of a colour.
        self.tensors_mut().last = placeholder(&self.device);
        (self.is_lagging, self.is_prepared) = (false, false);
        Ok(())
    }

    /// The parameters as they are when every row is up to date, to keep. The state stays as it is, so that looking changes
    /// nothing.
    ///
    /// # Errors
    /// As [`ModelState::update`].
    pub fn current(&self) -> Result<Splats> {
        match self.is_lagging {
            true => advanced(self.tensors().clone(), self.missed_updates()),
            false => Ok(self.splats()),
        }
    }

    /// [`ModelState::current`] for a caller that drops it before the next operation.
    ///
    /// # Errors
    /// As [`ModelState::update`].
    pub(crate) fn current_lent(&self) -> Result<Splats> {
        match self.is_lagging {
            true => self.current(),
            false => Ok(self.lent()),
        }
    }

    pub(super) fn missed_updates(&self) -> MissedUpdates {
        let rates = self.lag.unwrap_or(ShRates::NONE);
        MissedUpdates { through: self.num_updates, settings: self.settings, rates }
    }
}

/// The parameters of `state`, a copy, with every row up to date.
fn advanced(state: crate::backend::State<Dispatch>, missed: MissedUpdates) -> Result<Splats> {
    let Changed { state, outcome } = <Dispatch as OptimOps>::advanced(state, missed);
    outcome?;
    Ok(splats(state.params))
}

impl Snapshot {
    /// The parameters, every row up to date, for a caller that changes nothing.
    ///
    /// # Errors
    /// As [`ModelState::update`].
    pub fn splats(&self) -> Result<Splats> {
        match self.is_lagging {
            true => advanced(self.tensors.clone(), self.missed),
            false => Ok(splats(self.tensors.params.clone())),
        }
    }
}

/// Whether words of rows can be those of a model after `num_updates` updates.
pub(crate) fn are_words_valid(words: &[u32], num_updates: u32) -> bool {
    let oldest = num_updates.saturating_sub(MAX_MISSED).max(DENSE_UPDATES.min(num_updates));
    words.iter().all(|word| (oldest..=num_updates).contains(&(word & !crate::optim::missed::PREPARED)))
}

/// Words of rows as a tensor.
pub(super) fn words_tensor(words: Vec<u32>, device: &Device) -> IntTensor<Dispatch> {
    let len = words.len();
    let words: Vec<i32> = words.into_iter().map(u32::cast_signed).collect();
    Tensor::<1, Int>::from_data(TensorData::new(words, [len]), (device, DType::I32)).into_dispatch()
}

/// What stands in a state where no row lags: a device has no buffer without a word.
pub(super) fn placeholder(device: &Device) -> IntTensor<Dispatch> {
    words_tensor(vec![0], device)
}

/// Words of rows as they are on the host.
pub(super) fn words_of(tensor: IntTensor<Dispatch>) -> Result<Vec<u32>> {
    let words = Tensor::<1, Int>::from_dispatch(tensor);
    let data = words.try_into_data().map_err(|e| gazesplat_render::Error::device(&e))?;
    // A GPU copies on the first access: that can fail, too. Its words are unsigned, a CPU's signed: the bits are the same.
    let data = data.convert_dtype(DType::I32);
    let words: Vec<i32> = data.try_into_vec().map_err(|e| gazesplat_render::Error::device(&e))?;
    Ok(bytemuck::cast_vec(words))
}

#[cfg(test)]
#[path = "lag_tests.rs"]
mod tests;
