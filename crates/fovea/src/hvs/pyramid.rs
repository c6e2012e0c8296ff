//! The oriented band-pass pyramid whose responses are the features of HVSQ: its filters.
//!
//! Five levels: a high-pass of the image at full resolution, four levels of oriented bands of its low-pass, each half
//! the size of the one before, and what is left of the low-pass. Simoncelli's steerable filters, cut to 5 × 5 taps.

use crate::error::{Error, Result};

/// Levels, counting the low-pass residual.
pub const LEVELS: usize = 5;
/// Levels that carry oriented bands.
pub const BAND_LEVELS: usize = LEVELS - 1;
/// Sides of the image are enlarged to multiples of this: every halving is exact.
pub const SIDE_MULTIPLE: usize = 1 << LEVELS;
/// Width of a filter.
pub const TAPS: usize = 5;

/// A filter: rows from the top, applied as cross-correlation (not flipped).
pub type Taps = [[f64; TAPS]; TAPS];

/// What integer taps are multiples of.
const TAP_SCALE: f64 = 1e-8;

/// High-pass of [`FilterBank::sp5`].
const SP5_HIGH: [[i64; 5]; 5] = [
    [-290081, -673482, -981051, -673482, -290081],
    [-673482, -7027679, -11435863, -7027679, -673482],
    [-981051, -11435863, 81380200, -11435863, -981051],
    [-673482, -7027679, -11435863, -7027679, -673482],
    [-290081, -673482, -981051, -673482, -290081],
];
/// Low-pass of [`FilterBank::sp5`].
const SP5_LOW: [[i64; 5]; 5] = [
    [341614, -1551246, -3848215, -1551246, 341614],
    [-1551246, 5586982, 15925570, 5586982, -1551246],
    [-3848215, 15925570, 40304148, 15925570, -3848215],
    [-1551246, 5586982, 15925570, 5586982, -1551246],
    [341614, -1551246, -3848215, -1551246, 341614],
];
/// Bands of [`FilterBank::sp5`].
const SP5_BANDS: [[[i64; 5]; 5]; 6] = [
    [
        [-893064, -3075356, 0, 3075356, 893064],
        [1189859, -8226445, 0, 8226445, -1189859],
        [2755155, -11732297, 0, 11732297, -2755155],
        [1189859, -8226445, 0, 8226445, -1189859],
        [-893064, -3075356, 0, 3075356, 893064],
    ],
    [
        [-1977507, 1486305, 4435647, -853965, -1161195],
        [-4084211, -4819057, 9454202, 5394139, -3930573],
        [-228219, -12227230, 0, 12227230, 228219],
        [3930573, -5394139, -9454202, 4819057, 4084211],
        [1161195, 853965, -4435647, -1486305, 1977507],
    ],
    [
        [1977507, 4084211, 228219, -3930573, -1161195],
        [-1486305, 4819057, 12227230, 5394139, -853965],
        [-4435647, -9454202, 0, 9454202, 4435647],
        [853965, -5394139, -12227230, -4819057, 1486305],
        [1161195, 3930573, -228219, -4084211, -1977507],
    ],
    [
        [893064, -1189859, -2755155, -1189859, 893064],
        [3075356, 8226445, 11732297, 8226445, 3075356],
        [0, 0, 0, 0, 0],
        [-3075356, -8226445, -11732297, -8226445, -3075356],
        [-893064, 1189859, 2755155, 1189859, -893064],
    ],
    [
        [-1161195, -3930573, 228219, 4084211, 1977507],
        [-853965, 5394139, 12227230, 4819057, -1486305],
        [4435647, 9454202, 0, -9454202, -4435647],
        [1486305, -4819057, -12227230, -5394139, 853965],
        [-1977507, -4084211, -228219, 3930573, 1161195],
    ],
    [
        [-1161195, -853965, 4435647, 1486305, -1977507],
        [-3930573, 5394139, 9454202, -4819057, -4084211],
        [228219, 12227230, 0, -12227230, -228219],
        [4084211, 4819057, -9454202, -5394139, 3930573],
        [1977507, -1486305, -4435647, 853965, 1161195],
    ],
];

/// The filters of a pyramid.
#[derive(Debug, Clone, PartialEq)]
pub struct FilterBank {
    low: Taps,
    high: Taps,
    bands: Vec<Taps>,
}

impl FilterBank {
    /// A bank of a low-pass, a high-pass and oriented bands.
    ///
    /// # Errors
    /// [`Error::Parameter`] when there is no band or a tap is not finite.
    pub fn new(low: Taps, high: Taps, bands: Vec<Taps>) -> Result<Self> {
        if bands.is_empty() {
            return Err(Error::parameter("bands of a filter bank", 0, "at least one"));
        }
        let taps = [&low, &high].into_iter().chain(&bands).flatten().flatten();
        if let Some(tap) = taps.copied().find(|t| !t.is_finite()) {
            return Err(Error::parameter("tap of a filter", tap, "a finite number"));
        }
        Ok(Self { low, high, bands })
    }

    /// Six orientations: Simoncelli's `sp5` filters, cut to their central 5 × 5 taps; every tap is an exact multiple of
    /// 1e-8 and the bands sum to zero.
    pub fn sp5() -> Self {
        let taps = |t: &[[i64; 5]; 5]| t.map(|row| row.map(|v| v as f64 * TAP_SCALE));
        Self { low: taps(&SP5_LOW), high: taps(&SP5_HIGH), bands: SP5_BANDS.iter().map(taps).collect() }
    }

    /// The low-pass in front of the levels.
    pub fn low(&self) -> &Taps {
        &self.low
    }

    /// The high-pass of the image.
    pub fn high(&self) -> &Taps {
        &self.high
    }

    /// The oriented bands.
    pub fn bands(&self) -> &[Taps] {
        &self.bands
    }

    /// Maps an HVSQ is the mean of: mean and standard deviation of every response, and the residual.
    pub fn num_maps(&self) -> usize {
        2 * (1 + BAND_LEVELS * self.bands.len()) + 1
    }
}

impl Default for FilterBank {
    fn default() -> Self {
        Self::sp5()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn total(taps: &[[i64; 5]; 5]) -> i64 {
        taps.iter().flatten().sum()
    }

    /// The checks that come with the table of taps.
    #[test]
    fn taps_have_their_symmetries_and_sums_exactly() {
        assert_eq!((total(&SP5_HIGH), total(&SP5_LOW)), (-2946352, 99917984));
        for taps in [SP5_HIGH, SP5_LOW] {
            for i in 0..5 {
                for j in 0..5 {
                    assert_eq!([taps[j][i], taps[4 - i][j], taps[i][4 - j]], [taps[i][j]; 3]);
                }
            }
        }
        for (o, band) in SP5_BANDS.iter().enumerate() {
            assert_eq!(total(band), 0);
            for i in 0..5 {
                for j in 0..5 {
                    assert_eq!(band[4 - i][4 - j], -band[i][j], "band {o}");
                }
            }
        }
        let [b0, b1, b2, b3, b4, b5] = SP5_BANDS;
        for i in 0..5 {
            for j in 0..5 {
                assert_eq!((b3[i][j], b2[i][j]), (-b0[j][i], -b1[j][i]));
                assert_eq!((b4[i][j], b5[i][j]), (b2[i][4 - j], b1[i][4 - j]));
            }
        }
    }

    #[test]
    fn six_orientations_make_51_maps_and_two_make_19() {
        let sp5 = FilterBank::sp5();
        assert_eq!(sp5.num_maps(), 51);
        let two = FilterBank::new(sp5.low, sp5.high, sp5.bands[..2].to_vec()).unwrap();
        assert_eq!(two.num_maps(), 19);
    }

    #[test]
    fn a_bank_needs_bands_and_finite_taps() {
        let sp5 = FilterBank::sp5();
        assert!(matches!(FilterBank::new(sp5.low, sp5.high, vec![]), Err(Error::Parameter { .. })));
        let mut low = sp5.low;
        low[2][3] = f64::NAN;
        assert!(matches!(FilterBank::new(low, sp5.high, sp5.bands), Err(Error::Parameter { .. })));
    }
}
