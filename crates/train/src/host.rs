//! Values of tensors on the host.

use crate::error::Result;
use burn::tensor::Tensor;

/// Waits for the device and takes the values of a float tensor, in C order; free for a contiguous, unshared tensor on the
/// CPU.
///
/// # Errors
/// [`gazesplat_render::Error::Device`] when a GPU was lost, has no memory left, or refused a kernel on the way.
pub(crate) fn read<const D: usize>(tensor: Tensor<D>) -> Result<Vec<f32>> {
    let stopped = |error: &dyn std::fmt::Display| gazesplat_render::Error::device(error);
    // Burn copies from a device on first access: either step may be the one that waits for it and finds it lost.
    let data = tensor.try_into_data().map_err(|error| stopped(&error))?;
    Ok(data.try_into_vec().map_err(|error| stopped(&error))?)
}
