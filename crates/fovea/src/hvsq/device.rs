//! A reference that lives on a GPU, and comparisons with it: of images on the host, and of tensors that never leave the
//! adapter.

use super::{Hvsq, ImageView};
use crate::error::Result;
use crate::kernels::cpu::hvsq::Regions as HostRegions;
use crate::kernels::gpu::hvsq::{Found, Plan, Regions, Statistics, Wanted};
use burn_cubecl::tensor::CubeTensor;
use gazesplat_render::gpu::Gpu;

/// Statistics on a GPU and what compares others with them.
pub(crate) struct DeviceReference {
    plan: Plan,
    statistics: Statistics,
}

impl std::fmt::Debug for DeviceReference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("DeviceReference").field("statistics", &self.statistics).finish_non_exhaustive()
    }
}

impl DeviceReference {
    /// The statistics of an image of a checked size.
    pub fn new(gpu: &Gpu, hvsq: &Hvsq, image: ImageView<'_, f32>) -> Result<Self> {
        let size = (image.width, image.height);
        let plan = Plan::new(gpu, size, &hvsq.bank, &hvsq.pooling, hvsq.distance);
        let statistics = plan.statistics(&upload(gpu, &image))?;
        Ok(Self { plan, statistics })
    }

    /// Memory of the statistics, bytes.
    pub fn num_bytes(&self) -> usize {
        self.statistics.num_bytes()
    }

    /// The adapter.
    pub fn gpu(&self) -> &Gpu {
        self.plan.gpu()
    }

    /// Compares a tensor `[height, width, 3 or more]` of the size of the reference, contiguous: nothing is waited for.
    pub fn compare(&self, image: &CubeTensor, gradient: bool) -> Result<Found> {
        Ok(self.plan.compare(&self.statistics, image, Wanted { gradient, region: None })?)
    }

    /// The value of an image on the host, and its gradient (empty when not wanted).
    pub fn value(&self, image: ImageView<'_, f32>, gradient: bool) -> Result<(f64, Vec<f32>)> {
        let gpu = self.gpu();
        let found = self.compare(&upload(gpu, &image), gradient)?;
        let v_image = found.v_image.map_or_else(|| Ok(Vec::new()), |v| gpu.read_f32(&v))?;
        Ok((f64::from(gpu.read_f32(&found.value)?[0]), v_image))
    }

    /// The value of region `k`, which has pixels.
    pub fn region(&self, image: ImageView<'_, f32>, regions: &HostRegions<f32>, k: usize) -> Result<f64> {
        let gpu = self.gpu();
        let region = Regions::new(gpu, regions, k);
        let wanted = Wanted { gradient: false, region: Some(&region) };
        let found = self.plan.compare(&self.statistics, &upload(gpu, &image), wanted)?;
        Ok(f64::from(gpu.read_f32(&found.value)?[0]))
    }
}

fn upload(gpu: &Gpu, image: &ImageView<'_, f32>) -> CubeTensor {
    gpu.upload_f32(image.data, &[image.height, image.width, image.channels])
}
