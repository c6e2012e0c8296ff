//! The reference against closed forms and against the golden records of the other, independent model.

use super::*;
use crate::close::{Tolerance, assert_close};
use crate::golden::{Golden, GoldenFile};

fn rows<const D: usize>(values: &[f64]) -> Vec<[f64; D]> {
    values.chunks_exact(D).map(|c| c.try_into().expect("chunks_exact yields D values")).collect()
}

fn shipped(stem: &str) -> Golden {
    let json = crate::data::workspace_root().join(format!("tests/golden/{stem}.json"));
    GoldenFile { stem: stem.into(), json }.load()
}

fn scene(golden: &Golden) -> (Gaussians, Camera, Options) {
    let number = |key: &str| golden.number(key).unwrap_or_else(|| panic!("{}: {key} is missing", golden.stem));
    let gaussians = Gaussians {
        means: rows(&golden.f64("in.means")),
        quats: rows(&golden.f64("in.quats")),
        log_scales: rows(&golden.f64("in.log_scales")),
        opacity_logits: golden.f64("in.opacity_logits"),
        num_coefficients: golden.shape("in.sh")[1],
        sh: rows(&golden.f64("in.sh")),
    };
    let camera = Camera {
        width: number("width") as usize,
        height: number("height") as usize,
        focal: [number("fx"), number("fy")],
        center: [number("cx"), number("cy")],
        camera_from_world: rows(&golden.f64("in.viewmat")).try_into().expect("the matrix has four rows"),
    };
    let options = Options {
        near: number("near"),
        alpha_max: number("alpha_max"),
        // The oracle took the float64 numbers of the JSON, not the float32 array beside it.
        background: std::array::from_fn(|c| golden.json["background"][c].as_f64().expect("the background is RGB")),
        sh_degree: number("sh_degree") as u32,
        antialiased: golden.json["antialiased"].as_bool().unwrap_or(false),
        fragile_rel: 1e-7,
        ..Options::default()
    };
    (gaussians, camera, options)
}

#[test]
fn equals_every_shipped_golden_scene_to_float64_rounding() {
    for stem in [
        "one",
        "two",
        "small64",
        "small64_amax099",
        "small64_aa",
        "sh2",
        "sh3_eval1",
        "near_behind",
        "near02",
        "aniso",
        "tiny",
        "tiny_aa",
        "huge",
        "opaque",
        "quats",
    ] {
        let golden = shipped(&format!("render_{stem}"));
        let (gaussians, camera, options) = scene(&golden);
        let frame = render(&gaussians, &camera, &options);
        let tolerance = Tolerance::max_abs(1e-9);
        assert_close(&format!("{stem} color"), frame.color.as_flattened(), &golden.f64("out.color"), tolerance);
        assert_close(&format!("{stem} alpha"), &frame.alpha, &golden.f64("out.alpha"), tolerance);
        assert_close(&format!("{stem} depth"), &frame.depth, &golden.f64("out.depth_acc"), tolerance);
        let blended: Vec<i64> = frame.num_blended.iter().map(|&n| i64::from(n)).collect();
        assert_eq!(blended, golden.int("out.n_blended"), "{stem} n_blended");
    }
}

#[test]
fn counters_equal_the_golden_work_statistics() {
    let stats = shipped("work_stats");
    for stem in ["opaque", "small64_amax099"] {
        let (gaussians, camera, options) = scene(&shipped(&format!("render_{stem}")));
        let frame = render(&gaussians, &camera, &options);
        let ints = |get: fn(&Counters) -> u32| frame.counters.iter().map(|c| i64::from(get(c))).collect::<Vec<_>>();
        assert_eq!(ints(|c| c.pixels_blended), stats.int(&format!("{stem}.pixels_blended")));
        assert_eq!(ints(|c| c.pixels_dominated), stats.int(&format!("{stem}.pixels_dominated")));
        assert_eq!(ints(|c| c.tiles_blended), stats.int(&format!("{stem}.tiles16_touched")));
        let floats = |get: fn(&Counters) -> f64| frame.counters.iter().map(get).collect::<Vec<_>>();
        let tolerance = Tolerance::max_abs(1e-9);
        assert_close("weight_max", &floats(|c| c.weight_max), &stats.f64(&format!("{stem}.weight_max")), tolerance);
        assert_close("weight_sum", &floats(|c| c.weight_sum), &stats.f64(&format!("{stem}.weight_sum")), tolerance);
        for (c, aabb) in frame.counters.iter().zip(stats.int(&format!("{stem}.tiles16_aabb_exact"))) {
            assert!(c.tiles_blended <= c.tiles_used && i64::from(c.tiles_used) <= aabb);
        }
    }
}

#[test]
fn sums_over_gaussians_equal_sums_over_tiles_and_pixels() {
    let (gaussians, camera, options) = scene(&shipped("render_opaque"));
    let frame = render(&gaussians, &camera, &options);
    let dominated: u32 = frame.counters.iter().map(|c| c.pixels_dominated).sum();
    assert_eq!(dominated as usize, frame.num_blended.iter().filter(|&&n| n > 0).count());
    let used: u64 = frame.counters.iter().map(|c| u64::from(c.tiles_used)).sum();
    assert_eq!(used, frame.totals.num_pairs_used);
    assert!(used < frame.totals.num_pairs, "early termination leaves pairs of this scene unused");
}

#[test]
fn sh_basis_is_orthonormal() {
    // Fibonacci points on the sphere integrate smooth functions well enough for four digits.
    let n = 20_000;
    let mut sums = vec![0.0; 25 * 25];
    for i in 0..n {
        let z = 1.0 - (2.0 * f64::from(i) + 1.0) / f64::from(n);
        let phi = f64::from(i) * std::f64::consts::PI * (3.0 - 5.0f64.sqrt());
        let r = (1.0 - z * z).sqrt();
        let basis = sh_basis(4, [r * phi.cos(), r * phi.sin(), z]);
        for (sum, (a, b)) in sums.iter_mut().zip(basis.iter().flat_map(|&a| basis.iter().map(move |&b| (a, b)))) {
            *sum += a * b * 4.0 * std::f64::consts::PI / f64::from(n);
        }
    }
    for (k, sum) in sums.iter().enumerate() {
        let expected = if k / 25 == k % 25 { 1.0 } else { 0.0 };
        assert!((sum - expected).abs() < 1e-3, "{} {}: {sum}", k / 25, k % 25);
    }
}
