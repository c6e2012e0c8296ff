//! Counters against the golden record `work_stats` (`tests/golden/README.md`).

use gazesplat_render::{RenderOptions, StatsMode};
use gazesplat_testkit::{Tolerance, assert_close, golden};

use crate::common::Scene;
use crate::golden::{fragile, scene};

/// Pixels at a threshold can move a count; everything else is exact.
#[test]
fn golden_work_stats_equal_the_counters() {
    let Some(file) = golden::find("work_stats") else {
        println!("SKIPPED: no work_stats.json in {:?}", golden::golden_dirs());
        return;
    };
    let stats = file.load();
    let names = stats.json.as_object().expect("work_stats.json holds one object per scene").keys().cloned();
    let mut compared = 0;
    for name in names.collect::<Vec<_>>() {
        let Some(file) = golden::find(&format!("render_{name}")) else {
            println!("SKIPPED: work_stats of {name}: no render_{name}.json");
            continue;
        };
        let record = file.load();
        let scene = scene(&record);
        let num_fragile = fragile(&record, &scene).iter().filter(|f| **f).count() as i64;
        let scene = Scene { options: RenderOptions { stats: StatsMode::All, ..scene.options }, ..scene };
        let found = scene.frame().splat_stats;
        // The reference knows which Gaussians reach a fragile pixel.
        let slack = scene.reference();
        let check = |what: &str, found: &[u32], expected: Vec<i64>, slack: &dyn Fn(usize) -> i64| {
            assert_eq!(found.len(), expected.len(), "{name} {what}");
            let mut exact = 0;
            for (i, (&f, e)) in found.iter().zip(expected).enumerate() {
                let off = (i64::from(f) - e).abs();
                assert!(off <= slack(i), "{name} {what} of {i}: found {f}, expected {e}, slack {}", slack(i));
                exact += usize::from(off == 0);
            }
            println!("{name:18} {what:18} {exact} of {} exact", found.len());
        };
        let of = |i: usize| &slack.counters[i];
        let ints = |what: &str| stats.int(&format!("{name}.{what}"));
        check("pixels_blended", &found.pixels_blended, ints("pixels_blended"), &|i| of(i).slack_pixels.into());
        check("pixels_dominated", &found.pixels_dominated, ints("pixels_dominated"), &|i| of(i).slack_dominated.into());
        check("tiles_blended", &found.tiles_blended, ints("tiles16_touched"), &|i| of(i).slack_tiles.into());
        for (i, aabb) in ints("tiles16_aabb_exact").into_iter().enumerate() {
            let (blended, used) = (found.tiles_blended[i], found.tiles_used[i]);
            assert!(blended <= used && i64::from(used) <= aabb, "{name} {i}: {blended} <= {used} <= {aabb}");
        }
        let tolerance = Tolerance::max_abs(1e-5 + if num_fragile > 0 { 1.0 / 255.0 } else { 0.0 });
        assert_close("weight_max", &found.weight_max, &stats.f64(&format!("{name}.weight_max")), tolerance);
        for (i, (&sum, expected)) in found.weight_sum.iter().zip(stats.f64(&format!("{name}.weight_sum"))).enumerate() {
            let sum = sum as f64 / 2f64.powi(32);
            let bound = 1e-5 * expected.max(1.0) + f64::from(of(i).slack_pixels);
            assert!((sum - expected).abs() <= bound, "{name} weight_sum of {i}: found {sum}, expected {expected}");
        }
        compared += 1;
    }
    assert!(compared > 0, "none of the scenes of work_stats is there");
}

crate::common::on_gpu!(golden_work_stats_equal_the_counters,);
