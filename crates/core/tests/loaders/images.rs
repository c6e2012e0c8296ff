//! Decoding, masks, alpha, the cache.

use crate::scenes::{Scene, assert_says, binary_scene, small_model};
use gazesplat_core::camera::{Camera, Pinhole};
use gazesplat_core::dataset::LoadOptions;
use gazesplat_core::io::images::{ImageCache, decode_rgb, image_size, load_view_image};
use gazesplat_core::{Dataset, Error, View};
use glam::Mat4;
use image::{DynamicImage, GrayImage, ImageBuffer, ImageFormat, Luma, LumaA, Rgb, Rgba, RgbaImage};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

fn view(path: PathBuf, width: u32, height: u32) -> View {
    View {
        name: path.file_name().unwrap().to_string_lossy().into_owned(),
        camera: Camera { intrinsics: Pinhole::from_fov_x(width, height, 1.0), camera_from_world: Mat4::IDENTITY },
        image_path: Some(path),
        distortion: None,
        mask_path: None,
    }
}

fn save(scene: &Scene, name: &str, image: impl Into<DynamicImage>, format: ImageFormat) -> PathBuf {
    let path = scene.write(name, "");
    image.into().save_with_format(&path, format).unwrap();
    path
}

#[test]
fn all_usual_pixel_types_decode_to_rgb() {
    let scene = Scene::new();
    let gray = save(&scene, "gray.png", GrayImage::from_pixel(3, 2, Luma([77])), ImageFormat::Png);
    assert_eq!(decode_rgb(&gray).unwrap().pixel(2, 1), [77, 77, 77]);
    let deep = ImageBuffer::from_pixel(3, 2, Rgb([65535_u16, 32896, 0]));
    let deep = save(&scene, "deep.png", DynamicImage::ImageRgb16(deep), ImageFormat::Png);
    assert_eq!(decode_rgb(&deep).unwrap().pixel(0, 0), [255, 128, 0]);
    let gray_alpha = ImageBuffer::from_pixel(3, 2, LumaA([9_u8, 100]));
    let gray_alpha = save(&scene, "gray_alpha.png", DynamicImage::ImageLumaA8(gray_alpha), ImageFormat::Png);
    let loaded = load_view_image(&view(gray_alpha, 3, 2)).unwrap();
    assert_eq!((loaded.image.pixel(1, 1), loaded.alpha.unwrap()), ([9, 9, 9], vec![100; 6]));
    // A JPEG under a name that says PNG.
    let odd = image::RgbImage::from_pixel(16, 16, Rgb([50, 100, 150]));
    let odd = save(&scene, "odd.png", DynamicImage::ImageRgb8(odd), ImageFormat::Jpeg);
    assert_eq!(image_size(&odd).unwrap(), [16, 16]);
    let [r, g, b] = decode_rgb(&odd).unwrap().pixel(8, 8);
    assert!(r.abs_diff(50) < 4 && g.abs_diff(100) < 4 && b.abs_diff(150) < 4);
}

#[test]
fn opaque_alpha_is_dropped_and_real_alpha_composites() {
    let scene = Scene::new();
    let opaque = save(&scene, "o.png", RgbaImage::from_pixel(2, 2, Rgba([1, 2, 3, 255])), ImageFormat::Png);
    assert_eq!(load_view_image(&view(opaque, 2, 2)).unwrap().alpha, None);
    let clear = save(&scene, "c.png", RgbaImage::from_pixel(2, 2, Rgba([200, 100, 0, 51])), ImageFormat::Png);
    let loaded = load_view_image(&view(clear, 2, 2)).unwrap();
    assert_eq!(loaded.image.pixel(0, 0), [200, 100, 0]);
    // 0.2 · c + 0.8 · b.
    assert_eq!(loaded.composited([1.0, 0.5, 0.0]).pixel(0, 0), [244, 122, 0]);
    assert_eq!(loaded.num_bytes(), 4 * 4);
}

#[test]
fn images_that_do_not_decode_are_named() {
    let scene = Scene::new();
    let whole = scene.write_image("whole.png", [40, 30]);
    let bytes = std::fs::read(&whole).unwrap();
    for (name, content) in [
        ("empty.png", &b""[..]),
        ("text.jpg", b"hello"),
        ("cut.png", &bytes[..bytes.len() / 2]),
        ("head.png", &bytes[..20]),
    ] {
        let path = scene.write(name, content);
        assert_says(&decode_rgb(&path).unwrap_err(), name, &["does not decode"]);
    }
    let huge = {
        let mut bytes = bytes.clone();
        bytes[16..24].copy_from_slice(&[0x7f, 0xff, 0xff, 0xff, 0x7f, 0xff, 0xff, 0xff]);
        scene.write("huge.png", bytes)
    };
    assert_says(&decode_rgb(&huge).unwrap_err(), "huge.png", &[]);
    let gif = scene.write("x.gif", b"GIF89a\x01\0\x01\0\0\0\0;");
    let error = decode_rgb(&gif).unwrap_err();
    assert!(matches!(error, Error::Unsupported { .. }), "{error:?}");
    assert_says(&error, "x.gif", &["JPEG and PNG"]);
    assert!(matches!(
        decode_rgb(scene.path()),
        Err(Error::Io { .. } | Error::Format { .. } | Error::Unsupported { .. })
    ));
    assert_says(&decode_rgb(scene.at("none.png")).unwrap_err(), "none.png", &["cannot read"]);
}

#[test]
fn every_prefix_of_a_jpeg_is_an_error() {
    let scene = Scene::new();
    let photo = image::RgbImage::from_fn(48, 40, |x, y| Rgb([(x * 5) as u8, (y * 6) as u8, (x * y) as u8]));
    let path = save(&scene, "a.jpg", DynamicImage::ImageRgb8(photo), ImageFormat::Jpeg);
    let bytes = std::fs::read(&path).unwrap();
    let survived: Vec<usize> = (0..bytes.len())
        .filter(|&end| {
            scene.write("a.jpg", &bytes[..end]);
            decode_rgb(&path).is_ok()
        })
        .collect();
    assert!(survived.is_empty(), "{} of {} prefixes decode, from {:?}", survived.len(), bytes.len(), survived.first());
}

#[test]
fn masks_are_found_and_reduced_with_the_photograph() {
    let model = small_model(2);
    let scene = binary_scene(&model);
    // COLMAP's name for the first view, the stem for the second; the second has half the size of its photograph.
    let mut mask = GrayImage::from_pixel(24, 16, Luma([255]));
    mask.put_pixel(3, 2, Luma([0]));
    save(&scene, "masks/photo 00.JPG.png", mask, ImageFormat::Png);
    save(
        &scene,
        "masks/photo 01.png",
        GrayImage::from_fn(16, 10, |x, _| Luma([if x < 8 { 0 } else { 9 }])),
        ImageFormat::Png,
    );
    let data = Dataset::load(scene.path(), &LoadOptions { max_side: 12, ..LoadOptions::default() }).unwrap();
    let views = data.all_views();
    let first = load_view_image(views[0]).unwrap();
    let masked: Vec<usize> = (0..12 * 8).filter(|&i| first.mask.as_ref().unwrap()[i] == 0).collect();
    assert_eq!(masked, [12 + 1]);
    let second = load_view_image(views[1]).unwrap();
    let (width, height) = (second.image.width as usize, second.image.height as usize);
    let row = &second.mask.as_ref().unwrap()[height / 2 * width..(height / 2 + 1) * width];
    assert!(row[..width / 2 - 1].iter().all(|&m| m == 0) && row[width / 2 + 1..width - 1].iter().all(|&m| m == 255));
    // A mask that masks nothing, and one that does not fit.
    save(&scene, "masks/photo 00.JPG.png", GrayImage::from_pixel(24, 16, Luma([1])), ImageFormat::Png);
    assert_eq!(load_view_image(views[0]).unwrap().mask, None);
    save(&scene, "masks/photo 00.JPG.png", GrayImage::from_pixel(16, 24, Luma([1])), ImageFormat::Png);
    assert_says(&load_view_image(views[0]).unwrap_err(), "photo 00.JPG.png", &["16 × 24", "24 × 16"]);
}

#[test]
fn photographs_that_changed_size_or_are_absent_are_errors() {
    let scene = Scene::new();
    let path = scene.write_image("a.png", [20, 10]);
    assert_says(&load_view_image(&view(path.clone(), 10, 20)).unwrap_err(), "a.png", &["20 × 10", "10 × 20"]);
    assert_eq!(load_view_image(&view(path.clone(), 10, 5)).unwrap().image.width, 10);
    let bare = View { image_path: None, ..view(path, 2, 2) };
    assert!(matches!(load_view_image(&bare), Err(Error::Parameter { .. })));
}

/// Views of 10 × 10 pixels, 300 bytes each.
fn cache(scene: &Scene, count: usize, budget: usize) -> ImageCache {
    let views = (0..count).map(|i| view(scene.write_image(&format!("{i}.png"), [10, 10]), 10, 10)).collect();
    ImageCache::new(views, budget)
}

#[test]
fn cache_keeps_its_budget_and_drops_the_least_recently_used() {
    let scene = Scene::new();
    let cache = cache(&scene, 3, 700);
    let first = cache.get(0).unwrap();
    cache.get(1).unwrap();
    assert!(Arc::ptr_eq(&first, &cache.get(0).unwrap()));
    cache.get(2).unwrap();
    assert_eq!(cache.num_bytes(), 600);
    // 0 was used after 1, so that 1 went; a held image is served after its file is gone, another is not.
    for i in 0..3 {
        std::fs::remove_file(scene.at(&format!("{i}.png"))).unwrap();
    }
    assert!(cache.get(0).is_ok() && cache.get(2).is_ok());
    assert!(matches!(cache.get(1), Err(Error::Io { .. })));
    assert!(matches!(cache.get(3), Err(Error::Parameter { .. })));
}

#[test]
fn caches_beside_each_other_share_one_budget() {
    let scene = Scene::new();
    let cache = cache(&scene, 3, 700);
    let other = cache.beside((0..2).map(|i| view(scene.write_image(&format!("b{i}.png"), [10, 10]), 10, 10)).collect());
    cache.get(0).unwrap();
    cache.get(1).unwrap();
    let held = other.get(0).unwrap();
    // 0 of the first one had to go.
    assert_eq!((cache.num_bytes(), other.num_bytes()), (300, 300));
    assert!(Arc::ptr_eq(&held, &other.get(0).unwrap()));
    let stats = cache.stats();
    assert_eq!(stats, other.stats());
    assert_eq!((stats.byte_budget, stats.num_bytes, stats.peak_bytes), (700, 600, 600));
    assert_eq!((stats.num_hits, stats.num_misses), (1, 3));
    // Full: nothing more is decoded ahead, and nothing that is held goes.
    assert_eq!((cache.preload(|_, _| ()).unwrap(), cache.stats().num_misses), (1, 3));
    drop(other);
    assert_eq!(cache.stats().num_bytes, 300, "what it held is free again");
    assert_eq!((cache.preload(|_, _| ()).unwrap(), cache.num_bytes()), (2, 600));
}

#[test]
fn alpha_and_masks_count() {
    let scene = Scene::new();
    let path = save(&scene, "a.png", RgbaImage::from_pixel(10, 10, Rgba([1, 2, 3, 9])), ImageFormat::Png);
    let mask = save(&scene, "m.png", GrayImage::from_fn(10, 10, |x, _| Luma([x as u8])), ImageFormat::Png);
    let masked = View { mask_path: Some(mask), ..view(path, 10, 10) };
    let cache = ImageCache::new(vec![masked.clone()], 500);
    cache.get(0).unwrap();
    assert_eq!((cache.num_bytes(), cache.stats().peak_bytes), (500, 500));
    let small = ImageCache::new(vec![masked], 499);
    small.get(0).unwrap();
    assert_eq!(small.num_bytes(), 0);
}

#[test]
fn images_larger_than_the_budget_are_served_but_not_kept() {
    let scene = Scene::new();
    let cache = cache(&scene, 2, 299);
    assert_eq!(cache.get(1).unwrap().image.width, 10);
    assert_eq!((cache.num_bytes(), cache.preload(|_, _| ()).unwrap()), (0, 0));
}

#[test]
fn preload_fills_the_budget_in_order_and_reports_each_image() {
    let scene = Scene::new();
    let cache = cache(&scene, 5, 1000);
    let calls = AtomicUsize::new(0);
    let held = cache.preload(|_, planned| {
        assert_eq!(planned, 3);
        calls.fetch_add(1, Ordering::Relaxed);
    });
    assert_eq!((held.unwrap(), calls.load(Ordering::Relaxed), cache.num_bytes()), (3, 3, 900));
    scene.write("0.png", "broken");
    assert!(cache.get(0).is_ok());
    let cache = ImageCache::new(cache.views().to_vec(), 1000);
    assert_says(&cache.preload(|_, _| ()).unwrap_err(), "0.png", &["decode"]);
}

#[test]
fn cache_serves_many_threads() {
    let scene = Scene::new();
    let cache = Arc::new(cache(&scene, 8, 1300));
    cache.prefetch(7);
    cache.prefetch(100);
    std::thread::scope(|scope| {
        for thread in 0..8 {
            let cache = &cache;
            scope.spawn(move || {
                for i in 0..200 {
                    assert_eq!(cache.get((i * 7 + thread * 3) % 8).unwrap().image.width, 10);
                    assert!(cache.num_bytes() <= 1300);
                }
            });
        }
    });
}

#[test]
fn pixels_do_not_depend_on_the_number_of_threads() {
    let model = small_model(2);
    let scene = binary_scene(&model);
    let photo =
        RgbaImage::from_fn(32, 20, |x, y| Rgba([(x * 7) as u8, (y * 11) as u8, (x * y) as u8, (255 - x) as u8]));
    save(&scene, "images/photo 01.JPG", photo, ImageFormat::Png);
    let data = Dataset::load(scene.path(), &LoadOptions { max_side: 21, ..LoadOptions::default() }).unwrap();
    let load = |num_threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(num_threads).build().unwrap();
        pool.install(|| load_view_image(data.all_views()[1]).unwrap())
    };
    let single = load(1);
    assert!(single.alpha.is_some());
    assert_eq!(single, load(5));
}

/// A JPEG of `width` × `height` whose left half is red and whose right half is blue, with an EXIF orientation.
fn tagged_jpeg(scene: &Scene, name: &str, [width, height]: [u32; 2], orientation: u8) -> PathBuf {
    let color = |x: u32| if x < width / 2 { [250, 0, 0] } else { [0, 0, 250] };
    let image = image::RgbImage::from_fn(width, height, |x, _| Rgb(color(x)));
    let path = save(scene, name, image, ImageFormat::Jpeg);
    let jpeg = std::fs::read(&path).unwrap();
    // APP1 with one directory of one entry: tag 0x0112, SHORT, count 1.
    let mut tiff = b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0".to_vec();
    tiff.extend([orientation, 0, 0, 0, 0, 0, 0]);
    let mut bytes = jpeg[..2].to_vec();
    bytes.extend([0xff, 0xe1]);
    bytes.extend((tiff.len() as u16 + 2).to_be_bytes());
    bytes.extend(tiff);
    bytes.extend(&jpeg[2..]);
    std::fs::write(&path, bytes).unwrap();
    path
}

#[test]
fn orientation_is_followed_where_the_calibration_says_so_and_only_there() {
    let at = |image: &gazesplat_core::RgbImage8, x: u32, y: u32| {
        let [r, _, b] = image.pixel(x, y);
        if r > 150 && b < 100 { 'r' } else { 'b' }
    };
    for (orientation, top_left_of_turned) in [(6, 'r'), (8, 'b')] {
        let mut model = small_model(1);
        // Reconstructed as stored, as COLMAP does: the tag is passed over.
        model
            .cameras
            .insert(1, gazesplat_core::camera::distortion::LensDistortion::pinhole([48, 32], [40.0; 2], [24.0, 16.0]));
        let scene = binary_scene(&model);
        tagged_jpeg(&scene, "images/photo 00.JPG", [48, 32], orientation);
        let data = Dataset::load(scene.path(), &LoadOptions::default()).unwrap();
        let stored = load_view_image(data.all_views()[0]).unwrap().image;
        assert_eq!((stored.width, stored.height, at(&stored, 2, 2), at(&stored, 45, 2)), (48, 32, 'r', 'b'));
        // Reconstructed as shown: 90° clockwise (6) puts the left half on top, counterclockwise (8) below.
        let upright = gazesplat_core::camera::distortion::LensDistortion::pinhole([32, 48], [40.0; 2], [16.0, 24.0]);
        model.cameras.insert(1, upright);
        let scene = binary_scene(&model);
        for (size, name) in [([48, 32], "images"), ([24, 16], "images_2")] {
            tagged_jpeg(&scene, &format!("{name}/photo 00.JPG"), size, orientation);
            let options = LoadOptions { images: Some(name.into()), ..LoadOptions::default() };
            let data = Dataset::load(scene.path(), &options).unwrap();
            let pinhole = data.all_views()[0].camera.intrinsics;
            let turned = load_view_image(data.all_views()[0]).unwrap().image;
            assert_eq!([pinhole.width, pinhole.height], [size[1], size[0]]);
            assert_eq!([turned.width, turned.height], [size[1], size[0]]);
            assert_eq!(at(&turned, 1, 1), top_left_of_turned, "{orientation} {name}");
            assert_ne!(at(&turned, 1, size[0] - 2), top_left_of_turned);
        }
        // Without a tag there is nothing to follow.
        tagged_jpeg(&scene, "images/photo 00.JPG", [48, 32], 1);
        let error = Dataset::load(scene.path(), &LoadOptions::default()).unwrap_err();
        assert_says(&error, "photo 00.JPG", &["48 × 32 pixels, its camera 32 × 48"]);
    }
}
