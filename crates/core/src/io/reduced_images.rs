//! Photographs at a part of their size, for the beginning of a training from coarse to fine.

use super::images::{ImageCache, TrainingImage};
use crate::camera::Camera;
use crate::error::Result;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The photographs of an [`ImageCache`], each side divided by 2ⁿ, made on first use and kept as long as there is room.
///
/// They take their room from the budget of the cache they are made of, which drops photographs of full size for them: both
/// together stay within it. Once there is no more room, those that are not held are made again for every use. A reduced
/// photograph is a function of the full one: it does not depend on what was held when it was made.
#[derive(Debug)]
pub struct ReducedImages {
    source: Arc<ImageCache>,
    cameras: Vec<Camera>,
    slots: Mutex<Vec<Option<Arc<TrainingImage>>>>,
}

impl ReducedImages {
    /// The photographs of `source` with each side divided by 2^`num_halvings` and rounded, at least one pixel.
    pub fn new(source: Arc<ImageCache>, num_halvings: u32) -> Self {
        let cameras: Vec<Camera> = source.views().iter().map(|view| reduced(&view.camera, num_halvings)).collect();
        let slots = Mutex::new(vec![None; cameras.len()]);
        Self { source, cameras, slots }
    }

    /// The camera of view `index` at the size of its reduced photograph; `None` when there is no such view.
    pub fn camera(&self, index: usize) -> Option<&Camera> {
        self.cameras.get(index)
    }

    /// The reduced photograph of view `index`.
    ///
    /// # Errors
    /// As [`ImageCache::get`].
    pub fn get(&self, index: usize) -> Result<Arc<TrainingImage>> {
        if let Some(image) = self.lock().get(index).and_then(Clone::clone) {
            return Ok(image);
        }
        let full = self.source.get_unkept(index)?;
        let pinhole = self.cameras[index].intrinsics;
        // A copy of the photograph is short-lived, and decoding it cost more.
        let image = Arc::new(TrainingImage::clone(&full).resized(pinhole.width, pinhole.height));
        drop(full);
        let mut slots = self.lock();
        if let Some(held) = &slots[index] {
            return Ok(Arc::clone(held));
        }
        if self.source.reserve(image.num_bytes()) {
            slots[index] = Some(Arc::clone(&image));
        }
        Ok(image)
    }

    /// Makes the reduced photograph of view `index` in the background, on the thread pool of the caller, if it is not held.
    /// An error shows when it is asked for with [`get`](Self::get).
    pub fn prefetch(self: &Arc<Self>, index: usize) {
        if self.lock().get(index).is_some_and(Option::is_none) {
            let images = Arc::clone(self);
            rayon::spawn(move || drop(images.get(index)));
        }
    }

    /// Bytes of reduced photographs held.
    pub fn num_bytes(&self) -> usize {
        self.lock().iter().flatten().map(|image| image.num_bytes()).sum()
    }

    fn lock(&self) -> MutexGuard<'_, Vec<Option<Arc<TrainingImage>>>> {
        // Nothing that can panic runs under the lock, so that poisoned slots are still consistent.
        self.slots.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for ReducedImages {
    fn drop(&mut self) {
        self.source.release(self.num_bytes());
    }
}

/// `camera` for a photograph of sides divided by 2^`num_halvings`: every pixel position scales with its axis, and so do
/// focal lengths and principal point, since pixel (0, 0) has its centre at (0.5, 0.5).
pub fn reduced(camera: &Camera, num_halvings: u32) -> Camera {
    let pinhole = camera.intrinsics;
    let half = |side: u32| {
        let divided = f64::from(side) / 2f64.powi(num_halvings.min(31).cast_signed());
        (divided.round() as u32).max(1)
    };
    Camera { intrinsics: pinhole.resized(half(pinhole.width), half(pinhole.height)), ..*camera }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Pinhole;
    use crate::image::RgbImage8;
    use crate::io::save_png;
    use crate::view::View;
    use glam::Mat4;

    /// Photographs of random colours, 37 × 22 pixels, in a directory that lives as long as the first result.
    fn photographs(num: usize) -> (tempfile::TempDir, Vec<View>) {
        let dir = tempfile::tempdir().expect("temporary directory");
        let mut word = 9_u64;
        let views = (0..num)
            .map(|i| {
                let data = (0..3 * 37 * 22)
                    .map(|_| {
                        word = word.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                        (word >> 56) as u8
                    })
                    .collect();
                let path = dir.path().join(format!("{i}.png"));
                save_png(&path, &RgbImage8 { width: 37, height: 22, data }).expect("writable");
                let intrinsics = Pinhole { width: 37, height: 22, fx: 40.0, fy: 41.0, cx: 18.0, cy: 11.5 };
                View {
                    name: format!("{i}.png"),
                    camera: Camera { intrinsics, camera_from_world: Mat4::IDENTITY },
                    image_path: Some(path),
                    distortion: None,
                    mask_path: None,
                }
            })
            .collect();
        (dir, views)
    }

    const FULL: usize = 3 * 37 * 22;

    #[test]
    fn a_point_lands_on_the_same_share_of_the_image_at_every_size() {
        let intrinsics = Pinhole { width: 1062, height: 1894, fx: 1375.7, fy: 1380.1, cx: 540.2, cy: 931.8 };
        let camera = Camera { intrinsics, camera_from_world: Mat4::IDENTITY };
        for n in 0..6 {
            let small = reduced(&camera, n).intrinsics;
            assert_eq!(small.width, (1062.0 / f64::from(1 << n)).round() as u32);
            assert_eq!(small.height, (1894.0 / f64::from(1 << n)).round() as u32);
            for (x, y) in [(0.0f32, 0.0f32), (0.3, -0.6), (-0.35, 0.65)] {
                let full = (intrinsics.fx * x + intrinsics.cx, intrinsics.fy * y + intrinsics.cy);
                let found = (small.fx * x + small.cx, small.fy * y + small.cy);
                let (sx, sy) = (small.width as f32 / 1062.0, small.height as f32 / 1894.0);
                // Products and sums of some hundreds of pixels, each rounded to 2⁻²⁴ of itself.
                assert!((found.0 - full.0 * sx).abs() < 3e-4 && (found.1 - full.1 * sy).abs() < 3e-4, "{n}");
            }
        }
        assert_eq!(reduced(&camera, 0), camera);
        assert_eq!(reduced(&camera, 31).intrinsics.width, 1);
    }

    #[test]
    fn halves_are_means_of_the_pixels_they_cover() {
        let (_dir, mut views) = photographs(1);
        // An even size, so that a pixel covers exactly four.
        let data: Vec<u8> = (0..3 * 36 * 22).map(|i| (i * 7 % 251) as u8).collect();
        let full = RgbImage8 { width: 36, height: 22, data };
        save_png(views[0].image_path.as_ref().expect("it has one"), &full).expect("writable");
        views[0].camera.intrinsics = Pinhole { width: 36, ..views[0].camera.intrinsics };
        let images = ReducedImages::new(Arc::new(ImageCache::new(views, 1 << 20)), 1);
        let half = images.get(0).expect("readable");
        assert_eq!((half.image.width, half.image.height), (18, 11));
        for y in 0..11 {
            for x in 0..18 {
                for c in 0..3 {
                    let at = |dx: usize, dy: usize| f32::from(full.data[3 * ((2 * y + dy) * 36 + 2 * x + dx) + c]);
                    let mean = 0.25 * (at(0, 0) + at(1, 0) + at(0, 1) + at(1, 1));
                    // A level is the nearest to the mean.
                    assert!((f32::from(half.image.data[3 * (y * 18 + x) + c]) - mean).abs() <= 0.5);
                }
            }
        }
        let camera = images.camera(0).expect("it is there").intrinsics;
        assert_eq!((camera.fx, camera.fy, camera.cx, camera.cy), (20.0, 20.5, 9.0, 5.75));
    }

    #[test]
    fn full_and_reduced_photographs_share_one_budget() {
        let (_dir, views) = photographs(6);
        let reduced_bytes = 3 * 19 * 11;
        let budget = 4 * FULL;
        let source = Arc::new(ImageCache::new(views.clone(), budget));
        assert_eq!(source.preload(|_, _| ()).expect("readable"), 4);
        let images = Arc::new(ReducedImages::new(Arc::clone(&source), 1));
        let first: Vec<_> = (0..6).map(|i| images.get(i).expect("readable")).collect();
        assert_eq!(images.num_bytes(), 6 * reduced_bytes);
        assert!(source.num_bytes() <= budget, "{} of {budget}", source.num_bytes());
        // They are held, and what they took is given back when they are gone.
        assert!((0..6).all(|i| Arc::ptr_eq(&first[i], &images.get(i).expect("readable"))));
        for i in 0..6 {
            source.get(i).expect("readable");
            assert!(source.num_bytes() <= budget);
        }
        drop(images);
        (0..6).for_each(|i| drop(source.get(i).expect("readable")));
        assert_eq!(source.num_bytes(), budget);
        // Without room they are made again, the same, whatever was held.
        for budget in [0, reduced_bytes, 2 * reduced_bytes + 1, FULL, 100 * FULL] {
            let source = Arc::new(ImageCache::new(views.clone(), budget));
            let images = ReducedImages::new(Arc::clone(&source), 1);
            for i in [0, 3, 0, 5, 1, 2, 4, 3] {
                assert_eq!(images.get(i).expect("readable"), first[i]);
                assert!(source.num_bytes() <= budget);
            }
        }
    }

    #[test]
    fn masks_and_sizes_follow_and_missing_views_are_named() {
        let (_dir, views) = photographs(2);
        let images = ReducedImages::new(Arc::new(ImageCache::new(views, 1 << 20)), 2);
        let image = images.get(1).expect("readable");
        assert_eq!((image.image.width, image.image.height), (9, 6));
        assert!(images.get(2).expect_err("there is none").to_string().contains("view index"));
        assert!(images.camera(2).is_none());
    }
}
