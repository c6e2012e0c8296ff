//! The gradient of the camera's pose: closed forms, differences of the float64 reference, sums over many splats, bits. The
//! golden records of it are in `golden`.

use burn::tensor::Tensor;
use gazesplat_core::camera::se3;
use gazesplat_render::{MeansProbe, Pass, PoseProbe, Probes, RenderOptions, Splats, render_with};
use gazesplat_testkit::finite_diff::{central, central_f32};
use gazesplat_testkit::{Rng, Tolerance, assert_close, reference};
use glam::{DMat4, DVec3, Mat3, Vec3};

use crate::common::scenes::{Draw, empty_cloud, logit, push, random, scene, upstream};
use crate::common::{Scene, device, host, interleaved, with_gpu};

/// Random upstream gradients, none at pixels where a branch could flip.
fn sturdy_upstream(seed: u64, scene: &Scene) -> Vec<f32> {
    let mut weights = upstream(seed, scene);
    let channels = scene.channels();
    for (pixel, _) in scene.reference().fragile.iter().enumerate().filter(|(_, f)| **f) {
        weights[pixel * channels..][..channels].fill(0.0);
    }
    weights
}

/// Differences of Σ weights · image of the float64 reference, whose camera is moved by exp(ω, v) from the left.
fn reference_pose_gradient(scene: &Scene, weights: &[f32], step: f64) -> Vec<f64> {
    let (gaussians, camera, options) =
        (scene.reference_gaussians(), scene.reference_camera(), scene.reference_options());
    let pose = DMat4::from_cols_array_2d(&camera.camera_from_world).transpose();
    let mut loss = |twist: &[f64]| {
        let moved = se3::exp(std::array::from_fn(|k| twist[k])) * pose;
        let rows = std::array::from_fn(|row| moved.row(row).to_array());
        let frame = reference::render(&gaussians, &reference::Camera { camera_from_world: rows, ..camera }, &options);
        interleaved(&frame, scene.channels()).iter().zip(weights).map(|(v, &w)| v * f64::from(w)).sum()
    };
    (0..6).map(|k| central(&mut loss, &[0.0; 6], k, step)).collect()
}

/// Sums of magnitudes that stand for the parts of (ω, v): of forces, and of forces times distances.
fn magnitudes(scene: &Scene, means: &[f32]) -> [f64; 2] {
    let camera = scene.camera.camera_from_world;
    let parts = means.chunks_exact(3).zip(&scene.cloud.means).map(|(g, m)| {
        let force = f64::from(Vec3::new(g[0], g[1], g[2]).length());
        if force == 0.0 {
            return [0.0, 0.0];
        }
        [force * f64::from(camera.transform_point3(Vec3::from(*m)).length()), force]
    });
    parts.fold([0.0; 2], |sum, part| [sum[0] + part[0], sum[1] + part[1]])
}

#[track_caller]
fn check_against_reference(what: &str, scene: &Scene, seed: u64, tolerance: f64) {
    let weights = sturdy_upstream(seed, scene);
    let (_, gradients) = scene.frame_and_gradients(&weights);
    let expected = reference_pose_gradient(scene, &weights, 1e-7);
    for (part, range) in [("ω", 0..3), ("v", 3..6)] {
        let d = assert_close(
            &format!("{what}: {part}"),
            &gradients.pose[range.clone()],
            &expected[range],
            Tolerance::relative_l2(tolerance),
        );
        println!("{what}: {part} relative L2 {:.1e}", d.relative_l2);
    }
}

// The tolerances are those of the other gradients against the same differences (`finite_diff`): float32 leaves as much of
// their sum as of its parts, unless these cancel.

#[test]
fn pose_gradients_equal_differences_of_the_reference_in_every_sh_degree() {
    for sh_degree in 0..=4 {
        for seed in 60..63 {
            let scene = random(seed, Draw { n: 12, sh_degree, ..Draw::default() });
            check_against_reference(&format!("degree {sh_degree}, scene {seed}"), &scene, seed, 1e-4);
        }
    }
}

#[test]
fn pose_gradients_through_stop_clamp_and_background_equal_differences_of_the_reference() {
    for seed in 70..73 {
        let draw = Draw { n: 40, size: [24, 20], opacity: [0.6, 0.995], log_scale: [-1.5, 0.0], ..Draw::default() };
        let mut scene = random(seed, draw);
        scene.options.background = [5.0, -3.0, 2.0];
        check_against_reference(&format!("opaque {seed}"), &scene, seed, 1e-4);
    }
    // Long splats from beyond the limits of the Jacobian, as in `finite_diff`.
    let mut rng = Rng::new(31);
    let mut cloud = empty_cloud();
    for (i, side) in [[2.6, 0.1], [-2.6, 0.2], [0.1, 2.2], [-0.2, -2.2], [1.9, 1.7], [0.2, 0.1]].iter().enumerate() {
        let z = rng.range(0.8, 2.5);
        push(&mut cloud, [side[0] * z, side[1] * z, z], [0.6, -2.5, -1.8], 0.5, [0.8, 0.4, 0.2]);
        cloud.quats[i] = std::array::from_fn(|_| rng.normal());
    }
    check_against_reference("clamp", &scene(cloud, 40, 30), 31, 1e-3);
}

#[test]
fn depth_and_alpha_pull_at_the_pose_too() {
    let scene = random(80, Draw { n: 12, ..Draw::default() });
    for channel in [3, 4] {
        let mut weights = sturdy_upstream(80, &scene);
        for (i, w) in weights.iter_mut().enumerate() {
            if i % scene.channels() != channel {
                *w = 0.0;
            }
        }
        let (_, gradients) = scene.frame_and_gradients(&weights);
        let expected = reference_pose_gradient(&scene, &weights, 1e-7);
        assert_close(&format!("channel {channel}"), &gradients.pose, &expected, Tolerance::relative_l2(1e-4));
    }
}

#[test]
fn smooth_cutoff_pose_gradients_equal_differences_of_the_renderer() {
    for seed in 90..93 {
        let draw =
            Draw { n: 7, size: [28, 21], sh_degree: 2, opacity: [0.15, 0.6], log_scale: [-1.4, -0.4], stray: 0.0 };
        let mut scene = random(seed, draw);
        // Colours well above the clamp at 0, which is a kink.
        for (row, sh) in scene.cloud.sh.iter_mut().enumerate() {
            *sh = if row % 9 == 0 { sh.map(|v| 1.2 + 0.2 * v) } else { sh.map(|v| 0.3 * v) };
        }
        scene.options.pass = Pass::SmoothCutoff;
        let weights = upstream(seed, &scene);
        let (_, gradients) = scene.frame_and_gradients(&weights);
        let mut probe = scene.clone();
        let mut loss = |twist: &[f32]| {
            probe.camera = scene.camera.moved(std::array::from_fn(|k| f64::from(twist[k])));
            let image = probe.frame().image;
            image.iter().zip(&weights).map(|(&v, &w)| f64::from(v) * f64::from(w)).sum()
        };
        // Steps that move the splats, one to eight units away, as far as that test of `finite_diff` does; its bound, too.
        let step = |k: usize| if k < 3 { 4e-3 } else { 2e-2 };
        let differences: Vec<f64> = (0..6).map(|k| central_f32(&mut loss, &[0.0; 6], k, step(k))).collect();
        let d = assert_close("smooth", &gradients.pose, &differences, Tolerance::relative_l2(1e-2));
        println!("smooth {seed}: relative L2 {:.1e}", d.relative_l2);
    }
}

/// Moving the camera by v is moving every mean by Rᵀ v, whatever the colours are made of.
#[test]
fn translation_gradient_is_the_turned_sum_of_the_mean_gradients() {
    for sh_degree in [0, 3] {
        let scene = random(100, Draw { n: 200, sh_degree, ..Draw::default() });
        let (_, gradients) = scene.frame_and_gradients(&upstream(100, &scene));
        let rotation = Mat3::from_mat4(scene.camera.camera_from_world).as_dmat3();
        let sum = gradients.means.chunks_exact(3).fold(DVec3::ZERO, |sum, g| sum + Vec3::from_slice(g).as_dvec3());
        let bound = 1e-6 * magnitudes(&scene, &gradients.means)[1];
        assert_close("v", &gradients.pose[3..], &(rotation * sum).to_array(), Tolerance::max_abs(bound));
    }
}

/// One round splat on the axis: a roll changes nothing, and sideways it moves by f/z pixels.
#[test]
fn round_splat_on_the_axis_has_the_gradient_of_its_image() {
    let mut cloud = empty_cloud();
    let z = 3.0;
    push(&mut cloud, [0.0, 0.0, z], [-1.5; 3], logit(0.7), [0.9, 0.3, 0.5]);
    let scene = scene(cloud, 32, 32);
    let (_, gradients) = scene.frame_and_gradients(&upstream(3, &scene));
    let f_z = f64::from(scene.camera.intrinsics.fx / z);
    let [x, y] = [0, 1].map(|k| f64::from(gradients.means2d[k]) * f_z);
    let scale = x.hypot(y);
    // On the axis Σ' does not change to first order with x and y.
    assert_close("v", &gradients.pose[3..5], &[x, y], Tolerance::max_abs(1e-5 * scale));
    // exp(ω) takes (0, 0, z) to z (ω_y, −ω_x, 0).
    let z = f64::from(z);
    assert_close("ω", &gradients.pose[..3], &[-z * y, z * x, 0.0], Tolerance::max_abs(1e-5 * z * scale));
}

#[test]
fn nothing_visible_gives_no_pull() {
    let mut cloud = empty_cloud();
    let behind = scene(cloud.clone(), 20, 20);
    assert_eq!(behind.frame_and_gradients(&upstream(4, &behind)).1.pose, [0.0; 6]);
    push(&mut cloud, [0.0, 0.0, -3.0], [-1.5; 3], 1.0, [0.9, 0.3, 0.5]);
    let behind = scene(cloud, 20, 20);
    assert_eq!(behind.frame_and_gradients(&upstream(4, &behind)).1.pose, [0.0; 6]);
}

/// The parts of what is not seen, or broken, are not there: the sum is the same to the last bit.
#[test]
fn culled_and_broken_gaussians_pull_at_nothing() {
    let whole = random(110, Draw { n: 900, sh_degree: 2, size: [80, 60], ..Draw::default() });
    let weights = upstream(110, &whole);
    let expected = whole.frame_and_gradients(&weights).1.pose;
    assert!(expected.iter().all(|&v| v != 0.0));
    let mut damaged = whole.clone();
    let cloud = &mut damaged.cloud;
    for (row, value) in [(0, f32::NAN), (300, f32::INFINITY), (600, f32::MAX)] {
        cloud.means.insert(row, [value, 0.0, 1.0]);
        cloud.quats.insert(row, [f32::NAN, 0.0, 0.0, 1.0]);
        cloud.log_scales.insert(row, [value; 3]);
        cloud.opacity_logits.insert(row, 3.0);
        for _ in 0..9 {
            cloud.sh.insert(row * 9, [value; 3]);
        }
    }
    assert_eq!(damaged.frame_and_gradients(&weights).1.pose, expected);
}

/// Asking for it changes no other bit, and who asks for nothing else need not track the model.
#[test]
fn pose_gradient_stands_by_itself() {
    let scene = random(120, Draw { n: 300, sh_degree: 1, ..Draw::default() });
    let weights = upstream(120, &scene);
    let (frame, all) = scene.frame_and_gradients(&weights);
    let device = device().autodiff();
    let options = RenderOptions { pass: Pass::Train, ..scene.options.clone() };
    let (width, height) = (scene.camera.intrinsics.width as usize, scene.camera.intrinsics.height as usize);
    let run = |splats: &Splats, probes: Probes<'_>| {
        let image = render_with(splats, probes, &scene.camera, &options).expect("legal").image;
        assert!(host(image.clone()) == frame.image);
        let data = burn::tensor::TensorData::new(weights.clone(), [height, width, scene.channels()]);
        (image * Tensor::<3>::from_data(data, &device)).sum().backward()
    };
    let untracked = Splats::from_cloud(&scene.cloud, &device).expect("it fits");
    let pose = PoseProbe::new(&device);
    let gradients = run(&untracked, Probes { pose: Some(&pose), ..Probes::default() });
    assert_eq!(host(pose.gradient(&gradients).expect("it was asked for")), all.pose);
    let tracked = Splats::from_cloud(&scene.cloud, &device).expect("it fits").require_grad();
    let means = MeansProbe::new(scene.cloud.len(), &device);
    let gradients = run(&tracked, Probes { means: Some(&means), ..Probes::default() });
    assert!(host(tracked.means.grad(&gradients).expect("tracked")) == all.means);
    assert!(host(tracked.quats.grad(&gradients).expect("tracked")) == all.quats);
    assert!(host(means.gradient(&gradients).expect("it was asked for")) == all.means2d);
    assert!(pose.gradient(&gradients).is_none(), "this frame was not asked");
}

#[test]
fn pose_gradients_are_the_same_bits_on_any_number_of_threads() {
    let draw = Draw { n: 6000, size: [213, 150], sh_degree: 2, log_scale: [-4.5, -2.0], ..Draw::default() };
    let scene = random(77, draw);
    let weights = upstream(5, &scene);
    let on = |num_threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(num_threads).build().expect("the pool starts");
        pool.install(|| scene.frame_and_gradients(&weights).1.pose)
    };
    let expected = on(1);
    assert!(expected.iter().all(|v| v.is_finite() && *v != 0.0));
    for num_threads in [2, 3, 7] {
        assert_eq!(on(num_threads), expected, "{num_threads} threads");
    }
}

/// Enough splats for three levels of the tree. Against the sum in float64 of the gradients that the same device gave, the
/// rounding of a tree of V parts is the bound, with the three roundings of a part on top.
#[test]
fn sum_over_many_splats_is_off_by_the_depth_of_a_tree() {
    let mut scene =
        random(130, Draw { n: 80_000, size: [120, 90], log_scale: [-7.0, -5.0], stray: 0.0, ..Draw::default() });
    scene.options.sh_degree = Some(0);
    let (frame, gradients) = scene.frame_and_gradients(&upstream(130, &scene));
    assert!(frame.stats.num_visible > 256 * 256, "{}", frame.stats.num_visible);
    let rotation = Mat3::from_mat4(scene.camera.camera_from_world).as_dmat3();
    let sum = gradients.means.chunks_exact(3).fold(DVec3::ZERO, |sum, g| sum + Vec3::from_slice(g).as_dvec3());
    let magnitude = magnitudes(&scene, &gradients.means)[1];
    let roundings = (frame.stats.num_visible as f64).log2().ceil() + 3.0;
    let bound = roundings * f64::from(f32::EPSILON) / 2.0 * magnitude;
    let d = assert_close("v", &gradients.pose[3..], &(rotation * sum).to_array(), Tolerance::max_abs(bound));
    println!("off by {:.1e} of the magnitudes, bound {:.1e}", d.max_abs / magnitude, bound / magnitude);
}

/// A scene, its gradient on the CPU, and the magnitudes it is a sum of.
type Case = (Scene, Vec<f32>, [f64; 2]);

thread_local! {
    static CPU: std::cell::RefCell<Vec<Case>> = const { std::cell::RefCell::new(Vec::new()) };
}

/// The tolerance is a tenth of that of the parameters' gradients (`gpu_equals_cpu`), of the magnitudes that are summed: how far they
/// cancel is no fault of either.
#[test]
fn pose_gradients_of_the_gpu_are_those_of_the_cpu() {
    let scenes: Vec<Scene> = (0..12)
        .map(|seed| {
            let n = [1, 40, 255, 257, 2000][(seed % 5) as usize];
            random(140 + seed, Draw { n, size: [64, 50], sh_degree: (seed % 5) as u32, ..Draw::default() })
        })
        .collect();
    let run = |scene: &Scene| scene.frame_and_gradients(&sturdy_upstream(7, scene)).1;
    CPU.set(
        scenes
            .into_iter()
            .map(|scene| {
                let gradients = run(&scene);
                let magnitudes = magnitudes(&scene, &gradients.means);
                (scene, gradients.pose, magnitudes)
            })
            .collect(),
    );
    with_gpu(|| {
        CPU.with_borrow(|cases| {
            for (k, (scene, expected, [torque, force])) in cases.iter().enumerate() {
                let weights = sturdy_upstream(7, scene);
                let found = scene.frame_and_gradients(&weights).1.pose;
                assert_eq!(scene.frame_and_gradients(&weights).1.pose, found, "scene {k}: the same bits twice");
                for (part, range, scale) in [("ω", 0..3, torque), ("v", 3..6, force)] {
                    let d = assert_close(
                        &format!("scene {k}: {part}"),
                        &found[range.clone()],
                        &expected[range].iter().map(|&v| f64::from(v)).collect::<Vec<_>>(),
                        Tolerance::max_abs(1e-5 * scale),
                    );
                    println!("scene {k}: {part} off by {:.1e} of {scale:.1e}", d.max_abs);
                }
            }
        });
    });
}

crate::common::on_gpu!(
    pose_gradients_equal_differences_of_the_reference_in_every_sh_degree,
    pose_gradients_through_stop_clamp_and_background_equal_differences_of_the_reference,
    depth_and_alpha_pull_at_the_pose_too,
    smooth_cutoff_pose_gradients_equal_differences_of_the_renderer,
    translation_gradient_is_the_turned_sum_of_the_mean_gradients,
    round_splat_on_the_axis_has_the_gradient_of_its_image,
    nothing_visible_gives_no_pull,
    culled_and_broken_gaussians_pull_at_nothing,
    pose_gradient_stands_by_itself,
    sum_over_many_splats_is_off_by_the_depth_of_a_tree,
);
