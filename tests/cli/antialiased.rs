//! The antialiased mode from training to every command that draws, and depth maps.

use crate::support::{Place, SHORT};
use gazesplat_core::io::model;

/// A place with the small scene and a run on it that was trained antialiased.
fn place() -> Place {
    let place = Place::with_scene();
    let args = [&["train", "scene", "--out", "run", "--set", "model.antialiased=true"], SHORT.as_slice()].concat();
    place.run(&args).done();
    place
}

fn is_antialiased(place: &Place, file: &str) -> bool {
    model::load_with_report(place.path(file)).expect("readable").1.is_antialiased()
}

/// The frames of the test views that `args` draw, byte for byte.
fn frames(place: &Place, args: &[&str], out: &str) -> Vec<Vec<u8>> {
    place.run(&[&["render"], args, &["--scene", "scene", "--split", "test", "--out", out]].concat()).done();
    let files = place.list(out);
    assert_eq!(files.len(), 2, "{files:?}");
    files.iter().map(|file| std::fs::read(place.path(out).join(file)).expect("readable")).collect()
}

#[test]
fn model_says_how_it_was_trained_and_is_drawn_so() {
    let place = place();
    assert!(is_antialiased(&place, "run/point_cloud.ply"));
    assert!(place.read("run/settings.toml").contains("antialiased = true"));
    let of_run = frames(&place, &["run"], "a");
    assert!(of_run == frames(&place, &["run/point_cloud.ply"], "b"), "a PLY file alone says it too");
    let plain = frames(&place, &["run", "--antialiased=false"], "c");
    assert!(of_run != plain, "the mode changes the image");
    // What says nothing is told.
    let said = place.run(&["convert", "run", "m.splat"]).done().stderr;
    assert!(said.contains("draw `m.splat` with `--antialiased`"), "{said}");
    assert!(frames(&place, &["m.splat"], "d") != frames(&place, &["m.splat", "--antialiased"], "e"));
    place.run(&["convert", "run", "m.spz"]).done();
    assert!(is_antialiased(&place, "m.spz"));
    place.run(&["convert", "m.spz", "again.ply"]).done();
    assert!(is_antialiased(&place, "again.ply"));
    assert!(frames(&place, &["m.spz"], "f") == frames(&place, &["m.spz", "--antialiased"], "g"));

    let psnr = |more: &[&str]| -> f64 {
        let ended = place.run(&[&["eval", "run", "--scene", "scene"], more].concat()).done();
        serde_json::from_str::<serde_json::Value>(&ended.stdout).expect("JSON")["psnr"].as_f64().expect("a number")
    };
    assert_eq!(psnr(&[]), psnr(&["--antialiased"]));
    assert!(psnr(&[]) != psnr(&["--antialiased=false"]));
    assert_eq!(psnr(&["--antialiased=false"]), psnr(&["--set", "model.antialiased=false"]));
}

#[test]
fn training_and_pruning_go_on_in_the_mode_of_the_model() {
    let place = place();
    let train = |more: &[&str]| {
        let init = ["train", "scene", "--init", "run/point_cloud.ply", "--set", "train.steps=3", "--out", "on"];
        place.run(&[&init, more].concat()).done();
    };
    train(&[]);
    assert!(is_antialiased(&place, "on/point_cloud.ply"));
    train(&["--set", "model.antialiased=false", "--overwrite"]);
    assert!(!is_antialiased(&place, "on/point_cloud.ply"));
    let prune = |out: &str, more: &[&str]| {
        let brief = ["--budget", "0.001", "--quality", "0.5", "--out", out];
        place.run(&[&["prune", "run", "--scene", "scene"], brief.as_slice(), more].concat()).done();
    };
    prune("pruned", &[]);
    assert!(is_antialiased(&place, "pruned/point_cloud.ply"));
    for file in ["pruned/settings.toml", "pruned/prune.toml"] {
        assert!(place.read(file).contains("antialiased = true"), "{file}");
    }
    prune("plain", &["--antialiased=false"]);
    assert!(!is_antialiased(&place, "plain/point_cloud.ply"));
}

#[test]
fn plain_models_say_nothing() {
    let place = Place::with_run();
    assert!(!is_antialiased(&place, "run/point_cloud.ply"));
    assert!(frames(&place, &["run"], "a") == frames(&place, &["run", "--antialiased=false"], "b"));
    assert!(frames(&place, &["run"], "a") != frames(&place, &["run", "--antialiased"], "c"));
}

/// Shape and values of a NumPy file of float32.
fn npy(bytes: &[u8]) -> (String, Vec<f32>) {
    assert!(bytes.starts_with(b"\x93NUMPY\x01\x00"));
    let end = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let header = String::from_utf8(bytes[10..end].to_vec()).expect("ASCII");
    assert!(header.contains("'descr': '<f4', 'fortran_order': False"), "{header}");
    let values = bytes[end..].chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    (header, values)
}

#[test]
fn depth_lies_beside_every_image_in_world_units() {
    let place = Place::with_run();
    let draw = ["render", "run", "--scene", "scene", "--split", "test", "--out"];
    place.run(&[&draw, ["plain"].as_slice()].concat()).done();
    place.run(&[&draw, ["deep", "--depth"].as_slice()].concat()).done();
    let images = place.list("plain");
    assert_eq!(place.list("deep").len(), 2 * images.len());
    for image in images {
        let same = |dir: &str| std::fs::read(place.path(dir).join(&image)).expect("readable");
        assert!(same("plain") == same("deep"), "the image is the same without depth");
        let stem = image.strip_suffix(".png").expect("a PNG");
        let (header, values) =
            npy(&std::fs::read(place.path("deep").join(format!("{stem}_depth.npy"))).expect("readable"));
        assert!(header.contains("'shape': (48, 64)"), "{header}");
        assert_eq!(values.len(), 48 * 64);
        // The room of `synth` is some units wide, and its cameras stand in it.
        assert!(values.iter().all(|&z| (0.0..100.0).contains(&z)), "world units");
        assert!(values.iter().filter(|&&z| z > 0.1).count() > 48 * 64 / 2, "most pixels see something");
    }
    let said = place.run(&["render", "run", "--scene", "scene", "--depth", "--out", "a.y4m"]).refused();
    assert!(said.contains("holds no depth"), "{said}");
    assert!(!place.path("a.y4m").exists());
}
