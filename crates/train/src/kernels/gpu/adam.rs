//! Adam (Kingma 2015, Algorithm 1) over all parameter groups in one pass, the regularisers' gradients with it.
//!
//! One unit per value of the packed parameters; its group follows from where it lies. Parameters and moments are
//! overwritten in place: the caller owns them. Memory bound as on the CPU: 28 bytes per value. NaN goes into the
//! parameter and its moments, and the row counts as broken from then on; the padding between groups is updated with
//! what lies there and never read; nothing is done while the status is closed.

use super::regularize::{opacity_gradient, scale_gradient};
use super::rows::{Sections, SectionsLaunch};
use crate::backend::AdamUpdate;
use crate::kernels::cpu::adam::Step;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::gpu::device_fn::is_finite;
use gazesplat_render::gpu::{Gpu, cube_dim, packed::PackedLayout};

/// Learning rates of one update with the bias correction of the first moment.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
pub struct Rates {
    pub means: f32,
    pub quats: f32,
    pub log_scales: f32,
    pub opacity_logits: f32,
    pub sh_dc: f32,
    pub sh_rest: f32,
    /// Weight of the mean opacity over N.
    pub opacity_factor: f32,
    /// Weight of the mean scale over 3 N.
    pub scale_factor: f32,
}

/// Constants of one update, as in the twin on the CPU.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
pub struct Constants {
    pub beta1: f32,
    pub one_minus_beta1: f32,
    pub beta2: f32,
    pub one_minus_beta2: f32,
    pub epsilon: f32,
    pub weight_decay: f32,
    pub inverse_sqrt_bias2: f32,
}

/// Parameters, gradients and both moments, packed the same way.
#[derive(Debug, Clone)]
pub struct Packed<'a> {
    /// Overwritten.
    pub params: &'a CubeTensor,
    /// Read.
    pub grads: &'a CubeTensor,
    /// Overwritten.
    pub first: &'a CubeTensor,
    /// Overwritten.
    pub second: &'a CubeTensor,
}

/// Closes the status, `[4]`, if `loss`, `[1]`, is not finite and it is open.
pub fn watch(gpu: &Gpu, loss: CubeTensor, status: &CubeTensor, number: u32) {
    close_if_broken::launch(
        &gpu.client,
        gpu.cubes(1),
        cube_dim(),
        loss.into_buffer_arg(),
        status.clone().into_buffer_arg(),
        number,
    );
}

#[cube(launch)]
fn close_if_broken(loss: &[f32], status: &mut [u32], number: u32) {
    if ABSOLUTE_POS == 0 {
        let value = loss[0];
        if status[0] == 0u32 && !is_finite(value) {
            status[0] = number;
            status[1] = u32::reinterpret(value);
        }
    }
}

/// One update of all groups; without the SH coefficients if the update is of marked rows only: those are
/// [`super::seen::update_seen`]'s.
pub fn update_all(gpu: &Gpu, layout: &PackedLayout, packed: &Packed<'_>, status: &CubeTensor, update: &AdamUpdate) {
    let len = if update.marked_only { layout.offsets[4] } else { layout.len() };
    let step = Step::new(&update.settings, update.number);
    let (rates, weights) = (&update.rates, update.regularizers);
    let num_rows = layout.num_rows as f32;
    update_values::launch(
        &gpu.client,
        gpu.units(len),
        cube_dim(),
        packed.params.clone().into_buffer_arg(),
        packed.grads.clone().into_buffer_arg(),
        packed.first.clone().into_buffer_arg(),
        packed.second.clone().into_buffer_arg(),
        status.clone().into_buffer_arg(),
        SectionsLaunch::of(layout),
        RatesLaunch::new(
            step.rate(rates.means),
            step.rate(rates.quats),
            step.rate(rates.log_scales),
            step.rate(rates.opacity_logits),
            step.rate(rates.sh_dc),
            step.rate(rates.sh_rest),
            weights.opacity / num_rows,
            weights.scale / (3.0 * num_rows),
        ),
        ConstantsLaunch::new(
            step.beta1,
            step.one_minus_beta1,
            step.beta2,
            step.one_minus_beta2,
            step.epsilon,
            step.weight_decay,
            step.inverse_sqrt_bias2,
        ),
        len as u32,
    );
}

#[cube(launch)]
fn update_values(
    params: &mut [f32],
    grads: &[f32],
    first: &mut [f32],
    second: &mut [f32],
    status: &[u32],
    at: Sections,
    rates: Rates,
    step: Constants,
    len: u32,
) {
    let i = ABSOLUTE_POS;
    let place = ABSOLUTE_POS as u32;
    if i < len as usize && status[0] == 0u32 {
        let p = params[i];
        let mut g = grads[i];
        // 1. The group: its rate, and the regulariser's gradient.
        let mut rate = rates.means;
        if place >= at.sh {
            rate = rates.sh_rest;
            if (place - at.sh) % at.sh_width < 3u32 {
                rate = rates.sh_dc;
            }
        } else if place >= at.opacity_logits {
            rate = rates.opacity_logits;
            g += opacity_gradient(p, rates.opacity_factor);
        } else if place >= at.log_scales {
            rate = rates.log_scales;
            g += scale_gradient(p, rates.scale_factor);
        } else if place >= at.quats {
            rate = rates.quats;
        }
        // 2. Moments and the step.
        g += step.weight_decay * p;
        let m = flushed(step.beta1 * first[i] + step.one_minus_beta1 * g);
        let v = flushed(step.beta2 * second[i] + step.one_minus_beta2 * g * g);
        first[i] = m;
        second[i] = v;
        params[i] = p - rate * m / (f32::sqrt(v) * step.inverse_sqrt_bias2 + step.epsilon);
    }
}

/// 0 for what would be a denormal number soon.
#[cube]
pub fn flushed(v: f32) -> f32 {
    let mut kept = v;
    if f32::abs(v) < 1e-37f32 {
        kept = 0.0f32;
    }
    kept
}
