//! Small scenes: random ones, and flat discs at given pixels.

use gazesplat_core::{Camera, GaussianCloud, Pinhole};
use gazesplat_render::RenderOptions;
use gazesplat_testkit::Rng;
use glam::{Mat4, Vec3};

use super::Scene;

/// SH coefficient of degree 0 that shows the colour value `v`.
pub fn dc(v: f32) -> f32 {
    (v - 0.5) / 0.282_094_8
}

/// An SH degree 0 cloud without Gaussians.
pub fn empty_cloud() -> GaussianCloud {
    GaussianCloud::default()
}

/// Appends a Gaussian without rotation, of SH degree 0.
pub fn push(cloud: &mut GaussianCloud, mean: [f32; 3], log_scales: [f32; 3], opacity_logit: f32, color: [f32; 3]) {
    cloud.means.push(mean);
    cloud.quats.push([1.0, 0.0, 0.0, 0.0]);
    cloud.log_scales.push(log_scales);
    cloud.opacity_logits.push(opacity_logit);
    cloud.sh.push(color.map(dc));
}

/// Logit of an opacity in (0, 1).
pub fn logit(opacity: f64) -> f32 {
    (opacity / (1.0 - opacity)).ln() as f32
}

/// Identity pose, focal length `f` pixels, principal point in the middle.
pub fn camera(width: u32, height: u32, f: f32) -> Camera {
    let intrinsics = Pinhole { width, height, fx: f, fy: f, cx: 0.5 * width as f32, cy: 0.5 * height as f32 };
    Camera { intrinsics, camera_from_world: Mat4::IDENTITY }
}

/// Options with depth, so that tests see every channel.
pub fn options() -> RenderOptions {
    RenderOptions { depth: true, ..RenderOptions::default() }
}

/// A scene of this cloud under an identity camera.
pub fn scene(cloud: GaussianCloud, width: u32, height: u32) -> Scene {
    Scene { cloud, camera: camera(width, height, 60.0), options: options() }
}

/// Appends a disc that faces an identity [`camera`]: its image is isotropic with standard deviation `sigma_px`
/// (dilation included, so at least 0.55) around `center_px`.
pub fn push_disc(
    cloud: &mut GaussianCloud,
    camera: &Camera,
    center_px: [f32; 2],
    sigma_px: f32,
    depth: f32,
    opacity_logit: f32,
    color: [f32; 3],
) {
    let p = camera.intrinsics;
    let log_scale = ((sigma_px * sigma_px - 0.3).max(1e-6).sqrt() * depth / p.fx).ln();
    let mean = [(center_px[0] - p.cx) * depth / p.fx, (center_px[1] - p.cy) * depth / p.fy, depth];
    push(cloud, mean, [log_scale, log_scale, -20.0], opacity_logit, color);
}

/// How a random scene is drawn.
#[derive(Clone, Copy)]
pub struct Draw {
    /// Number of Gaussians.
    pub n: usize,
    /// Image size.
    pub size: [u32; 2],
    /// SH degree.
    pub sh_degree: u32,
    /// Range of opacities.
    pub opacity: [f32; 2],
    /// Range of log scales.
    pub log_scale: [f32; 2],
    /// Part of the Gaussians that lie behind, at the side or too near.
    pub stray: f64,
}

impl Default for Draw {
    fn default() -> Self {
        Self { n: 40, size: [50, 37], sh_degree: 1, opacity: [0.02, 0.98], log_scale: [-3.5, -0.7], stray: 0.15 }
    }
}

/// A random scene before a turned camera with an off-centre principal point.
pub fn random(seed: u64, draw: Draw) -> Scene {
    let mut rng = Rng::new(seed);
    let [width, height] = draw.size;
    let mut camera = camera(width, height, 0.9 * width as f32);
    camera.intrinsics.fy *= 0.95;
    camera.intrinsics.cx *= 0.93;
    camera.intrinsics.cy *= 1.08;
    let axis = Vec3::new(rng.normal(), rng.normal(), rng.normal()).normalize_or(Vec3::X);
    let translation = Vec3::new(rng.normal(), rng.normal(), rng.normal());
    camera.camera_from_world = Mat4::from_axis_angle(axis, rng.range(0.0, 3.0));
    camera.camera_from_world.w_axis = translation.extend(1.0);
    let world_from_camera = camera.camera_from_world.inverse();

    let mut cloud = GaussianCloud { sh_degree: draw.sh_degree, ..GaussianCloud::default() };
    for _ in 0..draw.n {
        let z = rng.range(1.0, 8.0);
        let mut in_camera = Vec3::new(rng.range(-0.55, 0.55) * z, rng.range(-0.45, 0.45) * z, z);
        if rng.unit() < draw.stray {
            in_camera *= [-1.0, 1e-3, 0.02][rng.below(3)];
            in_camera.x += rng.range(-4.0, 4.0);
        }
        cloud.means.push(world_from_camera.transform_point3(in_camera).to_array());
        cloud.quats.push(std::array::from_fn(|_| rng.normal()));
        cloud.log_scales.push(std::array::from_fn(|_| rng.range(draw.log_scale[0], draw.log_scale[1])));
        cloud.opacity_logits.push(logit(rng.range(draw.opacity[0], draw.opacity[1]).into()));
        for k in 0..cloud.num_coefficients() {
            let spread = if k == 0 { 1.0 } else { 0.3 };
            cloud.sh.push(std::array::from_fn(|_| spread * rng.normal()));
        }
    }
    let mut options = options();
    options.background = [0.2, 0.5, 0.9];
    Scene { cloud, camera, options }
}

/// Random weights for an image, for use as upstream gradients.
pub fn upstream(seed: u64, scene: &Scene) -> Vec<f32> {
    let mut rng = Rng::new(seed ^ 0x5eed);
    (0..scene.image_len()).map(|_| rng.normal()).collect()
}
