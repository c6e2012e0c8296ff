//! The GPU against the CPU on random scenes: images, gradients, counters; and against itself: the same bits every time.

use gazesplat_render::{StatsMode, Termination};
use gazesplat_testkit::{Tolerance, assert_close};

use crate::common::scenes::{Draw, random, upstream};
use crate::common::{Frame, Gradients, Scene, is_on_gpu, sturdy, with_gpu};

/// Sparse, dense, opaque, tiny, wide and thin; every SH degree; with and without depth; odd sizes; then the
/// first sixteen once more, antialiased.
fn scenes() -> impl Iterator<Item = (u64, Scene)> {
    (0..56).map(|case: u64| {
        let seed = case % 40;
        let sh_degree = (seed % 5) as u32;
        let draw = match seed % 8 {
            0 => Draw { sh_degree, ..Draw::default() },
            1 => Draw { n: 300, size: [101, 67], log_scale: [-4.0, -1.0], sh_degree, ..Draw::default() },
            2 => Draw { n: 120, opacity: [0.5, 0.999], log_scale: [-2.5, 0.0], sh_degree, ..Draw::default() },
            3 => Draw { n: 30, size: [35, 61], log_scale: [-1.5, 0.8], opacity: [0.004, 0.1], ..Draw::default() },
            4 => Draw { n: 700, size: [130, 17], log_scale: [-7.0, -3.0], sh_degree, ..Draw::default() },
            5 => Draw { n: 60, size: [17, 90], log_scale: [-5.0, 0.5], stray: 0.4, sh_degree, ..Draw::default() },
            6 => Draw { n: 1, size: [1, 1], sh_degree, ..Draw::default() },
            _ => Draw { n: 2000, size: [64, 64], log_scale: [-3.5, -2.0], sh_degree, ..Draw::default() },
        };
        let mut scene = random(7000 + seed, draw);
        scene.options.depth = !seed.is_multiple_of(3);
        scene.options.antialiased = case >= 40;
        scene.options.stats = StatsMode::All;
        if seed % 4 == 3 {
            scene.options.termination = Termination::Fixed(0.0);
        }
        (seed, scene)
    })
}

/// A scene, what it is pulled back by, and both on the CPU; pixels at a branch are left out.
struct Case {
    seed: u64,
    scene: Scene,
    upstream: Vec<f32>,
    fragile: Vec<bool>,
    slack: Vec<[u32; 4]>,
    cpu: (Frame, Gradients),
}

fn cases() -> Vec<Case> {
    assert!(!is_on_gpu(), "the CPU comes first");
    let case = |(seed, scene): (u64, Scene)| {
        let reference = scene.reference();
        let channels = scene.channels();
        let mut upstream = upstream(seed, &scene);
        for (pixel, _) in reference.fragile.iter().enumerate().filter(|(_, f)| **f) {
            upstream[pixel * channels..][..channels].fill(0.0);
        }
        let slack = reference.counters.iter();
        let slack = slack.map(|c| [c.slack_pixels, c.slack_dominated, c.slack_tiles, c.slack_pixels]).collect();
        let cpu = scene.frame_and_gradients(&upstream);
        Case { seed, upstream, fragile: reference.fragile.clone(), slack, cpu, scene }
    };
    scenes().map(case).collect()
}

thread_local! {
    static CASES: std::cell::RefCell<Vec<Case>> = const { std::cell::RefCell::new(Vec::new()) };
}

#[test]
fn images_gradients_and_counters_are_those_of_the_cpu() {
    CASES.set(cases());
    with_gpu(|| CASES.with_borrow(|cases| cases.iter().for_each(compare)));
}

/// Tolerances: float32 leaves up to 4e-5 in the gradients of the thinnest needles on either side (`simd_agreement`), a sum
/// of 1e-4; images off fragile pixels were measured to differ by 5e-6 at most, a quarter of the bound. See the output.
fn compare(case: &Case) {
    let Case { seed, scene, upstream, fragile, slack, cpu: (frame, gradients) } = case;
    let (found, found_gradients) = scene.frame_and_gradients(upstream);
    let channels = scene.channels();
    let d = assert_close(
        &format!("image {seed}"),
        &sturdy(&found.image, channels, fragile),
        &sturdy(&frame.image, channels, fragile),
        Tolerance::max_abs(2e-5),
    );
    print!("scene {seed:2}: image {:.1e};", d.max_abs);
    for ((name, found), (_, expected)) in found_gradients.groups().into_iter().zip(gradients.groups()) {
        if expected.iter().all(|v| *v == 0.0) {
            assert!(found.iter().all(|v| *v == 0.0), "scene {seed}: gradient of {name} is not zero");
            continue;
        }
        let d = assert_close(&format!("{name} {seed}"), found, expected, Tolerance::relative_l2(1e-4));
        print!(" {name} {:.1e}", d.relative_l2);
    }
    println!();
    let (f, e) = (&found.splat_stats, &frame.splat_stats);
    for (i, slack) in slack.iter().enumerate() {
        let pairs = [
            ("pixels_blended", f.pixels_blended[i], e.pixels_blended[i], slack[0]),
            ("pixels_dominated", f.pixels_dominated[i], e.pixels_dominated[i], slack[1]),
            ("tiles_blended", f.tiles_blended[i], e.tiles_blended[i], slack[2]),
            ("tiles_used", f.tiles_used[i], e.tiles_used[i], slack[2]),
        ];
        for (what, found, expected, slack) in pairs {
            assert!(
                found.abs_diff(expected) <= slack,
                "scene {seed}, {what} of {i}: found {found}, expected {expected} ± {slack}"
            );
        }
    }
    let totals = |s: &gazesplat_render::RenderStats| {
        [s.num_splats, s.num_culled_non_finite, s.num_visible, s.num_pairs, s.num_pairs_box, s.num_tiles_empty]
    };
    let off: u64 = totals(&found.stats).iter().zip(totals(&frame.stats)).map(|(a, b)| a.abs_diff(b)).sum();
    assert!(off <= 2, "scene {seed}: {:?}, expected {:?}", found.stats, frame.stats);
}

fn twice() {
    for seed in [1, 4] {
        let draw = Draw { n: 3000, size: [213, 150], sh_degree: 2, log_scale: [-4.5, -2.0], ..Draw::default() };
        let mut scene = random(seed, draw);
        scene.options.stats = StatsMode::All;
        let upstream = upstream(seed, &scene);
        let (frame, gradients) = scene.frame_and_gradients(&upstream);
        let (again, again_gradients) = scene.frame_and_gradients(&upstream);
        assert!(frame == again && gradients == again_gradients, "scene {seed}");
    }
}

#[test]
fn one_adapter_gives_the_same_bits_twice() {
    with_gpu(twice);
}

/// Files whose test bodies all run on both processors.
const ON_BOTH: [(&str, &str); 12] = [
    ("antialiased", include_str!("antialiased.rs")),
    ("counters", include_str!("counters.rs")),
    ("depth", include_str!("depth.rs")),
    ("determinism", include_str!("determinism.rs")),
    ("finite_diff", include_str!("finite_diff.rs")),
    ("golden", include_str!("golden.rs")),
    ("golden_work_stats", include_str!("golden_work_stats.rs")),
    ("pose", include_str!("pose.rs")),
    ("random_values", include_str!("random_values.rs")),
    ("stability", include_str!("stability.rs")),
    ("stability_limits", include_str!("stability_limits.rs")),
    ("termination", include_str!("termination.rs")),
];

#[test]
fn every_body_is_listed_for_the_gpu() {
    let cpu_only = [
        // It calls the slice kernels of the CPU by themselves; the image tests judge the projection of the GPU.
        "golden_projections_equal_the_oracle",
        // Threads and clusters are the CPU's; the GPU has its own test of equal bits above.
        "image_gradients_and_counters_are_the_same_bits_on_any_number_of_threads",
        "skipping_whole_clusters_does_not_change_the_image",
        "pose_gradients_are_the_same_bits_on_any_number_of_threads",
        // It takes both.
        "pose_gradients_of_the_gpu_are_those_of_the_cpu",
    ];
    for (file, text) in ON_BOTH {
        let (bodies, listed) =
            text.split_once("on_gpu!(").unwrap_or_else(|| panic!("{file} lists nothing for the GPU"));
        let listed: Vec<&str> = listed.split([',', ')']).map(str::trim).collect();
        let mut lines = bodies.lines().map(str::trim);
        let mut found = 0;
        while lines.by_ref().any(|line| line == "#[test]") {
            let name = lines.next().and_then(|l| l.strip_prefix("fn ")).and_then(|l| l.split('(').next());
            let name = name.expect("a function follows");
            assert!(cpu_only.contains(&name) || listed.contains(&name), "{file}: {name} is not listed");
            found += 1;
        }
        assert!(found > 0, "{file} holds no test");
    }
}
