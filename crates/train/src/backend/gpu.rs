//! Training on a GPU: tensors to packed buffers, buffers through the kernels, views of them back.
//!
//! Parameters and moments each lie in one allocation ([`PackedLayout`]), so that one kernel reaches all of them. They are
//! overwritten in place. Moments belong to the state alone; parameters do unless the caller says `shared`, which costs a
//! copy: the reference count of an allocation with five views of it cannot tell.

use super::{
    AdamUpdate, Changed, Densification, MissedUpdates, NoiseUpdate, OptimOps, Refinement, State, StatisticStep,
};
use crate::densify::Bounds;
use crate::event::DensifyReport;
use crate::kernels::gpu::adam::{self, Packed};
use crate::kernels::gpu::densify::{add_statistic, densify};
use crate::kernels::gpu::noise::add_noise;
use crate::kernels::gpu::regularize::regularize;
use crate::kernels::gpu::relocate::refine;
use crate::kernels::gpu::rows::{Listed, PackedRows, clamp_opacities, copied, copied_words, morton_order};
use crate::kernels::gpu::scale_decay::add_scale_decay;
use crate::kernels::gpu::seen;
use crate::kernels::gpu::sweep::sweep;
use crate::optim::SeenBy;
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn_cubecl::CubeBackend;
use gazesplat_render::Result;
use gazesplat_render::backend::Parameters;
use gazesplat_render::gpu::{Gpu, contiguous, packed::PackedLayout};

type GpuState = State<CubeBackend>;
type GpuParameters = Parameters<CubeBackend>;

/// The buffers of `state`; a copy of the parameters if they are `shared`.
fn pack(gpu: &Gpu, state: &GpuState, shared: bool) -> Result<PackedRows> {
    let (layout, mut params) = PackedLayout::pack(gpu, state.params.clone())?;
    if shared {
        params = copied(gpu, params, layout.len())?;
    }
    let (_, first) = PackedLayout::pack(gpu, state.first.clone())?;
    let (_, second) = PackedLayout::pack(gpu, state.second.clone())?;
    Ok(PackedRows { layout, params, first, second })
}

/// Runs `change` on the buffers of `state`; an empty model has nothing to change.
fn changed(
    state: GpuState,
    shared: bool,
    change: impl FnOnce(&Gpu, PackedRows, &GpuState) -> Result<(PackedRows, DensifyReport)>,
) -> Changed<CubeBackend> {
    if state.params.opacity_logits.meta.num_elements() == 0 {
        return Changed { state, outcome: Ok(DensifyReport::default()) };
    }
    let gpu = Gpu::of(&state.status);
    match pack(&gpu, &state, shared).and_then(|rows| change(&gpu, rows, &state)) {
        Ok((PackedRows { layout, params, first, second }, report)) => {
            let [params, first, second] = [params, first, second].map(|whole| layout.views(&whole));
            Changed {
                state: State { params, first, second, status: state.status, last: state.last },
                outcome: Ok(report),
            }
        }
        Err(error) => Changed { state, outcome: Err(error) },
    }
}

/// A report of a change that moves no row onto another and adds none.
fn unmoved(rows: PackedRows) -> (PackedRows, DensifyReport) {
    let report = DensifyReport { num_gaussians: rows.layout.num_rows, ..DensifyReport::default() };
    (rows, report)
}

impl OptimOps for CubeBackend {
    fn adam(
        state: GpuState,
        gradients: GpuParameters,
        loss: FloatTensor<Self>,
        update: AdamUpdate,
        shared: bool,
    ) -> Changed<Self> {
        changed(state, shared, |gpu, rows, state| {
            let (_, grads) = PackedLayout::pack(gpu, gradients)?;
            adam::watch(gpu, loss, &state.status, update.number);
            if update.report {
                regularize(gpu, &rows.layout, &rows.params, &state.status)?;
            }
            let PackedRows { layout, params, first, second } = &rows;
            let packed = Packed { params, grads: &grads, first, second };
            adam::update_all(gpu, layout, &packed, &state.status, &update);
            if update.marked_only {
                seen::update_seen(gpu, &rows, &grads, &state.last, &state.status, &update);
            }
            Ok(unmoved(rows))
        })
    }

    fn prepare_seen(state: GpuState, view: SeenBy, missed: MissedUpdates, shared: bool) -> Changed<Self> {
        changed(state, shared, |gpu, rows, state| {
            seen::prepare(gpu, &rows, &state.last, &state.status, &view, missed)?;
            Ok(unmoved(rows))
        })
    }

    fn catch_up(state: GpuState, missed: MissedUpdates, shared: bool) -> Changed<Self> {
        changed(state, shared, |gpu, rows, state| {
            seen::catch_up(gpu, &rows, &state.last, &state.status, missed)?;
            Ok(unmoved(rows))
        })
    }

    fn advanced(state: GpuState, missed: MissedUpdates) -> Changed<Self> {
        changed(state, true, |gpu, rows, state| {
            seen::advance(gpu, &rows, &state.last, &state.status, missed)?;
            Ok(unmoved(rows))
        })
    }

    fn add_noise(state: GpuState, noise: NoiseUpdate, shared: bool) -> Changed<Self> {
        changed(state, shared, |gpu, rows, state| {
            add_noise(gpu, &rows.layout, &rows.params, &state.status, &noise);
            Ok(unmoved(rows))
        })
    }

    fn refine(state: GpuState, refinement: Refinement, shared: bool) -> Changed<Self> {
        changed(state, shared, |gpu, rows, state| refine(gpu, rows, &state.status, &refinement))
    }

    fn add_statistic(
        statistic: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
        visible: IntTensor<Self>,
        step: StatisticStep,
    ) -> FloatTensor<Self> {
        let gpu = Gpu::of(&statistic);
        let statistic = contiguous(statistic);
        add_statistic(&gpu, &statistic, &contiguous(gradient), &visible, &step);
        statistic
    }

    fn densify(
        state: GpuState,
        statistic: FloatTensor<Self>,
        densification: Densification,
        shared: bool,
    ) -> Changed<Self> {
        let statistic = contiguous(statistic);
        changed(state, shared, |gpu, rows, state| densify(gpu, rows, &state.status, &statistic, &densification))
    }

    fn sweep(state: GpuState, bounds: Bounds, shared: bool) -> Changed<Self> {
        changed(state, shared, |gpu, rows, state| sweep(gpu, rows, &state.status, &bounds))
    }

    fn sort_spatially(state: GpuState, center: [f32; 3], half: f32) -> Changed<Self> {
        changed(state, false, |gpu, rows, _| {
            let order = morton_order(gpu, &rows.layout, &rows.params, center, half)?;
            rows.selected(gpu, rows.layout, &order, Listed::Only).map(unmoved)
        })
    }

    fn select_rows(state: GpuState, rows: Vec<u32>) -> Changed<Self> {
        changed(state, false, |gpu, from, _| {
            let new = PackedLayout::new(rows.len(), from.layout.num_coefficients);
            let list = gpu.upload_u32(&rows, &[rows.len()]);
            from.selected(gpu, new, &list, Listed::Only).map(unmoved)
        })
    }

    fn clamp_opacities(state: GpuState, max_logit: f32, shared: bool) -> Changed<Self> {
        changed(state, shared, |gpu, rows, _| {
            clamp_opacities(gpu, &rows.layout, &rows.params, &rows.first, &rows.second, max_logit);
            Ok(unmoved(rows))
        })
    }

    fn copied(state: GpuState) -> Changed<Self> {
        let mut copy = changed(state, true, |gpu, mut rows, _| {
            rows.first = copied(gpu, rows.first, rows.layout.len())?;
            rows.second = copied(gpu, rows.second, rows.layout.len())?;
            Ok(unmoved(rows))
        });
        let len = copy.state.last.meta.num_elements();
        match copied_words(&Gpu::of(&copy.state.status), &copy.state.last, len) {
            Ok(last) => copy.state.last = last,
            Err(error) => copy.outcome = Err(error),
        }
        copy
    }

    fn add_scale_decay(
        log_scales: FloatTensor<Self>,
        gradients: FloatTensor<Self>,
        used: IntTensor<Self>,
        factor: f32,
    ) -> FloatTensor<Self> {
        let gpu = Gpu::of(&gradients);
        let gradients = contiguous(gradients);
        add_scale_decay(&gpu, &contiguous(log_scales), &gradients, &used, factor);
        gradients
    }

    fn widen_sh(state: GpuState, num_coefficients: usize) -> Changed<Self> {
        changed(state, false, |gpu, rows, _| {
            let new = PackedLayout::new(rows.layout.num_rows, num_coefficients);
            let none = gpu.upload_u32(&[], &[0]);
            rows.selected(gpu, new, &none, Listed::Copied).map(unmoved)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::Status;
    use crate::config::OptimSection;
    use crate::optim::{AdamSettings, LearningRates, Regularizers};
    use burn::tensor::DType;
    use gazesplat_render::device::gpu_device;
    use gazesplat_testkit::devices::required_gpu;

    #[test]
    fn an_update_writes_where_the_values_are_unless_they_are_shared() {
        let Some(gpu) = required_gpu(gpu_device(None)).and_then(|device| Gpu::from_device(&device)) else { return };
        let layout = PackedLayout::new(100, 4);
        let zeros = || {
            let whole = gpu.zeros("bytes of a test", &[layout.len()], DType::F32).expect("it fits");
            layout.views(&whole)
        };
        let status = gpu.upload_u32(&Status::default().to_words(), &[Status::NUM_WORDS]);
        let last = gpu.upload_u32(&[0], &[1]);
        let state = State { params: zeros(), first: zeros(), second: zeros(), status, last };
        let is_same =
            |a: &GpuParameters, b: &GpuParameters| a.sh.handle.memory.descriptor() == b.sh.handle.memory.descriptor();
        let update = AdamUpdate {
            number: 1,
            settings: AdamSettings::default(),
            rates: LearningRates::at(&OptimSection::default(), 0, 10, 1.0),
            regularizers: Regularizers::default(),
            report: false,
            marked_only: false,
        };
        for shared in [false, true] {
            let loss = gpu.zeros("bytes of a test", &[1], DType::F32).expect("it fits");
            let Changed { state: after, outcome } = CubeBackend::adam(state.clone(), zeros(), loss, update, shared);
            outcome.expect("it fits");
            assert_eq!(is_same(&after.params, &state.params), !shared);
            assert!(is_same(&after.first, &state.first) && is_same(&after.second, &state.second));
        }
    }
}
