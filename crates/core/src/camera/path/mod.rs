//! Camera paths: sequences of posed pinhole cameras to render, as files and as smooth curves.

mod json;

use crate::camera::{Camera, Pinhole};
use crate::error::{Error, Result};
use glam::{Mat3, Mat4, Quat, Vec3};
use std::path::Path;

/// Frames per second of a path whose file names none.
pub const DEFAULT_FPS: f32 = 30.0;

/// A sequence of named cameras.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraPath {
    /// Name (a file stem) and camera of each frame, in playing order.
    pub frames: Vec<(String, Camera)>,
    /// Playing speed in frames per second.
    pub fps: f32,
}

impl CameraPath {
    /// Reads a camera path. Known layouts: this project's own (below), the `cameras.json` of the 3DGS reference
    /// implementation, and the `camera_path.json` of nerfstudio.
    ///
    /// The own layout, `camera_from_world` being the first three rows of the matrix with OpenCV axes:
    ///
    /// ```json
    /// { "format": "gazesplat-path", "fps": 30.0, "frames": [
    ///   { "name": "frame_00000",
    ///     "intrinsics": { "width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0 },
    ///     "camera_from_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.5]] } ] }
    /// ```
    ///
    /// # Errors
    ///
    /// [`Error::Io`] when the file cannot be read; [`Error::Format`] when it is not JSON, has none of the known layouts, or
    /// a frame is no camera (image size, focal lengths, rotation); [`Error::Unsupported`] for cameras that are no pinholes.
    pub fn load(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let text = std::fs::read_to_string(path).map_err(|e| Error::io("read", path, e))?;
        json::parse(path, &text)
    }

    /// Writes the path in this project's layout; the file appears complete or not at all.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] when writing fails.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        let text = json::to_text(self);
        crate::io::write_atomically(path.as_ref(), |file| std::io::Write::write_all(file, text.as_bytes()))
    }

    /// Circle of `num_frames` cameras around `center` that look at it, counter-clockwise seen from `up`.
    ///
    /// `radius` is measured across `up`, `height` along it, both in world units; `up` has any non-zero length.
    pub fn orbit(intrinsics: Pinhole, center: Vec3, up: Vec3, radius: f32, height: f32, num_frames: usize) -> Self {
        let up = up.normalize();
        let (side, ahead) = up.any_orthonormal_pair();
        let cameras = (0..num_frames).map(|i| {
            let (sin, cos) = (std::f32::consts::TAU * i as f32 / num_frames as f32).sin_cos();
            let eye = center + radius * (cos * side + sin * ahead) + height * up;
            Camera::look_at(intrinsics, eye, center, up)
        });
        Self::numbered(cameras)
    }

    /// Smooth path of `num_frames` cameras through `keys`: Catmull–Rom positions, spherical linear interpolation of the
    /// rotations, equal time between keys; closed to a loop (the last frame is one step before the first) or open (first
    /// and last frame are the first and last key). The image size is that of the first key.
    ///
    /// # Errors
    ///
    /// [`Error::Parameter`] when there are no keys.
    pub fn through(keys: &[Camera], num_frames: usize, is_loop: bool) -> Result<Self> {
        let Some(first) = keys.first() else {
            return Err(Error::parameter("keys", "found 0 cameras, expected at least 1"));
        };
        let size = (first.intrinsics.width, first.intrinsics.height);
        let num_segments = if is_loop { keys.len() } else { keys.len() - 1 };
        let num_steps = if is_loop { num_frames } else { num_frames.saturating_sub(1) }.max(1);
        let key = |i: isize| {
            let n = keys.len() as isize;
            &keys[if is_loop { i.rem_euclid(n) } else { i.clamp(0, n - 1) } as usize]
        };
        let cameras = (0..num_frames).map(|frame| {
            // In f64: an f32 product loses the exact hit on keys of long paths.
            let time = frame as f64 * num_segments as f64 / num_steps as f64;
            let segment = (time as usize).min(num_segments.saturating_sub(1)) as isize;
            let t = (time - segment as f64) as f32;
            let around = [-1, 0, 1, 2].map(|offset| key(segment + offset));
            let position = catmull_rom(around.map(Camera::position), t);
            let rotation = world_from_camera(around[1]).slerp(world_from_camera(around[2]), t);
            let [from, to] = [around[1], around[2]].map(|camera| camera.intrinsics.resized(size.0, size.1));
            posed(mixed(from, to, t), rotation, position)
        });
        Ok(Self::numbered(cameras))
    }

    fn numbered(cameras: impl Iterator<Item = Camera>) -> Self {
        let frames = cameras.enumerate().map(|(i, camera)| (format!("frame_{i:05}"), camera)).collect();
        Self { frames, fps: DEFAULT_FPS }
    }
}

/// Uniform Catmull–Rom spline between `points[1]` (t = 0) and `points[2]` (t = 1).
fn catmull_rom([a, b, c, d]: [Vec3; 4], t: f32) -> Vec3 {
    b + 0.5 * t * ((c - a) + t * ((2.0 * a - 5.0 * b + 4.0 * c - d) + t * (3.0 * (b - c) + d - a)))
}

fn mixed(from: Pinhole, to: Pinhole, t: f32) -> Pinhole {
    let mix = |a: f32, b: f32| a + t * (b - a);
    Pinhole {
        fx: mix(from.fx, to.fx),
        fy: mix(from.fy, to.fy),
        cx: mix(from.cx, to.cx),
        cy: mix(from.cy, to.cy),
        ..from
    }
}

fn world_from_camera(camera: &Camera) -> Quat {
    Quat::from_mat3(&Mat3::from_mat4(camera.camera_from_world).transpose()).normalize()
}

/// Camera with the given orientation (`world_from_camera`) and centre.
fn posed(intrinsics: Pinhole, world_from_camera: Quat, position: Vec3) -> Camera {
    let rotation = Mat3::from_quat(world_from_camera).transpose();
    let mut camera_from_world = Mat4::from_mat3(rotation);
    camera_from_world.w_axis = (-(rotation * position)).extend(1.0);
    Camera { intrinsics, camera_from_world }
}
