//! Scenes described by `transforms.json`: the dialects of nerfstudio, instant-ngp and NeRF-synthetic.
//!
//! Poses are camera-to-world with OpenGL axes (x right, y up, z back); they become camera-from-world with OpenCV axes by
//! negating the second and third column and inverting. nerfstudio's `applied_transform` and `applied_scale` were already
//! applied to the poses of the file and to its `ply_file_path`: both stay in the frame of the file, and the keys, which
//! lead back to the frame of the reconstruction, are not needed. Frames whose image is missing are left out with a
//! warning, because files that list more than what is published are common.

mod calibration;
mod pose;
mod split;

use super::locate::{Photo, ViewBuilder, check_calibration, find_image, find_mask, mask_dirs, photo_sizes};
use super::ply;
use crate::dataset::{LoadOptions, Scene, SceneFormat, SparsePoints};
use crate::error::{Error, Result};
use crate::view::View;
use glam::DMat4;
use serde_json::{Map, Value};
use std::collections::{HashMap, HashSet};
use std::path::{Component, Path, PathBuf};

/// The training views of the NeRF-synthetic dialect.
pub(crate) const TRAIN_FILE: &str = "transforms_train.json";
/// The test views of the NeRF-synthetic dialect.
const TEST_FILE: &str = "transforms_test.json";

/// The scene described by `file`. A `transforms_train.json` brings its own test views if `transforms_test.json` lies
/// beside it; any other file brings its own split if it lists one (`train_filenames` and its kin, see [`split`]).
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] naming the frame and the key, [`Error::Unsupported`] for camera models that are not
/// implemented; [`Error::Format`] when no frame has an image.
pub(crate) fn load_scene(file: &Path, options: &LoadOptions) -> Result<Scene> {
    let is_synthetic = file.file_name().is_some_and(|name| name == TRAIN_FILE);
    let test_file = Some(file.with_file_name(TEST_FILE)).filter(|test| is_synthetic && test.exists());
    let mut warnings = Vec::new();
    let train = TransformsFile::read(file, options, &mut warnings)?;
    let test = test_file.map(|test| TransformsFile::read(&test, options, &mut warnings)).transpose()?;
    let points = train.points(&mut warnings)?;
    let mut frames = train.frames;
    if frames.is_empty() {
        return Err(Error::format(
            file,
            format!("no registered views: none of its {} frames has an image file", train.num_listed),
            "check that `file_path` of the frames is relative to the directory of this file",
        ));
    }
    let lists = if is_synthetic { None } else { split::Lists::read(file, &train.globals, &train.listed)? };
    let has_own_split = lists.is_some();
    let mut num_train = frames.len();
    if let Some(lists) = lists {
        (frames, num_train) = lists.divide(file, frames, &mut warnings)?;
    }
    frames.extend(test.into_iter().flat_map(|test| test.frames));
    strip_common_directory(&mut frames);
    check_unique(file, &frames)?;
    let mut views = make_views(frames, options)?;
    let own_test = (has_own_split || (is_synthetic && views.len() > num_train)).then(|| views.split_off(num_train));
    let source = if is_synthetic { SceneFormat::NerfSynthetic } else { SceneFormat::Transforms };
    Ok(Scene { views, own_test, points, source, warnings })
}

/// A file with its frames whose image exists.
struct TransformsFile {
    path: PathBuf,
    globals: Map<String, Value>,
    frames: Vec<Frame>,
    num_listed: usize,
    /// `file_path` of every frame, with an image or without.
    listed: HashSet<PathBuf>,
}

/// A frame whose image exists.
struct Frame {
    photo: Photo,
    /// `file_path` as the file has it.
    listed: PathBuf,
    world_from_camera: DMat4,
    intrinsics: calibration::Intrinsics,
    /// File and frame, for messages.
    origin: (PathBuf, String),
}

impl TransformsFile {
    fn read(path: &Path, options: &LoadOptions, warnings: &mut Vec<String>) -> Result<Self> {
        let text = std::fs::read(path).map_err(|source| Error::io("read", path, source))?;
        let hint = "the file must be JSON as nerfstudio, instant-ngp or NeRF-synthetic write it";
        let value: Value = serde_json::from_slice(&text).map_err(|error| {
            Error::format(path, format!("not valid JSON: {error}"), format!("{hint}; NaN is not JSON"))
        })?;
        let Value::Object(mut globals) = value else {
            return Err(Error::format(path, "the file holds no JSON object", hint));
        };
        let Some(Value::Array(listed)) = globals.remove("frames") else {
            return Err(Error::format(path, "the key `frames` is missing or is no array", hint));
        };
        let paths = listed.iter().filter_map(|frame| frame.get("file_path")?.as_str());
        let paths = paths.map(|path| relative_image_path(path, None)).collect();
        let (num_listed, frames) = (listed.len(), Vec::new());
        let mut file = Self { path: path.to_owned(), globals, frames, num_listed, listed: paths };
        let mut missing = Vec::new();
        for (index, frame) in listed.iter().enumerate() {
            match file.frame(index, frame, options, warnings)? {
                Ok(frame) => file.frames.push(frame),
                Err(path) => missing.push(path),
            }
        }
        if let Some(first) = missing.first() {
            warnings.push(format!(
                "{} of the {} frames of `{}` have no image file and were left out, the first is `{}`",
                missing.len(),
                listed.len(),
                path.display(),
                first.display()
            ));
        }
        Ok(file)
    }

    /// The frame, or the path of its image when that does not exist.
    fn frame(
        &self,
        index: usize,
        frame: &Value,
        options: &LoadOptions,
        warnings: &mut Vec<String>,
    ) -> Result<std::result::Result<Frame, PathBuf>> {
        let listed_path = frame.get("file_path").and_then(Value::as_str);
        let context = match listed_path {
            Some(listed_path) => format!("frame {index} (`{listed_path}`)"),
            None => format!("frame {index}"),
        };
        let wrong = |message: String| {
            Error::format(&self.path, format!("{context}: {message}"), "correct the frame or remove it from the file")
        };
        let Value::Object(keys) = frame else { return Err(wrong("it is no JSON object".into())) };
        let listed_path = listed_path.ok_or_else(|| wrong("the key `file_path` is missing or is no string".into()))?;
        let world_from_camera = pose::world_from_camera(keys.get("transform_matrix")).map_err(wrong)?;
        let intrinsics = calibration::Intrinsics::parse(keys, &self.globals)
            .map_err(|problem| problem.into_error(&self.path, &context))?;
        let relative = relative_image_path(listed_path, options.images.as_deref());
        let path = self.directory().join(&relative);
        let Some(found) = find_image(&path) else { return Ok(Err(path)) };
        let name = view_name(&relative, &found);
        let mask_path = self.mask(keys, &relative, &name, warnings);
        let photo = Photo { name, path: found, mask_path };
        let listed = relative_image_path(listed_path, None);
        Ok(Ok(Frame { photo, listed, world_from_camera, intrinsics, origin: (self.path.clone(), context) }))
    }

    /// The mask a frame names, else the one in `masks` beside the images.
    fn mask(
        &self,
        keys: &Map<String, Value>,
        relative: &Path,
        name: &str,
        warnings: &mut Vec<String>,
    ) -> Option<PathBuf> {
        let images = relative.components().next().unwrap_or(Component::CurDir).as_os_str().to_string_lossy();
        let masks = mask_dirs(self.directory(), &images);
        if let Some(mask) = keys.get("mask_path").and_then(Value::as_str) {
            let listed = relative_image_path(mask, None);
            // As with the images: the scaled directory instead of the one that is named.
            let scaled = masks[0].join(listed.components().skip(1).collect::<PathBuf>());
            let path = self.directory().join(&listed);
            if let Some(found) = [scaled, path.clone()].into_iter().find(|path| path.is_file()) {
                return Some(found);
            }
            warnings.push(format!("the mask `{}` of `{name}` is missing, the image is used without", path.display()));
        }
        let in_images = relative.components().skip(1).collect::<PathBuf>().to_string_lossy().replace('\\', "/");
        [in_images.as_str(), name].into_iter().filter(|name| !name.is_empty()).find_map(|name| find_mask(&masks, name))
    }

    /// The points of `ply_file_path`, if the file names some.
    fn points(&self, warnings: &mut Vec<String>) -> Result<SparsePoints> {
        let Some(listed) = self.globals.get("ply_file_path").and_then(Value::as_str) else {
            return Ok(SparsePoints::default());
        };
        let path = self.directory().join(listed.replace('\\', "/"));
        if path.is_file() {
            return ply::load_points(&path);
        }
        warnings.push(format!("the point cloud `{}` named by `ply_file_path` is missing", path.display()));
        Ok(SparsePoints::default())
    }

    fn directory(&self) -> &Path {
        self.path.parent().unwrap_or(Path::new(""))
    }
}

/// Where `file_path` leads, with its first directory replaced by `images`, if that is given.
fn relative_image_path(listed: &str, images: Option<&str>) -> PathBuf {
    let listed = listed.replace('\\', "/");
    let path: PathBuf = Path::new(&listed).components().filter(|c| *c != Component::CurDir).collect();
    match images {
        None => path,
        Some(images) if path.components().count() > 1 => {
            Path::new(images).join(path.components().skip(1).collect::<PathBuf>())
        }
        Some(images) => Path::new(images).join(path),
    }
}

/// The path in the scene with the extension of the file `found`, `/` between its parts, without leading `..`.
fn view_name(relative: &Path, found: &Path) -> String {
    let directories = relative.parent().unwrap_or(Path::new("")).components();
    let parts = directories.filter_map(|c| match c {
        Component::Normal(part) => Some(part),
        _ => None,
    });
    let parts: Vec<_> = parts.chain(found.file_name()).map(|part| part.to_string_lossy()).collect();
    parts.join("/")
}

/// Removes the directories that the names of all frames begin with, so that they are relative to the image directory,
/// as those of COLMAP.
fn strip_common_directory(frames: &mut [Frame]) {
    let directory = |name: &str| name.rfind('/').map_or("", |end| &name[..=end]).to_owned();
    let mut common = frames.first().map_or(String::new(), |frame| directory(&frame.photo.name));
    for frame in frames.iter() {
        while !frame.photo.name.starts_with(&common) {
            common = directory(common.trim_end_matches('/'));
        }
    }
    for frame in frames {
        frame.photo.name.drain(..common.len());
    }
}

fn check_unique(file: &Path, frames: &[Frame]) -> Result<()> {
    let mut seen: HashMap<&str, &Frame> = HashMap::new();
    for frame in frames {
        if let Some(first) = seen.insert(&frame.photo.name, frame) {
            return Err(Error::format(
                file,
                format!("{} and {} name the same image `{}`", first.origin.1, frame.origin.1, frame.photo.name),
                "remove one of the two frames",
            ));
        }
    }
    Ok(())
}

fn make_views(frames: Vec<Frame>, options: &LoadOptions) -> Result<Vec<View>> {
    let (photos, rest): (Vec<_>, Vec<_>) =
        frames.into_iter().map(|f| (f.photo, (f.world_from_camera, f.intrinsics, f.origin))).unzip();
    let sizes = photo_sizes(&photos)?;
    let mut builder = ViewBuilder::new(options.max_side);
    let mut views = Vec::with_capacity(photos.len());
    for ((photo, size), (world_from_camera, intrinsics, (file, context))) in photos.into_iter().zip(sizes).zip(rest) {
        let wrong = |message: String| {
            Error::format(&file, format!("{context}: {message}"), "correct the intrinsics of the file or of the frame")
        };
        let lens = intrinsics.lens(size).map_err(wrong)?;
        check_calibration(&lens).map_err(wrong)?;
        views.push(builder.view(photo, size, lens, &world_from_camera.inverse())?);
    }
    Ok(views)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_relative_to_the_image_directory() {
        let relative = relative_image_path("./train/r_1", None);
        assert_eq!(relative, Path::new("train/r_1"));
        assert_eq!(view_name(&relative, Path::new("/x/train/r_1.png")), "train/r_1.png");
        assert_eq!(view_name(Path::new("../a/b.jpg"), Path::new("../a/b.jpg")), "a/b.jpg");
        assert_eq!(relative_image_path("images\\a b.jpg", Some("images_4")), Path::new("images_4/a b.jpg"));
        assert_eq!(relative_image_path("b.jpg", Some("images_4")), Path::new("images_4/b.jpg"));
    }
}
