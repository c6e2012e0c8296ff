//! Stable radix sort of (key, value) pairs of `u32`, four bits a pass, least significant first.
//!
//! Three steps a pass: every workgroup counts the digits of its 1024 pairs; the counts, digit by digit, are scanned;
//! every workgroup ranks its pairs and scatters them. A unit owns four consecutive pairs, so that rank follows order.
//! The number of pairs lies on the device: dispatches cover the most there can be, and workgroups beyond it do nothing.

use super::scan::exclusive_scan;
use crate::error::Result;
use crate::gpu::{Gpu, UNITS, cube_dim};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Bits of a digit: the counters of all 16 digits of a unit fit eight words.
const DIGIT_BITS: u32 = 4;
/// Number of digits.
const NUM_DIGITS: u32 = 1 << DIGIT_BITS;
/// Words that hold two 16-bit counters each.
const NUM_WORDS: u32 = NUM_DIGITS / 2;
/// Pairs of one unit.
const PER_UNIT: u32 = 4;
/// Pairs of one workgroup.
const PER_CUBE: u32 = UNITS * PER_UNIT;

/// Front-to-back order of the visible splats: their indices `ids` by the bits of their depths, which are positive and so
/// order like the depths; equal depths keep the order of their indices. Of `capacity` splats the first `count[count_at]` are
/// there.
///
/// # Errors
/// [`crate::Error::Limit`] when a buffer is larger than the adapter takes.
pub fn depth_order(
    gpu: &Gpu,
    depth_bits: CubeTensor,
    ids: CubeTensor,
    capacity: usize,
    count: &CubeTensor,
    count_at: usize,
) -> Result<CubeTensor> {
    Ok(radix_sort(gpu, depth_bits, ids, capacity, count, count_at, u32::BITS)?.1)
}

/// The pairs ordered by the low `key_bits` bits of their keys; pairs of equal keys keep their order.
///
/// `keys` and `values` hold `capacity` words, of which the first `count[count_at]` are pairs; what follows those in the
/// result is undefined.
///
/// # Errors
/// [`crate::Error::Limit`] when a buffer is larger than the adapter takes.
pub fn radix_sort(
    gpu: &Gpu,
    keys: CubeTensor,
    values: CubeTensor,
    capacity: usize,
    count: &CubeTensor,
    count_at: usize,
    key_bits: u32,
) -> Result<(CubeTensor, CubeTensor)> {
    let (mut keys, mut values) = (keys, values);
    if capacity == 0 {
        return Ok((keys, values));
    }
    let num_cubes = capacity.div_ceil(PER_CUBE as usize);
    let num_counts = num_cubes * NUM_DIGITS as usize;
    let mut shift = 0;
    while shift < key_bits {
        let counts = gpu.empty("bytes of digit counts", &[num_counts], DType::U32)?;
        count_digits::launch(
            &gpu.client,
            gpu.cubes(num_cubes),
            cube_dim(),
            keys.clone().into_buffer_arg(),
            count.clone().into_buffer_arg(),
            counts.clone().into_buffer_arg(),
            count_at as u32,
            num_cubes as u32,
            shift,
        );
        let starts = exclusive_scan(gpu, &counts, num_counts)?;
        let new_keys = gpu.empty("bytes of sort keys", &[capacity], DType::U32)?;
        let new_values = gpu.empty("bytes of sorted values", &[capacity], DType::U32)?;
        scatter::launch(
            &gpu.client,
            gpu.cubes(num_cubes),
            cube_dim(),
            keys.into_buffer_arg(),
            values.into_buffer_arg(),
            count.clone().into_buffer_arg(),
            starts.into_buffer_arg(),
            new_keys.clone().into_buffer_arg(),
            new_values.clone().into_buffer_arg(),
            count_at as u32,
            num_cubes as u32,
            shift,
        );
        (keys, values) = (new_keys, new_values);
        shift += DIGIT_BITS;
    }
    Ok((keys, values))
}

/// Digits of the pairs of each workgroup, `[16, workgroups]`.
#[cube(launch)]
fn count_digits(keys: &[u32], count: &[u32], counts: &mut [u32], count_at: u32, num_cubes: u32, shift: u32) {
    let shared = Shared::<[Atomic<u32>]>::new_slice(NUM_DIGITS as usize);
    let unit = UNIT_POS as usize;
    if UNIT_POS < NUM_DIGITS {
        shared[unit].store(0u32);
    }
    sync_cube();
    let len = count[count_at as usize] as usize;
    for k in 0..PER_UNIT as usize {
        let at = CUBE_POS * PER_CUBE as usize + k * UNITS as usize + unit;
        if at < len {
            let digit = (keys[at] >> shift) & (NUM_DIGITS - 1);
            shared[digit as usize].fetch_add(1u32);
        }
    }
    sync_cube();
    if UNIT_POS < NUM_DIGITS && CUBE_POS < num_cubes as usize {
        counts[unit * num_cubes as usize + CUBE_POS] = shared[unit].load();
    }
}

/// Moves every pair to its place.
#[cube(launch)]
fn scatter(
    keys: &[u32],
    values: &[u32],
    count: &[u32],
    starts: &[u32],
    new_keys: &mut [u32],
    new_values: &mut [u32],
    count_at: u32,
    num_cubes: u32,
    shift: u32,
) {
    // Counters of two digits a word, one word after the other for all units.
    let mut shared = Shared::<[u32]>::new_slice((NUM_WORDS * UNITS) as usize);
    let unit = UNIT_POS as usize;
    let units = UNITS as usize;
    let len = count[count_at as usize] as usize;
    let first = CUBE_POS * PER_CUBE as usize + unit * PER_UNIT as usize;
    // 1. Digits of this unit's pairs.
    for w in 0..NUM_WORDS as usize {
        shared[w * units + unit] = 0u32;
    }
    for k in 0..PER_UNIT as usize {
        if first + k < len {
            let digit = (keys[first + k] >> shift) & (NUM_DIGITS - 1);
            shared[(digit / 2) as usize * units + unit] += 1u32 << (16 * (digit % 2));
        }
    }
    sync_cube();
    // 2. Inclusive scan over the units, all words side by side. A workgroup holds 1024 pairs: no counter overflows.
    let mut distance = 1usize;
    while distance < units {
        let mut sums = Array::<u32>::new(NUM_WORDS as usize);
        #[unroll]
        for w in 0..NUM_WORDS as usize {
            let mut sum = shared[w * units + unit];
            if unit >= distance {
                sum += shared[w * units + unit - distance];
            }
            sums[w] = sum;
        }
        sync_cube();
        #[unroll]
        for w in 0..NUM_WORDS as usize {
            shared[w * units + unit] = sums[w];
        }
        sync_cube();
        distance *= 2;
    }
    // 3. Start of the digit in this workgroup, pairs of the units before, pairs of this unit before.
    for k in 0..PER_UNIT as usize {
        if first + k < len {
            let key = keys[first + k];
            let digit = (key >> shift) & (NUM_DIGITS - 1);
            let mut before = 0u32;
            if unit > 0 {
                let word = shared[(digit / 2) as usize * units + unit - 1];
                before = (word >> (16 * (digit % 2))) & 0xffffu32;
            }
            for j in 0..k {
                if (keys[first + j] >> shift) & (NUM_DIGITS - 1) == digit {
                    before += 1u32;
                }
            }
            let to = (starts[digit as usize * num_cubes as usize + CUBE_POS] + before) as usize;
            new_keys[to] = key;
            new_values[to] = values[first + k];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::scan::exclusive_scan;
    use super::radix_sort;
    use crate::gpu::Gpu;
    use gazesplat_testkit::{Rng, devices};

    fn gpu() -> Option<Gpu> {
        let device = devices::required_gpu(crate::device::gpu_device(None))?;
        Gpu::from_device(&device)
    }

    #[test]
    fn prefix_sums_equal_the_loop() {
        let Some(gpu) = gpu() else { return };
        let mut rng = Rng::new(1);
        for len in [0, 1, 3, 1023, 1024, 1025, 70_000, 1_100_000] {
            let values: Vec<u32> = (0..len).map(|_| rng.below(9) as u32).collect();
            let sums = exclusive_scan(&gpu, &gpu.upload_u32(&values, &[len]), len).expect("it fits");
            let mut sum = 0;
            let mut expected = vec![0];
            expected.extend(values.iter().map(|v| {
                sum += v;
                sum
            }));
            assert!(gpu.read_u32(&sums).expect("the adapter answers") == expected, "{len}");
        }
    }

    #[test]
    fn sorting_is_stable_and_stops_at_the_count() {
        let Some(gpu) = gpu() else { return };
        let mut rng = Rng::new(2);
        for (capacity, len, bits) in [(1, 1, 32), (1000, 1000, 13), (1025, 1024, 4), (40_000, 30_001, 32), (5, 0, 32)] {
            let keys: Vec<u32> = (0..capacity).map(|_| (rng.unit() * 4e9) as u32 >> (32 - bits)).collect();
            let values: Vec<u32> = (0..capacity as u32).collect();
            let [keys_on, values_on] = [&keys, &values].map(|v| gpu.upload_u32(v, &[capacity]));
            let count = gpu.upload_u32(&[7, len as u32], &[2]);
            let (k, v) = radix_sort(&gpu, keys_on, values_on, capacity, &count, 1, bits).expect("it fits");
            let [k, v] = [k, v].map(|t| gpu.read_u32(&t).expect("the adapter answers"));
            let mut expected: Vec<u32> = (0..len as u32).collect();
            expected.sort_by_key(|&i| keys[i as usize]);
            assert!(v[..len] == expected, "{capacity} {len} {bits}");
            assert!(k[..len].iter().zip(&expected).all(|(k, &i)| *k == keys[i as usize]));
        }
    }
}
