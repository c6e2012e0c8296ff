//! Real captures; skipped aloud where they are not present.

use gazesplat_core::camera::distortion::LensModel;
use gazesplat_core::dataset::{LoadOptions, SceneFormat};
use gazesplat_core::io::images::load_view_image;
use gazesplat_core::{Dataset, RgbImage8};
use gazesplat_testkit::data_path;

fn load(path: impl AsRef<std::path::Path>) -> Dataset {
    Dataset::load(path, &LoadOptions::default()).unwrap()
}

fn names(views: &[gazesplat_core::View]) -> Vec<&str> {
    views.iter().map(|view| view.name.as_str()).collect()
}

fn psnr(a: &RgbImage8, b: &RgbImage8) -> f64 {
    assert_eq!((a.width, a.height), (b.width, b.height));
    let squares = a.data.iter().zip(&b.data).map(|(&a, &b)| f64::from(a.abs_diff(b)).powi(2)).sum::<f64>();
    10.0 * (255.0 * 255.0 * a.data.len() as f64 / squares).log10()
}

#[test]
fn fox_is_the_same_scene_from_colmap_and_from_transforms() {
    let Some(path) = data_path("fox") else { return };
    let (colmap, transforms) = (load(&path), load(path.join("transforms.json")));
    assert_eq!((colmap.source, transforms.source), (SceneFormat::ColmapBinary, SceneFormat::Transforms));
    assert_eq!((colmap.train.len(), colmap.test.len(), colmap.points.len()), (43, 7, 13302));
    assert_eq!(
        names(&colmap.test),
        ["0001.jpg", "0012.jpg", "0027.jpg", "0042.jpg", "0073.jpg", "0089.jpg", "0110.jpg"]
    );
    assert!(colmap.warnings.is_empty() && transforms.warnings.is_empty());
    for (a, b) in colmap.all_views().into_iter().zip(transforms.all_views()) {
        assert_eq!(a.name, b.name);
        assert!(a.camera.camera_from_world.abs_diff_eq(b.camera.camera_from_world, 1e-4), "{}", a.name);
        let (p, q) = (a.camera.intrinsics, b.camera.intrinsics);
        assert_eq!((p.width, p.height), (q.width, q.height));
        assert!((p.fx - q.fx).abs() < 1e-3 && (p.fy - q.fy).abs() < 1e-3 && (p.cx - q.cx).abs() < 1e-3);
    }
    assert!((colmap.scene_extent() - transforms.scene_extent()).abs() < 1e-3);
    let options = LoadOptions { max_side: 480, ..LoadOptions::default() };
    let small = Dataset::load(&path, &options).unwrap();
    let image = load_view_image(&small.test[0]).unwrap();
    assert_eq!((image.image.width, image.image.height, image.mask), (269, 480, None));
}

#[test]
fn fox_distorted_undistorts_to_what_colmap_made_of_it() {
    let (Some(distorted), Some(reference)) = (data_path("fox_distorted"), data_path("fox")) else { return };
    let text = load(&distorted);
    assert_eq!((text.source, text.points.len(), text.all_views().len()), (SceneFormat::ColmapText, 1771, 6));
    let reference = load(reference);
    for view in text.all_views() {
        let lens = view.distortion.expect("the capture is distorted");
        assert_eq!((lens.model, lens.width), (LensModel::OpenCv, 1080));
        assert_eq!((view.camera.intrinsics.width, view.camera.intrinsics.height), (1062, 1894));
        // `fox` holds COLMAP's undistorted photographs, reduced with another filter and compressed.
        let expected = reference.all_views().into_iter().find(|v| v.name == view.name).unwrap();
        let mut small = view.clone();
        small.camera.intrinsics = view.camera.intrinsics.resized(359, 640);
        let found = load_view_image(&small).unwrap();
        let psnr = psnr(&found.image, &load_view_image(expected).unwrap().image);
        println!("{}: {psnr:.2} dB", view.name);
        assert!(psnr > 33.0, "{}: {psnr}", view.name);
        assert_eq!(found.mask, None);
        assert!(view.camera.position().distance(expected.camera.position()) < 0.05);
    }
    let transforms = load(distorted.join("transforms.json"));
    assert_eq!(transforms.all_views().len(), 6);
    let lens = transforms.test[0].distortion.expect("the capture is distorted");
    assert_eq!((lens.fx, lens.coefficients[0], lens.height), (1375.52, 0.0578421, 1920));
}

#[test]
fn lego_has_alpha_and_its_own_test_views() {
    let Some(path) = data_path("lego") else { return };
    let data = load(path);
    assert_eq!((data.source, data.train.len(), data.test.len()), (SceneFormat::NerfSynthetic, 87, 13));
    assert!(data.points.is_empty());
    let pinhole = data.train[0].camera.intrinsics;
    assert!((pinhole.fx - 277.78).abs() < 0.01 && (pinhole.width, pinhole.height) == (200, 200));
    let image = load_view_image(&data.test[0]).unwrap();
    assert_eq!(image.alpha.as_ref().unwrap()[0], 0);
    assert_eq!(image.composited([1.0; 3]).pixel(0, 0), [255, 255, 255]);
    // Blender puts the object at the origin: every camera looks at it.
    for view in data.all_views() {
        assert!(view.camera.forward().dot(-view.camera.position().normalize()) > 0.95, "{}", view.name);
    }
}

#[test]
fn banana_keeps_its_upper_case_names() {
    let Some(path) = data_path("banana") else { return };
    let data = load(path);
    assert_eq!((data.train.len(), data.points.len()), (12, 6281));
    assert_eq!(names(&data.test), ["DSC_0423.JPG", "DSC_0432.JPG"]);
    assert_eq!(load_view_image(&data.train[0]).unwrap().image.width, 480);
}

#[test]
fn model_plush_has_views_without_a_reconstruction() {
    let Some(path) = data_path("model_plush") else { return };
    let data = load(path);
    assert_eq!((data.source, data.all_views().len(), data.points.len()), (SceneFormat::Transforms, 24, 0));
    assert_eq!(data.test[0].camera.intrinsics.fx, 450.0);
    assert_eq!(load_view_image(&data.test[0]).unwrap().image.height, 300);
}

#[test]
fn remaining_captures_load() {
    for (name, num_views) in [("alexander", 53), ("lund_street", 29), ("model_flowers", 24)] {
        let Some(path) = data_path(name) else { continue };
        let data = load(path);
        assert_eq!((data.all_views().len(), data.warnings.len()), (num_views, 0), "{name}");
        assert!(data.scene_extent() > 0.0);
    }
}
