//! The loss on a GPU: the photograph goes up as one word per pixel, nothing comes back.

use super::{LossGradientOps, LossOps, LossTarget};
use crate::kernels::gpu::l1_ssim::{Comparison, TargetFormat, scaled, similarity, similarity_and_gradient};
use burn::backend::tensor::FloatTensor;
use burn_cubecl::CubeBackend;
use gazesplat_render::gpu::{Gpu, contiguous};
use rayon::prelude::*;

/// Pixels packed by one job.
const PIXELS_PER_JOB: usize = 16 * 1024;

/// The buffers of the loss are at most as large as the image.
const FITS: &str = "the adapter took an image of that size";

impl LossOps for CubeBackend {
    fn l1_ssim(image: FloatTensor<Self>, target: LossTarget, ssim_weight: f32) -> FloatTensor<Self> {
        let (gpu, comparison) = comparison(image, &target);
        similarity(&gpu, &comparison, ssim_weight).expect(FITS)
    }
}

impl LossGradientOps for CubeBackend {
    fn l1_ssim_with_gradient(
        image: FloatTensor<Self>,
        target: LossTarget,
        ssim_weight: f32,
    ) -> (FloatTensor<Self>, FloatTensor<Self>) {
        let (gpu, comparison) = comparison(image, &target);
        similarity_and_gradient(&gpu, &comparison, ssim_weight).expect(FITS)
    }

    fn scaled_by_loss(gradient: FloatTensor<Self>, v_packed: FloatTensor<Self>) -> FloatTensor<Self> {
        scaled(&Gpu::of(&gradient), gradient, contiguous(v_packed))
    }
}

fn comparison(image: FloatTensor<CubeBackend>, target: &LossTarget) -> (Gpu, Comparison) {
    let (width, height) = target.size();
    let image = contiguous(image);
    let shape = image.meta.shape();
    assert_eq!(&shape[..2], [height, width], "image and photograph differ in size");
    let channels = shape[2];
    let gpu = Gpu::of(&image);
    let (words, num_pixels) = packed_target(target);
    let target = gpu.upload_u32(&words, &[height, width]);
    (gpu, Comparison { width, height, channels, image, target, format: TargetFormat::Bytes, num_pixels })
}

/// One word per pixel, red in the lowest byte, the highest 255 where the pixel carries loss, else 0; and how many carry it.
fn packed_target(target: &LossTarget) -> (Vec<u32>, usize) {
    let (width, height) = target.size();
    let (rgb, mask) = (target.rgb(), target.mask());
    // Fresh zeroed memory is mapped where it is first written: by the jobs.
    let mut words = vec![0u32; width * height];
    let num_pixels = words
        .par_chunks_mut(PIXELS_PER_JOB)
        .zip(rgb.par_chunks(3 * PIXELS_PER_JOB))
        .enumerate()
        .map(|(job, (words, rgb))| {
            for (word, color) in words.iter_mut().zip(rgb.chunks_exact(3)) {
                *word = u32::from_le_bytes([color[0], color[1], color[2], 255]);
            }
            let Some(mask) = mask else { return words.len() };
            let mask = &mask[job * PIXELS_PER_JOB..][..words.len()];
            let mut num_pixels = words.len();
            for (word, _) in words.iter_mut().zip(mask).filter(|(_, m)| **m == 0) {
                *word &= 0x00ff_ffff;
                num_pixels -= 1;
            }
            num_pixels
        })
        .sum();
    (words, num_pixels)
}

#[cfg(test)]
mod tests {
    use super::*;
    use gazesplat_core::image::RgbImage8;
    use gazesplat_core::io::images::TrainingImage;
    use std::sync::Arc;

    #[test]
    fn words_hold_colour_and_mask_across_jobs() {
        let (width, height) = (257, 130);
        let data: Vec<u8> = (0..width * height * 3).map(|i| (i * 31 % 251) as u8).collect();
        let mask: Vec<u8> = (0..width * height).map(|i| [0, 1, 255][i % 3]).collect();
        for mask in [None, Some(mask)] {
            let image = RgbImage8 { width: width as u32, height: height as u32, data: data.clone() };
            let photo = TrainingImage { image, alpha: None, mask: mask.clone() };
            let (words, num_pixels) = packed_target(&LossTarget::new(Arc::new(photo), [0.0; 3]));
            let is_valid = |i: usize| mask.as_ref().is_none_or(|m| m[i] != 0);
            assert_eq!(num_pixels, (0..width * height).filter(|&i| is_valid(i)).count());
            for (i, word) in words.into_iter().enumerate() {
                let [r, g, b, valid] = word.to_le_bytes();
                assert_eq!([r, g, b], data[3 * i..][..3]);
                assert_eq!(valid, if is_valid(i) { 255 } else { 0 });
            }
        }
    }
}
