//! Front-to-back order of the visible splats.
//!
//! Least-significant-digit radix sort of (depth bits, index), 11 bits a pass. Depths are positive and finite, so their
//! bits order like their values; the sort is stable, so equal depths keep the order of their indices. Empty input gives
//! an empty order.

use rayon::prelude::*;

const DIGIT_BITS: u32 = 11;
const NUM_DIGITS: usize = 1 << DIGIT_BITS;

/// Indices 0..depths.len() ordered by depth, ties by index. `depths`: positive, finite, world units.
pub fn depth_order(depths: &[f32]) -> Vec<u32> {
    let mut from: Vec<(u32, u32)> =
        depths.par_iter().with_min_len(4096).enumerate().map(|(i, d)| (d.to_bits(), i as u32)).collect();
    let mut to = vec![(0, 0); from.len()];
    for shift in (0..u32::BITS).step_by(DIGIT_BITS as usize) {
        let digit = |key: u32| (key >> shift) as usize & (NUM_DIGITS - 1);
        let mut starts = [0u32; NUM_DIGITS];
        for &(key, _) in &from {
            starts[digit(key)] += 1;
        }
        // All keys share the digit: the pass would copy.
        if starts.contains(&(from.len() as u32)) {
            continue;
        }
        let mut total = 0;
        for start in &mut starts {
            total += std::mem::replace(start, total);
        }
        for &(key, index) in &from {
            let slot = &mut starts[digit(key)];
            to[*slot as usize] = (key, index);
            *slot += 1;
        }
        std::mem::swap(&mut from, &mut to);
    }
    from.into_iter().map(|(_, index)| index).collect()
}

#[cfg(test)]
mod tests {
    use super::depth_order;

    #[test]
    fn order_is_by_depth_then_index_over_nine_decades() {
        let depths: Vec<f32> =
            (0..5000u32).map(|i| 1e-2 * 10f32.powf((i.wrapping_mul(2_654_435_761) % 700) as f32 / 77.0)).collect();
        let mut expected: Vec<u32> = (0..5000).collect();
        expected.sort_by(|&a, &b| depths[a as usize].total_cmp(&depths[b as usize]).then(a.cmp(&b)));
        assert_eq!(depth_order(&depths), expected);
    }

    #[test]
    fn equal_depths_keep_index_order() {
        assert_eq!(depth_order(&[2.0; 100]), (0..100).collect::<Vec<u32>>());
        assert!(depth_order(&[]).is_empty());
    }
}
