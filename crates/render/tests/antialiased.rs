//! The antialiased mode: closed forms, gradients against the float64 reference, what it culls, and what it is for.
//! The numerical hazards run in this mode too (`stability`), as do counters, tables, instruction sets and the GPU.

use gazesplat_core::synthetic::{bench_camera, bench_cloud};
use gazesplat_render::{RenderOptions, StatsMode};
use gazesplat_testkit::{Rng, Tolerance, assert_close, difference};

use crate::common::Scene;
use crate::common::scenes::{Draw, camera, empty_cloud, logit, options, push, random, upstream};
use crate::finite_diff::check_against_reference;

fn antialiased(mut scene: Scene) -> Scene {
    scene.options.antialiased = true;
    scene
}

/// Opacity at the centre of one Gaussian whose raw footprint has these standard deviations along the image axes, pixels.
fn centre_alpha(deviations_px: [f32; 2], opacity: f64) -> f32 {
    let view = camera(33, 33, 60.0);
    let depth = 3.0;
    let mut cloud = empty_cloud();
    let [x, y] = deviations_px.map(|d| (d * depth / view.intrinsics.fx).ln());
    push(&mut cloud, [0.0, 0.0, depth], [x, y, -20.0], logit(opacity), [0.9, 0.4, 0.2]);
    let frame = antialiased(Scene { cloud, camera: view, options: options() }).frame();
    frame.image[(16 * 33 + 16) * 5 + 3]
}

#[test]
fn opacity_of_an_axis_aligned_gaussian_is_that_computed_by_hand() {
    for ([x, y], opacity) in [([2.0f64, 0.5], 0.8), ([1.0, 1.0], 0.5), ([0.2, 0.3], 0.9), ([0.05, 8.0], 0.7)] {
        let (vx, vy) = (x * x, y * y);
        let expected = opacity * (vx * vy / ((vx + 0.3) * (vy + 0.3))).sqrt();
        let found = centre_alpha([x as f32, y as f32], opacity);
        // Alpha is 1 − T in float32: three roundings of 6e-8, and the polynomial of the exponential (4e-6).
        assert!((f64::from(found) - expected).abs() < 5e-6, "{x} x {y}: found {found}, expected {expected}");
    }
    // At the floor: 0.9 · 0.005 is just visible.
    assert!((centre_alpha([1e-3, 1e-3], 0.9) - 0.0045).abs() < 1e-6);
}

#[test]
fn effective_opacity_decides_what_is_culled() {
    let view = camera(33, 33, 60.0);
    for (opacity, is_seen) in [(0.9, true), (0.8, true), (0.78, false), (0.5, false)] {
        let mut cloud = empty_cloud();
        push(&mut cloud, [0.0, 0.0, 3.0], [-10.0; 3], logit(opacity), [0.9, 0.4, 0.2]);
        let mut scene = Scene { cloud, camera: view, options: options() };
        scene.options.stats = StatsMode::All;
        assert_eq!(scene.frame().stats.num_visible, 1, "without compensation {opacity} is seen");
        let scene = antialiased(scene);
        let (frame, gradients) = scene.frame_and_gradients(&upstream(3, &scene));
        assert_eq!(frame.stats.num_visible, u64::from(is_seen), "0.005 · {opacity} against 1/255");
        assert_eq!(frame.stats.num_culled_non_finite, 0);
        assert_eq!(gradients.opacity_logits[0] != 0.0, is_seen, "{opacity}");
    }
}

/// The mode changes opacities only: the same image comes of the plain mode and lowered opacities.
#[test]
fn it_equals_the_plain_mode_with_compensated_opacities() {
    let scene = random(60, Draw { n: 200, log_scale: [-4.5, -1.0], ..Draw::default() });
    let reference = |scene: &Scene| {
        let (gaussians, camera, options) =
            (scene.reference_gaussians(), scene.reference_camera(), scene.reference_options());
        (0..gaussians.len())
            .map(|i| gazesplat_testkit::reference::project(&gaussians, i, &camera, &options).map(|p| p.opacity))
            .collect::<Vec<_>>()
    };
    let mode = antialiased(scene.clone());
    let mut lowered = scene;
    for (to, opacity) in lowered.cloud.opacity_logits.iter_mut().zip(reference(&mode)) {
        *to = opacity.map_or(-100.0, logit);
    }
    let (found, expected) = (mode.frame().image, lowered.frame().image);
    let fragile = mode.reference().fragile;
    let (found, expected) = (crate::common::sturdy(&found, 5, &fragile), crate::common::sturdy(&expected, 5, &fragile));
    // Logits of opacities near 1 are good to some ulps; a depth of 8 weighs them.
    assert_close("lowered opacities", &found, &expected, Tolerance::max_abs(2e-5));
}

#[test]
fn gradients_equal_differences_of_the_reference() {
    for seed in 70..76 {
        let log_scale = if seed % 2 == 0 { [-3.5, -0.7] } else { [-5.5, -2.0] };
        let scene = antialiased(random(seed, Draw { n: 12, log_scale, opacity: [0.1, 0.98], ..Draw::default() }));
        check_against_reference(&format!("antialiased {seed}"), &scene, seed, 1e-4);
    }
}

/// Thin in the image, seen edge-on, below a pixel: where det Σ'_raw is smallest.
#[test]
fn gradients_of_thin_and_tiny_gaussians_equal_differences_of_the_reference() {
    let mut rng = Rng::new(77);
    for (name, log_scales) in
        [("needles", [-1.0f32, -4.5, -4.5]), ("discs", [-2.0, -2.0, -7.0]), ("below a pixel", [-4.2, -4.4, -4.6])]
    {
        let mut cloud = empty_cloud();
        for i in 0..30 {
            let mean = [rng.range(-0.7, 0.7), rng.range(-0.5, 0.5), 2.0 + 0.05 * i as f32];
            push(&mut cloud, mean, log_scales, rng.range(2.0, 4.0), std::array::from_fn(|_| rng.range(0.1, 1.0)));
            cloud.quats[i] = std::array::from_fn(|_| rng.normal());
        }
        let scene = antialiased(Scene { cloud, camera: camera(48, 36, 60.0), options: options() });
        assert!(scene.reference().totals.num_blended > 50, "{name} are seen");
        check_against_reference(name, &scene, 78, 1e-4);
    }
}

#[test]
fn gradients_of_8000_to_1_needles_equal_differences_of_the_reference() {
    // The bound of the plain mode (`finite_diff`).
    let draw = Draw { n: 60, log_scale: [-8.0, 1.0], opacity: [0.004, 0.999], ..Draw::default() };
    check_against_reference("needles", &antialiased(random(503, draw)), 3, 1e-4);
}

/// At the floor the compensation is a constant: the gradients are those of the plain mode with 0.005 of the opacity.
#[test]
fn shape_has_no_gradient_through_opacity_at_the_floor() {
    let mut rng = Rng::new(79);
    let view = camera(48, 36, 60.0);
    let mut cloud = empty_cloud();
    let opacities: Vec<f64> = (0..60).map(|_| rng.range(0.85, 0.99).into()).collect();
    for (i, &opacity) in opacities.iter().enumerate() {
        // Within a third of a pixel of a pixel's centre, or nothing of them is seen.
        let at = [i % 10, i / 10].map(|k| 4.5 + 4.0 * k as f32);
        let depth = 2.0 + 0.1 * i as f32;
        let mean: [f32; 2] = std::array::from_fn(|a| {
            let center = [view.intrinsics.cx, view.intrinsics.cy][a];
            (at[a] + rng.range(-0.1, 0.1) - center) * depth / 60.0
        });
        let log_scales = std::array::from_fn(|_| (rng.range(0.005, 0.03) * depth / 60.0).ln());
        push(&mut cloud, [mean[0], mean[1], depth], log_scales, logit(opacity), [0.9, 0.4, 0.2]);
        cloud.quats[i] = std::array::from_fn(|_| rng.normal());
    }
    let scene = antialiased(Scene { cloud, camera: view, options: options() });
    let mut plain = scene.clone();
    plain.options.antialiased = false;
    plain.cloud.opacity_logits = opacities.iter().map(|o| logit(0.005 * o)).collect();
    let mut weights = upstream(79, &scene);
    for (pixel, _) in scene.reference().fragile.iter().enumerate().filter(|(_, f)| **f) {
        weights[5 * pixel..][..5].fill(0.0);
    }
    let (frame, mut found) = scene.frame_and_gradients(&weights);
    assert!(frame.image.chunks_exact(5).filter(|p| p[3] > 0.0).count() > 30, "most are seen");
    let (_, expected) = plain.frame_and_gradients(&weights);
    // ∂ ln o/∂logit is 1 − o of the opacity as stored.
    for (v, o) in found.opacity_logits.iter_mut().zip(&opacities) {
        *v *= ((1.0 - 0.005 * o) / (1.0 - o)) as f32;
    }
    for ((name, found), (_, expected)) in found.groups().into_iter().zip(expected.groups()) {
        assert!(expected.iter().any(|&v| v != 0.0), "{name} has a gradient");
        // Logits near −5 and 5 are rounded to 5e-7, their opacities as much.
        assert_close(name, found, expected, Tolerance::relative_l2(1e-5));
    }
}

/// Counting and drawing see the same opacities.
#[test]
fn counting_alone_gives_the_counters_of_the_drawn_frame() {
    let mut scene = antialiased(random(80, Draw { n: 400, log_scale: [-5.0, -2.0], ..Draw::default() }));
    let plain = Scene { options: RenderOptions { antialiased: false, ..scene.options.clone() }, ..scene.clone() };
    for stats in [StatsMode::Tiles, StatsMode::Dominance, StatsMode::All] {
        scene.options.stats = stats;
        let (drawn, counted) = (scene.frame(), scene.counted());
        assert!(counted.splat_stats == drawn.splat_stats, "{stats:?}");
        assert_eq!(counted.stats.num_pairs, drawn.stats.num_pairs);
        assert!(drawn.stats.num_pairs < plain.frame().stats.num_pairs, "fainter Gaussians reach fewer tiles");
    }
}

/// Colours of a frame of the bench model, clamped as a viewer shows them, `[H, W, 3]`.
fn shown([width, height]: [usize; 2], antialiased: bool) -> Vec<f32> {
    let options = RenderOptions { antialiased, ..RenderOptions::default() };
    let scene = Scene { cloud: bench_cloud(60_000, 3), camera: bench_camera(width as u32, height as u32), options };
    scene.frame().image.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).map(|c| c.clamp(0.0, 1.0)).collect()
}

/// Means over squares of `factor` pixels.
fn scaled_down(image: &[f32], width: usize, factor: usize) -> Vec<f32> {
    let (w, h) = (width / factor, image.len() / 3 / width / factor);
    let mean = |i: usize| {
        let (x, y, c) = (i / 3 % w, i / 3 / w, i % 3);
        let square = (0..factor * factor).map(|k| (y * factor + k / factor) * width + x * factor + k % factor);
        square.map(|pixel| image[3 * pixel + c]).sum::<f32>() / (factor * factor) as f32
    };
    (0..3 * w * h).map(mean).collect()
}

/// What the mode is for: at a lower resolution a model looks like its own image scaled down.
#[test]
fn lower_resolutions_are_nearer_to_the_scaled_image_than_without() {
    let [width, height] = [480, 320];
    let whole = [false, true].map(|mode| shown([width, height], mode));
    for factor in [2, 4] {
        let error = |mode: bool| {
            let scaled = scaled_down(&whole[usize::from(mode)], width, factor);
            difference(&shown([width / factor, height / factor], mode), &scaled).mean_abs
        };
        let (with, without) = (error(true), error(false));
        println!("1/{factor}: mean difference {with:.4} antialiased, {without:.4} plain");
        assert!(with < without, "1/{factor}: {with} antialiased, {without} plain");
    }
}

crate::common::on_gpu!(
    opacity_of_an_axis_aligned_gaussian_is_that_computed_by_hand,
    effective_opacity_decides_what_is_culled,
    it_equals_the_plain_mode_with_compensated_opacities,
    gradients_equal_differences_of_the_reference,
    gradients_of_thin_and_tiny_gaussians_equal_differences_of_the_reference,
    gradients_of_8000_to_1_needles_equal_differences_of_the_reference,
    shape_has_no_gradient_through_opacity_at_the_floor,
    counting_alone_gives_the_counters_of_the_drawn_frame,
    lower_resolutions_are_nearer_to_the_scaled_image_than_without,
);
