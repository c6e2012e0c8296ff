//! A Gaussian model as tensors.

use crate::error::{Error, Result};
use burn::tensor::{Device, Tensor, TensorData};
use gazesplat_core::GaussianCloud;

/// N Gaussians on a device, in the parametrisation of [`GaussianCloud`]: what is rendered and what is optimised.
#[derive(Debug, Clone)]
pub struct Splats {
    /// Centres, `[N, 3]`, world units.
    pub means: Tensor<2>,
    /// Rotations (w, x, y, z), unnormalised, `[N, 4]`.
    pub quats: Tensor<2>,
    /// Natural logarithms of the standard deviations, `[N, 3]`.
    pub log_scales: Tensor<2>,
    /// Logits of the opacities, `[N]`.
    pub opacity_logits: Tensor<1>,
    /// SH coefficients, `[N, (degree + 1)², 3]`.
    pub sh: Tensor<3>,
}

impl Splats {
    /// Uploads `cloud` to `device`.
    ///
    /// # Errors
    /// [`Error::Limit`] when a GPU takes no tensor of that size.
    pub fn from_cloud(cloud: &GaussianCloud, device: &Device) -> Result<Self> {
        let n = cloud.len();
        #[cfg(feature = "gpu")]
        if let Some(gpu) = crate::gpu::Gpu::from_device(device) {
            gpu.check_model(n, cloud.num_coefficients())?;
        }
        let flat = |rows: &[[f32; 3]]| rows.as_flattened().to_vec();
        let sh_shape = [n, cloud.num_coefficients(), 3];
        Ok(Self {
            means: Tensor::from_data(TensorData::new(flat(&cloud.means), [n, 3]), device),
            quats: Tensor::from_data(TensorData::new(cloud.quats.as_flattened().to_vec(), [n, 4]), device),
            log_scales: Tensor::from_data(TensorData::new(flat(&cloud.log_scales), [n, 3]), device),
            opacity_logits: Tensor::from_data(TensorData::new(cloud.opacity_logits.clone(), [n]), device),
            sh: Tensor::from_data(TensorData::new(flat(&cloud.sh), sh_shape), device),
        })
    }

    /// Downloads the model.
    ///
    /// # Errors
    /// [`Error::Device`] when a GPU does not answer.
    pub fn to_cloud(&self) -> Result<GaussianCloud> {
        fn values<const D: usize>(tensor: &Tensor<D>) -> Result<Vec<f32>> {
            let data = tensor.try_to_data().map_err(|e| Error::device(&e))?;
            // A GPU copies on the first access: that can fail, too.
            data.try_into_vec().map_err(|e| Error::device(&e))
        }
        fn rows<const D: usize, const W: usize>(tensor: &Tensor<D>) -> Result<Vec<[f32; W]>> {
            Ok(values(tensor)?.as_chunks().0.to_vec())
        }
        Ok(GaussianCloud {
            means: rows(&self.means)?,
            quats: rows(&self.quats)?,
            log_scales: rows(&self.log_scales)?,
            opacity_logits: values(&self.opacity_logits)?,
            sh_degree: self.sh_degree(),
            sh: rows(&self.sh)?,
        })
    }

    /// Number of Gaussians N.
    pub fn len(&self) -> usize {
        self.means.dims()[0]
    }

    /// True when there is no Gaussian.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// SH coefficients stored per Gaussian and channel.
    pub fn num_coefficients(&self) -> usize {
        self.sh.dims()[1]
    }

    /// Degree of the SH stored: the largest whose coefficients are there.
    pub fn sh_degree(&self) -> u32 {
        let stored = self.num_coefficients();
        (0..=gazesplat_core::sh::MAX_DEGREE)
            .rev()
            .find(|&d| gazesplat_core::sh::num_coefficients(d) <= stored)
            .unwrap_or(0)
    }

    /// Where the tensors live.
    pub fn device(&self) -> Device {
        self.means.device()
    }

    /// The same values as leaves of a fresh autodiff graph. The tensors must be on an autodiff device
    /// ([`Device::autodiff`]).
    #[must_use]
    pub fn require_grad(self) -> Self {
        Self {
            means: self.means.require_grad(),
            quats: self.quats.require_grad(),
            log_scales: self.log_scales.require_grad(),
            opacity_logits: self.opacity_logits.require_grad(),
            sh: self.sh.require_grad(),
        }
    }
}
