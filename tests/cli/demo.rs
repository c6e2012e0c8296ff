//! `gazesplat demo`: everything it makes, and that it spares what is there.

use crate::support::Place;
use std::fs;

#[test]
fn demo_leaves_scene_model_video_and_report() {
    let place = Place::new();
    let told = place.run(&["demo", "--quick", "--out", "out"]).done();
    assert_eq!(told.stdout, "");
    for name in ["scene/transforms.json", "orbit.json", "orbit.y4m", "metrics.jsonl", "settings.toml", "eval.json"] {
        assert!(place.path("out").join(name).exists(), "{name}");
    }
    assert!(place.path("out/point_cloud.ply").exists());
    let report = place.read("out/report.html");
    assert!(report.contains("Fly-through") && report.contains("after 400 steps"), "the report tells what was done");
    assert!(told.stderr.contains(" test views"), "{}", told.stderr);
    let num_measured = place.read("out/metrics.jsonl").matches("\"test\"").count();
    assert!(num_measured >= 4, "a curve of {num_measured} points");

    let said = place.run(&["demo", "--quick", "--out", "out"]).refused();
    assert!(said.contains("`out` already holds") && said.contains("--overwrite"), "{said}");
}

#[test]
fn demo_spares_a_scene_and_a_file() {
    let place = Place::with_scene();
    let before = place.list("scene/images");
    let said = place.run(&["demo", "--quick", "--out", "."]).refused();
    assert!(said.contains("already holds a scene") && said.contains("--overwrite"), "{said}");
    assert_eq!(place.list("scene/images"), before);
    fs::write(place.path("file"), "in the way").expect("writable");
    let said = place.run(&["demo", "--quick", "--out", "file", "--overwrite"]).refused();
    assert!(said.contains("`file` is a file") && said.contains("--out"), "{said}");
    assert_eq!(place.read("file"), "in the way");
}
