//! The objects of a scene together: nearest hits, shadows, and points on surfaces.

use super::bvh::Bvh;
use super::raycast::{Hit, Object, Ray, SurfacePoint};
use glam::{Vec2, Vec3};

/// All objects of a scene; object 0 is the room.
pub(super) struct Geometry {
    pub objects: Vec<Object>,
    bvh: Bvh,
}

impl Geometry {
    /// `objects[0]` must be the room.
    pub fn new(objects: Vec<Object>) -> Self {
        let bvh = Bvh::new(objects[1..].iter().map(Object::bounds).collect());
        Self { objects, bvh }
    }

    /// Nearest intersection; `None` only for rays that start outside the room and pass it by.
    pub fn trace(&self, ray: Ray) -> Option<Hit> {
        let hit_of = |object: usize| {
            let (t, face, is_inside) = self.objects[object].intersect(ray)?;
            Some(Hit { t, object, face, is_inside })
        };
        let mut nearest = hit_of(0);
        self.bvh.visit(ray, nearest.map_or(f32::INFINITY, |hit| hit.t), |item| {
            if let Some(hit) = hit_of(item + 1)
                && nearest.is_none_or(|found| hit.t < found.t)
            {
                nearest = Some(hit);
            }
            nearest.map_or(f32::INFINITY, |hit| hit.t)
        });
        nearest
    }

    /// Where a ray that starts in the room would meet its walls if nothing stood in the way.
    pub fn trace_walls(&self, ray: Ray) -> Option<SurfacePoint> {
        let (t, face, is_inside) = self.objects[0].intersect(ray)?;
        Some(self.surface(ray, Hit { t, object: 0, face, is_inside }))
    }

    /// True when an object (not the room) lies between `from` and `to`.
    pub fn is_occluded(&self, from: Vec3, to: Vec3) -> bool {
        let ray = Ray { origin: from, direction: to - from };
        let mut is_hit = false;
        self.bvh.visit(ray, 1.0, |item| {
            is_hit = is_hit || self.objects[item + 1].intersect(ray).is_some_and(|(t, ..)| t < 1.0);
            if is_hit { f32::NEG_INFINITY } else { 1.0 }
        });
        is_hit
    }

    /// True when `point` is in a solid.
    pub fn is_inside_solid(&self, point: Vec3) -> bool {
        self.objects[1..].iter().any(|object| object.contains(point))
    }

    /// The surface point of a hit of `ray`.
    pub fn surface(&self, ray: Ray, hit: Hit) -> SurfacePoint {
        let object = &self.objects[hit.object];
        let position = ray.origin + hit.t * ray.direction;
        let local = object.to_local(position - object.center);
        let uv = object.shape.uv(hit.face, local).clamp(Vec2::ZERO, Vec2::ONE);
        let normal = object.to_world(object.shape.normal(hit.face, local));
        SurfacePoint { object: hit.object, face: hit.face, uv, position, local, normal }
    }

    /// The surface point at `uv` of the patch of a face.
    pub fn patch_point(&self, object: usize, face: usize, uv: Vec2) -> SurfacePoint {
        let placed = &self.objects[object];
        let (local, normal) = placed.shape.patch_point(face, uv);
        let position = placed.center + placed.to_world(local);
        SurfacePoint { object, face, uv, position, local, normal: placed.to_world(normal) }
    }
}

#[cfg(test)]
mod tests {
    use super::super::raycast::Shape;
    use super::*;
    use crate::rng::Rng;

    fn solids() -> Vec<Object> {
        let shapes = [
            Shape::Room { half: Vec3::splat(5.0) },
            Shape::Cuboid { half: Vec3::new(0.3, 0.5, 0.2) },
            Shape::Sphere { radius: 0.4 },
            Shape::Frustum { bottom: 0.5, top: 0.2, half_height: 0.6 },
        ];
        let place = |(i, shape): (usize, Shape)| Object {
            shape,
            center: if i == 0 { Vec3::ZERO } else { Vec3::new(i as f32 - 2.0, 0.3, -0.2) },
            yaw: if i == 0 { Vec2::X } else { Vec2::from_angle(0.4) },
            materials: [0; 6],
        };
        shapes.into_iter().enumerate().map(place).collect()
    }

    #[test]
    fn ray_at_a_patch_point_hits_it() {
        let geometry = Geometry::new(solids());
        let mut rng = Rng::new(1);
        for object in 0..geometry.objects.len() {
            let shape = geometry.objects[object].shape;
            for face in 0..shape.num_faces() {
                for _ in 0..50 {
                    let uv = Vec2::new(rng.range(0.02, 0.98), rng.range(0.02, 0.98));
                    if !shape.is_on_patch(face, uv) || (face > 0 && (uv - 0.5).length() > 0.48) {
                        continue;
                    }
                    let target = geometry.patch_point(object, face, uv);
                    let ray = Ray { origin: target.position + 0.05 * target.normal, direction: -target.normal };
                    let hit = geometry.trace(ray).expect("inside the room");
                    let found = geometry.surface(ray, hit);
                    assert_eq!((found.object, found.face, hit.is_inside), (object, face, false));
                    assert!((found.uv - uv).length() < 1e-3, "{:?} {:?}", found.uv, uv);
                    assert!((found.normal - target.normal).length() < 1e-3);
                }
            }
        }
    }

    #[test]
    fn hierarchy_finds_what_trying_every_object_finds() {
        let geometry = Geometry::new(solids());
        let mut rng = Rng::new(2);
        for _ in 0..2000 {
            let mut point = || Vec3::new(rng.range(-2.0, 2.0), rng.range(-2.0, 2.0), rng.range(-2.0, 2.0));
            let (origin, direction) = (point(), point());
            let ray = Ray { origin, direction };
            let all = geometry.objects.iter().filter_map(|o| o.intersect(ray)).map(|(t, ..)| t);
            let expected = all.fold(f32::INFINITY, f32::min);
            assert_eq!(geometry.trace(ray).map(|hit| hit.t), Some(expected));
            let solid = geometry.objects[1..].iter().filter_map(|o| o.intersect(ray)).any(|(t, ..)| t < 1.0);
            assert_eq!(geometry.is_occluded(origin, origin + direction), solid);
        }
    }
}
