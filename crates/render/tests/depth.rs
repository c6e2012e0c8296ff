//! Accumulated and expected depth: closed forms, gradients, and that they are there only when asked for.

use gazesplat_render::{Splats, cpu_device, render};
use gazesplat_testkit::{Tolerance, assert_close};

use crate::common::Scene;
use crate::common::scenes::{Draw, camera, empty_cloud, logit, options, push, push_disc, random, scene};
use crate::finite_diff::differences;

#[test]
fn one_gaussian_is_expected_at_its_depth_wherever_it_is_seen() {
    let view = camera(40, 30, 60.0);
    for depth in [0.02f32, 1.0, 37.5, 1e6] {
        let mut cloud = empty_cloud();
        push_disc(&mut cloud, &view, [17.0, 12.5], 5.0, depth, logit(0.8), [0.9, 0.4, 0.2]);
        let scene = Scene { cloud, camera: view, options: options() };
        let (image, found) = (scene.frame().image, scene.expected_depth());
        let mut seen = 0;
        for (pixel, found) in image.chunks_exact(5).zip(&found) {
            if pixel[3] == 0.0 {
                assert_eq!(*found, 0.0);
                continue;
            }
            seen += 1;
            // Alpha is 1 − (1 − α): rounded to 6e-8 absolutely, so to 6e-8/α relatively.
            let bound = depth * (6e-8 / pixel[3] + 2e-7);
            assert!((found - depth).abs() <= bound, "found {found}, expected {depth} ± {bound:e}");
        }
        assert!(seen > 200 && seen < found.len(), "{seen} pixels see it");
    }
}

#[test]
fn two_gaussians_are_weighted_by_what_is_seen_of_them() {
    let mut cloud = empty_cloud();
    for (z, opacity) in [(2.0, 0.25), (6.0, 0.5)] {
        push(&mut cloud, [0.0, 0.0, z], [6.0; 3], logit(opacity), [0.5; 3]);
    }
    let scene = scene(cloud, 7, 5);
    // ¼ · 2 + ¾ · ½ · 6 over 1 − ¾ · ½.
    let (accumulated, alpha) = (2.75, 0.625);
    let frame = scene.frame();
    for pixel in frame.image.chunks_exact(5) {
        assert!((pixel[4] - accumulated).abs() < 1e-4, "{pixel:?}");
    }
    let expected = vec![f64::from(accumulated / alpha); 35];
    assert_close("expected depth", &scene.expected_depth(), &expected, Tolerance::max_abs(1e-4));
}

#[test]
fn opaque_surfaces_hide_the_depth_behind_them() {
    let mut cloud = empty_cloud();
    for z in [3.0, 8.0, 20.0] {
        push(&mut cloud, [0.0, 0.0, z], [6.0; 3], 30.0, [0.5; 3]);
    }
    // α_max = 0.999 leaves T = 1e-3 behind the first; the second would take it to 1e-6, so the pixel stops before it.
    let scene = scene(cloud, 4, 4);
    assert_close("hidden", &scene.expected_depth(), &[3.0; 16], Tolerance::max_abs(1e-5));
}

#[test]
fn it_is_there_only_when_asked_for() {
    let mut scene = random(90, Draw::default());
    scene.options.depth = false;
    let splats = Splats::from_cloud(&scene.cloud, &cpu_device()).expect("it fits");
    let out = render(&splats, &scene.camera, &scene.options).expect("legal");
    assert_eq!(out.image.dims()[2], 4);
    assert!(out.accumulated_depth().is_none() && out.expected_depth().is_none());
}

/// Random weights, none on fragile pixels and none where nothing is seen.
fn weights(seed: u64, scene: &Scene) -> Vec<f32> {
    let mut rng = gazesplat_testkit::Rng::new(seed);
    let reference = scene.reference();
    let pixels = reference.fragile.iter().zip(&reference.alpha);
    pixels.map(|(&fragile, &alpha)| if fragile || alpha == 0.0 { 0.0 } else { rng.normal() }).collect()
}

#[test]
fn gradients_of_the_expected_depth_equal_differences_of_the_reference() {
    for seed in 91..95 {
        let mut scene = random(seed, Draw { n: 12, ..Draw::default() });
        scene.options.antialiased = seed % 2 == 0;
        let weights = weights(seed, &scene);
        let gradients = scene.expected_depth_gradients(&weights);
        let expected = differences(&scene, 1e-7, |frame| {
            let quotients = frame.depth.iter().zip(&frame.alpha).map(|(d, a)| d / a.max(1e-10));
            quotients.zip(&weights).map(|(e, &w)| e * f64::from(w)).sum()
        });
        assert!(gradients.sh.iter().all(|&v| v == 0.0), "depth does not depend on colour");
        // The gradient is the sum of what comes through Σ T α z and through alpha, which nearly cancel in a pixel with one
        // Gaussian, as its depth is all that can be expected there. Measured 2e-6 of the parts.
        let frame = scene.reference();
        let parts = |part: &dyn Fn(f64, f64) -> [f64; 2]| {
            let pixels = frame.depth.iter().zip(&frame.alpha).zip(&weights);
            let upstream: Vec<f32> = pixels
                .flat_map(|((&d, &a), &w)| {
                    let [alpha, depth] = if w == 0.0 { [0.0; 2] } else { part(d, a).map(|v| v * f64::from(w)) };
                    [0.0, 0.0, 0.0, alpha as f32, depth as f32]
                })
                .collect();
            scene.frame_and_gradients(&upstream).1
        };
        let through_alpha = parts(&|d, a| [-d / (a * a), 0.0]);
        let through_depth = parts(&|_, a| [0.0, 1.0 / a]);
        let mut expected = &expected[..];
        let norm = |values: &[f32]| values.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt();
        for (k, (name, found)) in gradients.groups().into_iter().take(4).enumerate() {
            let (head, tail) = expected.split_at(found.len());
            expected = tail;
            let error = found.iter().zip(head).map(|(f, e)| (f64::from(*f) - e).powi(2)).sum::<f64>().sqrt();
            let scale = norm(through_alpha.groups()[k].1) + norm(through_depth.groups()[k].1);
            println!("expected depth {seed}: {name:15} {:.1e} of the parts", error / scale);
            assert!(
                error <= 1e-5 * scale,
                "expected depth {seed}: {name} is off by {error:e}, the parts are {scale:e}"
            );
        }
    }
}

/// Where nothing is seen the quotient is 0/1e-10: its gradient reaches no Gaussian, however large it is.
#[test]
fn pixels_without_a_gaussian_have_no_gradient() {
    let view = camera(48, 32, 60.0);
    let mut cloud = empty_cloud();
    push_disc(&mut cloud, &view, [8.0, 8.0], 1.5, 2.0, logit(0.8), [0.9, 0.4, 0.2]);
    let scene = Scene { cloud, camera: view, options: options() };
    let empty = scene.frame().image.chunks_exact(5).map(|p| if p[3] == 0.0 { 1e3 } else { 0.0 }).collect::<Vec<f32>>();
    assert!(empty.iter().filter(|&&w| w > 0.0).count() > 1000);
    let gradients = scene.expected_depth_gradients(&empty);
    gradients.assert_finite("empty pixels");
    assert!(gradients.groups().iter().all(|(_, values)| values.iter().all(|&v| v == 0.0)));
}

crate::common::on_gpu!(
    one_gaussian_is_expected_at_its_depth_wherever_it_is_seen,
    two_gaussians_are_weighted_by_what_is_seen_of_them,
    opaque_surfaces_hide_the_depth_behind_them,
    it_is_there_only_when_asked_for,
    gradients_of_the_expected_depth_equal_differences_of_the_reference,
    pixels_without_a_gaussian_have_no_gradient,
);
