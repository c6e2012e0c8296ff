//! `gazesplat eval`: the same figures as training gave, as data.

use crate::support::{Place, SHORT, write_lpips_weights};
use serde_json::Value;

#[test]
fn run_is_measured_as_it_was_trained() {
    let place = Place::with_run();
    let ended = place.run(&["eval", "run", "--scene", "scene"]).done();
    assert_eq!(ended.stdout, place.read("run/eval.json"));
    assert!(ended.stderr.contains("mean"), "{}", ended.stderr);
}

#[test]
fn settings_and_split_apply_to_a_plain_model() {
    let place = Place::with_run();
    let args = [
        "eval",
        "run/point_cloud.ply",
        "--scene",
        "scene",
        "--split",
        "all",
        "--set",
        "data.max_side=32",
        "--out",
        "e.json",
    ];
    let ended = place.run(&args).done();
    let eval: Value = serde_json::from_str(&ended.stdout).expect("JSON");
    assert_eq!(eval["views"].as_array().map(Vec::len), Some(9));
    assert_eq!(place.read("e.json"), ended.stdout);
}

#[test]
fn quality_below_the_floor_is_status_1() {
    let place = Place::with_run();
    let ended = place.run(&["eval", "run", "--scene", "scene", "--min-psnr", "90"]);
    assert_eq!(ended.code, 1);
    assert!(ended.stderr.contains("check failed: mean PSNR is "), "{}", ended.stderr);
    assert!(serde_json::from_str::<Value>(&ended.stdout).is_ok(), "the figures are given all the same");
    place.run(&["eval", "run", "--scene", "scene", "--min-psnr", "3"]).done();
}

#[test]
fn split_without_views_is_refused() {
    let place = Place::with_run();
    let said = place.run(&["eval", "run", "--scene", "scene", "--set", "data.test_every=0"]).refused();
    assert!(said.contains("`scene` has no test views"), "{said}");
}

#[test]
fn closed_pipe_is_no_failure() {
    use std::process::{Command, Stdio};
    let place = Place::with_run();
    let mut child = Command::new(assert_cmd::cargo::cargo_bin!("gazesplat"))
        .args(["info", "run"])
        .current_dir(place.path("."))
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    drop(child.stdout.take());
    let output = child.wait_with_output().expect("ends");
    assert!(output.status.success(), "{:?}", output.status);
    assert_eq!(String::from_utf8_lossy(&output.stderr), "");
}

#[test]
fn renders_and_error_maps_are_saved() {
    let place = Place::with_run();
    let plain = place.run(&["eval", "run", "--scene", "scene"]).done();
    let ended = place.run(&["eval", "run", "--scene", "scene", "--save-images", "new/looks"]).done();
    assert_eq!(ended.stdout, plain.stdout, "the figures are the same");
    let names = ["view_000.png", "view_008.png"];
    for kind in ["renders", "errors", "flip"] {
        assert_eq!(place.list(&format!("new/looks/{kind}")), names, "{kind}");
    }
    let read = |path: String| gazesplat_core::io::images::decode_rgb(place.path(&path)).expect("a PNG");
    for name in names {
        let (photo, render) = (read(format!("scene/images/{name}")), read(format!("new/looks/renders/{name}")));
        let errors = read(format!("new/looks/errors/{name}"));
        assert_eq!((errors.width, errors.height), (photo.width, photo.height));
        let flip = read(format!("new/looks/flip/{name}"));
        assert_eq!((flip.width, flip.height), (photo.width, photo.height));
        assert!(flip.data.chunks_exact(3).any(|pixel| pixel != &flip.data[..3]), "it is no flat colour");
        // Brightness follows the difference: the brightest pixel of the map is one of the worst.
        let sum = |image: &gazesplat_core::RgbImage8, i: usize| {
            image.data[3 * i..3 * i + 3].iter().map(|&v| u32::from(v)).sum::<u32>()
        };
        let difference = |i: usize| -> u32 {
            (0..3).map(|c| u32::from(photo.data[3 * i + c].abs_diff(render.data[3 * i + c]))).sum()
        };
        let brightest = (0..photo.num_pixels()).max_by_key(|&i| sum(&errors, i)).expect("pixels");
        let darkest = (0..photo.num_pixels()).min_by_key(|&i| sum(&errors, i)).expect("pixels");
        assert!(difference(brightest) > difference(darkest), "{name}");
    }
    place.write("file", "mine");
    let said = place.run(&["eval", "run", "--scene", "scene", "--save-images", "file"]).refused();
    assert!(said.contains("file"), "{said}");
    assert_eq!(place.read("file"), "mine");
}

/// Means are those of the views.
#[track_caller]
fn assert_mean(eval: &Value, metric: &str) {
    let views = eval["views"].as_array().expect("views");
    let values: Vec<f64> = views.iter().map(|v| v[metric].as_f64().expect("a number")).collect();
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let found = eval[metric].as_f64().expect("a number");
    assert!((found - mean).abs() < 1e-12 && found > 0.0, "{metric}: {found}, mean of {values:?}");
}

#[test]
fn flip_stands_beside_psnr_and_ssim() {
    let place = Place::with_run();
    let ended = place.run(&["eval", "run", "--scene", "scene"]).done();
    let eval: Value = serde_json::from_str(&ended.stdout).expect("JSON");
    for metric in ["psnr", "ssim", "flip"] {
        assert_mean(&eval, metric);
    }
    assert!(eval["flip"].as_f64().is_some_and(|flip| flip < 1.0) && eval.get("lpips").is_none(), "{eval}");
    assert!(ended.stderr.contains("FLIP") && !ended.stderr.contains("LPIPS"), "{}", ended.stderr);
    // FLIP of the photographs themselves, drawn to white, is larger: it is measured of the images, not made up.
    let white = place.run(&["eval", "run", "--scene", "scene", "--set", "render.near=1000"]).done();
    let white: Value = serde_json::from_str(&white.stdout).expect("JSON");
    assert!(white["flip"].as_f64() > eval["flip"].as_f64(), "{white}");
}

#[test]
fn lpips_is_measured_where_its_weights_are_given() {
    let place = Place::with_run();
    write_lpips_weights(&place, "w.safetensors", |_, _| ());
    let ended = place.run(&["eval", "run", "--scene", "scene", "--lpips-weights", "w.safetensors"]).done();
    let eval: Value = serde_json::from_str(&ended.stdout).expect("JSON");
    assert_mean(&eval, "lpips");
    assert!(ended.stderr.contains("LPIPS"), "{}", ended.stderr);
    let set = "eval.lpips_weights=w.safetensors";
    let by_setting = place.run(&["eval", "run", "--scene", "scene", "--set", set]).done();
    assert_eq!(by_setting.stdout, ended.stdout);
    // A training measures with them, too, and `eval` of its run finds them in its settings.
    place.run(&[&["train", "scene", "--out", "with", "--set", set], SHORT.as_slice()].concat()).done();
    let trained: Value = serde_json::from_str(&place.read("with/eval.json")).expect("JSON");
    assert_mean(&trained, "lpips");
    assert_eq!(place.run(&["eval", "with", "--scene", "scene"]).done().stdout, place.read("with/eval.json"));
    // The weights measure; they change nothing of the model.
    let model = |run: &str| std::fs::read(place.path(run).join("point_cloud.ply")).expect("readable");
    assert!(model("with") == model("run"));
}

#[test]
fn weights_of_lpips_that_cannot_be_used_are_refused() {
    let place = Place::with_run();
    let refused = |name: &str| {
        let said = place.run(&["eval", "run", "--scene", "scene", "--lpips-weights", name]).refused();
        assert!(said.contains(name), "{said}");
        said
    };
    assert!(refused("none.safetensors").contains("cannot be read"));
    place.write("text.safetensors", "these are no weights");
    assert!(refused("text.safetensors").contains("no safetensors file"));
    write_lpips_weights(&place, "missing.safetensors", |header, _| {
        let tensor = header["net.slice3.12.bias"].take();
        let header = header.as_object_mut().expect("an object");
        header.remove("net.slice3.12.bias");
        header.insert("net.slice3.13.bias".to_owned(), tensor);
    });
    let said = refused("missing.safetensors");
    assert!(
        said.contains("`features.12.bias` is missing, or `net.slice3.12.bias`") && said.contains("README"),
        "{said}"
    );
    write_lpips_weights(&place, "shape.safetensors", |header, _| {
        header["lin4.model.1.weight"]["shape"] = serde_json::json!([2, 1, 1, 1]);
    });
    assert!(refused("shape.safetensors").contains("has the shape [2, 1, 1, 1], expected [1, 2, 1, 1]"));
    write_lpips_weights(&place, "nan.safetensors", |_, values| values[5] = f32::NAN);
    assert!(refused("nan.safetensors").contains("value 5 of `net.slice1.0.weight` is NaN"));
    // Before a training, not after it.
    let args = ["train", "scene", "--out", "new", "--set", "eval.lpips_weights=nan.safetensors"];
    let said = place.run(&[args.as_slice(), SHORT.as_slice()].concat()).refused();
    assert!(said.contains("nan.safetensors") && !place.path("new").exists(), "{said}");
}
