//! Termination tables: against the golden records, against the float64 reference, and in their limits.

use gazesplat_core::color::ColorSpace;
use gazesplat_render::{ColorMax, Residual, StatsMode, Termination, TerminationLut};
use gazesplat_testkit::{Rng, Tolerance, assert_close, difference, golden};

use crate::common::scenes::{Draw, random};
use crate::common::{Scene, devices, interleaved, sturdy};
use crate::golden::scene as golden_scene;

const RESIDUALS: [Residual; 4] = [Residual::Drop, Residual::Background, Residual::Mean, Residual::Centre];

/// A table with random limits in the range of the real ones.
fn table(seed: u64, size: usize) -> TerminationLut {
    let mut rng = Rng::new(seed);
    let values = (0..size.pow(3)).map(|_| rng.range(0.003, 0.03)).collect();
    TerminationLut::new(size, values, ColorSpace::Srgb).expect("legal")
}

fn with(scene: &Scene, lut: TerminationLut) -> Scene {
    let mut scene = scene.clone();
    scene.options.termination = Termination::Lut(lut);
    scene
}

/// Dense scenes, so that most pixels stop; colours exceed 1 and the background is not black.
fn dense() -> Vec<Scene> {
    let draws = [
        Draw { n: 300, size: [101, 67], log_scale: [-2.5, 0.0], opacity: [0.3, 0.999], ..Draw::default() },
        Draw { n: 400, size: [50, 37], log_scale: [-2.0, 0.2], opacity: [0.05, 0.6], sh_degree: 0, ..Draw::default() },
        Draw { n: 250, size: [33, 64], log_scale: [-3.0, 0.5], opacity: [0.5, 0.999], sh_degree: 3, ..Draw::default() },
        // Antialiased.
        Draw { n: 400, size: [64, 41], log_scale: [-3.5, -1.0], opacity: [0.6, 0.999], ..Draw::default() },
    ];
    let scenes = draws.into_iter().enumerate().map(|(seed, draw)| {
        let mut scene = random(900 + seed as u64, draw);
        scene.options.stats = StatsMode::All;
        scene.options.antialiased = seed == 3;
        scene
    });
    scenes.collect()
}

/// The sets of `jnd_render`: table as named, c_max = one, residual = background, 1e-4 beside it.
#[test]
fn golden_frames_with_tables_are_those_of_the_oracle() {
    let Some(record) = golden::find("jnd_render") else {
        println!("SKIPPED: jnd_render is larger than 1 MiB and not here");
        return;
    };
    let (record, tables) = (record.load(), golden::find("jnd_lut").expect("tests/golden holds it").load());
    let keys: Vec<&str> = record.names().filter_map(|n| n.strip_suffix(".color")).collect();
    assert_eq!(keys.len(), 10);
    for key in keys {
        let [scene, lut, gamma] = key.split('.').collect::<Vec<_>>().try_into().expect("scene.lut.gamma");
        let Some(inputs) = golden::find(&format!("render_{scene}")) else {
            println!("SKIPPED: {key}: render_{scene} is larger than 1 MiB and not here");
            continue;
        };
        let values = match lut {
            "vertex_srgb" => tables.f64("grid8.T_vertex_srgb"),
            "hpe_diag" => tables.f64("grid8.dkl.hpe_raw.T_diag"),
            other => panic!("unknown table {other}"),
        };
        let lut = TerminationLut::new(8, values.iter().map(|&v| v as f32).collect(), ColorSpace::Srgb)
            .and_then(|lut| lut.with_gamma(gamma[1..].parse().expect("a number")))
            .and_then(|lut| lut.with_also_fixed(Some(1e-4)))
            .expect("legal")
            .with_residual(Residual::Background)
            .with_color_max(ColorMax::One);
        let inputs = inputs.load();
        // The float32 yardstick of the plain record, five times (see `golden`).
        let bound = 5.0 * inputs.json["yardstick_torch_f32_vs_f64"]["color"].as_f64().expect("a yardstick");
        let mut scene = with(&golden_scene(&inputs), lut);
        scene.options.stats = StatsMode::All;
        let fragile = record.bool(&format!("{key}.fragile"));
        let num_fragile = fragile.iter().filter(|f| **f).count();
        for (name, device) in devices() {
            let frame = scene.frame_on(&device);
            let rgb: Vec<f32> = frame.image.chunks_exact(frame.channels).flat_map(|p| p[..3].to_vec()).collect();
            let alpha: Vec<f32> = frame.image.chunks_exact(frame.channels).map(|p| 1.0 - p[3]).collect();
            let color =
                difference(&sturdy(&rgb, 3, &fragile), &sturdy(&record.f64(&format!("{key}.color")), 3, &fragile));
            let t =
                difference(&sturdy(&alpha, 1, &fragile), &sturdy(&record.f64(&format!("{key}.T_final")), 1, &fragile));
            let blended: i64 = record.int(&format!("{key}.n_blended")).iter().sum();
            println!(
                "{name} {key:30} colour {:.1e} (bound {bound:.1e}), T {:.1e}, blended {} of {blended}",
                color.max_abs, t.max_abs, frame.stats.num_blended
            );
            assert!(color.max_abs <= bound && t.max_abs <= bound, "{name} {key}: {color:?} {t:?}");
            // A pixel that rounding decides otherwise ends one splat earlier or later, seldom more.
            assert!(frame.stats.num_blended.abs_diff(blended as u64) <= 4 * num_fragile as u64, "{name} {key}");
        }
    }
}

/// Every residual, both bounds, tables in workgroup memory and in a buffer, a fixed rule beside them, γ up to where pixels
/// stop before anything is blended: images and counters of the float64 reference.
#[test]
fn frames_with_tables_are_those_of_the_reference() {
    let cases: Vec<(Residual, ColorMax, usize, f32, Option<f32>)> = vec![
        (Residual::Drop, ColorMax::Tile, 8, 1.0, None),
        (Residual::Background, ColorMax::One, 8, 2.0, Some(1e-4)),
        (Residual::Mean, ColorMax::Tile, 17, 1.0, None),
        (Residual::Centre, ColorMax::Tile, 8, 1.0, None),
        (Residual::Centre, ColorMax::One, 5, 10.0, Some(0.01)),
        (Residual::Centre, ColorMax::Tile, 1, 0.25, None),
        (Residual::Mean, ColorMax::Tile, 2, 1000.0, None),
    ];
    for (s, scene) in dense().iter().enumerate() {
        for (c, &(residual, color_max, size, gamma, also_fixed)) in cases.iter().enumerate() {
            let lut = table(c as u64, size)
                .with_gamma(gamma)
                .and_then(|lut| lut.with_also_fixed(also_fixed))
                .expect("legal")
                .with_residual(residual)
                .with_color_max(color_max);
            let scene = with(scene, lut);
            let reference = scene.reference();
            let num_fragile = reference.fragile.iter().filter(|f| **f).count();
            assert!(num_fragile * 5 < reference.fragile.len(), "scene {s}, case {c}: {num_fragile} fragile pixels");
            for (name, device) in devices() {
                let what = format!("{name}, scene {s}, case {c}");
                let frame = scene.frame_on(&device);
                let channels = frame.channels;
                let d = assert_close(
                    &what,
                    &sturdy(&frame.image, channels, &reference.fragile),
                    &sturdy(&interleaved(&reference, channels), channels, &reference.fragile),
                    // That of `gpu_equals_cpu`; depths of these scenes reach 8.
                    Tolerance::max_abs(8.0 * 2e-5),
                );
                println!("{what}: {:.1e}, {num_fragile} fragile, {} blended", d.max_abs, frame.stats.num_blended);
                for (i, e) in reference.counters.iter().enumerate() {
                    let f = &frame.splat_stats;
                    for (kind, found, expected, slack) in [
                        ("pixels_blended", f.pixels_blended[i], e.pixels_blended, e.slack_pixels),
                        ("pixels_dominated", f.pixels_dominated[i], e.pixels_dominated, e.slack_dominated),
                        ("tiles_used", f.tiles_used[i], e.tiles_used, e.slack_tiles),
                    ] {
                        assert!(
                            found.abs_diff(expected) <= slack,
                            "{what}: {kind} of {i}: {found}, {expected} ± {slack}"
                        );
                    }
                }
            }
        }
    }
}

#[test]
fn gamma_zero_is_the_fixed_rule_bit_for_bit() {
    for scene in dense() {
        for fixed in [0.0, 1e-4] {
            let mut plain = scene.clone();
            plain.options.termination = Termination::Fixed(fixed);
            let expected = plain.frame();
            for residual in RESIDUALS {
                let lut = table(1, 8).with_gamma(0.0).and_then(|lut| lut.with_also_fixed(Some(fixed)));
                let found = with(&scene, lut.expect("legal").with_residual(residual)).frame();
                assert!(found == expected, "{residual:?} beside {fixed}");
            }
            if fixed == 0.0 {
                let found = with(&scene, table(1, 8).with_gamma(0.0).expect("legal")).frame();
                assert!(found == expected, "without a fixed rule");
            }
        }
    }
}

#[test]
fn looking_at_every_step_changes_no_bit() {
    for scene in dense() {
        for (size, gamma) in [(8, 1.0), (8, 20.0), (11, 0.5)] {
            for color_max in [ColorMax::Tile, ColorMax::One] {
                let lut = table(2, size).with_gamma(gamma).expect("legal").with_color_max(color_max);
                let eager = with(&scene, lut.clone().with_eager_lookup()).frame();
                assert!(with(&scene, lut).frame() == eager, "size {size}, γ {gamma}, {color_max:?}");
            }
        }
    }
}

/// Colours so bright that the limits end where f32 does: a pixel then stops by the floor, and every tile ends in its list.
#[test]
fn colors_beyond_all_limits_end_every_tile() {
    let draw = Draw { n: 400, size: [50, 37], log_scale: [-0.5, 0.5], opacity: [0.99, 0.9999], ..Draw::default() };
    let mut scene = random(77, draw);
    scene.options.stats = StatsMode::All;
    for (i, coefficient) in scene.cloud.sh.iter_mut().enumerate() {
        *coefficient = coefficient.map(|v| if i % 3 == 0 { v.abs() * 1e38 } else { v });
    }
    for gamma in [1e-6, 1.0] {
        let lut = table(4, 8).with_gamma(gamma).expect("legal").with_residual(Residual::Centre);
        let scene = with(&scene, lut);
        for (name, device) in devices() {
            let frame = scene.frame_on(&device);
            let tiles = &frame.splat_stats.tiles;
            assert!(tiles.num_pairs.iter().any(|&n| n > 50), "lists are long");
            let within = tiles.num_pairs_used.iter().zip(&tiles.num_pairs).all(|(used, n)| used <= n);
            assert!(within, "{name}, γ {gamma}: {:?} of {:?}", tiles.num_pairs_used, tiles.num_pairs);
            assert!(frame.stats.num_pairs_used < frame.stats.num_pairs, "{name}: pixels do stop");
            assert!(frame.image.iter().all(|v| !v.is_nan()), "{name}, γ {gamma}");
        }
    }
}

#[test]
fn frames_do_not_depend_on_the_counters_asked_for() {
    for scene in dense() {
        let scene = with(&scene, table(3, 8));
        let full = scene.frame();
        for stats in [StatsMode::None, StatsMode::Tiles, StatsMode::Dominance] {
            let mut less = scene.clone();
            less.options.stats = stats;
            let frame = less.frame();
            assert!(frame.image == full.image, "{stats:?}");
            if stats != StatsMode::None {
                assert_eq!(frame.splat_stats.tiles_used, full.splat_stats.tiles_used, "{stats:?}");
            }
        }
    }
}

/// A larger γ stops no pixel later; with 1e-4 beside the table no pixel blends more than under 1e-4 alone.
#[test]
fn blends_fall_with_gamma_and_never_exceed_the_fixed_rule() {
    for scene in dense() {
        let mut plain = scene.clone();
        plain.options.termination = Termination::Fixed(1e-4);
        let fixed = plain.frame().splat_stats.pixels_blended;
        let mut before = u64::MAX;
        for gamma in [0.1, 0.5, 1.0, 2.0, 5.0, 20.0] {
            let lut = table(4, 8).with_gamma(gamma).and_then(|lut| lut.with_also_fixed(Some(1e-4)));
            let frame = with(&scene, lut.expect("legal")).frame();
            for (found, fixed) in frame.splat_stats.pixels_blended.iter().zip(&fixed) {
                assert!(found <= fixed, "γ {gamma}");
            }
            assert!(frame.stats.num_blended <= before, "γ {gamma}");
            before = frame.stats.num_blended;
        }
    }
}

#[test]
fn pixels_that_work_through_their_list_keep_the_background() {
    for residual in RESIDUALS {
        let mut scene = random(31, Draw { n: 3, opacity: [0.1, 0.3], log_scale: [-4.0, -3.0], ..Draw::default() });
        let expected = scene.frame().image;
        scene.options.termination = Termination::Lut(table(5, 8).with_residual(residual));
        assert!(scene.frame().image == expected, "{residual:?}");
    }
}

#[test]
fn passes_with_gradients_and_linear_tables_are_refused() {
    let scene = random(32, Draw::default());
    let mut options = scene.options.clone();
    options.termination = Termination::Lut(table(6, 8));
    options.pass = gazesplat_render::Pass::Train;
    assert!(scene.refusal(&options).is_some_and(|e| e.to_string().contains("gradients")));
    options.pass = gazesplat_render::Pass::Inference;
    assert!(scene.refusal(&options).is_none());
    options.background[1] = -0.1;
    assert!(scene.refusal(&options).is_some_and(|e| e.to_string().contains("no negative channel")));
    options.background[1] = 0.0;
    // Also where the model is tracked, whatever the options say.
    let tracked = gazesplat_render::Splats::from_cloud(&scene.cloud, &crate::common::device().autodiff())
        .expect("fits")
        .require_grad();
    let refused = gazesplat_render::render(&tracked, &scene.camera, &options).err();
    assert!(refused.is_some_and(|e| e.to_string().contains("tracked")));
    options.termination = Termination::Lut(table(6, 8).read_as(ColorSpace::Linear));
    assert!(scene.refusal(&options).is_some_and(|e| e.to_string().contains("linear light")));
}

crate::common::on_gpu!(
    golden_frames_with_tables_are_those_of_the_oracle,
    frames_with_tables_are_those_of_the_reference,
    gamma_zero_is_the_fixed_rule_bit_for_bit,
    looking_at_every_step_changes_no_bit,
    colors_beyond_all_limits_end_every_tile,
    frames_do_not_depend_on_the_counters_asked_for,
    blends_fall_with_gamma_and_never_exceed_the_fixed_rule,
    pixels_that_work_through_their_list_keep_the_background,
    passes_with_gradients_and_linear_tables_are_refused,
);
