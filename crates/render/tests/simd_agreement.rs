//! Every instruction set gives the same image, gradients and counters, up to rounding. A binary of its own, because the
//! level is a switch of the whole process.

use std::sync::{Mutex, MutexGuard, PoisonError};

use gazesplat_core::color::ColorSpace;
use gazesplat_render::simd::{self, SimdLevel};
use gazesplat_render::{StatsMode, Termination, TerminationLut};
use gazesplat_testkit::{Tolerance, assert_close};

#[expect(dead_code, unused_macros, unused_imports, reason = "this binary needs some of the scenes only")]
mod common;

use common::scenes::{Draw, random, upstream};
use common::{Frame, Gradients, Scene, interleaved, sturdy};

/// One test at a time: the level belongs to the process.
static LEVEL: Mutex<()> = Mutex::new(());

fn lock() -> MutexGuard<'static, ()> {
    LEVEL.lock().unwrap_or_else(PoisonError::into_inner)
}

fn levels() -> Vec<SimdLevel> {
    let (available, missing): (Vec<_>, Vec<_>) = SimdLevel::ALL.into_iter().partition(|l| l.is_available());
    for level in missing {
        println!("SKIPPED: this processor cannot run {level:?}");
    }
    available
}

fn at<T>(level: SimdLevel, run: impl FnOnce() -> T) -> T {
    simd::force_level(Some(level));
    let result = run();
    simd::force_level(None);
    result
}

/// Each of four kinds as it is, then antialiased.
fn scenes() -> Vec<Scene> {
    let draws = [
        Draw::default(),
        Draw { n: 300, size: [101, 67], log_scale: [-4.0, -1.0], sh_degree: 3, ..Draw::default() },
        Draw { n: 120, opacity: [0.5, 0.999], log_scale: [-2.5, 0.0], sh_degree: 0, ..Draw::default() },
        Draw { n: 60, log_scale: [-8.0, 1.0], opacity: [0.004, 0.999], ..Draw::default() },
    ];
    let plain = draws.into_iter().enumerate().map(|(seed, draw)| random(500 + seed as u64, draw));
    let plain: Vec<Scene> = plain.collect();
    let antialiased = plain.iter().cloned().map(|mut scene| {
        scene.options.antialiased = true;
        scene
    });
    plain.iter().cloned().chain(antialiased).collect()
}

/// Renders with gradients that leave fragile pixels out.
fn run(scene: &Scene, level: SimdLevel, weights: &[f32]) -> (Frame, Gradients) {
    let mut scene = scene.clone();
    scene.options.stats = StatsMode::All;
    at(level, || scene.frame_and_gradients(weights))
}

#[test]
fn the_scalar_level_runs_everywhere() {
    assert!(levels().contains(&SimdLevel::Scalar));
}

#[test]
fn every_level_equals_the_reference() {
    let _lock = lock();
    for (k, scene) in scenes().iter().enumerate() {
        let reference = scene.reference();
        let expected = sturdy(&interleaved(&reference, 5), 5, &reference.fragile);
        for level in levels() {
            let frame = at(level, || scene.frame());
            let found = sturdy(&frame.image, 5, &reference.fragile);
            let d = assert_close(&format!("scene {k} at {level:?}"), &found, &expected, Tolerance::max_abs(2e-4));
            println!("scene {k} {level:?}: largest difference from float64 {:.1e}", d.max_abs);
        }
    }
}

#[test]
fn levels_agree_in_image_gradients_and_counters() {
    let _lock = lock();
    for (k, scene) in scenes().iter().enumerate() {
        let reference = scene.reference();
        let mut weights = upstream(k as u64, scene);
        for (pixel, _) in reference.fragile.iter().enumerate().filter(|(_, f)| **f) {
            weights[pixel * 5..][..5].fill(0.0);
        }
        let (plain, plain_gradients) = run(scene, SimdLevel::Scalar, &weights);
        let plain_counters = &plain.splat_stats;
        for level in levels() {
            let what = format!("scene {k}, {level:?} against scalar");
            let (frame, gradients) = run(scene, level, &weights);
            let image = |f: &Frame| sturdy(&f.image, 5, &reference.fragile);
            assert_close(&format!("{what}: image"), &image(&frame), &image(&plain), Tolerance::max_abs(1e-4));
            for ((name, found), (_, expected)) in gradients.groups().into_iter().zip(plain_gradients.groups()) {
                // Two levels differ by at most the sum of their distances from float64, which for the needles of scene 3
                // are up to 2.3e-5 (AVX-512), 4.4e-5 (AVX2) and 2.9e-5 (scalar); elsewhere below 1e-6. The reciprocal
                // estimates of the vendors differ, so one processor may pass a tighter bound than another.
                let bound = if k % 4 == 3 { 1e-4 } else { 5e-6 };
                let d = assert_close(&format!("{what}: {name}"), found, expected, Tolerance::relative_l2(bound));
                println!("{what}: {name:15} {:.1e}", d.relative_l2);
            }
            let counters = &frame.splat_stats;
            for (i, c) in reference.counters.iter().enumerate() {
                let pairs = [
                    (counters.tiles_used[i], plain_counters.tiles_used[i], c.slack_tiles),
                    (counters.tiles_blended[i], plain_counters.tiles_blended[i], c.slack_tiles),
                    (counters.pixels_blended[i], plain_counters.pixels_blended[i], c.slack_pixels),
                    (counters.pixels_dominated[i], plain_counters.pixels_dominated[i], c.slack_dominated),
                ];
                for (found, expected, slack) in pairs {
                    assert!(
                        found.abs_diff(expected) <= slack,
                        "{what}: counters of {i}: {found}, {expected} ± {slack}"
                    );
                }
            }
        }
    }
}

#[test]
fn one_level_gives_the_same_bits_twice() {
    let _lock = lock();
    let scene = &scenes()[1];
    let weights = upstream(9, scene);
    for level in levels() {
        let (frame, gradients) = run(scene, level, &weights);
        let (again, again_gradients) = run(scene, level, &weights);
        assert!(frame == again && gradients == again_gradients, "{level:?}");
    }
}

/// Gathers, clamps and rounding of indices are written per level.
#[test]
fn every_level_stops_by_a_table_as_the_reference_does() {
    let _lock = lock();
    for (k, mut scene) in scenes().into_iter().enumerate() {
        for size in [8, 13] {
            let mut rng = gazesplat_testkit::Rng::new(k as u64);
            let values = (0..size * size * size).map(|_| rng.range(0.003, 0.05)).collect();
            let lut = TerminationLut::new(size, values, ColorSpace::Srgb).expect("legal");
            scene.options.termination = Termination::Lut(lut);
            scene.options.stats = StatsMode::All;
            let reference = scene.reference();
            let expected = sturdy(&interleaved(&reference, 5), 5, &reference.fragile);
            for level in levels() {
                let what = format!("scene {k}, {size} cells, {level:?}");
                let frame = at(level, || scene.frame());
                let found = sturdy(&frame.image, 5, &reference.fragile);
                assert_close(&what, &found, &expected, Tolerance::max_abs(2e-4));
                for (i, c) in reference.counters.iter().enumerate() {
                    let found = frame.splat_stats.pixels_blended[i];
                    assert!(found.abs_diff(c.pixels_blended) <= c.slack_pixels, "{what}: pixels of {i}");
                }
            }
        }
    }
}
