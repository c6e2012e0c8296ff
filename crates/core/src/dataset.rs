//! A scene as it was captured: posed views, their split, sparse points.

use crate::error::{Error, Result};
use crate::io::{colmap, transforms};
use crate::view::View;
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::path::Path;

/// Sparse points of a reconstruction, the usual initialisation.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SparsePoints {
    /// Positions, `[P, 3]`, world units.
    pub positions: Vec<[f32; 3]>,
    /// Colours, `[P, 3]`, sRGB 8-bit.
    pub colors: Vec<[u8; 3]>,
}

impl SparsePoints {
    /// Number of points P.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// True when there is no point.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }
}

/// What a scene was read from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SceneFormat {
    /// COLMAP `cameras.bin`, `images.bin`, `points3D.bin`.
    ColmapBinary,
    /// COLMAP `cameras.txt`, `images.txt`, `points3D.txt`.
    ColmapText,
    /// `transforms.json` of nerfstudio or instant-ngp.
    Transforms,
    /// `transforms_train.json` and `transforms_test.json` of NeRF-synthetic.
    NerfSynthetic,
    /// Made by [`crate::synthetic`], not read from files.
    #[default]
    Synthetic,
}

impl fmt::Display for SceneFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::ColmapBinary => "COLMAP (binary)",
            Self::ColmapText => "COLMAP (text)",
            Self::Transforms => "transforms.json",
            Self::NerfSynthetic => "NeRF-synthetic (transforms_train.json)",
            Self::Synthetic => "synthetic",
        })
    }
}

/// Training views that take no part in gradient steps, for a guard that judges the model later.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Holdout {
    /// Every training view trains.
    #[default]
    None,
    /// Training views whose index in the sorted list is 4 modulo 8 are kept out.
    Every8,
}

/// How a scene is read and split.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LoadOptions {
    /// Longer side of the images in pixels after downscaling; 0 = as they are.
    pub max_side: u32,
    /// Image directory inside the scene (`images_2`, …); `None` = `images`, or what `transforms.json` says.
    pub images: Option<String>,
    /// Every how many views, sorted by name, one is a test view, the first being one; 0 = none. Scenes with their own
    /// test file keep their split.
    pub test_every: u32,
    /// Training views kept out of gradient steps.
    pub holdout: Holdout,
}

impl Default for LoadOptions {
    fn default() -> Self {
        Self { max_side: 0, images: None, test_every: 8, holdout: Holdout::None }
    }
}

/// Posed views and sparse points of one scene, views sorted by name.
#[derive(Debug, Clone, Default)]
pub struct Dataset {
    /// Views that training may use, sorted by name.
    pub train: Vec<View>,
    /// Views kept for measurement only, sorted by name.
    pub test: Vec<View>,
    /// Views kept out of training for a later guard, sorted by name; see [`Holdout`].
    pub holdout: Vec<View>,
    /// Sparse points; empty when the scene has none.
    pub points: SparsePoints,
    /// What the scene was read from.
    pub source: SceneFormat,
    /// What was left out while reading, in sentences for people.
    pub warnings: Vec<String>,
}

/// A scene before it is split.
#[derive(Debug)]
pub(crate) struct Scene {
    /// Views in any order.
    pub views: Vec<View>,
    /// The test views of scenes that bring their own split, in any order.
    pub own_test: Option<Vec<View>>,
    /// Sparse points, possibly none.
    pub points: SparsePoints,
    /// What the scene was read from.
    pub source: SceneFormat,
    /// What was left out.
    pub warnings: Vec<String>,
}

/// Factor on the radius of the camera positions, 1.1 in the code of Kerbl 2023.
const EXTENT_MARGIN: f32 = 1.1;

impl Dataset {
    /// Reads the scene at `path`: a directory with a COLMAP model (the largest of `sparse/0`, `sparse/1`, …;
    /// `sparse`, `colmap/sparse/0` or the directory itself; `.bin` preferred to `.txt`), else with `transforms.json`, else with `transforms_train.json`; or
    /// one of these JSON files itself. Images are not decoded, only their sizes are read.
    ///
    /// # Errors
    /// [`Error::Io`] and [`Error::Format`] for files that are missing or damaged, [`Error::Unsupported`] for camera models
    /// that are not implemented and for what is no scene, each naming the file.
    pub fn load(path: impl AsRef<Path>, options: &LoadOptions) -> Result<Self> {
        let path = path.as_ref();
        let metadata = std::fs::metadata(path).map_err(|source| Error::io("read", path, source))?;
        let scene = if metadata.is_file() {
            if path.extension().is_none_or(|extension| !extension.eq_ignore_ascii_case("json")) {
                return Err(not_a_scene(path, "a file, but no JSON file"));
            }
            transforms::load_scene(path, options)?
        } else if let Some((model, choice)) = colmap::choose_model(path) {
            colmap::load_scene(path, (&model, choice), options)?
        } else if let Some(file) =
            ["transforms.json", transforms::TRAIN_FILE].map(|f| path.join(f)).into_iter().find(|f| f.exists())
        {
            transforms::load_scene(&file, options)?
        } else {
            return Err(not_a_scene(path, "no COLMAP model in `sparse/0` and no `transforms.json`"));
        };
        Ok(Self::split(scene, options))
    }

    /// Splits `views` by the rules of `options`: sorted by name, every `test_every`-th is a test view.
    pub fn from_views(views: Vec<View>, points: SparsePoints, source: SceneFormat, options: &LoadOptions) -> Self {
        Self::split(Scene { views, own_test: None, points, source, warnings: Vec::new() }, options)
    }

    fn split(scene: Scene, options: &LoadOptions) -> Self {
        let Scene { mut views, own_test, points, source, warnings } = scene;
        views.sort_by(|a, b| a.name.cmp(&b.name));
        let (train, mut test) = match own_test {
            Some(test) => (views, test),
            None => partition(views, |i| options.test_every > 0 && i % options.test_every as usize == 0),
        };
        test.sort_by(|a, b| a.name.cmp(&b.name));
        let (holdout, train) = match options.holdout {
            Holdout::None => (Vec::new(), train),
            Holdout::Every8 => {
                let (train, holdout) = partition(train, |i| i % 8 == 4);
                (holdout, train)
            }
        };
        Self { train, test, holdout, points, source, warnings }
    }

    /// Training, held-out and test views together, sorted by name.
    pub fn all_views(&self) -> Vec<&View> {
        let mut views: Vec<_> = self.train.iter().chain(&self.holdout).chain(&self.test).collect();
        views.sort_by(|a, b| a.name.cmp(&b.name));
        views
    }

    /// Radius of the positions of the training cameras around their mean, times 1.1 (Kerbl 2023, code); world units.
    /// It scales the learning rate of the means. 1 when the cameras share one position, which has no scale to tell.
    pub fn scene_extent(&self) -> f32 {
        let views = if self.train.is_empty() { self.all_views() } else { self.train.iter().collect() };
        let positions: Vec<Vec3> = views.iter().map(|view| view.camera.position()).collect();
        let center = positions.iter().sum::<Vec3>() / positions.len().max(1) as f32;
        let radius = positions.iter().map(|position| position.distance(center)).fold(0.0, f32::max);
        let magnitude = center.length();
        // Positions that differ by rounding only are one position.
        if radius > 1e-6 * magnitude.max(f32::MIN_POSITIVE) { EXTENT_MARGIN * radius } else { 1.0 }
    }
}

/// (views whose index does not satisfy `chosen`, views whose index does), in order.
fn partition(views: Vec<View>, chosen: impl Fn(usize) -> bool) -> (Vec<View>, Vec<View>) {
    let (mut rest, mut picked) = (Vec::new(), Vec::new());
    for (i, view) in views.into_iter().enumerate() {
        if chosen(i) { picked.push(view) } else { rest.push(view) }
    }
    (rest, picked)
}

fn not_a_scene(path: &Path, found: &str) -> Error {
    Error::unsupported(
        path,
        format!("not a scene: {found}"),
        "give a COLMAP directory (`sparse/0` and `images`), or a directory with `transforms.json` or `transforms_train.json`",
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Camera, Pinhole};
    use glam::Mat4;
    use proptest::prelude::*;

    fn view(name: &str, x: f32) -> View {
        let camera = Camera {
            intrinsics: Pinhole::from_fov_x(8, 6, 1.0),
            camera_from_world: Mat4::from_translation(Vec3::new(-x, 0.0, 0.0)),
        };
        View { name: name.into(), camera, image_path: None, distortion: None, mask_path: None }
    }

    fn names(views: &[View]) -> Vec<&str> {
        views.iter().map(|v| v.name.as_str()).collect()
    }

    proptest! {
        #[test]
        fn split_keeps_every_view_once_and_sorted(count in 0_usize..50, test_every in 0_u32..12, holdout in any::<bool>()) {
            let views = (0..count).rev().map(|i| view(&format!("{i:03}"), 0.0)).collect();
            let holdout = if holdout { Holdout::Every8 } else { Holdout::None };
            let options = LoadOptions { test_every, holdout, ..LoadOptions::default() };
            let data = Dataset::from_views(views, SparsePoints::default(), SceneFormat::Synthetic, &options);
            let all: Vec<_> = data.all_views().iter().map(|v| v.name.clone()).collect();
            prop_assert_eq!(all, (0..count).map(|i| format!("{i:03}")).collect::<Vec<_>>());
            let expected = if test_every == 0 { 0 } else { count.div_ceil(test_every as usize) };
            prop_assert_eq!(data.test.len(), expected);
            prop_assert!(data.train.is_sorted_by_key(|v| &v.name) && data.test.is_sorted_by_key(|v| &v.name));
        }
    }

    #[test]
    fn first_and_every_eighth_view_by_name_are_test_views() {
        let views = (0..17).rev().map(|i| view(&format!("{i:02}.JPG"), 0.0)).collect();
        let options = LoadOptions { holdout: Holdout::Every8, ..LoadOptions::default() };
        let data = Dataset::from_views(views, SparsePoints::default(), SceneFormat::Synthetic, &options);
        assert_eq!(names(&data.test), ["00.JPG", "08.JPG", "16.JPG"]);
        assert_eq!(names(&data.holdout), ["05.JPG", "14.JPG"]);
    }

    #[test]
    fn extent_is_the_radius_of_the_camera_positions_with_margin() {
        let options = LoadOptions { test_every: 0, ..LoadOptions::default() };
        let data = |xs: &[f32]| {
            let views = xs.iter().enumerate().map(|(i, &x)| view(&i.to_string(), x)).collect();
            Dataset::from_views(views, SparsePoints::default(), SceneFormat::Synthetic, &options)
        };
        assert!((data(&[0.0, 4.0]).scene_extent() - 2.2).abs() < 1e-6);
        assert_eq!(data(&[3.0, 3.0, 3.0]).scene_extent(), 1.0);
        assert_eq!(data(&[]).scene_extent(), 1.0);
    }
}
