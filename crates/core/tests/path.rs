//! Camera paths: files and curves.

#![expect(clippy::unwrap_used, reason = "a helper of a test may panic like the test")]

use gazesplat_core::camera::path::CameraPath;
use gazesplat_core::{Camera, Error, Pinhole};
use glam::{Mat3, Mat4, Vec3};
use std::path::PathBuf;
use tempfile::TempDir;

const INTRINSICS: Pinhole = Pinhole { width: 640, height: 480, fx: 500.0, fy: 505.0, cx: 320.5, cy: 239.0 };

fn written(text: &str) -> (TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("path.json");
    std::fs::write(&path, text).unwrap();
    (dir, path)
}

fn ring(num: usize) -> Vec<Camera> {
    let orbit = CameraPath::orbit(INTRINSICS, Vec3::new(1.0, 2.0, 3.0), Vec3::Z, 4.0, 1.5, num);
    orbit.frames.into_iter().map(|(_, camera)| camera).collect()
}

#[test]
fn orbit_looks_at_its_centre_from_its_radius() {
    let center = Vec3::new(1.0, 2.0, 3.0);
    for camera in ring(12) {
        let offset = camera.position() - center;
        assert!((offset.z - 1.5).abs() < 1e-5 && (offset.truncate().length() - 4.0).abs() < 1e-5);
        let seen = camera.camera_from_world.transform_point3(center);
        assert!(seen.truncate().length() < 1e-5 && seen.z > 0.0);
        // World up is up in the image.
        assert!(camera.camera_from_world.transform_vector3(Vec3::Z).y < 0.0);
    }
}

#[test]
fn saved_paths_load_as_they_were() {
    let dir = tempfile::tempdir().unwrap();
    let path = CameraPath { fps: 24.0, ..CameraPath::orbit(INTRINSICS, Vec3::ZERO, Vec3::NEG_Y, 2.0, 0.3, 7) };
    path.save(dir.path().join("p.json")).unwrap();
    assert_eq!(CameraPath::load(dir.path().join("p.json")).unwrap(), path);
}

#[test]
fn curve_passes_through_its_keys_and_stays_rigid() {
    let keys = ring(5);
    for (is_loop, num_frames, per_segment) in [(true, 50, 10), (false, 41, 10)] {
        let path = CameraPath::through(&keys, num_frames, is_loop).unwrap();
        assert_eq!(path.frames.len(), num_frames);
        for (i, key) in keys.iter().enumerate() {
            let camera = path.frames[i * per_segment].1;
            assert!(camera.camera_from_world.abs_diff_eq(key.camera_from_world, 1e-4), "key {i}");
        }
        for (name, camera) in &path.frames {
            let r = Mat3::from_mat4(camera.camera_from_world);
            assert!((r * r.transpose()).abs_diff_eq(Mat3::IDENTITY, 1e-5), "{name}");
        }
        // Smooth: no step is much longer than the mean one.
        let steps: Vec<f32> =
            path.frames.windows(2).map(|w| (w[1].1.position() - w[0].1.position()).length()).collect();
        let mean = steps.iter().sum::<f32>() / steps.len() as f32;
        assert!(steps.iter().all(|step| *step < 1.5 * mean), "{steps:?}");
    }
}

#[test]
fn degenerate_curves_are_still_paths() {
    let keys = ring(3);
    assert_eq!(CameraPath::through(&keys[..1], 4, false).unwrap().frames.len(), 4);
    assert_eq!(CameraPath::through(&keys[..1], 4, true).unwrap().frames.len(), 4);
    assert_eq!(CameraPath::through(&keys, 1, false).unwrap().frames.len(), 1);
    assert_eq!(CameraPath::through(&keys, 0, true).unwrap().frames.len(), 0);
    assert!(matches!(CameraPath::through(&[], 3, false), Err(Error::Parameter { .. })));
}

#[test]
fn reference_cameras_json_has_the_poses_it_says() {
    let text = r#"[{"id": 0, "img_name": "a/b", "width": 800, "height": 600, "position": [1.0, 2.0, 3.0],
        "rotation": [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], "fy": 910.0, "fx": 900.0}]"#;
    let (_dir, file) = written(text);
    let path = CameraPath::load(&file).unwrap();
    let (name, camera) = &path.frames[0];
    assert_eq!(name, "a_b");
    assert_eq!(camera.intrinsics, Pinhole { width: 800, height: 600, fx: 900.0, fy: 910.0, cx: 400.0, cy: 300.0 });
    assert!(camera.position().abs_diff_eq(Vec3::new(1.0, 2.0, 3.0), 1e-6));
    // The third column of camera-to-world is where the camera looks.
    assert!(camera.forward().abs_diff_eq(Vec3::X, 1e-6));
}

#[test]
fn nerfstudio_paths_are_turned_to_our_axes() {
    // Identity in OpenGL axes looks along −z with +y up.
    let text = r#"{"camera_type": "perspective", "render_height": 100, "render_width": 200, "fps": 25, "seconds": 1,
        "camera_path": [{"camera_to_world": [1,0,0,5, 0,1,0,6, 0,0,1,7, 0,0,0,1], "fov": 90, "aspect": 2}]}"#;
    let (_dir, file) = written(text);
    let path = CameraPath::load(&file).unwrap();
    let camera = path.frames[0].1;
    assert_eq!(path.fps, 25.0);
    assert!((camera.intrinsics.fx - 50.0).abs() < 1e-4 && camera.intrinsics.cx == 100.0);
    assert!(camera.position().abs_diff_eq(Vec3::new(5.0, 6.0, 7.0), 1e-6));
    assert!(camera.forward().abs_diff_eq(Vec3::NEG_Z, 1e-6));
    assert!(camera.camera_from_world.transform_vector3(Vec3::Y).abs_diff_eq(Vec3::NEG_Y, 1e-6));
    let (_dir, file) = written(&text.replace("perspective", "equirectangular"));
    assert!(matches!(CameraPath::load(&file), Err(Error::Unsupported { .. })));
}

#[test]
fn errors_name_the_file_and_the_frame() {
    let fails = |text: &str| {
        let (_dir, file) = written(text);
        let error = CameraPath::load(&file).expect_err("bad path");
        assert!(error.to_string().contains("path.json"), "{error}");
        format!("{error} {}", error.hint().unwrap_or_default())
    };
    assert!(fails("not json").contains("not valid JSON"));
    assert!(fails("{}").contains("known layouts"));
    assert!(fails("[]").contains("no frames"));
    assert!(fails(r#"{"frames": [{"transform_matrix": []}]}"#).contains("transforms.json"));
    let good = r#"{"format": "gazesplat-path", "fps": 30, "frames": [{"name": "a",
        "intrinsics": {"width": 4, "height": 4, "fx": 4, "fy": 4, "cx": 2, "cy": 2},
        "camera_from_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.5]]}]}"#;
    let (_dir, file) = written(good);
    assert_eq!(CameraPath::load(&file).unwrap().frames[0].1.camera_from_world, Mat4::from_translation(Vec3::Z * 2.5));
    assert!(fails(&good.replace("[1, 0, 0, 0]", "[2, 0, 0, 0]")).contains("frame 0"));
    assert!(fails(&good.replace("\"fx\": 4", "\"fx\": 0")).contains("frame 0"));
    assert!(fails(&good.replace("\"width\": 4", "\"width\": 0")).contains("image size is 0x4"));
    assert!(fails(&good.replace("\"fps\": 30", "\"fps\": 0")).contains("fps is 0"));
    assert!(fails(&good.replace("\"name\"", "\"nam\"")).contains("line"));
    assert!(matches!(CameraPath::load("no/such/path.json"), Err(Error::Io { .. })));
}

#[test]
fn cameras_of_real_models_are_those_of_their_transforms() {
    for name in ["model_plush", "model_flowers", "garden_points"] {
        let Some(file) = gazesplat_testkit::data_path(&format!("{name}/cameras.json")) else { return };
        let path = CameraPath::load(&file).unwrap();
        assert_eq!(path.frames.len(), if name == "garden_points" { 3 } else { 24 });
        let Some(transforms) = file.with_file_name("transforms.json").is_file().then(|| file.parent().unwrap()) else {
            continue;
        };
        let dataset =
            gazesplat_core::Dataset::load(transforms, &gazesplat_core::dataset::LoadOptions::default()).unwrap();
        for (view, (_, camera)) in dataset.all_views().iter().zip(&path.frames) {
            let found = view.camera.camera_from_world;
            assert!(found.abs_diff_eq(camera.camera_from_world, 1e-5), "{}: {found}", view.name);
            assert!((view.camera.intrinsics.fx - 0.5 * camera.intrinsics.fx).abs() < 1e-3);
        }
    }
}
