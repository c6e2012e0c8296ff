//! `gazesplat render`: frames as files, videos, counters.

use crate::support::Place;
use serde_json::Value;

#[test]
fn every_view_becomes_a_png_of_its_own_size() {
    let place = Place::with_run();
    place.run(&["render", "run", "--scene", "scene", "--out", "frames"]).done();
    let images = place.list("scene/images");
    assert_eq!(place.list("frames"), images);
    for name in images {
        assert_eq!(image::image_dimensions(place.path("frames").join(name)).expect("a PNG"), (64, 48));
    }
}

#[test]
fn size_and_field_of_view_replace_the_cameras() {
    let place = Place::with_run();
    let args = ["render", "run", "--scene", "scene", "--split", "test", "--size", "40x30", "--fov", "90", "--out", "f"];
    place.run(&args).done();
    assert_eq!(place.list("f").len(), 2);
    let first = place.list("f").remove(0);
    assert_eq!(image::image_dimensions(place.path("f").join(first)).expect("a PNG"), (40, 30));
}

#[test]
fn run_keeps_its_renders_with_it() {
    let place = Place::with_run();
    place.run(&["render", "run", "--scene", "scene", "--split", "test"]).done();
    assert_eq!(place.list("run/renders").len(), 2);
    place.run(&["render", "run/point_cloud.ply", "--scene", "scene", "--split", "test"]).done();
    assert_eq!(place.list("renders/point_cloud").len(), 2);
}

#[test]
fn photographs_need_not_decode() {
    let place = Place::with_run();
    for name in place.list("scene/images") {
        let path = place.path("scene/images").join(name);
        let whole = std::fs::read(&path).expect("readable");
        std::fs::write(&path, &whole[..whole.len() / 2]).expect("writable");
    }
    place.run(&["render", "run", "--scene", "scene", "--out", "frames"]).done();
    assert_eq!(place.list("frames").len(), 9);
}

#[test]
fn video_is_444_and_has_every_frame() {
    let place = Place::with_run();
    let told = place.run(&["render", "run", "--scene", "scene", "--out", "a.y4m"]).done().stderr;
    assert!(told.contains("YUV 4:4:4, BT.709, limited range"), "{told}");
    let video = std::fs::read(place.path("a.y4m")).expect("readable");
    let header = b"YUV4MPEG2 W64 H48 F30:1 Ip A1:1 C444 XCOLORRANGE=LIMITED\n";
    assert!(video.starts_with(header));
    assert_eq!(video.len(), header.len() + 9 * (b"FRAME\n".len() + 3 * 64 * 48));
}

#[test]
fn camera_path_is_followed() {
    let place = Place::with_run();
    let camera = |id: usize| {
        serde_json::json!({ "id": id, "img_name": format!("c{id}"), "width": 32, "height": 24, "fx": 30.0, "fy": 30.0,
            "position": [0.0, 0.0, id], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]] })
    };
    place.write("path.json", serde_json::json!([camera(0), camera(1)]).to_string());
    place.run(&["render", "run", "--path", "path.json", "--out", "frames"]).done();
    assert_eq!(place.list("frames").len(), 2);
}

#[test]
fn counters_are_data() {
    let place = Place::with_run();
    let ended = place.run(&["render", "run", "--scene", "scene", "--split", "test", "--out", "f", "--stats"]).done();
    let stats: Value = serde_json::from_str(&ended.stdout).expect("JSON");
    let views = stats["views"].as_array().expect("list");
    assert_eq!(views.len(), 2);
    for view in views {
        assert!(view["name"].is_string() && view["num_pairs"].as_u64() > Some(0), "{view}");
        assert!(view["num_blended"].as_u64() > Some(0), "{view}");
    }
}

#[test]
fn cameras_are_named_once() {
    let place = Place::with_run();
    assert_eq!(place.run(&["render", "run"]).code, 2);
    assert_eq!(place.run(&["render", "run", "--scene", "scene", "--path", "p.json"]).code, 2);
}

#[test]
fn options_out_of_range_are_refused() {
    let place = Place::with_run();
    for wrong in
        [["--alpha-max", "1.5"], ["--near", "-1"], ["--background", "3,0,0"], ["--size", "0x5"], ["--fov", "200"]]
    {
        let flag = format!("{}={}", wrong[0], wrong[1]);
        let ended = place.run(&["render", "run", "--scene", "scene", "--out", "f", &flag]);
        assert_eq!(ended.code, 2, "{flag}");
        // The others are refused by the parser, which shows what the option takes.
        if ["--alpha-max", "--near"].contains(&wrong[0]) {
            assert!(ended.refused().contains("gazesplat render --help"), "{flag}");
        }
        assert!(!place.path("f").exists(), "{flag}");
    }
}

#[test]
fn other_video_formats_are_refused_with_the_way_there() {
    let said = Place::with_run().run(&["render", "run", "--scene", "scene", "--out", "a.mp4"]).refused();
    assert!(said.contains("`ffmpeg -i a.y4m a.mp4`"), "{said}");
}
