//! A model for benchmarks with the statistics of a trained one, without a training run.
//!
//! Gaussians lie on the surfaces of the room, evenly by area: flat (a fifth as thick as wide), turned with the surface, in
//! the colour of the surface, with log-normal widths in proportion to the distance between neighbours and two groups of
//! opacities (dense and faint), as found in trained models. Seen from [`bench_camera`] at 1000 × 1000 pixels,
//! 300 000 of them are the standard case: about 40 % in view, 30 to 40 blended per pixel before the transmittance falls
//! below 10⁻⁴ (a test keeps these figures).

use super::{SyntheticScene, linear_to_srgb, ring_camera, tone_mapped};
use crate::camera::{Camera, Pinhole};
use crate::gaussian_cloud::GaussianCloud;
use crate::rng::Rng;
use crate::sh;
use glam::{Mat3, Quat, Vec2};
use rayon::prelude::*;

const SH_DEGREE: u32 = 3;
/// Mean width (standard deviation) in units of the mean distance between Gaussians: sets the blends per pixel.
const WIDTH: f32 = 0.6;
/// Standard deviation of the logarithm of the width.
const WIDTH_SPREAD: f32 = 0.4;
/// Standard deviation of the view-dependent coefficients.
const SH_REST_DEVIATION: f32 = 0.02;

/// `num_gaussians` Gaussians of SH degree 3 on the surfaces of [`SyntheticScene::room`]. Gaussian i depends on `seed`, i and
/// `num_gaussians` only.
pub fn bench_cloud(num_gaussians: usize, seed: u64) -> GaussianCloud {
    on_surfaces_of(&SyntheticScene::room(0), num_gaussians, seed)
}

fn on_surfaces_of(scene: &SyntheticScene, num_gaussians: usize, seed: u64) -> GaussianCloud {
    let patches = Patches::new(scene);
    let spacing = (patches.total_area() / num_gaussians.max(1) as f32).sqrt();
    let mut cloud = GaussianCloud::zeros(num_gaussians, SH_DEGREE);
    let k = sh::num_coefficients(SH_DEGREE);
    (
        cloud.means.par_iter_mut(),
        cloud.quats.par_iter_mut(),
        cloud.log_scales.par_iter_mut(),
        cloud.opacity_logits.par_iter_mut(),
        cloud.sh.par_chunks_exact_mut(k),
    )
        .into_par_iter()
        .enumerate()
        .for_each(|(i, (mean, quat, log_scale, opacity_logit, sh))| {
            let mut rng = Rng::for_index(seed, i as u64);
            let point = patches.sample(scene, &mut rng);
            *mean = (point.position + 0.1 * spacing * rng.normal() * point.normal).to_array();
            let (tangent, bitangent) = point.normal.any_orthonormal_pair();
            let spin = Quat::from_axis_angle(point.normal, rng.range(0.0, std::f32::consts::TAU));
            let q = spin * Quat::from_mat3(&Mat3::from_cols(tangent, bitangent, point.normal));
            *quat = [q.w, q.x, q.y, q.z];
            let width = (WIDTH * spacing).ln() + WIDTH_SPREAD * rng.normal();
            let stretch = 0.35 * rng.normal();
            *log_scale = [width + stretch, width - stretch, width + 0.2f32.ln()];
            *opacity_logit = if rng.uniform() < 0.4 { 1.6 + 1.2 * rng.normal() } else { -1.6 + rng.normal() };
            let seen = tone_mapped(scene.outgoing(&point, point.normal)).to_array();
            sh[0] = seen.map(|c| sh::dc_from_color(linear_to_srgb(c)));
            for coefficient in &mut sh[1..] {
                *coefficient = [0; 3].map(|_| SH_REST_DEVIATION * rng.normal());
            }
        });
    cloud
}

/// The camera of the standard benchmark: one of the room's ring, about 40 % of a [`bench_cloud`] in its frustum.
pub fn bench_camera(width: u32, height: u32) -> Camera {
    ring_camera(5, 40, Pinhole::from_fov_x(width, height, 68f32.to_radians()))
}

/// All faces with their cumulative areas.
struct Patches {
    faces: Vec<(usize, usize)>,
    cumulative_area: Vec<f32>,
}

impl Patches {
    fn new(scene: &SyntheticScene) -> Self {
        let (mut faces, mut cumulative_area, mut sum) = (Vec::new(), Vec::new(), 0.0);
        for (object, placed) in scene.geometry.objects.iter().enumerate() {
            for face in 0..placed.shape.num_faces() {
                sum += placed.shape.patch_size(face).element_product();
                faces.push((object, face));
                cumulative_area.push(sum);
            }
        }
        Self { faces, cumulative_area }
    }

    fn total_area(&self) -> f32 {
        self.cumulative_area.last().copied().unwrap_or(0.0)
    }

    fn sample(&self, scene: &SyntheticScene, rng: &mut Rng) -> super::SurfacePoint {
        loop {
            let area = rng.uniform_f64() as f32 * self.total_area();
            let patch = self.cumulative_area.partition_point(|&a| a <= area).min(self.faces.len() - 1);
            let (object, face) = self.faces[patch];
            let uv = Vec2::new(rng.uniform(), rng.uniform());
            if scene.geometry.objects[object].shape.is_on_patch(face, uv) {
                return scene.geometry.patch_point(object, face, uv);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    /// Blends per pixel and share in view, by the definition: on a grid of pixels, all Gaussians that reach 1/255 there,
    /// front to back until the transmittance falls below 1e-4.
    #[test]
    fn standard_case_has_its_statistics() {
        const STEP: usize = 25;
        let camera = bench_camera(1000, 1000);
        let cloud = bench_cloud(300_000, 0);
        let (fx, fy) = (camera.intrinsics.fx, camera.intrinsics.fy);
        let mut pixels = vec![Vec::new(); (1000 / STEP).pow(2)];
        let mut num_visible = 0;
        for i in 0..cloud.len() {
            let m = camera.camera_from_world.transform_point3(Vec3::from(cloud.means[i]));
            if m.z < 0.01 {
                continue;
            }
            let center = Vec2::new(fx * m.x / m.z + camera.intrinsics.cx, fy * m.y / m.z + camera.intrinsics.cy);
            let [w, x, y, z] = cloud.quats[i];
            let axes = Mat3::from_quat(Quat::from_xyzw(x, y, z, w))
                * Mat3::from_diagonal(Vec3::from(cloud.log_scales[i]).exp());
            let in_camera = Mat3::from_mat4(camera.camera_from_world) * axes;
            // Kerbl 2023, Eq. 5 with the low-pass of 0.3 px² and the clamp of the Jacobian of the reference code.
            let limit = 1.3 * 500.0 / Vec2::new(fx, fy);
            let tan = (Vec2::new(m.x, m.y) / m.z).clamp(-limit, limit);
            let row_x = in_camera.transpose() * Vec3::new(fx / m.z, 0.0, -fx * tan.x / m.z);
            let row_y = in_camera.transpose() * Vec3::new(0.0, fy / m.z, -fy * tan.y / m.z);
            let (a, b, c) = (row_x.length_squared() + 0.3, row_x.dot(row_y), row_y.length_squared() + 0.3);
            let determinant = a * c - b * b;
            let opacity = 1.0 / (1.0 + (-cloud.opacity_logits[i]).exp());
            let reach = 2.0 * (255.0 * opacity).ln().max(0.0);
            let extent = Vec2::new((reach * a).sqrt(), (reach * c).sqrt());
            let (low, high) = (center - extent, center + extent);
            if high.min_element() < 0.0 || low.max_element() > 1000.0 || reach == 0.0 {
                continue;
            }
            num_visible += 1;
            let first = |v: f32| (v.max(0.0) / STEP as f32).ceil() as usize;
            let last = |v: f32| ((v.max(0.0) / STEP as f32) as usize + 1).min(1000 / STEP);
            for gy in first(low.y)..last(high.y) {
                for gx in first(low.x)..last(high.x) {
                    let d = Vec2::new((gx * STEP) as f32, (gy * STEP) as f32) - center;
                    let power = 0.5 * (c * d.x * d.x - 2.0 * b * d.x * d.y + a * d.y * d.y) / determinant;
                    let alpha = (opacity * (-power).exp()).min(0.999);
                    if alpha >= 1.0 / 255.0 {
                        pixels[gy * (1000 / STEP) + gx].push((m.z, alpha));
                    }
                }
            }
        }
        let blends = |list: &mut Vec<(f32, f32)>| {
            list.sort_by(|a, b| a.0.total_cmp(&b.0));
            let mut transmittance = 1.0;
            list.iter()
                .take_while(|(_, alpha)| {
                    let goes_on = transmittance > 1e-4;
                    transmittance *= 1.0 - alpha;
                    goes_on
                })
                .count()
        };
        let mean = pixels.iter_mut().map(blends).sum::<usize>() as f32 / pixels.len() as f32;
        let visible = num_visible as f32 / cloud.len() as f32;
        eprintln!("{mean} blends per pixel, {visible} in view");
        assert!((30.0..40.0).contains(&mean), "{mean} blends per pixel");
        assert!((0.35..0.45).contains(&visible), "{visible} in view");
    }

    #[test]
    fn rows_are_valid_and_reproducible() {
        let scene = SyntheticScene::room(0);
        let cloud = on_surfaces_of(&scene, 500, 3);
        assert!(cloud.validate().is_ok());
        assert_eq!(cloud, bench_cloud(500, 3));
        assert_ne!(cloud.means, on_surfaces_of(&scene, 500, 4).means);
    }
}
