//! Gradients against finite differences: of the renderer itself with a smooth cut, and of the float64 reference.

use gazesplat_core::GaussianCloud;
use gazesplat_render::{Pass, Termination};
use gazesplat_testkit::finite_diff::{central, central_f32};
use gazesplat_testkit::{Rng, Tolerance, assert_close, reference};

use crate::common::scenes::{Draw, empty_cloud, logit, push, random, scene, upstream};
use crate::common::{Gradients, Scene};

/// All parameters in one vector: means, quats, log scales, opacity logits, SH.
fn flatten(cloud: &GaussianCloud) -> Vec<f32> {
    let mut x = cloud.means.as_flattened().to_vec();
    x.extend(cloud.quats.as_flattened());
    x.extend(cloud.log_scales.as_flattened());
    x.extend(&cloud.opacity_logits);
    x.extend(cloud.sh.as_flattened());
    x
}

fn rows<T: Copy, const D: usize>(x: &mut &[T], n: usize) -> Vec<[T; D]> {
    let (head, tail) = x.split_at(n * D);
    *x = tail;
    head.chunks_exact(D).map(|c| std::array::from_fn(|i| c[i])).collect()
}

fn unflatten(cloud: &GaussianCloud, mut x: &[f32]) -> GaussianCloud {
    let n = cloud.len();
    let x = &mut x;
    GaussianCloud {
        means: rows(x, n),
        quats: rows(x, n),
        log_scales: rows(x, n),
        opacity_logits: rows::<_, 1>(x, n).into_iter().flatten().collect(),
        sh_degree: cloud.sh_degree,
        sh: rows(x, n * cloud.num_coefficients()),
    }
}

/// Names and widths of the parameter groups, in the order of [`flatten`].
fn groups(cloud: &GaussianCloud) -> [(&'static str, usize); 5] {
    let sh = 3 * cloud.num_coefficients();
    [("means", 3), ("quats", 4), ("log_scales", 3), ("opacity_logits", 1), ("sh", sh)]
}

/// Compares group by group; the groups of the analytic gradient are those of [`flatten`].
#[track_caller]
fn compare(what: &str, scene: &Scene, gradients: &Gradients, mut expected: &[f64], tolerance: f64) {
    for ((name, width), (_, found)) in groups(&scene.cloud).into_iter().zip(gradients.groups()) {
        let (head, tail) = expected.split_at(width * scene.cloud.len());
        expected = tail;
        let d = assert_close(&format!("{what}: {name}"), found, head, Tolerance::relative_l2(tolerance));
        println!("{what}: {name:15} relative L2 {:.1e}", d.relative_l2);
    }
}

/// Differences of Σ upstream · image of the float64 reference.
fn reference_gradient(scene: &Scene, upstream: &[f32], step: f64) -> Vec<f64> {
    let channels = scene.channels();
    differences(scene, step, |frame| {
        crate::common::interleaved(frame, channels).iter().zip(upstream).map(|(v, &w)| v * f64::from(w)).sum()
    })
}

/// Differences of `loss` of the frame of the float64 reference, in the order of [`flatten`].
pub fn differences(scene: &Scene, step: f64, loss: impl Fn(&reference::Frame) -> f64) -> Vec<f64> {
    let (gaussians, camera, options) =
        (scene.reference_gaussians(), scene.reference_camera(), scene.reference_options());
    let (n, k) = (gaussians.len(), gaussians.num_coefficients);
    let mut loss = |x: &[f64]| {
        let mut x = x;
        let x = &mut x;
        let moved = reference::Gaussians {
            means: rows(x, n),
            quats: rows(x, n),
            log_scales: rows(x, n),
            opacity_logits: rows::<_, 1>(x, n).into_iter().flatten().collect(),
            num_coefficients: k,
            sh: rows(x, n * k),
        };
        loss(&reference::render(&moved, &camera, &options))
    };
    let x: Vec<f64> = flatten(&scene.cloud).into_iter().map(f64::from).collect();
    (0..x.len()).map(|i| central(&mut loss, &x, i, step)).collect()
}

/// The true derivative of the hard-cut renderer, from float64: steps so small that no pixel crosses a branch.
#[track_caller]
pub fn check_against_reference(what: &str, scene: &Scene, seed: u64, tolerance: f64) {
    let mut upstream = upstream(seed, scene);
    let channels = scene.channels();
    for (pixel, _) in scene.reference().fragile.iter().enumerate().filter(|(_, f)| **f) {
        upstream[pixel * channels..][..channels].fill(0.0);
    }
    let (_, gradients) = scene.frame_and_gradients(&upstream);
    compare(what, scene, &gradients, &reference_gradient(scene, &upstream, 1e-7), tolerance);
}

/// Few, smooth, translucent: no pixel stops, float32 differences are meaningful.
fn smooth(seed: u64) -> Scene {
    let draw = Draw { n: 7, size: [28, 21], sh_degree: 2, opacity: [0.15, 0.6], log_scale: [-1.4, -0.4], stray: 0.0 };
    let mut scene = random(seed, draw);
    // SH colours well above the clamp at 0, which is a kink.
    for (row, sh) in scene.cloud.sh.iter_mut().enumerate() {
        *sh = if row % 9 == 0 { sh.map(|v| 1.2 + 0.2 * v) } else { sh.map(|v| 0.3 * v) };
    }
    scene
}

#[test]
fn smooth_cutoff_gradients_equal_differences_of_the_renderer() {
    for (seed, antialiased) in [(0, false), (1, false), (2, false), (3, false), (0, true), (1, true)] {
        let mut scene = smooth(seed);
        scene.options.pass = Pass::SmoothCutoff;
        scene.options.antialiased = antialiased;
        let weights = upstream(seed, &scene);
        let (_, gradients) = scene.frame_and_gradients(&weights);
        let mut probe = scene.clone();
        let mut loss = |x: &[f32]| {
            probe.cloud = unflatten(&scene.cloud, x);
            let image = probe.frame().image;
            image.iter().zip(&weights).map(|(&v, &w)| f64::from(v) * f64::from(w)).sum()
        };
        let x = flatten(&scene.cloud);
        let differences: Vec<f64> = (0..x.len()).map(|i| central_f32(&mut loss, &x, i, 2e-2)).collect();
        compare(&format!("smooth {seed}"), &scene, &gradients, &differences, 1e-2);
    }
}

#[test]
fn gradients_equal_differences_of_the_reference() {
    for seed in 10..16 {
        check_against_reference(
            &format!("random {seed}"),
            &random(seed, Draw { n: 12, ..Draw::default() }),
            seed,
            1e-4,
        );
    }
}

#[test]
fn gradients_through_the_stop_rule_equal_differences_of_the_reference() {
    for seed in 20..23 {
        let draw = Draw { n: 40, size: [24, 20], opacity: [0.6, 0.995], log_scale: [-1.5, 0.0], ..Draw::default() };
        let scene = random(seed, draw);
        check_against_reference(&format!("opaque {seed}"), &scene, seed, 1e-4);
    }
}

#[test]
fn gradients_beyond_the_jacobian_clamp_equal_differences_of_the_clamped_function() {
    for seed in 30..34 {
        let mut rng = Rng::new(seed);
        let mut cloud = empty_cloud();
        for i in 0..8 {
            // Centres outside the image and its margin on every side; long enough to reach in, across the clamp.
            let side =
                [[2.6, 0.1], [-2.6, 0.2], [0.1, 2.2], [-0.2, -2.2], [1.9, 1.7], [-1.8, -1.9], [0.2, 0.1], [-0.3, 0.2]]
                    [i];
            let z = rng.range(0.8, 2.5);
            let mean = [side[0] * z, side[1] * z, z];
            push(
                &mut cloud,
                mean,
                [rng.range(0.3, 0.9), -2.5, -1.8],
                0.5,
                std::array::from_fn(|_| rng.range(0.1, 1.0)),
            );
            cloud.quats[i] = std::array::from_fn(|_| rng.normal());
        }
        let mut scene = scene(cloud, 40, 30);
        (scene.camera.intrinsics.cx, scene.camera.intrinsics.cy) = (11.0, 22.0);
        assert!(scene.reference().totals.num_blended > 300, "they reach into the image");
        check_against_reference(&format!("clamp {seed}"), &scene, seed, 1e-3);
    }
}

#[test]
fn gradients_of_8000_to_1_needles_equal_differences_of_the_reference() {
    // Measured 2e-5 to 5e-5, by instruction set: what float32 leaves of such needles (see `simd_agreement`).
    let scene = random(503, Draw { n: 60, log_scale: [-8.0, 1.0], opacity: [0.004, 0.999], ..Draw::default() });
    check_against_reference("needles", &scene, 3, 1e-4);
}

#[test]
fn background_enters_through_the_transmittance() {
    let mut scene = smooth(40);
    scene.options.background = [5.0, -3.0, 2.0];
    check_against_reference("background", &scene, 40, 1e-4);
}

/// Upstream gradients of one channel only.
fn only(scene: &Scene, channel: usize) -> Vec<f32> {
    let mut weights = upstream(50, scene);
    for (i, w) in weights.iter_mut().enumerate() {
        if i % scene.channels() != channel {
            *w = 0.0;
        }
    }
    weights
}

#[test]
fn alpha_and_depth_have_their_own_gradients() {
    let scene = smooth(41);
    for (name, channel) in [("alpha", 3), ("depth", 4)] {
        let mut weights = only(&scene, channel);
        for (pixel, _) in scene.reference().fragile.iter().enumerate().filter(|(_, f)| **f) {
            weights[pixel * 5..][..5].fill(0.0);
        }
        let (_, gradients) = scene.frame_and_gradients(&weights);
        assert!(gradients.sh.iter().all(|&v| v == 0.0), "{name} does not depend on colour");
        compare(name, &scene, &gradients, &reference_gradient(&scene, &weights, 1e-7), 1e-4);
    }
}

#[test]
fn inactive_sh_bands_have_zero_gradient() {
    let mut scene = random(42, Draw { n: 15, sh_degree: 3, ..Draw::default() });
    scene.options.sh_degree = Some(1);
    let (_, gradients) = scene.frame_and_gradients(&upstream(42, &scene));
    for row in gradients.sh.chunks_exact(3 * 16) {
        assert!(row[12..].iter().all(|&v| v == 0.0));
    }
    check_against_reference("degree 1 of 3", &scene, 42, 1e-4);
}

#[test]
fn every_sh_degree_has_right_gradients() {
    for sh_degree in 0..=4 {
        let scene = random(43, Draw { n: 10, sh_degree, size: [24, 20], ..Draw::default() });
        check_against_reference(&format!("degree {sh_degree}"), &scene, 43, 1e-4);
    }
}

#[test]
fn means2d_gradient_moves_the_image_plane_mean() {
    // A disc facing the camera moves on the image by f/z per world unit, and its covariance does not change with x, y
    // as its extent along the axis is nil: the two gradients differ by that factor only.
    let mut cloud = empty_cloud();
    push(&mut cloud, [0.05, -0.1, 2.0], [-1.5, -1.5, -20.0], logit(0.7), [0.9, 0.3, 0.5]);
    let mut scene = scene(cloud, 32, 32);
    scene.options.termination = Termination::Fixed(0.0);
    let (_, gradients) = scene.frame_and_gradients(&upstream(3, &scene));
    let (f, z) = (f64::from(scene.camera.intrinsics.fx), 2.0);
    let from_means: Vec<f64> = gradients.means[..2].iter().map(|&v| f64::from(v) * z / f).collect();
    assert_close("means2d", &gradients.means2d[..2], &from_means, Tolerance::relative_l2(1e-4));
    assert!(gradients.means2d[2] >= gradients.means2d[0].abs() && gradients.means2d[3] >= gradients.means2d[1].abs());
}

crate::common::on_gpu!(
    smooth_cutoff_gradients_equal_differences_of_the_renderer,
    gradients_equal_differences_of_the_reference,
    gradients_through_the_stop_rule_equal_differences_of_the_reference,
    gradients_beyond_the_jacobian_clamp_equal_differences_of_the_clamped_function,
    gradients_of_8000_to_1_needles_equal_differences_of_the_reference,
    background_enters_through_the_transmittance,
    alpha_and_depth_have_their_own_gradients,
    inactive_sh_bands_have_zero_gradient,
    every_sh_degree_has_right_gradients,
    means2d_gradient_moves_the_image_plane_mean,
);
