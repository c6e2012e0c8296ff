//! Settings from files and `--set`, and what is said when they are wrong.

use crate::support::Place;
use insta::assert_snapshot;

#[test]
fn misspelt_key_in_a_file_shows_the_place_and_the_nearest_key() {
    let place = Place::with_scene();
    place.write("my.toml", "[train]\nsteps = 30\nsede = 1\n");
    let said = place.run(&["train", "scene", "--config", "my.toml", "--out", "out"]).refused();
    assert_snapshot!(said, @r"
    error: `my.toml`: `train.sede` is not a setting
       ╭─[my.toml:3:1]
     2 │ steps = 30
     3 │ sede = 1
       · ──┬─
       ·   ╰── no such key
       ╰────
    hint: did you mean `train.seed`?
    ");
    assert!(!place.path("out").exists());
}

#[test]
fn misspelt_key_on_the_command_line_gets_the_nearest_key() {
    let said = Place::new().run(&["train", "scene", "--set", "densify.cpa=5"]).refused();
    assert_snapshot!(said, @r"
    error: `--set densify.cpa=5`: `densify.cpa` is not a setting
    hint: did you mean `densify.cap`?
    ");
}

#[test]
fn value_of_the_wrong_type_names_the_key_and_what_it_takes() {
    let place = Place::new();
    place.write("my.toml", "train.steps = \"many\"\n");
    assert_snapshot!(place.run(&["train", "scene", "--config", "my.toml"]).refused(), @r#"
    error: `my.toml`: `train.steps` expects a whole number, 0 or more, found the text `"many"`
       ╭─[my.toml:1:15]
     1 │ train.steps = "many"
       ·               ───┬──
       ·                  ╰── wrong kind of value
       ╰────
    hint: the default is `30000`
    "#);
}

#[test]
fn file_that_is_no_toml_shows_the_place() {
    let place = Place::new();
    place.write("my.toml", "[train\nsteps = 3\n");
    let ended = place.run(&["train", "scene", "--config", "my.toml"]);
    assert_eq!(ended.code, 2);
    assert!(ended.stderr.contains("my.toml:1:"), "{}", ended.stderr);
}

#[test]
fn missing_file_lists_the_presets() {
    let said = Place::new().run(&["train", "scene", "--config", "qiuck"]).refused();
    assert!(said.contains("`quick`, `quality`"), "{said}");
}

#[test]
fn value_out_of_range_is_refused_before_the_scene_is_read() {
    let place = Place::new();
    for wrong in ["train.steps=0", "render.alpha_max=0.99999", "render.alpha_max=0.002", "render.near=0"] {
        let said = place.run(&["train", "no such scene", "--set", wrong, "--out", "out"]).refused();
        let (key, _) = wrong.split_once('=').expect("a key");
        assert!(said.contains(key) && said.contains("gazesplat train --help"), "{said}");
        assert!(!place.path("out").exists(), "{wrong}");
    }
}

#[test]
fn resolved_settings_are_kept_and_train_the_same_model_again() {
    let place = Place::with_run();
    let settings = place.read("run/settings.toml");
    for line in ["steps = 40", "seed = 0", "cap = 600", "alpha_max = 0.999"] {
        assert!(settings.contains(line), "{line}:\n{settings}");
    }
    place.run(&["train", "scene", "--config", "run/settings.toml", "--out", "again"]).done();
    let model = |run: &str| std::fs::read(place.path(run).join("point_cloud.ply")).expect("readable");
    assert!(model("run") == model("again"), "the same settings give another model");
}
