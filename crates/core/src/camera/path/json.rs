//! The JSON layouts of camera paths.

use super::{CameraPath, DEFAULT_FPS};
use crate::camera::{Camera, Pinhole};
use crate::error::{Error, Result};
use glam::{DMat3, DMat4, DVec3};
use serde::{Deserialize, Serialize};
use std::path::Path;

const OWN_FORMAT: &str = "gazesplat-path";
const HINT_LAYOUTS: &str = "known layouts: a gazesplat path, cameras.json of the 3DGS reference implementation, camera_path.json of nerfstudio";

/// The camera path in `text`, the content of the file `path`.
pub(super) fn parse(path: &Path, text: &str) -> Result<CameraPath> {
    let value: serde_json::Value =
        serde_json::from_str(text).map_err(|e| Error::format(path, format!("not valid JSON: {e}"), HINT_LAYOUTS))?;
    let parsed = if value.is_array() {
        inria(path, text)?
    } else if value.get("camera_path").is_some() {
        nerfstudio(path, text)?
    } else if value.get("format").and_then(|f| f.as_str()) == Some(OWN_FORMAT) {
        own(path, text)?
    } else if value.pointer("/frames/0/transform_matrix").is_some() {
        let hint = "this is the transforms.json of a scene: pass its directory as a scene instead";
        return Err(Error::format(path, "not a camera path", hint));
    } else {
        return Err(Error::format(path, "not a camera path: the layout is unknown", HINT_LAYOUTS));
    };
    if !(parsed.fps.is_finite() && parsed.fps > 0.0) {
        return Err(Error::format(path, format!("fps is {}, expected a positive number", parsed.fps), ""));
    }
    if parsed.frames.is_empty() {
        return Err(Error::format(path, "the camera path has no frames", "a path needs at least one camera"));
    }
    Ok(parsed)
}

/// `path` in this project's layout.
pub(super) fn to_text(path: &CameraPath) -> String {
    let frames = path.frames.iter().map(|(name, camera)| {
        let m = camera.camera_from_world;
        OwnFrame {
            name: name.clone(),
            intrinsics: camera.intrinsics,
            camera_from_world: [0, 1, 2].map(|row| m.row(row).to_array().map(f64::from)),
        }
    });
    let file = OwnFile { format: OWN_FORMAT.into(), fps: path.fps, frames: frames.collect() };
    serde_json::to_string_pretty(&file).expect("numbers and strings serialise to JSON")
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct OwnFile {
    format: String,
    #[serde(default = "default_fps")]
    fps: f32,
    frames: Vec<OwnFrame>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct OwnFrame {
    name: String,
    intrinsics: Pinhole,
    camera_from_world: [[f64; 4]; 3],
}

fn default_fps() -> f32 {
    DEFAULT_FPS
}

fn own(path: &Path, text: &str) -> Result<CameraPath> {
    let file: OwnFile = typed(path, text)?;
    let frames = file.frames.into_iter().enumerate().map(|(index, frame)| {
        let rows = frame.camera_from_world;
        let rotation = DMat3::from_cols_array_2d(&rows.map(|[a, b, c, _]| [a, b, c])).transpose();
        let translation = DVec3::from_array(rows.map(|row| row[3]));
        Ok((file_stem(&frame.name, index), camera(path, index, frame.intrinsics, rotation, translation)?))
    });
    Ok(CameraPath { frames: frames.collect::<Result<_>>()?, fps: file.fps })
}

/// One camera of `cameras.json` (Kerbl 2023, reference implementation): centre and camera-to-world rotation, OpenCV axes;
/// the principal point is the image centre unless the file says otherwise.
#[derive(Deserialize)]
struct InriaCamera {
    img_name: Option<String>,
    width: f64,
    height: f64,
    position: [f64; 3],
    rotation: [[f64; 3]; 3],
    fx: f64,
    fy: f64,
    cx: Option<f64>,
    cy: Option<f64>,
}

fn inria(path: &Path, text: &str) -> Result<CameraPath> {
    let cameras: Vec<InriaCamera> = typed(path, text)?;
    let frames = cameras.into_iter().enumerate().map(|(index, c)| {
        let intrinsics = Pinhole {
            width: c.width as u32,
            height: c.height as u32,
            fx: c.fx as f32,
            fy: c.fy as f32,
            cx: c.cx.unwrap_or(0.5 * c.width) as f32,
            cy: c.cy.unwrap_or(0.5 * c.height) as f32,
        };
        // The file's rows are those of camera-to-world; read as columns they are its transpose, camera-from-world.
        let rotation = DMat3::from_cols_array_2d(&c.rotation);
        let translation = -(rotation * DVec3::from_array(c.position));
        Ok((
            file_stem(c.img_name.as_deref().unwrap_or(""), index),
            camera(path, index, intrinsics, rotation, translation)?,
        ))
    });
    Ok(CameraPath { frames: frames.collect::<Result<_>>()?, fps: DEFAULT_FPS })
}

/// `camera_path.json` of nerfstudio: row-major camera-to-world with OpenGL axes, vertical field of view in degrees.
#[derive(Deserialize)]
struct NerfstudioFile {
    #[serde(default)]
    camera_type: Option<String>,
    render_width: f64,
    render_height: f64,
    #[serde(default = "default_fps")]
    fps: f32,
    camera_path: Vec<NerfstudioCamera>,
}

#[derive(Deserialize)]
struct NerfstudioCamera {
    camera_to_world: Vec<f64>,
    fov: f64,
}

fn nerfstudio(path: &Path, text: &str) -> Result<CameraPath> {
    let file: NerfstudioFile = typed(path, text)?;
    if let Some(kind) = file.camera_type.as_deref().filter(|kind| *kind != "perspective") {
        let message = format!("camera_type `{kind}` is not supported, only `perspective`");
        return Err(Error::unsupported(path, message, "export the path with perspective cameras"));
    }
    let frames = file.camera_path.iter().enumerate().map(|(index, c)| {
        let Ok(matrix) = <[f64; 16]>::try_from(c.camera_to_world.as_slice()) else {
            let message =
                format!("frame {index}: camera_to_world has {} numbers, expected 16", c.camera_to_world.len());
            return Err(Error::format(path, message, "export the camera path again"));
        };
        let world_from_camera = DMat4::from_cols_array(&matrix).transpose();
        // From OpenGL (y up, z back) to OpenCV axes: the camera's y and z change sign.
        let columns = DMat3::from_mat4(world_from_camera);
        let rotation = DMat3::from_cols(columns.x_axis, -columns.y_axis, -columns.z_axis).transpose();
        let translation = -(rotation * world_from_camera.w_axis.truncate());
        let focal = 0.5 * file.render_height / (0.5 * c.fov.to_radians()).tan();
        let intrinsics = Pinhole {
            width: file.render_width as u32,
            height: file.render_height as u32,
            fx: focal as f32,
            fy: focal as f32,
            cx: 0.5 * file.render_width as f32,
            cy: 0.5 * file.render_height as f32,
        };
        Ok((numbered_name(index), camera(path, index, intrinsics, rotation, translation)?))
    });
    Ok(CameraPath { frames: frames.collect::<Result<_>>()?, fps: file.fps })
}

fn typed<T: serde::de::DeserializeOwned>(path: &Path, text: &str) -> Result<T> {
    serde_json::from_str(text).map_err(|e| Error::format(path, e.to_string(), HINT_LAYOUTS))
}

/// The checked camera of frame `index`; `rotation` and `translation` are those of camera-from-world.
fn camera(path: &Path, index: usize, intrinsics: Pinhole, rotation: DMat3, translation: DVec3) -> Result<Camera> {
    // Files in circulation carry about four digits.
    const TOLERANCE: f64 = 1e-2;
    let bad =
        |message: String| Err(Error::format(path, format!("frame {index}: {message}"), "correct or remove the frame"));
    let Pinhole { width, height, fx, fy, cx, cy } = intrinsics;
    if width == 0 || height == 0 {
        return bad(format!("image size is {width}x{height}, expected at least 1x1"));
    }
    if !(fx > 0.0 && fy > 0.0 && [fx, fy, cx, cy].iter().all(|v| v.is_finite())) {
        return bad(format!(
            "intrinsics fx {fx} fy {fy} cx {cx} cy {cy}, expected finite numbers and positive lengths"
        ));
    }
    let is_rotation = (rotation * rotation.transpose()).abs_diff_eq(DMat3::IDENTITY, TOLERANCE)
        && rotation.determinant() > 0.0
        && translation.is_finite();
    if !is_rotation {
        return bad("the pose is not a rotation and a finite position".into());
    }
    let mut camera_from_world = DMat4::from_mat3(rotation);
    camera_from_world.w_axis = translation.extend(1.0);
    Ok(Camera { intrinsics, camera_from_world: camera_from_world.as_mat4() })
}

fn numbered_name(index: usize) -> String {
    format!("frame_{index:05}")
}

/// Frame names become file names: nothing that leaves the output directory.
fn file_stem(name: &str, index: usize) -> String {
    match name {
        "" | "." | ".." => numbered_name(index),
        _ => name.replace(['/', '\\', '\0'], "_"),
    }
}
