//! Losses between a rendered image and a photograph: terms of a weighted sum, each with its report.
//!
//! Values stay on the device until somebody asks for them: [`PendingLoss::read`] is the one place that waits for it.

pub mod l1_ssim;

pub use l1_ssim::L1Ssim;

use crate::error::Result;
use crate::host::read;
use burn::tensor::Tensor;
use gazesplat_core::image::RgbImage8;
use gazesplat_core::io::images::TrainingImage;
use std::sync::Arc;

/// What an image is compared with: 8-bit colours, shared with the image cache, and the mask.
#[derive(Debug, Clone)]
pub struct LossTarget {
    photo: Arc<TrainingImage>,
    composited: Option<Arc<RgbImage8>>,
    background: [f32; 3],
}

impl LossTarget {
    /// The photograph, over `background` (RGB in 0..1) where it is transparent.
    pub fn new(photo: Arc<TrainingImage>, background: [f32; 3]) -> Self {
        let composited = photo.alpha.is_some().then(|| Arc::new(photo.composited(background)));
        Self { photo, composited, background }
    }

    /// The photograph: the same allocation for the same view as long as the image cache holds it, which is how losses
    /// recognise a view whose statistics they keep.
    pub fn photo(&self) -> &Arc<TrainingImage> {
        &self.photo
    }

    /// What shows behind transparent pixels of the photograph, `None` for an opaque one.
    pub fn background(&self) -> Option<[f32; 3]> {
        self.photo.alpha.is_some().then_some(self.background)
    }

    /// Width and height in pixels.
    pub fn size(&self) -> (usize, usize) {
        (self.photo.image.width as usize, self.photo.image.height as usize)
    }

    /// Colours `[height, width, 3]`.
    pub fn rgb(&self) -> &[u8] {
        self.composited.as_ref().map_or(&self.photo.image.data, |c| &c.data)
    }

    /// `[height, width]`, 0 = the pixel carries no loss.
    pub fn mask(&self) -> Option<&[u8]> {
        self.photo.mask.as_deref()
    }
}

/// One term of a loss.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LossTerm {
    /// Name, as in logs.
    pub name: &'static str,
    /// Value before weighting.
    pub value: f32,
}

/// A loss and what it is made of.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LossTerms {
    /// The weighted sum that is minimised.
    pub total: f32,
    /// The terms, unweighted, in a fixed order.
    pub terms: Vec<LossTerm>,
}

impl LossTerms {
    /// The value of a term.
    pub fn get(&self, name: &str) -> Option<f32> {
        self.terms.iter().find(|t| t.name == name).map(|t| t.value)
    }
}

/// A differentiable value of an image and what its report will be made of.
#[derive(Debug)]
pub struct ImageLossValue {
    /// `[1]`, on the graph of the image.
    pub loss: Tensor<1>,
    /// The terms it is made of, unweighted, off the graph; as many as `names`.
    pub terms: Tensor<1>,
    /// Names of the terms, as in logs.
    pub names: &'static [&'static str],
}

/// A loss between a rendered image and a photograph.
pub trait ImageLoss: Send {
    /// The value for `image`, `[H, W, 4 or 5]`: RGB over the background, alpha, depth if there is a fifth channel. It
    /// must not wait for the device.
    fn evaluate(&self, image: Tensor<3>, target: &LossTarget) -> ImageLossValue;
}

/// A loss on its device, and its report for when somebody asks.
#[derive(Debug)]
pub struct PendingLoss {
    /// The weighted sum that is minimised, `[1]` on the graph of the image.
    pub loss: Tensor<1>,
    total: Tensor<1>,
    /// Values of terms and their names, one entry per loss.
    parts: Vec<(Tensor<1>, &'static [&'static str])>,
}

impl PendingLoss {
    /// The weighted sum, `[1]` off the graph: for what looks at it on the device.
    pub fn total(&self) -> Tensor<1> {
        self.total.clone()
    }

    /// Waits for the device and reads the report, in one transfer. The graph need not exist any more.
    ///
    /// # Errors
    /// [`crate::Error::Render`] when a GPU was lost, has no memory left, or refused a kernel on the way.
    pub fn read(&self) -> Result<LossTerms> {
        let parts = self.parts.iter().map(|(values, _)| values.clone());
        let values = read(Tensor::cat(std::iter::once(self.total()).chain(parts).collect(), 0))?;
        let names = self.parts.iter().flat_map(|(_, names)| names.iter());
        let terms = names.zip(&values[1..]).map(|(&name, &value)| LossTerm { name, value }).collect();
        Ok(LossTerms { total: values[0], terms })
    }
}

/// A weighted sum of image losses.
#[derive(Default)]
pub struct WeightedLosses {
    losses: Vec<(f32, Box<dyn ImageLoss>)>,
}

impl WeightedLosses {
    /// Adds `weight` times `loss`.
    pub fn with(mut self, weight: f32, loss: Box<dyn ImageLoss>) -> Self {
        self.losses.push((weight, loss));
        self
    }

    /// The sum for `image` and what its report will be made of; `None` when there is no loss to sum.
    pub fn evaluate(&self, image: Tensor<3>, target: &LossTarget) -> Option<PendingLoss> {
        let mut sum: Option<Tensor<1>> = None;
        let mut parts = Vec::with_capacity(self.losses.len());
        for (weight, loss) in &self.losses {
            let value = loss.evaluate(image.clone(), target);
            parts.push((value.terms, value.names));
            let weighted = if *weight == 1.0 { value.loss } else { value.loss.mul_scalar(*weight) };
            sum = Some(match sum {
                Some(sum) => sum + weighted,
                None => weighted,
            });
        }
        let loss = sum?;
        Some(PendingLoss { total: loss.clone().inner(), loss, parts })
    }
}
