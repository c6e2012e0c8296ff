//! HVSQ where training and pruning look for losses and metrics, with the statistics of photographs kept between steps.

use super::op::{HvsqTarget, hvsq};
use super::{Hvsq, HvsqReference, ImageView};
use crate::hvs::pooling::Pooling;
use burn::tensor::{Device, Tensor};
use gazesplat_core::color::from_u8;
use gazesplat_core::image::ImageF32;
use gazesplat_core::io::images::TrainingImage;
use gazesplat_render::is_gpu;
use gazesplat_train::losses::{ImageLoss, ImageLossValue, LossTarget};
use gazesplat_train::metrics::ImageMetric;
use std::sync::{Arc, Mutex, PoisonError, Weak};

/// Memory for statistics unless somebody asks for another, bytes.
pub const DEFAULT_CACHE_BYTES: usize = 512 << 20;

/// Statistics of photographs, the ones used least recently dropped first when they take too much memory.
///
/// Uniform pools above one pixel only: other comparisons keep nothing but the colours, which are as quickly made again.
/// Statistics on the host and on a GPU are kept apart; a cache is for one GPU.
#[derive(Debug)]
pub struct ReferenceCache {
    hvsq: Hvsq,
    max_bytes: usize,
    entries: Mutex<Entries>,
}

#[derive(Debug, Default)]
struct Entries {
    /// Least recently used first.
    kept: Vec<Entry>,
    num_misses: u64,
}

#[derive(Debug)]
struct Entry {
    /// The photograph. That it cannot be another at the same place is what a weak reference is for.
    photo: Weak<TrainingImage>,
    background: Option<[u32; 3]>,
    reference: HvsqReference,
}

impl ReferenceCache {
    /// A cache of at most `max_bytes`.
    pub fn new(hvsq: Hvsq, max_bytes: usize) -> Self {
        Self { hvsq, max_bytes, entries: Mutex::default() }
    }

    /// How images are compared.
    pub fn hvsq(&self) -> &Hvsq {
        &self.hvsq
    }

    /// How often statistics had to be computed.
    pub fn num_misses(&self) -> u64 {
        self.lock().num_misses
    }

    /// The statistics of a photograph.
    ///
    /// # Errors
    /// As [`Hvsq::reference`].
    pub fn get(&self, target: &LossTarget) -> crate::Result<HvsqReference> {
        self.get_with(target, false, |image| self.hvsq.reference(image))
    }

    /// As [`ReferenceCache::get`], living on `device`.
    ///
    /// # Errors
    /// As [`Hvsq::reference_on`].
    pub fn get_on(&self, target: &LossTarget, device: &Device) -> crate::Result<HvsqReference> {
        self.get_with(target, is_gpu(device), |image| self.hvsq.reference_on(image, device))
    }

    fn get_with(
        &self,
        target: &LossTarget,
        on_gpu: bool,
        reference: impl FnOnce(ImageView<'_, f32>) -> crate::Result<HvsqReference>,
    ) -> crate::Result<HvsqReference> {
        let background = target.background().map(|b| b.map(f32::to_bits));
        let is_same = |e: &Entry| {
            std::ptr::eq(e.photo.as_ptr(), Arc::as_ptr(target.photo()))
                && e.background == background
                && e.reference.is_on_gpu() == on_gpu
        };
        let mut entries = self.lock();
        if let Some(i) = entries.kept.iter().position(is_same) {
            let entry = entries.kept.remove(i);
            let reference = entry.reference.clone();
            entries.kept.push(entry);
            return Ok(reference);
        }
        entries.num_misses += 1;
        drop(entries);
        let (width, height) = target.size();
        let data: Vec<f32> = target.rgb().iter().map(|v| from_u8(*v)).collect();
        let reference = reference(ImageView { width, height, channels: 3, data: &data })?;
        if matches!(self.hvsq.pooling(), Pooling::Uniform { size_px } if *size_px > 1.0) {
            let mut entries = self.lock();
            let photo = Arc::downgrade(target.photo());
            entries.kept.push(Entry { photo, background, reference: reference.clone() });
            entries.kept.retain(|e| e.photo.strong_count() > 0);
            let mut num_bytes: usize = entries.kept.iter().map(|e| e.reference.num_bytes()).sum();
            while num_bytes > self.max_bytes && !entries.kept.is_empty() {
                num_bytes -= entries.kept.remove(0).reference.num_bytes();
            }
        }
        Ok(reference)
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Entries> {
        // Entries are whole at every point where a holder could have panicked.
        self.entries.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// HVSQ as a term of a training loss.
#[derive(Debug, Clone)]
pub struct HvsqLoss {
    cache: Arc<ReferenceCache>,
}

impl HvsqLoss {
    /// The loss, with its statistics in `cache`.
    pub fn new(cache: Arc<ReferenceCache>) -> Self {
        Self { cache }
    }
}

/// Why statistics can be computed in a training.
const CHECKED: &str = "the size of every photograph was checked, and the adapter took a model that is larger";

impl ImageLoss for HvsqLoss {
    /// # Panics
    /// If the pools are larger than the photograph: [`Hvsq::check_size`] tells before a training begins.
    fn evaluate(&self, image: Tensor<3>, target: &LossTarget) -> ImageLossValue {
        let reference = self.cache.get_on(target, &image.device()).expect(CHECKED);
        let loss = hvsq(image, HvsqTarget { reference, photo: Some(target.clone()) });
        ImageLossValue { terms: loss.clone().inner(), loss, names: &["hvsq"] }
    }
}

/// HVSQ as a metric of evaluations and guards; lower is better. Masked pixels take the photograph's colours.
#[derive(Debug, Clone)]
pub struct HvsqMetric {
    cache: Arc<ReferenceCache>,
    name: String,
}

impl HvsqMetric {
    /// The metric `hvsq`, with `@` and the pooling size where that is uniform, and its statistics in `cache`.
    pub fn new(cache: Arc<ReferenceCache>) -> Self {
        let name = match cache.hvsq().pooling() {
            Pooling::Uniform { size_px } => format!("hvsq@{size_px}"),
            Pooling::Gaze(_) => "hvsq".to_owned(),
        };
        Self { cache, name }
    }
}

impl ImageMetric for HvsqMetric {
    fn name(&self) -> &str {
        &self.name
    }

    fn measure(&self, image: &ImageF32, target: &LossTarget) -> gazesplat_train::Result<f64> {
        let parameter = |error: crate::Error| gazesplat_train::Error::Parameter {
            key: self.name.clone(),
            message: error.to_string(),
        };
        let reference = self.cache.get(target).map_err(parameter)?;
        let shape = [image.height as usize, image.width as usize, 3];
        let target = HvsqTarget { reference, photo: Some(target.clone()) };
        super::op::measured(&image.data, &shape, &target).map_err(parameter)
    }
}
