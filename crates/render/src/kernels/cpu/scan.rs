//! Exclusive prefix sum of counts: where the part of each begins when all lie one behind the other.

/// Sums of everything before each count, and behind them the sum of all: one longer than the input. The caller has
/// checked that the sum fits.
pub fn exclusive_scan(counts: impl IntoIterator<Item = u32>) -> Vec<u32> {
    let counts = counts.into_iter();
    let mut sums = Vec::with_capacity(counts.size_hint().0 + 1);
    let mut sum = 0;
    sums.push(0);
    for count in counts {
        sum += count;
        sums.push(sum);
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::exclusive_scan;

    #[test]
    fn sums_begin_at_zero_and_end_with_the_total() {
        assert_eq!(exclusive_scan([3, 0, 5]), [0, 3, 3, 8]);
        assert_eq!(exclusive_scan([]), [0]);
    }
}
