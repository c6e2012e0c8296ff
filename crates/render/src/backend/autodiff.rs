//! The hand-written backward pass, hooked into Burn's autodiff.

use super::{Backward, Forward, Frame, Parameters, Probe, RenderOps, Saved, Wanted, host::shape_of};
use crate::error::Error;
use burn::backend::{
    Autodiff, AutodiffBackend,
    autodiff::{
        checkpoint::{base::Checkpointer, strategy::CheckpointStrategy},
        grads::Gradients,
        ops::{self, Backward as _, Ops, OpsKind},
    },
    tensor::FloatTensor,
};

/// What the backward pass of a frame needs.
#[derive(Debug, Clone)]
struct State<B: RenderOps> {
    parameters: Parameters<B>,
    saved: Saved<B>,
    frame: Frame,
    wanted: Wanted,
}

#[derive(Debug)]
struct RenderBackward;

impl<B: RenderOps> ops::Backward<B, 7> for RenderBackward {
    type State = State<B>;

    fn backward(self, ops: Ops<Self::State, 7>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let v_image = grads.consume::<B>(&ops.node);
        let State { parameters, saved, frame, wanted } = ops.state;
        let Backward { parameters: v, probe } = B::render_backward(parameters, saved, v_image, frame, wanted);
        let values = [v.means, v.quats, v.log_scales, v.opacity_logits, v.sh, probe.means2d, probe.pose];
        for (parent, value) in ops.parents.into_iter().zip(values) {
            if let Some(node) = parent {
                grads.register::<B>(node.id, value);
            }
        }
    }
}

/// A stop that the colour decides is no function with a gradient, and nothing is kept for one.
fn no_gradient_through_a_table() -> Error {
    Error::Parameter {
        name: "termination",
        found: "a table for a model whose gradient is tracked".to_owned(),
        expected: "a fixed transmittance, or a model without its graph",
    }
}

/// The tensors of a tracked model without their graph.
fn primitives<B: RenderOps, C: CheckpointStrategy>(p: Parameters<Autodiff<B, C>>) -> Parameters<B> {
    Parameters {
        means: p.means.into_primitive(),
        quats: p.quats.into_primitive(),
        log_scales: p.log_scales.into_primitive(),
        opacity_logits: p.opacity_logits.into_primitive(),
        sh: p.sh.into_primitive(),
    }
}

/// Saved tensors as constants of the graph.
fn constants<B: RenderOps, C: CheckpointStrategy>(s: Saved<B>) -> Saved<Autodiff<B, C>> {
    Saved {
        lanes: Autodiff::<B, C>::from_inner(s.lanes),
        final_t: Autodiff::<B, C>::from_inner(s.final_t),
        global_from_compact: s.global_from_compact,
        tile_offsets: s.tile_offsets,
        pair_splats: s.pair_splats,
        record_offsets: s.record_offsets,
        record_pairs: s.record_pairs,
        tile_ends: s.tile_ends,
        stop: s.stop,
    }
}

impl<B: RenderOps, C: CheckpointStrategy> RenderOps for Autodiff<B, C> {
    fn render_forward(parameters: Parameters<Self>, probe: Probe<Self>, frame: Frame) -> Forward<Self> {
        let nodes = [
            parameters.means.node(),
            parameters.quats.node(),
            parameters.log_scales.node(),
            parameters.opacity_logits.node(),
            parameters.sh.node(),
            probe.means2d.node(),
            probe.pose.node(),
        ];
        let prepared = RenderBackward.prepare::<C>(nodes).compute_bound().stateful();
        let parameters = primitives::<B, C>(parameters);
        let inner_probe = Probe { means2d: probe.means2d.into_primitive(), pose: probe.pose.into_primitive() };
        let asks = |leaf: &FloatTensor<B>| shape_of::<B>(leaf)[0] > 0;
        let wanted = Wanted { means2d: asks(&inner_probe.means2d), pose: asks(&inner_probe.pose) };
        match prepared {
            OpsKind::Tracked(prepared) => {
                let has_table = frame.raster.lut.is_some();
                let frame = Frame { keep: !has_table, ..frame };
                let out = B::render_forward(parameters.clone(), inner_probe, frame.clone());
                let outcome = if has_table { Err(no_gradient_through_a_table()) } else { out.outcome };
                let saved = constants::<B, C>(out.saved.clone());
                let state = State { parameters, saved: out.saved, frame, wanted };
                Forward { image: prepared.finish(state, out.image), saved, outcome }
            }
            OpsKind::UnTracked(prepared) => {
                let out = B::render_forward(parameters, inner_probe, frame);
                let saved = constants::<B, C>(out.saved);
                Forward { image: prepared.finish(out.image), saved, outcome: out.outcome }
            }
        }
    }

    fn render_backward(
        _: Parameters<Self>,
        _: Saved<Self>,
        _: FloatTensor<Self>,
        _: Frame,
        _: Wanted,
    ) -> Backward<Self> {
        panic!("the renderer has no second derivative: call `backward` once per frame")
    }
}
