//! The intrinsics of a frame: its own keys first, then those of the file.

use crate::camera::distortion::{LensDistortion, LensModel};
use crate::error::Error;
use serde_json::{Map, Value};
use std::path::Path;

/// Intrinsics as the keys give them; lengths in pixels, angles in radians.
pub(super) struct Intrinsics {
    /// `w`, `h`.
    size: Option<[u32; 2]>,
    /// `fl_x` or `camera_angle_x`.
    focal_x: Focal,
    /// `fl_y` or `camera_angle_y`; as along x when neither is given.
    focal_y: Option<Focal>,
    /// `cx`, `cy`; the middle of the image when not given.
    center: [Option<f64>; 2],
    model: LensModel,
    coefficients: [f64; 8],
}

/// A focal length or the field of view that stands for it.
#[derive(Clone, Copy)]
enum Focal {
    Pixels(f64),
    FieldOfView(f64),
}

/// What is wrong with the intrinsics of a frame.
pub(super) enum Problem {
    /// A value is missing or out of range.
    Value(String),
    /// The camera model is not implemented.
    Model(String),
}

impl Problem {
    /// The error about the frame `context` of the file `path`.
    pub fn into_error(self, path: &Path, context: &str) -> Error {
        match self {
            Self::Value(message) => Error::format(
                path,
                format!("{context}: {message}"),
                "correct the intrinsics of the file or of the frame",
            ),
            Self::Model(message) => Error::unsupported(
                path,
                format!("{context}: {message}"),
                "undistort the photographs to a pinhole first",
            ),
        }
    }
}

impl From<String> for Problem {
    fn from(message: String) -> Self {
        Self::Value(message)
    }
}

impl Intrinsics {
    /// The intrinsics of a frame with the keys `frame` in a file with the keys `globals`.
    pub fn parse(frame: &Map<String, Value>, globals: &Map<String, Value>) -> Result<Self, Problem> {
        let either = |key: &str| Ok::<_, String>(number(frame, key)?.or(number(globals, key)?));
        let (own_x, own_y) = (Focal::parse(frame, "x")?, Focal::parse(frame, "y")?);
        let (focal_x, focal_y) = match own_x {
            // A focal length of its own along x replaces both of the file.
            Some(own_x) => (own_x, own_y),
            None => {
                let message = "the focal length is missing: neither `fl_x` nor `camera_angle_x` is given";
                let shared_x = Focal::parse(globals, "x")?.ok_or_else(|| message.to_owned())?;
                (shared_x, own_y.or(Focal::parse(globals, "y")?))
            }
        };
        let size = match (either("w")?, either("h")?) {
            (Some(w), Some(h)) => Some([side("w", w)?, side("h", h)?]),
            _ => None,
        };
        let (model, coefficients) = lens_model(frame, globals)?;
        Ok(Self { size, focal_x, focal_y, center: [either("cx")?, either("cy")?], model, coefficients })
    }

    /// The calibration; `photo_size` stands in for a size that the file does not give.
    ///
    /// # Errors
    /// A sentence naming a field of view that is out of range.
    pub fn lens(&self, photo_size: [u32; 2]) -> Result<LensDistortion, String> {
        let size = self.size.unwrap_or(photo_size);
        let [width, height] = size.map(f64::from);
        let fx = self.focal_x.pixels("camera_angle_x", width)?;
        let fy = match self.focal_y {
            Some(focal) => focal.pixels("camera_angle_y", height)?,
            None => fx,
        };
        let center = [self.center[0].unwrap_or(0.5 * width), self.center[1].unwrap_or(0.5 * height)];
        Ok(LensDistortion::new(self.model, size, [fx, fy], center, self.coefficients))
    }
}

impl Focal {
    fn parse(keys: &Map<String, Value>, axis: &str) -> Result<Option<Self>, String> {
        let focal = number(keys, &format!("fl_{axis}"))?.map(Self::Pixels);
        Ok(focal.or(number(keys, &format!("camera_angle_{axis}"))?.map(Self::FieldOfView)))
    }

    fn pixels(self, key: &str, side: f64) -> Result<f64, String> {
        match self {
            Self::Pixels(focal) => Ok(focal),
            Self::FieldOfView(angle) if angle > 0.0 && angle < std::f64::consts::PI => {
                Ok(0.5 * side / (0.5 * angle).tan())
            }
            Self::FieldOfView(angle) => Err(format!("`{key}` is {angle}, expected radians between 0 and π")),
        }
    }
}

/// Lens model and coefficients. As nerfstudio does, perspective models use whichever of k1 … k4, p1, p2 are given,
/// whatever the name says.
fn lens_model(frame: &Map<String, Value>, globals: &Map<String, Value>) -> Result<(LensModel, [f64; 8]), Problem> {
    let value = |key: &str| frame.get(key).or_else(|| globals.get(key)).filter(|value| !value.is_null());
    let coefficient = |key: &str| Ok::<_, String>(number(frame, key)?.or(number(globals, key)?).unwrap_or(0.0));
    let k = |i: usize| coefficient(["k1", "k2", "k3", "k4", "k5", "k6"][i]);
    let name = match value("camera_model") {
        None => "OPENCV".to_owned(),
        Some(Value::String(name)) => name.to_ascii_uppercase(),
        Some(other) => return Err(format!("`camera_model` is {other}, expected a string").into()),
    };
    let is_fisheye =
        value("is_fisheye").is_some_and(|v| v.as_bool().unwrap_or_else(|| v.as_f64().is_some_and(|v| v != 0.0)));
    let model = if is_fisheye { Some(LensModel::OpenCvFisheye) } else { LensModel::from_name(&name) };
    let coefficients = [k(0)?, k(1)?, coefficient("p1")?, coefficient("p2")?, k(2)?, k(3)?, k(4)?, k(5)?];
    if !coefficients.iter().all(|c| c.is_finite()) {
        return Err("a distortion coefficient is not finite".to_owned().into());
    }
    let [k1, k2, p1, p2, k3, k4, ..] = coefficients;
    match model {
        Some(LensModel::OpenCvFisheye | LensModel::SimpleRadialFisheye | LensModel::RadialFisheye) => {
            Ok((LensModel::OpenCvFisheye, [k1, k2, k3, k4, 0.0, 0.0, 0.0, 0.0]))
        }
        Some(LensModel::FullOpenCv) => Ok((LensModel::FullOpenCv, coefficients)),
        Some(
            LensModel::SimplePinhole
            | LensModel::Pinhole
            | LensModel::SimpleRadial
            | LensModel::Radial
            | LensModel::OpenCv,
        ) => {
            let model = if k4 != 0.0 {
                LensModel::Perspective
            } else if k3 != 0.0 {
                LensModel::FullOpenCv
            } else if [k1, k2, p1, p2] != [0.0; 4] {
                LensModel::OpenCv
            } else {
                LensModel::Pinhole
            };
            Ok((model, [k1, k2, p1, p2, k3, k4, 0.0, 0.0]))
        }
        Some(LensModel::Fov | LensModel::ThinPrismFisheye | LensModel::Perspective) | None => {
            Err(Problem::Model(format!(
                "the camera model {name} is not supported in transforms files; supported are SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, \
             RADIAL, OPENCV, FULL_OPENCV, SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE and OPENCV_FISHEYE"
            )))
        }
    }
}

/// The number under `key`; absent and null are `None`.
fn number(keys: &Map<String, Value>, key: &str) -> Result<Option<f64>, String> {
    match keys.get(key) {
        None | Some(Value::Null) => Ok(None),
        Some(value) => value.as_f64().map(Some).ok_or_else(|| format!("`{key}` is {value}, expected a number")),
    }
}

/// An image side; instant-ngp writes it as a float.
fn side(key: &str, value: f64) -> Result<u32, String> {
    let rounded = value.round();
    if (value - rounded).abs() < 1e-3 && (1.0..=f64::from(super::super::locate::MAX_SIDE)).contains(&rounded) {
        Ok(rounded as u32)
    } else {
        Err(format!("`{key}` is {value}, expected a whole number of pixels"))
    }
}
