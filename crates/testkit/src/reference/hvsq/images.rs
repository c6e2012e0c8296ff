//! Test images given by a formula, as the golden record `hvsq_formula` writes it down: no file is needed.

use std::f64::consts::TAU;

/// Image `seed` of the formula, `[3, height, width]`, values in 0..1: smooth waves and a little noise.
pub fn synth(height: usize, width: usize, seed: u32) -> Vec<f32> {
    let mut image = Vec::with_capacity(3 * height * width);
    for c in 0..3u32 {
        for y in 0..height as u32 {
            for x in 0..width as u32 {
                let terms = [x.wrapping_mul(374_761_393), y.wrapping_mul(668_265_263), c.wrapping_mul(2_147_483_647)];
                let h = terms.into_iter().fold(seed.wrapping_mul(3_266_489_917), u32::wrapping_add);
                let h = (h ^ (h >> 13)).wrapping_mul(1_274_126_177);
                let noise = f64::from(h ^ (h >> 16)) / 4_294_967_295.0;
                let (x, y, c) = (f64::from(x), f64::from(y), f64::from(c));
                let smooth =
                    0.5 + 0.25 * (TAU * (x / 17.0 + 0.1 * c)).sin() + 0.15 * (TAU * (y / 23.0 - 0.2 * c)).cos();
                image.push((0.8 * smooth + 0.2 * noise).clamp(0.0, 1.0) as f32);
            }
        }
    }
    image
}

/// Reference image a and altered image b = 0.9 a + 0.1 synth(7), in float32 arithmetic: so the values of the record were
/// computed, whatever its note says (`mean_b` matches exactly).
pub fn pair(height: usize, width: usize) -> [Vec<f32>; 2] {
    let (a, other) = (synth(height, width, 1), synth(height, width, 7));
    let mix = |(a, o): (&f32, &f32)| (0.9f32 * *a + 0.1f32 * *o).clamp(0.0, 1.0);
    let b = a.iter().zip(&other).map(mix).collect();
    [a, b]
}

/// `[3, height, width]` as `[height, width, channels]`; further channels hold 7, which nothing may look at.
pub fn interleaved(planes: &[f32], channels: usize) -> Vec<f32> {
    let n = planes.len() / 3;
    let value = |i: usize| if i % channels < 3 { planes[i % channels * n + i / channels] } else { 7.0 };
    (0..n * channels).map(value).collect()
}
