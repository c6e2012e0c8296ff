//! COLMAP models, binary and text.

use crate::scenes::{Scene, assert_says, binary, binary_scene, small_model, text, text_scene};
use gazesplat_core::camera::distortion::LensModel;
use gazesplat_core::dataset::{LoadOptions, SceneFormat};
use gazesplat_core::io::colmap::{ColmapModel, read_model};
use gazesplat_core::{Dataset, Error};

fn load(scene: &Scene) -> Result<Dataset, Error> {
    Dataset::load(scene.path(), &LoadOptions::default())
}

/// Equal up to the rounding of quaternions.
fn assert_same_model(found: &ColmapModel, expected: &ColmapModel) {
    assert_eq!(found.cameras, expected.cameras);
    assert_eq!(found.points, expected.points);
    assert_eq!(found.images.len(), expected.images.len());
    for (a, b) in found.images.iter().zip(&expected.images) {
        assert_eq!((a.id, &a.name, a.camera_id), (b.id, &b.name, b.camera_id));
        assert!(a.camera_from_world.abs_diff_eq(b.camera_from_world, 1e-12));
    }
}

#[test]
fn models_survive_both_formats() {
    let model = small_model(5);
    for (scene, format) in
        [(binary_scene(&model), SceneFormat::ColmapBinary), (text_scene(&model), SceneFormat::ColmapText)]
    {
        let (found, source) = read_model(&scene.at("sparse/0")).unwrap();
        assert_eq!(source, format);
        assert_same_model(&found, &model);
        let data = load(&scene).unwrap();
        assert_eq!((data.train.len(), data.test.len(), data.source), (4, 1, format));
        assert_eq!(data.test[0].name, "photo 00.JPG");
        assert!(data.warnings.is_empty());
        let views = data.all_views();
        assert_eq!((views[0].camera.intrinsics.width, views[0].camera.intrinsics.fy), (24, 20.25));
        assert!(views[0].distortion.is_none() && views[1].distortion.is_some());
    }
}

#[test]
fn binary_is_preferred_and_all_places_are_found() {
    let model = small_model(2);
    let scene = binary_scene(&model);
    scene.write("sparse/0/cameras.txt", "nonsense");
    assert_eq!(load(&scene).unwrap().source, SceneFormat::ColmapBinary);
    for place in ["sparse", "colmap/sparse/0", "."] {
        let scene = Scene::new();
        for (name, content) in ["cameras.txt", "images.txt"].iter().zip(text(&model)) {
            scene.write(&format!("{place}/{name}"), content);
        }
        scene.write_photos(&model);
        let data = load(&scene).unwrap();
        assert_eq!((data.all_views().len(), data.points.len()), (2, 0), "{place}");
    }
    // The directory of the model itself.
    let scene = binary_scene(&model);
    assert!(Dataset::load(scene.at("sparse/0"), &LoadOptions::default()).is_ok());
}

#[test]
fn every_prefix_of_a_binary_file_is_an_error() {
    let model = small_model(3);
    for (index, file) in ["cameras.bin", "images.bin", "points3D.bin"].into_iter().enumerate() {
        let scene = binary_scene(&model);
        let whole = binary(&model)[index].clone();
        for end in 0..whole.len() {
            scene.write(&format!("sparse/0/{file}"), &whole[..end]);
            assert_says(&load(&scene).unwrap_err(), file, &["at byte", "bytes"]);
        }
        scene.write(&format!("sparse/0/{file}"), [&whole[..], b"x"].concat());
        assert_says(&load(&scene).unwrap_err(), file, &["1 bytes follow"]);
    }
}

#[test]
fn every_changed_byte_is_survived() {
    let model = small_model(2);
    for (index, file) in ["cameras.bin", "images.bin", "points3D.bin"].into_iter().enumerate() {
        let scene = binary_scene(&model);
        let whole = binary(&model)[index].clone();
        for i in 0..whole.len() {
            let mut changed = whole.clone();
            changed[i] ^= 0xff;
            scene.write(&format!("sparse/0/{file}"), changed);
            // Any answer but a panic or an allocation of what a damaged number asks for.
            drop(load(&scene));
        }
    }
}

#[test]
fn declared_counts_are_not_believed() {
    let model = small_model(2);
    for (index, file) in ["cameras.bin", "images.bin", "points3D.bin"].into_iter().enumerate() {
        for count in [u64::MAX, 1 << 40, 1000] {
            let scene = binary_scene(&model);
            let mut content = binary(&model)[index].clone();
            content[..8].copy_from_slice(&count.to_le_bytes());
            scene.write(&format!("sparse/0/{file}"), content);
            assert_says(&load(&scene).unwrap_err(), file, &["at byte 0", &count.to_string(), "at most"]);
        }
    }
}

#[test]
fn every_prefix_of_a_text_file_is_survived() {
    let model = small_model(2);
    for (index, file) in ["cameras.txt", "images.txt", "points3D.txt"].into_iter().enumerate() {
        let scene = text_scene(&model);
        let whole = text(&model)[index].clone();
        for end in 0..whole.len() {
            scene.write(&format!("sparse/0/{file}"), &whole[..end]);
            if let Err(error) = load(&scene) {
                assert!(error.hint().is_some(), "{error}");
            }
        }
    }
}

#[test]
fn text_errors_name_the_line_and_what_is_expected() {
    let model = small_model(2);
    for (file, content, words) in [
        ("cameras.txt", "# c\n1 PINHOLE 24 sixteen 20 20 12 8\n", vec!["line 2", "`sixteen`", "an image height"]),
        ("cameras.txt", "1 PINHOLE 24 16 20 20 12\n", vec!["line 1", "parameter 4 of 4 of PINHOLE"]),
        ("cameras.txt", "1 PINHOLE 24 16 20 20 12 8 9\n", vec!["line 1", "`9` follows"]),
        ("cameras.txt", "1 PINHOLE 24 16 0 20 12 8\n", vec!["camera 1", "fx = 0"]),
        ("cameras.txt", "1 PINHOLE 24 16 NaN 20 12 8\n", vec!["camera 1", "finite"]),
        ("cameras.txt", "1 PINHOLE 0 16 20 20 12 8\n", vec!["camera 1", "width 0"]),
        ("cameras.txt", "1 PINHOLE 2 2 9 9 1 1\n1 PINHOLE 2 2 9 9 1 1\n", vec!["line 2", "declared twice"]),
        ("images.txt", "1 1 0 0 0 0 0 0 9 a.png\n\n", vec!["line 1", "a.png", "camera 9"]),
        ("images.txt", "1 0 0 0 0 0 0 0 1 a.png\n\n", vec!["a.png", "quaternion"]),
        ("images.txt", "1 1 NaN 0 0 0 0 0 1 a.png\n\n", vec!["a.png", "quaternion"]),
        ("images.txt", "1 1 0 0 0 inf 0 0 1 a.png\n\n", vec!["a.png", "translation"]),
        ("images.txt", "1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 0 0 0 1 a.png\n\n", vec!["line 3", "registered twice"]),
        ("images.txt", "1 1 0 0 0 0 0 0 1\n\n", vec!["empty name"]),
        ("points3D.txt", "1 0 0 0 1 2 300 0.5\n", vec!["line 1", "`300`", "0 to 255"]),
    ] {
        let scene = text_scene(&model);
        scene.write(&format!("sparse/0/{file}"), content);
        assert_says(&load(&scene).unwrap_err(), file, &words);
    }
    let scene = text_scene(&model);
    scene.write("sparse/0/images.txt", b"1 1 0 0 0 0 0 0 1 \xff\xfe.png\n");
    assert_says(&load(&scene).unwrap_err(), "images.txt", &["line 1", "UTF-8"]);
}

#[test]
fn windows_line_ends_and_byte_order_marks_are_read() {
    let model = small_model(3);
    let scene = text_scene(&model);
    for (name, content) in ["cameras.txt", "images.txt", "points3D.txt"].iter().zip(text(&model)) {
        scene.write(&format!("sparse/0/{name}"), format!("\u{feff}{}", content.replace('\n', "\r\n")));
    }
    assert_same_model(&read_model(&scene.at("sparse/0")).unwrap().0, &model);
}

#[test]
fn unknown_camera_models_are_unsupported_and_named() {
    let model = small_model(2);
    let scene = text_scene(&model);
    scene.write("sparse/0/cameras.txt", "3 RAD_TAN_THIN_PRISM_FISHEYE 24 16 20 20 12 8\n");
    let error = load(&scene).unwrap_err();
    assert!(matches!(error, Error::Unsupported { .. }));
    assert_says(&error, "cameras.txt", &["camera 3", "`RAD_TAN_THIN_PRISM_FISHEYE`", "SIMPLE_RADIAL", "OPENCV"]);
    let scene = binary_scene(&model);
    let mut cameras = binary(&model)[0].clone();
    cameras[12..16].copy_from_slice(&42_i32.to_le_bytes());
    scene.write("sparse/0/cameras.bin", cameras);
    let error = load(&scene).unwrap_err();
    assert!(matches!(error, Error::Unsupported { .. }));
    assert_says(&error, "cameras.bin", &["camera 1", "number 42", "OPENCV"]);
}

#[test]
fn every_camera_model_of_colmap_survives_both_formats() {
    for lens_model in LensModel::ALL {
        let mut model = small_model(2);
        let lens = model.cameras.get_mut(&7).unwrap();
        let mut coefficients = [0.01, -0.02, 0.001, 0.002, 0.003, 0.004, 0.005, 0.006];
        coefficients[lens_model.coefficient_names().len()..].fill(0.0);
        *lens = gazesplat_core::camera::distortion::LensDistortion::new(
            lens_model,
            [32, 20],
            [30.0, if lens_model.has_single_focal() { 30.0 } else { 31.0 }],
            [16.0, 10.0],
            coefficients,
        );
        assert_same_model(&read_model(&binary_scene(&model).at("sparse/0")).unwrap().0, &model);
        assert_same_model(&read_model(&text_scene(&model).at("sparse/0")).unwrap().0, &model);
    }
}

#[test]
fn missing_parts_are_named_with_a_hint() {
    let error = Dataset::load("no/such/scene", &LoadOptions::default()).unwrap_err();
    assert_says(&error, "no/such/scene", &["cannot read"]);

    let scene = Scene::new();
    assert_says(&load(&scene).unwrap_err(), scene.path().to_str().unwrap(), &["sparse/0", "transforms.json"]);
    let file = scene.write("notes.txt", "hello");
    assert_says(&Dataset::load(file, &LoadOptions::default()).unwrap_err(), "notes.txt", &["not a scene"]);

    let model = small_model(4);
    let scene = binary_scene(&model);
    std::fs::remove_file(scene.at("sparse/0/images.bin")).unwrap();
    assert_says(&load(&scene).unwrap_err(), "images.bin", &["cannot read"]);

    let scene = binary_scene(&model);
    std::fs::remove_file(scene.at("sparse/0/cameras.bin")).unwrap();
    std::fs::create_dir(scene.at("sparse/0/cameras.bin")).unwrap();
    assert_says(&load(&scene).unwrap_err(), "cameras.bin", &["directory"]);

    for scene in [binary_scene(&small_model(0)), text_scene(&small_model(0))] {
        assert_says(&load(&scene).unwrap_err(), "sparse/0", &["no registered views"]);
    }

    let scene = binary_scene(&model);
    std::fs::remove_file(scene.at("images/photo 03.JPG")).unwrap();
    std::fs::remove_file(scene.at("images/photo 01.JPG")).unwrap();
    assert_says(&load(&scene).unwrap_err(), "photo 01.JPG", &["2 of the 4"]);

    let scene = binary_scene(&model);
    std::fs::rename(scene.at("images"), scene.at("images_4")).unwrap();
    let error = load(&scene).unwrap_err();
    assert_says(&error, "images`", &["missing"]);
    assert!(error.hint().unwrap().contains("data.images=images_4"));
    let options = LoadOptions { images: Some("images_4".into()), ..LoadOptions::default() };
    assert_eq!(Dataset::load(scene.path(), &options).unwrap().all_views().len(), 4);
}

#[test]
fn points_may_be_missing_or_not_finite() {
    let mut model = small_model(2);
    model.points.positions[1][2] = f32::NAN;
    model.points.positions[3][0] = f32::INFINITY;
    for scene in [binary_scene(&model), text_scene(&model)] {
        let data = load(&scene).unwrap();
        assert_eq!(data.points.len(), 3);
        assert!(data.warnings[0].contains("2 sparse points"), "{:?}", data.warnings);
    }
    let scene = binary_scene(&small_model(2));
    std::fs::remove_file(scene.at("sparse/0/points3D.bin")).unwrap();
    assert!(load(&scene).unwrap().points.is_empty());
}

#[test]
fn intrinsics_follow_photographs_of_another_size() {
    let model = small_model(2);
    let scene = binary_scene(&model);
    scene.write_image("images_2/photo 00.png", [12, 8]);
    scene.write_image("images_2/photo 01.JPG", [16, 10]);
    let options = LoadOptions { images: Some("images_2".into()), ..LoadOptions::default() };
    let data = Dataset::load(scene.path(), &options).unwrap();
    let views = data.all_views();
    let pinhole = views[0].camera.intrinsics;
    assert_eq!((pinhole.width, pinhole.height, pinhole.fx, pinhole.cx), (12, 8, 10.25, 6.0));
    let lens = views[1].distortion.unwrap();
    assert_eq!((lens.width, lens.height, lens.fy), (16, 10, 15.25));
    scene.write_image("images_2/photo 00.png", [8, 12]);
    let error = Dataset::load(scene.path(), &options).unwrap_err();
    assert_says(&error, "photo 00.png", &["8 × 12", "24 × 16"]);
}

#[test]
fn longer_side_is_limited_and_intrinsics_follow() {
    let scene = binary_scene(&small_model(2));
    let options = LoadOptions { max_side: 12, ..LoadOptions::default() };
    let data = Dataset::load(scene.path(), &options).unwrap();
    let pinhole = data.all_views()[0].camera.intrinsics;
    assert_eq!((pinhole.width, pinhole.height, pinhole.fx, pinhole.cy), (12, 8, 10.25, 4.0));
}

#[test]
fn of_several_models_the_largest_is_used_aloud() {
    for base in ["sparse", "colmap/sparse"] {
        let scene = Scene::new();
        let whole = small_model(7);
        let part = |n: usize| ColmapModel { images: whole.images[..n].to_vec(), ..whole.clone() };
        for (number, model) in [(0, part(2)), (1, part(5)), (2, part(5)), (10, part(3))] {
            let is_text = number == 1;
            if is_text {
                for (name, content) in ["cameras.txt", "images.txt", "points3D.txt"].iter().zip(text(&model)) {
                    scene.write(&format!("{base}/{number}/{name}"), content);
                }
            } else {
                for (name, content) in ["cameras.bin", "images.bin", "points3D.bin"].iter().zip(binary(&model)) {
                    scene.write(&format!("{base}/{number}/{name}"), content);
                }
            }
        }
        scene.write(&format!("{base}/3/images.bin"), "damaged");
        // Not a number, not a model.
        for (name, content) in ["cameras.bin", "images.bin"].iter().zip(binary(&whole)) {
            scene.write(&format!("{base}/aligned/{name}"), content);
        }
        std::fs::create_dir_all(scene.at(&format!("{base}/4"))).unwrap();
        scene.write_photos(&whole);
        let data = load(&scene).unwrap();
        assert_eq!((data.all_views().len(), data.source), (5, SceneFormat::ColmapText), "{base}");
        let [said] = &data.warnings[..] else { panic!("{:?}", data.warnings) };
        for told in
            ["has 5 models", "1` with 5 registered views", "0` has 2", "2` has 5", "10` has 3", "3` cannot be read"]
        {
            assert!(said.contains(told), "{told}: {said}");
        }
        // The hint it gives works.
        let other = Dataset::load(scene.at(&format!("{base}/10")), &LoadOptions::default());
        assert_eq!(other.map(|data| (data.all_views().len(), data.warnings)).unwrap(), (3, vec![]));
    }
}

#[test]
fn names_with_blanks_and_of_any_language_are_found() {
    for is_text in [false, true] {
        let mut model = small_model(4);
        for (image, name) in
            model.images.iter_mut().zip(["zwei Wörter.png", "東京/写真 1.png", "☃ (копия).JPG", "a'b&c.png"])
        {
            image.name = name.into();
        }
        let scene = if is_text { text_scene(&model) } else { binary_scene(&model) };
        let mask = gazesplat_core::RgbImage8::filled(32, 20, [0; 3]);
        gazesplat_core::io::save_png(scene.write("masks/東京/写真 1.png.png", ""), &mask).unwrap();
        let data = load(&scene).unwrap();
        let views = data.all_views();
        let names: Vec<&str> = views.iter().map(|view| view.name.as_str()).collect();
        assert_eq!(names, ["a'b&c.png", "zwei Wörter.png", "☃ (копия).JPG", "東京/写真 1.png"]);
        for view in views {
            gazesplat_core::io::images::load_view_image(view).unwrap();
        }
        assert!(data.all_views()[3].mask_path.is_some());
    }
}

#[test]
fn calibrations_and_poses_that_cannot_be_are_named() {
    for (what, file, words) in [
        ("focal", "cameras.bin", ["camera 1 (PINHOLE)", "focal length fx = 0, expected a positive number of pixels"]),
        ("center", "cameras.bin", ["camera 1 (PINHOLE)", "expected finite numbers"]),
        ("size", "cameras.bin", ["camera 1 (PINHOLE)", "image width 0, expected 1 to 65536 pixels"]),
        ("pose", "images.bin", ["image 100 (`photo 00.JPG`)", "translation [NaN"]),
    ] {
        let mut model = small_model(2);
        let (size, focal, center) = match what {
            "focal" => ([24, 16], [0.0, 20.25], [12.0, 8.0]),
            "center" => ([24, 16], [20.5, 20.25], [f64::NAN, 8.0]),
            "size" => ([0, 16], [20.5, 20.25], [12.0, 8.0]),
            _ => ([24, 16], [20.5, 20.25], [12.0, 8.0]),
        };
        model.cameras.insert(1, gazesplat_core::camera::distortion::LensDistortion::pinhole(size, focal, center));
        if what == "pose" {
            model.images[0].camera_from_world.w_axis.x = f64::NAN;
        }
        let scene = Scene::new();
        for (name, content) in ["cameras.bin", "images.bin", "points3D.bin"].iter().zip(binary(&model)) {
            scene.write(&format!("sparse/0/{name}"), content);
        }
        assert_says(&load(&scene).unwrap_err(), file, &words);
    }
}
