//! Values of tensors on the host.

use crate::error::Result;
use burn::tensor::Tensor;

/// Waits for the device and takes the values of a float tensor, in C order; free for a contiguous, unshared tensor on the
/// CPU.
///
/// # Errors
/// [`gazesplat_render::Error::Device`] when a GPU was lost, has no memory left, or refused a kernel on the way.
pub(crate) fn read<const D: usize>(tensor: Tensor<D>) -> Result<Vec<f32>> {
    let data = tensor.try_into_data().map_err(|error| gazesplat_render::Error::device(&error))?;
    Ok(data.try_into_vec().expect("every tensor of this crate is f32"))
}
