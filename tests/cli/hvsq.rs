//! `gazesplat hvsq` and `eval --hvsq`: numbers as data, a picture of where, and refusals.

use crate::support::Place;
use gazesplat_core::{RgbImage8, io};
use serde_json::Value;

/// A place with two pictures of waves: the second is brighter and has its lower half shaken.
fn with_pictures() -> Place {
    let place = Place::new();
    let picture = |shaken: bool| {
        let value = |i: usize| {
            let (x, y, c) = (i / 3 % 70, i / 210, i % 3);
            let wave = 90.0 + 60.0 * ((x as f32) * 0.3 + c as f32).sin() + 40.0 * ((y as f32) * 0.2).cos();
            let shake = if shaken && y >= 25 { (i * 7919 % 41) as f32 } else { 0.0 };
            (wave + shake) as u8
        };
        RgbImage8 { width: 70, height: 50, data: (0..70 * 50 * 3).map(value).collect() }
    };
    for (name, shaken) in [("a.png", true), ("b.png", false)] {
        io::save_png(place.path(name), &picture(shaken)).expect("a file");
    }
    io::save_png(place.path("small.png"), &RgbImage8::filled(20, 50, [3; 3])).expect("a file");
    place
}

fn json(text: &str) -> Value {
    serde_json::from_str(text).expect("JSON")
}

#[test]
fn two_pictures_have_a_number_per_pool() {
    let place = with_pictures();
    let found = json(&place.run(&["hvsq", "a.png", "b.png"]).done().stdout);
    let values = found["hvsq"].as_array().expect("a list");
    let sizes: Vec<f64> = values.iter().map(|v| v["pooling_px"].as_f64().expect("a size")).collect();
    assert_eq!(sizes, [1.0, 3.0, 7.0, 12.0]);
    assert!(values.iter().all(|v| v["value"].as_f64().is_some_and(|v| v > 0.0)));
    assert!(found["psnr"].as_f64().is_some_and(|v| v > 10.0));
    let same = json(&place.run(&["hvsq", "b.png", "b.png", "--hvsq", "3"]).done().stdout);
    assert_eq!(same["hvsq"][0]["value"], 0.0);
}

#[test]
fn gaze_regions_and_map() {
    let place = with_pictures();
    let args = ["hvsq", "a.png", "b.png", "--hvsq", "1,2.5", "--gaze", "0.5,-0.2", "--display-fov", "100"];
    let more = ["--hvsq-regions", "--hvsq-map", "map.png"];
    let found = json(&place.run(&[&args[..], &more[..]].concat()).done().stdout);
    let values = found["hvsq"].as_array().expect("a list");
    assert_eq!(values.len(), 3);
    assert_eq!(values[2]["gaze"], serde_json::json!([0.5, -0.2]));
    assert_eq!(values[0]["regions"].as_array().map(Vec::len), Some(4));
    let map = io::images::decode_rgb(place.path("map.png")).expect("a picture");
    assert_eq!((map.width, map.height), (70, 50));
    let mean = |rows: std::ops::Range<u32>| {
        let n = (rows.end - rows.start) * 70;
        rows.flat_map(|y| (0..70).map(move |x| (x, y))).map(|(x, y)| f64::from(map.pixel(x, y)[0])).sum::<f64>()
            / f64::from(n)
    };
    assert!(mean(30..50) > 3.0 * mean(0..20), "{} {}", mean(30..50), mean(0..20));
}

#[test]
fn impossible_comparisons_are_refused() {
    let place = with_pictures();
    let said = place.run(&["hvsq", "a.png", "small.png"]).refused();
    assert!(said.contains("`a.png` is 70x50 and `small.png` is 20x50"), "{said}");
    let said = place.run(&["hvsq", "a.png", "b.png", "--hvsq", "0.5"]).refused();
    assert!(said.contains("pooling size: found 0.5, expected pixels from 1 on"), "{said}");
    let said = place.run(&["hvsq", "a.png", "b.png", "--hvsq", "3,65"]).refused();
    assert!(said.contains("pooling size: found 65, expected at most 64 pixels"), "{said}");
    let said = place.run(&["hvsq", "a.png", "missing.png"]).refused();
    assert!(said.contains("missing.png"), "{said}");
    let said = place.run(&["hvsq", "a.png", "b.png", "--display-fov", "100"]).refused();
    assert!(said.contains("no meaning for pools of one size") && said.contains("--gaze X,Y"), "{said}");
    let ended = place.run(&["hvsq", "--hvsq", "a.png", "b.png"]);
    assert!(ended.code == 2 && ended.stderr.contains("what is no size stands before `--hvsq`"), "{}", ended.stderr);
    for bad in [["--gaze", "0.5"], ["--gaze", "NaN,0"], ["--display-fov", "171"], ["--display-fov", "0"]] {
        let ended = place.run(&[&["hvsq", "a.png", "b.png"][..], &bad[..]].concat());
        assert_eq!(ended.code, 2, "{bad:?}");
        assert!(ended.stderr.contains(bad[0]), "{}", ended.stderr);
    }
}

#[test]
fn eval_measures_views_and_their_mean() {
    let place = Place::with_run();
    let args =
        ["eval", "run", "--scene", "scene", "--split", "all", "--hvsq", "--gaze", "0.5,0.5", "--hvsq-map", "m.png"];
    let ended = place.run(&args).done();
    let found = json(&ended.stdout);
    let views = found["hvsq"]["views"].as_array().expect("a list");
    assert_eq!(views.len(), 9);
    for i in 0..5 {
        let mean = found["hvsq"]["mean"][i]["value"].as_f64().expect("a number");
        let of_views = views.iter().map(|v| v["hvsq"][i]["value"].as_f64().expect("a number")).sum::<f64>() / 9.0;
        assert!((mean / of_views - 1.0).abs() < 1e-12 && mean > 0.0);
    }
    assert!(found["psnr"].is_number() && ended.stderr.contains("HVSQ p=12"), "{}", ended.stderr);
    assert!(place.path("m.png").is_file());
}
