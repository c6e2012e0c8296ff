//! Parts of an image over which means are taken.

use super::enlarged;
use crate::hvs::pyramid::LEVELS;
use crate::real::Real;

/// A partition of the image, as weights on every level.
#[derive(Debug, Clone)]
pub(crate) struct Regions<T> {
    /// By level, by region: `[height, width]` of the level.
    pub(super) weights: Vec<Vec<Vec<T>>>,
    /// By level, by region: the sum of the weights.
    pub(super) totals: Vec<Vec<f64>>,
}

impl<T: Real> Regions<T> {
    /// Regions 0..`num_regions` of an image of `size`, from the region of every pixel, `[height, width]`; the label of a
    /// pixel of the enlarged image is that of the nearest pixel. Labels from `num_regions` on belong to no region.
    pub fn new(labels: &[u8], size: (usize, usize), num_regions: usize) -> Self {
        let (width, height) = enlarged(size);
        let nearest = |i: usize, to: usize, from: usize| ((2 * i + 1) * from / (2 * to)).min(from - 1);
        let mut weights: Vec<Vec<Vec<T>>> = vec![
            (0..num_regions)
                .map(|k| {
                    let is_inside = |i: usize| {
                        let (x, y) = (nearest(i % width, width, size.0), nearest(i / width, height, size.1));
                        usize::from(labels[y * size.0 + x]) == k
                    };
                    (0..width * height).map(|i| if is_inside(i) { T::ONE } else { T::ZERO }).collect()
                })
                .collect(),
        ];
        for l in 1..LEVELS {
            let (w, h) = (width >> l, height >> l);
            let halved = |finer: &Vec<T>| {
                let at = |x: usize, y: usize| finer[y * 2 * w + x];
                let mean = |i: usize| {
                    let (x, y) = (i % w * 2, i / w * 2);
                    (at(x, y) + at(x + 1, y) + at(x, y + 1) + at(x + 1, y + 1)) * T::of(0.25)
                };
                (0..w * h).map(mean).collect()
            };
            weights.push(weights[l - 1].iter().map(halved).collect());
        }
        let total = |weights: &Vec<T>| weights.iter().map(|w| w.to_f64()).sum();
        let totals = weights.iter().map(|level| level.iter().map(total).collect()).collect();
        Self { weights, totals }
    }

    /// Weights and their sum of region `k`, level by level.
    #[cfg(feature = "gpu")]
    pub fn levels(&self, k: usize) -> impl Iterator<Item = (&[T], f64)> {
        self.weights.iter().zip(&self.totals).map(move |(weights, totals)| (&weights[k][..], totals[k]))
    }

    /// How many there are.
    pub fn num_regions(&self) -> usize {
        self.totals[0].len()
    }

    /// Whether no pixel belongs to region `k`.
    pub fn is_empty(&self, k: usize) -> bool {
        self.totals[0][k] == 0.0
    }
}
