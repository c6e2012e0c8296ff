//! Working on a GPU: buffers, sizes of dispatches, and what an adapter must have.
//!
//! [`Gpu`] is a client of one adapter. Everything it allocates is contiguous; an allocation that is larger than the
//! adapter takes is refused before any work with [`Error::Limit`]. Work is queued; only [`Gpu::read_u32`] and
//! [`Gpu::read_f32`] wait for it, and they are where a lost adapter or a full memory shows.

use crate::error::{Error, Result};
use crate::layout::lane;
use burn::backend::DispatchDevice;
use burn::tensor::{DType, Device, Shape};
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::ops::numeric::{empty_device_contiguous_dtype, zeros_client};
use burn_cubecl::{CubeDevice, tensor::CubeTensor};
use cubecl::client::Client;
use cubecl::prelude::*;
use cubecl::server::CubeCountSelection;

pub mod packed;

/// Units (threads) of every workgroup: a tile's pixels. Every desktop adapter and WebGPU's defaults have that many.
pub const UNITS: u32 = 256;

/// Storage buffers a kernel of ours is given at most, with the one that carries its sizes: WebGPU's default.
pub const MAX_BUFFERS: u32 = 8;

/// Workgroup memory that the largest kernel, the backward rasteriser, takes, bytes. Above WebGPU's default of 16 KiB, with
/// which it would reduce four splats at a time instead of eight; below the 32 KiB that Metal and DirectX 12 guarantee and
/// the Vulkan drivers tried here have.
pub const SHARED_BYTES: usize = 20_804;

/// Where kernels are launched and buffers live.
#[derive(Clone)]
pub struct Gpu {
    /// The queue of the adapter.
    pub client: Client,
    device: CubeDevice,
}

impl Gpu {
    /// The adapter that `tensor` lives on.
    pub fn of(tensor: &CubeTensor) -> Self {
        Self { client: tensor.client.clone(), device: tensor.device.clone() }
    }

    /// The adapter behind a device; `None` for a CPU.
    pub fn from_device(device: &Device) -> Option<Self> {
        fn inner(device: &DispatchDevice) -> Option<&CubeDevice> {
            match device {
                DispatchDevice::Cube(device) => Some(device),
                DispatchDevice::Autodiff(device) => inner(device),
                _ => None,
            }
        }
        inner(device.as_dispatch()).map(|device| Self { client: device.client(), device: device.clone() })
    }

    /// A buffer of `shape` with undefined content; `what` names it should it be too large.
    ///
    /// # Errors
    /// [`Error::Limit`] when it is larger than the adapter takes.
    pub fn empty(&self, what: &'static str, shape: &[usize], dtype: DType) -> Result<CubeTensor> {
        self.check_size(what, shape, dtype)?;
        Ok(self.filled(shape, |shape| {
            empty_device_contiguous_dtype(self.client.clone(), self.device.clone(), shape, dtype)
        }))
    }

    /// A buffer of `shape` filled with zeros.
    ///
    /// # Errors
    /// As [`Gpu::empty`].
    pub fn zeros(&self, what: &'static str, shape: &[usize], dtype: DType) -> Result<CubeTensor> {
        self.check_size(what, shape, dtype)?;
        Ok(self.filled(shape, |shape| zeros_client(self.client.clone(), self.device.clone(), shape, dtype)))
    }

    /// A tensor of `shape` on what `make` allocates: never nothing, since no buffer can be bound that holds no byte.
    fn filled(&self, shape: &[usize], make: impl FnOnce(Shape) -> CubeTensor) -> CubeTensor {
        let len = shape.iter().product::<usize>();
        let tensor = make(Shape::from(vec![len.max(1)]));
        let (handle, dtype) = (tensor.handle, tensor.dtype);
        CubeTensor::new_contiguous(self.client.clone(), self.device.clone(), Shape::from(shape.to_vec()), handle, dtype)
    }

    /// Checks that the adapter takes a buffer of that size.
    ///
    /// # Errors
    /// [`Error::Limit`].
    pub fn check_size(&self, what: &'static str, shape: &[usize], dtype: DType) -> Result<()> {
        let size = dtype.size() as u64;
        let needed = shape.iter().fold(size, |bytes, &d| bytes.saturating_mul(d as u64));
        // Kernels index values with 32 bits, however large the buffers of the adapter are.
        let limit = self.client.properties().memory.max_page_size.min(size * u64::from(u32::MAX));
        match needed > limit {
            true => Err(Error::Limit { what, needed, limit }),
            false => Ok(()),
        }
    }

    /// Checks that a model of `num_gaussians` with `num_coefficients` SH coefficients per channel can be drawn and trained:
    /// the buffers whose size is known from these two.
    ///
    /// # Errors
    /// [`Error::Limit`].
    pub fn check_model(&self, num_gaussians: usize, num_coefficients: usize) -> Result<()> {
        self.check_size("bytes of projected lanes", &[num_gaussians, lane::COUNT], DType::F32)?;
        let num_values = packed::PackedLayout::new(num_gaussians, num_coefficients).len() + 4 * num_gaussians;
        self.check_size("bytes of all parameters of the model", &[num_values], DType::F32)
    }

    /// Uploads words as a `u32` buffer of `shape`.
    pub fn upload_u32(&self, words: &[u32], shape: &[usize]) -> CubeTensor {
        let words = if words.is_empty() { &[0][..] } else { words };
        let handle = self.client.create_from_slice(bytemuck::cast_slice(words));
        let shape = Shape::from(shape.to_vec());
        CubeTensor::new_contiguous(self.client.clone(), self.device.clone(), shape, handle, DType::U32)
    }

    /// Uploads values as an `f32` buffer of `shape`.
    pub fn upload_f32(&self, values: &[f32], shape: &[usize]) -> CubeTensor {
        let values = if values.is_empty() { &[0.0][..] } else { values };
        let handle = self.client.create_from_slice(bytemuck::cast_slice(values));
        let shape = Shape::from(shape.to_vec());
        CubeTensor::new_contiguous(self.client.clone(), self.device.clone(), shape, handle, DType::F32)
    }

    /// Waits for the queue and downloads a `u32` buffer.
    ///
    /// # Errors
    /// [`Error::Device`] when the adapter was lost, has no memory left, or refused a kernel on the way.
    pub fn read_u32(&self, tensor: &CubeTensor) -> Result<Vec<u32>> {
        self.read(tensor)
    }

    /// Waits for the queue and downloads an `f32` buffer.
    ///
    /// # Errors
    /// As [`Gpu::read_u32`].
    pub fn read_f32(&self, tensor: &CubeTensor) -> Result<Vec<f32>> {
        self.read(tensor)
    }

    /// Waits for the queue once and downloads several `u32` buffers.
    ///
    /// # Errors
    /// As [`Gpu::read_u32`].
    pub fn read_all_u32<const N: usize>(&self, tensors: [&CubeTensor; N]) -> Result<[Vec<u32>; N]> {
        let handles = tensors.iter().map(|t| t.handle.clone()).collect();
        let read = self.client.read(handles).map_err(|e| Error::device(&e))?;
        let words = |(bytes, tensor): (&[u8], &CubeTensor)| {
            let values = bytes.chunks_exact(4).take(tensor.meta.num_elements());
            values.map(bytemuck::pod_read_unaligned).collect()
        };
        let mut all = read.iter().map(|bytes| &bytes[..]).zip(tensors).map(words);
        Ok(std::array::from_fn(|_| all.next().unwrap_or_default()))
    }

    fn read<T: bytemuck::AnyBitPattern>(&self, tensor: &CubeTensor) -> Result<Vec<T>> {
        let len = tensor.meta.num_elements();
        if len == 0 {
            return Ok(Vec::new());
        }
        let bytes = self.client.read_one(tensor.handle.clone()).map_err(|e| Error::device(&e))?;
        let size = size_of::<T>();
        Ok(bytes.chunks_exact(size).take(len).map(bytemuck::pod_read_unaligned).collect())
    }

    /// A dispatch of at least `num_cubes` workgroups, spread over three axes where one is too short: kernels compare
    /// `CUBE_POS` or `ABSOLUTE_POS` with their size.
    pub fn cubes(&self, num_cubes: usize) -> CubeCount {
        CubeCountSelection::new(&self.client, num_cubes as u32).cube_count()
    }

    /// A dispatch of at least `num_units` units in workgroups of [`UNITS`].
    pub fn units(&self, num_units: usize) -> CubeCount {
        self.cubes(num_units.div_ceil(UNITS as usize))
    }
}

/// The shape of every workgroup.
pub fn cube_dim() -> CubeDim {
    CubeDim::new_1d(UNITS)
}

/// The tensor with its values in C order, copied only if they are not.
pub fn contiguous(tensor: CubeTensor) -> CubeTensor {
    into_contiguous(tensor)
}

/// Checks that an opened adapter has what every kernel needs.
///
/// # Errors
/// As [`check_limits`].
pub(crate) fn check_device(device: &Device) -> Result<()> {
    let Some(gpu) = Gpu::from_device(device) else { return Ok(()) };
    let has = &gpu.client.properties().hardware;
    // The client has kept one buffer for the sizes of the others.
    let units = has.max_units_per_cube.min(has.max_cube_dim.0);
    check_limits(units, has.max_bindings.saturating_add(1), has.max_shared_memory_size)
}

/// Checks that an adapter with so many units and so many bytes of memory in a workgroup, and so many storage buffers in
/// a kernel, has what every kernel needs.
///
/// # Errors
/// [`Error::Limit`] naming the first thing it has too little of.
pub fn check_limits(units: u32, buffers: u32, shared_bytes: usize) -> Result<()> {
    let limits = [
        ("units of a workgroup", u64::from(UNITS), u64::from(units)),
        ("storage buffers of a kernel", u64::from(MAX_BUFFERS), u64::from(buffers)),
        ("bytes of workgroup memory", SHARED_BYTES as u64, shared_bytes as u64),
    ];
    match limits.into_iter().find(|(_, needed, limit)| needed > limit) {
        Some((what, needed, limit)) => Err(Error::Limit { what, needed, limit }),
        None => Ok(()),
    }
}

/// The device functions that kernels of several files use.
#[expect(missing_docs, reason = "what the kernel macros generate carries no documentation")]
pub mod device_fn {
    use cubecl::prelude::*;

    /// True if `x` is neither infinite nor NaN. By its bits: shader compilers may assume that neither exists.
    #[cube]
    pub fn is_finite(x: f32) -> bool {
        (u32::reinterpret(x) & 0x7f80_0000u32) != 0x7f80_0000u32
    }
}

#[cfg(test)]
mod tests {
    use super::{Error, SHARED_BYTES, check_limits};

    #[test]
    fn what_metal_and_directx_guarantee_suffices_and_less_is_named() {
        assert_eq!(check_limits(256, 8, 32_768), Ok(()));
        for (units, buffers, shared, named) in [
            (128, 8, 32_768, ("units of a workgroup", 256, 128)),
            (256, 4, 32_768, ("storage buffers of a kernel", 8, 4)),
            (256, 8, 16_384, ("bytes of workgroup memory", SHARED_BYTES as u64, 16_384)),
        ] {
            let (what, needed, limit) = named;
            assert_eq!(check_limits(units, buffers, shared), Err(Error::Limit { what, needed, limit }));
        }
    }
}
