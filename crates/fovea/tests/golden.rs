//! HVSQ in float32 against the golden records, within the tolerances of the specification (hvsq.md §12), on the CPU and on
//! a GPU.

use burn::tensor::Device;
use gazesplat_core::{Display, Gaze, Pinhole, PixelGrid};
use gazesplat_fovea::Hvsq;
use gazesplat_fovea::hvs::pooling::{GazePooling, Growth, Pooling};
use gazesplat_fovea::hvs::pyramid::{FilterBank, Taps};
use gazesplat_fovea::hvsq::plain::PlainPooling;
use gazesplat_fovea::hvsq::{Distance, HvsqReference, ImageView};
use gazesplat_testkit::reference::hvsq::images::{interleaved, pair};
use gazesplat_testkit::{difference, golden};
use serde_json::Value;
use std::cell::RefCell;

/// Relative error of values: what float32 sums of squares of differences keep (§12, tests 3, 4, 7).
const VALUE: f64 = 1e-5;

/// Relative L2 error of gradients (§12, test 6): signs of tiny differences flip in float32.
fn gradient_tolerance(distance: Distance) -> f64 {
    match distance {
        Distance::Mse => 1e-4,
        Distance::L1 => 2e-2,
    }
}

thread_local! {
    /// The device that references live on.
    static DEVICE: RefCell<Device> = RefCell::new(gazesplat_render::cpu_device());
}

fn reference_of(hvsq: &Hvsq, image: ImageView<'_, f32>) -> HvsqReference {
    let device = DEVICE.with_borrow(Device::clone);
    let reference = hvsq.reference_on(image, &device).expect("valid");
    assert_eq!(reference.is_on_gpu(), gazesplat_render::is_gpu(&device));
    reference
}

/// The bodies of tests once more, with references that live on a GPU.
macro_rules! on_gpu {
    ($($body:ident),+ $(,)?) => {
        mod on_gpu {
            $(
                #[test]
                fn $body() {
                    let opened = gazesplat_render::device::gpu_device(None);
                    let Some(gpu) = gazesplat_testkit::devices::required_gpu(opened) else { return };
                    super::DEVICE.set(gpu);
                    super::$body();
                }
            )+
        }
    };
}

on_gpu!(
    golden_formula_uniform,
    golden_formula_gaze,
    golden_formula_gradients,
    golden_formula_regions,
    golden_formula_resized,
    golden_rtgs_values_and_gradients,
);

const DISTANCES: [(&str, Distance); 2] = [("MSE", Distance::Mse), ("L1", Distance::L1)];

fn formula() -> Value {
    golden::find("hvsq_formula").expect("shipped").load_json()
}

fn number(json: &Value) -> f64 {
    json.as_f64().unwrap_or_else(|| panic!("no number but {json}"))
}

fn assert_relative(found: f64, expected: &Value, bound: f64, what: &str) {
    let error = (found / number(expected) - 1.0).abs();
    println!("{what}: {found:e}, off by {error:.1e}");
    assert!(error <= bound, "{what}: {found:e} instead of {expected}, off by {error:e}");
}

fn view(data: &[f32], width: usize, height: usize, channels: usize) -> ImageView<'_, f32> {
    ImageView { width, height, channels, data }
}

fn uniform(size_px: f64) -> Pooling {
    Pooling::Uniform { size_px }
}

fn gaze(x: f64, y: f64, grid: PixelGrid) -> Pooling {
    Pooling::Gaze(GazePooling { gaze: Gaze::new(x, y).expect("finite"), grid, ..GazePooling::default() })
}

/// Value and gradient of formula image b against a, 96 × 160, the gradient `[height, width, 3]`.
fn of_formula(pooling: Pooling, distance: Distance) -> (f64, Vec<f32>) {
    let [a, b] = pair(96, 160).map(|i| interleaved(&i, 3));
    let hvsq = Hvsq::new(pooling, distance).expect("valid");
    let reference = reference_of(&hvsq, view(&a, 160, 96, 3));
    let (value, gradient) = reference.value_and_gradient(view(&b, 160, 96, 3)).expect("same size");
    let alone = reference.value(view(&b, 160, 96, 3)).expect("same size");
    if reference.is_on_gpu() {
        // Another kernel, whose products the driver may fuse otherwise.
        assert!((alone / value - 1.0).abs() < VALUE, "the value alone: {alone:e} {value:e}");
    } else {
        assert_eq!(alone, value, "the value alone");
    }
    (value, gradient)
}

#[test]
fn golden_formula_uniform() {
    let json = formula();
    for p in [1, 3, 7, 12, 32] {
        for (name, distance) in DISTANCES {
            let key = format!("ps{p}_{name}");
            let (value, _) = of_formula(uniform(f64::from(p)), distance);
            assert_relative(value, &json["hvsq_uniform"][&key]["f64"], VALUE, &key);
        }
    }
}

#[test]
fn golden_formula_gaze() {
    let json = formula();
    for [x, y] in [[0.5, 0.5], [0.25, 0.75]] {
        for (grid, field) in [(PixelGrid::EndPoints, "end_points_f64"), (PixelGrid::Centres, "centres_f64")] {
            for (name, distance) in DISTANCES {
                let key = format!("gaze[{x}, {y}]_{name}");
                let (value, _) = of_formula(gaze(x, y, grid), distance);
                assert_relative(value, &json["hvsq_gaze"][&key][field], VALUE, &format!("{key} {field}"));
            }
        }
    }
}

#[test]
fn golden_formula_gradients() {
    let json = formula();
    for (key, expected) in json["gradient"].as_object().expect("an object").iter().filter(|(k, _)| *k != "note") {
        let distance = if key.ends_with("L1") { Distance::L1 } else { Distance::Mse };
        let size = key.strip_prefix("ps").and_then(|k| k.split('_').next()).and_then(|p| p.parse().ok());
        let pooling = size.map_or(gaze(0.25, 0.75, PixelGrid::Centres), uniform);
        let (value, gradient) = of_formula(pooling, distance);
        let bound = gradient_tolerance(distance);
        assert_relative(value, &expected["value"], VALUE, key);
        let at = |c: usize, y: usize, x: usize| f64::from(gradient[(y * 160 + x) * 3 + c]);
        let l2 = gradient.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        assert_relative(l2, &expected["l2"], bound, &format!("{key} l2"));
        // Sums and samples are held to the same part of the norm as the whole gradient: they are projections of it.
        let (mut sum, mut hash, mut hash_norm) = (0.0, 0.0, 0.0f64);
        for c in 0..3 {
            for y in 0..96 {
                for x in 0..160 {
                    let weight = ((x * 7 + y * 13 + c * 29) % 17) as f64 - 8.0;
                    sum += at(c, y, x);
                    hash += weight * at(c, y, x);
                    hash_norm += weight * weight;
                }
            }
        }
        let norm = number(&expected["l2"]);
        let num = (gradient.len() as f64).sqrt();
        for (name, found, weights) in [("sum", sum, num), ("dot_hash", hash, hash_norm.sqrt())] {
            let error = (found - number(&expected[name])).abs();
            assert!(error <= bound * norm * weights, "{key} {name}: {found:e}, off by {error:e}");
        }
        let mut worst = 0.0f64;
        for (place, expected) in expected["samples"].as_object().expect("samples") {
            let i: Vec<usize> = place.split(',').map(|v| v.parse().expect("an index")).collect();
            worst = worst.max((at(i[0], i[1], i[2]) - number(expected)).abs());
        }
        // A sample may be off by what an L1 sign that flips changes, a few times the root mean square.
        let rms = norm / num;
        let samples = if distance == Distance::L1 { 0.1 * rms } else { 1e-3 * rms };
        assert!(worst <= samples, "{key}: sample off by {worst:e}, rms {rms:e}");
    }
}

#[test]
fn golden_formula_regions() {
    let json = formula();
    let [a, b] = pair(96, 160).map(|i| interleaved(&i, 3));
    let hvsq = Hvsq::new(uniform(3.0), Distance::Mse).expect("valid");
    let reference = reference_of(&hvsq, view(&a, 160, 96, 3));
    let labels: Vec<u8> = (0..96 * 160).map(|i| u8::from(i % 160 >= 56)).collect();
    let found = reference.by_region(view(&b, 160, 96, 3), &labels, 3).expect("same size");
    let [Some(inside), Some(outside), None] = found[..] else { panic!("{found:?}") };
    assert_relative(inside, &json["region"]["inside"], VALUE, "inside");
    assert_relative(outside, &json["region"]["outside"], VALUE, "outside");
    let fraction = number(&json["region"]["fraction"]);
    let whole = fraction * inside + (1.0 - fraction) * outside;
    assert_relative(whole, &json["region"]["whole"], VALUE, "whole");
}

#[test]
fn golden_formula_resized() {
    let json = formula();
    for p in [1, 3, 12] {
        for (name, distance) in DISTANCES {
            let [a, b] = pair(90, 150).map(|i| interleaved(&i, 5));
            let hvsq = Hvsq::new(uniform(f64::from(p)), distance).expect("valid");
            let reference = reference_of(&hvsq, view(&a, 150, 90, 5));
            let value = reference.value(view(&b, 150, 90, 5)).expect("same size");
            let key = format!("ps{p}_{name}");
            assert_relative(value, &json["resize"][&key], VALUE, &format!("resize {key}"));
        }
    }
}

#[test]
fn golden_formula_pooling_px() {
    let json = formula();
    for (key, expected) in json["pooling_px"].as_object().expect("an object").iter().filter(|(k, _)| *k != "note") {
        let (size, point) = key.split_once('_').expect("size and gaze");
        let (h, w) = size.split_once('x').expect("height and width");
        let size: (usize, usize) = (w.parse().expect("a width"), h.parse().expect("a height"));
        let point: Vec<f64> = point.trim_matches(['[', ']']).split(", ").map(|v| v.parse().expect("x, y")).collect();
        for (grid, expected) in [(PixelGrid::EndPoints, expected), (PixelGrid::Centres, &expected["centres"])] {
            let Pooling::Gaze(pooling) = gaze(point[0], point[1], grid) else { unreachable!() };
            let at = |i, j| pooling.pooling_px(size, i, j);
            let mean = (0..size.0 * size.1).map(|i| at(i % size.0, i / size.0)).sum::<f64>() / (size.0 * size.1) as f64;
            for (name, found) in [
                ("corner", at(0, 0)),
                ("centre", at(size.0 / 2, size.1 / 2)),
                ("right_mid", at(size.0 - 1, size.1 / 2)),
                ("mean", mean),
            ] {
                assert_relative(found, &expected[name], VALUE, &format!("{key} {grid:?} {name}"));
            }
        }
    }
}

fn taps(json: &Value, scale: f64) -> Taps {
    std::array::from_fn(|i| std::array::from_fn(|j| number(&json[i][j]) * scale))
}

#[test]
fn golden_formula_filters_are_the_built_in_bank() {
    let filters = &formula()["filters"];
    let bands = filters["bands"].as_array().expect("bands").iter().map(|b| taps(b, 1e-8)).collect();
    let bank = FilterBank::new(taps(&filters["low0"], 1e-8), taps(&filters["high0"], 1e-8), bands).expect("valid");
    assert_eq!(bank, FilterBank::sp5());
}

#[test]
fn golden_rtgs_values_and_gradients() {
    let Some(file) = golden::find("hvsq") else { return };
    let record = file.load();
    let filters = &formula()["filters_2"];
    let bands = filters["bands"].as_array().expect("bands").iter().map(|b| taps(b, 1e-8)).collect();
    let two = FilterBank::new(taps(&filters["low0"], 1.0), taps(&filters["high0"], 1e-8), bands).expect("valid");
    let (reference, altered) = (record.f32("ref"), record.f32("alt"));
    let mut num_found = 0;
    for (name, config) in record.json.as_object().expect("an object").iter().filter(|(k, _)| k.starts_with("rtgs_")) {
        let pooling = if config["kind"] == "uniform" {
            uniform(number(&config["pooling_size"]))
        } else {
            let size = (number(&config["real_image_width"]), number(&config["real_viewing_distance"]));
            Pooling::Gaze(GazePooling {
                display: Display::from_size(size.0, size.1).expect("possible"),
                gaze: Gaze::new(number(&config["gaze"][0]), number(&config["gaze"][1])).expect("finite"),
                alpha: number(&config["alpha"]),
                growth: Growth::Quadratic,
                grid: PixelGrid::EndPoints,
            })
        };
        let distance = if config["loss_type"] == "L1" { Distance::L1 } else { Distance::Mse };
        let bank = if number(&config["n_orientations"]) == 2.0 { two.clone() } else { FilterBank::sp5() };
        let hvsq = Hvsq::with_bank(pooling, distance, bank).expect("valid");
        let reference = reference_of(&hvsq, view(&reference, 96, 64, 3));
        let (value, gradient) = reference.value_and_gradient(view(&altered, 96, 64, 3)).expect("same size");
        assert_relative(value, &config["loss"], VALUE, name);
        let d = difference(&gradient, &record.f64(&format!("{name}.grad_alt")));
        println!("{name} gradient: relative L2 {:.1e}", d.relative_l2);
        assert!(d.relative_l2 <= gradient_tolerance(distance), "{name}: gradient off by {:e}", d.relative_l2);
        num_found += 1;
    }
    assert_eq!(num_found, 8);
}

/// Tolerance of §12, test 17.
const PLAIN: f64 = 1e-5;

#[test]
fn golden_plain_values_regions_and_gradients() {
    let Some(file) = golden::find("hvsq") else { return };
    let record = file.load();
    let json = &record.json["plain"];
    let camera = |key: &str| number(&json[key]) as f32;
    let camera =
        Pinhole { width: 96, height: 64, fx: camera("fx"), fy: camera("fy"), cx: camera("cx"), cy: camera("cy") };
    let labels: Vec<u8> = record.int("plain.region").iter().map(|v| *v as u8).collect();
    for (name, growth) in [("quadratic", Growth::Quadratic), ("linear", Growth::Linear)] {
        let config = &record.json[format!("plain.{name}")];
        let gaze_px = [0, 1].map(|i| number(&json["gaze_px"][i]));
        let pooling = PlainPooling { camera, gaze_px, scale: number(&config["scale"]), growth };
        let (reference, altered) = (record.f32("ref"), record.f32("alt"));
        let found = pooling.compare(view(&reference, 96, 64, 3), view(&altered, 96, 64, 3)).expect("valid");
        let radii: Vec<i64> = (0..96 * 64).map(|i| pooling.radius_px(i % 96, i / 96) as i64).collect();
        assert_eq!(radii, record.int(&format!("plain.{name}.pool_radius_px")), "{name}");
        assert_relative(found.value, &config["hvsq"], PLAIN, name);
        for (k, value) in found.by_region(&labels, 4).into_iter().enumerate() {
            let expected = &config["per_region"][format!("L{}", k + 1)];
            assert_relative(value.expect("not empty"), expected, PLAIN, &format!("{name} region {k}"));
        }
        let d = difference(&found.per_pixel, &record.f64(&format!("plain.{name}.per_pixel")));
        assert!(d.relative_l2 <= PLAIN, "{name} per pixel: {d:?}");
        let d = difference(&found.v_altered, &record.f64(&format!("plain.{name}.grad_alt")));
        assert!(d.relative_l2 <= PLAIN, "{name} gradient: {d:?}");
    }
    let pooling = PlainPooling { camera, gaze_px: [30.0, 40.0], scale: 1.0, growth: Growth::Linear };
    let e: Vec<f64> = (0..96 * 64).map(|i| pooling.eccentricity_rad(i % 96, i / 96)).collect();
    let d = difference(&e, &record.f64("plain.eccentricity_rad"));
    // The record's arc cosine loses digits near the gaze.
    assert!(d.max_abs < 1e-7, "{d:?}");
}
