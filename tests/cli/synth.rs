//! `gazesplat synth`: a scene that both loaders read.

use crate::support::Place;

#[test]
fn scene_has_photographs_cameras_and_points() {
    let place = Place::with_scene();
    assert_eq!(place.list("scene/images").len(), 9);
    assert!(place.path("scene/transforms.json").exists() && place.path("scene/sparse/0/images.txt").exists());
    assert_eq!(
        image::image_dimensions(place.path("scene/images").join(&place.list("scene/images")[0])).expect("a PNG"),
        (64, 48)
    );
}

#[test]
fn same_seed_gives_the_same_scene() {
    let place = Place::with_scene();
    place.run(&["synth", "--out", "again", "--views", "9", "--size", "64x48", "--points", "400"]).done();
    for name in place.list("scene/images") {
        let read = |scene: &str| std::fs::read(place.path(scene).join("images").join(&name)).expect("readable");
        assert!(read("scene") == read("again"), "{name}");
    }
    assert_eq!(place.read("scene/transforms.json"), place.read("again/transforms.json"));
}

#[test]
fn place_that_cannot_be_written_is_refused_with_the_option() {
    let place = Place::new();
    place.write("file", "in the way");
    for out in ["file", "file/scene"] {
        let said = place.run(&["synth", "--out", out, "--views", "1", "--size", "32x24"]).refused();
        assert!(said.contains("`--out`"), "{said}");
    }
}

#[test]
fn existing_directory_is_not_mixed_with_a_scene() {
    let place = Place::with_scene();
    let said = place.run(&["synth", "--out", "scene", "--views", "3", "--size", "32x24"]).refused();
    assert!(said.contains("`scene`") && said.contains("--out"), "{said}");
    assert_eq!(place.list("scene/images").len(), 9);
}
