//! Counter-based random numbers: every draw is a function of (seed, stream, step, index), so that nothing depends on the
//! order of threads and a run can be resumed from its step number alone.
//!
//! Philox4x32-10 (Salmon 2011, "Parallel random numbers: as easy as 1, 2, 3").

#[cfg(feature = "gpu")]
#[expect(missing_docs, reason = "what the kernel macros generate carries no documentation")]
pub mod gpu;

pub use crate::math::uniform;

use crate::math;
use gazesplat_render::math::vec::Vec3;

/// What the numbers are for; streams do not overlap.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Stream {
    /// Order of the views within an epoch.
    ViewOrder = 1,
    /// Random initial positions and colours.
    Init = 2,
    /// Background colour of a step.
    Background = 3,
    /// Which Gaussians take in a dead one (MCMC), and where the parts of one that is split go (ADC).
    Sampling = 4,
    /// Position noise of a step.
    Noise = 5,
}

/// Four random words of one counter and key.
#[inline]
pub fn philox(mut counter: [u32; 4], mut key: [u32; 2]) -> [u32; 4] {
    for _ in 0..10 {
        let a = u64::from(counter[0]) * 0xD251_1F53;
        let b = u64::from(counter[2]) * 0xCD9E_8D57;
        counter = [(b >> 32) as u32 ^ counter[1] ^ key[0], b as u32, (a >> 32) as u32 ^ counter[3] ^ key[1], a as u32];
        key = [key[0].wrapping_add(0x9E37_79B9), key[1].wrapping_add(0xBB67_AE85)];
    }
    counter
}

/// Four random words for row `index` at `step` of a stream.
#[inline]
pub fn draw(seed: u64, stream: Stream, step: u32, index: u64) -> [u32; 4] {
    let counter = [index as u32, (index >> 32) as u32, step, stream as u32];
    philox(counter, [seed as u32, (seed >> 32) as u32])
}

/// Two words as a number in [0, 1) of 53 bits.
#[inline]
pub fn uniform_f64(high: u32, low: u32) -> f64 {
    ((u64::from(high) << 21) ^ (u64::from(low) >> 11)) as f64 * (1.0 / (1u64 << 53) as f64)
}

/// Three independent standard normal numbers from four words (Box and Muller 1958).
#[inline]
pub fn normals(words: [u32; 4]) -> [f32; 3] {
    let Vec3 { x, y, z } = math::normals(words[0], words[1], words[2], words[3]);
    [x, y, z]
}

/// A random order of 0..n (Fisher and Yates).
pub fn permutation(n: usize, seed: u64, stream: Stream, step: u32) -> Vec<usize> {
    let mut order: Vec<usize> = (0..n).collect();
    for i in (1..n).rev() {
        let words = draw(seed, stream, step, i as u64);
        order.swap(i, (uniform_f64(words[0], words[1]) * (i + 1) as f64) as usize);
    }
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn philox_known_answers() {
        // Random123, kat_vectors of philox4x32 10.
        assert_eq!(philox([0; 4], [0; 2]), [0x6627_e8d5, 0xe169_c58d, 0xbc57_ac4c, 0x9b00_dbd8]);
        assert_eq!(philox([u32::MAX; 4], [u32::MAX; 2]), [0x408f_276d, 0x41c8_3b0e, 0xa20b_c7c6, 0x6d54_51fd]);
    }

    #[test]
    fn normals_have_mean_zero_and_variance_one() {
        let values: Vec<f64> = (0..20_000).flat_map(|i| normals(draw(3, Stream::Noise, 1, i))).map(f64::from).collect();
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let variance = values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64;
        assert!(mean.abs() < 0.02 && (variance - 1.0).abs() < 0.03, "{mean} {variance}");
    }

    #[test]
    fn a_permutation_holds_every_index_once() {
        let mut order = permutation(100, 1, Stream::ViewOrder, 5);
        assert_ne!(order, (0..100).collect::<Vec<_>>());
        order.sort_unstable();
        assert_eq!(order, (0..100).collect::<Vec<_>>());
    }
}
