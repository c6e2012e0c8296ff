//! `gazesplat prune`: what it leaves behind, interruption, refusals.

use crate::support::{Ended, Place};
use serde_json::Value;

/// A few steps: some seconds.
const BRIEF: [&str; 6] = ["--budget", "0.001", "--quality", "0.2", "--set", "prune.adapt_iterations=10000"];

fn prune(place: &Place, more: &[&str]) -> Ended {
    place.run(&[&["prune", "run", "--scene", "scene"], BRIEF.as_slice(), more].concat())
}

fn lines(place: &Place, file: &str) -> Vec<Value> {
    place.read(file).lines().map(|l| serde_json::from_str(l).expect("JSON")).collect()
}

#[test]
fn run_leaves_model_report_and_curve_and_no_scaffolding() {
    let place = Place::with_run();
    let ended = prune(&place, &["--out", "pruned"]).done();
    let result: Value = serde_json::from_str(&ended.stdout).expect("JSON");
    let files = place.list("pruned");
    for file in ["eval.json", "point_cloud.ply", "prune.jsonl", "prune.toml", "report.html", "settings.toml"] {
        assert!(files.iter().any(|f| f == file), "{file} of {files:?}");
    }
    assert!(!files.iter().any(|f| f.starts_with("checkpoint") || f == "levels"), "{files:?}");
    let lines = lines(&place, "pruned/prune.jsonl");
    let phases: Vec<&str> = lines.iter().map(|l| l["phase"].as_str().expect("phase")).collect();
    assert_eq!((phases[0], phases[1], phases[phases.len() - 1]), ("settings", "reference", "result"));
    assert!(phases.contains(&"prune") && phases.contains(&"final") && phases.contains(&"adapt"), "{phases:?}");
    for line in &lines[1..lines.len() - 1] {
        for key in
            ["iteration", "points", "removed", "pairs_per_tile", "pairs_used_per_tile", "psnr", "ssim", "psnr_ref"]
        {
            assert!(line[key].is_number(), "{key}: {line}");
        }
        for key in ["ssim_ref", "gamma", "ws", "render_ms", "elapsed_s"] {
            assert!(line[key].is_number(), "{key}: {line}");
        }
        assert!(line["accepted"].is_boolean() && line["rolled_back"].is_boolean(), "{line}");
    }
    assert_eq!(lines[lines.len() - 1], result);
    assert!(result["points"].as_u64() < result["points_dense"].as_u64(), "{result}");
    let report = place.read("pruned/report.html");
    assert!(report.contains("Work of the tiles") && report.contains("work per tile"));
    // The result is a run like any other.
    place.run(&["eval", "pruned", "--scene", "scene"]).done();
}

#[test]
fn unknown_views_of_the_model_are_said() {
    let place = Place::with_run();
    let said = prune(&place, &["--out", "a"]).done().stderr;
    assert!(said.contains("the model was trained on all views: the views that judge it stay"), "{said}");
    let model = place.path("run/point_cloud.ply").display().to_string();
    let args = [&["prune", &model, "--scene", "scene", "--out", "b"], BRIEF.as_slice()].concat();
    let said = place.run(&args).done().stderr;
    assert!(said.contains("it is not known which views the model was trained on"), "{said}");
}

#[test]
fn interrupted_run_is_gone_on_with_and_not_replaced_unasked() {
    let place = Place::with_run();
    prune(&place, &["--out", "whole"]).done();
    let checkpoint = place.path("killed/checkpoint.safetensors");
    let args = [&["prune", "run", "--scene", "scene", "--out", "killed"], BRIEF.as_slice()].concat();
    place.kill_when(&args, || checkpoint.is_file());
    assert!(checkpoint.is_file(), "the run was killed at its first checkpoint, long before its end");
    let said = prune(&place, &["--out", "killed"]).refused();
    assert!(said.contains("holds an interrupted run") && said.contains("--resume"), "{said}");
    let said = prune(&place, &["--out", "killed", "--resume", "--set", "prune.share=0.5"]).refused();
    assert!(said.contains("prune.share = 0.02, now 0.5"), "{said}");
    let said = prune(&place, &["--out", "killed", "--resume"]).done().stderr;
    assert!(said.contains("resuming `killed` at step "), "{said}");
    assert_eq!(
        std::fs::read(place.path("killed/point_cloud.ply")).expect("readable"),
        std::fs::read(place.path("whole/point_cloud.ply")).expect("readable")
    );
    let timeless = |file: &str| {
        let mut lines = lines(&place, file);
        for line in &mut lines {
            for key in ["render_ms", "elapsed_s"] {
                line.as_object_mut().expect("object").remove(key);
            }
        }
        lines.pop();
        lines
    };
    assert_eq!(timeless("killed/prune.jsonl"), timeless("whole/prune.jsonl"));
}

#[test]
fn wrong_input_is_refused_with_a_reason() {
    let place = Place::with_run();
    let said = place.run(&["prune", "run", "--scene", "nowhere"]).refused();
    assert!(said.contains("nowhere"), "{said}");
    let said = prune(&place, &["--out", "none", "--resume"]).refused();
    assert!(said.contains("no run was interrupted in it"), "{said}");
    let said = prune(&place, &["--out", "none", "--set", "prune.bugdet=1"]).refused();
    assert!(said.contains("did you mean `prune.budget`?"), "{said}");
    let said = prune(&place, &["--out", "none", "--set", "prune.opacity_clamp=0.001"]).refused();
    assert!(said.contains("prune.opacity_clamp"), "{said}");
    assert!(!place.path("none").exists(), "nothing is left behind");
    let said = place.run(&["prune", "run", "--scene", "scene", "--quality", "x"]).stderr;
    assert!(said.contains("expected h, m, l, or a share"), "{said}");
    place.write("run/empty.ply", "ply\n");
    place.run(&["prune", "run/empty.ply", "--scene", "scene"]).refused();
}
