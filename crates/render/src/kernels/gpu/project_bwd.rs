//! Gradient of the projection: from the records of each splat's pairs to the parameters of its Gaussian.
//!
//! Twelve units sum the records of a splat, one lane each, in their order. Then one unit per Gaussian owns its gradient
//! rows. The forward intermediates are computed again: cheaper than storing them. Rows of Gaussians that are not visible
//! are zero. A row in which anything overflows is zeroed as a whole: no step along it would mean anything.

use super::bin::TileLists;
use super::project::{GaussianBuffers, exp3, num_basis, row3, row4, sh_basis, view_launch};
use crate::error::Result;
use crate::gpu::device_fn::is_finite;
use crate::gpu::packed::PackedLayout;
use crate::gpu::{Gpu, cube_dim};
use crate::kernels::cpu::project::ViewSpec;
use crate::layout::{grad_lane, lane};
use crate::math::alpha::sigmoid;
use crate::math::ewa::{ViewParams, to_camera, view_direction, view_direction_vjp};
use crate::math::footprint::{SplatGradient, antialiased_vjp, footprint, footprint_vjp};
use crate::math::sh;
use crate::math::vec::{Sym2, Vec3};
use burn::tensor::{DType, Shape};
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Gradients of the parameters of N Gaussians.
pub struct ParameterGradients {
    /// All five, packed.
    pub packed: CubeTensor,
    /// Where each lies.
    pub layout: PackedLayout,
    /// `[N, 4]`: image-plane gradient (x, y) in pixels, and the sums of its per-pixel magnitudes. `[0, 4]` unless asked
    /// for.
    pub probe: CubeTensor,
}

/// Sums each splat's pair gradients (by record, from [`super::rasterize_bwd::rasterize_bwd`]) and carries them back to the
/// parameters.
///
/// # Errors
/// [`crate::Error::Limit`] when a buffer is larger than the adapter takes.
pub fn project_bwd(
    gpu: &Gpu,
    g: &GaussianBuffers,
    view: &ViewSpec,
    lists: &TileLists,
    records: CubeTensor,
    probe: bool,
) -> Result<ParameterGradients> {
    let v_projected = gpu.zeros("bytes of splat gradients", &[g.len, grad_lane::COUNT], DType::F32)?;
    if lists.num_visible > 0 {
        sum_records::launch(
            &gpu.client,
            gpu.units(lists.num_visible * grad_lane::COUNT),
            cube_dim(),
            records.into_buffer_arg(),
            lists.record_offsets.clone().into_buffer_arg(),
            lists.lanes.clone().into_buffer_arg(),
            lists.global_from_compact.clone().into_buffer_arg(),
            v_projected.clone().into_buffer_arg(),
            lists.num_visible as u32,
        );
    }
    let layout = PackedLayout::new(g.len, g.num_coefficients);
    let num_probes = if probe { g.len } else { 0 };
    let whole = gpu.empty("bytes of gradients", &[layout.len() + 4 * num_probes], DType::F32)?;
    if g.len > 0 {
        let [quats, log_scales, opacity_logits, sh, probes] = std::array::from_fn(|k| layout.offsets[k + 1] as u32);
        project_bwd_kernel::launch(
            &gpu.client,
            gpu.units(g.len),
            cube_dim(),
            g.means.clone().into_buffer_arg(),
            g.quats.clone().into_buffer_arg(),
            g.log_scales.clone().into_buffer_arg(),
            g.opacity_logits.clone().into_buffer_arg(),
            g.sh.clone().into_buffer_arg(),
            v_projected.into_buffer_arg(),
            whole.clone().into_buffer_arg(),
            view_launch(&view.params),
            SectionsLaunch::new(quats, log_scales, opacity_logits, sh, probes),
            g.len as u32,
            g.num_coefficients as u32,
            g.sh_degree,
            probe,
            view.antialiased,
        );
    }
    let mut handle = whole.handle.clone();
    let probe_start = 4 * layout.len() as u64;
    if num_probes > 0 {
        handle = handle.offset_start(probe_start);
    }
    let probe_shape = Shape::from(vec![num_probes, 4]);
    let probe = CubeTensor::new_contiguous(whole.client.clone(), whole.device.clone(), probe_shape, handle, DType::F32);
    Ok(ParameterGradients { packed: whole, layout, probe })
}

/// Where the sections of the packed gradient begin, in values; the means come first.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
struct Sections {
    quats: u32,
    log_scales: u32,
    opacity_logits: u32,
    sh: u32,
    probes: u32,
}

/// Sum over a splat's pairs, in the order of its records: one unit per splat and lane. Colour is gated where it was clamped
/// at 0.
#[cube(launch)]
fn sum_records(
    records: &[f32],
    record_offsets: &[u32],
    lanes: &[f32],
    global_from_compact: &[u32],
    v_projected: &mut [f32],
    num_visible: u32,
) {
    let r = ABSOLUTE_POS / grad_lane::COUNT;
    let l = ABSOLUTE_POS % grad_lane::COUNT;
    if r < num_visible as usize {
        let mut sum = 0.0_f32;
        for record in record_offsets[r]..record_offsets[r + 1] {
            sum += records[record as usize * grad_lane::COUNT + l];
        }
        let is_color = l == lane::RED || l == lane::RED + 1 || l == lane::RED + 2;
        if is_color && lanes[r * lane::COUNT + l] <= 0.0_f32 {
            sum = 0.0_f32;
        }
        v_projected[global_from_compact[r] as usize * grad_lane::COUNT + l] = sum;
    }
}

/// Carries the gradient of a splat's lanes to the parameters of its Gaussian: one unit per Gaussian.
#[cube(launch)]
fn project_bwd_kernel(
    means: &[f32],
    quats: &[f32],
    log_scales: &[f32],
    opacity_logits: &[f32],
    sh: &[f32],
    v_projected: &[f32],
    out: &mut [f32],
    view: ViewParams,
    sections: Sections,
    num_splats: u32,
    num_coefficients: u32,
    #[comptime] sh_degree: u32,
    #[comptime] probe: bool,
    #[comptime] antialiased: bool,
) {
    let i = ABSOLUTE_POS;
    if i >= num_splats as usize {
        terminate!();
    }
    let row = i * grad_lane::COUNT;
    let mut is_zero = true;
    for l in 0..grad_lane::COUNT {
        is_zero = is_zero && v_projected[row + l] == 0.0_f32;
    }
    if comptime!(probe) {
        let to = sections.probes as usize + 4 * i;
        let x = v_projected[row + lane::MEAN_X];
        let y = v_projected[row + lane::MEAN_Y];
        let abs_x = v_projected[row + grad_lane::ABS_X];
        let abs_y = v_projected[row + grad_lane::ABS_Y];
        let kept = is_finite(x) && is_finite(y) && is_finite(abs_x) && is_finite(abs_y);
        out[to] = select(kept, x, 0.0_f32);
        out[to + 1] = select(kept, y, 0.0_f32);
        out[to + 2] = select(kept, abs_x, 0.0_f32);
        out[to + 3] = select(kept, abs_y, 0.0_f32);
    }
    // Zero first: bands that are not evaluated, rows that are not seen, rows that overflow.
    let (to_quat, to_scale) = (sections.quats as usize + 4 * i, sections.log_scales as usize + 3 * i);
    let to_logit = sections.opacity_logits as usize + i;
    let num_sh = num_coefficients as usize * 3;
    let to_sh = sections.sh as usize + num_sh * i;
    for k in 0..3usize {
        out[3 * i + k] = 0.0_f32;
        out[to_scale + k] = 0.0_f32;
    }
    for k in 0..4usize {
        out[to_quat + k] = 0.0_f32;
    }
    out[to_logit] = 0.0_f32;
    for k in 0..num_sh {
        out[to_sh + k] = 0.0_f32;
    }
    if is_zero {
        terminate!();
    }
    let mean = row3(means, i);
    let in_camera = to_camera(view, mean);
    let scales = exp3(row3(log_scales, i));
    let fp = footprint(view, in_camera, row4(quats, i), scales);
    let upstream = SplatGradient {
        mean_x: v_projected[row + lane::MEAN_X],
        mean_y: v_projected[row + lane::MEAN_Y],
        depth: v_projected[row + lane::DEPTH],
        conic: Sym2 {
            xx: v_projected[row + lane::CONIC_XX],
            xy: v_projected[row + lane::CONIC_XY],
            yy: v_projected[row + lane::CONIC_YY],
        },
    };
    let v = if comptime!(antialiased) {
        antialiased_vjp(view, fp, in_camera, scales, upstream, v_projected[row + lane::LOG2_OPACITY])
    } else {
        footprint_vjp(view, fp, in_camera, scales, upstream)
    };
    // Colour → SH, and through the viewing direction to the mean.
    let v_color = Vec3 {
        x: v_projected[row + lane::RED],
        y: v_projected[row + lane::RED + 1],
        z: v_projected[row + lane::RED + 2],
    };
    let direction = view_direction(view, mean);
    let v_direction = color_direction_vjp(sh, i * num_sh, direction.unit, v_color, sh_degree);
    let through_color = view_direction_vjp(direction, v_direction);
    let v_mean = Vec3 { x: v.mean.x + through_color.x, y: v.mean.y + through_color.y, z: v.mean.z + through_color.z };
    // v is ∂L/∂ln o, compensated or not, and ∂ ln o/∂logit = 1 − o = σ(−logit), which keeps its digits where o is close to 1.
    let v_logit = v_projected[row + lane::LOG2_OPACITY] * sigmoid(-opacity_logits[i]);
    let is_row_finite = is_finite(v_mean.x)
        && is_finite(v_mean.y)
        && is_finite(v_mean.z)
        && is_finite(v.quat.w)
        && is_finite(v.quat.x)
        && is_finite(v.quat.y)
        && is_finite(v.quat.z)
        && is_finite(v.log_scales.x)
        && is_finite(v.log_scales.y)
        && is_finite(v.log_scales.z)
        && is_finite(v_color.x)
        && is_finite(v_color.y)
        && is_finite(v_color.z)
        && is_finite(v_logit);
    if is_row_finite {
        out[3 * i] = v_mean.x;
        out[3 * i + 1] = v_mean.y;
        out[3 * i + 2] = v_mean.z;
        out[to_quat] = v.quat.w;
        out[to_quat + 1] = v.quat.x;
        out[to_quat + 2] = v.quat.y;
        out[to_quat + 3] = v.quat.z;
        out[to_scale] = v.log_scales.x;
        out[to_scale + 1] = v.log_scales.y;
        out[to_scale + 2] = v.log_scales.z;
        out[to_logit] = v_logit;
        let basis = sh_basis(direction.unit, sh_degree);
        #[unroll]
        for k in 0..comptime!(num_basis(sh_degree)) {
            out[to_sh + 3 * k] = v_color.x * basis[k];
            out[to_sh + 3 * k + 1] = v_color.y * basis[k];
            out[to_sh + 3 * k + 2] = v_color.z * basis[k];
        }
    }
}

/// Upstream gradient of basis function `k`: colour gradient times its coefficients.
#[cube]
fn v_basis(sh: &[f32], first: usize, v_color: Vec3, #[comptime] k: usize) -> f32 {
    v_color.x * sh[first + 3 * k] + v_color.y * sh[first + 3 * k + 1] + v_color.z * sh[first + 3 * k + 2]
}

/// Gradient of the colour with respect to the unit direction `d`, as three free variables.
#[cube]
pub fn color_direction_vjp(sh: &[f32], first: usize, d: Vec3, v: Vec3, #[comptime] degree: u32) -> Vec3 {
    let mut x = 0.0_f32;
    let mut y = 0.0_f32;
    let mut z = 0.0_f32;
    if comptime!(degree >= 1) {
        let g = sh::band1_vjp(sh::Band1 {
            m0: v_basis(sh, first, v, 1usize),
            m1: v_basis(sh, first, v, 2usize),
            m2: v_basis(sh, first, v, 3usize),
        });
        x += g.x;
        y += g.y;
        z += g.z;
    }
    if comptime!(degree >= 2) {
        let g = sh::band2_vjp(
            d.x,
            d.y,
            d.z,
            sh::Band2 {
                m0: v_basis(sh, first, v, 4usize),
                m1: v_basis(sh, first, v, 5usize),
                m2: v_basis(sh, first, v, 6usize),
                m3: v_basis(sh, first, v, 7usize),
                m4: v_basis(sh, first, v, 8usize),
            },
        );
        x += g.x;
        y += g.y;
        z += g.z;
    }
    if comptime!(degree >= 3) {
        let g = sh::band3_vjp(
            d.x,
            d.y,
            d.z,
            sh::Band3 {
                m0: v_basis(sh, first, v, 9usize),
                m1: v_basis(sh, first, v, 10usize),
                m2: v_basis(sh, first, v, 11usize),
                m3: v_basis(sh, first, v, 12usize),
                m4: v_basis(sh, first, v, 13usize),
                m5: v_basis(sh, first, v, 14usize),
                m6: v_basis(sh, first, v, 15usize),
            },
        );
        x += g.x;
        y += g.y;
        z += g.z;
    }
    if comptime!(degree >= 4) {
        let g = sh::band4_vjp(
            d.x,
            d.y,
            d.z,
            sh::Band4 {
                m0: v_basis(sh, first, v, 16usize),
                m1: v_basis(sh, first, v, 17usize),
                m2: v_basis(sh, first, v, 18usize),
                m3: v_basis(sh, first, v, 19usize),
                m4: v_basis(sh, first, v, 20usize),
                m5: v_basis(sh, first, v, 21usize),
                m6: v_basis(sh, first, v, 22usize),
                m7: v_basis(sh, first, v, 23usize),
                m8: v_basis(sh, first, v, 24usize),
            },
        );
        x += g.x;
        y += g.y;
        z += g.z;
    }
    Vec3 { x, y, z }
}
