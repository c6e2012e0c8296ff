//! What is measured of images beside PSNR and SSIM: FLIP always, LPIPS where its weights are given.

use super::device::ComputeDevice;
use crate::diagnostics::Result;
use gazesplat_fovea::flip::{Flip, FlipMetric, PIXELS_PER_DEGREE};
use gazesplat_fovea::lpips::Lpips;
use gazesplat_render::device::Device;
use gazesplat_train::metrics::ImageMetric;
use std::path::Path;

/// The metrics, ready.
#[derive(Debug)]
pub(crate) struct Perceptual {
    /// FLIP for an observer at the published distance.
    pub flip: FlipMetric,
    lpips: Option<Lpips>,
}

impl Perceptual {
    /// FLIP, and LPIPS with the weights in `weights`, if that names a file; on `device`.
    ///
    /// # Errors
    /// When the file is not what it has to be.
    pub fn new(weights: Option<&Path>, device: &ComputeDevice) -> Result<Self> {
        Ok(Self { flip: FlipMetric(Flip::new(PIXELS_PER_DEGREE)?), lpips: lpips(weights, device)? })
    }

    /// All of them.
    pub fn metrics(&self) -> Vec<&dyn ImageMetric> {
        let lpips = self.lpips.as_ref().map(|lpips| lpips as &dyn ImageMetric);
        [&self.flip as &dyn ImageMetric].into_iter().chain(lpips).collect()
    }
}

/// LPIPS with the weights in `weights`, if that names a file, on `device`.
///
/// # Errors
/// When the file is not what it has to be.
pub(crate) fn lpips(weights: Option<&Path>, device: &ComputeDevice) -> Result<Option<Lpips>> {
    let Some(path) = weights.filter(|path| !path.as_os_str().is_empty()) else { return Ok(None) };
    device.guard(|| Ok(Some(Lpips::load(path, &tensors(device))?)))
}

/// Where the network computes: on the CPU through Burn's successor of ndarray, where this build has it, whose convolution is
/// a product of matrices and not a plain loop.
fn tensors(device: &ComputeDevice) -> Device {
    #[cfg(feature = "flex")]
    if !device.is_gpu() {
        return gazesplat_render::device::flex_device();
    }
    device.tensors().clone()
}
