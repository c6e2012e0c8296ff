//! The synthetic scene: pictures, points, and the scene as files.

use gazesplat_core::dataset::{LoadOptions, SceneFormat};
use gazesplat_core::io::images::decode_rgb;
use gazesplat_core::synthetic::{SynthOptions, SyntheticScene, write_scene};
use gazesplat_core::{Dataset, Pinhole};
use glam::Vec3;
use std::sync::LazyLock;

/// Baking takes a second: one room for all tests.
static ROOM: LazyLock<SyntheticScene> = LazyLock::new(|| SyntheticScene::room(0));

fn small() -> Pinhole {
    Pinhole::from_fov_x(96, 64, 75f32.to_radians())
}

#[test]
fn pictures_are_neither_dark_nor_burnt_and_have_detail() {
    for camera in ROOM.camera_ring(8, small()) {
        let image = ROOM.render(&camera, 2);
        let n = image.data.len() as f32;
        let mean = image.data.iter().sum::<f32>() / n;
        let deviation = (image.data.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / n).sqrt();
        let burnt = image.data.iter().filter(|v| **v > 0.99).count() as f32 / n;
        assert!(image.data.iter().all(|v| (0.0..=1.0).contains(v)));
        assert!((0.25..0.65).contains(&mean), "mean {mean}");
        assert!(deviation > 0.1, "standard deviation {deviation}");
        assert!(burnt < 0.05, "{burnt} of the values are white");
    }
}

#[test]
fn pictures_do_not_depend_on_the_number_of_threads() {
    let camera = ROOM.camera_ring(3, small())[1];
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let alone = pool.install(|| SyntheticScene::room(0).render(&camera, 2));
    assert_eq!(alone, ROOM.render(&camera, 2));
}

#[test]
fn seeds_make_different_rooms() {
    let camera = ROOM.camera_ring(3, small())[0];
    assert_ne!(SyntheticScene::room(1).render(&camera, 1), ROOM.render(&camera, 1));
}

#[test]
fn points_lie_where_views_show_their_colour() {
    let points = ROOM.sparse_points(300, 7);
    assert_eq!(points, ROOM.sparse_points(300, 7));
    let cameras = ROOM.camera_ring(24, Pinhole::from_fov_x(480, 320, 75f32.to_radians()));
    let close = |a: f32, b: u8| (a - f32::from(b) / 255.0).abs() < 0.06;
    let mut num_right = 0;
    for (i, (position, color)) in points.positions.iter().zip(&points.colors).enumerate() {
        let position = Vec3::from(*position);
        assert!(position.abs().cmple(Vec3::new(3.02, 2.52, 2.82)).all(), "{position}");
        // The camera that found the point shows a picture of one pixel around it.
        let mut camera = cameras[i % 24];
        let p = camera.camera_from_world.transform_point3(position);
        assert!(p.z > 0.0);
        let f = 20_000.0;
        camera.intrinsics =
            Pinhole { width: 1, height: 1, fx: f, fy: f, cx: 0.5 - f * p.x / p.z, cy: 0.5 - f * p.y / p.z };
        let pixel = ROOM.render(&camera, 1);
        num_right += usize::from(pixel.data.iter().zip(color).all(|(a, b)| close(*a, *b)));
    }
    // The noise moves points off edges of patterns and objects.
    assert!(num_right > 240, "{num_right} of 300");
}

#[test]
fn written_scenes_load_with_the_same_cameras_in_both_layouts() {
    let options =
        SynthOptions { num_views: 9, width: 60, height: 40, samples_per_side: 1, num_points: 50, ..Default::default() };
    let dir = tempfile::tempdir().unwrap();
    let colmap = write_scene(dir.path(), &options).unwrap();
    assert_eq!(colmap.source, SceneFormat::ColmapText);
    let transforms = Dataset::load(dir.path().join("transforms.json"), &LoadOptions::default()).unwrap();
    assert_eq!(transforms.source, SceneFormat::Transforms);
    let cameras = ROOM.camera_ring(9, Pinhole::from_fov_x(60, 40, options.fov_x_deg.to_radians()));
    let expected_points = ROOM.sparse_points(50, 0);
    for dataset in [&colmap, &transforms] {
        assert!(dataset.warnings.is_empty(), "{:?}", dataset.warnings);
        assert_eq!((dataset.all_views().len(), dataset.test.len()), (9, 2));
        assert_eq!(dataset.points, expected_points);
        for (i, (view, camera)) in dataset.all_views().iter().zip(&cameras).enumerate() {
            let (found, expected) = (view.camera, *camera);
            assert!(found.camera_from_world.abs_diff_eq(expected.camera_from_world, 1e-5), "{i}");
            assert_eq!(found.intrinsics, expected.intrinsics);
            if i == 4 {
                let image = decode_rgb(view.image_path.as_ref().expect("the scene has images")).unwrap();
                assert_eq!(image, ROOM.render(camera, 1).to_rgb8());
            }
        }
    }
}

#[test]
fn options_out_of_range_are_refused_before_anything_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let scene = dir.path().join("scene");
    for options in [
        SynthOptions { num_views: 0, ..Default::default() },
        SynthOptions { width: 0, ..Default::default() },
        SynthOptions { fov_x_deg: f32::NAN, ..Default::default() },
    ] {
        assert!(write_scene(&scene, &options).is_err());
    }
    assert!(!scene.exists());
}
