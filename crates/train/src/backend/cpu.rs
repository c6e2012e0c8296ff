//! Training on the CPU backends: tensors to vectors, vectors through the kernels, vectors to tensors; all without a copy
//! as long as nothing else shares the tensors.

use super::{AdamUpdate, Changed, Densification, NoiseUpdate, OptimOps, Refinement, State, StatisticStep, Status};
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
    sweep::sweep,
};
use crate::optim::Columns;
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
    let State { params, first, second, status: words } = state;
    let mut rows = Rows { params: columns::<B>(params), first: columns::<B>(first), second: columns::<B>(second) };
    let before = status;
    let outcome = change(&mut rows, &mut status);
    let state = State {
        params: parameters::<B>(rows.params),
        first: parameters::<B>(rows.first),
        second: parameters::<B>(rows.second),
        status: if status == before { words } else { status_tensor::<B>(status) },
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
    with_rows::<B>(state, |rows, status| {
        let mut gradients = columns::<B>(gradients);
        gradients.widths = rows.params.widths;
        [status.mean_opacity, status.mean_scale] = regularize(&rows.params, &mut gradients, update.regularizers);
        adam::update_all(rows, &gradients, &update.rates, &adam::Step::new(&update.settings, update.number));
        DensifyReport { num_gaussians: rows.num_rows(), ..DensifyReport::default() }
    })
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
