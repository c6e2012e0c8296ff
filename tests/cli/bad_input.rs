//! Damaged, missing and misplaced input: a clear error, a hint, status 2, and nothing left half-written.

use crate::support::{Place, SHORT, break_rows};
use std::fs;

/// Trains on `scene`, which must be refused without leaving a run behind.
#[track_caller]
fn refused(place: &Place) -> String {
    let said = place.run(&[&["train", "scene", "--out", "out"], SHORT.as_slice()].concat()).refused();
    assert_eq!(place.list("out"), Vec::<String>::new(), "{said}");
    said
}

/// Leaves the COLMAP reconstruction as the only cameras of the scene.
fn colmap_only() -> Place {
    let place = Place::with_scene();
    fs::remove_file(place.path("scene/transforms.json")).expect("there");
    place
}

#[test]
fn missing_directory() {
    let said = refused(&Place::new());
    assert!(said.contains("`scene`"), "{said}");
}

#[test]
fn directory_without_a_scene() {
    let place = Place::new();
    fs::create_dir(place.path("scene")).expect("writable");
    let said = refused(&place);
    assert!(said.contains("not a scene") && said.contains("sparse/0"), "{said}");
}

#[test]
fn missing_images() {
    let place = colmap_only();
    fs::remove_dir_all(place.path("scene/images")).expect("there");
    let said = refused(&place);
    assert!(said.contains("images"), "{said}");
}

#[test]
fn one_missing_image() {
    let place = colmap_only();
    let name = place.list("scene/images").remove(3);
    fs::remove_file(place.path("scene/images").join(&name)).expect("there");
    let ended = place.run(&[&["train", "scene", "--out", "out"], SHORT.as_slice()].concat());
    assert!(ended.stderr.contains(&name), "the file is named:\n{}", ended.stderr);
    assert!(ended.code == 2 || ended.stderr.contains("warning: "), "{}", ended.stderr);
}

#[test]
fn truncated_binary_model() {
    let place = colmap_only();
    // One camera is announced and ends after its number and model.
    let mut cameras = 1_u64.to_le_bytes().to_vec();
    cameras.extend([1, 0, 0, 0, 1, 0, 0, 0]);
    place.write("scene/sparse/0/cameras.bin", cameras);
    place.write("scene/sparse/0/images.bin", 9_u64.to_le_bytes());
    place.write("scene/sparse/0/points3D.bin", 0_u64.to_le_bytes());
    let said = refused(&place);
    assert!(said.contains("cameras.bin"), "{said}");
}

#[test]
fn unknown_camera_model() {
    let place = colmap_only();
    place.edit("scene/sparse/0/cameras.txt", " PINHOLE ", " CRYSTAL_BALL ");
    let said = refused(&place);
    assert!(said.contains("cameras.txt") && said.contains("CRYSTAL_BALL") && said.contains("PINHOLE"), "{said}");
}

#[test]
fn image_that_is_no_image() {
    let place = Place::with_scene();
    let name = place.list("scene/images").remove(3);
    place.write(&format!("scene/images/{name}"), "this is no photograph");
    let said = refused(&place);
    assert!(said.contains(&name), "{said}");
}

#[test]
fn image_that_ends_early() {
    let place = Place::with_scene();
    for (index, split) in [(3, "training"), (0, "test")] {
        let name = place.list("scene/images").remove(index);
        let whole = fs::read(place.path("scene/images").join(&name)).expect("readable");
        place.write(&format!("scene/images/{name}"), &whole[..whole.len() / 2]);
        let said = refused(&place);
        assert!(said.contains(&name), "{split} view:\n{said}");
        place.write(&format!("scene/images/{name}"), whole);
    }
}

#[test]
fn no_registered_views() {
    let place = colmap_only();
    place.write("scene/sparse/0/images.txt", "# Image list\n");
    let said = refused(&place);
    assert!(said.contains("images.txt") || said.contains("views"), "{said}");
}

#[test]
fn model_with_missing_attributes() {
    let place = Place::with_run();
    place.edit_bytes("run/point_cloud.ply", b"property float opacity\n", b"property float opakity\n");
    let said = place.run(&["eval", "run", "--scene", "scene"]).refused();
    assert!(said.contains("point_cloud.ply") && said.contains("opacity"), "{said}");
}

#[test]
fn model_that_ends_early() {
    let place = Place::with_run();
    let whole = fs::read(place.path("run/point_cloud.ply")).expect("readable");
    place.write("run/point_cloud.ply", &whole[..whole.len() - 100]);
    let said = place.run(&["render", "run", "--scene", "scene", "--out", "frames"]).refused();
    assert!(said.contains("point_cloud.ply"), "{said}");
    assert!(!place.path("frames").exists());
}

#[test]
fn model_without_a_usable_gaussian() {
    let place = Place::with_run();
    let refused_by_both = |model: &str| {
        for args in [["eval", model, "--scene", "scene"].as_slice(), &["render", model, "--scene", "scene"]] {
            let said = place.run(args).refused();
            assert!(said.contains(model) && said.contains("no Gaussian that can be drawn"), "{said}");
        }
        assert!(!place.path("renders").exists());
    };
    let whole = fs::read(place.path("run/point_cloud.ply")).expect("readable");
    let end = b"end_header\n";
    let data = whole.windows(end.len()).position(|w| w == end).expect("a PLY header") + end.len();
    let header = String::from_utf8_lossy(&whole[..data]).replace("element vertex 600", "element vertex 0");
    place.write("empty.ply", header);
    refused_by_both("empty.ply");
    place.write("broken.ply", whole);
    break_rows(&place, "broken.ply", usize::MAX);
    refused_by_both("broken.ply");
}

#[test]
fn model_with_some_broken_rows_is_drawn_without_them() {
    let place = Place::with_run();
    fs::copy(place.path("run/point_cloud.ply"), place.path("some.ply")).expect("writable");
    break_rows(&place, "some.ply", 3);
    for args in [["eval", "some.ply", "--scene", "scene"].as_slice(), &["render", "some.ply", "--scene", "scene"]] {
        let told = place.run(args).done().stderr;
        assert!(told.contains("warning: `some.ply`: left out 3 of 600 Gaussians"), "{told}");
    }
}

#[test]
fn missing_model() {
    let place = Place::with_scene();
    let said = place.run(&["eval", "no.ply", "--scene", "scene"]).refused();
    assert!(said.contains("`no.ply`"), "{said}");
    let said = place.run(&["eval", "scene", "--scene", "scene"]).refused();
    assert!(said.contains("`scene` holds no `point_cloud.ply`"), "{said}");
}

#[test]
fn directory_that_cannot_be_written() {
    let place = Place::with_scene();
    place.write("file", "in the way");
    let args = [&["train", "scene", "--out", "file/run"], SHORT.as_slice()].concat();
    let said = place.run(&args).refused();
    assert!(said.contains("file/run") && said.contains("--out"), "{said}");
    let said = place.run(&[&["train", "scene", "--out", "file"], SHORT.as_slice()].concat()).refused();
    assert!(said.contains("`file` is a file"), "{said}");
    assert_eq!(place.read("file"), "in the way");
}

#[test]
fn views_that_would_share_a_file() {
    let place = Place::with_run();
    fs::remove_file(place.path("scene/transforms.json")).expect("there");
    let names = place.list("scene/images");
    for (dir, name) in [("a", &names[0]), ("b", &names[1])] {
        fs::create_dir(place.path("scene/images").join(dir)).expect("writable");
        fs::rename(place.path("scene/images").join(name), place.path("scene/images").join(dir).join("same.png"))
            .expect("there");
        place.edit("scene/sparse/0/images.txt", name, &format!("{dir}/same.png"));
    }
    let said = place.run(&["render", "run", "--scene", "scene", "--out", "frames"]).refused();
    assert!(said.contains("`a/same.png` and `b/same.png`"), "{said}");
    assert!(!place.path("frames").exists());
}

/// Replaces parts of the first line of a camera, view or other record of a COLMAP text file that starts with `start`.
fn edit_record(place: &Place, name: &str, start: &str, edit: impl Fn(&mut Vec<String>)) {
    let text = place.read(name);
    let line = text.lines().find(|line| line.starts_with(start)).expect("a record");
    let mut parts: Vec<String> = line.split(' ').map(str::to_owned).collect();
    edit(&mut parts);
    place.write(name, text.replacen(line, &parts.join(" "), 1));
}

#[test]
fn camera_with_zero_focal_length() {
    let place = colmap_only();
    // CAMERA_ID MODEL WIDTH HEIGHT fx …
    edit_record(&place, "scene/sparse/0/cameras.txt", "1 PINHOLE", |parts| parts[4] = "0".to_owned());
    let said = refused(&place);
    assert!(said.contains("cameras.txt") && said.contains("focal length fx = 0, expected a positive number"), "{said}");

    let place = Place::with_scene();
    let mut transforms: serde_json::Value = serde_json::from_str(&place.read("scene/transforms.json")).expect("JSON");
    transforms["fl_x"] = 0.0.into();
    place.write("scene/transforms.json", transforms.to_string());
    fs::remove_dir_all(place.path("scene/sparse")).expect("there");
    let said = refused(&place);
    assert!(said.contains("transforms.json") && said.contains("focal length"), "{said}");
}

#[test]
fn poses_that_are_not_finite() {
    for (at, value) in [(2, "nan"), (6, "inf")] {
        let place = colmap_only();
        // IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME
        edit_record(&place, "scene/sparse/0/images.txt", "1 ", |parts| parts[at] = value.to_owned());
        let said = refused(&place);
        assert!(said.contains("images.txt") && said.contains("finite"), "{said}");
    }
    let place = Place::with_scene();
    fs::remove_dir_all(place.path("scene/sparse")).expect("there");
    let mut transforms: serde_json::Value = serde_json::from_str(&place.read("scene/transforms.json")).expect("JSON");
    transforms["frames"][1]["transform_matrix"][0][3] = "here".into();
    let written = transforms.to_string();
    for value in ["NaN", "1e999", "null"] {
        place.write("scene/transforms.json", written.replace("\"here\"", value));
        let said = refused(&place);
        assert!(said.contains("transforms.json"), "{value}:\n{said}");
    }
}

#[test]
fn mask_of_another_size() {
    let place = Place::with_scene();
    let name = place.list("scene/images").remove(3);
    fs::create_dir(place.path("scene/masks")).expect("writable");
    let mask = gazesplat_core::RgbImage8 { width: 48, height: 64, data: vec![255; 48 * 64 * 3] };
    gazesplat_core::io::save_png(place.path("scene/masks").join(&name), &mask).expect("writable");
    let said = refused(&place);
    assert!(said.contains(&format!("masks/{name}")) && said.contains("48 × 64") && said.contains("64 × 48"), "{said}");
    // A smaller mask of the same shape is one of a scaled copy, and fits.
    let mask = gazesplat_core::RgbImage8 { width: 32, height: 24, data: vec![255; 32 * 24 * 3] };
    gazesplat_core::io::save_png(place.path("scene/masks").join(&name), &mask).expect("writable");
    place.run(&[&["train", "scene", "--out", "out"], SHORT.as_slice()].concat()).done();
}
