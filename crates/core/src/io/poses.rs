//! Camera poses by the names of their views: what refinement leaves behind, and what a scene can be seen by instead of its own.
//!
//! The file is JSON: `{"format": "gazesplat poses 1", "poses": {"image.jpg": [[r00, r01, r02, t0], …, [0, 0, 0, 1]], …}}`, each matrix
//! camera_from_world by rows with OpenCV axes, in the frame of the scene. Lens, size and image stay the scene's, so that one file
//! serves every kind of scene and every image size.

use super::write_atomically;
use crate::dataset::Dataset;
use crate::error::{Error, Result};
use crate::view::View;
use glam::{Mat3, Mat4, Vec4};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::io::Write as _;
use std::path::Path;

/// Format and its version.
const FORMAT: &str = "gazesplat poses 1";
/// Largest entry of R Rᵀ − I that is taken for rounding: as much as four digits of a text leave.
const MAX_SHEAR: f32 = 1e-3;
const HINT: &str = "give the `poses.json` of a run with `train.refine_poses`";

#[derive(Deserialize)]
struct File {
    format: String,
    poses: BTreeMap<String, Vec<Vec<f32>>>,
}

/// Writes the poses of `views`. Reading them gives the same bits.
///
/// # Errors
/// [`Error::Io`] when the file cannot be written.
pub fn save(path: impl AsRef<Path>, views: &[View]) -> Result<()> {
    let sorted: BTreeMap<&str, Mat4> = views.iter().map(|v| (v.name.as_str(), v.camera.camera_from_world)).collect();
    let lines: Vec<String> = sorted
        .into_iter()
        .map(|(name, pose)| {
            let rows: Vec<[f32; 4]> = (0..4).map(|row| pose.row(row).to_array()).collect();
            let json = (serde_json::to_string(name), serde_json::to_string(&rows));
            let (name, rows) = (json.0.expect("a text is JSON"), json.1.expect("poses are finite numbers"));
            format!("    {name}: {rows}")
        })
        .collect();
    let text = format!("{{\n  \"format\": \"{FORMAT}\",\n  \"poses\": {{\n{}\n  }}\n}}\n", lines.join(",\n"));
    write_atomically(path, |file| file.write_all(text.as_bytes()))
}

/// The camera_from_world of each view the file names.
///
/// # Errors
/// [`Error::Io`], and [`Error::Format`] naming the view whose matrix is no rigid transform.
pub fn load(path: impl AsRef<Path>) -> Result<BTreeMap<String, Mat4>> {
    let path = path.as_ref();
    let bytes = std::fs::read(path).map_err(|source| Error::io("read", path, source))?;
    let wrong = |message: String| Error::format(path, message, HINT);
    let file: File = serde_json::from_slice(&bytes).map_err(|error| wrong(format!("no poses file: {error}")))?;
    if file.format != FORMAT {
        return Err(wrong(format!("its format is `{}`, expected `{FORMAT}`", file.format)));
    }
    let parsed = |(name, rows): (String, Vec<Vec<f32>>)| match matrix(&rows) {
        Ok(pose) => Ok((name, pose)),
        Err(message) => Err(wrong(format!("the pose of `{name}` {message}"))),
    };
    file.poses.into_iter().map(parsed).collect()
}

fn matrix(rows: &[Vec<f32>]) -> std::result::Result<Mat4, String> {
    let rows: Option<Vec<Vec4>> =
        rows.iter().map(|r| <[f32; 4]>::try_from(r.as_slice()).ok().map(Vec4::from)).collect();
    let Some(&[a, b, c, d]) = rows.as_deref() else { return Err("is no matrix of 4 rows of 4 numbers".to_owned()) };
    let pose = Mat4::from_cols(a, b, c, d).transpose();
    if !pose.is_finite() {
        return Err("has an entry that is not finite".to_owned());
    }
    if d != Vec4::W {
        return Err(format!("ends in the row {:?}, expected [0, 0, 0, 1]", d.to_array()));
    }
    let r = Mat3::from_mat4(pose);
    let off = (r * r.transpose() - Mat3::IDENTITY).to_cols_array().iter().fold(0.0_f32, |m, x| m.max(x.abs()));
    if off.is_nan() || off > MAX_SHEAR {
        return Err(format!("is no rotation (R Rᵀ is off by {off:.1e}, at most {MAX_SHEAR:.0e})"));
    }
    if r.determinant() < 0.0 {
        return Err("mirrors space".to_owned());
    }
    Ok(pose)
}

/// Replaces the poses of the views of `dataset` that the file names, whatever their split; the others keep theirs. Names that the
/// scene does not have are told in its warnings. Returns how many views were given another pose.
///
/// # Errors
/// As [`load`]; [`Error::Format`] when the file names no view of the scene.
pub fn apply(dataset: &mut Dataset, path: impl AsRef<Path>) -> Result<usize> {
    let path = path.as_ref();
    let mut poses = load(path)?;
    let num_listed = poses.len();
    let mut num_applied = 0;
    let Dataset { train, test, holdout, .. } = dataset;
    for view in train.iter_mut().chain(test).chain(holdout) {
        if let Some(pose) = poses.remove(&view.name) {
            view.camera.camera_from_world = pose;
            num_applied += 1;
        }
    }
    if num_applied == 0 {
        let first = poses.keys().next().map_or("none".to_owned(), |name| format!("the first is `{name}`"));
        let message = format!("none of its {num_listed} poses is of a view of the scene, {first}");
        return Err(Error::format(
            path,
            message,
            "the names have to be those of the scene's images: is it of another scene?",
        ));
    }
    if let Some(first) = poses.keys().next() {
        dataset.warnings.push(format!(
            "{} of the {num_listed} poses of `{}` are of no view of the scene, the first is `{first}`",
            poses.len(),
            path.display()
        ));
    }
    Ok(num_applied)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Camera, Pinhole};
    use crate::dataset::{LoadOptions, SceneFormat, SparsePoints};
    use glam::Vec3;

    fn view(name: &str, angle: f32) -> View {
        let pose = Mat4::from_axis_angle(Vec3::new(0.6, 0.0, 0.8), angle)
            * Mat4::from_translation(Vec3::new(0.1, 2e-8, -37.3));
        let camera = Camera { intrinsics: Pinhole::from_fov_x(8, 6, 1.0), camera_from_world: pose };
        View { name: name.to_owned(), camera, image_path: None, distortion: None, mask_path: None }
    }

    fn scene() -> Dataset {
        let views = ["a.jpg", "b.jpg", "ü \"c\".jpg"].map(|name| view(name, 0.3)).to_vec();
        Dataset::from_views(views, SparsePoints::default(), SceneFormat::Synthetic, &LoadOptions::default())
    }

    #[test]
    fn poses_come_back_bit_for_bit_and_only_those_named_change() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("poses.json");
        let moved = [view("ü \"c\".jpg", 1.234_567), view("b.jpg", -2.7), view("gone.jpg", 0.1)];
        save(&path, &moved).unwrap();
        let mut dataset = scene();
        assert_eq!(apply(&mut dataset, &path).unwrap(), 2);
        // The first view is a test view.
        assert_eq!(dataset.test[0].camera, scene().test[0].camera);
        assert_eq!(dataset.train[0].camera, moved[1].camera);
        assert_eq!(dataset.train[1].camera, moved[0].camera);
        assert!(dataset.warnings[0].contains("`gone.jpg`"), "{:?}", dataset.warnings);
    }

    #[test]
    fn files_that_are_no_poses_are_refused_with_the_reason() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("poses.json");
        let refused = |text: &str| {
            std::fs::write(&path, text).unwrap();
            let error = apply(&mut scene(), &path).unwrap_err();
            assert!(error.hint().is_some());
            error.to_string()
        };
        let with = |matrix: &str| format!("{{\"format\": \"{FORMAT}\", \"poses\": {{\"b.jpg\": {matrix}}}}}");
        for (text, said) in [
            ("[1, 2".to_owned(), "no poses file"),
            ("{\"frames\": []}".to_owned(), "missing field `format`"),
            ("{\"format\": \"other\", \"poses\": {}}".to_owned(), "its format is `other`"),
            (with("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]"), "the pose of `b.jpg` is no matrix of 4 rows"),
            (with("[[1, 0, 0, 1e39], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"), "b.jpg"),
            (with("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]]"), "ends in the row"),
            (with("[[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"), "is no rotation"),
            (with("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]"), "mirrors"),
            (with("null"), "no poses file"),
        ] {
            let message = refused(&text);
            assert!(message.contains(said) && message.contains("poses.json"), "{message}");
        }
        save(&path, &[view("x.jpg", 0.0)]).unwrap();
        let message = apply(&mut scene(), &path).unwrap_err().to_string();
        assert!(message.contains("none of its 1 poses") && message.contains("`x.jpg`"), "{message}");
        assert!(load(dir.path().join("none")).unwrap_err().hint().is_some());
    }
}
