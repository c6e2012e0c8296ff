//! The renderer on GPUs: tensors to buffers, buffers through the kernels, buffers to tensors.

use super::{Backward, Forward, Frame, Parameters, Probe, RenderOps, Saved, Wanted};
use crate::error::Result;
use crate::gpu::packed::PackedLayout;
use crate::gpu::{Gpu, contiguous};
use crate::kernels::cpu::bin::TileGrid;
use crate::kernels::gpu::{
    bin::{TileLists, bin},
    pose_bwd::pose_bwd,
    project::{GaussianBuffers, project},
    project_bwd::project_bwd,
    rasterize::{Raster, rasterize},
    rasterize_bwd::rasterize_bwd,
    stats::splat_stats,
};
use crate::layout::{TILE, grad_lane, lane};
use crate::stats::{RenderStats, SplatStats};
use crate::termination::ColorMax;
use burn::backend::tensor::FloatTensor;
use burn::tensor::DType;
use burn_cubecl::{CubeBackend, tensor::CubeTensor};

/// Everything of one frame, as buffers.
struct DeviceFrame {
    lists: TileLists,
    raster: Raster,
    stats: RenderStats,
    splat_stats: SplatStats,
}

fn draw(gpu: &Gpu, g: &GaussianBuffers, frame: &Frame) -> Result<DeviceFrame> {
    let grid = TileGrid::new(frame.view.width, frame.view.height);
    // What is known to be too large is refused before any work.
    let (width, height) = (frame.view.width as usize, frame.view.height as usize);
    gpu.check_size("bytes of the image", &[height, width, frame.raster.num_channels()], DType::F32)?;
    let projected = project(gpu, g, &frame.view)?;
    let wants_maximum = frame.raster.lut.as_ref().is_some_and(|lut| lut.color_max() == ColorMax::Tile);
    let lists = bin(gpu, g, &projected, grid, wants_maximum)?;
    if frame.keep {
        check_backward(gpu, g, lists.num_pairs)?;
    }
    let raster = rasterize(gpu, &lists, &frame.raster, frame.keep)?;
    let (splat_stats, num_tiles_empty) =
        splat_stats(gpu, frame.stats, g.len, &lists, &frame.raster, &raster.tile_ends)?;
    let sum = |counts: &[u32]| counts.iter().map(|&c| u64::from(c)).sum::<u64>();
    let num_pairs_used = sum(&splat_stats.tiles_used);
    let stats = RenderStats {
        num_splats: g.len as u64,
        num_culled_non_finite: lists.num_non_finite,
        num_culled_by_cluster: 0,
        num_visible: lists.num_visible as u64,
        num_pairs_box: lists.num_pairs_box,
        num_pairs: lists.num_pairs as u64,
        num_pairs_used,
        num_lane_pixels: num_pairs_used * (TILE * TILE) as u64,
        num_blended: sum(&splat_stats.pixels_blended),
        num_tiles: grid.len() as u64,
        num_tiles_empty,
    };
    Ok(DeviceFrame { lists, raster, stats, splat_stats })
}

/// Checks that what the backward pass allocates on top will fit: it cannot return an error.
fn check_backward(gpu: &Gpu, g: &GaussianBuffers, num_pairs: usize) -> Result<()> {
    gpu.check_size("bytes of pair gradients", &[num_pairs, grad_lane::COUNT], DType::F32)?;
    gpu.check_size("bytes of splat gradients", &[g.len, grad_lane::COUNT], DType::F32)?;
    let num_values = PackedLayout::new(g.len, g.num_coefficients).len() + 4 * g.len;
    gpu.check_size("bytes of gradients", &[num_values], DType::F32)
}

/// An empty tensor on the same adapter: zero rows on one unused word.
fn nothing(gpu: &Gpu, dtype: DType) -> CubeTensor {
    gpu.empty("bytes", &[0], dtype).expect("an adapter takes a buffer of four bytes")
}

/// An image without pixels.
fn empty_image(gpu: &Gpu, frame: &Frame) -> CubeTensor {
    let channels = frame.raster.num_channels();
    gpu.empty("bytes", &[0, 0, channels], DType::F32).expect("an adapter takes a buffer of four bytes")
}

fn saved(gpu: &Gpu, frame: Option<DeviceFrame>) -> Saved<CubeBackend> {
    let Some(DeviceFrame { lists, raster, .. }) = frame else {
        return Saved {
            lanes: gpu.empty("bytes", &[0, lane::COUNT], DType::F32).expect("an adapter takes four bytes"),
            final_t: nothing(gpu, DType::F32),
            global_from_compact: nothing(gpu, DType::U32),
            tile_offsets: nothing(gpu, DType::U32),
            pair_splats: nothing(gpu, DType::U32),
            record_offsets: nothing(gpu, DType::U32),
            record_pairs: nothing(gpu, DType::U32),
            tile_ends: nothing(gpu, DType::U32),
            stop: nothing(gpu, DType::U32),
        };
    };
    Saved {
        lanes: lists.lanes,
        final_t: raster.final_t,
        global_from_compact: lists.global_from_compact,
        tile_offsets: lists.tile_offsets,
        pair_splats: lists.pairs,
        record_offsets: lists.record_offsets,
        record_pairs: nothing(gpu, DType::U32),
        tile_ends: raster.tile_ends,
        stop: raster.stop,
    }
}

fn backward(
    parameters: Parameters<CubeBackend>,
    saved: Saved<CubeBackend>,
    v_image: CubeTensor,
    frame: &Frame,
    wanted: Wanted,
) -> Result<Backward<CubeBackend>> {
    let gpu = Gpu::of(&v_image);
    let g = GaussianBuffers::new(parameters, frame.sh_degree);
    let lists = TileLists {
        grid: TileGrid::new(frame.view.width, frame.view.height),
        num_visible: saved.lanes.meta.shape()[0],
        num_pairs: saved.pair_splats.meta.shape()[0],
        lanes: saved.lanes,
        global_from_compact: saved.global_from_compact,
        tile_offsets: saved.tile_offsets,
        pairs: saved.pair_splats,
        record_offsets: saved.record_offsets,
        color_max: nothing(&gpu, DType::U32),
        num_pairs_box: 0,
        num_non_finite: 0,
    };
    let v_image = contiguous(v_image);
    let raster =
        Raster { image: v_image.clone(), final_t: saved.final_t, stop: saved.stop, tile_ends: saved.tile_ends };
    let records = rasterize_bwd(&gpu, &lists, &frame.raster, &raster, v_image, wanted.means2d)?;
    let v = project_bwd(&gpu, &g, &frame.view, &lists, records, wanted.means2d)?;
    let pose = if wanted.pose { pose_bwd(&gpu, &g, &frame.view, &lists, &v)? } else { nothing(&gpu, DType::F32) };
    Ok(Backward { parameters: v.layout.views(&v.packed), probe: Probe { means2d: v.probe, pose } })
}

impl RenderOps for CubeBackend {
    fn render_forward(parameters: Parameters<Self>, _probe: Probe<Self>, frame: Frame) -> Forward<Self> {
        let gpu = Gpu::of(&parameters.means);
        let g = GaussianBuffers::new(parameters, frame.sh_degree);
        match draw(&gpu, &g, &frame) {
            Ok(mut drawn) => {
                let image = if frame.draws { drawn.raster.image.clone() } else { empty_image(&gpu, &frame) };
                let outcome = Ok((drawn.stats, std::mem::take(&mut drawn.splat_stats)));
                let kept = (frame.keep).then_some(drawn);
                Forward { image, saved: saved(&gpu, kept), outcome }
            }
            Err(error) => {
                let image = empty_image(&gpu, &frame);
                Forward { image, saved: saved(&gpu, None), outcome: Err(error) }
            }
        }
    }

    fn render_backward(
        parameters: Parameters<Self>,
        saved: Saved<Self>,
        v_image: FloatTensor<Self>,
        frame: Frame,
        wanted: Wanted,
    ) -> Backward<Self> {
        // Autodiff cannot hand on an error: `draw` has checked these sizes for a frame that is kept.
        backward(parameters, saved, v_image, &frame, wanted)
            .expect("the forward pass has checked the sizes of the backward pass")
    }
}
