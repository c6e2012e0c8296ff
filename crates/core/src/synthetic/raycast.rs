//! Rays, shapes, exact intersections, and the parametrisation ("patches") of every surface by (u, v) in the unit square.
//!
//! World frame of the synthetic scenes: metres, z up. A local frame is the world frame moved to the centre of the object
//! and turned about z.

use glam::{Vec2, Vec3, Vec3A};
use std::f32::consts::{PI, TAU};

/// Distances below this are the surface that a ray starts on, metres.
pub(super) const EPSILON: f32 = 1e-4;

/// Half-line from `origin` along `direction` (any length: `t` counts in multiples of it).
#[derive(Debug, Clone, Copy)]
pub(super) struct Ray {
    pub origin: Vec3,
    pub direction: Vec3,
}

/// A solid, or the inside of a room.
#[derive(Debug, Clone, Copy)]
pub(super) enum Shape {
    /// Axis-aligned in its local frame; faces −x +x −y +y −z +z.
    Cuboid { half: Vec3 },
    /// The same, seen from inside; every ray that starts inside hits it.
    Room { half: Vec3 },
    /// One face.
    Sphere { radius: f32 },
    /// Upright cone frustum (a cylinder when the radii are equal); faces side, bottom, top.
    Frustum { bottom: f32, top: f32, half_height: f32 },
}

/// A shape in its place, with a material for each face.
#[derive(Debug, Clone)]
pub(super) struct Object {
    pub shape: Shape,
    pub center: Vec3,
    /// Cosine and sine of the turn about z.
    pub yaw: Vec2,
    /// Index of the material of each face; a shape with fewer faces uses the first ones.
    pub materials: [u16; 6],
}

/// Where a ray meets an object.
#[derive(Debug, Clone, Copy)]
pub(super) struct Hit {
    pub t: f32,
    pub object: usize,
    pub face: usize,
    /// True when the ray started inside a solid.
    pub is_inside: bool,
}

/// A point on a face.
#[derive(Debug, Clone, Copy)]
pub(super) struct SurfacePoint {
    pub object: usize,
    pub face: usize,
    /// Position on the patch of the face, `[0, 1]²`.
    pub uv: Vec2,
    /// World position, metres.
    pub position: Vec3,
    /// Position in the local frame of the object, metres.
    pub local: Vec3,
    /// Unit normal in the world frame, out of the solid (into the room).
    pub normal: Vec3,
}

impl Shape {
    pub fn num_faces(&self) -> usize {
        match self {
            Self::Cuboid { .. } | Self::Room { .. } => 6,
            Self::Sphere { .. } => 1,
            Self::Frustum { .. } => 3,
        }
    }

    /// Half extents of the local bounding box.
    fn half_extent(&self) -> Vec3 {
        match *self {
            Self::Cuboid { half } | Self::Room { half } => half,
            Self::Sphere { radius } => Vec3::splat(radius),
            Self::Frustum { bottom, top, half_height } => {
                let radius = bottom.max(top);
                Vec3::new(radius, radius, half_height)
            }
        }
    }

    fn contains(&self, p: Vec3) -> bool {
        match *self {
            Self::Cuboid { half } => p.abs().cmplt(half).all(),
            Self::Room { .. } => false,
            Self::Sphere { radius } => p.length_squared() < radius * radius,
            Self::Frustum { bottom, top, half_height } => {
                let radius = 0.5 * (bottom + top) + 0.5 * (top - bottom) / half_height * p.z;
                p.z.abs() < half_height && p.truncate().length_squared() < radius * radius
            }
        }
    }

    /// First `(t, face, started inside)` with `EPSILON < t`, in the local frame.
    fn intersect(&self, o: Vec3, d: Vec3) -> Option<(f32, usize, bool)> {
        match *self {
            Self::Cuboid { half } => intersect_cuboid(half, o, d),
            Self::Room { half } => intersect_cuboid(half, o, d).map(|(t, face, _)| (t, face, false)),
            Self::Sphere { radius } => {
                let (a, b, c) = (d.dot(d), o.dot(d), o.dot(o) - radius * radius);
                let root = (b * b - a * c).max(0.0).sqrt();
                if b * b < a * c {
                    return None;
                }
                let (near, far) = ((-b - root) / a, (-b + root) / a);
                let scaled_epsilon = EPSILON / a.sqrt();
                if near > scaled_epsilon {
                    Some((near, 0, false))
                } else {
                    (far > scaled_epsilon).then_some((far, 0, true))
                }
            }
            Self::Frustum { bottom, top, half_height } => intersect_frustum(bottom, top, half_height, o, d),
        }
    }

    /// Size in metres of the patch of `face`. Width · height is the area of the face, except for the caps of frusta, whose
    /// patch is the square around the disc.
    pub fn patch_size(&self, face: usize) -> Vec2 {
        match *self {
            Self::Cuboid { half } | Self::Room { half } => 2.0 * tangential(half, face),
            // Lambert's cylindrical equal-area map.
            Self::Sphere { radius } => Vec2::new(TAU * radius, 2.0 * radius),
            Self::Frustum { bottom, top, half_height } => match face {
                0 => Vec2::new(PI * (bottom + top), (top - bottom).hypot(2.0 * half_height)),
                _ => Vec2::splat(2.0 * if face == 1 { bottom } else { top }),
            },
        }
    }

    /// True when the patch of `face` closes on itself along u.
    pub fn wraps(&self, face: usize) -> bool {
        matches!((self, face), (Self::Sphere { .. } | Self::Frustum { .. }, 0))
    }

    /// True when `uv` is a point of the surface (the corners of cap patches are not).
    pub fn is_on_patch(&self, face: usize, uv: Vec2) -> bool {
        !matches!(self, Self::Frustum { .. }) || face == 0 || (2.0 * uv - 1.0).length_squared() <= 1.0
    }

    /// Local position and normal at `uv` of the patch of `face`.
    pub fn patch_point(&self, face: usize, uv: Vec2) -> (Vec3, Vec3) {
        match *self {
            Self::Cuboid { half } | Self::Room { half } => {
                let t = (2.0 * uv - 1.0) * tangential(half, face);
                let axis = face / 2;
                let side = if face % 2 == 1 { half[axis] } else { -half[axis] };
                let p = match axis {
                    0 => Vec3::new(side, t.x, t.y),
                    1 => Vec3::new(t.x, side, t.y),
                    _ => Vec3::new(t.x, t.y, side),
                };
                (p, self.normal(face, p))
            }
            Self::Sphere { radius } => {
                let z = 2.0 * uv.y - 1.0;
                let (sin, cos) = (TAU * uv.x - PI).sin_cos();
                let ring = (1.0 - z * z).max(0.0).sqrt();
                let n = Vec3::new(ring * cos, ring * sin, z);
                (radius * n, n)
            }
            Self::Frustum { bottom, top, half_height } => {
                if face == 0 {
                    let (sin, cos) = (TAU * uv.x - PI).sin_cos();
                    let radius = bottom + (top - bottom) * uv.y;
                    let p = Vec3::new(radius * cos, radius * sin, half_height * (2.0 * uv.y - 1.0));
                    return (p, self.normal(face, p));
                }
                let (radius, z) = if face == 1 { (bottom, -half_height) } else { (top, half_height) };
                let disc = (2.0 * uv - 1.0).clamp_length_max(0.999) * radius;
                (disc.extend(z), self.normal(face, disc.extend(z)))
            }
        }
    }

    /// Inverse of [`Shape::patch_point`] for a local point on `face`.
    pub fn uv(&self, face: usize, p: Vec3) -> Vec2 {
        let turn = |p: Vec3| p.y.atan2(p.x) / TAU + 0.5;
        match *self {
            Self::Cuboid { half } | Self::Room { half } => 0.5 + 0.5 * tangential(p, face) / tangential(half, face),
            Self::Sphere { radius } => Vec2::new(turn(p), 0.5 + 0.5 * p.z / radius),
            Self::Frustum { bottom, top, half_height } => match face {
                0 => Vec2::new(turn(p), 0.5 + 0.5 * p.z / half_height),
                _ => 0.5 + 0.5 * p.truncate() / if face == 1 { bottom } else { top },
            },
        }
    }

    pub fn normal(&self, face: usize, p: Vec3) -> Vec3 {
        let mut n = Vec3::ZERO;
        match *self {
            Self::Cuboid { .. } => n[face / 2] = if face % 2 == 1 { 1.0 } else { -1.0 },
            Self::Room { .. } => n[face / 2] = if face % 2 == 1 { -1.0 } else { 1.0 },
            Self::Sphere { radius } => n = p / radius,
            Self::Frustum { bottom, top, half_height } => match face {
                0 => {
                    let slope = 0.5 * (top - bottom) / half_height;
                    n = (p.truncate().normalize_or(Vec2::X)).extend(-slope).normalize();
                }
                _ => n.z = if face == 1 { -1.0 } else { 1.0 },
            },
        }
        n
    }
}

/// The two coordinates along a face of a cuboid: horizontal first.
fn tangential(p: Vec3, face: usize) -> Vec2 {
    match face / 2 {
        0 => Vec2::new(p.y, p.z),
        1 => Vec2::new(p.x, p.z),
        _ => Vec2::new(p.x, p.y),
    }
}

fn intersect_cuboid(half: Vec3, o: Vec3, d: Vec3) -> Option<(f32, usize, bool)> {
    // Division by a zero component gives infinities of the right sign; 0/0 is lost in min and max.
    let inverse = Vec3A::from(d).recip();
    let (a, b) = ((Vec3A::from(-half - o)) * inverse, Vec3A::from(half - o) * inverse);
    let (low, high) = (a.min(b), a.max(b));
    let (near, far) = (low.max_element(), high.min_element());
    if near > far || far <= 0.0 {
        return None;
    }
    let epsilon = EPSILON * inverse.abs().min_element();
    if far <= epsilon {
        return None;
    }
    let is_inside = near <= epsilon;
    let (t, axis) = if is_inside { (far, high.min_position()) } else { (near, low.max_position()) };
    let goes_up = d[axis] > 0.0;
    // Out of the box through the side it goes to, into it through the side it comes from.
    Some((t, 2 * axis + usize::from(goes_up == is_inside), is_inside))
}

fn intersect_frustum(bottom: f32, top: f32, h: f32, o: Vec3, d: Vec3) -> Option<(f32, usize, bool)> {
    let slope = 0.5 * (top - bottom) / h;
    let radius_at = |z: f32| 0.5 * (bottom + top) + slope * z;
    let epsilon = EPSILON / d.length();
    let mut best: Option<(f32, usize)> = None;
    let mut offer = |t: f32, face: usize| {
        if t > epsilon && best.is_none_or(|(found, _)| t < found) {
            best = Some((t, face));
        }
    };
    let radius = radius_at(o.z);
    let a = d.x * d.x + d.y * d.y - slope * slope * d.z * d.z;
    let b = o.x * d.x + o.y * d.y - slope * d.z * radius;
    let c = o.x * o.x + o.y * o.y - radius * radius;
    let discriminant = b * b - a * c;
    if discriminant >= 0.0 && a.abs() > 1e-9 {
        for root in [-discriminant.sqrt(), discriminant.sqrt()] {
            let t = (-b + root) / a;
            let z = o.z + t * d.z;
            if z.abs() <= h && radius_at(z) > 0.0 {
                offer(t, 0);
            }
        }
    }
    for (z, radius, face) in [(-h, bottom, 1), (h, top, 2)] {
        let t = (z - o.z) / d.z;
        let p = (o + t * d).truncate();
        if p.length_squared() <= radius * radius {
            offer(t, face);
        }
    }
    let is_inside = c < 0.0 && o.z.abs() < h;
    best.map(|(t, face)| (t, face, is_inside))
}

impl Object {
    pub fn to_local(&self, v: Vec3) -> Vec3 {
        Vec3::new(self.yaw.x * v.x + self.yaw.y * v.y, self.yaw.x * v.y - self.yaw.y * v.x, v.z)
    }

    pub fn to_world(&self, v: Vec3) -> Vec3 {
        Vec3::new(self.yaw.x * v.x - self.yaw.y * v.y, self.yaw.y * v.x + self.yaw.x * v.y, v.z)
    }

    /// Corners of the bounding box in the world frame.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        let half = self.shape.half_extent();
        let turned = match self.shape {
            Shape::Cuboid { .. } | Shape::Room { .. } => {
                let (c, s) = (self.yaw.x.abs(), self.yaw.y.abs());
                Vec3::new(c * half.x + s * half.y, s * half.x + c * half.y, half.z)
            }
            _ => half,
        };
        (self.center - turned, self.center + turned)
    }

    /// `(t, face, started inside)` of the first intersection.
    pub fn intersect(&self, ray: Ray) -> Option<(f32, usize, bool)> {
        self.shape.intersect(self.to_local(ray.origin - self.center), self.to_local(ray.direction))
    }

    pub fn contains(&self, point: Vec3) -> bool {
        self.shape.contains(self.to_local(point - self.center))
    }
}
