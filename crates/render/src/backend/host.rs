//! Host slices of tensors on the CPU backends: the seam between Burn and the slice kernels.

use burn::backend::{
    Backend, NdArray, TensorMetadata,
    ndarray::NdArrayTensor,
    tensor::{FloatTensor, IntTensor},
};
use burn::tensor::TensorData;
use std::borrow::Cow;

/// A CPU backend whose `f32` and `i32` tensors can be read, written and built as slices, in C order.
///
/// The kernels in [`crate::kernels::cpu`] know only slices; with this trait one implementation of an operation serves
/// every CPU backend. Reading is free for contiguous tensors, building is free, and writing is in place when the
/// tensor is not shared.
pub trait HostTensors: Backend {
    /// The values of `tensor` in C order; copied only if they are not contiguous.
    fn f32_slice(tensor: &FloatTensor<Self>) -> Cow<'_, [f32]>;
    /// The values of `tensor` in C order for writing; copied first if the tensor is shared or not contiguous.
    fn f32_slice_mut(tensor: &mut FloatTensor<Self>) -> &mut [f32];
    /// The values of `tensor` in C order as a vector; free if the tensor is unshared and contiguous.
    fn f32_into_vec(tensor: FloatTensor<Self>) -> Vec<f32>;
    /// A tensor of shape `shape` that owns `data`, in C order.
    fn f32_tensor(data: Vec<f32>, shape: &[usize]) -> FloatTensor<Self>;
    /// The values of the 32-bit integer `tensor` in C order; copied only if they are not contiguous.
    fn i32_slice(tensor: &IntTensor<Self>) -> Cow<'_, [i32]>;
    /// A 32-bit integer tensor of shape `shape` that owns `data`, in C order.
    fn i32_tensor(data: Vec<i32>, shape: &[usize]) -> IntTensor<Self>;
}

/// Shape of a primitive float tensor of any backend.
pub fn shape_of<B: Backend>(tensor: &FloatTensor<B>) -> Vec<usize> {
    tensor.shape().iter().copied().collect()
}

impl HostTensors for NdArray {
    fn f32_slice(tensor: &NdArrayTensor) -> Cow<'_, [f32]> {
        let NdArrayTensor::F32(storage) = tensor else {
            panic!("splat parameters are f32, found {:?}", tensor.dtype())
        };
        ndarray_slice(storage.view())
    }

    fn f32_slice_mut(tensor: &mut NdArrayTensor) -> &mut [f32] {
        let NdArrayTensor::F32(storage) = tensor else { panic!("splat parameters are f32") };
        let array = storage.ensure_owned();
        if !array.is_standard_layout() {
            *array = array.as_standard_layout().into_owned().into_shared();
        }
        array.as_slice_mut().expect("standard layout was just ensured")
    }

    fn f32_into_vec(tensor: NdArrayTensor) -> Vec<f32> {
        let NdArrayTensor::F32(storage) = tensor else { panic!("splat parameters are f32") };
        let array = storage.into_owned();
        if array.is_standard_layout() && array.is_unique() {
            let len = array.len();
            let (mut data, offset) = array.into_owned().into_raw_vec_and_offset();
            if offset.unwrap_or(0) == 0 {
                data.truncate(len);
                return data;
            }
            return data[offset.unwrap_or(0)..][..len].to_vec();
        }
        array.iter().copied().collect()
    }

    fn f32_tensor(data: Vec<f32>, shape: &[usize]) -> NdArrayTensor {
        NdArrayTensor::from_data(TensorData::new(data, shape.to_vec()))
    }

    fn i32_slice(tensor: &NdArrayTensor) -> Cow<'_, [i32]> {
        let NdArrayTensor::I32(storage) = tensor else { panic!("index tensors are i32, found {:?}", tensor.dtype()) };
        ndarray_slice(storage.view())
    }

    fn i32_tensor(data: Vec<i32>, shape: &[usize]) -> NdArrayTensor {
        NdArrayTensor::from_data(TensorData::new(data, shape.to_vec()))
    }
}

/// The slice behind a contiguous view, or a copy in C order.
fn ndarray_slice<T: Copy>(view: ndarray::ArrayView<'_, T, ndarray::IxDyn>) -> Cow<'_, [T]> {
    match view.to_slice() {
        Some(slice) => Cow::Borrowed(slice),
        None => Cow::Owned(view.iter().copied().collect()),
    }
}

#[cfg(feature = "flex")]
mod flex {
    use super::{Cow, HostTensors, TensorData};
    use burn::backend::{Flex, flex::FlexTensor};

    impl HostTensors for Flex {
        fn f32_slice(tensor: &FlexTensor) -> Cow<'_, [f32]> {
            match tensor.as_slice::<f32>() {
                Some(slice) => Cow::Borrowed(slice),
                None => {
                    Cow::Owned(tensor.to_contiguous().as_slice::<f32>().expect("contiguous by construction").to_vec())
                }
            }
        }

        fn f32_slice_mut(tensor: &mut FlexTensor) -> &mut [f32] {
            if tensor.as_slice::<f32>().is_none() {
                *tensor = tensor.to_contiguous();
            }
            tensor.storage_mut::<f32>()
        }

        fn f32_into_vec(tensor: FlexTensor) -> Vec<f32> {
            tensor.into_data().try_into_vec().expect("splat parameters are f32")
        }

        fn f32_tensor(data: Vec<f32>, shape: &[usize]) -> FlexTensor {
            FlexTensor::from_data(TensorData::new(data, shape.to_vec()))
        }

        fn i32_slice(tensor: &FlexTensor) -> Cow<'_, [i32]> {
            match tensor.as_slice::<i32>() {
                Some(slice) => Cow::Borrowed(slice),
                None => {
                    Cow::Owned(tensor.to_contiguous().as_slice::<i32>().expect("contiguous by construction").to_vec())
                }
            }
        }

        fn i32_tensor(data: Vec<i32>, shape: &[usize]) -> FlexTensor {
            FlexTensor::from_data(TensorData::new(data, shape.to_vec()))
        }
    }
}
