//! The image cache in a training, as its log tells it, and the bench that holds it to a bound.

use crate::support::{Place, SHORT};
use serde_json::Value;

/// A photograph of the small scene, decoded: 64 · 48 pixels.
const IMAGE_BYTES: u64 = 64 * 48 * 3;

fn last_line(place: &Place, run: &str) -> Value {
    serde_json::from_str(place.read(&format!("{run}/metrics.jsonl")).lines().last().expect("a line")).expect("JSON")
}

#[test]
fn log_tells_memory_and_one_budget_holds_for_all_images() {
    let place = Place::with_scene();
    // Seven training and two test views; room for three images.
    let budget = 3 * IMAGE_BYTES;
    let cache = format!("data.cache_bytes={budget}");
    let args = [&["train", "scene", "--out", "small", "--set", &cache], SHORT.as_slice()].concat();
    let ended = place.run(&args).done();
    let memory = &last_line(&place, "small")["memory"];
    let number = |key: &str| memory[key].as_u64().unwrap_or_else(|| panic!("{key}: {memory}"));
    assert!(number("image_bytes") <= budget && number("image_bytes_peak") <= budget, "{memory}");
    assert!(number("image_misses") > 9 && number("image_hits") > 0, "images were dropped and read again: {memory}");
    if cfg!(target_os = "linux") {
        assert!(number("peak_resident_bytes") > budget, "{memory}");
        assert!(ended.stderr.contains("memory: at most "), "{}", ended.stderr);
    }
    assert!(ended.stderr.contains("images up to ") && ended.stderr.contains(" decoded, "), "{}", ended.stderr);
    // What is held changes nothing of the model.
    place.run(&[&["train", "scene", "--out", "large"], SHORT.as_slice()].concat()).done();
    assert_eq!(last_line(&place, "large")["memory"]["image_misses"], 9, "each once");
    let model = |run: &str| std::fs::read(place.path(run).join("point_cloud.ply")).expect("readable");
    assert!(model("small") == model("large"));
}

#[cfg(target_os = "linux")]
#[test]
fn bench_trains_a_capture_larger_than_its_cache_and_checks_the_bound() {
    let place = Place::new();
    let budget = (4 * IMAGE_BYTES).to_string();
    let args = [
        "bench",
        "memory",
        "--views",
        "40",
        "--pictures",
        "3",
        "--size",
        "64x48",
        "--steps",
        "50",
        "--cap",
        "300",
        "--cache-bytes",
        &budget,
        "--out",
        "figures.json",
    ];
    let ended = place.run(&args).done();
    assert_eq!(ended.stdout, place.read("figures.json"));
    let figures: Value = serde_json::from_str(&ended.stdout).expect("JSON");
    let number = |key: &str| figures[key].as_u64().unwrap_or_else(|| panic!("{key}: {figures}"));
    assert_eq!((number("views"), number("pictures"), number("decoded_bytes")), (40, 3, 40 * IMAGE_BYTES));
    assert!(number("image_bytes_peak") <= 4 * IMAGE_BYTES, "{figures}");
    // 36 training views of which at most four are held: 50 steps decode nearly as often, though there are 3 pictures.
    assert!(number("image_misses") > 30, "{figures}");
    assert!(number("peak_resident_bytes") <= number("bound_bytes"), "{figures}");
    let refused = place.run(&[args.as_slice(), &["--max-bytes", "1000"]].concat());
    assert_eq!(refused.code, 1, "{}", refused.stderr);
    assert!(refused.stderr.contains("check failed: the training took "), "{}", refused.stderr);
    assert!(place.run(&["bench", "memory", "--views", "3"]).refused().contains("nothing to measure"));
}
