//! What a run will need at its largest, against what the device has.

use crate::config::Config;
#[cfg(feature = "gpu")]
use crate::config::StrategyKind;
use crate::error::Result;
use burn::tensor::Device;
use gazesplat_core::io::images::ImageCache;
#[cfg(feature = "gpu")]
use gazesplat_core::sh;

/// Refuses before any work what a GPU cannot hold at the end of the run: the model at its largest, the largest image. The
/// model has `num_rows` Gaussians with `num_coefficients` each now.
#[cfg(feature = "gpu")]
pub(crate) fn check_limits(
    (num_rows, num_coefficients): (usize, usize),
    images: &ImageCache,
    config: &Config,
    device: &Device,
) -> Result<()> {
    let Some(gpu) = gazesplat_render::gpu::Gpu::from_device(device) else { return Ok(()) };
    let num_gaussians = match config.densify.strategy {
        StrategyKind::Mcmc | StrategyKind::Adc => num_rows.max(config.densify.cap),
        StrategyKind::None => num_rows,
    };
    gpu.check_model(num_gaussians, num_coefficients.max(sh::num_coefficients(config.model.sh_degree)))?;
    for view in images.views() {
        let pinhole = &view.camera.intrinsics;
        let shape = [pinhole.height as usize, pinhole.width as usize, 4];
        gpu.check_size("bytes of the image", &shape, burn::tensor::DType::F32)?;
    }
    Ok(())
}

/// A CPU has no limits but its memory.
#[cfg(not(feature = "gpu"))]
pub(crate) fn check_limits(_: (usize, usize), _: &ImageCache, _: &Config, _: &Device) -> Result<()> {
    Ok(())
}
