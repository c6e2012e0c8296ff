//! The first Gaussians: at the points of the reconstruction, or at random in front of the cameras.
//!
//! As in 3DGS, Sec. 5.1, a Gaussian starts as a sphere whose scale is the root mean square distance to its three nearest
//! neighbours, with the colour of its point. Ours: points that are not finite or absurdly far away are left out, and a
//! scale is at most a tenth of the distance to the nearest camera, so that a lone point does not begin as a fog bank.

use crate::config::Config;
use crate::error::{Error, Result};
use crate::rng::{Stream, draw, permutation, uniform};
use gazesplat_core::dataset::{Dataset, SparsePoints};
use gazesplat_core::sh::dc_from_color;
use gazesplat_core::{Camera, GaussianCloud};
use glam::{DMat3, DVec3, Vec3};
use rayon::prelude::*;
use rstar::{RTree, primitives::GeomWithData};

/// Points further from the middle of the cameras than this many scene extents are triangulation errors.
const MAX_DISTANCE_EXTENTS: f32 = 1000.0;
/// Largest initial scale per distance to the nearest camera: 6 degrees.
const MAX_ANGULAR_SCALE: f32 = 0.1;
/// Smallest initial scale in scene extents: points that coincide would have scale 0.
const MIN_SCALE_EXTENTS: f32 = 1e-5;
/// Neighbours whose distances give the scale (3DGS).
const NUM_NEIGHBORS: usize = 3;

/// An initial model and what a person should know about it.
#[derive(Debug, Clone, PartialEq)]
pub struct Initial {
    /// The Gaussians, SH degree 0.
    pub cloud: GaussianCloud,
    /// Where they come from, and what was left out.
    pub messages: Vec<String>,
}

/// The middle of the camera positions.
pub fn camera_center(cameras: &[Camera]) -> Vec3 {
    let sum: Vec3 = cameras.iter().map(Camera::position).sum();
    sum / cameras.len().max(1) as f32
}

/// Initial Gaussians of a scene.
///
/// # Errors
/// [`Error::NoTrainingViews`] when there are neither points nor views to place random ones.
pub fn initial_cloud(dataset: &Dataset, config: &Config) -> Result<Initial> {
    let cameras: Vec<Camera> = dataset.train.iter().map(|v| v.camera).collect();
    if cameras.is_empty() {
        return Err(Error::NoTrainingViews { num_test: dataset.test.len() });
    }
    let extent = positive_extent(dataset.scene_extent());
    let center = camera_center(&cameras);
    let mut messages = Vec::new();
    let mut points = usable(&dataset.points, center, MAX_DISTANCE_EXTENTS * extent);
    let num_left_out = dataset.points.positions.len() - points.positions.len();
    if num_left_out > 0 {
        messages.push(format!("{num_left_out} points are not finite or too far away and were left out"));
    }
    if points.positions.is_empty() {
        let num_points = config.init.random_points.min(config.densify.cap);
        points = random_points(&cameras, extent, num_points, config.train.seed);
        messages.push(format!("the scene has no usable points: {num_points} random Gaussians in front of the cameras"));
    } else if points.positions.len() > config.densify.cap {
        let mut kept = permutation(points.positions.len(), config.train.seed, Stream::Init, 1);
        kept.truncate(config.densify.cap);
        kept.sort_unstable();
        messages.push(format!("{} of {} points are used (densify.cap)", kept.len(), points.positions.len()));
        points = SparsePoints {
            positions: kept.iter().map(|&i| points.positions[i]).collect(),
            colors: kept.iter().map(|&i| points.colors[i]).collect(),
        };
    }
    let scales = neighbor_distances(&points.positions);
    let positions: Vec<Vec3> = cameras.iter().map(Camera::position).collect();
    let log_scales = points.positions.par_iter().zip(&scales).map(|(&point, &distance)| {
        let nearest = positions.iter().map(|c| c.distance(Vec3::from(point))).fold(f32::INFINITY, f32::min);
        let least = MIN_SCALE_EXTENTS * extent;
        let scale = config.init.scale * distance.min(MAX_ANGULAR_SCALE * nearest);
        [scale.max(least).ln(); 3]
    });
    let n = points.positions.len();
    let opacity = config.init.opacity;
    let cloud = GaussianCloud {
        log_scales: log_scales.collect(),
        quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: vec![(opacity / (1.0 - opacity)).ln(); n],
        sh_degree: 0,
        sh: points.colors.iter().map(|c| c.map(|v| dc_from_color(f32::from(v) / 255.0))).collect(),
        means: points.positions,
    };
    Ok(Initial { cloud, messages })
}

/// `extent`, or 1 where a scene has a single camera position.
pub(crate) fn positive_extent(extent: f32) -> f32 {
    if extent.is_finite() && extent > 0.0 { extent } else { 1.0 }
}

fn usable(points: &SparsePoints, center: Vec3, max_distance: f32) -> SparsePoints {
    let gray = [128; 3];
    let (positions, colors) = points
        .positions
        .iter()
        .enumerate()
        // Written so that NaN fails.
        .filter(|(_, p)| Vec3::from(**p).distance(center) <= max_distance)
        .map(|(i, p)| (*p, points.colors.get(i).copied().unwrap_or(gray)))
        .unzip();
    SparsePoints { positions, colors }
}

/// Root mean square distance of each point to its three nearest neighbours; infinite for a single point.
fn neighbor_distances(points: &[[f32; 3]]) -> Vec<f32> {
    let tree = RTree::bulk_load(points.iter().enumerate().map(|(i, p)| GeomWithData::new(*p, i)).collect());
    points
        .par_iter()
        .enumerate()
        .map(|(i, point)| {
            let (mut sum, mut count) = (0.0, 0);
            let others = tree.nearest_neighbor_iter_with_distance_2(point).filter(|(other, _)| other.data != i);
            for (_, squared) in others.take(NUM_NEIGHBORS) {
                sum += squared;
                count += 1;
            }
            if count == 0 { f32::INFINITY } else { (sum / count as f32).sqrt() }
        })
        .collect()
}

/// Random grey-centred colours at random places that cameras see: a random pixel of a random view at a random depth, up to
/// twice the distance at which the views look. Where enough views overlap, a point has to be in front of three of them,
/// which keeps random points where there is parallax.
fn random_points(cameras: &[Camera], extent: f32, num_points: usize, seed: u64) -> SparsePoints {
    const MAX_DRAWS: u32 = 64;
    let focus = focus_distance(cameras, extent);
    let needed = cameras.len().min(3);
    (0..num_points)
        .into_par_iter()
        .map(|i| {
            let mut best = (0, [0.0f32; 3], [128u8; 3]);
            for attempt in 0..MAX_DRAWS {
                let a = draw(seed, Stream::Init, 2 * attempt + 2, i as u64);
                let b = draw(seed, Stream::Init, 2 * attempt + 3, i as u64);
                let camera = &cameras[(uniform(a[0]) * cameras.len() as f32) as usize];
                let depth = focus * (0.1 + 1.9 * uniform(a[3]));
                let point = unproject(camera, uniform(a[1]), uniform(a[2]), depth);
                let num_seen = cameras.iter().filter(|c| sees(c, point)).take(needed).count();
                if attempt == 0 || num_seen > best.0 {
                    // Around grey: saturated colours take long to unlearn.
                    let color = [b[0], b[1], b[2]].map(|w| (64.0 + 128.0 * uniform(w)) as u8);
                    best = (num_seen, point.into(), color);
                }
                if best.0 >= needed {
                    break;
                }
            }
            (best.1, best.2)
        })
        .collect::<Vec<_>>()
        .into_iter()
        .fold(SparsePoints::default(), |mut points, (position, color)| {
            points.positions.push(position);
            points.colors.push(color);
            points
        })
}

/// World point at relative image position (u, v) in 0..1 and depth `depth` along the viewing axis.
fn unproject(camera: &Camera, u: f32, v: f32, depth: f32) -> Vec3 {
    let k = &camera.intrinsics;
    let x = (u * k.width as f32 - k.cx) / k.fx * depth;
    let y = (v * k.height as f32 - k.cy) / k.fy * depth;
    camera.camera_from_world.inverse().transform_point3(Vec3::new(x, y, depth))
}

fn sees(camera: &Camera, point: Vec3) -> bool {
    let p = camera.camera_from_world.transform_point3(point);
    let k = &camera.intrinsics;
    let (x, y) = (k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy);
    p.z > 0.0 && (0.0..k.width as f32).contains(&x) && (0.0..k.height as f32).contains(&y)
}

/// Median distance from the cameras to the point nearest to all viewing axes; three extents where the axes have no such
/// point in front of the cameras (parallel or diverging views).
fn focus_distance(cameras: &[Camera], extent: f32) -> f32 {
    let fallback = 3.0 * extent;
    let (mut matrix, mut vector) = (DMat3::ZERO, DVec3::ZERO);
    for camera in cameras {
        let axis = camera.forward().as_dvec3().normalize_or_zero();
        let projector = DMat3::IDENTITY - DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
        matrix += projector;
        vector += projector * camera.position().as_dvec3();
    }
    if matrix.determinant().abs() < 1e-6 * (cameras.len() as f64).powi(3) {
        return fallback;
    }
    let point = (matrix.inverse() * vector).as_vec3();
    let mut depths: Vec<f32> = cameras.iter().map(|c| (point - c.position()).dot(c.forward())).collect();
    depths.sort_by(f32::total_cmp);
    let depth = depths[depths.len() / 2];
    if depth > 0.1 * extent && depth < 100.0 * extent { depth } else { fallback }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gazesplat_core::Pinhole;

    fn ring(n: usize) -> Vec<Camera> {
        let intrinsics = Pinhole::from_fov_x(64, 48, 0.9);
        (0..n)
            .map(|i| {
                let a = i as f32 / n as f32 * std::f32::consts::TAU;
                Camera::look_at(intrinsics, Vec3::new(4.0 * a.cos(), 1.0, 4.0 * a.sin()), Vec3::ZERO, Vec3::Y)
            })
            .collect()
    }

    #[test]
    fn scales_are_distances_to_the_three_nearest() {
        let points: Vec<[f32; 3]> = (0..4)
            .flat_map(|x| (0..4).flat_map(move |y| (0..4).map(move |z| [x as f32, y as f32, z as f32])))
            .collect();
        assert!(neighbor_distances(&points).iter().all(|d| (d - 1.0).abs() < 1e-6));
        assert_eq!(neighbor_distances(&[[0.0; 3]]), [f32::INFINITY]);
        assert_eq!(neighbor_distances(&[[1.0; 3], [1.0; 3]]), [0.0, 0.0]);
    }

    #[test]
    fn broken_points_are_left_out() {
        let points = SparsePoints {
            positions: vec![[0.0; 3], [f32::NAN, 0.0, 0.0], [1e9, 0.0, 0.0], [1.0; 3]],
            colors: vec![[1; 3], [2; 3], [3; 3], [4; 3]],
        };
        let kept = usable(&points, Vec3::ZERO, 4000.0);
        assert_eq!(kept.colors, [[1; 3], [4; 3]]);
    }

    #[test]
    fn random_points_are_seen_by_three_views_and_follow_the_seed() {
        let cameras = ring(12);
        assert!((focus_distance(&cameras, 4.4) - 17.0f32.sqrt()).abs() < 0.01);
        let points = random_points(&cameras, 4.4, 500, 1);
        assert_eq!(points, random_points(&cameras, 4.4, 500, 1));
        assert_ne!(points, random_points(&cameras, 4.4, 500, 2));
        for point in &points.positions {
            assert!(cameras.iter().filter(|c| sees(c, Vec3::from(*point))).count() >= 3, "{point:?}");
        }
    }

    #[test]
    fn parallel_views_have_a_finite_focus() {
        let cameras: Vec<Camera> = (0..3)
            .map(|i| {
                let eye = Vec3::new(i as f32, 0.0, 0.0);
                Camera::look_at(Pinhole::from_fov_x(64, 48, 0.9), eye, eye + Vec3::Z, Vec3::NEG_Y)
            })
            .collect();
        assert_eq!(focus_distance(&cameras, 1.1), 3.3000002);
    }
}
