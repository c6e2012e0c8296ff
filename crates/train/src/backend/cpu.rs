//! Training on the CPU backends: tensors to vectors, vectors through the kernels, vectors to tensors; all without a copy
//! as long as nothing else shares the tensors.

use super::{
    AdamUpdate, Changed, Densification, MissedUpdates, NoiseUpdate, OptimOps, Refinement, State, StatisticStep, Status,
};
use crate::densify::Bounds;
use crate::event::DensifyReport;
use crate::kernels::cpu::{
    adam,
    densify::{add_statistic, densify},
    noise::add_noise,
    regularize::regularize,
    relocate::refine,
    rows::Rows,
    scale_decay::add_scale_decay,
    seen::{self, Missing},
    sweep::sweep,
};
use crate::optim::missed::missed;
use crate::optim::{Columns, Group, LearningRates, SeenBy};
use burn::backend::{
    NdArray,
    tensor::{FloatTensor, IntTensor},
};
use gazesplat_render::backend::Parameters;
use gazesplat_render::host::{HostTensors, shape_of};

/// The values of the tensors; free where they are contiguous and not shared.
fn columns<B: HostTensors>(p: Parameters<B>) -> Columns {
    let num_coefficients = shape_of::<B>(&p.sh)[1];
    let data = [p.means, p.quats, p.log_scales, p.opacity_logits, p.sh].map(B::f32_into_vec);
    Columns { data, widths: [3, 4, 3, 1, 3 * num_coefficients] }
}

fn parameters<B: HostTensors>(columns: Columns) -> Parameters<B> {
    let (n, num_coefficients) = (columns.num_rows(), columns.num_coefficients());
    let [means, quats, log_scales, opacity_logits, sh] = columns.data;
    Parameters {
        means: B::f32_tensor(means, &[n, 3]),
        quats: B::f32_tensor(quats, &[n, 4]),
        log_scales: B::f32_tensor(log_scales, &[n, 3]),
        opacity_logits: B::f32_tensor(opacity_logits, &[n]),
        sh: B::f32_tensor(sh, &[n, num_coefficients, 3]),
    }
}

fn status_of<B: HostTensors>(status: &IntTensor<B>) -> Status {
    let words = B::i32_slice(status);
    Status::from_words(std::array::from_fn(|i| words[i].cast_unsigned()))
}

fn status_tensor<B: HostTensors>(status: Status) -> IntTensor<B> {
    B::i32_tensor(status.to_words().map(u32::cast_signed).to_vec(), &[Status::NUM_WORDS])
}

/// Runs `change` on the rows of `state`, unless it is closed.
fn with_rows<B: HostTensors>(
    state: State<B>,
    change: impl FnOnce(&mut Rows, &mut Status) -> DensifyReport,
) -> Changed<B> {
    let mut status = status_of::<B>(&state.status);
    if status.failed.is_some() {
        let num_gaussians = shape_of::<B>(&state.params.opacity_logits)[0];
        return Changed { state, outcome: Ok(DensifyReport { num_gaussians, ..DensifyReport::default() }) };
    }
    let State { params, first, second, status: words, last } = state;
    let mut rows = Rows { params: columns::<B>(params), first: columns::<B>(first), second: columns::<B>(second) };
    let before = status;
    let outcome = change(&mut rows, &mut status);
    let state = State {
        params: parameters::<B>(rows.params),
        first: parameters::<B>(rows.first),
        second: parameters::<B>(rows.second),
        status: if status == before { words } else { status_tensor::<B>(status) },
        last,
    };
    Changed { state, outcome: Ok(outcome) }
}

fn host_adam<B: HostTensors>(
    mut state: State<B>,
    gradients: Parameters<B>,
    loss: &FloatTensor<B>,
    update: &AdamUpdate,
) -> Changed<B> {
    let loss = B::f32_slice(loss)[0];
    let status = status_of::<B>(&state.status);
    if status.failed.is_none() && !loss.is_finite() {
        state.status = status_tensor::<B>(Status { failed: Some((update.number, loss)), ..status });
    }
    let mut words = if update.marked_only { words::<B>(&state.last) } else { Vec::new() };
    let mut changed = with_rows::<B>(state, |rows, status| {
        let mut gradients = columns::<B>(gradients);
        gradients.widths = rows.params.widths;
        [status.mean_opacity, status.mean_scale] = regularize(&rows.params, &mut gradients, update.regularizers);
        let step = adam::Step::new(&update.settings, update.number);
        if update.marked_only {
            let sh = std::mem::take(gradients.of_mut(Group::Sh));
            let lanes = update.rates.lanes(Group::Sh, rows.params.widths[Group::Sh as usize]);
            let table = missed(&update.settings, update.number - 1);
            let missing = Missing { table: &table, through: update.number - 1, lanes: &lanes };
            seen::update_seen(rows, &sh, &mut words, &missing, &step);
        }
        adam::update_all(rows, &gradients, &update.rates, &step);
        DensifyReport { num_gaussians: rows.num_rows(), ..DensifyReport::default() }
    });
    if update.marked_only {
        changed.state.last = words_tensor::<B>(words);
    }
    changed
}

/// Words of rows that lag.
fn words<B: HostTensors>(last: &IntTensor<B>) -> Vec<u32> {
    bytemuck::cast_slice(&B::i32_slice(last)).to_vec()
}

fn words_tensor<B: HostTensors>(words: Vec<u32>) -> IntTensor<B> {
    let len = words.len();
    B::i32_tensor(bytemuck::cast_vec(words), &[len])
}

/// Learning rates of the SH coefficients of a row of `width` values.
fn lanes(missed: &MissedUpdates, width: usize) -> Vec<f32> {
    LearningRates { sh_dc: missed.rates.dc, sh_rest: missed.rates.rest, ..LearningRates::NONE }.lanes(Group::Sh, width)
}

fn host_prepare<B: HostTensors>(state: State<B>, view: &SeenBy, missed_updates: &MissedUpdates) -> Changed<B> {
    let mut words = words::<B>(&state.last);
    let mut changed = with_rows::<B>(state, |rows, _| {
        let lanes = lanes(missed_updates, rows.params.widths[Group::Sh as usize]);
        let table = missed(&missed_updates.settings, missed_updates.through);
        let missing = Missing { table: &table, through: missed_updates.through, lanes: &lanes };
        seen::prepare(&mut rows.params, &rows.first, &rows.second, &mut words, view, &missing);
        DensifyReport { num_gaussians: rows.num_rows(), ..DensifyReport::default() }
    });
    changed.state.last = words_tensor::<B>(words);
    changed
}

fn host_catch_up<B: HostTensors>(state: State<B>, missed_updates: &MissedUpdates) -> Changed<B> {
    let words = words::<B>(&state.last);
    with_rows::<B>(state, |rows, _| {
        let lanes = lanes(missed_updates, rows.params.widths[Group::Sh as usize]);
        let table = missed(&missed_updates.settings, missed_updates.through);
        seen::catch_up(rows, &words, &Missing { table: &table, through: missed_updates.through, lanes: &lanes });
        DensifyReport { num_gaussians: rows.num_rows(), ..DensifyReport::default() }
    })
}

fn host_advanced<B: HostTensors>(mut state: State<B>, missed_updates: &MissedUpdates) -> Changed<B> {
    let words = words::<B>(&state.last);
    if status_of::<B>(&state.status).failed.is_none() {
        let shape = shape_of::<B>(&state.params.sh);
        let lanes = lanes(missed_updates, shape[1] * shape[2]);
        let table = missed(&missed_updates.settings, missed_updates.through);
        let missing = Missing { table: &table, through: missed_updates.through, lanes: &lanes };
        let mut values = B::f32_slice(&state.params.sh).into_owned();
        seen::advance(&mut values, &B::f32_slice(&state.first.sh), &B::f32_slice(&state.second.sh), &words, &missing);
        state.params.sh = B::f32_tensor(values, &shape);
    }
    Changed { state, outcome: Ok(DensifyReport { num_gaussians: words.len(), ..DensifyReport::default() }) }
}

/// Runs `change`, which moves no row onto another and adds none.
fn changed<B: HostTensors>(state: State<B>, change: impl FnOnce(&mut Rows)) -> Changed<B> {
    with_rows::<B>(state, |rows, _| {
        change(rows);
        DensifyReport { num_gaussians: rows.num_rows(), ..DensifyReport::default() }
    })
}

fn host_scale_decay<B: HostTensors>(
    log_scales: &FloatTensor<B>,
    mut gradients: FloatTensor<B>,
    used: &IntTensor<B>,
    factor: f32,
) -> FloatTensor<B> {
    let (log_scales, used) = (B::f32_slice(log_scales), B::i32_slice(used));
    add_scale_decay(&log_scales, B::f32_slice_mut(&mut gradients), bytemuck::cast_slice(&used), factor);
    gradients
}

fn host_statistic<B: HostTensors>(
    mut statistic: FloatTensor<B>,
    gradient: &FloatTensor<B>,
    visible: &IntTensor<B>,
    step: &StatisticStep,
) -> FloatTensor<B> {
    let (gradient, visible) = (B::f32_slice(gradient), B::i32_slice(visible));
    let visible = &bytemuck::cast_slice::<i32, u32>(&visible)[..step.num_visible];
    add_statistic(B::f32_slice_mut(&mut statistic), &gradient, visible, step);
    statistic
}

/// The same host implementation serves every CPU backend.
macro_rules! host_optim_ops {
    ($backend:ty) => {
        impl OptimOps for $backend {
            fn adam(
                state: State<Self>,
                gradients: Parameters<Self>,
                loss: FloatTensor<Self>,
                update: AdamUpdate,
                _shared: bool,
            ) -> Changed<Self> {
                host_adam(state, gradients, &loss, &update)
            }

            fn prepare_seen(state: State<Self>, view: SeenBy, missed: MissedUpdates, _shared: bool) -> Changed<Self> {
                host_prepare(state, &view, &missed)
            }

            fn catch_up(state: State<Self>, missed: MissedUpdates, _shared: bool) -> Changed<Self> {
                host_catch_up(state, &missed)
            }

            fn advanced(state: State<Self>, missed: MissedUpdates) -> Changed<Self> {
                host_advanced(state, &missed)
            }

            fn add_noise(state: State<Self>, noise: NoiseUpdate, _shared: bool) -> Changed<Self> {
                changed(state, |rows| add_noise(&mut rows.params, noise.strength, noise.seed, noise.step))
            }

            fn refine(state: State<Self>, refinement: Refinement, _shared: bool) -> Changed<Self> {
                with_rows(state, |rows, _| refine(rows, &refinement))
            }

            fn add_statistic(
                statistic: FloatTensor<Self>,
                gradient: FloatTensor<Self>,
                visible: IntTensor<Self>,
                step: StatisticStep,
            ) -> FloatTensor<Self> {
                host_statistic::<Self>(statistic, &gradient, &visible, &step)
            }

            fn densify(
                state: State<Self>,
                statistic: FloatTensor<Self>,
                densification: Densification,
                _shared: bool,
            ) -> Changed<Self> {
                let statistic = Self::f32_into_vec(statistic);
                with_rows(state, |rows, _| densify(rows, &statistic, &densification))
            }

            fn sweep(state: State<Self>, bounds: Bounds, _shared: bool) -> Changed<Self> {
                with_rows(state, |rows, _| sweep(rows, &bounds))
            }

            fn sort_spatially(state: State<Self>, _center: [f32; 3], _half: f32) -> Changed<Self> {
                changed(state, Rows::sort_spatially)
            }

            fn select_rows(state: State<Self>, rows: Vec<u32>) -> Changed<Self> {
                changed(state, |state| state.reorder(&rows))
            }

            fn clamp_opacities(state: State<Self>, max_logit: f32, _shared: bool) -> Changed<Self> {
                changed(state, |rows| rows.clamp_opacities(max_logit))
            }

            fn copied(state: State<Self>) -> Changed<Self> {
                let num_gaussians = shape_of::<Self>(&state.params.opacity_logits)[0];
                Changed { state, outcome: Ok(DensifyReport { num_gaussians, ..DensifyReport::default() }) }
            }

            fn add_scale_decay(
                log_scales: FloatTensor<Self>,
                gradients: FloatTensor<Self>,
                used: IntTensor<Self>,
                factor: f32,
            ) -> FloatTensor<Self> {
                host_scale_decay::<Self>(&log_scales, gradients, &used, factor)
            }

            fn widen_sh(state: State<Self>, num_coefficients: usize) -> Changed<Self> {
                changed(state, |rows| rows.widen_sh(num_coefficients))
            }
        }
    };
}

host_optim_ops!(NdArray);
#[cfg(feature = "flex")]
host_optim_ops!(burn::backend::Flex);
