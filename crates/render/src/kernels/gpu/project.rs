//! Projection: from N Gaussians to the V visible splats of one view.
//!
//! One unit per Gaussian. A Gaussian with a value that is not finite, or from which anything not finite is computed, is
//! culled and counted. Lanes are written in place of the Gaussian; the visible ones are then numbered by a prefix sum,
//! in the order of their Gaussians. No Gaussians, or none visible, gives empty output.

use super::scan::exclusive_scan;
use crate::backend::Parameters;
use crate::cluster::Frustum;
use crate::error::Result;
use crate::gpu::device_fn::is_finite;
use crate::gpu::{Gpu, contiguous, cube_dim};
use crate::kernels::cpu::project::ViewSpec;
use crate::layout::{ALPHA_MIN, DET_MIN, EXTENT_SLACK, QUAT_NORM2_MIN, lane};
use crate::math::alpha::{LOG2_E, contour_power2, sigmoid};
use crate::math::compensation::compensation;
use crate::math::ewa::{ViewParams, ViewParamsLaunch, to_camera, view_direction};
use crate::math::footprint::footprint;
use crate::math::frustum::{Side, SideLaunch, Sides, SidesLaunch, excludes};
use crate::math::quat::Quat;
use crate::math::sh;
use crate::math::vec::{Mat3, Mat3Launch, Vec3, Vec3Launch};
use burn::tensor::DType;
use burn_cubecl::{CubeBackend, tensor::CubeTensor};
use cubecl::prelude::*;

/// Lane [`lane::DEPTH`] of a Gaussian that is culled for values that are not finite; 0 marks the others that are culled.
pub const NON_FINITE_DEPTH: f32 = -1.0;

/// Parameters of N Gaussians as contiguous buffers.
#[derive(Clone)]
pub struct GaussianBuffers {
    /// `[N, 3]`.
    pub means: CubeTensor,
    /// `[N, 4]`, (w, x, y, z).
    pub quats: CubeTensor,
    /// `[N, 3]`.
    pub log_scales: CubeTensor,
    /// `[N]`.
    pub opacity_logits: CubeTensor,
    /// `[N, K, 3]`.
    pub sh: CubeTensor,
    /// Number of Gaussians N.
    pub len: usize,
    /// K: coefficients stored per Gaussian and channel.
    pub num_coefficients: usize,
    /// Degree evaluated; (degree + 1)² ≤ K.
    pub sh_degree: u32,
}

impl GaussianBuffers {
    /// The buffers behind `parameters`; copied only where they are not contiguous.
    pub fn new(parameters: Parameters<CubeBackend>, sh_degree: u32) -> Self {
        let (len, num_coefficients) = (parameters.opacity_logits.meta.shape()[0], parameters.sh.meta.shape()[1]);
        Self {
            means: contiguous(parameters.means),
            quats: contiguous(parameters.quats),
            log_scales: contiguous(parameters.log_scales),
            opacity_logits: contiguous(parameters.opacity_logits),
            sh: contiguous(parameters.sh),
            len,
            num_coefficients,
            sh_degree,
        }
    }
}

/// The Gaussians as one view sees them.
pub struct Projected {
    /// `[N, 12]`, lanes as in [`crate::layout::lane`]; undefined but for the depth where a Gaussian is culled.
    pub lanes: CubeTensor,
    /// Number of visible Gaussians before each, `[N + 1]`: the last is V.
    pub visible_offsets: CubeTensor,
}

/// The camera as a kernel argument.
pub fn view_launch(view: &ViewParams) -> ViewParamsLaunch {
    let vec = |v: Vec3| Vec3Launch::new(v.x, v.y, v.z);
    let mat = |m: Mat3| Mat3Launch::new(vec(m.row0), vec(m.row1), vec(m.row2));
    ViewParamsLaunch::new(
        mat(view.rotation),
        vec(view.translation),
        vec(view.position),
        view.fx,
        view.fy,
        view.cx,
        view.cy,
        view.min_x,
        view.max_x,
        view.min_y,
        view.max_y,
    )
}

/// The sides of the frustum as a kernel argument.
pub fn sides_launch(sides: &Sides) -> SidesLaunch {
    let side = |s: Side| SideLaunch::new(Vec3Launch::new(s.normal.x, s.normal.y, s.normal.z), s.offset, s.pad);
    SidesLaunch::new(side(sides.left), side(sides.right), side(sides.top), side(sides.bottom))
}

/// Projects all Gaussians.
///
/// # Errors
/// [`crate::Error::Limit`] when a buffer is larger than the adapter takes.
pub fn project(gpu: &Gpu, g: &GaussianBuffers, view: &ViewSpec) -> Result<Projected> {
    let lanes = gpu.empty("bytes of projected lanes", &[g.len, lane::COUNT], DType::F32)?;
    let visible = gpu.empty("bytes of visibility", &[g.len], DType::U32)?;
    if g.len > 0 {
        project_kernel::launch(
            &gpu.client,
            gpu.units(g.len),
            cube_dim(),
            g.means.clone().into_buffer_arg(),
            g.quats.clone().into_buffer_arg(),
            g.log_scales.clone().into_buffer_arg(),
            g.opacity_logits.clone().into_buffer_arg(),
            g.sh.clone().into_buffer_arg(),
            lanes.clone().into_buffer_arg(),
            visible.clone().into_buffer_arg(),
            view_launch(&view.params),
            sides_launch(&Frustum::new(&view.params, view.width as f32, view.height as f32, view.near).sides),
            view.width as f32,
            view.height as f32,
            view.near,
            g.len as u32,
            g.num_coefficients as u32,
            g.sh_degree,
            view.antialiased,
        );
    }
    let visible_offsets = exclusive_scan(gpu, &visible, g.len)?;
    Ok(Projected { lanes, visible_offsets })
}

/// Row `i` of `[N, 3]`.
#[cube]
pub fn row3(values: &[f32], i: usize) -> Vec3 {
    Vec3 { x: values[i * 3], y: values[i * 3 + 1], z: values[i * 3 + 2] }
}

/// Row `i` of `[N, 4]`, (w, x, y, z).
#[cube]
pub fn row4(values: &[f32], i: usize) -> Quat {
    Quat { w: values[i * 4], x: values[i * 4 + 1], y: values[i * 4 + 2], z: values[i * 4 + 3] }
}

/// Standard deviations from their logarithms.
#[cube]
pub fn exp3(v: Vec3) -> Vec3 {
    Vec3 { x: f32::exp(v.x), y: f32::exp(v.y), z: f32::exp(v.z) }
}

#[cube]
fn is_finite3(v: Vec3) -> bool {
    is_finite(v.x) && is_finite(v.y) && is_finite(v.z)
}

/// Projection of one Gaussian per unit.
#[cube(launch)]
fn project_kernel(
    means: &[f32],
    quats: &[f32],
    log_scales: &[f32],
    opacity_logits: &[f32],
    sh: &[f32],
    lanes: &mut [f32],
    visible: &mut [u32],
    view: ViewParams,
    sides: Sides,
    width: f32,
    height: f32,
    near: f32,
    num_splats: u32,
    num_coefficients: u32,
    #[comptime] sh_degree: u32,
    #[comptime] antialiased: bool,
) {
    let i = ABSOLUTE_POS;
    if i >= num_splats as usize {
        terminate!();
    }
    let row = i * lane::COUNT;
    visible[i] = 0u32;
    lanes[row + lane::DEPTH] = 0.0_f32;
    // 1. Mean in the camera. Finiteness is tested by bits: a comparison with NaN may be compiled away.
    let mean = row3(means, i);
    let in_camera = to_camera(view, mean);
    if !is_finite3(mean) {
        lanes[row + lane::DEPTH] = NON_FINITE_DEPTH;
        terminate!();
    }
    if in_camera.z.is_nan() || in_camera.z <= near {
        terminate!();
    }
    let quat = row4(quats, i);
    let log_scale = row3(log_scales, i);
    let logit = opacity_logits[i];
    let quat_is_finite = is_finite(quat.w) && is_finite(quat.x) && is_finite(quat.y) && is_finite(quat.z);
    if !(quat_is_finite && is_finite3(log_scale) && is_finite(logit)) {
        lanes[row + lane::DEPTH] = NON_FINITE_DEPTH;
        terminate!();
    }
    let mut opacity = sigmoid(logit);
    let largest = f32::max(f32::max(f32::abs(quat.w), f32::abs(quat.x)), f32::max(f32::abs(quat.y), f32::abs(quat.z)));
    if opacity < ALPHA_MIN || largest < 0.5_f32 * f32::sqrt(QUAT_NORM2_MIN) {
        terminate!();
    }
    let scales = exp3(log_scale);
    if excludes(sides, mean, f32::max(f32::max(scales.x, scales.y), scales.z)) {
        terminate!();
    }
    // 2.–4. Σ' = J W Σ Wᵀ Jᵀ + 0.3 I and its inverse (Zwicker 2001; Kerbl 2023, Eq. 5).
    let fp = footprint(view, in_camera, quat, scales);
    if fp.unit.norm * fp.unit.norm < QUAT_NORM2_MIN || fp.dilated.det <= DET_MIN {
        terminate!();
    }
    if comptime!(antialiased) {
        opacity *= compensation(fp.dilated);
        if opacity < ALPHA_MIN {
            terminate!();
        }
    }
    // 5. Extent of the contour α = 1/255.
    let log2_opacity = f32::ln(opacity) * LOG2_E;
    let power2 = f32::max(contour_power2(log2_opacity), 0.0_f32);
    let extent_x = f32::sqrt(power2 * fp.dilated.cov.xx);
    let extent_y = f32::sqrt(power2 * fp.dilated.cov.yy);
    let mean_x = view.fx * in_camera.x / in_camera.z + view.cx;
    let mean_y = view.fy * in_camera.y / in_camera.z + view.cy;
    let reach = 1.0_f32 + EXTENT_SLACK;
    if mean_x + extent_x * reach < 0.5_f32
        || mean_x - extent_x * reach > width - 0.5_f32
        || mean_y + extent_y * reach < 0.5_f32
        || mean_y - extent_y * reach > height - 0.5_f32
    {
        terminate!();
    }
    // 6. Colour seen from the camera centre.
    let direction = view_direction(view, mean);
    let basis = sh_basis(direction.unit, sh_degree);
    let first = i * num_coefficients as usize * 3;
    let mut red = 0.5_f32;
    let mut green = 0.5_f32;
    let mut blue = 0.5_f32;
    #[unroll]
    for k in 0..comptime!(num_basis(sh_degree)) {
        red += basis[k] * sh[first + 3 * k];
        green += basis[k] * sh[first + 3 * k + 1];
        blue += basis[k] * sh[first + 3 * k + 2];
    }
    let color = Vec3 { x: red, y: green, z: blue };
    let extents = Vec3 { x: extent_x, y: extent_y, z: log2_opacity };
    let place = Vec3 { x: mean_x, y: mean_y, z: in_camera.z };
    let conic = Vec3 { x: fp.conic.xx, y: fp.conic.xy, z: fp.conic.yy };
    if !(is_finite3(color) && is_finite3(extents) && is_finite3(place) && is_finite3(conic)) {
        lanes[row + lane::DEPTH] = NON_FINITE_DEPTH;
        terminate!();
    }
    lanes[row + lane::MEAN_X] = mean_x;
    lanes[row + lane::MEAN_Y] = mean_y;
    lanes[row + lane::CONIC_XX] = conic.x;
    lanes[row + lane::CONIC_XY] = conic.y;
    lanes[row + lane::CONIC_YY] = conic.z;
    lanes[row + lane::LOG2_OPACITY] = log2_opacity;
    lanes[row + lane::RED] = f32::max(red, 0.0_f32);
    lanes[row + lane::RED + 1] = f32::max(green, 0.0_f32);
    lanes[row + lane::RED + 2] = f32::max(blue, 0.0_f32);
    lanes[row + lane::DEPTH] = in_camera.z;
    lanes[row + lane::EXTENT_X] = extent_x;
    lanes[row + lane::EXTENT_Y] = extent_y;
    visible[i] = 1u32;
}

/// Number of basis functions up to a degree.
pub fn num_basis(degree: u32) -> usize {
    gazesplat_core::sh::num_coefficients(degree)
}

/// Basis functions up to `degree` in the unit direction `d`.
#[cube]
pub fn sh_basis(d: Vec3, #[comptime] degree: u32) -> Array<f32> {
    let mut basis = Array::<f32>::new(comptime!(num_basis(degree)));
    basis[0] = sh::C0;
    if comptime!(degree >= 1) {
        let b = sh::band1(d.x, d.y, d.z);
        basis[1] = b.m0;
        basis[2] = b.m1;
        basis[3] = b.m2;
    }
    if comptime!(degree >= 2) {
        let b = sh::band2(d.x, d.y, d.z);
        basis[4] = b.m0;
        basis[5] = b.m1;
        basis[6] = b.m2;
        basis[7] = b.m3;
        basis[8] = b.m4;
    }
    if comptime!(degree >= 3) {
        let b = sh::band3(d.x, d.y, d.z);
        basis[9] = b.m0;
        basis[10] = b.m1;
        basis[11] = b.m2;
        basis[12] = b.m3;
        basis[13] = b.m4;
        basis[14] = b.m5;
        basis[15] = b.m6;
    }
    if comptime!(degree >= 4) {
        let b = sh::band4(d.x, d.y, d.z);
        basis[16] = b.m0;
        basis[17] = b.m1;
        basis[18] = b.m2;
        basis[19] = b.m3;
        basis[20] = b.m4;
        basis[21] = b.m5;
        basis[22] = b.m6;
        basis[23] = b.m7;
        basis[24] = b.m8;
    }
    basis
}
