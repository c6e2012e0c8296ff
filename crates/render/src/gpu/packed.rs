//! The five parameter tensors of a model in one allocation.
//!
//! A kernel may be given eight buffers; what reads or writes all parameters at once (the gradient of the projection,
//! Adam) would need more. So they lie one behind the other in one buffer, in the order of [`Parameters`], each aligned
//! as bindings must be, and the tensors are views of it.

use super::{Gpu, contiguous, cube_dim};
use crate::backend::Parameters;
use crate::error::Result;
use burn::tensor::{DType, Shape};
use burn_cubecl::{CubeBackend, tensor::CubeTensor};
use cubecl::prelude::*;

/// Alignment of a section in values: 256 bytes, the strictest any graphics API asks of a binding.
const ALIGNMENT: usize = 64;

/// Where the sections of a packed buffer lie, in values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PackedLayout {
    /// Number of Gaussians N.
    pub num_rows: usize,
    /// SH coefficients stored per Gaussian and channel, K.
    pub num_coefficients: usize,
    /// First value of means, quats, log scales, opacity logits, SH; then the length of the whole.
    pub offsets: [usize; 6],
}

impl PackedLayout {
    /// The layout for N Gaussians of K coefficients.
    pub fn new(num_rows: usize, num_coefficients: usize) -> Self {
        let mut offsets = [0; 6];
        for (g, width) in Self::widths_of(num_coefficients).into_iter().enumerate() {
            offsets[g + 1] = (offsets[g] + num_rows * width).next_multiple_of(ALIGNMENT);
        }
        Self { num_rows, num_coefficients, offsets }
    }

    fn widths_of(num_coefficients: usize) -> [usize; 5] {
        [3, 4, 3, 1, 3 * num_coefficients]
    }

    /// Values per row of each section.
    pub fn widths(&self) -> [usize; 5] {
        Self::widths_of(self.num_coefficients)
    }

    /// Values of the whole buffer.
    pub fn len(&self) -> usize {
        self.offsets[5]
    }

    /// True if there is no Gaussian.
    pub fn is_empty(&self) -> bool {
        self.num_rows == 0
    }

    fn shapes(&self) -> [Vec<usize>; 5] {
        let n = self.num_rows;
        [vec![n, 3], vec![n, 4], vec![n, 3], vec![n], vec![n, self.num_coefficients, 3]]
    }

    /// The sections of `whole` as tensors.
    pub fn views(&self, whole: &CubeTensor) -> Parameters<CubeBackend> {
        let widths = self.widths();
        let size = whole.handle.size();
        let [means, quats, log_scales, opacity_logits, sh] = std::array::from_fn(|g| {
            let (start, len) = (self.offsets[g], self.num_rows * widths[g]);
            // An empty section still has to name a byte.
            let len = len.max(1);
            let used = whole.handle.offset_start.unwrap_or(0);
            let handle = whole.handle.clone().offset_start(4 * start as u64);
            let end = size - used - whole.handle.offset_end.unwrap_or(0) - 4 * (start + len) as u64;
            CubeTensor::new_contiguous(
                whole.client.clone(),
                whole.device.clone(),
                Shape::from(self.shapes()[g].clone()),
                handle.offset_end(end),
                DType::F32,
            )
        });
        Parameters { means, quats, log_scales, opacity_logits, sh }
    }

    /// The buffer that `parameters` are the sections of: their own if they are views of one, else a packed copy.
    ///
    /// # Errors
    /// [`crate::Error::Limit`] when the copy is larger than the adapter takes.
    pub fn pack(gpu: &Gpu, parameters: Parameters<CubeBackend>) -> Result<(Self, CubeTensor)> {
        let num_rows = parameters.opacity_logits.meta.shape()[0];
        let layout = Self::new(num_rows, parameters.sh.meta.shape()[1]);
        let parts = sections(parameters);
        let base = parts[0].handle.clone();
        let start = base.offset_start.unwrap_or(0);
        let is_view = parts.iter().enumerate().all(|(g, part)| {
            let handle = &part.handle;
            part.is_contiguous()
                && num_rows > 0
                && handle.memory.descriptor() == base.memory.descriptor()
                && handle.offset_start.unwrap_or(0) == start + 4 * layout.offsets[g] as u64
        }) && start + 4 * layout.len() as u64 <= base.size();
        if is_view {
            let mut handle = base;
            handle.offset_start = (start > 0).then_some(start);
            let end = handle.size() - start - 4 * layout.len() as u64;
            handle.offset_end = (end > 0).then_some(end);
            let [first, ..] = parts;
            let shape = Shape::from(vec![layout.len()]);
            let whole = CubeTensor::new_contiguous(first.client, first.device, shape, handle, DType::F32);
            return Ok((layout, whole));
        }
        let whole = gpu.empty("bytes of packed parameters", &[layout.len()], DType::F32)?;
        for (g, part) in parts.into_iter().enumerate() {
            let len = num_rows * layout.widths()[g];
            let (part, start) = (contiguous(part), layout.offsets[g]);
            copy_section::launch(
                &gpu.client,
                gpu.units(len.max(1)),
                cube_dim(),
                part.into_buffer_arg(),
                whole.clone().into_buffer_arg(),
                start as u32,
                len as u32,
            );
        }
        Ok((layout, whole))
    }
}

/// The tensors in the order of the sections.
pub fn sections(p: Parameters<CubeBackend>) -> [CubeTensor; 5] {
    [p.means, p.quats, p.log_scales, p.opacity_logits, p.sh]
}

#[cube(launch)]
fn copy_section(from: &[f32], to: &mut [f32], start: u32, len: u32) {
    if ABSOLUTE_POS < len as usize {
        to[start as usize + ABSOLUTE_POS] = from[ABSOLUTE_POS];
    }
}

#[cfg(test)]
mod tests {
    use super::PackedLayout;

    #[test]
    fn sections_are_aligned_and_disjoint() {
        for (n, k) in [(0, 1), (1, 1), (7, 4), (1000, 16)] {
            let layout = PackedLayout::new(n, k);
            for g in 0..5 {
                assert_eq!(layout.offsets[g] % 64, 0);
                assert!(layout.offsets[g] + n * layout.widths()[g] <= layout.offsets[g + 1]);
            }
        }
    }
}
