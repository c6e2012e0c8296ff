//! Quality of a model on views it has not been trained on.

use crate::error::Result;
use crate::host::read;
use crate::losses::LossTarget;
use crate::metrics::{self, ImageMetric};
use gazesplat_core::image::ImageF32;
use gazesplat_core::io::images::ImageCache;
use gazesplat_render::{RenderOptions, Rendered, Splats, render};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Quality of one view.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ViewScore {
    /// Name of the view.
    pub name: String,
    /// Peak signal-to-noise ratio in dB, at most [`metrics::MAX_PSNR_DB`].
    pub psnr: f64,
    /// Mean SSIM.
    pub ssim: f64,
    /// Further metrics by name, as [`evaluate_with`] was given them.
    #[serde(flatten)]
    pub more: BTreeMap<String, f64>,
}

/// Quality of a model: what `eval.json` holds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EvalReport {
    /// Mean of the views' PSNR, dB; 0 without views.
    pub psnr: f64,
    /// Mean of the views' SSIM; 0 without views.
    pub ssim: f64,
    /// Means of the further metrics by name.
    #[serde(flatten)]
    pub more: BTreeMap<String, f64>,
    /// Gaussians of the model.
    pub num_gaussians: usize,
    /// Every view, in the order of the cache.
    pub views: Vec<ViewScore>,
}

/// Renders every view of `images` and compares it with its photograph (composited over the background of `options`);
/// `each` gets the score and the render, `[H, W, 3]` unclamped, of every view in order.
///
/// # Errors
/// When a photograph cannot be read, the renderer refuses, or the device stopped.
pub fn evaluate(
    splats: &Splats,
    images: &ImageCache,
    options: &RenderOptions,
    each: &mut dyn FnMut(&ViewScore, &ImageF32),
) -> Result<EvalReport> {
    evaluate_with(splats, images, options, &[], each)
}

/// As [`evaluate`], with further `metrics` of every view.
///
/// # Errors
/// As [`evaluate`], and those of the metrics.
pub fn evaluate_with(
    splats: &Splats,
    images: &ImageCache,
    options: &RenderOptions,
    metrics: &[&dyn ImageMetric],
    each: &mut dyn FnMut(&ViewScore, &ImageF32),
) -> Result<EvalReport> {
    let mut views = Vec::with_capacity(images.len());
    for (index, view) in images.views().iter().enumerate() {
        let target = LossTarget::new(images.get(index)?, options.background);
        let image = rgb(render(splats, &view.camera, options)?)?;
        let mut more = BTreeMap::new();
        for metric in metrics {
            more.insert(metric.name().to_owned(), metric.measure(&image, &target)?);
        }
        let score = ViewScore {
            name: view.name.clone(),
            psnr: metrics::psnr(&image, &target),
            ssim: metrics::ssim(&image, &target),
            more,
        };
        each(&score, &image);
        views.push(score);
    }
    let mean = |value: &dyn Fn(&ViewScore) -> f64| views.iter().map(value).sum::<f64>() / views.len().max(1) as f64;
    let names = metrics.iter().map(|metric| metric.name().to_owned());
    let more = names.map(|name| (name.clone(), mean(&|v| v.more[&name]))).collect();
    let (psnr, ssim) = (mean(&|v| v.psnr), mean(&|v| v.ssim));
    Ok(EvalReport { psnr, ssim, more, num_gaussians: splats.len(), views })
}

/// The expected depth of a frame, `[H, W]` in world units, on the host; `None` unless its options asked for depth.
///
/// # Errors
/// As [`rgb`].
pub fn expected_depth(rendered: &Rendered) -> Result<Option<Vec<f32>>> {
    rendered.expected_depth().map(read).transpose()
}

/// The colours of a frame, `[H, W, 3]`, on the host.
///
/// # Errors
/// [`crate::Error::Render`] when a GPU was lost, has no memory left, or refused a kernel on the way.
pub fn rgb(rendered: Rendered) -> Result<ImageF32> {
    let [height, width, channels] = rendered.image.dims();
    let values = read(rendered.image)?;
    let data = values.chunks_exact(channels).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
    Ok(ImageF32 { width: width as u32, height: height as u32, data })
}
