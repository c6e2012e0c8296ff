//! Scenes reconstructed by COLMAP: the model in memory, and its views.
//!
//! Poses are stored world-to-camera with OpenCV axes, which is this project's convention: they are used as they are.
//! The formats themselves are in [`colmap_bin`] and [`colmap_txt`].

use super::locate::{Photo, ViewBuilder, check_calibration, find_image, find_mask, mask_dirs, photo_sizes};
use super::{colmap_bin, colmap_txt};
use crate::camera::distortion::{LensDistortion, LensModel};
use crate::dataset::{LoadOptions, Scene, SceneFormat, SparsePoints};
use crate::error::{Error, Result};
use glam::{DMat4, DQuat, DVec3};
use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};

/// A COLMAP model: calibrations, registered images, points.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ColmapModel {
    /// Calibrations by camera id.
    pub cameras: BTreeMap<u32, LensDistortion>,
    /// Registered images in the order of the file, names unique.
    pub images: Vec<ColmapImage>,
    /// Points in the order of the file, all finite.
    pub points: SparsePoints,
    /// Points that were left out because a coordinate is not finite.
    pub num_dropped_points: usize,
}

/// A registered image of a COLMAP model.
#[derive(Debug, Clone, PartialEq)]
pub struct ColmapImage {
    /// COLMAP's id.
    pub id: u32,
    /// File name relative to the image directory.
    pub name: String,
    /// Key of [`ColmapModel::cameras`].
    pub camera_id: u32,
    /// Rigid transform from world to camera (OpenCV axes).
    pub camera_from_world: DMat4,
}

/// Names of the files of a model, in the order cameras, images, points.
pub(super) const BINARY_FILES: [&str; 3] = ["cameras.bin", "images.bin", "points3D.bin"];
/// As [`BINARY_FILES`], for the text format.
pub(super) const TEXT_FILES: [&str; 3] = ["cameras.txt", "images.txt", "points3D.txt"];

/// The directory of the COLMAP model of the scene directory `scene`, if it has one: the largest of the numbered ones in
/// `sparse` (`sparse/0`, …), `sparse` itself, the largest in `colmap/sparse`, or `scene` itself.
pub fn find_model(scene: &Path) -> Option<PathBuf> {
    choose_model(scene).map(|(dir, _)| dir)
}

/// As [`find_model`], with a sentence for people where there was a choice.
pub(crate) fn choose_model(scene: &Path) -> Option<(PathBuf, Option<String>)> {
    let sparse = scene.join("sparse");
    let only = |dir: PathBuf| is_model(&dir).then_some((dir, None));
    largest_model(&sparse)
        .or_else(|| only(sparse))
        .or_else(|| largest_model(&scene.join("colmap/sparse")))
        .or_else(|| only(scene.to_owned()))
}

fn is_model(dir: &Path) -> bool {
    let files = [BINARY_FILES, TEXT_FILES];
    files.iter().any(|[cameras, images, _]| dir.join(cameras).exists() || dir.join(images).exists())
}

/// The numbered model in `sparse` that has registered the most views, the first of equals. Where structure from motion
/// finds no link between two parts of a capture it leaves a model of each, in no order.
fn largest_model(sparse: &Path) -> Option<(PathBuf, Option<String>)> {
    let numbered = |entry: std::fs::DirEntry| Some((entry.file_name().to_str()?.parse::<u32>().ok()?, entry.path()));
    let mut models: Vec<(u32, PathBuf)> = std::fs::read_dir(sparse).ok()?.flatten().filter_map(numbered).collect();
    models.retain(|(_, dir)| is_model(dir));
    models.sort();
    if models.len() < 2 {
        return models.pop().map(|(_, dir)| (dir, None));
    }
    let counts: Vec<Option<usize>> =
        models.iter().map(|(_, dir)| read_model(dir).ok().map(|(model, _)| model.images.len())).collect();
    // The last maximum of the reversed list is the first of equals; a model that cannot be read counts as none.
    let (chosen, most) = counts.iter().enumerate().rev().max_by_key(|(_, count)| **count)?;
    let others = models.iter().zip(&counts).enumerate().filter(|(index, _)| *index != chosen);
    let others = others.map(|(_, ((_, dir), count))| match count {
        Some(count) => format!("`{}` has {count}", dir.display()),
        None => format!("`{}` cannot be read", dir.display()),
    });
    let others: Vec<String> = others.collect();
    let dir = models.swap_remove(chosen).1;
    let said = format!(
        "the scene has {} models: the largest, `{}` with {} registered views, is used; {}. To use another, give its \
         directory as the scene",
        counts.len(),
        dir.display(),
        most.unwrap_or(0),
        others.join(", ")
    );
    Some((dir, Some(said)))
}

/// Reads the model in the directory `dir`: the binary files when both `cameras.bin` and `images.bin` are there, else the
/// text files. `points3D` may be missing.
///
/// # Errors
/// [`Error::Io`] for missing files, [`Error::Format`] for damaged ones, [`Error::Unsupported`] for camera models that are
/// not implemented.
pub fn read_model(dir: &Path) -> Result<(ColmapModel, SceneFormat)> {
    let has = |files: [&str; 3]| dir.join(files[0]).exists() && dir.join(files[1]).exists();
    let any_binary = BINARY_FILES[..2].iter().any(|file| dir.join(file).exists());
    if has(BINARY_FILES) || (any_binary && !has(TEXT_FILES)) {
        Ok((colmap_bin::read(dir)?, SceneFormat::ColmapBinary))
    } else {
        Ok((colmap_txt::read(dir)?, SceneFormat::ColmapText))
    }
}

/// The views and points of the scene directory `scene`, whose model is in the directory `model_dir`; `choice` is what a
/// person should know about how it was chosen.
///
/// # Errors
/// As [`read_model`]; [`Error::Format`] when no view is registered, the image directory or any photograph is missing, or
/// a photograph does not fit its camera.
pub(crate) fn load_scene(
    scene: &Path,
    (model_dir, choice): (&Path, Option<String>),
    options: &LoadOptions,
) -> Result<Scene> {
    let (model, source) = read_model(model_dir)?;
    if model.images.is_empty() {
        return Err(Error::format(
            model_dir,
            "the COLMAP model has no registered views",
            "check the log of `colmap mapper`: no photograph could be matched to another",
        ));
    }
    let images_dir = find_images_dir(scene, model_dir, options)?;
    let images_name = images_dir.file_name().unwrap_or_default().to_string_lossy();
    let masks = mask_dirs(images_dir.parent().unwrap_or(scene), &images_name);
    let photos = find_photos(&model, &images_dir, &masks)?;
    let sizes = photo_sizes(&photos)?;
    let mut builder = ViewBuilder::new(options.max_side);
    let mut views = Vec::with_capacity(photos.len());
    for ((photo, size), image) in photos.into_iter().zip(sizes).zip(&model.images) {
        views.push(builder.view(photo, size, model.cameras[&image.camera_id], &image.camera_from_world)?);
    }
    let mut warnings: Vec<String> = choice.into_iter().collect();
    if model.num_dropped_points > 0 {
        warnings.push(format!(
            "{} sparse points with coordinates that are not finite were left out",
            model.num_dropped_points
        ));
    }
    Ok(Scene { views, own_test: None, points: model.points, source, warnings })
}

fn find_images_dir(scene: &Path, model_dir: &Path, options: &LoadOptions) -> Result<PathBuf> {
    let name = options.images.as_deref().unwrap_or("images");
    // When the model's own directory was given, the photographs lie beside it, beside `sparse` or beside `colmap`.
    let num_parents = if model_dir == scene { 4 } else { 1 };
    let bases = || scene.ancestors().take(num_parents);
    if let Some(dir) = bases().map(|base| base.join(name)).find(|dir| dir.is_dir()) {
        return Ok(dir);
    }
    let mut others: Vec<String> = std::fs::read_dir(scene)
        .map_err(|source| Error::io("read", scene, source))?
        .flatten()
        .filter(|entry| entry.path().is_dir())
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .filter(|other| other.starts_with("images") || other == "input")
        .collect();
    others.sort();
    let hint = match others.first() {
        Some(first) => format!(
            "the scene has `{}`; choose one with `data.images`, as in `data.images={first}`",
            others.join("`, `")
        ),
        None => "put the photographs that were reconstructed there, or name their directory with `data.images`".into(),
    };
    Err(Error::format(scene.join(name), "the directory of the photographs is missing", hint))
}

fn find_photos(model: &ColmapModel, images_dir: &Path, masks: &[PathBuf]) -> Result<Vec<Photo>> {
    let mut photos = Vec::with_capacity(model.images.len());
    let mut missing = Vec::new();
    for image in &model.images {
        let path = images_dir.join(&image.name);
        match find_image(&path) {
            Some(path) => {
                let mask_path = find_mask(masks, &image.name);
                photos.push(Photo { name: image.name.clone(), path, mask_path });
            }
            None => missing.push(path),
        }
    }
    match missing.iter().min() {
        Some(first) => Err(Error::format(
            first,
            format!(
                "the photograph is missing ({} of the {} registered views have none)",
                missing.len(),
                model.images.len()
            ),
            "restore the files, or name the directory that holds them with `data.images`",
        )),
        None => Ok(photos),
    }
}

/// Adds `image`, checked against what was read before.
///
/// # Errors
/// A sentence naming the image and what is wrong.
pub(super) fn add_image(
    model: &mut ColmapModel,
    seen: &mut HashSet<String>,
    image: RawImage,
) -> std::result::Result<(), String> {
    let RawImage { id, quat_wxyz: [w, x, y, z], translation, camera_id, name } = image;
    let context = format!("image {id} (`{name}`)");
    if name.is_empty() {
        return Err(format!("image {id} has an empty name"));
    }
    if !model.cameras.contains_key(&camera_id) {
        return Err(format!("{context} refers to camera {camera_id}, which is not in the cameras file"));
    }
    let rotation = DQuat::from_xyzw(x, y, z, w);
    let length = rotation.length();
    if !(length.is_finite() && length > 1e-6) {
        return Err(format!(
            "{context} has the quaternion ({w}, {x}, {y}, {z}), expected finite numbers of unit length"
        ));
    }
    if !translation.iter().all(|t| (*t as f32).is_finite()) {
        return Err(format!("{context} has the translation {translation:?}, expected finite numbers"));
    }
    if !seen.insert(name.clone()) {
        return Err(format!("{context} is registered twice"));
    }
    let camera_from_world = DMat4::from_rotation_translation(rotation / length, DVec3::from_array(translation));
    model.images.push(ColmapImage { id, name, camera_id, camera_from_world });
    Ok(())
}

/// A registered image as the files store it.
pub(super) struct RawImage {
    /// COLMAP's id.
    pub id: u32,
    /// Rotation from world to camera.
    pub quat_wxyz: [f64; 4],
    /// Translation from world to camera.
    pub translation: [f64; 3],
    /// Id of the camera.
    pub camera_id: u32,
    /// Name of the image file.
    pub name: String,
}

/// Adds a camera with COLMAP's parameters `params` (of `model.num_params()` values), checked.
///
/// # Errors
/// A sentence naming the camera and what is wrong.
pub(super) fn add_camera(
    cameras: &mut BTreeMap<u32, LensDistortion>,
    id: u32,
    model: LensModel,
    size: [u64; 2],
    params: &[f64],
) -> std::result::Result<(), String> {
    // What does not fit is refused by the check below.
    let size = size.map(|side| u32::try_from(side).unwrap_or(u32::MAX));
    let (focal, rest) =
        if model.has_single_focal() { ([params[0]; 2], &params[1..]) } else { ([params[0], params[1]], &params[2..]) };
    let mut coefficients = [0.0; 8];
    coefficients[..rest.len() - 2].copy_from_slice(&rest[2..]);
    let in_range = params.iter().all(|p| p.is_finite());
    // The search for the fold of the lens needs finite coefficients.
    let lens = if in_range {
        LensDistortion::new(model, size, focal, [rest[0], rest[1]], coefficients)
    } else {
        return Err(format!("camera {id} ({}) has the parameters {params:?}, expected finite numbers", model.name()));
    };
    check_calibration(&lens).map_err(|message| format!("camera {id} ({}) has {message}", model.name()))?;
    match cameras.insert(id, lens) {
        Some(_) => Err(format!("camera {id} is declared twice")),
        None => Ok(()),
    }
}

/// Adds a point, or counts it when a coordinate is not finite.
pub(super) fn add_point(model: &mut ColmapModel, position: [f64; 3], color: [u8; 3]) {
    let position = position.map(|x| x as f32);
    if position.iter().all(|x| x.is_finite()) {
        model.points.positions.push(position);
        model.points.colors.push(color);
    } else {
        model.num_dropped_points += 1;
    }
}

/// What to do about a damaged model file.
pub(super) const EXPORT_HINT: &str = "copy the model again, or write it anew with `colmap model_converter`";

/// The error for a camera model that is not implemented.
pub(super) fn unknown_model(path: &Path, camera_id: u32, found: &str) -> Error {
    Error::unsupported(
        path,
        format!("camera {camera_id} has the model {found}; supported are {}", LensModel::supported()),
        "undistort the photographs with `colmap image_undistorter` and give its output directory",
    )
}
