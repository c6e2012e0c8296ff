//! Images and gradients against the golden records (`tests/golden/README.md`), on every backend.
//!
//! The bound is five times the error that the oracle itself makes in float32, from each record. `--nocapture` prints the
//! table. Which records there are is not known here: whatever `render_*.json` the golden directory holds is run.

use burn::tensor::Device;
use gazesplat_core::{Camera, GaussianCloud, Pinhole};
use gazesplat_render::kernels::cpu::project::{GaussianSlices, ViewSpec, project};
use gazesplat_render::layout::lane;
use gazesplat_render::view_params::view_params;
use gazesplat_render::{RenderOptions, Termination};
use gazesplat_testkit::{Golden, Tolerance, difference, golden};
use glam::{Mat4, Vec4};

use crate::common::{Frame, Scene, devices, sturdy};

/// A record may be off by this multiple of its float32 yardstick.
const YARDSTICKS: f64 = 5.0;
/// Bound on errors for which a record has no yardstick, relative to the largest value (images) or in L2 (gradients).
const NO_YARDSTICK: f64 = 1e-5;

/// The records this renderer covers, loaded; what it has no option for is said aloud.
pub fn covered() -> Vec<(Golden, Scene)> {
    let files = golden::list("render_");
    let num_files = files.len();
    let mut covered = Vec::new();
    for file in files {
        let golden = file.load();
        let reason = if golden.number("eps2d").is_some_and(|e| e != 0.3) {
            "another dilation than 0.3"
        } else {
            let scene = scene(&golden);
            covered.push((golden, scene));
            continue;
        };
        println!("NOT COVERED: {}: {reason}", golden.stem);
    }
    println!("{} of {num_files} golden records covered", covered.len());
    assert!(!covered.is_empty(), "none of {num_files} golden records can be rendered");
    covered
}

fn rows<const D: usize>(values: &[f32]) -> Vec<[f32; D]> {
    values.chunks_exact(D).map(|c| c.try_into().expect("chunks_exact yields D values")).collect()
}

/// The inputs of a record.
pub fn scene(golden: &Golden) -> Scene {
    let number = |key: &str| golden.number(key).unwrap_or_else(|| panic!("{}: {key} is missing", golden.stem)) as f32;
    let num_coefficients = golden.shape("in.sh")[1];
    let cloud = GaussianCloud {
        means: rows(&golden.f32("in.means")),
        quats: rows(&golden.f32("in.quats")),
        log_scales: rows(&golden.f32("in.log_scales")),
        opacity_logits: golden.f32("in.opacity_logits"),
        sh_degree: num_coefficients.isqrt() as u32 - 1,
        sh: rows(&golden.f32("in.sh")),
    };
    let intrinsics = Pinhole {
        width: number("width") as u32,
        height: number("height") as u32,
        fx: number("fx"),
        fy: number("fy"),
        cx: number("cx"),
        cy: number("cy"),
    };
    let matrix: Vec<Vec4> = rows::<4>(&golden.f32("in.viewmat")).into_iter().map(Vec4::from).collect();
    let camera_from_world = Mat4::from_cols(matrix[0], matrix[1], matrix[2], matrix[3]).transpose();
    let options = RenderOptions {
        near: number("near"),
        alpha_max: number("alpha_max"),
        termination: Termination::Fixed(number("t_min")),
        background: golden.f32("in.background").try_into().expect("the background is RGB"),
        sh_degree: Some(number("sh_degree") as u32),
        depth: true,
        antialiased: golden.json["antialiased"].as_bool().unwrap_or(false),
        ..RenderOptions::default()
    };
    Scene { cloud, camera: Camera { intrinsics, camera_from_world }, options }
}

/// Pixels whose branches float32 rounding could flip; none where the record does not say.
pub fn fragile(golden: &Golden, scene: &Scene) -> Vec<bool> {
    let pixels = scene.image_len() / scene.channels();
    if golden.array("out.fragile").is_some() { golden.bool("out.fragile") } else { vec![false; pixels] }
}

/// Errors and bounds of all records, and what was violated.
#[derive(Default)]
struct Table {
    rows: Vec<String>,
    violations: Vec<String>,
    worst_ratio: f64,
    checks: usize,
}

impl Table {
    fn check(&mut self, golden: &Golden, what: &str, key: &str, error: f64, fallback: f64) {
        // Keys of the yardsticks hold dots.
        let yardstick = golden.json["yardstick_torch_f32_vs_f64"][key].as_f64();
        let bound = yardstick.map_or(fallback, |y| YARDSTICKS * y);
        let ratio = yardstick.map_or(f64::NAN, |y| error / y);
        let row =
            format!("{:24} {what:28} {error:10.2e} {:10.2e} {ratio:8.2}", golden.stem, yardstick.unwrap_or(f64::NAN));
        if ratio > self.worst_ratio {
            self.worst_ratio = ratio;
        }
        if error.is_nan() || error > bound {
            self.violations.push(format!("{row}  above {bound:.2e}"));
        }
        self.rows.push(row);
        self.checks += 1;
    }

    fn finish(self, title: &str) {
        println!("{title}\n{:24} {:28} {:>10} {:>10} {:>8}", "record", "quantity", "error", "yardstick", "ratio");
        println!("{}", self.rows.join("\n"));
        println!("{} comparisons, worst ratio {:.2}, allowed {YARDSTICKS}", self.checks, self.worst_ratio);
        assert!(
            self.violations.is_empty(),
            "{title}: {} violations\n{}",
            self.violations.len(),
            self.violations.join("\n")
        );
    }
}

fn check_image(table: &mut Table, golden: &Golden, scene: &Scene, frame: &Frame) {
    let fragile = fragile(golden, scene);
    let channels = |range: std::ops::Range<usize>| -> Vec<f32> {
        let values = frame.image.chunks_exact(frame.channels).flat_map(|p| p[range.clone()].to_vec());
        values.collect()
    };
    for (name, range) in [("color", 0..3), ("alpha", 3..4), ("depth_acc", 4..5)] {
        let width = range.len();
        let found = channels(range);
        gazesplat_testkit::close::assert_finite(&format!("{} {name}", golden.stem), &found);
        let expected = golden.f64(&format!("out.{name}"));
        let d = difference(&sturdy(&found, width, &fragile), &sturdy(&expected, width, &fragile));
        table.check(golden, name, name, d.max_abs, NO_YARDSTICK * d.scale.max(1.0));
    }
}

/// Upstream gradient of the two losses of a record.
fn upstream(golden: &Golden, full: bool) -> Vec<f32> {
    let (color, alpha, depth) =
        (golden.f32("loss.w_color"), golden.f32("loss.w_alpha"), golden.f32("loss.w_depth_acc"));
    let scale = if full { 1.0 } else { 0.0 };
    let pixels = color.chunks_exact(3).zip(alpha.iter().zip(&depth));
    pixels.flat_map(|(c, (a, d))| [c[0], c[1], c[2], scale * a, scale * d]).collect()
}

fn check_gradients(table: &mut Table, golden: &Golden, scene: &Scene, device: &Device) {
    for loss in ["color", "full"] {
        let (_, gradients) = scene.frame_and_gradients_on(device, &upstream(golden, loss == "full"));
        gradients.assert_finite(&golden.stem);
        let lanes = |first: usize| -> Vec<f32> {
            gradients.means2d.chunks_exact(4).flat_map(|g| [g[first], g[first + 1]]).collect()
        };
        let (means2d, means2d_abs) = (lanes(0), lanes(2));
        let groups: [(&str, &str, &[f32]); 8] = [
            ("means", "means", &gradients.means),
            ("quats", "quats", &gradients.quats),
            ("log_scales", "log_scales", &gradients.log_scales),
            ("opacity_logits", "opacity_logits", &gradients.opacity_logits),
            ("sh", "sh", &gradients.sh),
            ("means2d", "means2d", &means2d),
            // No yardstick of its own: a sum without cancellation is no harder than the signed one.
            ("means2d_abs", "means2d", &means2d_abs),
            // Six combinations of the entries of the raw derivative, without a yardstick of their own.
            ("se3_left", "viewmat", &gradients.pose),
        ];
        for (name, yardstick, found) in groups {
            let array = format!("grad_{loss}.{name}");
            if golden.array(&array).is_some() {
                let d = difference(found, &golden.f64(&array));
                table.check(golden, &array, &format!("rel_l2_grad.{loss}.{yardstick}"), d.relative_l2, NO_YARDSTICK);
            }
        }
    }
}

#[test]
fn golden_images_are_within_five_yardsticks() {
    let records = covered();
    for (name, device) in devices() {
        let mut table = Table::default();
        for (golden, scene) in &records {
            check_image(&mut table, golden, scene, &scene.frame_on(&device));
        }
        table.finish(&format!("images on {name}"));
    }
}

/// Expected depth against `out.depth_expected`. Accumulated depth d and alpha a may each be off by five yardsticks, so their
/// quotient e by 5 (y_d + e y_a) / a to first order.
#[test]
fn golden_expected_depths_are_as_exact_as_what_they_are_quotients_of() {
    for (golden, scene) in covered() {
        let fragile = fragile(&golden, &scene);
        let yardstick = |key: &str| {
            let found = golden.json["yardstick_torch_f32_vs_f64"][key].as_f64();
            found.unwrap_or_else(|| panic!("{}: no yardstick of {key}", golden.stem))
        };
        let (of_depth, of_alpha) = (yardstick("depth_acc"), yardstick("alpha"));
        let (expected, alpha) = (golden.f64("out.depth_expected"), golden.f64("out.alpha"));
        let found = scene.expected_depth();
        gazesplat_testkit::close::assert_finite(&golden.stem, &found);
        assert_eq!(found.len(), expected.len(), "{}", golden.stem);
        let mut worst = 0.0f64;
        for (pixel, (found, expected)) in found.iter().zip(&expected).enumerate() {
            if fragile[pixel] {
                continue;
            }
            if alpha[pixel] == 0.0 {
                assert_eq!(*found, 0.0, "{}: nothing is seen in pixel {pixel}", golden.stem);
                continue;
            }
            // The quotient itself is rounded to float32.
            let bound = YARDSTICKS * (of_depth + expected * of_alpha) / alpha[pixel] + 6e-8 * expected;
            let error = (f64::from(*found) - expected).abs();
            worst = worst.max(error / bound);
            assert!(error <= bound, "{}, pixel {pixel}: {found}, expected {expected} ± {bound:.1e}", golden.stem);
        }
        println!("{:24} expected depth: at most {worst:.2} of the bound", golden.stem);
    }
}

#[test]
fn golden_gradients_are_within_five_yardsticks() {
    let records = covered();
    for (name, device) in devices() {
        let mut table = Table::default();
        for (golden, scene) in &records {
            check_gradients(&mut table, golden, scene, &device);
        }
        table.finish(&format!("gradients on {name}"));
    }
}

/// Last row of the table of numerical hazards.
#[test]
fn golden_scenes_bound_the_error_of_float32() {
    for (golden, scene) in covered() {
        let (frame, gradients) = scene.frame_and_gradients(&upstream(&golden, true));
        let fragile = fragile(&golden, &scene);
        for (name, range) in [("color", 0..3), ("alpha", 3..4), ("depth_acc", 4..5)] {
            let width = range.len();
            let found: Vec<f32> =
                frame.image.chunks_exact(frame.channels).flat_map(|p| p[range.clone()].to_vec()).collect();
            let d = difference(
                &sturdy(&found, width, &fragile),
                &sturdy(&golden.f64(&format!("out.{name}")), width, &fragile),
            );
            let scale = d.scale.max(f64::MIN_POSITIVE);
            println!("{:24} {name:10} mean {:.2e} max {:.2e}", golden.stem, d.mean_abs / scale, d.max_abs / scale);
            let tolerance = Tolerance { mean_abs: 1e-5 * scale, max_abs: 1e-3 * scale, ..Tolerance::NONE };
            assert_eq!(tolerance.violation(&d), None, "{} {name}", golden.stem);
        }
        for (name, found) in gradients.groups() {
            let array = format!("grad_full.{name}");
            if name != "means2d" && golden.array(&array).is_some() {
                let d = difference(found, &golden.f64(&array));
                assert_eq!(Tolerance::relative_l2(1e-3).violation(&d), None, "{} {array}", golden.stem);
            }
        }
    }
}

/// Training renders the image that inference renders.
#[test]
fn golden_images_do_not_depend_on_the_pass() {
    for (golden, scene) in covered() {
        let (training, _) = scene.frame_and_gradients(&upstream(&golden, false));
        assert!(training.image == scene.frame().image, "{}: image of the training pass differs", golden.stem);
    }
}

/// The lanes of the projection against `proj.*`; Gaussians that are culled because nothing of them is seen are left out.
#[test]
fn golden_projections_equal_the_oracle() {
    let bound = 2e-5;
    for (golden, scene) in covered() {
        let cloud = &scene.cloud;
        let slices = GaussianSlices {
            means: cloud.means.as_flattened(),
            quats: cloud.quats.as_flattened(),
            log_scales: cloud.log_scales.as_flattened(),
            opacity_logits: &cloud.opacity_logits,
            sh: cloud.sh.as_flattened(),
            num_coefficients: cloud.num_coefficients(),
            sh_degree: scene.options.sh_degree.expect("records name their degree"),
        };
        let view = ViewSpec {
            params: view_params(&scene.camera).expect("the camera is legal"),
            width: scene.camera.intrinsics.width,
            height: scene.camera.intrinsics.height,
            near: scene.options.near,
            antialiased: scene.options.antialiased,
        };
        let projected = project(&slices, &view, None);
        let valid = golden.bool("proj.valid");
        let indices = || projected.global_from_compact.iter().map(|&i| i as usize);
        assert!(indices().all(|i| valid[i]), "{}: a Gaussian is visible that the oracle culls", golden.stem);
        assert_eq!(projected.num_non_finite, 0, "{}", golden.stem);
        for (name, first, width) in [
            ("means2d", lane::MEAN_X, 2),
            ("conics", lane::CONIC_XX, 3),
            ("colors", lane::RED, 3),
            ("depths", lane::DEPTH, 1),
            ("opacities_eff", lane::LOG2_OPACITY, 1),
        ] {
            let of_all = golden.f64(&format!("proj.{name}"));
            let expected: Vec<f64> = indices().flat_map(|i| of_all[i * width..(i + 1) * width].to_vec()).collect();
            let mut found: Vec<f32> = projected.rows().iter().flat_map(|r| r[first..first + width].to_vec()).collect();
            if first == lane::LOG2_OPACITY {
                found.iter_mut().for_each(|v| *v = v.exp2());
            }
            let d = difference(&found, &expected);
            println!(
                "{:24} {name:14} relative L2 {:.1e}, {} of {} visible",
                golden.stem,
                d.relative_l2,
                projected.len(),
                valid.len()
            );
            assert_eq!(Tolerance::relative_l2(bound).violation(&d), None, "{} {name}", golden.stem);
        }
    }
}

crate::common::on_gpu!(
    golden_images_are_within_five_yardsticks,
    golden_expected_depths_are_as_exact_as_what_they_are_quotients_of,
    golden_gradients_are_within_five_yardsticks,
    golden_scenes_bound_the_error_of_float32,
    golden_images_do_not_depend_on_the_pass,
);
