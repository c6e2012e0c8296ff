//! Light baked into maps on every patch: direct light of windows, lamps and the sun with soft shadows, then two bounces
//! between diffuse surfaces (radiosity by gathering). Rendering then costs no shadow rays, and a surface point looks
//! the same from every view, as Gaussians assume.
//!
//! Source of the estimators: Pharr, Jakob, Humphreys, *Physically Based Rendering*, 4th ed., §12.4 (area lights) and §A.5
//! (cosine-weighted hemisphere). Deterministic: sample positions depend on the texel only.

use super::geometry::Geometry;
use super::raycast::{Ray, SurfacePoint};
use crate::rng::Rng;
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use std::f32::consts::{PI, TAU};

/// Edge of a texel of the direct map, metres: resolves the contact shadows that a 480-pixel view of a room shows.
const DIRECT_TEXEL_M: f32 = 0.05;
/// Edge of a texel of the indirect map, metres, on large patches.
const INDIRECT_TEXEL_M: f32 = 0.12;
/// Small objects have at least this many indirect texels along a side, so that contact darkening shows.
const MIN_INDIRECT_TEXELS: f32 = 4.0;
/// Gather rays of a texel, squared stratification: about 3 % noise, below the texture of any surface.
const GATHER_SIDE: usize = 10;
const NUM_BOUNCES: usize = 2;
/// Directions towards the disc of the sun (enlarged, for soft edges).
const NUM_SUN_SAMPLES: usize = 12;
/// Start of shadow and gather rays above the surface, metres.
const OFFSET_M: f32 = 1e-3;

/// A one-sided rectangle that emits light.
pub(super) struct RectLight {
    pub center: Vec3,
    pub half_u: Vec3,
    pub half_v: Vec3,
    /// Unit normal of the emitting side.
    pub normal: Vec3,
    /// Radiance, linear RGB.
    pub radiance: Vec3,
    /// Stratified samples along u and v.
    pub grid: (usize, usize),
}

/// Parallel light that enters through the window.
pub(super) struct Sun {
    /// Unit vector towards the sun.
    pub direction: Vec3,
    /// Irradiance on a surface that faces the sun, linear RGB.
    pub irradiance: Vec3,
}

/// What the baker asks of a scene besides its geometry.
pub(super) trait Surfaces: Sync {
    /// Diffuse albedo, linear RGB.
    fn albedo(&self, point: &SurfacePoint) -> Vec3;
    /// True where the wall is open to the sky.
    fn is_opening(&self, point: &SurfacePoint) -> bool;
}

#[derive(Clone, Copy)]
struct Grid {
    offset: usize,
    num_u: usize,
    num_v: usize,
    wraps: bool,
}

impl Grid {
    fn new(offset: usize, size: Vec2, texel: f32, wraps: bool) -> Self {
        let count = |length: f32| ((length / texel).ceil() as usize).max(1);
        Self { offset, num_u: count(size.x), num_v: count(size.y), wraps }
    }

    fn len(&self) -> usize {
        self.num_u * self.num_v
    }

    fn texel_center(&self, i: usize) -> Vec2 {
        let (x, y) = (i % self.num_u, i / self.num_u);
        Vec2::new((x as f32 + 0.5) / self.num_u as f32, (y as f32 + 0.5) / self.num_v as f32)
    }

    /// Bilinear interpolation between texel centres, constant beyond the outermost ones.
    fn sample(&self, values: &[Vec3], uv: Vec2) -> Vec3 {
        let x = uv.x * self.num_u as f32 - 0.5;
        let y = (uv.y * self.num_v as f32 - 0.5).clamp(0.0, (self.num_v - 1) as f32);
        let x = if self.wraps { x } else { x.clamp(0.0, (self.num_u - 1) as f32) };
        let (x0, y0) = (x.floor(), y.floor());
        let column = |i: i64| match self.wraps {
            true => i.rem_euclid(self.num_u as i64) as usize,
            false => (i as usize).min(self.num_u - 1),
        };
        let (left, right) = (column(x0 as i64), column(x0 as i64 + 1));
        let (bottom, top) = (y0 as usize, (y0 as usize + 1).min(self.num_v - 1));
        let at = |column: usize, row: usize| values[self.offset + row * self.num_u + column];
        let low = at(left, bottom).lerp(at(right, bottom), x - x0);
        let high = at(left, top).lerp(at(right, top), x - x0);
        low.lerp(high, y - y0)
    }
}

/// Irradiance on all patches, linear RGB.
pub(super) struct LightMap {
    /// First patch of each object; its faces follow each other.
    first_patch: Vec<usize>,
    direct_grids: Vec<Grid>,
    indirect_grids: Vec<Grid>,
    direct: Vec<Vec3>,
    indirect: Vec<Vec3>,
}

impl LightMap {
    /// Bakes the light of `lights` and `sun`.
    pub fn bake(geometry: &Geometry, surfaces: &impl Surfaces, lights: &[RectLight], sun: &Sun) -> Self {
        let mut map = Self {
            first_patch: Vec::new(),
            direct_grids: Vec::new(),
            indirect_grids: Vec::new(),
            direct: Vec::new(),
            indirect: Vec::new(),
        };
        let mut patches = Vec::new();
        let (mut num_direct, mut num_indirect) = (0, 0);
        for (object, placed) in geometry.objects.iter().enumerate() {
            map.first_patch.push(patches.len());
            for face in 0..placed.shape.num_faces() {
                let (size, wraps) = (placed.shape.patch_size(face), placed.shape.wraps(face));
                let coarse = INDIRECT_TEXEL_M.min(size.max_element() / MIN_INDIRECT_TEXELS);
                map.direct_grids.push(Grid::new(num_direct, size, DIRECT_TEXEL_M, wraps));
                map.indirect_grids.push(Grid::new(num_indirect, size, coarse, wraps));
                num_direct += map.direct_grids[patches.len()].len();
                num_indirect += map.indirect_grids[patches.len()].len();
                patches.push((object, face));
            }
        }
        map.direct = filled(geometry, &patches, &map.direct_grids, |point, _| {
            direct_light(geometry, surfaces, lights, sun, point)
        });
        map.indirect = vec![Vec3::ZERO; num_indirect];
        for bounce in 0..NUM_BOUNCES {
            map.indirect = filled(geometry, &patches, &map.indirect_grids, |point, texel| {
                let mut rng = Rng::for_index(bounce as u64, texel as u64);
                map.gathered(geometry, surfaces, point, &mut rng)
            });
        }
        map
    }

    /// Irradiance at a surface point.
    pub fn irradiance(&self, point: &SurfacePoint) -> Vec3 {
        let patch = self.first_patch[point.object] + point.face;
        self.direct_grids[patch].sample(&self.direct, point.uv)
            + self.indirect_grids[patch].sample(&self.indirect, point.uv)
    }

    /// Irradiance from all surfaces seen from `point`: π · mean radiance of cosine-distributed directions.
    fn gathered(&self, geometry: &Geometry, surfaces: &impl Surfaces, point: &SurfacePoint, rng: &mut Rng) -> Vec3 {
        let (tangent, bitangent) = point.normal.any_orthonormal_pair();
        let origin = point.position + OFFSET_M * point.normal;
        let mut sum = Vec3::ZERO;
        for stratum in 0..GATHER_SIDE * GATHER_SIDE {
            let u = ((stratum % GATHER_SIDE) as f32 + rng.uniform()) / GATHER_SIDE as f32;
            let v = ((stratum / GATHER_SIDE) as f32 + rng.uniform()) / GATHER_SIDE as f32;
            let (sin, cos) = (TAU * u).sin_cos();
            let radius = v.sqrt();
            let up = (1.0 - v).sqrt();
            let ray = Ray { origin, direction: radius * (cos * tangent + sin * bitangent) + up * point.normal };
            if let Some(hit) = geometry.trace(ray)
                && !hit.is_inside
            {
                let seen = geometry.surface(ray, hit);
                // Openings are lights of their own, counted as direct light.
                if !surfaces.is_opening(&seen) {
                    sum += surfaces.albedo(&seen) * self.irradiance(&seen);
                }
            }
        }
        // Radiance is albedo · irradiance / π: the two π cancel.
        sum / (GATHER_SIDE * GATHER_SIDE) as f32
    }
}

/// Values of all texels; texels inside solids take the mean of their neighbours, or light would seep in as darkness.
fn filled(
    geometry: &Geometry,
    patches: &[(usize, usize)],
    grids: &[Grid],
    value: impl Fn(&SurfacePoint, usize) -> Vec3 + Sync,
) -> Vec<Vec3> {
    let maps: Vec<Vec<Vec3>> = patches
        .par_iter()
        .zip(grids)
        .map(|(&(object, face), grid)| {
            let mut texels: Vec<Option<Vec3>> = (0..grid.len())
                .into_par_iter()
                .map(|i| {
                    let point = geometry.patch_point(object, face, grid.texel_center(i));
                    let is_covered = geometry.is_inside_solid(point.position + OFFSET_M * point.normal);
                    (!is_covered).then(|| value(&point, grid.offset + i))
                })
                .collect();
            grow_into_covered(&mut texels, grid);
            texels.into_iter().map(|texel| texel.unwrap_or(Vec3::ZERO)).collect()
        })
        .collect();
    maps.concat()
}

fn grow_into_covered(texels: &mut [Option<Vec3>], grid: &Grid) {
    // Bilinear interpolation looks one texel far.
    let known = texels.to_vec();
    for (i, texel) in texels.iter_mut().enumerate().filter(|(_, texel)| texel.is_none()) {
        let (x, y) = ((i % grid.num_u) as i64, (i / grid.num_u) as i64);
        let around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (x + dx, y + dy)));
        let inside =
            around.filter(|&(x, y)| (0..grid.num_u as i64).contains(&x) && (0..grid.num_v as i64).contains(&y));
        let (sum, count) = inside
            .filter_map(|(x, y)| known[y as usize * grid.num_u + x as usize])
            .fold((Vec3::ZERO, 0), |(sum, count), value| (sum + value, count + 1));
        if count > 0 {
            *texel = Some(sum / count as f32);
        }
    }
}

fn direct_light(
    geometry: &Geometry,
    surfaces: &impl Surfaces,
    lights: &[RectLight],
    sun: &Sun,
    point: &SurfacePoint,
) -> Vec3 {
    let origin = point.position + OFFSET_M * point.normal;
    let mut sum = sunlight(geometry, surfaces, sun, point, origin);
    for light in lights {
        let (num_u, num_v) = light.grid;
        // Area over number of samples: |∂p/∂u × ∂p/∂v| of the rectangle is 4 |half_u × half_v|.
        let weight = 4.0 * light.half_u.cross(light.half_v).length() / (num_u * num_v) as f32;
        for sample in 0..num_u * num_v {
            let u = 2.0 * ((sample % num_u) as f32 + 0.5) / num_u as f32 - 1.0;
            let v = 2.0 * ((sample / num_u) as f32 + 0.5) / num_v as f32 - 1.0;
            let from = light.center + u * light.half_u + v * light.half_v;
            let to_light = from - origin;
            let distance2 = to_light.length_squared();
            let cosines = to_light.dot(point.normal).max(0.0) * (-to_light.dot(light.normal)).max(0.0);
            if cosines > 0.0 && !geometry.is_occluded(origin, from) {
                sum += light.radiance * (weight * cosines / (distance2 * distance2));
            }
        }
    }
    sum
}

fn sunlight(geometry: &Geometry, surfaces: &impl Surfaces, sun: &Sun, point: &SurfacePoint, origin: Vec3) -> Vec3 {
    // Sine of the half angle: four times the real sun, so that the edge of the light is wider than a texel.
    const SPREAD: f32 = 0.018;
    let cosine = point.normal.dot(sun.direction);
    if cosine <= 0.0 {
        return Vec3::ZERO;
    }
    let (tangent, bitangent) = sun.direction.any_orthonormal_pair();
    let reaches = |sample: usize| {
        // Vogel's spiral: even over the disc for any number of samples.
        let radius = SPREAD * ((sample as f32 + 0.5) / NUM_SUN_SAMPLES as f32).sqrt();
        let (sin, cos) = (sample as f32 * PI * (3.0 - 5f32.sqrt())).sin_cos();
        let ray = Ray { origin, direction: sun.direction + radius * (cos * tangent + sin * bitangent) };
        geometry
            .trace_walls(ray)
            .is_some_and(|wall| surfaces.is_opening(&wall) && !geometry.is_occluded(origin, wall.position))
    };
    let share = (0..NUM_SUN_SAMPLES).filter(|&sample| reaches(sample)).count() as f32 / NUM_SUN_SAMPLES as f32;
    sun.irradiance * (cosine * share)
}
