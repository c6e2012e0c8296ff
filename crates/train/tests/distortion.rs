//! Captures through lenses that distort train as well as what a pinhole would have taken of the same scene.

#![expect(clippy::unwrap_used, reason = "a helper of a test may panic like the test")]

use gazesplat_core::camera::distortion::{LensDistortion, LensModel};
use gazesplat_core::dataset::{Dataset, LoadOptions};
use gazesplat_core::io::images::{ImageCache, load_view_image};
use gazesplat_core::io::save_png;
use gazesplat_core::synthetic::SyntheticScene;
use gazesplat_core::{Camera, ImageF32};
use gazesplat_render::cpu_device;
use gazesplat_train::{Config, Trainer, evaluate, run, with_threads};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

const NUM_VIEWS: usize = 32;
const STEPS: u32 = 400;
const SAMPLES_PER_SIDE: u32 = 3;

/// What the issue asks for.
const MAX_LOSS_DB: f64 = 0.5;

/// A directory of this test, removed when dropped.
struct Scratch(PathBuf);

impl Drop for Scratch {
    fn drop(&mut self) {
        // A leftover in the temporary directory is no reason to fail.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Writes a COLMAP text model of `cameras` with one calibration, and what `photograph` sees from each.
fn write_scene(
    dir: &Path,
    scene: &SyntheticScene,
    cameras: &[Camera],
    calibration: &str,
    photograph: impl Fn(&Camera) -> ImageF32,
) -> Dataset {
    let sparse = dir.join("sparse/0");
    std::fs::create_dir_all(&sparse).unwrap();
    std::fs::create_dir_all(dir.join("images")).unwrap();
    let mut images = String::new();
    for (i, camera) in cameras.iter().enumerate() {
        save_png(dir.join(format!("images/{i:03}.png")), &photograph(camera).to_rgb8()).unwrap();
        let (_, q, t) = camera.camera_from_world.as_dmat4().to_scale_rotation_translation();
        writeln!(images, "{} {} {} {} {} {} {} {} 1 {i:03}.png\n", i + 1, q.w, q.x, q.y, q.z, t.x, t.y, t.z).unwrap();
    }
    let points = scene.sparse_points(2500, 0);
    let mut text = String::new();
    for (i, ([x, y, z], [r, g, b])) in points.positions.iter().zip(&points.colors).enumerate() {
        writeln!(text, "{} {x} {y} {z} {r} {g} {b} 0", i + 1).unwrap();
    }
    std::fs::write(sparse.join("cameras.txt"), format!("1 {calibration}\n")).unwrap();
    std::fs::write(sparse.join("images.txt"), images).unwrap();
    std::fs::write(sparse.join("points3D.txt"), text).unwrap();
    Dataset::load(dir, &LoadOptions::default()).unwrap()
}

/// Trains on `dataset` and measures on the test views of `measured`.
fn quality(dataset: &Dataset, measured: &Dataset) -> f64 {
    let mut config = Config::default();
    config.train.steps = STEPS;
    config.train.eval_every = 0;
    config.densify.cap = 5000;
    config.model.sh_degree = 1;
    let images = Arc::new(ImageCache::new(dataset.train.clone(), config.data.cache_bytes));
    let mut trainer = Trainer::new(dataset, images, &config, &cpu_device()).unwrap();
    run(&mut trainer, &mut [], &AtomicBool::new(false)).unwrap();
    let views = ImageCache::new(measured.test.clone(), config.data.cache_bytes);
    evaluate(&trainer.splats().unwrap(), &views, &config.render_options(), &mut |_, _| {}).unwrap().psnr
}

/// Loss in dB of a capture through `lens` against its pinhole twin, measured on the twin's test photographs.
fn loss_against_pinhole_twin(lens: &LensDistortion) -> f64 {
    let name = lens.model.name();
    let scratch = Scratch(std::env::temp_dir().join(format!("gazesplat-{name}-{}", std::process::id())));
    let scene = SyntheticScene::room(0);
    // The pinhole that the photographs are undistorted to: views of both captures are the same, pixel by pixel.
    let pinhole = lens.undistorted_pinhole();
    let cameras = scene.camera_ring(NUM_VIEWS, pinhole);
    let calibration = format!(
        "PINHOLE {} {} {} {} {} {}",
        pinhole.width, pinhole.height, pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy
    );
    let twin = write_scene(&scratch.0.join("pinhole"), &scene, &cameras, &calibration, |camera| {
        scene.render(camera, SAMPLES_PER_SIDE)
    });
    let [k1, k2, k3, k4, ..] = lens.coefficients;
    let calibration = format!(
        "{name} {} {} {} {} {} {} {k1} {k2} {k3} {k4}",
        lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy
    );
    let distorted = write_scene(&scratch.0.join("lens"), &scene, &cameras, &calibration, |camera| {
        scene.render_distorted(camera.camera_from_world, lens, SAMPLES_PER_SIDE)
    });
    for (ours, theirs) in distorted.test.iter().zip(&twin.test) {
        assert!(ours.distortion.is_some() && theirs.distortion.is_none());
        assert_eq!(ours.camera.intrinsics, theirs.camera.intrinsics);
        assert_eq!(load_view_image(ours).unwrap().mask, None, "the common region is the whole view");
    }
    let [reference, found] = [&twin, &distorted].map(|dataset| quality(dataset, &twin));
    let naive = quality(&Dataset { train: without_lens(&distorted), ..distorted.clone() }, &twin);
    println!("{name}: twin {reference:.3} dB, through the lens {found:.3} dB, lens ignored {naive:.3} dB");
    assert!(reference > 20.0, "{name}: the twin itself has learnt something: {reference} dB");
    // The comparison must be able to fail: with the lens left as it is, it does.
    assert!(reference - naive > 2.0 * MAX_LOSS_DB, "{name}: without undistortion {naive} dB, twin {reference} dB");
    reference - found
}

/// The training views as a loader that knows nothing of lenses would have them.
fn without_lens(dataset: &Dataset) -> Vec<gazesplat_core::View> {
    let strip = |view: &gazesplat_core::View| {
        let mut view = view.clone();
        let lens = view.distortion.take().unwrap();
        view.camera.intrinsics = gazesplat_core::Pinhole {
            width: lens.width,
            height: lens.height,
            fx: lens.fx as f32,
            fy: lens.fy as f32,
            cx: lens.cx as f32,
            cy: lens.cy as f32,
        };
        view
    };
    dataset.train.iter().map(strip).collect()
}

#[test]
fn opencv_capture_trains_as_well_as_its_pinhole_twin() {
    // A barrel of a wide-angle lens, 11 px in the corners.
    let k = [-0.18, 0.03, 0.002, -0.003, 0., 0., 0., 0.];
    let lens = LensDistortion::new(LensModel::OpenCv, [144, 96], [100.0, 99.0], [73.0, 47.0], k);
    let loss = with_threads(0, || loss_against_pinhole_twin(&lens)).unwrap();
    assert!(loss < MAX_LOSS_DB, "{loss} dB are lost");
}

#[test]
fn fisheye_capture_trains_as_well_as_its_pinhole_twin() {
    // 90° across.
    let k = [0.02, -0.01, 0.002, 0.0, 0., 0., 0., 0.];
    let lens = LensDistortion::new(LensModel::OpenCvFisheye, [144, 96], [92.0, 92.0], [71.0, 49.0], k);
    let loss = with_threads(0, || loss_against_pinhole_twin(&lens)).unwrap();
    assert!(loss < MAX_LOSS_DB, "{loss} dB are lost");
}
