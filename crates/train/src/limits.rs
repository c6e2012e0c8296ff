//! What a run will need at its largest, against what the device has.

use crate::config::Config;
#[cfg(feature = "gpu")]
use crate::config::StrategyKind;
use crate::error::Result;
use burn::tensor::Device;
use gazesplat_core::GaussianCloud;
use gazesplat_core::io::images::ImageCache;
#[cfg(feature = "gpu")]
use gazesplat_core::sh;

/// Refuses before any work what a GPU cannot hold at the end of the run: the model at its largest, the largest image.
#[cfg(feature = "gpu")]
pub(crate) fn check_limits(cloud: &GaussianCloud, images: &ImageCache, config: &Config, device: &Device) -> Result<()> {
    let Some(gpu) = gazesplat_render::gpu::Gpu::from_device(device) else { return Ok(()) };
    let num_gaussians = match config.densify.strategy {
        StrategyKind::Mcmc => cloud.len().max(config.densify.cap),
        StrategyKind::None => cloud.len(),
    };
    gpu.check_model(num_gaussians, sh::num_coefficients(cloud.sh_degree.max(config.model.sh_degree)))?;
    for view in images.views() {
        let pinhole = &view.camera.intrinsics;
        let shape = [pinhole.height as usize, pinhole.width as usize, 4];
        gpu.check_size("bytes of the image", &shape, burn::tensor::DType::F32)?;
    }
    Ok(())
}

/// A CPU has no limits but its memory.
#[cfg(not(feature = "gpu"))]
pub(crate) fn check_limits(_: &GaussianCloud, _: &ImageCache, _: &Config, _: &Device) -> Result<()> {
    Ok(())
}
