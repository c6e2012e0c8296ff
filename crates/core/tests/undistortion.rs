//! Undistortion against the analytic lens models, written here a second time from their definitions: the maps both ways,
//! and the resampled photographs, each within a twentieth of a pixel.

use gazesplat_core::RgbImage8;
use gazesplat_core::camera::distortion::{LensDistortion, LensModel};

/// What the maps are held to, in pixels.
const MAX_ERROR_PX: f64 = 0.05;

/// Where COLMAP's (or nerfstudio's) camera model `name` with `params` (focal lengths, principal point, coefficients in COLMAP's order) shows
/// the ray (u, v, 1), in pixels. From the formulas in COLMAP's documentation of its models and OpenCV's of its own.
fn project(name: &str, params: &[f64], u: f64, v: f64) -> [f64; 2] {
    let single =
        matches!(name, "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" | "SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE");
    let (fx, fy, c, k) = if single {
        (params[0], params[0], [params[1], params[2]], &params[3..])
    } else {
        (params[0], params[1], [params[2], params[3]], &params[4..])
    };
    let r = u.hypot(v);
    let theta = r.atan();
    let scaled = |factor: f64| (u * factor, v * factor);
    let of_angle = |distorted: f64| scaled(if r > 0.0 { distorted / r } else { 1.0 });
    let brown = |x: f64, y: f64, radial: f64, p1: f64, p2: f64| {
        let r2 = x * x + y * y;
        (
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    };
    let (x, y) = match name {
        "SIMPLE_PINHOLE" | "PINHOLE" => (u, v),
        "SIMPLE_RADIAL" => scaled(1.0 + k[0] * r.powi(2)),
        "RADIAL" => scaled(1.0 + k[0] * r.powi(2) + k[1] * r.powi(4)),
        "OPENCV" => brown(u, v, 1.0 + k[0] * r.powi(2) + k[1] * r.powi(4), k[2], k[3]),
        "FULL_OPENCV" => {
            let above = 1.0 + k[0] * r.powi(2) + k[1] * r.powi(4) + k[4] * r.powi(6);
            let below = 1.0 + k[5] * r.powi(2) + k[6] * r.powi(4) + k[7] * r.powi(6);
            brown(u, v, above / below, k[2], k[3])
        }
        // Of nerfstudio's `camera_utils`, with the coefficients in the order k1, k2, p1, p2, k3, k4.
        "PERSPECTIVE" => {
            let radial = 1.0 + k[0] * r.powi(2) + k[1] * r.powi(4) + k[4] * r.powi(6) + k[5] * r.powi(8);
            brown(u, v, radial, k[2], k[3])
        }
        "OPENCV_FISHEYE" => {
            of_angle(theta + k[0] * theta.powi(3) + k[1] * theta.powi(5) + k[2] * theta.powi(7) + k[3] * theta.powi(9))
        }
        "SIMPLE_RADIAL_FISHEYE" => of_angle(theta + k[0] * theta.powi(3)),
        "RADIAL_FISHEYE" => of_angle(theta + k[0] * theta.powi(3) + k[1] * theta.powi(5)),
        "FOV" => of_angle((2.0 * r * (0.5 * k[0]).tan()).atan() / k[0]),
        "THIN_PRISM_FISHEYE" => {
            let (a, b) = of_angle(theta);
            let t2 = theta * theta;
            let radial = 1.0 + k[0] * t2 + k[1] * t2.powi(2) + k[4] * t2.powi(3) + k[5] * t2.powi(4);
            let (x, y) = brown(a, b, radial, k[2], k[3]);
            (x + k[6] * t2, y + k[7] * t2)
        }
        other => panic!("no formula for {other}"),
    };
    [fx * x + c[0], fy * y + c[1]]
}

const SIZE: [u32; 2] = [400, 300];

/// Calibrations of every model: a usual lens and a strong one each; barrels, pincushions, lopsided ones and fisheyes of
/// 150° and more. All are one-to-one over their photograph.
fn lenses() -> Vec<(&'static str, Vec<f64>)> {
    let single = |f: f64, k: &[f64]| [&[f, 203.0, 148.0], k].concat();
    let double = |fx: f64, fy: f64, k: &[f64]| [&[fx, fy, 203.0, 148.0], k].concat();
    vec![
        ("SIMPLE_PINHOLE", single(310.0, &[])),
        ("PINHOLE", double(310.0, 305.0, &[])),
        ("SIMPLE_RADIAL", single(310.0, &[-0.05])),
        ("SIMPLE_RADIAL", single(400.0, &[-0.28])),
        ("SIMPLE_RADIAL", single(240.0, &[0.4])),
        ("RADIAL", single(310.0, &[0.06, -0.08])),
        ("RADIAL", single(230.0, &[-0.34, 0.13])),
        ("OPENCV", double(310.0, 305.0, &[0.056, -0.077, -0.0016, -0.0023])),
        ("OPENCV", double(230.0, 236.0, &[-0.31, 0.12, 0.012, -0.009])),
        ("FULL_OPENCV", double(310.0, 305.0, &[0.1, -0.02, 0.001, 0.002, 0.003, 0.05, 0.01, 0.001])),
        ("FULL_OPENCV", double(220.0, 226.0, &[0.3, 0.1, -0.006, 0.008, 0.02, 0.6, 0.3, 0.05])),
        ("PERSPECTIVE", double(310.0, 305.0, &[0.05, -0.04, 0.001, 0.002, 0.01, -0.002])),
        ("PERSPECTIVE", double(230.0, 236.0, &[-0.3, 0.12, 0.008, -0.006, -0.02, 0.01])),
        ("OPENCV_FISHEYE", double(300.0, 297.0, &[0.02, -0.01, 0.003, -0.001])),
        ("OPENCV_FISHEYE", double(200.0, 198.0, &[-0.06, 0.02, -0.01, 0.002])),
        ("SIMPLE_RADIAL_FISHEYE", single(300.0, &[0.03])),
        ("SIMPLE_RADIAL_FISHEYE", single(200.0, &[-0.05])),
        ("RADIAL_FISHEYE", single(300.0, &[0.03, -0.01])),
        ("RADIAL_FISHEYE", single(200.0, &[-0.07, 0.015])),
        ("FOV", double(310.0, 305.0, &[0.4])),
        ("FOV", double(230.0, 233.0, &[1.15])),
        ("THIN_PRISM_FISHEYE", double(300.0, 297.0, &[0.02, -0.01, 0.001, -0.002, 0.003, -0.001, 0.002, -0.001])),
        ("THIN_PRISM_FISHEYE", double(205.0, 202.0, &[-0.05, 0.01, 0.006, -0.005, -0.004, 0.001, 0.01, -0.012])),
    ]
}

fn lens(name: &str, params: &[f64]) -> LensDistortion {
    let model = LensModel::from_name(name).unwrap_or(LensModel::Perspective);
    let num_focal = if model.has_single_focal() { 1 } else { 2 };
    let mut coefficients = [0.0; 8];
    coefficients[..params.len() - num_focal - 2].copy_from_slice(&params[num_focal + 2..]);
    let focal = [params[0], params[num_focal - 1]];
    LensDistortion::new(model, SIZE, focal, [params[num_focal], params[num_focal + 1]], coefficients)
}

/// Centres of pixels over the whole photograph, corners included.
fn grid() -> impl Iterator<Item = [f64; 2]> {
    let [w, h] = SIZE.map(f64::from);
    (0..=30).flat_map(move |j| {
        (0..=40).map(move |i| [0.5 + (w - 1.0) * f64::from(i) / 40.0, 0.5 + (h - 1.0) * f64::from(j) / 30.0])
    })
}

#[test]
fn every_model_has_a_usual_and_a_strong_lens_here() {
    for model in LensModel::ALL {
        let least = if matches!(model, LensModel::SimplePinhole | LensModel::Pinhole) { 1 } else { 2 };
        assert!(lenses().iter().filter(|(name, _)| *name == model.name()).count() >= least, "{model:?}");
    }
}

#[test]
fn forward_map_is_the_analytic_model() {
    for (name, params) in lenses() {
        let lens = lens(name, &params);
        for [x, y] in grid() {
            // Rays up to what the strongest fisheye shows in its corners.
            let ray = [(x - lens.cx) / 120.0, (y - lens.cy) / 120.0];
            let [u, v] = lens.distort(ray);
            let [eu, ev] = project(name, &params, ray[0], ray[1]);
            let error = (u * lens.fx + lens.cx - eu).hypot(v * lens.fy + lens.cy - ev);
            assert!(error < MAX_ERROR_PX, "{name} {params:?}: off by {error} px at the ray {ray:?}");
        }
    }
}

#[test]
fn backward_map_of_every_pixel_leads_back_to_it() {
    for (name, params) in lenses() {
        let lens = lens(name, &params);
        let mut num_mapped = 0;
        for pixel in grid() {
            let distorted = [(pixel[0] - lens.cx) / lens.fx, (pixel[1] - lens.cy) / lens.fy];
            let Some(ray) = lens.undistort(distorted) else { continue };
            num_mapped += 1;
            let [u, v] = project(name, &params, ray[0], ray[1]);
            let error = (u - pixel[0]).hypot(v - pixel[1]);
            assert!(error < MAX_ERROR_PX, "{name} {params:?}: off by {error} px at {pixel:?}");
        }
        assert_eq!(num_mapped, grid().count(), "{name} {params:?}");
    }
}

/// Pixels per period of the pattern: 8-bit levels are then 0.024 px, half of which is rounding.
const PERIOD: u32 = 6;

/// Red and green tell the position along x and along y within a period.
fn pattern() -> RgbImage8 {
    let level = |i: u32| ((f64::from(i % PERIOD) + 0.5) / f64::from(PERIOD) * 255.0).round() as u8;
    let [w, h] = SIZE;
    let data = (0..h).flat_map(|y| (0..w).flat_map(move |x| [level(x), level(y), 0])).collect();
    RgbImage8 { width: w, height: h, data }
}

#[test]
fn resampled_pixels_come_from_where_the_analytic_model_puts_their_rays() {
    let photo = pattern();
    for (name, params) in lenses() {
        let lens = lens(name, &params);
        let out = lens.undistort_image(&photo, None, None);
        let pinhole = lens.undistorted_pinhole();
        assert_eq!([out.image.width, out.image.height], [pinhole.width, pinhole.height]);
        let (mut num_checked, mut worst) = (0, 0.0_f64);
        for y in 0..pinhole.height {
            for x in 0..pinhole.width {
                let u = (f64::from(x) + 0.5 - f64::from(pinhole.cx)) / f64::from(pinhole.fx);
                let v = (f64::from(y) + 0.5 - f64::from(pinhole.cy)) / f64::from(pinhole.fy);
                let source = project(name, &params, u, v);
                let is_masked = out.mask.as_ref().is_some_and(|mask| mask[(y * pinhole.width + x) as usize] == 0);
                let is_seen = source.iter().zip(SIZE).all(|(s, n)| (0.0..=f64::from(n)).contains(s));
                // Blank where the photograph ends, and nowhere else.
                assert!(
                    is_masked != is_seen || near_edge(source),
                    "{name} {params:?}: pixel ({x}, {y}), masked {is_masked}"
                );
                if is_masked || !is_seen {
                    continue;
                }
                let [red, green, _] = out.image.pixel(x, y);
                for (axis, level) in [red, green].into_iter().enumerate() {
                    let phase = source[axis].rem_euclid(f64::from(PERIOD));
                    let last = f64::from(PERIOD) - 0.5;
                    // Where a period wraps, between the centres of its last and the next first pixel, the pattern says nothing.
                    if !(0.5..=last).contains(&phase) || !(0.5..=f64::from(SIZE[axis]) - 0.5).contains(&source[axis]) {
                        continue;
                    }
                    let told = f64::from(level) / 255.0 * f64::from(PERIOD);
                    num_checked += 1;
                    worst = worst.max((told - phase).abs());
                    assert!(
                        (told - phase).abs() < MAX_ERROR_PX,
                        "{name} {params:?}: pixel ({x}, {y}) comes from {told} instead of {phase} along axis {axis}"
                    );
                }
            }
        }
        assert!(num_checked > 30_000, "{name}: {num_checked} checked");
    }
}

fn near_edge([x, y]: [f64; 2]) -> bool {
    let near = |v: f64, n: u32| v.abs() < 0.01 || (v - f64::from(n)).abs() < 0.01;
    near(x, SIZE[0]) || near(y, SIZE[1])
}
