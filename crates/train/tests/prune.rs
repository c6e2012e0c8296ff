//! Pruning from outside: rankings of closed forms, and a whole run on a model with Gaussians that earn nothing.

use gazesplat_core::dataset::Holdout;
use gazesplat_core::image::RgbImage8;
use gazesplat_core::io::images::ImageCache;
use gazesplat_core::io::save_png;
use gazesplat_core::synthetic::{SynthOptions, write_scene};
use gazesplat_core::{Camera, Dataset, GaussianCloud, Pinhole, sh};
use gazesplat_render::{RenderOptions, Splats, StatsMode, cpu_device, device::gpu_device, render};
use gazesplat_testkit::Rng;
use gazesplat_testkit::devices::required_gpu;
use gazesplat_train::evaluate::rgb;
use gazesplat_train::prune::{
    CriterionKind, GuardViews, Job, Part, Progress, Provenance, PruneConfig, Pruner, Status, one_shot, split,
};
use glam::Mat4;
use std::sync::Arc;

fn devices() -> Vec<burn::tensor::Device> {
    let mut devices = vec![cpu_device()];
    devices.extend(required_gpu(gpu_device(None)));
    devices
}

/// An identity camera of 64 × 64 pixels.
fn camera() -> Camera {
    let intrinsics = Pinhole { width: 64, height: 64, fx: 100.0, fy: 100.0, cx: 32.0, cy: 32.0 };
    Camera { intrinsics, camera_from_world: Mat4::IDENTITY }
}

/// Discs that face the camera (centre in pixels, σ in pixels, opacity), front to back.
fn discs(discs: &[([f32; 2], f32, f32)]) -> GaussianCloud {
    let mut cloud = GaussianCloud::default();
    for (i, &([x, y], sigma, opacity)) in discs.iter().enumerate() {
        let depth = 2.0 + i as f32;
        // The renderer dilates the image of a Gaussian by 0.3 px².
        let log_scale = ((sigma * sigma - 0.3).sqrt() * depth / 100.0).ln();
        cloud.means.push([(x - 32.0) * depth / 100.0, (y - 32.0) * depth / 100.0, depth]);
        cloud.quats.push([1.0, 0.0, 0.0, 0.0]);
        cloud.log_scales.push([log_scale, log_scale, -20.0]);
        cloud.opacity_logits.push((opacity / (1.0 - opacity)).ln());
        cloud.sh.push([0.1; 3]);
    }
    cloud
}

/// The row that goes first.
fn first_to_go(kind: CriterionKind, cloud: &GaussianCloud, device: &burn::tensor::Device) -> usize {
    let splats = Splats::from_cloud(cloud, device).expect("it fits");
    let keep = (cloud.len() - 1) as f64 / cloud.len() as f64;
    let rows = one_shot(kind, &splats, &[camera()], &RenderOptions::default(), &[keep]).expect("it draws");
    (0..cloud.len()).find(|i| !rows[0].contains(&(*i as u32))).expect("one is gone")
}

/// spec/pruning.md, Sec. 10, test 2.
#[test]
fn what_hides_or_veils_nothing_goes_first() {
    let pair = |front: f32| discs(&[([32.0, 32.0], 6.0, front), ([32.0, 32.0], 6.0, 0.9)]);
    for device in devices() {
        assert_eq!(first_to_go(CriterionKind::Ce, &pair(0.99), &device), 1, "hidden, although its opacity is 0.9");
        assert_eq!(first_to_go(CriterionKind::Ce, &pair(0.3), &device), 0, "a veil");
        assert_eq!(first_to_go(CriterionKind::Opacity, &pair(0.99), &device), 1);
        assert_eq!(first_to_go(CriterionKind::MaxContribution, &pair(0.99), &device), 1);
    }
}

/// spec/pruning.md, Sec. 10, test 3.
#[test]
fn big_and_faint_goes_before_small_and_strong() {
    let mut all = vec![([32.0, 32.0], 1000.0, 0.02)];
    all.extend((0..16).map(|k| ([8.0 + 16.0 * (k % 4) as f32, 8.0 + 16.0 * (k / 4) as f32], 2.4, 0.9)));
    let cloud = discs(&all);
    for device in devices() {
        assert_eq!(first_to_go(CriterionKind::Ce, &cloud, &device), 0);
        assert_ne!(first_to_go(CriterionKind::Surface, &cloud, &device), 0);
    }
}

/// spec/pruning.md, Sec. 10, test 10: with distinct depths the set removed does not depend on the order of the rows.
#[test]
fn permuting_rows_removes_the_same_gaussians() {
    let mut rng = Rng::new(11);
    let mut unit = || rng.unit() as f32;
    let all: Vec<_> =
        (0..120).map(|_| ([64.0 * unit(), 64.0 * unit()], 0.6 + 6.0 * unit(), 0.02 + 0.9 * unit())).collect();
    let cloud = discs(&all);
    let order: Vec<usize> = (0..120).map(|i| (i * 77 + 5) % 120).collect();
    let permuted = cloud.select(&order);
    let pairs = devices().into_iter().flat_map(|device| CriterionKind::ALL.map(|kind| (device.clone(), kind)));
    for (device, kind) in pairs {
        let kept = |cloud: &GaussianCloud| {
            let splats = Splats::from_cloud(cloud, &device).expect("it fits");
            let rows = one_shot(kind, &splats, &[camera()], &RenderOptions::default(), &[0.6]).expect("it draws");
            let mut depths: Vec<u32> = rows[0].iter().map(|&i| cloud.means[i as usize][2].to_bits()).collect();
            depths.sort_unstable();
            depths
        };
        assert_eq!(kept(&cloud), kept(&permuted), "{kind}");
    }
}

/// A scene of 16 small views whose photographs are renders of 300 of the 500 Gaussians of a model, lightly dithered so that
/// no model reproduces them to rounding errors: the other 200 are hidden inside opaque ones or too faint to matter.
fn scene_with_idle_gaussians() -> (tempfile::TempDir, Dataset, GaussianCloud) {
    let dir = tempfile::tempdir().expect("temporary directory");
    let options = SynthOptions {
        num_views: 16,
        width: 96,
        height: 64,
        samples_per_side: 1,
        num_points: 300,
        ..SynthOptions::default()
    };
    let dataset = write_scene(dir.path(), &options).expect("writable");
    let positions = &dataset.points.positions;
    let mut cloud = GaussianCloud { sh_degree: 0, ..GaussianCloud::default() };
    let mut push = |mean: [f32; 3], log_scale: f32, opacity: f32, color: [u8; 3]| {
        cloud.means.push(mean);
        cloud.quats.push([1.0, 0.0, 0.0, 0.0]);
        cloud.log_scales.push([log_scale; 3]);
        cloud.opacity_logits.push((opacity / (1.0 - opacity)).ln());
        cloud.sh.push(color.map(|c| (f32::from(c) / 255.0 - 0.5) / sh::SH_C0));
    };
    for (mean, color) in positions.iter().zip(&dataset.points.colors) {
        push(*mean, -1.6, 0.95, *color);
    }
    for (i, mean) in positions.iter().take(200).enumerate() {
        // Faint and large, or small in the middle of an opaque one.
        let (log_scale, opacity) = if i % 2 == 0 { (-0.9, 0.012) } else { (-3.5, 0.5) };
        push(*mean, log_scale, opacity, dataset.points.colors[i]);
    }
    let visible = cloud.select(&(0..positions.len()).collect::<Vec<_>>());
    let splats = Splats::from_cloud(&visible, &cpu_device()).expect("it fits");
    let mut rng = Rng::new(3);
    for view in dataset.train.iter().chain(&dataset.test) {
        let image =
            rgb(render(&splats, &view.camera, &RenderOptions::default()).expect("it draws")).expect("a CPU answers");
        let RgbImage8 { width, height, mut data } = image.to_rgb8();
        for value in &mut data {
            *value = value.saturating_add_signed((rng.unit() * 17.0) as i8 - 8);
        }
        let path = view.image_path.as_ref().expect("views of a scene have photographs");
        save_png(path, &RgbImage8 { width, height, data }).expect("writable");
    }
    (dir, dataset, cloud)
}

/// Mean list length over the views of `cloud`.
fn pairs_per_tile(cloud: &GaussianCloud, dataset: &Dataset) -> f64 {
    let splats = Splats::from_cloud(cloud, &cpu_device()).expect("it fits");
    let options = RenderOptions { stats: StatsMode::Tiles, ..RenderOptions::default() };
    let (mut pairs, mut tiles) = (0, 0);
    for view in &dataset.train {
        let stats = gazesplat_render::count(&splats, &view.camera, &options).expect("it draws").stats;
        pairs += stats.num_pairs;
        tiles += stats.num_tiles;
    }
    pairs as f64 / tiles as f64
}

/// spec/pruning.md, Sec. 10, test 13.
#[test]
fn idle_gaussians_go_and_the_guard_holds() {
    let (_dir, dataset, cloud) = scene_with_idle_gaussians();
    let parts = split(&dataset, GuardViews::Holdout, Provenance::Trained(Holdout::Every8)).expect("views");
    let run = |change: fn(&mut PruneConfig)| {
        let mut config = PruneConfig::default();
        config.prune.budget = 0.01;
        config.guard.loss = 0.03;
        change(&mut config);
        let images = |views: &[gazesplat_core::View]| Arc::new(ImageCache::new(views.to_vec(), 1 << 30));
        let job = Job {
            cloud: &cloud,
            dataset: &dataset,
            images: images(&parts.gradient),
            guard_images: images(&parts.guard),
            counted: parts.counted.iter().map(|v| (v.name.clone(), v.camera)).collect(),
            config: &config,
            more_settings: &serde_json::Value::Null,
            device: &cpu_device(),
        };
        let mut pruner = Pruner::new(&job).expect("valid");
        let mut reference = None;
        loop {
            match pruner.advance().expect("it runs") {
                Progress::Step(_) => {}
                Progress::Check(check) if check.phase == Part::Reference => reference = Some(check.measured),
                Progress::Check(_) => {}
                Progress::Finished(outcome) => {
                    let reference = reference.expect("it was measured");
                    return (outcome, reference, pruner.result().expect("a CPU answers"));
                }
            }
        }
    };
    let dense_pairs = pairs_per_tile(&cloud, &dataset);

    let (outcome, reference, pruned) = run(|_| {});
    assert_eq!(outcome.status, Status::Ok);
    assert!(reference.psnr < 45.0, "the bounds are shares: {} dB", reference.psnr);
    let m = outcome.measured;
    assert!(m.psnr >= 0.97 * reference.psnr && m.ssim >= 0.97 * reference.ssim, "{m:?} of {reference:?}");
    assert_eq!(m.points, pruned.len());
    assert!(pruned.len() as f64 <= 0.7 * cloud.len() as f64, "{} of {} are left", pruned.len(), cloud.len());
    let pairs = pairs_per_tile(&pruned, &dataset);
    assert!(pairs < dense_pairs, "{pairs} pairs per tile, {dense_pairs} before");

    // Scale decay alone shrinks lists as well.
    let (_, _, shrunk) = run(|config| {
        config.prune.rounds = 0;
        config.prune.min_opacity = 0.0;
        config.scale_decay.constant = Some(1e-2);
    });
    assert_eq!(shrunk.len(), cloud.len(), "nothing was removed");
    let pairs = pairs_per_tile(&shrunk, &dataset);
    assert!(pairs < dense_pairs, "{pairs} pairs per tile, {dense_pairs} before");
}
