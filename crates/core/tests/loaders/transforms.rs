//! The dialects of `transforms.json`.

use crate::scenes::{Scene, assert_says};
use gazesplat_core::camera::distortion::LensModel;
use gazesplat_core::dataset::{LoadOptions, SceneFormat};
use gazesplat_core::{Dataset, Error};
use glam::{Vec3, Vec4Swizzles};
use serde_json::{Value, json};

fn matrix(x: f64) -> Value {
    json!([[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]])
}

fn frame(path: &str, x: f64) -> Value {
    json!({"file_path": path, "transform_matrix": matrix(x)})
}

/// A scene with `transforms.json` and images of 20 × 10 pixels for all its frames.
fn scene(content: &Value) -> Scene {
    let scene = Scene::new();
    scene.write("transforms.json", content.to_string());
    for frame in content["frames"].as_array().into_iter().flatten() {
        if let Some(path) = frame["file_path"].as_str() {
            scene.write_image(path, [20, 10]);
        }
    }
    scene
}

fn load(scene: &Scene) -> Result<Dataset, Error> {
    Dataset::load(scene.path(), &LoadOptions::default())
}

fn only_view(content: &Value) -> gazesplat_core::View {
    load(&scene(content)).unwrap().all_views()[0].clone()
}

#[test]
fn opengl_poses_become_opencv_poses() {
    let view = only_view(&json!({"fl_x": 15.0, "frames": [frame("images/a.png", 2.0)]}));
    assert_eq!(view.camera.position(), Vec3::new(2.0, 0.0, 3.0));
    // OpenGL identity looks along −z with y up.
    assert_eq!(view.camera.forward(), Vec3::NEG_Z);
    assert_eq!(view.camera.camera_from_world.row(1).xyz(), Vec3::NEG_Y);
    assert_eq!(view.name, "a.png");
}

#[test]
fn intrinsics_come_from_the_frame_then_the_file_then_the_image() {
    let pinhole = |content: Value| only_view(&content).camera.intrinsics;
    let all = pinhole(
        json!({"fl_x": 15.0, "fl_y": 14.0, "cx": 9.5, "cy": 5.5, "w": 20.0, "h": 10, "frames": [frame("a.png", 0.0)]}),
    );
    assert_eq!((all.fx, all.fy, all.cx, all.cy, all.width, all.height), (15.0, 14.0, 9.5, 5.5, 20, 10));
    let angle = pinhole(json!({"camera_angle_x": 1.0, "frames": [frame("a.png", 0.0)]}));
    assert!((angle.fx - 10.0 / 0.5_f32.tan()).abs() < 1e-4 && angle.fx == angle.fy);
    assert_eq!((angle.cx, angle.cy), (10.0, 5.0));
    let mut own = frame("a.png", 0.0);
    own["fl_x"] = json!(12.0);
    own["cx"] = json!(8.0);
    let own = pinhole(json!({"fl_x": 15.0, "fl_y": 14.0, "cx": 9.5, "frames": [own]}));
    assert_eq!((own.fx, own.fy, own.cx), (12.0, 12.0, 8.0));
    // Declared at twice the size of the image.
    let half = pinhole(json!({"fl_x": 30.0, "cx": 19.0, "w": 40, "h": 20, "frames": [frame("a.png", 0.0)]}));
    assert_eq!((half.fx, half.cx, half.cy, half.width), (15.0, 9.5, 5.0, 20));
}

#[test]
fn camera_models_and_coefficients_are_understood() {
    let lens = |extra: Value| {
        let mut content = json!({"fl_x": 15.0, "frames": [frame("a.png", 0.0)]});
        content.as_object_mut().unwrap().extend(extra.as_object().unwrap().clone());
        only_view(&content).distortion
    };
    assert_eq!(lens(json!({"camera_model": "PINHOLE", "k1": 0.0, "p1": 0.0})), None);
    let found = lens(json!({"k1": 0.1, "k2": 0.02, "p1": 0.003, "p2": 0.004})).unwrap();
    assert_eq!((found.model, &found.coefficients[..4]), (LensModel::OpenCv, &[0.1, 0.02, 0.003, 0.004][..]));
    let found = lens(json!({"camera_model": "OPENCV", "k1": 0.1, "k3": 0.05})).unwrap();
    assert_eq!((found.model, found.coefficients[4]), (LensModel::FullOpenCv, 0.05));
    for fisheye in [json!({"camera_model": "OPENCV_FISHEYE", "k4": 0.01}), json!({"is_fisheye": true, "k4": 0.01})] {
        let found = lens(fisheye).unwrap();
        assert_eq!((found.model, found.coefficients[3]), (LensModel::OpenCvFisheye, 0.01));
    }
    let found = lens(json!({"camera_model": "OPENCV", "k1": 0.1, "k4": 0.01})).unwrap();
    assert_eq!((found.model, &found.coefficients[..6]), (LensModel::Perspective, &[0.1, 0.0, 0.0, 0.0, 0.0, 0.01][..]));
    for (name, words) in [("EQUIRECTANGULAR", "EQUIRECTANGULAR"), ("PERSPECTIVE", "PERSPECTIVE")] {
        let content = json!({"camera_model": name, "fl_x": 15.0, "k4": 0.5, "frames": [frame("a.png", 0.0)]});
        let error = load(&scene(&content)).unwrap_err();
        assert!(matches!(error, Error::Unsupported { .. }));
        assert_says(&error, "transforms.json", &["a.png", words]);
    }
}

#[test]
fn frames_without_image_are_left_out_aloud_and_none_left_is_an_error() {
    let content = json!({"fl_x": 15.0, "frames": [frame("images/a.JPG", 0.0), frame("images/b.jpg", 1.0), frame("images/c.jpg", 2.0)]});
    let scene = scene(&content);
    std::fs::remove_file(scene.at("images/b.jpg")).unwrap();
    let data = load(&scene).unwrap();
    assert_eq!(data.all_views().iter().map(|v| v.name.as_str()).collect::<Vec<_>>(), ["a.JPG", "c.jpg"]);
    assert!(
        data.warnings[0].contains("1 of the 3 frames") && data.warnings[0].contains("b.jpg"),
        "{:?}",
        data.warnings
    );
    std::fs::remove_dir_all(scene.at("images")).unwrap();
    assert_says(&load(&scene).unwrap_err(), "transforms.json", &["no registered views", "3 frames"]);
    let empty = Scene::new();
    empty.write("transforms.json", r#"{"frames": []}"#);
    assert_says(&load(&empty).unwrap_err(), "transforms.json", &["no registered views"]);
}

#[test]
fn nerf_synthetic_has_its_own_split_and_extensionless_names() {
    let scene = Scene::new();
    let frames = |set: &str| (0..9).map(|i| frame(&format!("./{set}/r_{i}"), f64::from(i))).collect::<Vec<_>>();
    for set in ["train", "test"] {
        scene.write(
            &format!("transforms_{set}.json"),
            json!({"camera_angle_x": 0.7, "frames": frames(set)}).to_string(),
        );
        for i in 0..9 {
            scene.write_image(&format!("{set}/r_{i}.png"), [8, 8]);
        }
    }
    let data = load(&scene).unwrap();
    assert_eq!((data.train.len(), data.test.len(), data.source), (9, 9, SceneFormat::NerfSynthetic));
    assert_eq!((data.train[0].name.as_str(), data.test[8].name.as_str()), ("train/r_0.png", "test/r_8.png"));
    // Without the test file the usual rule splits.
    std::fs::remove_file(scene.at("transforms_test.json")).unwrap();
    let data = load(&scene).unwrap();
    assert_eq!((data.train.len(), data.test.len()), (7, 2));
    assert_eq!(data.test[0].name, "r_0.png");
}

#[test]
fn points_and_masks_are_found() {
    let mut first = frame("images/a.jpg", 0.0);
    first["mask_path"] = json!("my masks/one.png");
    let mut third = frame("images/c.jpg", 2.0);
    third["mask_path"] = json!("gone.png");
    let content = json!({
        "fl_x": 15.0, "ply_file_path": "points.ply", "applied_transform": [[1, 0, 0, 5], [0, 0, 1, 0], [0, -1, 0, 0]],
        "frames": [first, frame("images/b.jpg", 1.0), third],
    });
    let scene = scene(&content);
    scene.write_image("my masks/one.png", [20, 10]);
    scene.write_image("masks/b.png", [20, 10]);
    scene.write(
        "points.ply",
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n1 2 3 4 5 6\n",
    );
    let data = load(&scene).unwrap();
    // The file's frame is kept, for the points and the poses.
    assert_eq!((data.points.positions[0], data.points.colors[0]), ([1.0, 2.0, 3.0], [4, 5, 6]));
    let views = data.all_views();
    assert_eq!(views[1].camera.position(), Vec3::new(1.0, 0.0, 3.0));
    assert_eq!(views[0].mask_path, Some(scene.at("my masks/one.png")));
    assert_eq!(views[1].mask_path, Some(scene.at("masks/b.png")));
    assert_eq!(views[2].mask_path, None);
    assert!(data.warnings.iter().any(|w| w.contains("gone.png")));
}

#[test]
fn another_image_directory_can_be_chosen() {
    let content = json!({"fl_x": 15.0, "w": 20, "h": 10, "frames": [frame("images/a.jpg", 0.0)]});
    let scene = scene(&content);
    scene.write_image("images_2/a.png", [10, 5]);
    let options = LoadOptions { images: Some("images_2".into()), ..LoadOptions::default() };
    let data = Dataset::load(scene.path(), &options).unwrap();
    assert_eq!(data.test[0].image_path, Some(scene.at("images_2/a.png")));
    assert_eq!(data.test[0].camera.intrinsics.fx, 7.5);
}

#[test]
fn damaged_files_name_the_frame_and_the_key() {
    let text = |content: &str| {
        let scene = Scene::new();
        scene.write("transforms.json", content);
        load(&scene).unwrap_err()
    };
    assert_says(&text(""), "transforms.json", &["not valid JSON", "line 1"]);
    assert_says(&text("[1, 2]"), "transforms.json", &["no JSON object"]);
    assert_says(&text("{}"), "transforms.json", &["`frames`"]);
    assert_says(&text(r#"{"frames": [NaN]}"#), "transforms.json", &["not valid JSON"]);
    let bad = |change: &dyn Fn(&mut Value)| {
        let mut content = json!({"fl_x": 15.0, "frames": [frame("a.png", 0.0), frame("b.png", 0.0)]});
        change(&mut content);
        let scene = Scene::new();
        scene.write("transforms.json", content.to_string());
        scene.write_image("a.png", [20, 10]);
        scene.write_image("b.png", [20, 10]);
        load(&scene).unwrap_err()
    };
    let says = |error: Error, words: &[&str]| assert_says(&error, "transforms.json", words);
    says(bad(&|c| c["frames"][1] = json!(5)), &["frame 1", "no JSON object"]);
    says(bad(&|c| c["frames"][1]["file_path"] = json!(5)), &["frame 1", "`file_path`"]);
    says(bad(&|c| c["frames"][1]["transform_matrix"] = json!(null)), &["frame 1 (`b.png`)", "`transform_matrix`"]);
    says(bad(&|c| c["frames"][1]["transform_matrix"][0][0] = json!(1e300)), &["frame 1", "finite"]);
    says(bad(&|c| c["frames"][1]["transform_matrix"][0][0] = json!(-1.0)), &["frame 1", "mirrors"]);
    says(bad(&|c| c["frames"][1]["fl_x"] = json!("wide")), &["frame 1", "`fl_x`", "\"wide\"", "a number"]);
    says(bad(&|c| c["fl_x"] = json!(null)), &["frame 0", "fl_x", "camera_angle_x"]);
    says(bad(&|c| c["fl_x"] = json!(0.0)), &["frame 0", "fx = 0"]);
    let odd =
        bad(&|c| c["frames"][1].as_object_mut().unwrap().extend([("w".into(), json!(20.5)), ("h".into(), json!(10))]));
    says(odd, &["frame 1", "`w`", "20.5"]);
    says(bad(&|c| *c = json!({"camera_angle_x": 4.0, "frames": c["frames"]})), &["frame 0", "`camera_angle_x`", "π"]);
}

#[test]
fn the_same_image_twice_is_refused() {
    let content = json!({"fl_x": 15.0, "frames": [frame("images/a.png", 0.0), frame("images/./a.png", 1.0)]});
    assert_says(&load(&scene(&content)).unwrap_err(), "transforms.json", &["frame 0", "frame 1", "same image"]);
}

#[test]
fn a_colmap_model_is_preferred_and_a_json_file_can_be_given() {
    let model = crate::scenes::small_model(2);
    let scene = crate::scenes::binary_scene(&model);
    scene.write("transforms.json", json!({"fl_x": 15.0, "frames": [frame("images/photo 00.JPG", 0.0)]}).to_string());
    assert_eq!(load(&scene).unwrap().source, SceneFormat::ColmapBinary);
    let data = Dataset::load(scene.at("transforms.json"), &LoadOptions::default()).unwrap();
    assert_eq!((data.source, data.all_views().len()), (SceneFormat::Transforms, 1));
}

#[test]
fn names_with_blanks_and_of_any_language_are_found() {
    let names = ["images/zwei Wörter.png", "images/東京/写真 1.png", "images\\☃ (копия).png"];
    let frames: Vec<Value> = names.iter().zip([0.0, 1.0, 2.0]).map(|(name, x)| frame(name, x)).collect();
    let scene = Scene::new();
    scene.write("transforms.json", json!({ "fl_x": 20.0, "frames": frames }).to_string());
    for name in names {
        scene.write_image(&name.replace('\\', "/"), [20, 10]);
    }
    let data = load(&scene).unwrap();
    assert_eq!(data.warnings, Vec::<String>::new());
    let found: Vec<String> = data.all_views().iter().map(|view| view.name.clone()).collect();
    assert_eq!(found, ["zwei Wörter.png", "☃ (копия).png", "東京/写真 1.png"]);
}

fn names(views: &[gazesplat_core::View]) -> Vec<&str> {
    views.iter().map(|view| view.name.as_str()).collect()
}

#[test]
fn split_lists_of_nerfstudio_are_followed() {
    let frames: Vec<Value> =
        ["a", "b", "c", "d", "e"].iter().map(|name| frame(&format!("images/{name}.png"), 0.0)).collect();
    let split = |lists: Value| {
        let mut content = json!({"fl_x": 15.0, "frames": frames});
        content.as_object_mut().unwrap().extend(lists.as_object().unwrap().clone());
        load(&scene(&content))
    };
    let data = split(json!({
        "train_filenames": ["images/d.png", "./images/a.png"], "test_filenames": ["images/c.png"],
        "val_filenames": ["images/b.png"],
    }))
    .unwrap();
    assert_eq!((names(&data.train), names(&data.test)), (vec!["a.png", "d.png"], vec!["c.png"]));
    assert!(data.warnings[0].contains("2 of 5 frames are neither training nor test views"), "{:?}", data.warnings);
    // Validation views judge where there are no test views, and train nowhere.
    let data = split(json!({"val_filenames": ["images/b.png"]})).unwrap();
    assert_eq!((names(&data.train), names(&data.test)), (vec!["a.png", "c.png", "d.png", "e.png"], vec!["b.png"]));
    let data = split(json!({"test_filenames": ["images/b.png"], "val_filenames": ["images/c.png"]})).unwrap();
    assert_eq!((names(&data.train), names(&data.test)), (vec!["a.png", "d.png", "e.png"], vec!["b.png"]));
    // Without one of them every view may train: the rule by number is not asked.
    let all: Vec<String> = ["a", "b", "c", "d", "e"].iter().map(|name| format!("images/{name}.png")).collect();
    let data = split(json!({ "train_filenames": all })).unwrap();
    assert_eq!((data.train.len(), data.test.len()), (5, 0));

    for (lists, words) in [
        (
            json!({"train_filenames": ["images/x.png"]}),
            "`train_filenames`: no frame has the `file_path` `images/x.png`",
        ),
        (json!({"val_filenames": "images/a.png"}), "`val_filenames`: found no array"),
        (json!({"test_filenames": [3]}), "`test_filenames`: found 3, expected a file name"),
        (json!({"train_filenames": []}), "leaves no frame with an image file to train on"),
        (
            json!({"train_filenames": ["images/a.png"], "val_filenames": ["images/a.png"]}),
            "`images/a.png` is in `train_filenames` and in `val_filenames`",
        ),
    ] {
        assert_says(&split(lists).unwrap_err(), "transforms.json", &[words]);
    }
}

#[test]
fn scaled_images_take_their_scaled_masks_first() {
    let mut named = frame("images/a.png", 0.0);
    named["mask_path"] = json!("masks/special.png");
    let content = json!({"fl_x": 15.0, "w": 20, "h": 10, "frames": [named, frame("images/b.png", 1.0)]});
    let scene = scene(&content);
    for name in ["a", "b"] {
        scene.write_image(&format!("images_2/{name}.png"), [10, 5]);
    }
    for name in ["masks/special.png", "masks/b.png", "masks_2/b.png"] {
        scene.write(name, "");
    }
    let masks = |images: Option<&str>| -> Vec<String> {
        let options = LoadOptions { images: images.map(str::to_owned), ..LoadOptions::default() };
        let data = Dataset::load(scene.path(), &options).unwrap();
        let name = |path: &std::path::Path| path.strip_prefix(scene.path()).unwrap().to_string_lossy().into_owned();
        data.all_views().iter().map(|view| name(view.mask_path.as_deref().unwrap())).collect()
    };
    assert_eq!(masks(None), ["masks/special.png", "masks/b.png"]);
    assert_eq!(masks(Some("images_2")), ["masks/special.png", "masks_2/b.png"]);
    scene.write("masks_2/special.png", "");
    assert_eq!(masks(Some("images_2")), ["masks_2/special.png", "masks_2/b.png"]);
}
