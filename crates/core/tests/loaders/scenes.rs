//! Writers of tiny scenes.

use gazesplat_core::camera::distortion::{LensDistortion, LensModel};
use gazesplat_core::dataset::SparsePoints;
use gazesplat_core::io::colmap::{ColmapImage, ColmapModel};
use gazesplat_core::io::save_png;
use gazesplat_core::{Error, RgbImage8};
use glam::{DMat4, DQuat, DVec3};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// A directory that goes away with the test.
pub struct Scene {
    dir: TempDir,
}

impl Scene {
    pub fn new() -> Self {
        Self { dir: tempfile::tempdir().unwrap() }
    }

    pub fn path(&self) -> &Path {
        self.dir.path()
    }

    pub fn at(&self, relative: &str) -> PathBuf {
        self.dir.path().join(relative)
    }

    pub fn write(&self, relative: &str, content: impl AsRef<[u8]>) -> PathBuf {
        let path = self.at(relative);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, content).unwrap();
        path
    }

    /// A PNG of one colour; the name may have any extension.
    pub fn write_image(&self, relative: &str, [width, height]: [u32; 2]) -> PathBuf {
        let path = self.write(relative, "");
        save_png(&path, &RgbImage8::filled(width, height, [10, 20, 30])).unwrap();
        path
    }

    /// Photographs of a model, in `images`.
    pub fn write_photos(&self, model: &ColmapModel) {
        for image in &model.images {
            let lens = &model.cameras[&image.camera_id];
            self.write_image(&format!("images/{}", image.name), [lens.width, lens.height]);
        }
    }
}

/// Two cameras, `num_images` images (names with blanks, upper-case extensions), five points.
pub fn small_model(num_images: u32) -> ColmapModel {
    let opencv = [0.05, -0.02, 0.001, -0.002, 0., 0., 0., 0.];
    let cameras = BTreeMap::from([
        (1, LensDistortion::pinhole([24, 16], [20.5, 20.25], [12.0, 8.0])),
        (7, LensDistortion::new(LensModel::OpenCv, [32, 20], [30.0, 30.5], [16.0, 10.0], opencv)),
    ]);
    let images = (0..num_images)
        .map(|i| ColmapImage {
            id: 100 + i,
            name: format!("photo {i:02}.JPG"),
            camera_id: if i % 2 == 0 { 1 } else { 7 },
            camera_from_world: DMat4::from_rotation_translation(
                DQuat::from_axis_angle(DVec3::new(1.0, 2.0, 2.0) / 3.0, 0.1 * f64::from(i)),
                DVec3::new(f64::from(i), -1.0, 2.5),
            ),
        })
        .collect();
    let points = SparsePoints {
        positions: (0..5).map(|i| [i as f32, 0.5, -2.0]).collect(),
        colors: (0..5).map(|i| [i, 100, 255]).collect(),
    };
    ColmapModel { cameras, images, points, num_dropped_points: 0 }
}

/// Parameters in COLMAP's order.
fn params(lens: &LensDistortion) -> Vec<f64> {
    let focal = if lens.model.has_single_focal() { vec![lens.fx] } else { vec![lens.fx, lens.fy] };
    let coefficients = &lens.coefficients[..lens.model.coefficient_names().len()];
    [&focal[..], &[lens.cx, lens.cy], coefficients].concat()
}

/// (quaternion w x y z, translation).
fn pose(image: &ColmapImage) -> ([f64; 4], [f64; 3]) {
    let (_, q, t) = image.camera_from_world.to_scale_rotation_translation();
    ([q.w, q.x, q.y, q.z], t.to_array())
}

/// Contents of cameras.bin, images.bin, points3D.bin; every image has two 2D points, every point two observations.
pub fn binary(model: &ColmapModel) -> [Vec<u8>; 3] {
    let mut cameras = (model.cameras.len() as u64).to_le_bytes().to_vec();
    for (id, lens) in &model.cameras {
        let model_id = LensModel::ALL.iter().position(|m| *m == lens.model).unwrap() as i32;
        cameras.extend(id.to_le_bytes());
        cameras.extend(model_id.to_le_bytes());
        cameras.extend([lens.width, lens.height].map(u64::from).map(u64::to_le_bytes).concat());
        cameras.extend(params(lens).iter().flat_map(|p| p.to_le_bytes()));
    }
    let mut images = (model.images.len() as u64).to_le_bytes().to_vec();
    for image in &model.images {
        let (quat, translation) = pose(image);
        images.extend(image.id.to_le_bytes());
        images.extend(quat.iter().chain(&translation).flat_map(|v| v.to_le_bytes()));
        images.extend(image.camera_id.to_le_bytes());
        images.extend(image.name.as_bytes());
        images.push(0);
        images.extend(2_u64.to_le_bytes());
        for id in [3_i64, -1] {
            images.extend([1.5_f64, 2.5].map(f64::to_le_bytes).concat());
            images.extend(id.to_le_bytes());
        }
    }
    let mut points = (model.points.len() as u64).to_le_bytes().to_vec();
    for (i, (position, color)) in model.points.positions.iter().zip(&model.points.colors).enumerate() {
        points.extend((i as u64 + 1).to_le_bytes());
        points.extend(position.iter().flat_map(|&x| f64::from(x).to_le_bytes()));
        points.extend(color);
        points.extend(0.5_f64.to_le_bytes());
        points.extend(2_u64.to_le_bytes());
        points.extend([100_u32, 0, 101, 1].iter().flat_map(|v| v.to_le_bytes()));
    }
    [cameras, images, points]
}

/// Contents of cameras.txt, images.txt, points3D.txt; every other image has an empty second line.
pub fn text(model: &ColmapModel) -> [String; 3] {
    let mut cameras = "# Camera list\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n".to_owned();
    for (id, lens) in &model.cameras {
        let params: Vec<String> = params(lens).iter().map(f64::to_string).collect();
        writeln!(cameras, "{id} {} {} {} {}", lens.model.name(), lens.width, lens.height, params.join(" ")).unwrap();
    }
    let mut images = "# Image list\n\n".to_owned();
    for (i, image) in model.images.iter().enumerate() {
        let ([w, x, y, z], [tx, ty, tz]) = pose(image);
        writeln!(images, "{} {w} {x} {y} {z} {tx} {ty} {tz} {} {}", image.id, image.camera_id, image.name).unwrap();
        images.push_str(if i % 2 == 0 { "1.5 2.5 3 1.5 2.5 -1\n" } else { "\n" });
    }
    let mut points = "# 3D point list\n".to_owned();
    for (i, ([x, y, z], [r, g, b])) in model.points.positions.iter().zip(&model.points.colors).enumerate() {
        writeln!(points, "{} {x} {y} {z} {r} {g} {b} 0.5 100 0 101 1", i + 1).unwrap();
    }
    [cameras, images, points]
}

/// A scene with a binary model in `sparse/0` and its photographs.
pub fn binary_scene(model: &ColmapModel) -> Scene {
    let scene = Scene::new();
    for (name, content) in ["cameras.bin", "images.bin", "points3D.bin"].iter().zip(binary(model)) {
        scene.write(&format!("sparse/0/{name}"), content);
    }
    scene.write_photos(model);
    scene
}

/// A scene with a text model in `sparse/0` and its photographs.
pub fn text_scene(model: &ColmapModel) -> Scene {
    let scene = Scene::new();
    for (name, content) in ["cameras.txt", "images.txt", "points3D.txt"].iter().zip(text(model)) {
        scene.write(&format!("sparse/0/{name}"), content);
    }
    scene.write_photos(model);
    scene
}

/// Checks that the error names the file, says each of `words` and has a hint.
#[track_caller]
pub fn assert_says(error: &Error, file: &str, words: &[&str]) {
    let text = error.to_string();
    assert!(text.contains(file), "`{text}` does not name {file}");
    for word in words {
        assert!(text.contains(word), "`{text}` does not say `{word}`");
    }
    assert!(error.hint().is_some(), "`{text}` has no hint");
}
