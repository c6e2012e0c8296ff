//! Removal of broken rows: those with a value that is not finite, or beyond the bounds of the scene.
//!
//! One unit judges a row and counts what is wrong with it; whole numbers are added, whose sum has no order. The host reads
//! four words, and the verdicts only if a row is broken; the sound rows then move into buffers of their own, in their order,
//! with their moments. A model of which no row would stay is left alone, and so is one whose status is closed.

use super::rows::{Listed, PackedRows, Sections, SectionsLaunch};
use crate::densify::Bounds;
use crate::event::{BrokenCounts, DensifyReport};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::Result;
use gazesplat_render::gpu::device_fn::is_finite;
use gazesplat_render::gpu::{Gpu, cube_dim, packed::PackedLayout};

/// Reasons to be broken.
pub const NUM_REASONS: usize = 3;

/// Bounds of a scene.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
pub struct BoundsArgs {
    pub center_x: f32,
    pub center_y: f32,
    pub center_z: f32,
    pub max_log_scale: f32,
    pub max_distance: f32,
}

impl BoundsArgsLaunch {
    /// Those of `bounds`.
    pub fn of(bounds: &Bounds) -> Self {
        let [x, y, z] = bounds.center;
        Self::new(x, y, z, bounds.max_log_scale, bounds.max_distance)
    }
}

/// The counts of the host.
pub fn broken_counts(words: &[u32]) -> BrokenCounts {
    BrokenCounts { non_finite: words[0] as usize, huge: words[1] as usize, far: words[2] as usize }
}

/// What is wrong with a row: 0, or the number of the reason.
#[cube]
pub fn broken(params: &[f32], at: &Sections, bounds: &BoundsArgs, row: usize) -> u32 {
    let mut finite = is_finite(params[at.opacity_logits as usize + row]);
    let mut is_huge = false;
    for i in 0..3usize {
        let log_scale = params[at.log_scales as usize + 3 * row + i];
        finite = finite && is_finite(params[3 * row + i]) && is_finite(log_scale);
        is_huge = is_huge || log_scale > bounds.max_log_scale;
    }
    for i in 0..4usize {
        finite = finite && is_finite(params[at.quats as usize + 4 * row + i]);
    }
    let sh = at.sh as usize + row * at.sh_width as usize;
    for i in 0..at.sh_width as usize {
        finite = finite && is_finite(params[sh + i]);
    }
    let is_far = f32::abs(params[3 * row] - bounds.center_x) > bounds.max_distance
        || f32::abs(params[3 * row + 1] - bounds.center_y) > bounds.max_distance
        || f32::abs(params[3 * row + 2] - bounds.center_z) > bounds.max_distance;
    let mut reason = 0u32;
    if !finite {
        reason = 1u32;
    } else if is_huge {
        reason = 2u32;
    } else if is_far {
        reason = 3u32;
    }
    reason
}

/// Removes the rows beyond `bounds`.
///
/// # Errors
/// [`gazesplat_render::Error::Device`] when the adapter does not answer.
pub fn sweep(gpu: &Gpu, rows: PackedRows, status: &CubeTensor, bounds: &Bounds) -> Result<(PackedRows, DensifyReport)> {
    let n = rows.layout.num_rows;
    let verdicts = gpu.empty("bytes of verdicts", &[n], DType::U32)?;
    let counts = gpu.zeros("bytes of counts", &[NUM_REASONS], DType::U32)?;
    judge_rows::launch(
        &gpu.client,
        gpu.units(n),
        cube_dim(),
        rows.params.clone().into_buffer_arg(),
        verdicts.clone().into_buffer_arg(),
        counts.clone().into_buffer_arg(),
        SectionsLaunch::of(&rows.layout),
        BoundsArgsLaunch::of(bounds),
    );
    let [words, status] = gpu.read_all_u32([&counts, status])?;
    let broken = broken_counts(&words);
    if broken.total() == 0 || broken.total() == n || status[0] > 0 {
        return Ok((rows, DensifyReport { num_gaussians: n, ..DensifyReport::default() }));
    }
    let verdicts = gpu.read_u32(&verdicts)?;
    let sound: Vec<u32> = (0..n as u32).filter(|&row| verdicts[row as usize] == 0).collect();
    let list = gpu.upload_u32(&sound, &[sound.len()]);
    let rows = rows.selected(gpu, PackedLayout::new(sound.len(), rows.layout.num_coefficients), &list, Listed::Only)?;
    Ok((rows, DensifyReport { broken, num_gaussians: sound.len(), ..DensifyReport::default() }))
}

#[cube(launch)]
fn judge_rows(params: &[f32], verdicts: &mut [u32], counts: &mut [Atomic<u32>], at: Sections, bounds: BoundsArgs) {
    let row = ABSOLUTE_POS;
    if row < at.num_rows as usize {
        let reason = broken(params, &at, &bounds, row);
        verdicts[row] = reason;
        if reason > 0u32 {
            counts[reason as usize - 1].fetch_add(1u32);
        }
    }
}
