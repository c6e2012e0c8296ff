//! Counters of Gaussians and frames against the float64 reference and closed forms.

use gazesplat_render::{SplatStats, StatsMode};
use gazesplat_testkit::reference;

use crate::common::scenes::{Draw, camera, empty_cloud, logit, options, push_disc, random};
use crate::common::{Frame, Scene};

fn counted(scene: &Scene) -> (Frame, SplatStats) {
    let mut scene = scene.clone();
    scene.options.stats = StatsMode::All;
    let frame = scene.frame();
    let stats = frame.splat_stats.clone();
    (frame, stats)
}

/// Scenes of every kind: sparse, dense, opaque, tiny and wide Gaussians; the last fifty antialiased.
fn scenes() -> impl Iterator<Item = (u64, Scene)> {
    (0..250).map(|seed| {
        let draw = match seed % 5 {
            0 => Draw::default(),
            1 => Draw { n: 150, size: [64, 48], opacity: [0.3, 0.999], ..Draw::default() },
            2 => Draw { n: 30, size: [35, 61], log_scale: [-1.5, 0.8], opacity: [0.004, 0.1], ..Draw::default() },
            3 => Draw { n: 200, size: [70, 70], log_scale: [-7.0, -3.0], ..Draw::default() },
            _ => Draw { n: 60, size: [17, 90], log_scale: [-5.0, 0.5], stray: 0.4, ..Draw::default() },
        };
        let mut scene = random(seed, draw);
        scene.options.antialiased = seed >= 200;
        (seed, scene)
    })
}

#[track_caller]
fn within(what: &str, seed: u64, i: usize, found: u32, expected: u32, slack: u32) {
    assert!(
        found.abs_diff(expected) <= slack,
        "scene {seed}, {what} of {i}: found {found}, expected {expected} ± {slack}"
    );
}

#[test]
fn counters_equal_the_reference_off_fragile_pixels() {
    let (mut exact, mut total) = (0, 0);
    for (seed, scene) in scenes() {
        let (_, found) = counted(&scene);
        let reference = scene.reference();
        for (i, c) in reference.counters.iter().enumerate() {
            within("pixels_blended", seed, i, found.pixels_blended[i], c.pixels_blended, c.slack_pixels);
            within("pixels_dominated", seed, i, found.pixels_dominated[i], c.pixels_dominated, c.slack_dominated);
            within("tiles_blended", seed, i, found.tiles_blended[i], c.tiles_blended, c.slack_tiles);
            within("tiles_used", seed, i, found.tiles_used[i], c.tiles_used, c.slack_tiles);
            let cut = if c.slack_pixels > 0 { 1.0 / 255.0 } else { 0.0 };
            let off = (f64::from(found.weight_max[i]) - c.weight_max).abs();
            assert!(off <= 1e-4 + cut, "scene {seed}, weight_max of {i} is off by {off}");
            let sum = found.weight_sum[i] as f64 / 2f64.powi(32);
            // Strays right before the camera have their centres thousands of pixels away: measured up to 7e-5.
            let bound = 3e-4 * (1.0 + c.weight_sum) + f64::from(c.slack_pixels);
            assert!(
                (sum - c.weight_sum).abs() <= bound,
                "scene {seed}, weight_sum of {i}: {sum}, expected {}",
                c.weight_sum
            );
            exact += usize::from(c.slack_pixels == 0 && c.slack_tiles == 0);
            total += 1;
        }
    }
    println!("{exact} of {total} Gaussians are compared exactly");
    assert!(2 * exact > total, "most Gaussians are compared exactly");
}

#[test]
fn sums_over_gaussians_are_the_totals_of_the_frame() {
    for (seed, scene) in scenes() {
        let (frame, found) = counted(&scene);
        let sum = |values: &[u32]| values.iter().map(|&v| u64::from(v)).sum::<u64>();
        assert_eq!(sum(&found.tiles_used), frame.stats.num_pairs_used, "scene {seed}");
        assert_eq!(sum(&found.pixels_blended), frame.stats.num_blended, "scene {seed}");
        let covered = frame.image.chunks_exact(frame.channels).filter(|p| p[3] > 0.0).count() as u64;
        assert_eq!(sum(&found.pixels_dominated), covered, "scene {seed}");
        for (blended, used) in found.tiles_blended.iter().zip(&found.tiles_used) {
            assert!(blended <= used, "scene {seed}");
        }
        let stats = frame.stats;
        assert_eq!(stats.num_splats, scene.cloud.len() as u64);
        assert!(stats.num_pairs_used <= stats.num_pairs && stats.num_pairs <= stats.num_pairs_box, "{stats:?}");
        assert!(stats.num_visible <= stats.num_splats && stats.num_tiles_empty <= stats.num_tiles, "{stats:?}");
        assert!(stats.num_blended <= stats.num_lane_pixels && stats.num_lane_pixels % 16 == 0, "{stats:?}");
    }
}

#[test]
fn totals_of_the_frame_equal_the_reference() {
    for (seed, scene) in scenes() {
        let (frame, _) = counted(&scene);
        let reference::Totals {
            num_visible,
            num_pairs,
            num_pairs_used,
            num_blended,
            num_tiles,
            num_tiles_empty,
            fragile_pairs,
        } = scene.reference().totals;
        let fragile = scene.reference().fragile.iter().filter(|f| **f).count() as u64;
        let stats = frame.stats;
        let close = |what: &str, found: u64, expected: u64, slack: u64| {
            assert!(found.abs_diff(expected) <= slack, "scene {seed}: {what} {found}, expected {expected} ± {slack}");
        };
        // Visible by bounding box: every Gaussian with a pair, and few besides.
        assert!(
            stats.num_visible + fragile_pairs >= num_visible && stats.num_visible <= num_boxes(&scene),
            "scene {seed}: {stats:?}"
        );
        close("num_pairs", stats.num_pairs, num_pairs, fragile_pairs);
        close("num_tiles", stats.num_tiles, num_tiles, 0);
        close("num_tiles_empty", stats.num_tiles_empty, num_tiles_empty, fragile_pairs);
        // A pixel that stops elsewhere moves the end of its tile by as much as the list is long.
        let reach = if fragile > 0 { scene.cloud.len() as u64 * fragile } else { 0 };
        close("num_pairs_used", stats.num_pairs_used, num_pairs_used, fragile_pairs + reach);
        close("num_blended", stats.num_blended, num_blended, reach);
    }
}

/// Gaussians whose contour α = 1/255 has a bounding box that meets the image.
fn num_boxes(scene: &Scene) -> u64 {
    let (gaussians, camera, options) =
        (scene.reference_gaussians(), scene.reference_camera(), scene.reference_options());
    let size = [camera.width as f64, camera.height as f64];
    let projected = (0..gaussians.len()).filter_map(|i| reference::project(&gaussians, i, &camera, &options));
    let meets = |p: &reference::Projected| {
        let power2 = 2.0 * (255.0 * p.opacity).ln();
        [0, 1].into_iter().all(|a| {
            let half = (power2 * p.cov2d[2 * a]).max(0.0).sqrt() * 1.0001 + 1e-3;
            p.mean2d[a] + half >= 0.0 && p.mean2d[a] - half <= size[a]
        })
    };
    projected.filter(meets).count() as u64
}

/// Without early stops `tiles_used` counts the pairs of a Gaussian: the set itself is compared.
#[test]
fn pairs_are_those_whose_alpha_reaches_the_cut_at_pixel_centres() {
    let mut pairs = 0;
    for seed in 0..60 {
        let draw = Draw { n: 25, size: [75, 58], log_scale: [-6.0, 0.3], opacity: [0.004, 0.3], ..Draw::default() };
        let mut scene = random(1000 + seed, draw);
        scene.options.termination = gazesplat_render::Termination::Fixed(0.0);
        let (frame, found) = counted(&scene);
        let reference = scene.reference();
        let mut expected = vec![0; scene.cloud.len()];
        for &i in reference.tile_lists.iter().flatten() {
            expected[i as usize] += 1;
        }
        for (i, (&found, &expected)) in found.tiles_used.iter().zip(&expected).enumerate() {
            within("pairs", seed, i, found, expected, u32::from(reference.totals.fragile_pairs > 0));
        }
        assert!(frame.stats.num_pairs.abs_diff(reference.totals.num_pairs) <= reference.totals.fragile_pairs);
        pairs += frame.stats.num_pairs;
    }
    assert!(pairs > 5000, "{pairs} pairs were compared");
}

#[test]
fn modes_fill_what_they_say() {
    let mut scene = random(4, Draw::default());
    let n = scene.cloud.len();
    let (_, all) = counted(&scene);
    scene.options.stats = StatsMode::None;
    assert_eq!(scene.frame().splat_stats, SplatStats::default());
    scene.options.stats = StatsMode::Tiles;
    let tiles = scene.frame().splat_stats;
    let expected = SplatStats { tiles_used: all.tiles_used.clone(), tiles: all.tiles.clone(), ..SplatStats::default() };
    assert_eq!(tiles, expected);
    scene.options.stats = StatsMode::Dominance;
    let dominance = scene.frame().splat_stats;
    assert_eq!(dominance.tiles_used, all.tiles_used);
    assert_eq!(dominance.pixels_dominated, all.pixels_dominated);
    assert_eq!(dominance.weight_max, all.weight_max);
    assert!(
        dominance.pixels_blended.is_empty() && dominance.weight_sum.is_empty() && dominance.tiles_blended.is_empty()
    );
    assert_eq!([all.pixels_blended.len(), all.weight_sum.len(), all.tiles_blended.len()], [n; 3]);
    assert!(dominance.blends_of_pixels.is_empty());
    let size = &scene.camera.intrinsics;
    assert_eq!(all.blends_of_pixels.len(), size.width as usize * size.height as usize);
}

/// What pixels count is what Gaussians count, and off fragile pixels what the float64 reference counts.
#[test]
fn blends_of_pixels_are_those_of_the_reference() {
    for seed in 0..6 {
        let mut scene = random(300 + seed, Draw { n: 150, size: [45, 37], opacity: [0.05, 0.9], ..Draw::default() });
        scene.options.stats = StatsMode::All;
        let (frame, found) = counted(&scene);
        assert_eq!(found.blends_of_pixels.iter().map(|&n| u64::from(n)).sum::<u64>(), frame.stats.num_blended);
        let reference = scene.reference();
        let pixels = found.blends_of_pixels.iter().zip(&reference.num_blended).zip(&reference.fragile);
        let mut compared = 0;
        for (i, ((found, expected), _)) in pixels.enumerate().filter(|(_, (_, fragile))| !**fragile) {
            assert_eq!(found, expected, "seed {seed}, pixel {i}");
            compared += 1;
        }
        assert!(compared * 2 > reference.fragile.len(), "seed {seed}: {compared} pixels compared");
    }
}

#[test]
fn training_counts_what_inference_counts() {
    let mut scene = random(6, Draw { n: 120, ..Draw::default() });
    scene.options.stats = StatsMode::All;
    let (training, _) = scene.frame_and_gradients(&vec![1.0; scene.image_len()]);
    assert!(training.splat_stats == scene.frame().splat_stats);
}

/// Counting alone fills what a frame with its image fills, and counters leave the image as it is, bit for bit.
#[test]
fn counting_needs_no_image_and_leaves_it_alone() {
    for (seed, mut scene) in scenes().step_by(9) {
        scene.options.stats = StatsMode::None;
        let plain = scene.frame();
        for mode in [StatsMode::Tiles, StatsMode::Dominance, StatsMode::All] {
            scene.options.stats = mode;
            let frame = scene.frame();
            assert!(frame.image == plain.image, "scene {seed}, {mode:?}");
            let counted = scene.counted();
            assert!(counted.splat_stats == frame.splat_stats, "scene {seed}, {mode:?}");
            assert_eq!(counted.stats.num_pairs, frame.stats.num_pairs, "scene {seed}, {mode:?}");
            assert_eq!(counted.stats.num_pairs_used, frame.stats.num_pairs_used, "scene {seed}, {mode:?}");
            let tiles = &frame.splat_stats.tiles;
            let sum = |counts: &[u32]| counts.iter().map(|&n| u64::from(n)).sum::<u64>();
            assert_eq!(sum(&tiles.num_pairs), frame.stats.num_pairs, "scene {seed}");
            assert_eq!(sum(&tiles.num_pairs_used), frame.stats.num_pairs_used, "scene {seed}");
            assert_eq!(tiles.num_pairs.len() as u64, frame.stats.num_tiles);
            assert!(tiles.num_pairs_used.iter().zip(&tiles.num_pairs).all(|(used, all)| used <= all));
        }
    }
}

#[test]
fn counting_for_gradients_is_refused() {
    let mut scene = random(4, Draw::default());
    scene.options.pass = gazesplat_render::Pass::Train;
    let splats = gazesplat_render::Splats::from_cloud(&scene.cloud, &crate::common::device()).expect("it fits");
    let error = gazesplat_render::count(&splats, &scene.camera, &scene.options).expect_err("refused");
    assert!(error.to_string().contains("pass"), "{error}");
}

#[test]
fn permuting_gaussians_permutes_their_counters() {
    let scene = random(31, Draw { n: 80, ..Draw::default() });
    let (_, found) = counted(&scene);
    let mut reversed = scene.clone();
    let cloud = &mut reversed.cloud;
    cloud.means.reverse();
    cloud.quats.reverse();
    cloud.log_scales.reverse();
    cloud.opacity_logits.reverse();
    let num_coefficients = cloud.num_coefficients();
    cloud.sh = cloud.sh.chunks(num_coefficients).rev().flatten().copied().collect();
    let (_, mut back) = counted(&reversed);
    back.tiles_used.reverse();
    back.pixels_dominated.reverse();
    back.pixels_blended.reverse();
    back.weight_max.reverse();
    back.weight_sum.reverse();
    back.tiles_blended.reverse();
    assert!(back == found);
}

/// Discs (centre in pixels, σ in pixels, opacity), front to back.
fn discs(size: u32, discs: &[([f32; 2], f32, f64)]) -> Scene {
    let view = camera(size, size, 100.0);
    let mut cloud = empty_cloud();
    for (i, &(center, sigma, opacity)) in discs.iter().enumerate() {
        push_disc(&mut cloud, &view, center, sigma, 2.0 + i as f32, logit(opacity), [0.5; 3]);
    }
    Scene { cloud, camera: view, options: options() }
}

#[test]
fn a_wall_hides_what_stands_behind_it() {
    let wall = ([8.0, 8.0], 1000.0, 0.9999);
    let (_, found) = counted(&discs(16, &[wall; 3]));
    assert_eq!(found.tiles_used, [1, 0, 0]);
    assert_eq!(found.pixels_dominated, [256, 0, 0]);
}

#[test]
fn a_tile_ends_where_its_last_pixel_stops() {
    let layer = ([8.0, 8.0], 1000.0, 0.8);
    // 0.2⁵ = 3.2e-4 stays above the stopping transmittance, 0.2⁶ does not: the sixth layer ends every pixel.
    let (_, found) = counted(&discs(16, &[layer; 8]));
    assert_eq!(found.tiles_used, [1, 1, 1, 1, 1, 0, 0, 0]);
}

#[test]
fn one_uncovered_pixel_keeps_the_tile_open() {
    // Layers that end just before the last corner of the tile: α = 1/255 at r = σ √(2 ln(255 · 0.8)) = 3.261 σ.
    let reach = 20.9; // the corner pixel's centre lies 15·√2 = 21.21 from the first one's, its neighbours 20.52
    let layer = ([0.5, 0.5], reach / 3.261, 0.8);
    let covered = ([8.0, 8.0], 1000.0, 0.9999);
    let mut layers = vec![layer; 2];
    layers.extend([covered; 2]);
    let (_, found) = counted(&discs(16, &layers));
    assert_eq!(found.tiles_used[..3], [1, 1, 1]);
    assert_eq!(found.pixels_blended[0], 255);
}

#[test]
fn the_hidden_one_dominates_nothing() {
    let pair = |front: f64| discs(64, &[([32.0, 32.0], 6.0, front), ([32.0, 32.0], 6.0, 0.9)]);
    let (_, found) = counted(&pair(0.99));
    assert_eq!((found.pixels_dominated, found.tiles_used), (vec![1256, 0], vec![12, 12]));
    let (_, found) = counted(&pair(0.3));
    assert_eq!(found.pixels_dominated, [0, 1224]);
    let (_, found) = counted(&pair(0.5));
    assert_eq!(found.pixels_dominated, [24, 1200]);
}

#[test]
fn big_and_faint_against_small_and_strong() {
    let mut all = vec![([32.0, 32.0], 1000.0, 0.02)];
    for k in 0..16 {
        all.push(([8.0 + 16.0 * (k % 4) as f32, 8.0 + 16.0 * (k / 4) as f32], 2.4, 0.9));
    }
    let (_, found) = counted(&discs(64, &all));
    assert_eq!((found.pixels_dominated[0], found.tiles_used[0]), (1856, 16));
    assert!(found.pixels_dominated[1..].iter().all(|&v| v == 140) && found.tiles_used[1..].iter().all(|&v| v == 1));
}

crate::common::on_gpu!(
    counters_equal_the_reference_off_fragile_pixels,
    sums_over_gaussians_are_the_totals_of_the_frame,
    totals_of_the_frame_equal_the_reference,
    pairs_are_those_whose_alpha_reaches_the_cut_at_pixel_centres,
    modes_fill_what_they_say,
    blends_of_pixels_are_those_of_the_reference,
    training_counts_what_inference_counts,
    counting_needs_no_image_and_leaves_it_alone,
    counting_for_gradients_is_refused,
    permuting_gaussians_permutes_their_counters,
    a_wall_hides_what_stands_behind_it,
    a_tile_ends_where_its_last_pixel_stops,
    one_uncovered_pixel_keeps_the_tile_open,
    the_hidden_one_dominates_nothing,
    big_and_faint_against_small_and_strong,
);
