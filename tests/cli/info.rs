//! `gazesplat info`: what is there, for people and for programs.

use crate::support::Place;
use insta::{assert_snapshot, with_settings};
use serde_json::Value;

fn json(place: &Place, path: &str) -> Value {
    serde_json::from_str(&place.run(&["info", path, "--json"]).done().stdout).expect("JSON")
}

#[test]
fn scene_is_described() {
    let place = Place::with_scene();
    with_settings!({ filters => vec![(r"-?\d+\.\d+", "[n]")] }, {
        assert_snapshot!(place.run(&["info", "scene"]).done().stdout, @r"
        scene                     scene
        format                    COLMAP (text)
        views                     9 (7 for training, 2 for testing)
        image size                64 x 48 (9 views)
        horizontal field of view  [n]°
        lens                      pinhole (9 views)
        extent of the cameras     [n] world units
        sparse points             400
        bounds                    ([n], [n], [n]) to ([n], [n], [n]), without the outermost 1 % on each side
        ");
    });
    let info = json(&place, "scene");
    assert_eq!(
        (info["kind"].as_str(), info["num_views"].as_u64(), info["num_test"].as_u64()),
        (Some("scene"), Some(9), Some(2))
    );
}

#[test]
fn run_and_model_are_described() {
    let place = Place::with_run();
    with_settings!({ filters => vec![(r"-?\d+\.\d+", "[n]")] }, {
        assert_snapshot!(place.run(&["info", "run"]).done().stdout, @r"
        run                       run
        file size                 [n] kB
        Gaussians                 600
        SH degree                 1 (4 coefficients per channel)
        bounds                    ([n], [n], [n]) to ([n], [n], [n]), without the outermost 1 % on each side
        opacity                   [n] median, [n] to [n] for the middle 90 %
        scale (geometric mean)    [n] median, [n] to [n] for the middle 90 %
        longest to shortest axis  [n] median, [n] to [n] for the middle 90 %
        logged steps              5
        PSNR                      [n] dB
        SSIM                      [n]
        settings                  run/settings.toml
        report                    run/report.html
        ");
    });
    let (run, model) = (json(&place, "run"), json(&place, "run/point_cloud.ply"));
    assert_eq!((run["kind"].as_str(), model["kind"].as_str()), (Some("run"), Some("model")));
    assert_eq!(run["num_gaussians"], model["num_gaussians"]);
    assert_eq!(model["sh_degree"].as_u64(), Some(1));
    assert!(model["opacity"]["p50"].as_f64().is_some_and(|o| (0.0..=1.0).contains(&o)));
}

#[test]
fn model_with_rows_that_are_not_numbers_is_read_without_them() {
    let place = Place::with_run();
    let path = place.path("run/point_cloud.ply");
    let mut bytes = std::fs::read(&path).expect("readable");
    let end = b"end_header\n";
    let data = bytes.windows(end.len()).position(|w| w == end).expect("a PLY header") + end.len();
    bytes[data..data + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    std::fs::write(&path, bytes).expect("writable");
    let ended = place.run(&["info", "run/point_cloud.ply"]).done();
    assert!(ended.stderr.contains("warning: `run/point_cloud.ply`: left out 1 of "), "{}", ended.stderr);
}

#[test]
fn what_is_none_of_these_is_refused() {
    let place = Place::new();
    assert!(place.run(&["info", "nothing"]).refused().contains("`nothing`"));
    std::fs::create_dir(place.path("empty")).expect("writable");
    assert!(place.run(&["info", "empty"]).refused().contains("not a scene"));
    place.write("a.ply", "not a ply\n");
    assert!(place.run(&["info", "a.ply"]).refused().contains("`a.ply`"));
}
