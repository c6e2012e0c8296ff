//! What a step looks at: which view, at which size, over which background. All are functions of the step.

use super::Trainer;
use crate::config::{Background, NamedBackground};
use crate::error::Result;
use crate::optim::schedule;
use crate::rng::{Stream, draw, permutation, uniform};
use gazesplat_core::io::images::TrainingImage;
use gazesplat_core::io::reduced_images::{ReducedImages, reduced};
use gazesplat_core::{Camera, View};
use std::sync::Arc;

impl Trainer {
    /// The view of step `step`, counted from 0.
    pub(super) fn view_at(&mut self, step: u32) -> usize {
        let num_views = self.images.len() as u32;
        let (epoch, position) = (step / num_views, (step % num_views) as usize);
        if self.view_order.as_ref().is_none_or(|(held, _)| *held != epoch) {
            let order = permutation(self.images.len(), self.config.train.seed, Stream::ViewOrder, epoch);
            if step != self.step {
                // A look ahead into the next epoch; the order of this one is still needed.
                return order[position];
            }
            self.view_order = Some((epoch, order));
        }
        self.view_order.as_ref().map_or(0, |(_, order)| order[position])
    }

    pub(super) fn background(&self) -> [f32; 3] {
        match self.config.data.background {
            Background::Named(NamedBackground::Random) => {
                let words = draw(self.config.train.seed, Stream::Background, self.step, 0);
                [uniform(words[0]), uniform(words[1]), uniform(words[2])]
            }
            fixed => fixed.fixed_rgb(),
        }
    }

    /// How often the sides of the images of step `step`, counted from 0, are halved.
    fn num_halvings_at(&self, step: u32) -> u32 {
        let section = &self.config.train;
        schedule::num_halvings(step, section.steps, section.num_downscales, section.resolution_schedule)
    }

    /// How often the sides of the images of the next step are halved, and their size there, \[width, height\] in pixels of the
    /// first view, if it is the first step at that size; a run whose first step has full size has no such step.
    pub fn resolution_change(&self) -> Option<(u32, [u32; 2])> {
        let now = self.num_halvings_at(self.step);
        let before = self.step.checked_sub(1).map_or(0, |step| self.num_halvings_at(step));
        let intrinsics = reduced(&self.images.views().first()?.camera, now).intrinsics;
        (now != before).then_some((now, [intrinsics.width, intrinsics.height]))
    }

    /// The training views at the smallest size of their images that the run uses.
    pub fn smallest_views(&self) -> Vec<View> {
        let small =
            |view: &View| View { camera: reduced(&view.camera, self.config.train.num_downscales), ..view.clone() };
        self.images.views().iter().map(small).collect()
    }

    /// The photograph of `view` for this step, and its camera; those of the next step are made in the background.
    pub(super) fn photo(&mut self, view: usize) -> Result<(Arc<TrainingImage>, Camera)> {
        let num_halvings = self.num_halvings_at(self.step);
        if self.coarse.as_ref().is_some_and(|(held, _)| *held != num_halvings) {
            self.coarse = None;
        }
        let (is_same_size, next) = (self.num_halvings_at(self.step + 1) == num_halvings, self.view_at(self.step + 1));
        if num_halvings == 0 {
            let photo = self.images.get(view)?;
            self.images.prefetch(next);
            return Ok((photo, self.images.views()[view].camera));
        }
        let images = &self.images;
        let make = || (num_halvings, Arc::new(ReducedImages::new(Arc::clone(images), num_halvings)));
        let (_, coarse) = self.coarse.get_or_insert_with(make);
        let photo = coarse.get(view)?;
        if is_same_size {
            coarse.prefetch(next);
        }
        Ok((photo, reduced(&self.images.views()[view].camera, num_halvings)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use gazesplat_core::io::images::ImageCache;
    use gazesplat_core::synthetic::{SynthOptions, write_scene};
    use gazesplat_render::cpu_device;

    #[test]
    fn a_run_sees_every_size_in_its_turn_and_ends_with_the_full_one() {
        let dir = tempfile::tempdir().expect("temporary directory");
        let options = SynthOptions {
            num_views: 4,
            width: 42,
            height: 30,
            samples_per_side: 1,
            num_points: 150,
            ..SynthOptions::default()
        };
        let dataset = write_scene(dir.path(), &options).expect("writable");
        let mut config = Config::default();
        (config.train.steps, config.train.num_downscales, config.model.sh_degree) = (50, 2, 0);
        let budget = 3 * 42 * 30 * 2;
        let images = Arc::new(ImageCache::new(dataset.train.clone(), budget));
        let mut trainer = Trainer::new(&dataset, Arc::clone(&images), &config, &cpu_device()).expect("valid");
        assert_eq!(trainer.smallest_views()[0].camera.intrinsics.width, 11);
        let (mut sizes, mut changes) = (Vec::new(), Vec::new());
        while trainer.step_index() < 50 {
            changes.extend(trainer.resolution_change().map(|change| (trainer.step_index(), change)));
            let view = trainer.view_at(trainer.step_index());
            let (photo, camera) = trainer.photo(view).expect("readable");
            let size = [photo.image.width, photo.image.height];
            assert_eq!(size, [camera.intrinsics.width, camera.intrinsics.height]);
            sizes.push(size);
            trainer.step().expect("trains");
            assert!(images.num_bytes() <= budget, "{} of {budget}", images.num_bytes());
        }
        assert_eq!(changes, [(0, (2, [11, 8])), (5, (1, [21, 15])), (10, (0, [42, 30]))]);
        assert!(sizes[..5].iter().all(|s| *s == [11, 8]) && sizes[5..10].iter().all(|s| *s == [21, 15]));
        assert!(sizes[10..].iter().all(|s| *s == [42, 30]));
        assert!(trainer.resolution_change().is_none() && trainer.coarse.is_none());
    }
}
