//! `lut`, `bench termination`, and the options of `render` and `eval` that go with them.

use crate::support::{Place, write_lpips_weights};
use std::fs;

/// A quick table in `table.json`.
fn with_table(place: Place) -> Place {
    place.run(&["lut", "--rule", "vertex", "--sample", "centre", "--out", "table.json"]).done();
    place
}

#[test]
fn table_is_written_with_its_provenance_range_and_picture() {
    let place = Place::new();
    let ended = place.run(&["lut", "--preset", "paper", "--out", "paper.json"]).done();
    assert_eq!(place.list("."), ["paper.json", "paper.png"]);
    let said: serde_json::Value = serde_json::from_str(&ended.stdout).expect("JSON");
    // The published range and cubic mean of this choice.
    let number = |key: &str| said["range"][key].as_f64().expect("a number");
    assert!((number("min") - 3.66e-4).abs() < 1e-6 && (number("max") - 1.0209e-2).abs() < 1e-6, "{said}");
    assert!((number("cubic_mean") - 5.063e-3).abs() < 1e-6, "{said}");
    let file: serde_json::Value = serde_json::from_str(&place.read("paper.json")).expect("JSON");
    assert_eq!(file["values"].as_array().map(Vec::len), Some(512));
    assert_eq!(file["spec"]["rule"], "dkl_diagonal");
}

#[test]
fn tables_out_of_range_are_refused() {
    let place = Place::new();
    for option in [["--size", "0"], ["--size", "65"], ["--jnd-de", "0"], ["--jnd-de", "-1"], ["--jnd-de", "NaN"]] {
        place.run(&["lut", option[0], option[1], "--out", "table.json"]).refused();
    }
    place.run(&["lut", "--out", "table.png"]).refused();
    assert!(place.list(".").is_empty());
}

#[test]
fn frames_stop_by_each_rule_and_blend_less() {
    let place = with_table(Place::with_run());
    let blended = |args: &[&str]| -> u64 {
        let base = ["render", "run", "--scene", "scene", "--split", "test", "--stats", "--out", "frames"];
        let said: serde_json::Value =
            serde_json::from_str(&place.run(&[&base, args].concat()).done().stdout).expect("JSON");
        said["views"].as_array().expect("views").iter().map(|v| v["num_blended"].as_u64().expect("a count")).sum()
    };
    let fixed = blended(&[]);
    assert_eq!(fixed, blended(&["--termination", "fixed"]));
    let table = blended(&["--lut", "table.json"]);
    assert_eq!(table, blended(&["--termination", "jnd", "--lut", "table.json", "--gamma", "1"]));
    assert!(table <= fixed && blended(&["--lut", "table.json", "--gamma", "10"]) <= table);
    assert!(blended(&["--termination", "naive", "--lut", "table.json", "--gamma", "10"]) <= fixed);
    let eval = |args: &[&str]| {
        let base = ["eval", "run", "--scene", "scene"];
        let said: serde_json::Value =
            serde_json::from_str(&place.run(&[&base, args].concat()).done().stdout).expect("JSON");
        said["psnr"].as_f64().expect("a number")
    };
    assert!((eval(&[]) - eval(&["--lut", "table.json"])).abs() < 0.2);
}

/// Every case ends before anything is drawn, with the reason.
#[test]
fn tables_and_gammas_that_cannot_be_used_are_refused_with_the_reason() {
    let place = with_table(Place::with_run());
    let whole = place.read("table.json");
    let first = whole.split("\"values\": [").nth(1).and_then(|v| v.trim().split(',').next()).expect("values");
    let cases = [
        ("size.json", whole.replacen("\"size\": 8", "\"size\": 7", 1), "512 entries"),
        ("nan.json", whole.replacen(first, "NaN", 1), "nan.json"),
        ("zero.json", whole.replacen(first, "0.0", 1), "0 at entry 0"),
        ("negative.json", whole.replacen(first, "-0.01", 1), "-0.01 at entry 0"),
        ("linear.json", whole.replacen("\"read_as\": \"srgb\"", "\"read_as\": \"linear\"", 1), "linear light"),
        ("empty.json", String::new(), "empty.json"),
        ("other.json", "{\"a\": 1}".to_owned(), "other.json"),
    ];
    let render = ["render", "run", "--scene", "scene", "--out", "frames"];
    for (name, text, reason) in &cases {
        assert_ne!(*text, whole, "{name}");
        place.write(name, text);
        for command in [&render[..], &["eval", "run", "--scene", "scene"]] {
            let said = place.run(&[command, &["--lut", name]].concat()).refused();
            assert!(said.contains(name) && said.contains(reason), "{said}");
        }
    }
    for (args, reason) in [
        (&["--lut", "missing.json"][..], "missing.json"),
        (&["--termination", "jnd", "--gamma", "-1"], "--gamma -1"),
        (&["--termination", "jnd", "--gamma", "NaN"], "--gamma NaN"),
        (&["--termination", "fixed", "--lut", "table.json"], "--lut"),
        (&["--gamma", "2"], "--gamma"),
    ] {
        let said = place.run(&[&render[..], args].concat()).refused();
        assert!(said.contains(reason), "{said}");
    }
    assert!(!place.path("frames").exists());
}

/// What `lut --space linear` writes is for colours the renderer does not composite; the paper's choice says so itself.
#[test]
fn a_table_for_linear_light_is_refused_unless_it_is_the_papers() {
    let place = Place::with_run();
    let render = |table: &str| place.run(&["render", "run", "--scene", "scene", "--lut", table, "--out", "frames"]);
    place.run(&["lut", "--rule", "vertex", "--sample", "centre", "--space", "linear", "--out", "linear.json"]).done();
    assert!(render("linear.json").refused().contains("linear light"));
    place.run(&["lut", "--preset", "paper", "--out", "paper.json"]).done();
    render("paper.json").done();
    place.run(&["lut", "--preset", "paper", "--space", "linear", "--out", "named.json"]).done();
    assert_eq!(place.read("named.json"), place.read("paper.json"), "naming a preset's own space changes nothing");
}

#[test]
fn the_study_compares_every_rule() {
    let place = with_table(Place::with_run());
    let args = ["bench", "termination", "run", "--scene", "scene", "--views", "1", "--repeats", "1", "--out", "study"];
    let ended = place.run(&args).done();
    let files = [
        "delta_e.png",
        "error_over_time.svg",
        "flip.png",
        "flip_over_time.svg",
        "quality_over_gamma.svg",
        "saved.png",
        "termination.csv",
        "termination.json",
    ];
    assert_eq!(place.list("study"), files);
    let rows: serde_json::Value = serde_json::from_str(&ended.stdout).expect("JSON");
    let rows = rows.as_array().expect("rows");
    assert_eq!(rows.len(), 23);
    let csv = place.read("study/termination.csv");
    let columns = "rule,gamma,psnr,ssim,psnr_to_full,delta_e_max,delta_e_p999,above_one,flip,flip_p999,blends_per_pixel,\
                   lane_pixels_per_pixel,ms,speed_up";
    assert_eq!(csv.lines().next(), Some(columns));
    assert_eq!(csv.lines().count(), 24);
    for row in rows {
        let number = |key: &str| row[key].as_f64().unwrap_or_else(|| panic!("{key}: {row}"));
        assert!((0.0..=1.0).contains(&number("flip")) && number("flip") <= number("flip_p999"), "{row}");
        assert!(number("lane_pixels_per_pixel") >= number("blends_per_pixel") && number("ms") > 0.0, "{row}");
    }
    let report: serde_json::Value = serde_json::from_str(&place.read("study/termination.json")).expect("JSON");
    let stops = &report["stops_of_strict"];
    let shares = ["below_constant", "above_constant"].map(|g| stops[g]["share"].as_f64().expect("a share"));
    assert!((shares[0] + shares[1] - 1.0).abs() < 1e-9, "{stops}");
    assert!(stops["centred_over_dropped"]["min"].as_f64().expect("a number") >= 1.0, "{stops}");
    assert!(report["not_measured"].to_string().contains("LPIPS"));
    let strict = rows.iter().find(|r| r["rule"] == "strict" && r["gamma"] == 1.0).expect("a row");
    assert!(strict["delta_e_max"].as_f64().expect("a number") <= 1.05, "{strict}");
    let own = [&args[..], &["--lut", "table.json", "--gamma", "3"]].concat();
    let rows: serde_json::Value = serde_json::from_str(&place.run(&own).done().stdout).expect("JSON");
    let last = rows.as_array().and_then(|rows| rows.last()).expect("rows");
    assert!(last["rule"] == "given" && last["gamma"] == 3.0, "{last}");
    for (option, value) in [("--gamma", "-1"), ("--lut", "missing.json")] {
        let refused = place.run(&[&args[..], &["--termination", "jnd", option, value]].concat()).refused();
        assert!(refused.contains(value), "{refused}");
    }
    let refused = place.run(&["bench", "termination", "run", "--scene", "scene", "--repeats", "0"]).refused();
    assert!(refused.contains("nothing would be measured"));
    let refused = place.run(&["bench", "termination", "run", "--scene", "scene", "--pixels-per-degree", "0"]).refused();
    assert!(refused.contains("pixels per degree"));
    fs::remove_dir_all(place.path("study")).expect("there");
}

#[test]
fn the_study_has_lpips_where_its_weights_are_given() {
    let place = Place::with_run();
    write_lpips_weights(&place, "w.safetensors", |_, _| ());
    let args = ["bench", "termination", "run", "--scene", "scene", "--views", "1", "--repeats", "1", "--out", "study"];
    let ended = place.run(&[&args[..], &["--lpips-weights", "w.safetensors"]].concat()).done();
    let rows: serde_json::Value = serde_json::from_str(&ended.stdout).expect("JSON");
    let lpips: Vec<f64> =
        rows.as_array().expect("rows").iter().map(|r| r["lpips"].as_f64().expect("a number")).collect();
    assert!(lpips.iter().all(|v| *v >= 0.0) && lpips.iter().any(|v| *v > 0.0), "{lpips:?}");
    let csv = place.read("study/termination.csv");
    assert!(csv.lines().next().is_some_and(|line| line.ends_with(",speed_up,lpips")), "{csv}");
    let num_columns = |line: &str| line.matches(',').count();
    assert!(csv.lines().all(|line| num_columns(line) >= num_columns("rule,gamma") + 13), "{csv}");
    let report: serde_json::Value = serde_json::from_str(&place.read("study/termination.json")).expect("JSON");
    assert_eq!(report["not_measured"], serde_json::json!([]));
    let refused = place.run(&[&args[..], &["--lpips-weights", "run/eval.json"]].concat()).refused();
    assert!(refused.contains("run/eval.json") && refused.contains("no safetensors file"), "{refused}");
}
