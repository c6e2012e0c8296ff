//! The six attribute streams: values in a few bytes and back.

use super::{Header, MAX_FRACTIONAL_BITS};
use crate::error::{Error, Result};
use crate::gaussian_cloud::GaussianCloud;
use crate::io::quantize::{from_smallest_three, logit_from_u8, normalized, opacity_to_u8, smallest_three};
use crate::sh;
use std::f32::consts::FRAC_1_SQRT_2;

/// Colours are stored as ½ + 0.15 · DC: more than 0..1, as higher bands may bring such a colour back.
const COLOR_SCALE: f64 = 0.15;
/// Largest stored magnitude of a component of the smallest three.
const ROTATION_STEPS: f32 = 511.0;
/// Largest stored coordinate, in steps.
const MAX_POSITION: f32 = 8_388_607.0;

/// Streams of known lengths: positions, alphas, colours, scales, rotations, spherical harmonics.
pub(super) struct Packed<'a> {
    header: &'a Header,
    streams: &'a [Vec<u8>; 6],
}

impl<'a> Packed<'a> {
    /// `streams` have the lengths [`Header::stream_bytes`] says.
    pub fn of_streams(header: &'a Header, streams: &'a [Vec<u8>; 6]) -> Self {
        debug_assert!(streams.iter().zip(header.stream_bytes()).all(|(s, n)| s.len() as u64 == n));
        Self { header, streams }
    }

    /// The model, in the axes of the file.
    pub fn unpack(&self) -> GaussianCloud {
        let [positions, alphas, colors, scales, rotations, rest] = self.streams;
        let mut cloud = GaussianCloud::zeros(self.header.num_points, self.header.sh_degree);
        let k = cloud.num_coefficients();
        let step = (-(self.header.fractional_bits as f32)).exp2();
        for (mean, bytes) in cloud.means.as_flattened_mut().iter_mut().zip(positions.chunks_exact(3)) {
            // Three bytes on top of an empty one: the shift back brings the sign along.
            *mean = (i32::from_le_bytes([0, bytes[0], bytes[1], bytes[2]]) >> 8) as f32 * step;
        }
        for (scale, &level) in cloud.log_scales.as_flattened_mut().iter_mut().zip(scales) {
            *scale = f32::from(level) / 16.0 - 10.0;
        }
        for (logit, &level) in cloud.opacity_logits.iter_mut().zip(alphas) {
            *logit = logit_from_u8(level);
        }
        for (row, rgb) in cloud.sh.chunks_exact_mut(k).zip(colors.chunks_exact(3)) {
            row[0] = [rgb[0], rgb[1], rgb[2]].map(|level| ((f64::from(level) / 255.0 - 0.5) / COLOR_SCALE) as f32);
        }
        if k > 1 {
            for (row, bytes) in cloud.sh.chunks_exact_mut(k).zip(rest.chunks_exact(3 * (k - 1))) {
                for (coefficient, bytes) in row[1..].iter_mut().zip(bytes.chunks_exact(3)) {
                    *coefficient = [bytes[0], bytes[1], bytes[2]].map(|level| (f32::from(level) - 128.0) / 128.0);
                }
            }
        }
        let rotation_bytes = if self.header.version >= 3 { 4 } else { 3 };
        for (quat, bytes) in cloud.quats.iter_mut().zip(rotations.chunks_exact(rotation_bytes)) {
            *quat = match *bytes {
                [a, b, c, d] => unpacked_rotation(u32::from_le_bytes([a, b, c, d])),
                _ => first_three(bytes),
            };
        }
        cloud
    }
}

/// x y z of a unit quaternion with w ≥ 0, as version 2 has it.
fn first_three(bytes: &[u8]) -> [f32; 4] {
    let [x, y, z] = [bytes[0], bytes[1], bytes[2]].map(|level| f32::from(level) / 127.5 - 1.0);
    from_smallest_three(0, [x, y, z])
}

fn unpacked_rotation(word: u32) -> [f32; 4] {
    let part = |shift: u32| {
        let magnitude = ((word >> shift) & 511) as f32 / ROTATION_STEPS * FRAC_1_SQRT_2;
        if word >> (shift + 9) & 1 == 1 { -magnitude } else { magnitude }
    };
    let [x, y, z, w] = from_smallest_three((word >> 30) as usize, [part(20), part(10), part(0)]);
    [w, x, y, z]
}

fn packed_rotation([w, x, y, z]: [f32; 4]) -> u32 {
    let (largest, others) = smallest_three([x, y, z, w]);
    others.into_iter().fold(largest as u32, |word, component| {
        let magnitude = (component.abs() / FRAC_1_SQRT_2 * ROTATION_STEPS + 0.5).min(ROTATION_STEPS) as u32;
        (word << 10) | (u32::from(component < 0.0) << 9) | magnitude
    })
}

/// The finest fixed point that holds every position of `cloud`.
///
/// # Errors
///
/// [`Error::Parameter`] naming the Gaussian that none holds.
pub(super) fn fractional_bits(cloud: &GaussianCloud) -> Result<u32> {
    let size = |mean: &[f32; 3]| mean.iter().fold(0.0_f32, |a, b| a.max(b.abs()));
    let farthest = cloud.means.iter().map(size).enumerate().max_by(|a, b| a.1.total_cmp(&b.1));
    let (index, farthest) = farthest.unwrap_or((0, 0.0));
    (0..=MAX_FRACTIONAL_BITS).rev().find(|&bits| farthest * (bits as f32).exp2() <= MAX_POSITION).ok_or_else(|| {
        let message = format!("it is {farthest} units from the origin along an axis, an SPZ file holds {MAX_POSITION}");
        Error::parameter(format!("Gaussian {index}"), message)
    })
}

/// The streams of `cloud`, and how many values were clamped.
pub(super) fn pack(cloud: &GaussianCloud, fractional_bits: u32, sh_bits: [u32; 2]) -> ([Vec<u8>; 6], usize) {
    let n = cloud.len();
    let mut num_clamped = 0;
    // In `f64`: a value near the middle of two steps goes to the nearer one.
    let mut to_u8 = |value: f64| {
        let rounded = (value + 0.5).floor();
        num_clamped += usize::from(!(0.0..=255.0).contains(&rounded));
        rounded.clamp(0.0, 255.0) as u8
    };
    let scale = (fractional_bits as f32).exp2();
    let mut positions = Vec::with_capacity(9 * n);
    for value in cloud.means.as_flattened() {
        let [low, middle, high, _] = ((value * scale).round() as i32).to_le_bytes();
        positions.extend([low, middle, high]);
    }
    let alphas = cloud.opacity_logits.iter().map(|&logit| opacity_to_u8(logit)).collect();
    let dc = (0..n).flat_map(|index| cloud.sh_of(index)[0]);
    let colors = dc.map(|value| to_u8((f64::from(value) * COLOR_SCALE + 0.5) * 255.0)).collect();
    let scales = cloud.log_scales.as_flattened().iter().map(|&log| to_u8((f64::from(log) + 10.0) * 16.0)).collect();
    let quats = cloud.quats.iter();
    let rotations = quats.flat_map(|&quat| packed_rotation(normalized(quat)).to_le_bytes()).collect();
    let mut rest = Vec::with_capacity(n * sh::num_rest(cloud.sh_degree));
    for index in 0..n {
        for (k, coefficient) in cloud.sh_of(index).iter().enumerate().skip(1) {
            // The first four coefficients are those of degrees 0 and 1.
            let bucket = (1_u32 << (8 - sh_bits[usize::from(k >= 4)])) as f32;
            for value in coefficient {
                let level = ((value * 128.0 + 128.0) / bucket).round() * bucket;
                // +1 itself is a step too far, and comes back as 127/128.
                num_clamped += usize::from(!(-1.0..=1.0).contains(value));
                rest.push(level.clamp(0.0, 255.0) as u8);
            }
        }
    }
    ([positions, alphas, colors, scales, rotations, rest], num_clamped)
}
