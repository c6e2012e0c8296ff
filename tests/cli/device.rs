//! `--device` and `info --devices`: what is refused, with which way out, and that a GPU does what the CPU does.

use crate::support::{Place, SHORT};
use gazesplat_render::device::gpu_device;
use gazesplat_testkit::devices::required_gpu;
use serde_json::Value;

fn json(text: &str) -> Value {
    serde_json::from_str(text).expect("JSON")
}

#[test]
fn device_that_is_none_is_refused_by_every_command() {
    for args in [
        ["train", "scene"].as_slice(),
        &["eval", "run", "--scene", "scene"],
        &["render", "run", "--scene", "scene"],
        &["demo"],
    ] {
        let ended = Place::new().run(&[args, &["--device", "cuda"]].concat());
        assert_eq!(ended.code, 2, "{args:?}");
        assert!(ended.stderr.contains("expected `cpu`, `gpu` or `gpu:N`, found `cuda`"), "{}", ended.stderr);
    }
}

#[cfg(target_os = "linux")]
#[test]
fn without_a_driver_every_command_names_the_remedy_before_it_touches_anything() {
    let place = Place::with_run();
    let before = (place.list("."), place.list("run"));
    for args in [
        [&["train", "scene", "--out", "out"], SHORT.as_slice()].concat().as_slice(),
        &["train", "scene", "--out", "run", "--overwrite"],
        &["eval", "run", "--scene", "scene", "--out", "eval.json"],
        &["render", "run", "--scene", "scene"],
        &["demo", "--quick", "--overwrite", "--out", "."],
    ] {
        let said = place.run_without_gpu(&[args, &["--device", "gpu"]].concat()).refused();
        for told in ["no GPU", "install the driver", "mesa-vulkan-drivers", "`--device cpu`", "info --devices"] {
            assert!(said.contains(told), "{told}:\n{said}");
        }
        assert_eq!((place.list("."), place.list("run")), before, "{args:?}");
    }
    place.run_without_gpu(&["eval", "run", "--scene", "scene"]).done();
}

#[test]
fn adapter_that_is_not_there_is_refused() {
    let place = Place::with_scene();
    let said = place.run(&["train", "scene", "--out", "out", "--device", "gpu:99"]).refused();
    assert!(said.contains("no GPU") && said.contains("info --devices"), "{said}");
    assert!(!place.path("out").exists());
}

#[cfg(target_os = "linux")]
#[test]
fn info_without_a_driver_tells_the_cpu_and_the_remedy() {
    let ended = Place::new().run_without_gpu(&["info", "--devices"]).done();
    assert!(ended.stdout.starts_with("cpu ") && ended.stdout.contains("vector instructions"), "{}", ended.stdout);
    assert!(!ended.stdout.contains("gpu:"), "{}", ended.stdout);
    assert!(ended.stderr.contains("mesa-vulkan-drivers"), "{}", ended.stderr);
    let info = json(&Place::new().run_without_gpu(&["info", "--devices", "--json"]).done().stdout);
    assert!(info["cpu"]["num_threads"].as_u64().is_some_and(|n| n > 0), "{info}");
    assert_eq!(info["gpus"].as_array().map(Vec::len), Some(0), "{info}");
}

#[test]
fn info_takes_a_path_or_devices() {
    for args in [["info"].as_slice(), &["info", "scene", "--devices"]] {
        let ended = Place::new().run(args);
        assert!(ended.code == 2 && ended.stderr.contains("--devices"), "{}", ended.stderr);
    }
}

#[test]
fn info_tells_the_adapter_that_gpu_means() {
    if required_gpu(gpu_device(None)).is_none() {
        return;
    }
    let place = Place::new();
    let table = place.run(&["info", "--devices"]).done().stdout;
    assert!(table.contains("\ngpu:0 ") && table.contains("will be used by `--device gpu`"), "{table}");
    let info = json(&place.run(&["info", "--devices", "--json"]).done().stdout);
    let gpus = info["gpus"].as_array().expect("list");
    let chosen: Vec<&Value> = gpus.iter().filter(|gpu| gpu["is_default"] == true).collect();
    assert!(chosen.len() == 1 && chosen[0]["is_usable"] == true && chosen[0]["lacks"].is_null(), "{info}");
}

#[test]
fn gpu_trains_measures_and_draws_what_the_cpu_does() {
    if required_gpu(gpu_device(None)).is_none() {
        return;
    }
    let place = Place::with_run();
    let psnr = |text: &str| json(text)["psnr"].as_f64().expect("a number");
    // 0.1 dB is what the project allows a GPU to end apart from the CPU.
    let assert_near = |gpu: f64, cpu: f64| assert!((gpu - cpu).abs() < 0.1, "{gpu:.3} dB against {cpu:.3} dB");

    let on_cpu = psnr(&place.run(&["eval", "run", "--scene", "scene"]).done().stdout);
    let told = place.run(&["eval", "run", "--scene", "scene", "--device", "gpu", "-v"]).done();
    assert!(told.stderr.contains("device: gpu:"), "{}", told.stderr);
    assert_near(psnr(&told.stdout), on_cpu);

    place.run(&[&["train", "scene", "--out", "gpu", "--device", "gpu"], SHORT.as_slice()].concat()).done();
    assert_near(psnr(&place.read("gpu/eval.json")), on_cpu);
    assert_eq!(place.list("gpu"), place.list("run"));
    assert!(place.read("gpu/settings.toml").contains("\n# Computed on: gpu:"));
    // Stages are queued, not done, when the host looks at its clock.
    let metrics = place.read("gpu/metrics.jsonl");
    for step_ms in metrics.lines().map(|line| json(line)["step_ms"].take()) {
        let times = step_ms.as_object().expect("an object");
        assert!(times.len() == 1 && times["total"].as_f64().is_some_and(|ms| ms > 0.0), "{step_ms}");
    }
    let report = place.read("gpu/report.html");
    assert!(report.contains("ms on average. Its stages have no times of their own") && !report.contains("backward"));

    place.run(&["render", "run", "--scene", "scene", "--out", "cpu.y4m"]).done();
    place.run(&["render", "run", "--scene", "scene", "--out", "gpu.y4m", "--device", "gpu"]).done();
    let frames = |name: &str| std::fs::read(place.path(name)).expect("readable");
    let (cpu, gpu) = (frames("cpu.y4m"), frames("gpu.y4m"));
    assert_eq!(cpu.len(), gpu.len());
    let num_off = cpu.iter().zip(&gpu).filter(|(a, b)| a.abs_diff(**b) > 1).count();
    // One level in 99.99 % of the values; luma and chroma of colours one level apart are at most one level apart.
    assert!(num_off * 10_000 <= cpu.len(), "{num_off} of {} values are off by more than one level", cpu.len());
}
