//! A synthetic scene as files, in the layouts that photographs come in: COLMAP text and `transforms.json` beside the images.

use super::SyntheticScene;
use crate::camera::{Camera, Pinhole};
use crate::dataset::{Dataset, LoadOptions, SparsePoints};
use crate::error::{Error, Result};
use crate::io::{save_png, write_atomically};
use glam::{DMat3, DQuat, Mat3};
use serde_json::json;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;

/// What [`write_scene`] makes.
#[derive(Debug, Clone, PartialEq)]
pub struct SynthOptions {
    /// Seed of the scene and its points.
    pub seed: u64,
    /// Number of views, at least 1.
    pub num_views: usize,
    /// Image width in pixels, at least 1.
    pub width: u32,
    /// Image height in pixels, at least 1.
    pub height: u32,
    /// Horizontal field of view in degrees, between 0 and 180.
    pub fov_x_deg: f32,
    /// Samples along each side of a pixel.
    pub samples_per_side: u32,
    /// Number of sparse points.
    pub num_points: usize,
}

impl Default for SynthOptions {
    fn default() -> Self {
        Self {
            seed: 0,
            num_views: 40,
            width: 480,
            height: 320,
            fov_x_deg: 75.0,
            samples_per_side: 3,
            num_points: 10_000,
        }
    }
}

impl SynthOptions {
    fn intrinsics(&self) -> Result<Pinhole> {
        if self.num_views == 0 || self.width == 0 || self.height == 0 {
            let found = format!("found {} views of {}x{}", self.num_views, self.width, self.height);
            return Err(Error::parameter("num_views, width, height", format!("{found}, expected at least 1")));
        }
        if !(self.fov_x_deg > 0.0 && self.fov_x_deg < 180.0) {
            let message = format!("found {}, expected more than 0 and less than 180", self.fov_x_deg);
            return Err(Error::parameter("fov_x_deg", message));
        }
        Ok(Pinhole::from_fov_x(self.width, self.height, self.fov_x_deg.to_radians()))
    }
}

/// Writes the room of `options.seed` as a scene to `dir` (made if missing) and reads it back: `images/view_000.png` …, a COLMAP
/// text model in `sparse/0`, `transforms.json` (OpenGL axes) and `points3D.ply`. Equal options give equal files.
///
/// # Errors
///
/// [`Error::Parameter`] for options out of range, [`Error::Io`] when writing fails.
pub fn write_scene(dir: impl AsRef<Path>, options: &SynthOptions) -> Result<Dataset> {
    let dir = dir.as_ref();
    let intrinsics = options.intrinsics()?;
    let (images, sparse) = (dir.join("images"), dir.join("sparse").join("0"));
    for made in [&images, &sparse] {
        std::fs::create_dir_all(made).map_err(|e| Error::io("create", made, e))?;
    }
    let scene = SyntheticScene::room(options.seed);
    let cameras = scene.camera_ring(options.num_views, intrinsics);
    for (index, camera) in cameras.iter().enumerate() {
        let image = scene.render(camera, options.samples_per_side).to_rgb8();
        save_png(images.join(image_name(index)), &image)?;
    }
    let points = scene.sparse_points(options.num_points, options.seed);
    let write_text = |path: &Path, text: String| write_atomically(path, |file| file.write_all(text.as_bytes()));
    write_text(&sparse.join("cameras.txt"), cameras_txt(&intrinsics))?;
    write_text(&sparse.join("images.txt"), images_txt(&cameras))?;
    write_text(&sparse.join("points3D.txt"), points_txt(&points))?;
    write_text(&dir.join("transforms.json"), transforms_json(&intrinsics, &cameras))?;
    write_atomically(dir.join("points3D.ply"), |file| write_points_ply(file, &points))?;
    Dataset::load(dir, &LoadOptions::default())
}

fn image_name(index: usize) -> String {
    format!("view_{index:03}.png")
}

fn cameras_txt(c: &Pinhole) -> String {
    let Pinhole { width, height, fx, fy, cx, cy } = c;
    format!("# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n1 PINHOLE {width} {height} {fx} {fy} {cx} {cy}\n")
}

/// Pose of each image, followed by its (empty) line of observations.
fn images_txt(cameras: &[Camera]) -> String {
    let mut text = String::from("# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n");
    for (index, camera) in cameras.iter().enumerate() {
        let rotation: DMat3 = Mat3::from_mat4(camera.camera_from_world).as_dmat3();
        let q = DQuat::from_mat3(&rotation).normalize();
        let t = camera.camera_from_world.w_axis;
        let id = index + 1;
        let name = image_name(index);
        writeln!(text, "{id} {} {} {} {} {} {} {} 1 {name}\n", q.w, q.x, q.y, q.z, t.x, t.y, t.z)
            .expect("writing to a string does not fail");
    }
    text
}

fn points_txt(points: &SparsePoints) -> String {
    let mut text = String::from("# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID, POINT2D_IDX)\n");
    for (index, ([x, y, z], [r, g, b])) in points.positions.iter().zip(&points.colors).enumerate() {
        writeln!(text, "{} {x} {y} {z} {r} {g} {b} 0", index + 1).expect("writing to a string does not fail");
    }
    text
}

fn transforms_json(c: &Pinhole, cameras: &[Camera]) -> String {
    let frames: Vec<_> = cameras
        .iter()
        .enumerate()
        .map(|(index, camera)| {
            let world_from_camera = camera.camera_from_world.as_dmat4().inverse();
            // From OpenCV to OpenGL axes: the camera's y and z change sign.
            let rows = [0, 1, 2, 3].map(|row| {
                let [x, y, z, w] = world_from_camera.row(row).to_array();
                [x, -y, -z, w]
            });
            json!({ "file_path": format!("images/{}", image_name(index)), "transform_matrix": rows })
        })
        .collect();
    let file = json!({
        "camera_model": "PINHOLE",
        "w": c.width, "h": c.height, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy,
        "ply_file_path": "points3D.ply",
        "frames": frames,
    });
    format!("{file:#}\n")
}

fn write_points_ply(file: &mut impl std::io::Write, points: &SparsePoints) -> std::io::Result<()> {
    write!(file, "ply\nformat binary_little_endian 1.0\nelement vertex {}\n", points.positions.len())?;
    for name in ["x", "y", "z"] {
        writeln!(file, "property float {name}")?;
    }
    for name in ["red", "green", "blue"] {
        writeln!(file, "property uchar {name}")?;
    }
    writeln!(file, "end_header")?;
    for (position, color) in points.positions.iter().zip(&points.colors) {
        position.iter().try_for_each(|v| file.write_all(&v.to_le_bytes()))?;
        file.write_all(color)?;
    }
    Ok(())
}
