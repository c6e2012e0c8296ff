//! `gazesplat eval`: the same figures as training gave, as data.

use crate::support::Place;
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
    assert_eq!(
        (place.list("new/looks/renders"), place.list("new/looks/errors")),
        (names.map(String::from).to_vec(), names.map(String::from).to_vec())
    );
    let read = |path: String| gazesplat_core::io::images::decode_rgb(place.path(&path)).expect("a PNG");
    for name in names {
        let (photo, render) = (read(format!("scene/images/{name}")), read(format!("new/looks/renders/{name}")));
        let errors = read(format!("new/looks/errors/{name}"));
        assert_eq!((errors.width, errors.height), (photo.width, photo.height));
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
