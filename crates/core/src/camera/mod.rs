//! Cameras: the pinhole everything is rendered with. Lens distortion is removed on load ([`distortion`]).

use glam::{Mat3, Mat4, Vec3};
use serde::{Deserialize, Serialize};

pub mod distortion;
pub mod path;
pub mod se3;

/// Pinhole intrinsics in pixels of an image of `width` × `height`.
///
/// A camera-space point (x, y, z), z > 0, lands on (fx·x/z + cx, fy·y/z + cy); pixel (0, 0) has its centre at (0.5, 0.5).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Pinhole {
    /// Image width in pixels, at least 1.
    pub width: u32,
    /// Image height in pixels, at least 1.
    pub height: u32,
    /// Focal length along x, pixels.
    pub fx: f32,
    /// Focal length along y, pixels.
    pub fy: f32,
    /// Principal point x, pixels.
    pub cx: f32,
    /// Principal point y, pixels.
    pub cy: f32,
}

impl Pinhole {
    /// Centred principal point and square pixels from a horizontal field of view in radians.
    pub fn from_fov_x(width: u32, height: u32, fov_x_rad: f32) -> Self {
        let f = 0.5 * width as f32 / (0.5 * fov_x_rad).tan();
        Self { width, height, fx: f, fy: f, cx: 0.5 * width as f32, cy: 0.5 * height as f32 }
    }

    /// The same view sampled at another image size: every length scales with its axis.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let (sx, sy) = (width as f32 / self.width as f32, height as f32 / self.height as f32);
        Self { width, height, fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy }
    }

    /// Size with the longer side at most `max_side` pixels, the aspect ratio kept; 0 means no limit.
    pub fn fitted(&self, max_side: u32) -> Self {
        let side = self.width.max(self.height);
        if max_side == 0 || side <= max_side {
            return *self;
        }
        let scale = f64::from(max_side) / f64::from(side);
        let fit = |n: u32| ((f64::from(n) * scale).round() as u32).max(1);
        self.resized(fit(self.width), fit(self.height))
    }

    /// Horizontal field of view in radians, of a centred principal point.
    pub fn fov_x_rad(&self) -> f32 {
        2.0 * (0.5 * self.width as f32 / self.fx).atan()
    }
}

/// A posed pinhole camera.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Intrinsics.
    pub intrinsics: Pinhole,
    /// Rigid transform from world to camera (OpenCV axes: +x right, +y down, +z forward).
    pub camera_from_world: Mat4,
}

impl Camera {
    /// Camera at `eye` that looks at `target`, with world direction `up` pointing up in the image.
    pub fn look_at(intrinsics: Pinhole, eye: Vec3, target: Vec3, up: Vec3) -> Self {
        let forward = (target - eye).normalize();
        let right = forward.cross(up).normalize();
        let down = forward.cross(right);
        let world_from_camera = Mat3::from_cols(right, down, forward);
        let r = world_from_camera.transpose();
        let mut m = Mat4::from_mat3(r);
        m.w_axis = (-(r * eye)).extend(1.0);
        Self { intrinsics, camera_from_world: m }
    }

    /// Camera centre in world coordinates.
    pub fn position(&self) -> Vec3 {
        let r = Mat3::from_mat4(self.camera_from_world);
        -(r.transpose() * self.camera_from_world.w_axis.truncate())
    }

    /// Viewing direction (+z of the camera) in world coordinates, unit length.
    pub fn forward(&self) -> Vec3 {
        self.camera_from_world.row(2).truncate()
    }
}
