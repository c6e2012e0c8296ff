//! Parts of an image over which means are taken: the weights of one of them, uploaded.

use crate::kernels::cpu::hvsq::Regions as HostRegions;
use burn_cubecl::tensor::CubeTensor;
use gazesplat_render::gpu::Gpu;

/// One region, as weights on every level.
#[derive(Debug, Clone)]
pub(crate) struct Regions {
    /// By level: `[height, width]`.
    pub(super) weights: Vec<CubeTensor>,
    /// By level: the sum of the weights.
    pub(super) totals: Vec<f64>,
}

impl Regions {
    /// Region `k` of `host`.
    pub fn new(gpu: &Gpu, host: &HostRegions<f32>, k: usize) -> Self {
        let upload = |weights: &[f32]| gpu.upload_f32(weights, &[weights.len()]);
        let (weights, totals) = host.levels(k).map(|(weights, total)| (upload(weights), total)).unzip();
        Self { weights, totals }
    }
}
