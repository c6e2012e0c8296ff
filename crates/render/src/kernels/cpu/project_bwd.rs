//! Gradient of the projection: from the records of each splat's pairs to the parameters of its Gaussian.
//!
//! One chunk of [`CLUSTER`] rows per task, which owns the gradient rows of its Gaussians. The forward intermediates are
//! computed again: cheaper than storing them. Rows of Gaussians that are not visible are zero. A row in which anything
//! overflows is zeroed as a whole: no step along it would mean anything.

use super::bin::TileLists;
use super::project::{GaussianSlices, MAX_COEFFICIENTS, ProjectedSplats, ViewSpec, sh_basis};
use super::rasterize_bwd::Record;
use crate::layout::{CLUSTER, grad_lane, lane};
use crate::math::alpha::sigmoid;
use crate::math::ewa::{ViewDirection, to_camera, view_direction, view_direction_vjp};
use crate::math::footprint::{SplatGradient, antialiased_vjp, footprint, footprint_vjp};
use crate::math::sh;
use crate::math::vec::{Sym2, Vec3};
use crate::simd::{prefetch, vectorize};
use rayon::prelude::*;

/// Gradients of the parameters of N Gaussians, shapes as in [`GaussianSlices`].
#[derive(Debug, Clone, Default)]
pub struct ParameterGradients {
    /// `[N, 3]`.
    pub means: Vec<f32>,
    /// `[N, 4]`, with respect to the raw quaternions.
    pub quats: Vec<f32>,
    /// `[N, 3]`.
    pub log_scales: Vec<f32>,
    /// `[N]`.
    pub opacity_logits: Vec<f32>,
    /// `[N, K, 3]`.
    pub sh: Vec<f32>,
    /// `[N, 4]`: image-plane gradient (x, y) in pixels, and the sums of its per-pixel magnitudes. Empty unless asked for.
    pub probe: Vec<f32>,
}

/// Gradient of everything in one row.
struct RowGradient {
    mean: [f32; 3],
    quat: [f32; 4],
    log_scales: [f32; 3],
    opacity_logit: f32,
    color: [f32; 3],
}

/// Sums each splat's pair gradients (list order, from [`super::rasterize_bwd::rasterize_bwd`]) and carries them back to
/// the parameters.
pub fn project_bwd(
    g: &GaussianSlices<'_>,
    view: &ViewSpec,
    splats: &ProjectedSplats<'_>,
    lists: &TileLists<'_>,
    pair_gradients: &[Record],
    probe: bool,
) -> ParameterGradients {
    let n = g.len();
    let k3 = g.num_coefficients * 3;
    let mut out = ParameterGradients {
        means: vec![0.0; n * 3],
        quats: vec![0.0; n * 4],
        log_scales: vec![0.0; n * 3],
        opacity_logits: vec![0.0; n],
        sh: vec![0.0; n * k3],
        probe: vec![0.0; if probe { n * 4 } else { 0 }],
    };
    // Visible splats of each chunk: the compact indices are ordered by Gaussian.
    let ids = &splats.global_from_compact;
    let starts: Vec<usize> =
        (0..=n.div_ceil(CLUSTER)).map(|c| ids.partition_point(|&id| (id as usize) < c * CLUSTER)).collect();
    let probe_ends = (1..=n.div_ceil(CLUSTER)).map(|c| if probe { (c * CLUSTER).min(n) * 4 } else { 0 });
    let probes = super::bin::split_at_offsets(&mut out.probe, probe_ends);
    out.means
        .par_chunks_mut(CLUSTER * 3)
        .zip(out.quats.par_chunks_mut(CLUSTER * 4))
        .zip(out.log_scales.par_chunks_mut(CLUSTER * 3))
        .zip(out.opacity_logits.par_chunks_mut(CLUSTER))
        .zip(out.sh.par_chunks_mut(CLUSTER * k3))
        .zip(probes)
        .zip(starts.par_windows(2))
        .enumerate()
        .for_each(|(chunk, ((((((means, quats), log_scales), logits), sh), probes), range))| {
            vectorize(
                #[inline(always)]
                || {
                    for (compact, &id) in (range[0]..).zip(&ids[range[0]..range[1]]) {
                        let i = id as usize;
                        let row = i - chunk * CLUSTER;
                        let v = sum_records(lists, pair_gradients, compact);
                        let in_image = [v[lane::MEAN_X], v[lane::MEAN_Y], v[grad_lane::ABS_X], v[grad_lane::ABS_Y]];
                        if let Some(probe) = probes.as_chunks_mut::<4>().0.get_mut(row)
                            && in_image.iter().all(|v| v.is_finite())
                        {
                            *probe = in_image;
                        }
                        let color = &splats.rows()[compact][lane::RED..lane::RED + 3];
                        let sh_row = sh[row * k3..][..k3].as_chunks_mut::<3>().0;
                        let gradient = row_gradient(g, view, i, &v, color, sh_row);
                        if gradient.is_finite() {
                            means.as_chunks_mut::<3>().0[row] = gradient.mean;
                            quats.as_chunks_mut::<4>().0[row] = gradient.quat;
                            log_scales.as_chunks_mut::<3>().0[row] = gradient.log_scales;
                            logits[row] = gradient.opacity_logit;
                        } else {
                            sh_row.fill([0.0; 3]);
                        }
                    }
                },
            );
        });
    out
}

impl RowGradient {
    #[inline(always)]
    fn is_finite(&self) -> bool {
        let all = self.mean.iter().chain(&self.quat).chain(&self.log_scales).chain(&self.color);
        // A sum of finite values that overflows belongs to a row that is useless anyway.
        all.chain(std::iter::once(&self.opacity_logit)).all(|v| v.is_finite())
    }
}

/// How many records ahead a pair's gradient is asked for.
const PREFETCH_AHEAD: usize = 24;

/// Sum over a splat's pairs, in the order of its records.
#[inline(always)]
fn sum_records(lists: &TileLists<'_>, pair_gradients: &[Record], compact: usize) -> Record {
    let records = lists.record_offsets[compact] as usize..lists.record_offsets[compact + 1] as usize;
    let mut sum = [0.0; grad_lane::COUNT];
    for r in records {
        // The pairs of one splat lie in different tiles: each is a cache miss unless asked for ahead.
        if let Some(&ahead) = lists.record_pairs.get(r + PREFETCH_AHEAD) {
            let [first, .., last] = &pair_gradients[ahead as usize];
            prefetch(first);
            prefetch(last);
        }
        for (s, v) in sum.iter_mut().zip(&pair_gradients[lists.record_pairs[r] as usize]) {
            *s += v;
        }
    }
    sum
}

/// Carries the gradient `v` of a splat's lanes to the parameters of Gaussian `i`; writes the SH rows.
#[inline(always)]
fn row_gradient(
    g: &GaussianSlices<'_>,
    view: &ViewSpec,
    i: usize,
    v: &Record,
    color: &[f32],
    v_sh: &mut [[f32; 3]],
) -> RowGradient {
    let mean = g.mean(i);
    let in_camera = to_camera(view.params, mean);
    let scales = g.scales(i);
    let fp = footprint(view.params, in_camera, g.quat(i), scales);
    let upstream = SplatGradient {
        mean_x: v[lane::MEAN_X],
        mean_y: v[lane::MEAN_Y],
        depth: v[lane::DEPTH],
        conic: Sym2 { xx: v[lane::CONIC_XX], xy: v[lane::CONIC_XY], yy: v[lane::CONIC_YY] },
    };
    let geometry = match view.antialiased {
        false => footprint_vjp(view.params, fp, in_camera, scales, upstream),
        true => antialiased_vjp(view.params, fp, in_camera, scales, upstream, v[lane::LOG2_OPACITY]),
    };
    let (v_mean, v_quat, v_log_scales) = (geometry.mean, geometry.quat, geometry.log_scales);
    // Colour: gated where it was clamped at 0.
    let v_color: [f32; 3] = std::array::from_fn(|c| if color[c] > 0.0 { v[lane::RED + c] } else { 0.0 });
    let direction = view_direction(view.params, mean);
    let v_through_color = sh_gradient(g, i, &direction, &v_color, v_sh);
    RowGradient {
        mean: [v_mean.x + v_through_color.x, v_mean.y + v_through_color.y, v_mean.z + v_through_color.z],
        quat: [v_quat.w, v_quat.x, v_quat.y, v_quat.z],
        log_scales: [v_log_scales.x, v_log_scales.y, v_log_scales.z],
        // v is ∂L/∂ln o, compensated or not, and ∂ ln o/∂logit = 1 − o = σ(−logit), which keeps its digits where o is close to 1.
        opacity_logit: v[lane::LOG2_OPACITY] * sigmoid(-g.opacity_logits[i]),
        color: v_color,
    }
}

/// Writes ∂L/∂SH and returns the gradient of the mean through the viewing direction.
#[inline(always)]
fn sh_gradient(
    g: &GaussianSlices<'_>,
    i: usize,
    direction: &ViewDirection,
    v_color: &[f32; 3],
    v_sh: &mut [[f32; 3]],
) -> Vec3 {
    let mut basis = [0.0; MAX_COEFFICIENTS];
    sh_basis(g.sh_degree, direction.unit, &mut basis);
    for (v_row, b) in v_sh.iter_mut().zip(&basis[..g.coefficients(i).len()]) {
        *v_row = v_color.map(|v| v * b);
    }
    view_direction_vjp(*direction, color_direction_vjp(g, i, direction.unit, v_color))
}

/// Gradient of the colour of Gaussian `i` with respect to the unit direction it is seen in, as three free variables.
#[inline(always)]
pub(super) fn color_direction_vjp(g: &GaussianSlices<'_>, i: usize, unit: Vec3, v_color: &[f32; 3]) -> Vec3 {
    let mut v_basis = [0.0f32; MAX_COEFFICIENTS];
    for (row, v_b) in g.coefficients(i).iter().zip(&mut v_basis) {
        *v_b = v_color[0] * row[0] + v_color[1] * row[1] + v_color[2] * row[2];
    }
    let Vec3 { x, y, z } = unit;
    let mut v = Vec3 { x: 0.0, y: 0.0, z: 0.0 };
    let mut add = |g: Vec3| v = Vec3 { x: v.x + g.x, y: v.y + g.y, z: v.z + g.z };
    let [_, a1, a2, a3, b0, b1, b2, b3, b4, c0, c1, c2, c3, c4, c5, c6, d @ ..] = v_basis;
    if g.sh_degree >= 1 {
        add(sh::band1_vjp(sh::Band1 { m0: a1, m1: a2, m2: a3 }));
    }
    if g.sh_degree >= 2 {
        add(sh::band2_vjp(x, y, z, sh::Band2 { m0: b0, m1: b1, m2: b2, m3: b3, m4: b4 }));
    }
    if g.sh_degree >= 3 {
        add(sh::band3_vjp(x, y, z, sh::Band3 { m0: c0, m1: c1, m2: c2, m3: c3, m4: c4, m5: c5, m6: c6 }));
    }
    if g.sh_degree >= 4 {
        let [m0, m1, m2, m3, m4, m5, m6, m7, m8] = d;
        add(sh::band4_vjp(x, y, z, sh::Band4 { m0, m1, m2, m3, m4, m5, m6, m7, m8 }));
    }
    v
}
