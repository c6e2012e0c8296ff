//! Culling of whole clusters of Gaussians before any of them is read.
//!
//! A cluster is [`CLUSTER`] consecutive rows. Its box bounds the means, its radius the largest standard deviation; the
//! test is conservative, so culling a cluster never changes a pixel. It pays when the rows are spatially sorted
//! ([`morton_order`]). A cluster with a mean or scale that is not finite is never culled here: its rows are counted one
//! by one. Other values of culled rows are not read, so not counted.

use crate::kernels::cpu::project::GaussianSlices;
use crate::layout::CLUSTER;
use crate::math::alpha::{LN_2, LOG2_ALPHA_MIN};
use crate::math::conic::DILATION;
use crate::math::ewa::ViewParams;
use crate::math::frustum::{Side, Sides, excludes};
use crate::math::vec::{Vec3, combine, dot};
use rayon::prelude::*;

/// Pixels added to every footprint before it is called outside: rounding must not cull what touches the border.
const SLACK_PX: f32 = 0.5;

/// Bounds of one cluster.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cluster {
    /// Middle of the box around the means, world units.
    center: [f32; 3],
    /// Half its size.
    half: [f32; 3],
    /// Largest standard deviation of a member, world units.
    scale: f32,
}

/// Bounds of all clusters of a model, `[⌈N / CLUSTER⌉]`.
pub fn clusters(gaussians: &GaussianSlices<'_>) -> Vec<Cluster> {
    let (means, scales) = (gaussians.means.as_chunks::<3>().0, gaussians.log_scales.as_chunks::<3>().0);
    means
        .par_chunks(CLUSTER)
        .zip(scales.par_chunks(CLUSTER))
        .map(|(means, log_scales)| {
            let (mut low, mut high, mut widest) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3], f32::NEG_INFINITY);
            let mut finite = true;
            for (m, s) in means.iter().zip(log_scales) {
                for a in 0..3 {
                    low[a] = low[a].min(m[a]);
                    high[a] = high[a].max(m[a]);
                    widest = widest.max(s[a]);
                    finite &= m[a].is_finite() && s[a].is_finite();
                }
            }
            // Every comparison with NaN fails, so nothing excludes such a cluster.
            let center = std::array::from_fn(|a| if finite { 0.5 * (low[a] + high[a]) } else { f32::NAN });
            let half = std::array::from_fn(|a| 0.5 * (high[a] - low[a]));
            Cluster { center, half, scale: widest.exp() }
        })
        .collect()
}

/// Half-spaces that contain everything a frame can show: near plane and the four [`Sides`].
#[derive(Debug, Clone, Copy)]
pub struct Frustum {
    /// The four sides.
    pub sides: Sides,
    depth_axis: Vec3,
    depth_offset: f32,
    near: f32,
}

impl Frustum {
    /// The frustum of `view` for an image of `width` × `height` pixels.
    pub fn new(view: &ViewParams, width: f32, height: f32, near: f32) -> Self {
        let power2 = -2.0 * LN_2 * LOG2_ALPHA_MIN;
        let dilation = (DILATION * power2).sqrt() + SLACK_PX;
        let rx = view.min_x.abs().max(view.max_x.abs());
        let ry = view.min_y.abs().max(view.max_y.abs());
        let (w, t) = (view.rotation, view.translation);
        let side = |f: f32, axis: Vec3, t_axis: f32, edge: f32, ratio: f32| Side {
            normal: combine(f, axis, edge + dilation, w.row2),
            offset: f * t_axis + (edge + dilation) * t.z,
            pad: 1.001 * power2.sqrt() * f.abs() * (1.0 + ratio * ratio).sqrt(),
        };
        Self {
            sides: Sides {
                left: side(view.fx, w.row0, t.x, view.cx, rx),
                right: side(-view.fx, w.row0, t.x, width - view.cx, rx),
                top: side(view.fy, w.row1, t.y, view.cy, ry),
                bottom: side(-view.fy, w.row1, t.y, height - view.cy, ry),
            },
            depth_axis: w.row2,
            depth_offset: t.z,
            near,
        }
    }

    /// Whether a Gaussian in front of the near plane with largest standard deviation `scale` lies outside for certain.
    #[inline(always)]
    pub fn excludes(&self, mean: Vec3, scale: f32) -> bool {
        excludes(self.sides, mean, scale)
    }

    /// Whether every member of `cluster` lies outside for certain.
    pub fn excludes_cluster(&self, cluster: &Cluster) -> bool {
        let [x, y, z] = cluster.center;
        let center = Vec3 { x, y, z };
        let reach = |n: Vec3| n.x.abs() * cluster.half[0] + n.y.abs() * cluster.half[1] + n.z.abs() * cluster.half[2];
        dot(self.depth_axis, center) + self.depth_offset + reach(self.depth_axis) <= self.near * 0.999
            || [self.sides.left, self.sides.right, self.sides.top, self.sides.bottom]
                .iter()
                .any(|s| dot(s.normal, center) + s.offset + s.pad * cluster.scale + reach(s.normal) < 0.0)
    }
}

/// Order of the rows along a Morton curve through the box of the finite means; `means` is `[N, 3]`. Rows that are not
/// finite come last. Ties keep their order.
pub fn morton_order(means: &[[f32; 3]]) -> Vec<u32> {
    let finite = |m: &&[f32; 3]| m.iter().all(|c| c.is_finite());
    let (low, high) = means.iter().filter(finite).fold(([f32::MAX; 3], [f32::MIN; 3]), |(low, high), m| {
        (std::array::from_fn(|a| m[a].min(low[a])), std::array::from_fn(|a| m[a].max(high[a])))
    });
    let cells = f64::from(1 << 21) - 1.0;
    let key = |m: &[f32; 3]| -> u64 {
        if !finite(&m) {
            return u64::MAX;
        }
        (0..3).fold(0, |key, a| {
            let share = (f64::from(m[a]) - f64::from(low[a])) / (f64::from(high[a]) - f64::from(low[a])).max(1e-30);
            key | spread((share * cells) as u64) << a
        })
    };
    let mut order: Vec<(u64, u32)> = means.par_iter().enumerate().map(|(i, m)| (key(m), i as u32)).collect();
    order.par_sort_unstable();
    order.into_iter().map(|(_, i)| i).collect()
}

/// Puts two zero bits between the low 21 bits of `v`.
fn spread(v: u64) -> u64 {
    let v = v & 0x1f_ffff;
    let v = (v | v << 32) & 0x001f_0000_0000_ffff;
    let v = (v | v << 16) & 0x001f_0000_ff00_00ff;
    let v = (v | v << 8) & 0x100f_00f0_0f00_f00f;
    let v = (v | v << 4) & 0x10c3_0c30_c30c_30c3;
    (v | v << 2) & 0x1249_2492_4924_9249
}
