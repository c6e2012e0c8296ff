//! A procedural scene with exact ground truth: a furnished room, ray-cast analytically.
//!
//! It serves the demo, the quality tests (no photograph has to be shipped) and the benchmarks. World frame: metres, z up,
//! the floor at 0, the centre of the room above the origin. Everything is a function of the seed.

mod bench_cloud;
mod bvh;
mod export;
mod geometry;
mod light;
mod painting;
mod raycast;
mod room;
mod texture;

pub use bench_cloud::{bench_camera, bench_cloud};
pub use export::{SynthOptions, write_scene};

use crate::camera::distortion::LensDistortion;
use crate::camera::{Camera, Pinhole};
use crate::color::{linear_to_srgb, to_u8};
use crate::dataset::SparsePoints;
use crate::image::ImageF32;
use crate::rng::Rng;
use geometry::Geometry;
use glam::{Mat3, Mat4, Vec2, Vec3};
use light::{LightMap, RectLight, Surfaces};
use raycast::{Ray, SurfacePoint};
use rayon::prelude::*;
use texture::{Material, Place};

/// Factor from radiance to image values, so that a sunlit white wall is just below white.
const EXPOSURE: f32 = 1.9;
/// Radiance (after exposure) that becomes 1 in the image.
const WHITE: f32 = 4.0;
/// Exponent of the highlights.
const SHININESS: f32 = 60.0;
/// Centre of what the camera ring looks at.
const LOOK_AT: Vec3 = Vec3::new(0.0, 0.0, 0.72);
/// Standard deviation of the noise on sparse points, metres: that of a good reconstruction of a room.
const POINT_NOISE_M: f32 = 0.002;

/// A scene that can be photographed from anywhere inside.
pub struct SyntheticScene {
    geometry: Geometry,
    materials: Vec<Material>,
    lights: Vec<RectLight>,
    light_map: LightMap,
}

impl SyntheticScene {
    /// A living room of 6 × 5 × 2.8 m; `seed` chooses its colours and moves the small things. Baking the light takes about
    /// a second.
    pub fn room(seed: u64) -> Self {
        let room::Layout { geometry, materials, lights, sun } = room::layout(seed);
        let look = Look { geometry: &geometry, materials: &materials };
        let light_map = LightMap::bake(&geometry, &look, &lights, &sun);
        Self { geometry, materials, lights, light_map }
    }

    /// Photographs the scene, sRGB-encoded, values in 0..1. Every pixel is the mean of `samples_per_side`² samples at the
    /// centres of a regular grid; 3 or 4 are enough for a picture without jagged edges. The result does not depend on the
    /// number of threads.
    pub fn render(&self, camera: &Camera, samples_per_side: u32) -> ImageF32 {
        let Pinhole { width, height, .. } = camera.intrinsics;
        self.render_rays([width, height], samples_per_side, |at| Some(pixel_ray(camera, at)))
    }

    /// As [`render`](Self::render), through a lens that distorts, from a camera posed by `camera_from_world`: what a real
    /// camera would have taken. Black where no ray comes from.
    pub fn render_distorted(&self, camera_from_world: Mat4, lens: &LensDistortion, samples_per_side: u32) -> ImageF32 {
        let intrinsics = Pinhole { width: lens.width, height: lens.height, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
        // Rays of a camera whose pixels are normalised coordinates.
        let camera = Camera { intrinsics, camera_from_world };
        self.render_rays([lens.width, lens.height], samples_per_side, |at| {
            let distorted = [(f64::from(at.x) - lens.cx) / lens.fx, (f64::from(at.y) - lens.cy) / lens.fy];
            lens.undistort(distorted).map(|[u, v]| pixel_ray(&camera, Vec2::new(u as f32, v as f32)))
        })
    }

    /// The mean of the samples of every pixel; `ray_at` says which ray an image position sees.
    fn render_rays(
        &self,
        [width, height]: [u32; 2],
        samples_per_side: u32,
        ray_at: impl Fn(Vec2) -> Option<Ray> + Sync,
    ) -> ImageF32 {
        let per_side = samples_per_side.max(1);
        let mut data = vec![0.0; 3 * width as usize * height as usize];
        data.par_chunks_mut((3 * width as usize).max(1)).enumerate().for_each(|(y, row)| {
            for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
                let mut sum = Vec3::ZERO;
                for sample in 0..per_side * per_side {
                    let offset = Vec2::new((sample % per_side) as f32 + 0.5, (sample / per_side) as f32 + 0.5);
                    let at = Vec2::new(x as f32, y as f32) + offset / per_side as f32;
                    sum += ray_at(at).map_or(Vec3::ZERO, |ray| tone_mapped(self.radiance(ray)));
                }
                let mean = sum / (per_side * per_side) as f32;
                pixel.copy_from_slice(&mean.to_array().map(linear_to_srgb));
            }
        });
        ImageF32 { width, height, data }
    }

    /// `num_views` cameras on an ellipse inside the room at heights between 0.9 and 2.1 m, looking at the middle.
    pub fn camera_ring(&self, num_views: usize, intrinsics: Pinhole) -> Vec<Camera> {
        (0..num_views).map(|i| ring_camera(i, num_views, intrinsics)).collect()
    }

    /// `num_points` points on surfaces that the camera ring sees, with their colours and 2 mm of noise: what structure from
    /// motion would find. Point i depends on `seed` and i only.
    pub fn sparse_points(&self, num_points: usize, seed: u64) -> SparsePoints {
        const NUM_CAMERAS: usize = 24;
        let cameras = self.camera_ring(NUM_CAMERAS, Pinhole::from_fov_x(480, 320, 75f32.to_radians()));
        let point = |i: usize| -> ([f32; 3], [u8; 3]) {
            let mut rng = Rng::for_index(seed, i as u64);
            let camera = &cameras[i % NUM_CAMERAS];
            loop {
                let Pinhole { width, height, .. } = camera.intrinsics;
                let ray = pixel_ray(camera, Vec2::new(rng.range(0.0, width as f32), rng.range(0.0, height as f32)));
                let Some(surface) = self.geometry.trace(ray).map(|hit| self.geometry.surface(ray, hit)) else {
                    continue;
                };
                // Nothing can be triangulated on the sky.
                if self.look().material(&surface).0.is_emissive() {
                    continue;
                }
                let noise = POINT_NOISE_M * Vec3::new(rng.normal(), rng.normal(), rng.normal());
                let color = tone_mapped(self.outgoing(&surface, -ray.direction.normalize()));
                return ((surface.position + noise).to_array(), color.to_array().map(|c| to_u8(linear_to_srgb(c))));
            }
        };
        let (positions, colors) = (0..num_points).into_par_iter().map(point).unzip();
        SparsePoints { positions, colors }
    }

    fn look(&self) -> Look<'_> {
        Look { geometry: &self.geometry, materials: &self.materials }
    }

    fn radiance(&self, ray: Ray) -> Vec3 {
        match self.geometry.trace(ray) {
            Some(hit) if !hit.is_inside => self.outgoing(&self.geometry.surface(ray, hit), -ray.direction.normalize()),
            _ => Vec3::ZERO,
        }
    }

    /// Radiance from a surface point towards the unit vector `to_eye`, linear RGB.
    fn outgoing(&self, point: &SurfacePoint, to_eye: Vec3) -> Vec3 {
        let (material, place) = self.look().material(point);
        let color = material.color_at(&place);
        if material.is_emissive() {
            return color;
        }
        let diffuse = color * self.light_map.irradiance(point) / std::f32::consts::PI;
        if material.gloss == 0.0 {
            return diffuse;
        }
        // Blinn–Phong from the centre of every light, without shadows.
        let highlights = self.lights.iter().map(|light| {
            let to_light = (light.center - point.position).normalize();
            let cosine = (to_light + to_eye).normalize_or_zero().dot(point.normal).max(0.0);
            if to_light.dot(light.normal) < 0.0 { cosine.powf(SHININESS) * light.radiance } else { Vec3::ZERO }
        });
        diffuse + material.gloss * room::highlight_color() * highlights.sum::<Vec3>()
    }
}

/// Geometry with its materials, all that is needed to ask for colours before there is light.
struct Look<'a> {
    geometry: &'a Geometry,
    materials: &'a [Material],
}

impl<'a> Look<'a> {
    fn material(&self, point: &SurfacePoint) -> (&'a Material, Place) {
        let object = &self.geometry.objects[point.object];
        let size_m = object.shape.patch_size(point.face);
        let uv_m = point.uv * size_m;
        if point.object == 0 && point.face == room::WINDOW_FACE {
            let (low, high) = room::WINDOW;
            if uv_m.cmpge(low).all() && uv_m.cmple(high).all() {
                // The material after those of the six faces of the room.
                let window = &self.materials[usize::from(object.materials[5]) + 1];
                return (window, Place { uv_m: uv_m - low, size_m: high - low, local: point.local });
            }
        }
        let material = &self.materials[usize::from(object.materials[point.face])];
        (material, Place { uv_m, size_m, local: point.local })
    }
}

impl Surfaces for Look<'_> {
    fn albedo(&self, point: &SurfacePoint) -> Vec3 {
        let (material, place) = self.material(point);
        // The glow of lamps is counted as direct light; as surfaces they are white.
        if material.is_emissive() { Vec3::splat(0.7) } else { material.color_at(&place).min(Vec3::splat(0.95)) }
    }

    fn is_opening(&self, point: &SurfacePoint) -> bool {
        self.material(point).0.pattern == texture::Pattern::Window
    }
}

/// Ray through the image position `at` (pixels), unnormalised with unit depth.
fn pixel_ray(camera: &Camera, at: Vec2) -> Ray {
    let Pinhole { fx, fy, cx, cy, .. } = camera.intrinsics;
    let world_from_camera = Mat3::from_mat4(camera.camera_from_world).transpose();
    let direction = world_from_camera * Vec3::new((at.x - cx) / fx, (at.y - cy) / fy, 1.0);
    Ray { origin: camera.position(), direction }
}

/// Reinhard's curve with a white point (Reinhard et al. 2002, Eq. 4); keeps windows from being flat white.
fn tone_mapped(radiance: Vec3) -> Vec3 {
    let x = EXPOSURE * radiance;
    (x * (1.0 + x / (WHITE * WHITE)) / (1.0 + x)).clamp(Vec3::ZERO, Vec3::ONE)
}

fn ring_camera(index: usize, num_views: usize, intrinsics: Pinhole) -> Camera {
    let turn = index as f32 / num_views as f32;
    let (sin, cos) = (std::f32::consts::TAU * turn).sin_cos();
    // Multiples of the golden ratio spread the heights evenly for any number of views.
    let low_high = (0.618_034 * index as f32 + 0.3).fract();
    let eye = Vec3::new(2.1 * cos, 1.65 * sin, 0.9 + 1.2 * low_high);
    let target = LOOK_AT + 0.25 * Vec3::new(-sin, cos, 0.6 * (low_high - 0.5));
    Camera::look_at(intrinsics, eye, target, Vec3::Z)
}
