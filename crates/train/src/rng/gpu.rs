//! The random words of [`crate::rng`] on a device: the same counters and keys, so the same bits.

use crate::rng::Stream;
use cubecl::prelude::*;

/// Four random words.
#[derive(CubeType, Clone, Copy)]
pub struct Words {
    pub w0: u32,
    pub w1: u32,
    pub w2: u32,
    pub w3: u32,
}

/// What draws of one step have in common.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
pub struct Draws {
    pub seed_low: u32,
    pub seed_high: u32,
    pub stream: u32,
    pub step: u32,
}

impl DrawsLaunch {
    /// Draws of `stream` at `step`.
    pub fn of(seed: u64, stream: Stream, step: u32) -> Self {
        Self::new(seed as u32, (seed >> 32) as u32, stream as u32, step)
    }
}

/// Four random words for row `index`: Philox4x32-10 (Salmon 2011).
#[cube]
pub fn draw(draws: &Draws, index: u32) -> Words {
    let mut c0 = index;
    let mut c1 = 0u32;
    let mut c2 = draws.step;
    let mut c3 = draws.stream;
    let mut k0 = draws.seed_low;
    let mut k1 = draws.seed_high;
    for _ in 0..10u32 {
        let a_high = u32::mul_hi(c0, 0xD251_1F53u32);
        let a_low = c0 * 0xD251_1F53u32;
        let b_high = u32::mul_hi(c2, 0xCD9E_8D57u32);
        let b_low = c2 * 0xCD9E_8D57u32;
        c0 = b_high ^ c1 ^ k0;
        c1 = b_low;
        c2 = a_high ^ c3 ^ k1;
        c3 = a_low;
        k0 += 0x9E37_79B9u32;
        k1 += 0xBB67_AE85u32;
    }
    Words { w0: c0, w1: c1, w2: c2, w3: c3 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::draw as draw_on_host;
    use burn::tensor::DType;
    use gazesplat_render::device::gpu_device;
    use gazesplat_render::gpu::{Gpu, cube_dim};
    use gazesplat_testkit::devices::required_gpu;

    #[cube(launch)]
    fn draw_all(out: &mut [u32], draws: Draws, len: u32) {
        let at = ABSOLUTE_POS;
        if at < len as usize {
            let words = draw(&draws, at as u32);
            out[4 * at] = words.w0;
            out[4 * at + 1] = words.w1;
            out[4 * at + 2] = words.w2;
            out[4 * at + 3] = words.w3;
        }
    }

    #[test]
    fn words_equal_those_of_the_cpu() {
        let Some(gpu) = required_gpu(gpu_device(None)).and_then(|device| Gpu::from_device(&device)) else { return };
        let (seed, step, len) = (0x1234_5678_9abc_def0, 77, 1000);
        let out = gpu.empty("bytes of a test", &[4 * len], DType::U32).expect("it fits");
        let draws = DrawsLaunch::of(seed, Stream::Noise, step);
        draw_all::launch(&gpu.client, gpu.units(len), cube_dim(), out.clone().into_buffer_arg(), draws, len as u32);
        let expected: Vec<u32> = (0..len as u64).flat_map(|i| draw_on_host(seed, Stream::Noise, step, i)).collect();
        assert_eq!(gpu.read_u32(&out).expect("the adapter answers"), expected);
    }
}
