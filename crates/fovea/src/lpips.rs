//! LPIPS: how far apart a network that has learned to see finds two images (LPIPS: Zhang, Isola, Efros, Shechtman, Wang,
//! *The Unreasonable Effectiveness of Deep Features as a Perceptual Metric*, 2018), version 0.1 over VGG16.
//!
//! Both images go through the convolutions of VGG16. After each of its five blocks the features of a pixel are scaled to unit
//! length, the squared differences of the channels are weighted by learned numbers of at least 0 and summed (LPIPS Eq. 1),
//! and the mean over the pixels is taken; the distance is the sum over the blocks. The weights are the user's: nothing is
//! shipped. The widths of the network are those of the file.
//!
//! Both images are taken through the network together, so that features of one block at a time are held: at most five
//! times 64 numbers per pixel at the first block, 1.3 kB per pixel (2.2 GB for 1600 × 1066) beside what the backend's
//! convolution takes. No image is cut into tiles: zero padding at inner borders would change the value.

mod weights;

use crate::error::{Error, Result};
use burn::module::{Module, Param};
use burn::nn::PaddingConfig2d;
use burn::nn::conv::Conv2d;
use burn::tensor::activation::relu;
use burn::tensor::module::max_pool2d;
use burn::tensor::ops::MaxPoolOptions;
use burn::tensor::{Device, Tensor, TensorData};
use gazesplat_core::color::from_u8;
use gazesplat_core::image::ImageF32;
use gazesplat_train::losses::LossTarget;
use gazesplat_train::metrics::{ImageMetric, unmasked};
use std::path::Path;

/// Shortest side of an image, pixels: four times it is halved.
pub const MIN_SIDE: u32 = 16;

/// Indices of the convolutions among the `features` of VGG16 in torchvision, by block.
const CONVS: [&[usize]; 5] = [&[0, 2], &[5, 7], &[10, 12, 14], &[17, 19, 21], &[24, 26, 28]];

/// What is subtracted from colours −1…1, and what they are divided by then (the published implementation's scaling layer).
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
/// See [`SHIFT`].
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];

/// Added to the length of features, so that none is divided by zero.
const EPSILON: f32 = 1e-10;

/// The metric with its weights, on one device.
#[derive(Debug)]
pub struct Lpips {
    network: Network,
    device: Device,
}

/// The convolutions of VGG16 up to relu5_3, with what was learned for the metric.
#[derive(Module, Debug)]
struct Network {
    blocks: Vec<Block>,
}

/// Convolutions of 3 × 3 pixels, each followed by ReLU; between blocks the size is halved by the maximum of 2 × 2 pixels.
#[derive(Module, Debug)]
struct Block {
    convs: Vec<Conv2d>,
    /// Weights of the squared differences of the channels, `[C]`.
    lin: Param<Tensor<1>>,
}

impl Network {
    /// The distance of two images `[1, 3, H, W]`, scaled for the network; `[1]`.
    fn distance(&self, a: Tensor<4>, b: Tensor<4>) -> Tensor<1> {
        let mut pair = [a, b];
        let mut sum = Tensor::zeros([1], &pair[0].device());
        for (index, block) in self.blocks.iter().enumerate() {
            if index > 0 {
                let halves = || MaxPoolOptions::new([2, 2]).with_stride([2, 2]);
                pair = pair.map(|x| max_pool2d(x, halves()));
            }
            for conv in &block.convs {
                pair = pair.map(|x| relu(conv.forward(x)));
            }
            let [a, b] = pair.clone().map(unit);
            let difference = a - b;
            let num_channels = difference.dims()[1];
            let weights = block.lin.val().reshape([1, num_channels, 1, 1]);
            // Row by row and then over the rows: a single sum of a million numbers would lose digits.
            let mean = (difference.clone() * difference * weights).sum_dim(1).mean_dim(3).mean_dim(2);
            sum = sum + mean.reshape([1]);
        }
        sum
    }
}

/// Features `[1, C, H, W]` with the channels of every pixel scaled to unit length.
fn unit(features: Tensor<4>) -> Tensor<4> {
    let length = (features.clone() * features.clone()).sum_dim(1).sqrt();
    features / (length + EPSILON)
}

impl Lpips {
    /// Reads the weights from a safetensors file onto `device`: the convolutions under the names of torchvision
    /// (`features.0.weight`, …) or of the `lpips` package (`net.slice1.0.weight`, …), the weights of the channels as
    /// `lin0.model.1.weight` or `lins.0.model.1.weight`; 32-bit floats.
    ///
    /// # Errors
    /// [`Error::File`] when the file cannot be read, is no safetensors file, lacks a tensor, or one has another shape or type,
    /// a value that is not finite, or a negative weight of a channel.
    pub fn load(path: &Path, device: &Device) -> Result<Self> {
        let file = weights::WeightsFile::read(path)?;
        let mut width = 3;
        let mut blocks = Vec::with_capacity(CONVS.len());
        for (index, features) in CONVS.iter().enumerate() {
            let mut convs = Vec::with_capacity(features.len());
            for &feature in *features {
                let names = [format!("features.{feature}"), format!("net.slice{}.{feature}", index + 1)];
                let (kernel, shape) = file.conv(&names, width)?;
                let bias = file.vector(&names.map(|name| format!("{name}.bias")), &[shape[0]])?;
                width = shape[0];
                convs.push(Conv2d {
                    weight: Param::from_data(TensorData::new(kernel, shape), device),
                    bias: Some(Param::from_data(TensorData::new(bias, [width]), device)),
                    stride: [1, 1],
                    kernel_size: [3, 3],
                    dilation: [1, 1],
                    groups: 1,
                    padding: PaddingConfig2d::Explicit(1, 1, 1, 1),
                });
            }
            // Without the dropout of training the layer is the first of its sequence.
            let names = ["lin", "lins."].map(|lin| [1, 0].map(|at| format!("{lin}{index}.model.{at}.weight")));
            let lin = file.vector(names.as_flattened(), &[1, width, 1, 1])?;
            file.check_not_negative(names.as_flattened(), &lin)?;
            blocks.push(Block { convs, lin: Param::from_data(TensorData::new(lin, [width]), device) });
        }
        Ok(Self { network: Network { blocks }.no_grad(), device: device.clone() })
    }

    /// The distance of two images of one size, sRGB-encoded, clamped to 0…1: 0 for equal ones; symmetric. Not a number where
    /// one of them is none.
    ///
    /// # Errors
    /// [`Error::Shape`] if the sizes differ or a side is below [`MIN_SIDE`]; [`Error::Render`] when the device refuses.
    pub fn distance(&self, a: &ImageF32, b: &ImageF32) -> Result<f64> {
        let size = |image: &ImageF32| vec![image.height as usize, image.width as usize, 3];
        if size(a) != size(b) || a.data.len() != b.data.len() || a.data.len() != size(a).iter().product::<usize>() {
            return Err(Error::Shape { name: "second image", found: size(b), expected: size(a) });
        }
        if a.width.min(a.height) < MIN_SIDE {
            let least = vec![MIN_SIDE as usize, MIN_SIDE as usize, 3];
            return Err(Error::Shape { name: "image for LPIPS", found: size(a), expected: least });
        }
        // ReLU and maxima of backends may drop a NaN.
        if a.data.iter().chain(&b.data).any(|v| v.is_nan()) {
            return Ok(f64::NAN);
        }
        let distance = self.network.distance(self.scaled(a), self.scaled(b));
        let stopped = |error: &dyn std::fmt::Display| gazesplat_render::Error::device(error);
        let data = distance.try_into_data().map_err(|error| stopped(&error))?;
        let values: Vec<f32> = data.try_into_vec().map_err(|error| stopped(&error))?;
        Ok(f64::from(values[0]))
    }

    /// `[1, 3, H, W]`, as the network was trained to see images.
    fn scaled(&self, image: &ImageF32) -> Tensor<4> {
        let channel = |c: usize| {
            let value = move |pixel: &[f32]| (2.0 * pixel[c].clamp(0.0, 1.0) - 1.0 - SHIFT[c]) / SCALE[c];
            image.data.chunks_exact(3).map(value)
        };
        let data: Vec<f32> = (0..3).flat_map(channel).collect();
        let shape = [1, 3, image.height as usize, image.width as usize];
        Tensor::from_data(TensorData::new(data, shape), &self.device)
    }
}

/// Pixels that the mask of the photograph leaves out do not differ; they count in the mean.
impl ImageMetric for Lpips {
    fn name(&self) -> &str {
        "lpips"
    }

    fn measure(&self, image: &ImageF32, target: &LossTarget) -> gazesplat_train::Result<f64> {
        let (width, height) = target.size();
        let photo = ImageF32 {
            width: width as u32,
            height: height as u32,
            data: target.rgb().iter().map(|v| from_u8(*v)).collect(),
        };
        self.distance(&unmasked(image, target), &photo).map_err(|error| match error {
            Error::Render(error) => error.into(),
            other => gazesplat_train::Error::Parameter { key: "lpips".to_owned(), message: other.to_string() },
        })
    }
}
