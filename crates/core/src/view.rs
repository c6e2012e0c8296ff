//! One posed photograph of a scene.

use crate::camera::{Camera, distortion::LensDistortion};
use std::path::PathBuf;

/// A photograph (or the place of one) with its camera. The image is decoded on demand, see [`crate::io::images`].
#[derive(Debug, Clone)]
pub struct View {
    /// File name relative to the image directory, with its extension: the key of the train/test split.
    pub name: String,
    /// Pinhole camera at the size the image will have once undistorted and downscaled to `data.max_side`.
    pub camera: Camera,
    /// Image file; `None` for a bare camera (camera paths, `cameras.json` without photographs).
    pub image_path: Option<PathBuf>,
    /// Calibration of the photograph as taken, when it has lens distortion: removed while decoding.
    pub distortion: Option<LensDistortion>,
    /// Single-channel mask beside the image: 0 = carries no loss.
    pub mask_path: Option<PathBuf>,
}
