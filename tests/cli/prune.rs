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

/// What does not depend on the clock of a report's lines.
fn timeless(place: &Place, file: &str) -> Vec<Value> {
    fn strip(value: &mut Value) {
        if let Some(object) = value.as_object_mut() {
            for key in ["render_ms", "elapsed_s", "ms", "speed_up", "correlation_points", "correlation_pairs_used"] {
                object.remove(key);
            }
            object.values_mut().for_each(strip);
        } else if let Some(list) = value.as_array_mut() {
            list.iter_mut().for_each(strip);
        }
    }
    let mut lines = lines(place, file);
    lines.iter_mut().for_each(strip);
    lines
}

/// Killed at three moments, one after the other, and gone on with: model and report are those of the uninterrupted run.
#[test]
fn killed_run_is_gone_on_with_to_the_same_end() {
    let place = Place::with_run();
    prune(&place, &["--out", "whole"]).done();
    let checkpoint = place.path("killed/checkpoint.safetensors");
    let report = place.path("killed/prune.jsonl");
    let num_lines = || std::fs::read_to_string(&report).map_or(0, |text| text.lines().count());
    let args = [&["prune", "run", "--scene", "scene", "--out", "killed"], BRIEF.as_slice()].concat();
    place.kill_when(&args, || checkpoint.is_file());
    assert!(checkpoint.is_file(), "killed at the first checkpoint, long before the end");
    let said = prune(&place, &["--out", "killed"]).refused();
    assert!(said.contains("holds an interrupted run") && said.contains("--resume"), "{said}");
    let said = prune(&place, &["--out", "killed", "--resume", "--set", "prune.share=0.5"]).refused();
    assert!(said.contains("prune.share = 0.02, now 0.5"), "{said}");
    let said = prune(&place, &["--out", "killed", "--resume", "--set", "loss.hvsq.weight=2"]).refused();
    assert!(said.contains("loss.hvsq.weight = 0.0, now 2.0"), "{said}");
    let resumed = [args.as_slice(), &["--resume"]].concat();
    for at_least in [4, 7] {
        place.kill_when(&resumed, || num_lines() >= at_least);
        assert!(checkpoint.is_file(), "killed at line {at_least} of the report, before the end");
    }
    let text = std::fs::read(&report).expect("readable");
    std::fs::write(&report, &text[..10]).expect("writable");
    let said = prune(&place, &["--out", "killed", "--resume"]).refused();
    assert!(said.contains("has 10 bytes, the checkpoint knows of"), "{said}");
    std::fs::write(&report, text).expect("writable");
    let said = prune(&place, &["--out", "killed", "--resume"]).done().stderr;
    assert!(said.contains("resuming `killed` at step "), "{said}");
    let model = |run: &str| std::fs::read(place.path(&format!("{run}/point_cloud.ply"))).expect("readable");
    assert!(model("killed") == model("whole"));
    assert_eq!(timeless(&place, "killed/prune.jsonl"), timeless(&place, "whole/prune.jsonl"));
    let said = prune(&place, &["--out", "killed", "--resume"]).refused();
    assert!(said.contains("the run in it is finished"), "{said}");
}

#[cfg(unix)]
#[test]
fn interrupt_leaves_a_checkpoint_and_says_how_to_go_on() {
    use std::process::{Command, Stdio};
    let place = Place::with_run();
    let child = Command::new(assert_cmd::cargo::cargo_bin!("gazesplat"))
        .args(["prune", "run", "--scene", "scene", "--out", "out", "--budget", "50"])
        .current_dir(place.path("."))
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    // The first checkpoint shows that the loop runs; a budget of 50 takes hours.
    let checkpoint = place.path("out/checkpoint.safetensors");
    for _ in 0..3000 {
        if checkpoint.is_file() {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    let status = Command::new("kill").args(["-INT", &child.id().to_string()]).status().expect("kill");
    let output = child.wait_with_output().expect("ends");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(status.success() && output.status.success(), "{said}");
    assert!(said.contains("go on with the same command and `--out out --resume`"), "{said}");
    assert!(checkpoint.is_file() && !place.path("out/point_cloud.ply").exists());
}

#[test]
fn studies_write_their_tables_and_plots() {
    let place = Place::with_run();
    let args = ["bench", "prune-curve", "run", "--scene", "scene", "--criteria", "ce,opacity", "--keep", "0.5,0.2"];
    let more = ["--fine-tune", "5", "--repeats", "1", "--out", "curve"];
    place.run(&[args.as_slice(), &more].concat()).done();
    let files = ["latency.svg", "prune_curve.csv", "prune_curve.json", "quality_over_time.svg"];
    assert_eq!(place.list("curve"), files);
    assert_eq!(place.read("curve/prune_curve.csv").lines().count(), 6, "header, dense, two criteria of two shares");
    let said = place.run(&[args.as_slice(), &["--keep", "1.5"]].concat()).refused();
    assert!(said.contains("found 1.5"), "{said}");
    let args =
        ["bench", "ablation", "run", "--scene", "scene", "--set", "prune.budget=0.001", "--set", "guard.loss=0.2"];
    place.run(&[args.as_slice(), &["--repeats", "1", "--out", "parts"]].concat()).done();
    let csv = place.read("parts/ablation.csv");
    let names: Vec<&str> = csv.lines().skip(1).filter_map(|line| line.split(',').next()).collect();
    assert_eq!(names, ["dense", "SD only", "SD + CE"]);
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
    let pools = ["--set", "guard.hvsq.at_most=1", "--set", "guard.hvsq.pooling_px=65"];
    let said = prune(&place, &[&["--out", "none"], pools.as_slice()].concat()).refused();
    assert!(said.contains("`guard.hvsq.pooling_px` and the photograph"), "{said}");
    let said = prune(&place, &["--out", "none", "--set", "guard.hvsq.at_most=1e-12"]);
    assert!(said.code == 2 && said.stderr.contains("hvsq@3 of at most 1.000e-12"), "{}", said.stderr);
    let said = place.run(&["prune", "run", "--scene", "scene", "--out", "run", "--overwrite"]).refused();
    assert!(said.contains("is the dense model itself"), "{said}");
    assert!(place.path("run/point_cloud.ply").is_file());
    let said = place.run(&["prune", "run"]);
    assert!(said.code == 2 && said.stderr.contains("--scene"), "{}", said.stderr);
}
