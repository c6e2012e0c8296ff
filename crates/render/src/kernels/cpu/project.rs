//! Projection: from N Gaussians to the V visible splats of one view.
//!
//! One chunk of [`CLUSTER`] rows per task; each reads its rows of the parameters and yields the lanes of its visible
//! splats in row order. A Gaussian with a value that is not finite, or from which anything not finite is computed, is
//! culled and counted. No Gaussians, or none visible, gives empty output.

use crate::cluster::{Cluster, Frustum};
use crate::layout::{ALPHA_MIN, CLUSTER, DET_MIN, EXTENT_SLACK, QUAT_NORM2_MIN, lane};
use crate::math::alpha::{LOG2_E, contour_power2, sigmoid};
use crate::math::compensation::compensation;
use crate::math::ewa::{ViewParams, to_camera, view_direction};
use crate::math::footprint::footprint;
use crate::math::quat::Quat;
use crate::math::sh;
use crate::math::vec::Vec3;
use crate::simd::vectorize;
use rayon::prelude::*;
use std::borrow::Cow;

/// Parameters of N Gaussians as slices in C order; see [`gazesplat_core::GaussianCloud`] for their meaning.
#[derive(Debug, Clone, Copy)]
pub struct GaussianSlices<'a> {
    /// `[N, 3]`.
    pub means: &'a [f32],
    /// `[N, 4]`, (w, x, y, z).
    pub quats: &'a [f32],
    /// `[N, 3]`.
    pub log_scales: &'a [f32],
    /// `[N]`.
    pub opacity_logits: &'a [f32],
    /// `[N, K, 3]`.
    pub sh: &'a [f32],
    /// K: coefficients stored per Gaussian and channel.
    pub num_coefficients: usize,
    /// Degree evaluated; (degree + 1)² ≤ K.
    pub sh_degree: u32,
}

impl GaussianSlices<'_> {
    /// Number of Gaussians N.
    pub fn len(&self) -> usize {
        self.opacity_logits.len()
    }

    /// True when there is no Gaussian.
    pub fn is_empty(&self) -> bool {
        self.opacity_logits.is_empty()
    }

    /// Mean of Gaussian `i`.
    #[inline(always)]
    pub(super) fn mean(&self, i: usize) -> Vec3 {
        let [x, y, z] = self.means.as_chunks::<3>().0[i];
        Vec3 { x, y, z }
    }

    /// Quaternion of Gaussian `i`.
    #[inline(always)]
    pub(super) fn quat(&self, i: usize) -> Quat {
        let [w, x, y, z] = self.quats.as_chunks::<4>().0[i];
        Quat { w, x, y, z }
    }

    /// Standard deviations of Gaussian `i`.
    #[inline(always)]
    pub(super) fn scales(&self, i: usize) -> Vec3 {
        let [x, y, z] = self.log_scales.as_chunks::<3>().0[i];
        Vec3 { x: x.exp(), y: y.exp(), z: z.exp() }
    }

    /// SH coefficients of Gaussian `i` up to the degree evaluated, `[(degree + 1)², 3]`.
    #[inline(always)]
    pub(super) fn coefficients(&self, i: usize) -> &[[f32; 3]] {
        let rows = self.sh.as_chunks::<3>().0;
        &rows[i * self.num_coefficients..][..gazesplat_core::sh::num_coefficients(self.sh_degree)]
    }
}

/// The visible splats of one view, in the order of their Gaussians.
#[derive(Debug, Clone, Default)]
pub struct ProjectedSplats<'a> {
    /// `[V, 12]`, lanes as in [`crate::layout::lane`].
    pub lanes: Cow<'a, [f32]>,
    /// Index of the Gaussian behind each splat, ascending, `[V]`.
    pub global_from_compact: Cow<'a, [u32]>,
    /// Gaussians culled for values that are not finite.
    pub num_non_finite: u64,
    /// Gaussians skipped with their cluster.
    pub num_culled_by_cluster: u64,
}

impl ProjectedSplats<'_> {
    /// Number of visible splats V.
    pub fn len(&self) -> usize {
        self.global_from_compact.len()
    }

    /// True when nothing is visible.
    pub fn is_empty(&self) -> bool {
        self.global_from_compact.is_empty()
    }

    /// Lanes of each splat.
    pub fn rows(&self) -> &[[f32; lane::COUNT]] {
        self.lanes.as_chunks().0
    }
}

/// One view: camera, image size, near plane, antialiasing.
#[derive(Debug, Clone, Copy)]
pub struct ViewSpec {
    /// Camera.
    pub params: ViewParams,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Near plane, world units.
    pub near: f32,
    /// Opacities are compensated for the dilation ([`crate::math::compensation`]).
    pub antialiased: bool,
}

/// What became of one Gaussian.
enum Outcome {
    Visible([f32; lane::COUNT]),
    Culled,
    NonFinite,
}

/// Projects all Gaussians; `clusters` are their bounds ([`crate::cluster::clusters`]) if the caller keeps any.
pub fn project(g: &GaussianSlices<'_>, view: &ViewSpec, clusters: Option<&[Cluster]>) -> ProjectedSplats<'static> {
    let frustum = Frustum::new(&view.params, view.width as f32, view.height as f32, view.near);
    let parts: Vec<Part> = (0..g.len().div_ceil(CLUSTER))
        .into_par_iter()
        .map(|chunk| {
            let range = chunk * CLUSTER..((chunk + 1) * CLUSTER).min(g.len());
            let mut part = Part::default();
            if clusters.is_some_and(|c| frustum.excludes_cluster(&c[chunk])) {
                part.num_culled_by_cluster = range.len() as u64;
                return part;
            }
            vectorize(
                #[inline(always)]
                || {
                    for i in range {
                        match project_one(g, view, &frustum, i) {
                            Outcome::Visible(lanes) => {
                                part.lanes.extend_from_slice(&lanes);
                                part.global_from_compact.push(i as u32);
                            }
                            Outcome::Culled => {}
                            Outcome::NonFinite => part.num_non_finite += 1,
                        }
                    }
                },
            );
            part
        })
        .collect();
    concatenate(&parts)
}

/// The visible splats of one chunk.
#[derive(Default)]
struct Part {
    lanes: Vec<f32>,
    global_from_compact: Vec<u32>,
    num_non_finite: u64,
    num_culled_by_cluster: u64,
}

/// The parts one after the other.
fn concatenate(parts: &[Part]) -> ProjectedSplats<'static> {
    let num_visible = parts.iter().map(|p| p.global_from_compact.len()).sum();
    let mut lanes = Vec::with_capacity(num_visible * lane::COUNT);
    let mut global_from_compact = Vec::with_capacity(num_visible);
    for part in parts {
        lanes.extend_from_slice(&part.lanes);
        global_from_compact.extend_from_slice(&part.global_from_compact);
    }
    ProjectedSplats {
        lanes: lanes.into(),
        global_from_compact: global_from_compact.into(),
        num_non_finite: parts.iter().map(|p| p.num_non_finite).sum(),
        num_culled_by_cluster: parts.iter().map(|p| p.num_culled_by_cluster).sum(),
    }
}

/// Projection of Gaussian `i`.
#[expect(clippy::neg_cmp_op_on_partial_ord, reason = "the comparison must fail for NaN")]
#[inline(always)]
fn project_one(g: &GaussianSlices<'_>, view: &ViewSpec, frustum: &Frustum, i: usize) -> Outcome {
    // 1. Mean in the camera; the comparison is false for NaN.
    let mean = g.mean(i);
    let in_camera = to_camera(view.params, mean);
    if !(in_camera.z > view.near) {
        let finite = mean.x.is_finite() && mean.y.is_finite() && mean.z.is_finite();
        return if finite { Outcome::Culled } else { Outcome::NonFinite };
    }
    let quat = g.quats.as_chunks::<4>().0[i];
    let log_scales = g.log_scales.as_chunks::<3>().0[i];
    let logit = g.opacity_logits[i];
    let rest = quat.iter().chain(&log_scales);
    if ![mean.x, mean.y, mean.z, logit].iter().chain(rest).all(|v| v.is_finite()) {
        return Outcome::NonFinite;
    }
    let mut opacity = sigmoid(logit);
    if opacity < ALPHA_MIN || quat.iter().all(|q| q.abs() < 0.5 * QUAT_NORM2_MIN.sqrt()) {
        return Outcome::Culled;
    }
    let scales = g.scales(i);
    if frustum.excludes(mean, scales.x.max(scales.y).max(scales.z)) {
        return Outcome::Culled;
    }
    // 2.–4. Σ' = J W Σ Wᵀ Jᵀ + 0.3 I and its inverse (Zwicker 2001; Kerbl 2023, Eq. 5).
    let fp = footprint(view.params, in_camera, g.quat(i), scales);
    if fp.unit.norm * fp.unit.norm < QUAT_NORM2_MIN || fp.dilated.det <= DET_MIN {
        return Outcome::Culled;
    }
    if view.antialiased {
        opacity *= compensation(fp.dilated);
        if opacity < ALPHA_MIN {
            return Outcome::Culled;
        }
    }
    // 5. Extent of the contour α = 1/255.
    let log2_opacity = opacity.ln() * LOG2_E;
    let power2 = contour_power2(log2_opacity).max(0.0);
    let extent_x = (power2 * fp.dilated.cov.xx).sqrt();
    let extent_y = (power2 * fp.dilated.cov.yy).sqrt();
    let mean_x = view.params.fx * in_camera.x / in_camera.z + view.params.cx;
    let mean_y = view.params.fy * in_camera.y / in_camera.z + view.params.cy;
    let (right, bottom) = (view.width as f32 - 0.5, view.height as f32 - 0.5);
    let reach = 1.0 + EXTENT_SLACK;
    if mean_x + extent_x * reach < 0.5
        || mean_x - extent_x * reach > right
        || mean_y + extent_y * reach < 0.5
        || mean_y - extent_y * reach > bottom
    {
        return Outcome::Culled;
    }
    // 6. Colour seen from the camera centre.
    let direction = view_direction(view.params, mean);
    let mut basis = [0.0; MAX_COEFFICIENTS];
    sh_basis(g.sh_degree, direction.unit, &mut basis);
    let mut color = [0.5f32; 3];
    for (b, c) in basis.iter().zip(g.coefficients(i)) {
        for a in 0..3 {
            color[a] += b * c[a];
        }
    }
    let lanes = [
        mean_x,
        mean_y,
        fp.conic.xx,
        fp.conic.xy,
        fp.conic.yy,
        log2_opacity,
        color[0],
        color[1],
        color[2],
        in_camera.z,
        extent_x,
        extent_y,
    ];
    if !lanes.iter().all(|v| v.is_finite()) {
        return Outcome::NonFinite;
    }
    let mut lanes = lanes;
    for c in &mut lanes[lane::RED..lane::RED + 3] {
        *c = c.max(0.0);
    }
    Outcome::Visible(lanes)
}

/// SH coefficients of the highest degree.
pub(super) const MAX_COEFFICIENTS: usize = gazesplat_core::sh::num_coefficients(gazesplat_core::sh::MAX_DEGREE);

/// Basis functions up to `degree` in the unit direction `d`.
#[inline(always)]
pub(super) fn sh_basis(degree: u32, d: Vec3, basis: &mut [f32; MAX_COEFFICIENTS]) {
    let Vec3 { x, y, z } = d;
    basis[0] = sh::C0;
    if degree >= 1 {
        let b = sh::band1(x, y, z);
        basis[1..4].copy_from_slice(&[b.m0, b.m1, b.m2]);
    }
    if degree >= 2 {
        let b = sh::band2(x, y, z);
        basis[4..9].copy_from_slice(&[b.m0, b.m1, b.m2, b.m3, b.m4]);
    }
    if degree >= 3 {
        let b = sh::band3(x, y, z);
        basis[9..16].copy_from_slice(&[b.m0, b.m1, b.m2, b.m3, b.m4, b.m5, b.m6]);
    }
    if degree >= 4 {
        let b = sh::band4(x, y, z);
        basis[16..25].copy_from_slice(&[b.m0, b.m1, b.m2, b.m3, b.m4, b.m5, b.m6, b.m7, b.m8]);
    }
}
