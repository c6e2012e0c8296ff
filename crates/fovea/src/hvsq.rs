//! HVSQ: how different two images look to an eye that does not look straight at them (RTGS Eq. 2).
//!
//! HVSQ = mean over maps and pixels of d(M(a), M(b)) + d(σ(a), σ(b)): M and σ are mean and standard deviation of features
//! over the pool around a pixel, the features are the responses of an oriented pyramid ([`crate::hvs::pyramid`]) to Y, Cr
//! and Cb of the encoded image. 0 = the same statistics everywhere; lower is better.
//!
//! Images are `[height, width, 3 or more]`, sRGB-encoded, nominally 0..1, not clamped. Sides that are no multiples of 32
//! are enlarged to the next one. Colours that are not finite give a value that is not finite.
//!
//! A comparison is computed where its reference lives, on the host or on a GPU; what lives elsewhere comes there.

#[cfg(feature = "gpu")]
pub(crate) mod device;
pub mod loss;
pub mod op;
pub mod plain;

#[cfg(test)]
mod tests;

pub use crate::kernels::cpu::hvsq::{Distance, ImageView};
pub use loss::{HvsqLoss, HvsqMetric, ReferenceCache};

use crate::error::{Error, Result};
use crate::hvs::pooling::Pooling;
use crate::hvs::pyramid::FilterBank;
use crate::kernels::cpu::hvsq::{Found, Plan, Regions, Statistics, Wanted, enlarged};
use burn::tensor::Device;
use std::sync::Arc;

/// How images are compared.
#[derive(Debug, Clone, PartialEq)]
pub struct Hvsq {
    pooling: Pooling,
    distance: Distance,
    bank: FilterBank,
}

/// What is known of the image that others are compared with: of its colours with uniform pools above one pixel only the
/// pooled statistics, at p = 3 about half a float per value of the image and map. Cloning is free.
#[derive(Debug, Clone)]
pub struct HvsqReference {
    inner: Arc<Inner>,
}

#[derive(Debug)]
struct Inner {
    hvsq: Hvsq,
    size: (usize, usize),
    held: Held,
}

/// Where a reference lives.
#[derive(Debug)]
enum Held {
    Host {
        plan: Box<Plan<f32>>,
        statistics: Statistics<f32>,
    },
    #[cfg(feature = "gpu")]
    Device(Box<device::DeviceReference>),
}

impl HvsqReference {
    /// Width and height of the images it can be compared with.
    pub fn size(&self) -> (usize, usize) {
        self.inner.size
    }

    /// Memory it takes, bytes, without the tables that depend on the size alone.
    pub fn num_bytes(&self) -> usize {
        match &self.inner.held {
            Held::Host { statistics, .. } => statistics.num_bytes(),
            #[cfg(feature = "gpu")]
            Held::Device(reference) => reference.num_bytes(),
        }
    }

    /// Whether it lives on a GPU.
    pub fn is_on_gpu(&self) -> bool {
        !matches!(self.inner.held, Held::Host { .. })
    }

    /// What lives on a GPU.
    #[cfg(feature = "gpu")]
    pub(crate) fn on_device(&self) -> Option<&device::DeviceReference> {
        match &self.inner.held {
            Held::Host { .. } => None,
            Held::Device(reference) => Some(reference),
        }
    }

    /// How it is compared.
    pub fn hvsq(&self) -> &Hvsq {
        &self.inner.hvsq
    }
}

impl Hvsq {
    /// A comparison with the six-orientation bank of Table 1 of RTGS.
    ///
    /// # Errors
    /// [`Error::Parameter`] as of [`Pooling::validate`].
    pub fn new(pooling: Pooling, distance: Distance) -> Result<Self> {
        Self::with_bank(pooling, distance, FilterBank::sp5())
    }

    /// A comparison with other filters.
    ///
    /// # Errors
    /// As [`Hvsq::new`].
    pub fn with_bank(pooling: Pooling, distance: Distance, bank: FilterBank) -> Result<Self> {
        pooling.validate()?;
        Ok(Self { pooling, distance, bank })
    }

    /// The pools.
    pub fn pooling(&self) -> &Pooling {
        &self.pooling
    }

    /// The distance.
    pub fn distance(&self) -> Distance {
        self.distance
    }

    /// Checks that images of this size (width, height) can be compared.
    ///
    /// # Errors
    /// [`Error::Parameter`] when a side is 0 or the pools are larger than the shorter enlarged side.
    pub fn check_size(&self, size: (usize, usize)) -> Result<()> {
        if size.0 == 0 || size.1 == 0 {
            return Err(Error::parameter("image size", format!("{}×{}", size.0, size.1), "at least one pixel"));
        }
        let (width, height) = enlarged(size);
        match self.pooling {
            Pooling::Uniform { size_px } if size_px > width.min(height) as f64 => Err(Error::parameter(
                "pooling size",
                size_px,
                format!("at most {} pixels, the shorter side of the image as it is enlarged", width.min(height)),
            )),
            _ => Ok(()),
        }
    }

    /// Checks that images of this size (width, height) can be compared on `device`.
    ///
    /// # Errors
    /// As [`Hvsq::check_size`]; [`Error::Render`] when a GPU takes no buffer as large as a comparison needs.
    pub fn check_size_on(&self, size: (usize, usize), device: &Device) -> Result<()> {
        self.check_size(size)?;
        #[cfg(feature = "gpu")]
        if let Some(gpu) = gazesplat_render::gpu::Gpu::from_device(device) {
            crate::kernels::gpu::hvsq::check_size(&gpu, size, &self.pooling)?;
        }
        #[cfg(not(feature = "gpu"))]
        let _ = device;
        Ok(())
    }

    /// The statistics of an image that others will be compared with.
    ///
    /// # Errors
    /// [`Error::Shape`] when the image is not `[height, width, 3 or more]`; [`Error::Parameter`] as of
    /// [`Hvsq::check_size`].
    pub fn reference(&self, image: ImageView<'_, f32>) -> Result<HvsqReference> {
        check_image(&image)?;
        let size = (image.width, image.height);
        self.check_size(size)?;
        let plan = Plan::new(size, &self.bank, &self.pooling, self.distance);
        let statistics = plan.statistics(&image);
        Ok(self.held(size, Held::Host { plan: Box::new(plan), statistics }))
    }

    /// As [`Hvsq::reference`], living on `device`: on a GPU, where it is one.
    ///
    /// # Errors
    /// As [`Hvsq::reference`]; [`Error::Render`] when a GPU cannot hold it.
    pub fn reference_on(&self, image: ImageView<'_, f32>, device: &Device) -> Result<HvsqReference> {
        #[cfg(feature = "gpu")]
        if let Some(gpu) = gazesplat_render::gpu::Gpu::from_device(device) {
            check_image(&image)?;
            let size = (image.width, image.height);
            self.check_size_on(size, device)?;
            return Ok(self.held(size, Held::Device(Box::new(device::DeviceReference::new(&gpu, self, image)?))));
        }
        #[cfg(not(feature = "gpu"))]
        let _ = device;
        self.reference(image)
    }

    fn held(&self, size: (usize, usize), held: Held) -> HvsqReference {
        HvsqReference { inner: Arc::new(Inner { hvsq: self.clone(), size, held }) }
    }
}

impl HvsqReference {
    /// HVSQ of `image`.
    ///
    /// # Errors
    /// [`Error::Shape`] when it has another size; of a reference on a GPU, [`Error::Render`] when that does not answer.
    pub fn value(&self, image: ImageView<'_, f32>) -> Result<f64> {
        Ok(self.compare(image, Wanted { gradient: false, map: false, regions: None })?.values[0])
    }

    /// HVSQ of `image` and its gradient, `[height, width, channels]`, zero beyond RGB.
    ///
    /// # Errors
    /// As [`HvsqReference::value`].
    pub fn value_and_gradient(&self, image: ImageView<'_, f32>) -> Result<(f64, Vec<f32>)> {
        let found = self.compare(image, Wanted { gradient: true, map: false, regions: None })?;
        Ok((found.values[0], found.v_image))
    }

    /// HVSQ of every region 0..`num_regions` (RTGS Sec. 4.3), `None` of those without a pixel: means are over the pixels
    /// of the region, pools reach beyond it. `labels`, `[height, width]`, is the region of every pixel of the image;
    /// labels from `num_regions` on belong to none.
    ///
    /// # Errors
    /// [`Error::Shape`] when `image` or `labels` has another size.
    pub fn by_region(&self, image: ImageView<'_, f32>, labels: &[u8], num_regions: usize) -> Result<Vec<Option<f64>>> {
        let size = self.size();
        if labels.len() != size.0 * size.1 {
            return Err(Error::Shape {
                name: "number of region labels",
                found: vec![labels.len()],
                expected: vec![size.0 * size.1],
            });
        }
        if num_regions == 0 {
            return Ok(Vec::new());
        }
        let regions = Regions::new(labels, size, num_regions);
        #[cfg(feature = "gpu")]
        if let Some(reference) = self.on_device() {
            self.check_compared(&image)?;
            let value = |k| reference.region(image, &regions, k);
            let some = |k| if regions.is_empty(k) { Ok(None) } else { value(k).map(Some) };
            return (0..num_regions).map(some).collect();
        }
        let found = self.compare(image, Wanted { gradient: false, map: false, regions: Some(&regions) })?;
        let some = |(k, value)| (!regions.is_empty(k)).then_some(value);
        Ok(found.values.into_iter().take(num_regions).enumerate().map(some).collect())
    }

    /// HVSQ of `image` and the distance of every pixel, `[height, width]`, averaged over the maps, for pictures: maps of
    /// coarser levels are enlarged bilinearly.
    ///
    /// # Errors
    /// As [`HvsqReference::value`]; [`Error::Parameter`] of a reference on a GPU: pictures are made on the host.
    pub fn value_and_map(&self, image: ImageView<'_, f32>) -> Result<(f64, Vec<f32>)> {
        let found = self.compare(image, Wanted { gradient: false, map: true, regions: None })?;
        Ok((found.values[0], found.map))
    }

    /// Checks the width and height of an image.
    fn check_image_size(&self, found: (usize, usize)) -> Result<()> {
        let size = self.size();
        if found == size {
            return Ok(());
        }
        Err(Error::Shape {
            name: "image (width, height)",
            found: vec![found.0, found.1],
            expected: vec![size.0, size.1],
        })
    }

    fn check_compared(&self, image: &ImageView<'_, f32>) -> Result<()> {
        check_image(image)?;
        self.check_image_size((image.width, image.height))
    }

    fn compare(&self, image: ImageView<'_, f32>, wanted: Wanted<'_, f32>) -> Result<Found<f32>> {
        self.check_compared(&image)?;
        match &self.inner.held {
            Held::Host { plan, statistics } => Ok(plan.compare(statistics, &image, wanted)),
            #[cfg(feature = "gpu")]
            Held::Device(_) if wanted.map => {
                Err(Error::parameter("reference of a per-pixel map", "one on a GPU", "one on the host"))
            }
            #[cfg(feature = "gpu")]
            Held::Device(reference) => {
                let (value, v_image) = reference.value(image, wanted.gradient)?;
                Ok(Found { values: vec![value], v_image, map: Vec::new() })
            }
        }
    }
}

fn check_image(image: &ImageView<'_, f32>) -> Result<()> {
    if image.channels < 3 {
        return Err(Error::parameter("channels of an image", image.channels, "at least 3"));
    }
    let expected = image.width * image.height * image.channels;
    if image.data.len() != expected {
        return Err(Error::Shape {
            name: "number of colour values",
            found: vec![image.data.len()],
            expected: vec![expected],
        });
    }
    Ok(())
}
