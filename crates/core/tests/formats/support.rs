//! What the tests of formats share: clouds, files, and differences of what is stored in few bits.

use gazesplat_core::GaussianCloud;
use gazesplat_core::io::model::{self, ModelFormat, SaveOptions};
use gazesplat_core::rng::Rng;
use std::io::Write;
use std::path::PathBuf;
use tempfile::TempDir;

/// Y₀⁰ in `f64`.
pub const SH_C0: f64 = 0.282_094_791_773_878_14;

pub const COMPACT: [ModelFormat; 4] =
    [ModelFormat::CompressedPly, ModelFormat::Splat, ModelFormat::Spz3, ModelFormat::Spz4];

/// Values as trained models have them, some near the ends of the formats' ranges.
pub fn random_cloud(num_gaussians: usize, degree: u32, seed: u64) -> GaussianCloud {
    let mut rng = Rng::new(seed);
    let mut cloud = GaussianCloud::zeros(num_gaussians, degree);
    cloud.means.as_flattened_mut().iter_mut().for_each(|v| *v = rng.range(-60.0, 60.0));
    cloud.quats.as_flattened_mut().iter_mut().for_each(|v| *v = 3.0 * rng.normal());
    cloud.log_scales.as_flattened_mut().iter_mut().for_each(|v| *v = rng.range(-10.0, 5.9));
    cloud.opacity_logits.iter_mut().for_each(|v| *v = rng.range(-9.0, 9.0));
    let k = cloud.num_coefficients();
    for (index, coefficient) in cloud.sh.iter_mut().enumerate() {
        // DC of colours in 0..1 and other coefficients up to 127/128: what every format holds.
        let limit = if index % k == 0 { 1.77 } else { 127.0 / 128.0 };
        *coefficient = [0; 3].map(|_| rng.range(-limit, limit));
    }
    cloud
}

pub fn file(name: &str, bytes: &[u8]) -> (TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    (dir, path)
}

pub fn name(format: ModelFormat) -> &'static str {
    match format {
        ModelFormat::Ply | ModelFormat::CompressedPly => "model.ply",
        ModelFormat::Splat => "model.splat",
        ModelFormat::Spz3 | ModelFormat::Spz4 => "model.spz",
    }
}

pub fn saved_with(cloud: &GaussianCloud, format: ModelFormat, sh_bits: Option<u32>) -> Vec<u8> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(name(format));
    model::save(&path, cloud, &SaveOptions { format, sh_bits, comments: Vec::new() }).unwrap();
    std::fs::read(path).unwrap()
}

pub fn saved(cloud: &GaussianCloud, format: ModelFormat) -> Vec<u8> {
    saved_with(cloud, format, None)
}

pub fn loaded(name: &str, bytes: &[u8]) -> GaussianCloud {
    let (_dir, path) = file(name, bytes);
    model::load(path).unwrap()
}

pub fn message(name: &str, bytes: &[u8]) -> String {
    let (_dir, path) = file(name, bytes);
    let error = model::load(&path).expect_err("the file is bad");
    assert!(error.to_string().contains(name), "the file is named: {error}");
    format!("{error} | hint: {}", error.hint().unwrap_or_default())
}

pub fn opacity(logit: f32) -> f64 {
    1.0 / (1.0 + (-f64::from(logit)).exp())
}

pub fn unit(q: [f32; 4]) -> [f64; 4] {
    let q = q.map(f64::from);
    let length = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    q.map(|v| v / length)
}

/// Largest difference over the components of two rotations, with the sign that brings them nearest.
pub fn rotation_error(a: [f32; 4], b: [f32; 4]) -> f64 {
    let (a, b) = (unit(a), unit(b));
    let of = |sign: f64| a.iter().zip(b).map(|(a, b)| (a - sign * b).abs()).fold(0.0, f64::max);
    of(1.0).min(of(-1.0))
}

pub fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}
