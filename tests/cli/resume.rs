//! `gazesplat train --resume`: killed and stopped runs end as if nothing had happened; what cannot go on is refused.

use crate::support::{Ended, Place, SHORT};
use serde_json::Value;
use std::time::{Duration, Instant};

/// A run with many checkpoints, of which two stay.
const MORE: [&str; 8] = [
    "--set",
    "train.steps=400",
    "--set",
    "train.checkpoint_every=25",
    "--set",
    "train.checkpoint_keep=2",
    "--set",
    "train.eval_every=0",
];

fn args<'a>(more: &[&'a str]) -> Vec<&'a str> {
    [&["train", "scene"], SHORT.as_slice(), MORE.as_slice(), more].concat()
}

fn train(place: &Place, more: &[&str]) -> Ended {
    place.run(&args(more))
}

/// Steps of the checkpoints in `dir`, the latest first.
fn checkpoints(place: &Place, dir: &str) -> Vec<u32> {
    let step = |name: &String| name.strip_prefix("checkpoint-")?.strip_suffix(".safetensors")?.parse().ok();
    let mut steps: Vec<u32> = place.list(dir).iter().filter_map(step).collect();
    steps.sort_by_key(|&step| std::cmp::Reverse(step));
    steps
}

fn model(place: &Place, dir: &str) -> Vec<u8> {
    std::fs::read(place.path(dir).join("point_cloud.ply")).expect("readable")
}

/// The lines of the report without what differs between two equal runs: times and memory.
fn metrics(place: &Place, dir: &str) -> Vec<Value> {
    let line = |text: &str| {
        let mut line: Value = serde_json::from_str(text).expect("JSON");
        for of_the_process in ["step_ms", "memory"] {
            line.as_object_mut().expect("an object").remove(of_the_process).expect("every line has it");
        }
        line
    };
    place.read(&format!("{dir}/metrics.jsonl")).lines().map(line).collect()
}

fn assert_same_end(place: &Place, a: &str, b: &str) {
    assert!(model(place, a) == model(place, b), "the models differ");
    assert_eq!(metrics(place, a), metrics(place, b));
    assert_eq!(place.read(&format!("{a}/eval.json")), place.read(&format!("{b}/eval.json")));
    assert!(checkpoints(place, a).is_empty() && checkpoints(place, b).is_empty(), "a finished run keeps none");
}

/// Kills at random moments from the start of the process on, three unless `GAZESPLAT_KILLS` says another number; 20 are what
/// the toolkit promises: `GAZESPLAT_KILLS=20 cargo test --release --test cli -- killed_training`.
#[test]
fn killed_training_is_gone_on_with_to_the_same_bytes() {
    let num_kills: u32 = std::env::var("GAZESPLAT_KILLS").map_or(3, |text| text.parse().expect("a number"));
    let place = Place::with_scene();
    let started = Instant::now();
    train(&place, &["--out", "whole"]).done();
    let whole = started.elapsed();
    let (fresh, resumed) = (args(&["--out", "killed"]), args(&["--out", "killed", "--resume"]));
    let go_on = || if checkpoints(&place, "killed").is_empty() { fresh.as_slice() } else { resumed.as_slice() };
    let is_finished = || checkpoints(&place, "killed").is_empty() && place.path("killed/point_cloud.ply").is_file();
    let (mut num_killed, mut random) = (0, 12_345_u32);
    while num_killed < num_kills {
        random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let moment = whole.mul_f64(0.6 * f64::from(random >> 8) / f64::from(1 << 24));
        let started = Instant::now();
        place.kill_when(go_on(), || started.elapsed() >= moment);
        if is_finished() {
            assert_same_end(&place, "killed", "whole");
            std::fs::remove_dir_all(place.path("killed")).expect("removable");
        } else {
            num_killed += 1;
        }
    }
    place.run(go_on()).done();
    assert_same_end(&place, "killed", "whole");
}

/// The poses are of the state that a checkpoint holds.
#[test]
fn killed_refinement_of_poses_ends_in_the_same_bytes() {
    let place = Place::with_scene();
    let refine = ["--set", "train.refine_poses=true", "--set", "poses.start=0"];
    let run = |out: &'static str, more: &[&'static str]| [&args(&["--out", out]), refine.as_slice(), more].concat();
    place.run(&run("whole", &[])).done();
    place.kill_when(&run("killed", &[]), || checkpoints(&place, "killed").len() == 2);
    let said = train(&place, &["--out", "killed", "--resume"]).refused();
    assert!(said.contains("train.refine_poses = true, now false"), "{said}");
    place.run(&run("killed", &["--resume"])).done();
    assert_same_end(&place, "killed", "whole");
    assert_eq!(place.read("killed/poses.json"), place.read("whole/poses.json"));
}

/// The statistic of ADC is part of a checkpoint, and so are the counts in the report.
#[test]
fn killed_training_with_adc_is_gone_on_with_to_the_same_bytes() {
    let place = Place::with_scene();
    let more = [
        "--set",
        "densify.strategy=adc",
        "--set",
        "densify.absolute_gradients=true",
        "--set",
        "densify.start=17",
        "--set",
        "densify.reset_every=110",
    ];
    let with = |out: &[&'static str]| args(&[&more, out].concat());
    place.run(&with(&["--out", "whole"])).done();
    place.kill_when(&with(&["--out", "killed"]), || checkpoints(&place, "killed").len() == 2);
    // Refinements are at step 17 and every fifth after it: each checkpoint is within an interval.
    let again: Vec<&str> = [&args(&more)[..], &["--out", "killed", "--resume"]].concat();
    place.run(&again).done();
    assert_same_end(&place, "killed", "whole");
    let last = metrics(&place, "whole").pop().expect("a line");
    assert!(last["densified"]["num_added"].as_u64() > Some(0), "{last}");
    assert!(last["densified"]["num_opacity_resets"] == 1 && last["densified"]["broken"]["far"] == 0, "{last}");
}

#[cfg(unix)]
#[test]
fn stopped_training_is_gone_on_with_to_the_same_bytes() {
    let place = Place::with_scene();
    train(&place, &["--out", "whole"]).done();
    let mut child = std::process::Command::new(assert_cmd::cargo::cargo_bin!("gazesplat"))
        .args(args(&["--out", "out"]))
        .current_dir(place.path("."))
        .stderr(std::process::Stdio::null())
        .spawn()
        .expect("the program starts");
    let started = Instant::now();
    let metrics = place.path("out/metrics.jsonl");
    while std::fs::metadata(&metrics).map_or(0, |m| m.len()) == 0 && started.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(1));
    }
    let status = std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status().expect("kill");
    assert!(status.success() && child.wait().expect("ends").success());
    assert!(place.path("out/point_cloud.ply").is_file() && !checkpoints(&place, "out").is_empty());
    let said = train(&place, &["--out", "out"]).refused();
    assert!(said.contains("holds an interrupted run") && said.contains("--resume"), "{said}");
    train(&place, &["--out", "out", "--resume"]).done();
    assert_same_end(&place, "out", "whole");
}

#[test]
fn what_cannot_go_on_is_refused_and_stays() {
    let place = Place::with_scene();
    train(&place, &["--out", "whole"]).done();
    let said = train(&place, &["--out", "whole", "--resume"]).refused();
    assert!(said.contains("holds no checkpoint: the run in it is finished") && said.contains("--init"), "{said}");
    let said = train(&place, &["--out", "none", "--resume"]).refused();
    assert!(said.contains("no run left one in it"), "{said}");
    assert!(!place.path("none").exists());
    place.kill_when(&args(&["--out", "out"]), || checkpoints(&place, "out").len() == 2);
    let steps = checkpoints(&place, "out");
    let [latest, before] = steps[..] else { panic!("killed with two checkpoints: {steps:?}") };
    let said = train(&place, &["--out", "out", "--resume", "--set", "train.seed=4"]).refused();
    assert!(said.contains("train.seed = 0, now 4"), "{said}");
    let said = train(&place, &["--out", "out", "--resume", "--set", "loss.hvsq.weight=2"]).refused();
    assert!(said.contains("loss.hvsq.weight = 0.0, now 2.0"), "{said}");
    let said = train(&place, &["--out", "out", "--resume", "--init", "whole"]).refused();
    assert!(said.contains("init = null, now "), "{said}");
    place.run(&["synth", "--out", "other", "--views", "7", "--size", "64x48", "--points", "400"]).done();
    let other = [&["train", "other"], &args(&["--out", "out", "--resume"])[2..]].concat();
    let said = place.run(&other).refused();
    assert!(said.contains("it is of a run on other views"), "{said}");
    let said = train(&place, &["--out", "out", "--resume=7"]).refused();
    assert!(said.contains("no checkpoint of step 7") && said.contains(&format!("{latest}, {before}")), "{said}");

    let file = place.path(&format!("out/checkpoint-{latest}.safetensors"));
    let bytes = std::fs::read(&file).expect("readable");
    std::fs::write(&file, &bytes[..bytes.len() / 2]).expect("writable");
    let report = place.read("out/metrics.jsonl");
    let said = train(&place, &["--out", "out", "--resume"]).refused();
    assert!(said.contains("damaged") && said.contains(&format!("`--resume={before}`")), "{said}");
    assert_eq!((checkpoints(&place, "out"), place.read("out/metrics.jsonl")), (vec![latest, before], report));
    let said = train(&place, &["--out", "out", &format!("--resume={before}")]).done().stderr;
    assert!(said.contains(&format!("resuming `out` at step {before} of 400")), "{said}");
    assert_same_end(&place, "out", "whole");
}

/// A run of 400 steps, killed when it has left a checkpoint, and the whole one beside it.
fn interrupted() -> Place {
    let place = Place::with_scene();
    train(&place, &["--out", "whole"]).done();
    place.kill_when(&args(&["--out", "out"]), || checkpoints(&place, "out").len() == 2);
    place
}

#[test]
fn checkpoint_of_another_version_is_refused_and_stays() {
    let place = interrupted();
    let latest = checkpoints(&place, "out")[0];
    let name = format!("out/checkpoint-{latest}.safetensors");
    let whole = std::fs::read(place.path(&name)).expect("readable");
    // The record is a JSON text within the JSON text of the header.
    let version = format!("\\\"version\\\":\\\"{}", env!("CARGO_PKG_VERSION"));
    let mut other = version.clone().into_bytes();
    *other.last_mut().expect("a digit") = b'x';
    place.edit_bytes(&name, version.as_bytes(), &other);
    let said = train(&place, &["--out", "out", "--resume"]).refused();
    assert!(said.contains(&name) && said.contains("it is of version "), "{said}");
    assert_eq!(checkpoints(&place, "out")[0], latest);
    place.edit_bytes(&name, b"gazesplat checkpoint 1", b"gazesplat checkpoint 9");
    let said = train(&place, &["--out", "out", "--resume"]).refused();
    assert!(said.contains("its format is `gazesplat checkpoint 9`"), "{said}");
    std::fs::write(place.path(&name), whole).expect("writable");
    train(&place, &["--out", "out", "--resume"]).done();
    assert_same_end(&place, "out", "whole");
}

/// A disk without space, as far as a shell can play one: no file may grow beyond a few blocks of 512 bytes.
#[cfg(unix)]
#[test]
fn disk_that_is_full_costs_no_checkpoint() {
    let place = interrupted();
    let file = |step: u32| std::fs::read(place.path(&format!("out/checkpoint-{step}.safetensors"))).expect("readable");
    let before = checkpoints(&place, "out");
    let held: Vec<Vec<u8>> = before.iter().map(|&step| file(step)).collect();
    let model_bytes = model(&place, "whole").len();
    let report_bytes = place.read("whole/metrics.jsonl").len();
    // Enough for the report, too little for a checkpoint and for the model.
    let blocks = (report_bytes / 512 + 4).max(model_bytes / 1024);
    assert!(
        512 * blocks < model_bytes && model_bytes < held[0].len(),
        "{report_bytes} {model_bytes} {}",
        held[0].len()
    );
    let mut script = format!("trap '' XFSZ; ulimit -f {blocks}; exec \"$0\" \"$@\"");
    script.push('\n');
    let output = std::process::Command::new("sh")
        .args(["-c", &script])
        .arg(assert_cmd::cargo::cargo_bin!("gazesplat"))
        .args(args(&["--out", "out", "--resume"]))
        .current_dir(place.path("."))
        .output()
        .expect("the shell starts");
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.contains("warning: no checkpoint of step ") && said.contains("cannot write"), "{said}");
    assert!(said.contains("error: ") && said.contains("\nhint: ") && !said.contains("panicked"), "{said}");
    assert_eq!(checkpoints(&place, "out"), before);
    assert!(before.iter().zip(&held).all(|(&step, bytes)| file(step) == *bytes), "they are as they were");
    assert!(!place.path("out/point_cloud.ply").exists(), "there is no half of a model");
    let leftovers: Vec<String> = place.list("out").into_iter().filter(|name| name.ends_with(".part")).collect();
    assert_eq!(leftovers, Vec::<String>::new());
    train(&place, &["--out", "out", "--resume"]).done();
    assert_same_end(&place, "out", "whole");
}
