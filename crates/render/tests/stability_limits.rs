//! Numerical hazards of size: many tiles, many pairs, many Gaussians on one pixel.

use gazesplat_render::{Error, Splats, Termination, render};
use gazesplat_testkit::{Tolerance, assert_close};

use crate::common::scenes::{camera, empty_cloud, logit, options, push, upstream};
use crate::common::{Scene, device, interleaved};

/// More tiles than 16 bits count, in an image that is one pixel wide (or high).
const TALL: u32 = 16 * 65_537;

#[test]
fn more_tiles_than_sixteen_bits_are_correct() {
    let focal = TALL as f32;
    let view = camera(1, TALL, focal);
    let mut cloud = empty_cloud();
    // One in the first, the middle and the last tile: small, at the depths that put them there.
    for row in [3.5f32, 0.5 * TALL as f32 + 0.5, TALL as f32 - 2.5] {
        let y = (row - view.intrinsics.cy) / focal;
        push(&mut cloud, [0.0, y, 1.0], [-14.0; 3], 2.0, [0.9, 0.4, 0.1]);
    }
    let scene = Scene { cloud, camera: view, options: options() };
    let frame = scene.frame();
    assert_eq!(frame.stats.num_tiles, 65_537);
    for row in [3, TALL as usize / 2, TALL as usize - 3] {
        assert!(frame.image[row * 5 + 3] > 0.5, "row {row} shows {:?}", &frame.image[row * 5..row * 5 + 5]);
    }
    let covered = frame.image.chunks_exact(5).filter(|p| p[3] > 0.0).count();
    assert!(covered < 60, "three small Gaussians cover {covered} pixels");
    let reference = scene.reference();
    assert_close(
        "tall image",
        &frame.image,
        &interleaved(&reference, 5),
        Tolerance { mean_abs: 1e-8, ..Tolerance::max_abs(1e-2) },
    );
}

#[test]
fn more_pairs_than_a_gpu_buffer_indexes_are_correct_or_refused() {
    // 2³¹/64 pairs of 65,537 tiles each.
    let num_splats = (1usize << 25) / 65_537 + 1;
    let mut cloud = empty_cloud();
    for i in 0..num_splats {
        push(&mut cloud, [0.0, 0.0, 1.0 + 1e-3 * i as f32], [11.5; 3], 2.0, [0.9, 0.4, 0.1]);
    }
    let scene = Scene { cloud, camera: camera(TALL, 1, 60.0), options: options() };
    match render(&Splats::from_cloud(&scene.cloud, &device()).expect("it fits"), &scene.camera, &scene.options) {
        Ok(out) => {
            assert!(out.stats.num_pairs >= 1 << 25, "{} pairs", out.stats.num_pairs);
            let image: Vec<f32> = out.image.into_data().try_to_vec().expect("images are f32");
            let middle = &image[(TALL as usize / 2) * 5..][..5];
            assert!(middle[3] > 0.999 && (middle[0] - 0.9).abs() < 1e-3, "{middle:?}");
        }
        Err(error) => assert!(matches!(error, Error::Limit { .. }), "{error}"),
    }
}

fn pile(n: usize, opacity: f64) -> Scene {
    let mut cloud = empty_cloud();
    for i in 0..n {
        // Back to front, so that sorting has work.
        let depth = 2.0 + 1e-4 * (n - i) as f32;
        push(&mut cloud, [0.0, 0.0, depth], [-4.0; 3], logit(opacity), [0.9, 0.4, (i % 7) as f32 / 7.0]);
    }
    Scene { cloud, camera: camera(17, 17, 60.0), options: options() }
}

#[test]
fn a_hundred_thousand_gaussians_on_one_pixel_are_correct() {
    for opacity in [0.005, 0.9] {
        let mut expected: Option<Vec<f32>> = None;
        for stop in [1e-4, 1e-20, 0.0] {
            let mut scene = pile(100_000, opacity);
            scene.options.termination = Termination::Fixed(stop);
            let (frame, gradients) = scene.frame_and_gradients(&upstream(4, &scene));
            gradients.assert_finite("pile");
            let mut alphas = frame.image.chunks_exact(5).map(|p| p[3]);
            assert!(alphas.all(|a| (0.0..=1.0).contains(&a)), "transmittance left [0, 1]");
            let middle = frame.image[(8 * 17 + 8) * 5 + 3];
            assert!(middle >= 0.998, "the pile is opaque: {middle}");
            // What lies behind a transmittance of 1e-4 hardly matters to what lies in front of it.
            match &expected {
                None => expected = Some(gradients.opacity_logits),
                Some(expected) => {
                    let what = format!("opacity {opacity}, gradient with stop {stop:e}");
                    let d = assert_close(&what, &gradients.opacity_logits, expected, Tolerance::relative_l2(5e-2));
                    println!("{what}: relative L2 {:.1e} from that with stop 1e-4", d.relative_l2);
                }
            }
        }
    }
}

#[test]
fn a_pile_of_faint_gaussians_equals_the_reference() {
    let scene = pile(3000, 0.02);
    let (frame, reference) = (scene.frame(), scene.reference());
    let expected = crate::common::sturdy(&interleaved(&reference, 5), 5, &reference.fragile);
    let found = crate::common::sturdy(&frame.image, 5, &reference.fragile);
    assert!(found.len() > 5 * 200, "most pixels are not fragile");
    assert_close("pile", &found, &expected, Tolerance::max_abs(1e-3));
}

crate::common::on_gpu!(
    more_tiles_than_sixteen_bits_are_correct,
    more_pairs_than_a_gpu_buffer_indexes_are_correct_or_refused,
    a_hundred_thousand_gaussians_on_one_pixel_are_correct,
    a_pile_of_faint_gaussians_equals_the_reference,
);
