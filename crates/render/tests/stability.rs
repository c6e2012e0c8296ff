//! Numerical hazards: values at which a renderer in float32 fails first. Limits of size are in `stability_limits`, the
//! bound on float32 as a whole in `golden`. Long because it is one table: each row is a test or two of a few lines.

use gazesplat_core::GaussianCloud;
use gazesplat_render::{RenderOptions, Termination};
use gazesplat_testkit::close::assert_finite;
use gazesplat_testkit::{Rng, Tolerance, assert_close};

use crate::common::scenes::{Draw, camera, empty_cloud, logit, options, push, push_disc, random, scene, upstream};
use crate::common::{Gradients, Scene, interleaved, sturdy};

/// The scene in the antialiased mode: every row of the table holds there too.
fn antialiased(scene: &Scene) -> Scene {
    let mut scene = scene.clone();
    scene.options.antialiased = true;
    scene
}

/// Renders with random upstream gradients, antialiased and as asked, and asserts that everything is finite.
#[track_caller]
fn finite(what: &str, scene: &Scene) -> (Vec<f32>, Gradients) {
    let mut last = None;
    for scene in [&antialiased(scene), scene] {
        let (frame, gradients) = scene.frame_and_gradients(&upstream(1, scene));
        let what = format!("{what}, antialiased {}", scene.options.antialiased);
        assert_finite(&format!("{what}: image"), &frame.image);
        gradients.assert_finite(&what);
        last = Some((frame.image, gradients));
    }
    last.expect("two modes were rendered")
}

/// Asserts that the image is the reference's, off fragile pixels, antialiased and as asked.
#[track_caller]
fn like_reference(what: &str, scene: &Scene, max_abs: f64) {
    for scene in [&antialiased(scene), scene] {
        let (frame, reference) = (scene.frame(), scene.reference());
        let expected = sturdy(&interleaved(&reference, frame.channels), frame.channels, &reference.fragile);
        let found = sturdy(&frame.image, frame.channels, &reference.fragile);
        let what = format!("{what}, antialiased {}", scene.options.antialiased);
        assert_close(&what, &found, &expected, Tolerance::max_abs(max_abs));
    }
}

fn is_background(scene: &Scene) -> bool {
    let b = scene.options.background;
    scene.frame().image.chunks_exact(5).all(|p| p == [b[0], b[1], b[2], 0.0, 0.0])
}

#[test]
fn alpha_near_one_has_finite_gradients() {
    let mut cloud = empty_cloud();
    let mut rng = Rng::new(3);
    for i in 0..60 {
        let mean = [rng.range(-1.0, 1.0), rng.range(-1.0, 1.0), 2.0 + 0.01 * i as f32];
        push(&mut cloud, mean, [rng.range(-3.0, 1.0); 3], rng.range(4.0, 80.0), [rng.range(0.0, 1.0); 3]);
    }
    for alpha_max in [0.99, 0.999, 0.9999] {
        let mut scene = scene(cloud.clone(), 40, 30);
        scene.options.alpha_max = alpha_max;
        finite("opaque layers", &scene);
        like_reference("opaque layers", &scene, 3e-5);
    }
}

#[test]
fn clamped_alpha_passes_no_gradient_to_opacity_and_geometry() {
    let mut cloud = empty_cloud();
    // Wide enough for α > 0.999 in every pixel before the clamp.
    push(&mut cloud, [0.0, 0.0, 2.0], [5.0; 3], 30.0, [0.8, 0.4, 0.1]);
    let scene = scene(cloud, 20, 20);
    let (_, gradients) = finite("clamped", &scene);
    assert_eq!(gradients.opacity_logits, [0.0]);
    assert!(gradients.log_scales.iter().chain(&gradients.quats).all(|&v| v == 0.0));
    assert!(gradients.means2d.iter().all(|&v| v == 0.0), "{:?}", gradients.means2d);
    assert!(gradients.sh.iter().all(|&v| v != 0.0), "colour still has a gradient");
}

#[test]
fn first_opaque_splat_is_blended() {
    let mut cloud = empty_cloud();
    push(&mut cloud, [0.0, 0.0, 2.0], [5.0; 3], 30.0, [0.8, 0.4, 0.1]);
    let mut scene = scene(cloud, 16, 16);
    scene.options.background = [1.0; 3];
    let image = scene.frame().image;
    let expected: Vec<f64> =
        [0.8 * 0.999 + 0.001, 0.4 * 0.999 + 0.001, 0.1 * 0.999 + 0.001, 0.999, 2.0 * 0.999].repeat(256);
    assert_close("opaque", &image, &expected, Tolerance::max_abs(1e-6));
}

#[test]
fn opacity_below_the_cut_leaves_background_and_zero_gradient() {
    let mut cloud = empty_cloud();
    for opacity in [1e-30, 1e-4, 0.0039] {
        push(&mut cloud, [0.0, 0.0, 2.0], [0.0; 3], logit(opacity), [0.8, 0.4, 0.1]);
    }
    cloud.opacity_logits.extend([-100.0, f32::MIN]);
    for _ in 0..2 {
        cloud.means.push([0.0, 0.0, 2.0]);
        cloud.quats.push([1.0, 0.0, 0.0, 0.0]);
        cloud.log_scales.push([0.0; 3]);
        cloud.sh.push([1.0; 3]);
    }
    let mut scene = scene(cloud, 33, 18);
    scene.options.background = [0.1, 0.2, 0.3];
    assert!(is_background(&scene));
    let (_, gradients) = finite("below the cut", &scene);
    for (name, values) in gradients.groups() {
        assert!(values.iter().all(|&v| v == 0.0), "gradient of {name} is {values:?}");
    }
}

#[test]
fn extreme_anisotropy_and_scale_stay_finite() {
    let mut rng = Rng::new(11);
    for (name, log_scales) in [
        ("1000:1 needle", [0.0, -6.9, -6.9]),
        ("1000:1 disc", [0.0, 0.0, -6.9]),
        ("1e6:1 needle", [4.0, -9.8, -9.8]),
        ("1e6:1 disc", [4.0, 4.0, -9.8]),
        ("scale 1e-12", [-27.6; 3]),
        ("scale 1e6", [13.8; 3]),
        ("1e18:1", [13.8, -27.6, 0.0]),
    ] {
        for seed in 0..6 {
            let mut cloud = empty_cloud();
            for i in 0..8 {
                push(
                    &mut cloud,
                    [rng.range(-0.7, 0.7), rng.range(-0.5, 0.5), 2.0 + 0.1 * i as f32],
                    log_scales,
                    0.5,
                    [0.7; 3],
                );
                cloud.quats[i] = std::array::from_fn(|_| rng.normal());
            }
            let scene = scene(cloud, 48, 36);
            finite(&format!("{name} ({seed})"), &scene);
        }
    }
}

#[test]
fn needles_of_1000_to_1_equal_the_reference() {
    let mut rng = Rng::new(12);
    let mut cloud = empty_cloud();
    for i in 0..40 {
        push(
            &mut cloud,
            [rng.range(-0.7, 0.7), rng.range(-0.5, 0.5), 2.0 + 0.1 * i as f32],
            [-1.0, -7.9, -7.9],
            0.0,
            [0.7; 3],
        );
        cloud.quats[i] = std::array::from_fn(|_| rng.normal());
    }
    like_reference("needles", &scene(cloud, 60, 45), 1e-3);
}

fn with_quat(quat: [f32; 4]) -> Scene {
    let mut cloud = empty_cloud();
    push(&mut cloud, [0.1, 0.0, 2.0], [-1.0, -2.0, -3.0], 1.0, [0.9, 0.5, 0.2]);
    cloud.quats[0] = quat;
    scene(cloud, 40, 30)
}

#[test]
fn quaternions_without_direction_are_culled() {
    for quat in [[0.0; 4], [f32::MIN_POSITIVE / 4.0; 4], [1e-30, -1e-30, 0.0, 0.0], [4e-4; 4]] {
        let scene = with_quat(quat);
        assert!(is_background(&scene), "{quat:?}");
        let (_, gradients) = finite("no direction", &scene);
        assert!(gradients.groups().iter().all(|(_, values)| values.iter().all(|&v| v == 0.0)), "{quat:?}");
    }
}

#[test]
fn quaternions_of_any_length_give_the_same_image() {
    let direction = [0.5f32, -0.1, 0.7, 0.5];
    let (expected, unit_gradients) = finite("unit", &with_quat(direction));
    for length in [2e-3f32, 1.0, 1e10, 1e18, 1e19, 1e25, 1e38] {
        let scene = with_quat(direction.map(|q| q * length));
        let (image, gradients) = finite(&format!("length {length:e}"), &scene);
        assert_close(&format!("length {length:e}"), &image, &expected, Tolerance::max_abs(2e-5));
        let scaled: Vec<f64> = unit_gradients.quats.iter().map(|&g| f64::from(g) / f64::from(length)).collect();
        // Below the smallest normal number only its absence is left to check.
        if length < 1e30 {
            assert_close(
                &format!("gradient at length {length:e}"),
                &gradients.quats,
                &scaled,
                Tolerance::relative_l2(1e-4),
            );
        }
    }
}

#[test]
fn extreme_positions_and_log_scales_are_culled_or_finite() {
    for log_scale in [-100.0, -87.0, -40.0, 30.0, 40.0, 44.0, 60.0, 88.0, 89.0, 100.0, f32::MAX, f32::MIN] {
        for axes in [[1.0, 1.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]] {
            let mut cloud = empty_cloud();
            push(
                &mut cloud,
                [0.1, 0.2, 2.0],
                axes.map(|a: f32| if a == 0.0 { -2.0 } else { log_scale }),
                1.0,
                [0.9; 3],
            );
            push(&mut cloud, [0.0, 0.0, 3.0], [-1.0; 3], 0.0, [0.2; 3]);
            cloud.quats[0] = [0.9, 0.2, -0.3, 0.1];
            finite(&format!("log scale {log_scale:e} on {axes:?}"), &scene(cloud, 40, 30));
        }
    }
    for far in [1e6f32, 1e12, 1e20, 1e30, f32::MAX] {
        for direction in [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.3, 0.2, 1.0]] {
            for log_scale in [-2.0, 10.0] {
                let mut cloud = empty_cloud();
                push(&mut cloud, direction.map(|d| d * far + 0.1), [log_scale; 3], 1.0, [0.9; 3]);
                finite(&format!("mean {far:e} along {direction:?}"), &scene(cloud, 40, 30));
            }
        }
    }
}

#[test]
fn mean_at_the_camera_centre_is_culled() {
    let mut cloud = empty_cloud();
    for mean in [[0.0; 3], [0.0, 0.0, f32::MIN_POSITIVE], [0.0, 0.0, -2.0]] {
        push(&mut cloud, mean, [0.0; 3], 3.0, [0.9; 3]);
    }
    let scene = scene(cloud, 24, 24);
    finite("camera centre", &scene);
    assert!(is_background(&scene));
}

#[test]
fn near_plane_culls_up_to_and_including_near() {
    for near in [0.01f32, 0.2, 1e-6, 50.0] {
        for (z, visible) in [(near.next_down(), false), (near, false), (near.next_up(), true)] {
            let mut cloud = empty_cloud();
            push(&mut cloud, [0.0, 0.0, z], [(0.1 * near).ln(); 3], 1.0, [0.9; 3]);
            let mut scene = scene(cloud, 24, 24);
            scene.options.near = near;
            finite(&format!("z = {z:e}"), &scene);
            assert_eq!(is_background(&scene), !visible, "z = {z:e}, near = {near:e}");
        }
    }
}

#[test]
fn means_far_off_axis_are_clamped_where_the_reference_clamps_them() {
    // Off-centre principal point: the limits differ on all four sides.
    let mut rng = Rng::new(5);
    let mut cloud = empty_cloud();
    for i in 0..30 {
        let side = [[3.0, 0.0], [-3.0, 0.0], [0.0, 2.5], [0.0, -2.5], [2.0, 2.0], [0.7, -0.4]][i % 6];
        let z = rng.range(0.5, 3.0);
        push(
            &mut cloud,
            [side[0] * z, side[1] * z, z],
            [rng.range(-0.5, 1.5), -3.0, -2.0],
            1.0,
            [rng.range(0.1, 1.0); 3],
        );
        cloud.quats[i] = std::array::from_fn(|_| rng.normal());
    }
    let mut scene = scene(cloud, 60, 44);
    (scene.camera.intrinsics.cx, scene.camera.intrinsics.cy) = (13.0, 35.0);
    assert!(scene.reference().totals.num_blended > 1000, "the long ones reach into the image");
    finite("off axis", &scene);
    like_reference("off axis", &scene, 1e-4);
}

/// Index of the damaged Gaussian, in the middle of the scene.
const DAMAGED: usize = 17;

/// Sets the `k`-th parameter of Gaussian [`DAMAGED`]; `None` when there are no more.
fn damaged(scene: &Scene, k: usize, value: f32) -> Option<Scene> {
    let mut scene = scene.clone();
    let cloud = &mut scene.cloud;
    let num_coefficients = cloud.num_coefficients();
    let sh = &mut cloud.sh[DAMAGED * num_coefficients..][..num_coefficients];
    let parameter = cloud.means[DAMAGED]
        .iter_mut()
        .chain(&mut cloud.quats[DAMAGED])
        .chain(&mut cloud.log_scales[DAMAGED])
        .chain([&mut cloud.opacity_logits[DAMAGED]])
        .chain(sh.iter_mut().flatten())
        .nth(k)?;
    *parameter = value;
    Some(scene)
}

fn without_damaged(scene: &Scene) -> Scene {
    let mut scene = scene.clone();
    let num_coefficients = scene.cloud.num_coefficients();
    let GaussianCloud { means, quats, log_scales, opacity_logits, sh, .. } = &mut scene.cloud;
    means.remove(DAMAGED);
    quats.remove(DAMAGED);
    log_scales.remove(DAMAGED);
    opacity_logits.remove(DAMAGED);
    sh.drain(DAMAGED * num_coefficients..(DAMAGED + 1) * num_coefficients);
    scene
}

#[test]
fn non_finite_parameters_are_culled_and_change_nothing_else() {
    let scene = random(21, Draw { n: 40, stray: 0.0, ..Draw::default() });
    non_finite_parameters(antialiased(&scene));
    non_finite_parameters(scene);
}

fn non_finite_parameters(mut scene: Scene) {
    // In the middle of the view, so that only the damaged value can cull it.
    let in_front = scene.camera.camera_from_world.inverse().transform_point3(glam::Vec3::new(0.0, 0.0, 3.0));
    scene.cloud.means[DAMAGED] = in_front.to_array();
    scene.cloud.opacity_logits[DAMAGED] = 2.0;
    let upstream = upstream(2, &scene);
    let (whole, _) = scene.frame_and_gradients(&upstream);
    assert_eq!(whole.stats.num_culled_non_finite, 0);
    let (expected, expected_gradients) = without_damaged(&scene).frame_and_gradients(&upstream);
    assert!(whole.image != expected.image, "the Gaussian is seen before it is damaged");
    let others: Vec<usize> = (0..scene.cloud.len()).filter(|&i| i != DAMAGED).collect();
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut k = 0;
        while let Some(scene) = damaged(&scene, k, value) {
            let (frame, gradients) = scene.frame_and_gradients(&upstream);
            assert!(frame.image == expected.image, "parameter {k} = {value} changes the image");
            assert!(gradients.rows(&others) == expected_gradients, "parameter {k} = {value} changes other gradients");
            for (name, values) in gradients.rows(&[DAMAGED]).groups() {
                assert!(values.iter().all(|&v| v == 0.0), "parameter {k} = {value}: gradient of {name} is {values:?}");
            }
            assert_eq!(frame.stats.num_culled_non_finite, 1, "parameter {k} = {value} is counted");
            k += 1;
        }
        assert_eq!(k, 3 + 4 + 3 + 1 + 12);
    }
}

#[test]
fn only_non_finite_gaussians_leave_background() {
    let mut cloud = empty_cloud();
    for _ in 0..20 {
        push(&mut cloud, [f32::NAN, 0.0, 2.0], [0.0; 3], 0.0, [0.5; 3]);
    }
    let scene = scene(cloud, 20, 20);
    finite("all NaN", &scene);
    assert!(is_background(&scene));
    assert_eq!(scene.frame().stats.num_culled_non_finite, 20);
}

#[test]
fn equal_depths_are_blended_in_index_order() {
    let colors = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    for order in [[0, 1, 2], [2, 1, 0], [1, 2, 0]] {
        let mut cloud = empty_cloud();
        for i in order {
            push(&mut cloud, [0.0, 0.0, 2.0], [5.0; 3], 0.0, colors[i]);
        }
        let image = scene(cloud, 5, 5).frame().image;
        let mut expected = [0.0f64; 5];
        for (rank, i) in order.into_iter().enumerate() {
            expected[i] = 0.5f64.powi(rank as i32 + 1);
        }
        (expected[3], expected[4]) = (0.875, 1.75);
        assert_close(&format!("order {order:?}"), &image, &expected.repeat(25), Tolerance::max_abs(1e-4));
    }
}

#[test]
fn a_scene_at_one_depth_equals_the_reference() {
    let view = camera(40, 40, 60.0);
    let mut rng = Rng::new(8);
    let mut cloud = empty_cloud();
    for _ in 0..300 {
        let center = [rng.range(0.0, 40.0), rng.range(0.0, 40.0)];
        push_disc(
            &mut cloud,
            &view,
            center,
            rng.range(1.0, 6.0),
            3.0,
            rng.normal(),
            std::array::from_fn(|_| rng.range(0.0, 1.0)),
        );
    }
    let scene = Scene { cloud, camera: view, options: options() };
    like_reference("one depth", &scene, 2e-5);
    assert!(scene.frame() == scene.frame());
}

#[test]
fn order_is_exact_over_nine_decades_of_depth() {
    let view = camera(9, 9, 20.0);
    let mut depths = vec![0.0101f32, 0.0101f32.next_up()];
    for decade in -1..7 {
        let z = 10f32.powi(decade);
        depths.extend([z.next_down(), z, z.next_up(), 3.0 * z]);
    }
    depths.extend([1e7f32.next_down(), 1e7, 1e7f32.next_up()]);
    let mut rng = Rng::new(9);
    for i in (1..depths.len()).rev() {
        depths.swap(i, rng.below(i + 1));
    }
    let mut cloud = empty_cloud();
    for &depth in &depths {
        let color = std::array::from_fn(|_| rng.range(0.0, 1.0));
        push_disc(&mut cloud, &view, [4.5, 4.5], 30.0, depth, logit(0.2), color);
    }
    let mut scene = Scene { cloud, camera: view, options: options() };
    // Depth itself is left out: its values span nine decades.
    scene.options.depth = false;
    like_reference("nine decades", &scene, 1e-5);
}

#[test]
fn images_of_odd_sizes_equal_the_reference() {
    for size in [[1, 1], [1, 40], [40, 1], [15, 17], [16, 16], [17, 31], [33, 65]] {
        let scene = random(size[0].into(), Draw { n: 30, size, stray: 0.0, ..Draw::default() });
        finite(&format!("{size:?}"), &scene);
        like_reference(&format!("{size:?}"), &scene, 1e-4);
    }
}

#[test]
fn scenes_without_visible_gaussians_are_background_with_zero_gradients() {
    let mut behind = empty_cloud();
    push(&mut behind, [0.0, 0.0, -3.0], [0.0; 3], 1.0, [0.5; 3]);
    let mut aside = empty_cloud();
    push(&mut aside, [500.0, 0.0, 1.0], [-3.0; 3], 1.0, [0.5; 3]);
    for (name, cloud) in [("no Gaussian", empty_cloud()), ("behind", behind), ("aside", aside)] {
        for [width, height] in [[1, 1], [16, 16], [37, 21]] {
            let mut scene = scene(cloud.clone(), width, height);
            scene.options.background = [0.25, 0.5, 0.75];
            assert!(is_background(&scene), "{name} at {width}x{height}");
            let (_, gradients) = finite(name, &scene);
            assert!(gradients.groups().iter().all(|(_, values)| values.iter().all(|&v| v == 0.0)), "{name}");
        }
    }
}

#[test]
fn negative_colours_are_clamped_with_gated_gradient() {
    for value in [-1e3f32, -1e30] {
        let mut cloud = empty_cloud();
        push(&mut cloud, [0.0, 0.0, 2.0], [-1.0; 3], 1.0, [0.5; 3]);
        cloud.sh[0] = [value, 0.0, 0.3];
        let scene = scene(cloud, 24, 24);
        let (image, gradients) = finite("negative colour", &scene);
        assert!(image.chunks_exact(5).all(|p| p[0] == 0.0), "red is clamped at 0");
        assert_eq!(gradients.sh[0], 0.0, "and has no gradient");
        assert!(gradients.sh[1] != 0.0 && gradients.sh[2] != 0.0);
    }
}

#[test]
fn huge_colours_stay_finite() {
    for value in [1e6f32, 1e20, 1e30] {
        let mut cloud = empty_cloud();
        push(&mut cloud, [0.0, 0.0, 2.0], [-1.0; 3], 1.0, [0.5; 3]);
        push(&mut cloud, [0.1, 0.0, 3.0], [-1.0; 3], 1.0, [0.5; 3]);
        cloud.sh[0] = [value, -value, 0.3];
        let scene = scene(cloud, 24, 24);
        assert_finite("huge colour", &scene.frame().image);
        if value < 1e30 {
            finite("huge colour", &scene);
        }
    }
}

#[test]
fn options_out_of_range_are_refused() {
    let scene = random(1, Draw::default());
    let default = options();
    for options in [
        RenderOptions { near: 0.0, ..default.clone() },
        RenderOptions { near: f32::NAN, ..default.clone() },
        RenderOptions { alpha_max: 1.0, ..default.clone() },
        RenderOptions { alpha_max: 0.0, ..default.clone() },
        RenderOptions { termination: Termination::Fixed(1.0), ..default.clone() },
        RenderOptions { termination: Termination::Fixed(f32::NAN), ..default.clone() },
        RenderOptions { background: [0.0, f32::INFINITY, 0.0], ..default.clone() },
    ] {
        assert!(scene.refusal(&options).is_some(), "{options:?} is accepted");
    }
    let mut broken = scene.clone();
    broken.camera.intrinsics.width = 0;
    assert!(broken.refusal(&default).is_some(), "an image without pixels is accepted");
    let mut broken = scene.clone();
    broken.camera.camera_from_world.w_axis.x = f32::NAN;
    assert!(broken.refusal(&default).is_some(), "a pose that is not finite is accepted");
}

crate::common::on_gpu!(
    alpha_near_one_has_finite_gradients,
    clamped_alpha_passes_no_gradient_to_opacity_and_geometry,
    first_opaque_splat_is_blended,
    opacity_below_the_cut_leaves_background_and_zero_gradient,
    extreme_anisotropy_and_scale_stay_finite,
    needles_of_1000_to_1_equal_the_reference,
    quaternions_without_direction_are_culled,
    quaternions_of_any_length_give_the_same_image,
    extreme_positions_and_log_scales_are_culled_or_finite,
    mean_at_the_camera_centre_is_culled,
    near_plane_culls_up_to_and_including_near,
    means_far_off_axis_are_clamped_where_the_reference_clamps_them,
    non_finite_parameters_are_culled_and_change_nothing_else,
    only_non_finite_gaussians_leave_background,
    equal_depths_are_blended_in_index_order,
    a_scene_at_one_depth_equals_the_reference,
    order_is_exact_over_nine_decades_of_depth,
    images_of_odd_sizes_equal_the_reference,
    scenes_without_visible_gaussians_are_background_with_zero_gradients,
    negative_colours_are_clamped_with_gated_gradient,
    huge_colours_stay_finite,
    options_out_of_range_are_refused,
);
