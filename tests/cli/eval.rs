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
