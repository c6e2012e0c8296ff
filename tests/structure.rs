//! The shape of the workspace: which crate may know which, twins of kernels, long files, silent libraries.

use cargo_metadata::{DependencyKind, MetadataCommand};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Crates from left to right: each may use those before it.
const ORDER: [&str; 5] = ["gazesplat-core", "gazesplat-render", "gazesplat-train", "gazesplat-fovea", "gazesplat"];

/// Longer files say in their header why.
const MAX_LINES: usize = 400;

fn root() -> PathBuf {
    gazesplat_testkit::workspace_root()
}

/// (package, dependency, whether it is for tests only) over the packages of the workspace.
fn edges() -> Vec<(String, String, bool)> {
    // The lock file lists every edge of ours, and reading manifests alone needs no network.
    let metadata =
        MetadataCommand::new().manifest_path(root().join("Cargo.toml")).no_deps().exec().expect("cargo metadata");
    let edge = |package: &cargo_metadata::Package, d: &cargo_metadata::Dependency| {
        (package.name.to_string(), d.name.clone(), d.kind == DependencyKind::Development)
    };
    metadata.packages.iter().flat_map(|p| p.dependencies.iter().map(move |d| edge(p, d))).collect()
}

fn rust_files(dir: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    let Ok(entries) = fs::read_dir(dir) else { return files };
    for entry in entries {
        let path = entry.expect("readable directory").path();
        if path.is_dir() && path.file_name().is_some_and(|n| n != "target") {
            files.extend(rust_files(&path));
        } else if path.extension().is_some_and(|e| e == "rs") {
            files.push(path);
        }
    }
    files
}

fn own_files() -> Vec<PathBuf> {
    ["src", "crates", "tests", "examples"].iter().flat_map(|dir| rust_files(&root().join(dir))).collect()
}

#[test]
fn crates_use_only_those_to_their_left() {
    let place = |name: &str| ORDER.iter().position(|n| *n == name);
    for (package, dependency, _) in edges() {
        if let (Some(from), Some(to)) = (place(&package), place(&dependency)) {
            assert!(to < from, "{package} depends on {dependency}, which stands to its right");
        }
    }
}

#[test]
fn testkit_knows_none_of_our_crates_and_is_for_tests_only() {
    for (package, dependency, is_dev) in edges() {
        assert!(
            package != "gazesplat-testkit" || !dependency.starts_with("gazesplat"),
            "testkit depends on {dependency}"
        );
        assert!(dependency != "gazesplat-testkit" || is_dev, "{package} ships the testkit");
    }
}

#[test]
fn core_knows_no_tensors_and_libraries_no_command_line() {
    for (package, dependency, _) in edges() {
        let is_tensors = dependency.starts_with("burn") || dependency.starts_with("cubecl");
        assert!(!(package == "gazesplat-core" && is_tensors), "core depends on {dependency}");
        let is_for_people = ["clap", "miette", "indicatif", "ctrlc", "plotters"].contains(&dependency.as_str());
        assert!(!(package != "gazesplat" && is_for_people), "{package} depends on {dependency}");
    }
}

/// Public functions of kernels on the CPU that are no passes, with their files.
const CPU_ONLY: [(&str, &str); 2] = [
    // The boundary of one splat; on a GPU it is read together with its place.
    ("bin", "contour"),
    // One tensor of a model; on a GPU one kernel updates all.
    ("adam", "update"),
];

/// The files of kernels in `dir`, by pass.
fn passes(dir: &Path) -> BTreeMap<String, String> {
    let mut passes = BTreeMap::new();
    for path in rust_files(dir) {
        let pass = path.file_stem().expect("a file has a name").to_string_lossy().into_owned();
        if path.parent() == Some(dir) && pass != "mod" {
            passes.insert(pass, fs::read_to_string(&path).expect("source is UTF-8"));
        }
    }
    passes
}

/// Public functions that stand at the left margin of a file: not those of an `impl`.
fn public_functions(text: &str) -> BTreeSet<&str> {
    let name = |line| str::strip_prefix(line, "pub fn ")?.split(['(', '<']).next();
    text.lines().filter_map(name).collect()
}

#[test]
fn every_kernel_has_a_twin_on_the_other_processor() {
    let mut num_pairs = 0;
    for entry in fs::read_dir(root().join("crates")).expect("readable") {
        let kernels = entry.expect("readable").path().join("src/kernels");
        let [cpu, gpu] = ["cpu", "gpu"].map(|processor| passes(&kernels.join(processor)));
        if !kernels.is_dir() {
            continue;
        }
        assert!(kernels.join("cpu").is_dir() && kernels.join("gpu").is_dir(), "{}: one side only", kernels.display());
        let names = |passes: &BTreeMap<String, String>| passes.keys().cloned().collect::<Vec<_>>();
        assert_eq!(names(&cpu), names(&gpu), "{}: files of one side only", kernels.display());
        for (pass, text) in &cpu {
            let (on_cpu, on_gpu) = (public_functions(text), public_functions(&gpu[pass]));
            let missing: Vec<&&str> =
                on_cpu.difference(&on_gpu).filter(|name| !CPU_ONLY.contains(&(pass.as_str(), **name))).collect();
            assert!(missing.is_empty(), "{}: kernels/gpu/{pass}.rs lacks {missing:?}", kernels.display());
            num_pairs += 1;
        }
    }
    assert!(num_pairs > 0, "no kernels found: the tree has changed its shape");
}

/// What the gradients rest on: a sum of floats has one order, and no driver is asked for what it may lack.
#[test]
fn no_kernel_adds_floats_atomically() {
    for path in own_files().into_iter().filter(|p| p.to_string_lossy().contains("kernels/gpu")) {
        let text = fs::read_to_string(&path).expect("source is UTF-8");
        assert!(!text.contains("Atomic<f"), "{} uses atomics on floats", path.display());
    }
}

#[test]
fn long_files_say_why() {
    for path in own_files() {
        let text = fs::read_to_string(&path).expect("source is UTF-8");
        let num_lines = text.lines().count();
        let header: String = text.lines().take_while(|l| l.starts_with("//")).collect::<Vec<_>>().join(" ");
        let explains = ["long", "lines", "one file", "400"].iter().any(|word| header.contains(word));
        assert!(
            num_lines <= MAX_LINES || explains,
            "{} has {num_lines} lines and its header does not say why",
            path.display()
        );
    }
}

#[test]
fn every_file_opens_with_what_it_is_for() {
    for path in own_files() {
        let text = fs::read_to_string(&path).expect("source is UTF-8");
        assert!(text.starts_with("//!"), "{} has no header", path.display());
    }
}

#[test]
fn libraries_do_not_print() {
    for crate_name in ["core", "render", "train", "fovea"] {
        for path in rust_files(&root().join("crates").join(crate_name).join("src")) {
            let text = fs::read_to_string(&path).expect("source is UTF-8");
            // Test modules stand at the end of a file or in files of their own.
            let is_test_file =
                path.file_stem().is_some_and(|s| s == "tests") || path.components().any(|c| c.as_os_str() == "tests");
            let shipped = text.split("#[cfg(test)]").next().unwrap_or_default();
            for call in ["println!(", "eprintln!(", "print!(", "eprint!("] {
                assert!(is_test_file || !shipped.contains(call), "{} calls {call}…)", path.display());
            }
        }
    }
}
