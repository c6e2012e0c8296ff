//! Help teaches: what there is, what it takes, an example of each.

use crate::support::Place;

const COMMANDS: [&str; 11] =
    ["train", "prune", "eval", "hvsq", "render", "synth", "demo", "info", "convert", "lut", "bench"];

#[test]
fn help_names_every_command_and_the_exit_statuses() {
    let help = Place::new().run(&["--help"]).done().stdout;
    for command in COMMANDS {
        assert!(help.contains(&format!("\n  {command}")), "{command}:\n{help}");
    }
    assert!(help.contains("Exit status: 0 done, 1 a check you asked for failed, 2 error."));
}

#[test]
fn help_of_every_command_has_an_example() {
    for command in COMMANDS {
        let help = Place::new().run(&[command, "--help"]).done().stdout;
        assert!(help.contains(&format!("Examples:\n  gazesplat {command}")), "{help}");
    }
}

#[test]
fn help_of_train_lists_every_setting_with_its_default() {
    let help = Place::new().run(&["train", "--help"]).done().stdout;
    for line in
        ["train.steps = 30000", "train.seed = 0", "data.max_side", "densify.cap", "train.threads = 0", "data.images"]
    {
        assert!(help.contains(&format!("\n  {line}")), "{line}:\n{help}");
    }
}

#[test]
fn no_command_shows_the_help_and_is_an_error() {
    let ended = Place::new().run(&[]);
    assert_eq!(ended.code, 2);
    assert!(ended.stderr.contains("Usage: gazesplat"), "{}", ended.stderr);
}

#[test]
fn misspelt_command_and_option_are_corrected() {
    let ended = Place::new().run(&["tarin", "x"]);
    assert!(ended.code == 2 && ended.stderr.contains("'train'"), "{}", ended.stderr);
    let ended = Place::new().run(&["eval", "x", "--scnee", "y"]);
    assert!(ended.code == 2 && ended.stderr.contains("'--scene'"), "{}", ended.stderr);
}

#[test]
fn version_is_printed() {
    let version = Place::new().run(&["--version"]).done().stdout;
    assert_eq!(version, format!("gazesplat {}\n", env!("CARGO_PKG_VERSION")));
}

#[test]
fn help_teaches_what_a_device_is_called() {
    for command in ["train", "eval", "render", "demo"] {
        let help = Place::new().run(&[command, "-h"]).done().stdout;
        let words = help.split_whitespace().collect::<Vec<_>>().join(" ");
        for told in ["--device <DEVICE>", "gpu:N", "software driver", "`gazesplat info --devices`", "[default: cpu]"] {
            assert!(words.contains(told), "{command}: {told}:\n{help}");
        }
    }
}
