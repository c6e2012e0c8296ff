//! The renderer on the CPU backends: tensors to slices, slices through the kernels, slices to tensors.

use super::host::{HostTensors, shape_of};
use super::{Backward, Forward, Frame, Parameters, Probe, RenderOps, Saved, Wanted};
use crate::cluster::clusters;
use crate::error::Result;
use crate::kernels::cpu::{
    bin::{BinExtras, TileGrid, TileLists, bin},
    pose_bwd::pose_bwd,
    project::{GaussianSlices, ProjectedSplats, project},
    project_bwd::project_bwd,
    rasterize::{Raster, rasterize},
    rasterize_bwd::rasterize_bwd,
    stats::{StatsLevel, splat_stats},
};
use crate::layout::{CLUSTER, lane};
use crate::options::StatsMode;
use crate::stats::{RenderStats, SplatStats};
use burn::backend::{
    NdArray,
    tensor::{FloatTensor, IntTensor},
};
use std::borrow::Cow;

/// Calls `f` with the parameters as slices.
fn with_slices<B: HostTensors, R>(p: &Parameters<B>, sh_degree: u32, f: impl FnOnce(&GaussianSlices<'_>) -> R) -> R {
    let (means, quats) = (B::f32_slice(&p.means), B::f32_slice(&p.quats));
    let (log_scales, opacity_logits) = (B::f32_slice(&p.log_scales), B::f32_slice(&p.opacity_logits));
    let sh = B::f32_slice(&p.sh);
    f(&GaussianSlices {
        means: &means,
        quats: &quats,
        log_scales: &log_scales,
        opacity_logits: &opacity_logits,
        sh: &sh,
        num_coefficients: shape_of::<B>(&p.sh)[1],
        sh_degree,
    })
}

/// Everything of one frame, as slices.
pub(crate) struct HostFrame {
    pub splats: ProjectedSplats<'static>,
    pub lists: TileLists<'static>,
    pub raster: Raster<'static>,
    pub stats: RenderStats,
    pub splat_stats: SplatStats,
}

/// Draws a frame, or with `counters` other than none fills those instead of the image.
pub(crate) fn draw(g: &GaussianSlices<'_>, frame: &Frame, counters: StatsLevel) -> Result<HostFrame> {
    let grid = TileGrid::new(frame.view.width, frame.view.height);
    // Bounds pay when a model is drawn and not changed between frames; a training step reads every row anyway.
    let bounds = (!frame.keep && g.len() > 16 * CLUSTER).then(|| clusters(g));
    let splats = project(g, &frame.view, bounds.as_deref());
    let lists = bin(&splats, grid, BinExtras { records: frame.keep, color_max: frame.raster.lut.is_some() })?;
    let raster = rasterize(splats.rows(), &lists, &frame.raster, counters, frame.keep);
    let stats = RenderStats {
        num_splats: g.len() as u64,
        num_culled_non_finite: splats.num_non_finite,
        num_culled_by_cluster: splats.num_culled_by_cluster,
        num_visible: splats.len() as u64,
        num_pairs_box: lists.num_pairs_box,
        num_pairs: lists.pair_splats.len() as u64,
        num_tiles: grid.len() as u64,
        ..raster.stats
    };
    let mode = match counters {
        StatsLevel::None => frame.stats.min(StatsMode::Tiles),
        _ => frame.stats,
    };
    let splat_stats = splat_stats(mode, g.len(), &splats, &lists, &raster);
    Ok(HostFrame { splats, lists, raster, stats, splat_stats })
}

fn indices<B: HostTensors>(data: Vec<u32>) -> IntTensor<B> {
    let len = data.len();
    // Every index is below 2³¹ (MAX_PAIRS), so the bits are the same number.
    B::i32_tensor(bytemuck::cast_vec(data), &[len])
}

fn saved<B: HostTensors>(frame: HostFrame, size: [usize; 2], keep: bool) -> Saved<B> {
    let HostFrame { splats, lists, raster, .. } = frame;
    let visible = splats.len();
    let size = if keep { size } else { [0, 0] };
    let kept = |data: Cow<'static, [u32]>| indices::<B>(if keep { data.into_owned() } else { Vec::new() });
    Saved {
        lanes: if keep {
            B::f32_tensor(splats.lanes.into_owned(), &[visible, lane::COUNT])
        } else {
            B::f32_tensor(Vec::new(), &[0, lane::COUNT])
        },
        final_t: B::f32_tensor(raster.final_t.into_owned(), &size),
        global_from_compact: kept(splats.global_from_compact),
        tile_offsets: kept(lists.tile_offsets),
        pair_splats: kept(lists.pair_splats),
        record_offsets: kept(lists.record_offsets),
        record_pairs: kept(lists.record_pairs),
        tile_ends: kept(raster.tile_ends),
        stop: B::i32_tensor(raster.stop.into_owned(), &size),
    }
}

fn forward<B: HostTensors>(parameters: &Parameters<B>, frame: &Frame) -> Forward<B> {
    let size = [frame.view.height as usize, frame.view.width as usize];
    let image_size = if frame.draws { size } else { [0, 0] };
    let image_shape = [image_size[0], image_size[1], frame.raster.num_channels()];
    let drawn = with_slices(parameters, frame.sh_degree, |g| {
        if !frame.draws {
            return draw(g, frame, StatsLevel::from_mode(frame.stats.max(StatsMode::Dominance)));
        }
        let mut drawn = draw(g, frame, StatsLevel::None)?;
        // Pixel counters come from a pass of their own: counting in the plain kernel would slow every frame.
        let level = StatsLevel::from_mode(frame.stats);
        if level != StatsLevel::None {
            let counted = draw(g, &Frame { keep: false, ..frame.clone() }, level)?;
            drawn.splat_stats = counted.splat_stats;
            drawn.stats.num_blended = counted.stats.num_blended;
        }
        Ok(drawn)
    });
    match drawn {
        Ok(mut host) => {
            let image = B::f32_tensor(std::mem::take(&mut host.raster.image), &image_shape);
            let outcome = Ok((host.stats, std::mem::take(&mut host.splat_stats)));
            Forward { image, saved: saved(host, size, frame.keep), outcome }
        }
        Err(error) => {
            let nothing = || B::i32_tensor(Vec::new(), &[0]);
            Forward {
                image: B::f32_tensor(vec![0.0; image_shape.iter().product()], &image_shape),
                saved: Saved {
                    lanes: B::f32_tensor(Vec::new(), &[0, lane::COUNT]),
                    final_t: B::f32_tensor(Vec::new(), &[0, 0]),
                    global_from_compact: nothing(),
                    tile_offsets: nothing(),
                    pair_splats: nothing(),
                    record_offsets: nothing(),
                    record_pairs: nothing(),
                    tile_ends: nothing(),
                    stop: B::i32_tensor(Vec::new(), &[0, 0]),
                },
                outcome: Err(error),
            }
        }
    }
}

fn backward<B: HostTensors>(
    parameters: &Parameters<B>,
    saved: &Saved<B>,
    v_image: &FloatTensor<B>,
    frame: &Frame,
    wanted: Wanted,
) -> Backward<B> {
    let [ids, offsets, pairs, record_offsets, records, ends] = [
        &saved.global_from_compact,
        &saved.tile_offsets,
        &saved.pair_splats,
        &saved.record_offsets,
        &saved.record_pairs,
        &saved.tile_ends,
    ]
    .map(|t| B::i32_slice(t));
    let unsigned = |slice| Cow::Borrowed(bytemuck::cast_slice::<i32, u32>(slice));
    let splats = ProjectedSplats {
        lanes: B::f32_slice(&saved.lanes),
        global_from_compact: unsigned(&ids),
        ..ProjectedSplats::default()
    };
    let lists = TileLists {
        grid: TileGrid::new(frame.view.width, frame.view.height),
        tile_offsets: unsigned(&offsets),
        pair_splats: unsigned(&pairs),
        record_offsets: unsigned(&record_offsets),
        record_pairs: unsigned(&records),
        color_max: Cow::default(),
        num_pairs_box: 0,
    };
    let raster = Raster {
        final_t: B::f32_slice(&saved.final_t),
        stop: B::i32_slice(&saved.stop),
        tile_ends: unsigned(&ends),
        ..Raster::default()
    };
    let v_image = B::f32_slice(v_image);
    let pairs = rasterize_bwd(splats.rows(), &lists, &frame.raster, &raster, &v_image, wanted.means2d);
    let (v, pose) = with_slices(parameters, frame.sh_degree, |g| {
        let v = project_bwd(g, &frame.view, &splats, &lists, &pairs, wanted.means2d);
        let pose = wanted.pose.then(|| pose_bwd(g, &frame.view, &splats.global_from_compact, &v));
        (v, pose.map_or_else(Vec::new, Vec::from))
    });
    let shape = |t: &FloatTensor<B>| shape_of::<B>(t);
    let probe_rows = v.probe.len() / 4;
    Backward {
        parameters: Parameters {
            means: B::f32_tensor(v.means, &shape(&parameters.means)),
            quats: B::f32_tensor(v.quats, &shape(&parameters.quats)),
            log_scales: B::f32_tensor(v.log_scales, &shape(&parameters.log_scales)),
            opacity_logits: B::f32_tensor(v.opacity_logits, &shape(&parameters.opacity_logits)),
            sh: B::f32_tensor(v.sh, &shape(&parameters.sh)),
        },
        probe: Probe {
            means2d: B::f32_tensor(v.probe, &[probe_rows, 4]),
            pose: B::f32_tensor(pose, &[if wanted.pose { 6 } else { 0 }]),
        },
    }
}

/// The same host implementation serves every CPU backend.
macro_rules! host_render_ops {
    ($backend:ty) => {
        impl RenderOps for $backend {
            fn render_forward(parameters: Parameters<Self>, _probe: Probe<Self>, frame: Frame) -> Forward<Self> {
                forward(&parameters, &frame)
            }

            fn render_backward(
                parameters: Parameters<Self>,
                saved: Saved<Self>,
                v_image: FloatTensor<Self>,
                frame: Frame,
                wanted: Wanted,
            ) -> Backward<Self> {
                backward(&parameters, &saved, &v_image, &frame, wanted)
            }
        }
    };
}

host_render_ops!(NdArray);
#[cfg(feature = "flex")]
host_render_ops!(burn::backend::Flex);
