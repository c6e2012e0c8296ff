//! HVSQ once more, in float64 and as plainly as possible: what the fast one is judged by, in float64 as well.
//!
//! Written from the specification: whole maps, every tap of every filter, every sample of every pool, no adjoints. Images
//! are planes of channels, `[3, height, width]`, encoded RGB.

pub mod images;
mod pooling;
#[cfg(test)]
mod tests;

pub use pooling::{Gaze, pooling_px};
use pooling::{gaze_pooled, resized, uniform_pooled};

/// A filter of 5 × 5 taps, rows from the top, not flipped.
pub type Filter = [[f64; 5]; 5];

/// Filters of a pyramid.
#[derive(Debug, Clone, PartialEq)]
pub struct Bank {
    /// Low-pass.
    pub low: Filter,
    /// High-pass.
    pub high: Filter,
    /// Oriented bands.
    pub bands: Vec<Filter>,
}

/// What features are pooled over.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pooling {
    /// Squares of this side everywhere.
    Uniform(f64),
    /// Regions that grow with eccentricity.
    Gaze(Gaze),
}

/// Distance between values of a map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Distance {
    /// Squared difference.
    Mse,
    /// Absolute difference.
    L1,
}

/// One channel of an image, or a map.
#[derive(Debug, Clone, PartialEq)]
pub struct Plane {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Rows from the top.
    pub values: Vec<f64>,
}

impl Plane {
    /// A plane of `value(x, y)`.
    pub fn new(width: usize, height: usize, value: impl Fn(usize, usize) -> f64) -> Self {
        Self { width, height, values: (0..width * height).map(|i| value(i % width, i / width)).collect() }
    }

    /// Value of a pixel.
    pub fn at(&self, x: usize, y: usize) -> f64 {
        self.values[y * self.width + x]
    }

    fn map(&self, f: impl Fn(f64) -> f64) -> Self {
        Self { values: self.values.iter().map(|v| f(*v)).collect(), ..*self }
    }
}

/// Channels of an encoded image, as [`Plane`]s R, G, B.
pub fn planes(width: usize, height: usize, rgb: &[f32]) -> [Plane; 3] {
    let value = |c: usize| move |x: usize, y: usize| f64::from(rgb[(c * height + y) * width + x]);
    [0, 1, 2].map(|c| Plane::new(width, height, value(c)))
}

/// Maps of a pyramid: its level, its filter ("h0", "b0" … or "l0") and the response, by channel Y, Cr, Cb.
pub fn pyramid(image: &[Plane; 3], bank: &Bank) -> Vec<(usize, String, [Plane; 3])> {
    let (width, height) = (image[0].width, image[0].height);
    let enlarged = image.each_ref().map(|p| resized(p, width.next_multiple_of(32), height.next_multiple_of(32)));
    let channels = ycrcb(&enlarged);
    let mut maps = vec![(0, "h0".to_string(), channels.each_ref().map(|c| filtered(c, &bank.high)))];
    let mut low = channels.each_ref().map(|c| filtered(c, &bank.low));
    for level in 0..4 {
        for (o, band) in bank.bands.iter().enumerate() {
            maps.push((level, format!("b{o}"), low.each_ref().map(|c| filtered(c, band))));
        }
        low = low.each_ref().map(halved);
    }
    maps.push((4, "l0".to_string(), low));
    maps
}

/// HVSQ of two images of one size, over pixels for which `is_inside(x, y)` holds in the enlarged image.
pub fn hvsq_of_region(
    a: &[Plane; 3],
    b: &[Plane; 3],
    bank: &Bank,
    pooling: &Pooling,
    distance: Distance,
    is_inside: &dyn Fn(usize, usize) -> bool,
) -> f64 {
    let (maps_a, maps_b) = (pyramid(a, bank), pyramid(b, bank));
    let full = &maps_a[0].2[0];
    let mask = Plane::new(full.width, full.height, |x, y| f64::from(u8::from(is_inside(x, y))));
    let mut masks = vec![mask];
    for level in 1..5 {
        masks.push(halved(&masks[level - 1]));
    }
    let (mut sum, mut num_maps) = (0.0, 0);
    for ((level, name, map_a), (_, _, map_b)) in maps_a.iter().zip(&maps_b) {
        let mask = &masks[*level];
        let mean = |pairs: &[(Plane, Plane)]| {
            let (mut total, mut weights) = (0.0, 0.0);
            for (a, b) in pairs {
                for ((a, b), w) in a.values.iter().zip(&b.values).zip(&mask.values) {
                    let d = a - b;
                    total += w * if distance == Distance::Mse { d * d } else { d.abs() };
                    weights += w;
                }
            }
            total / weights
        };
        let pairs: Vec<_> = map_a.iter().zip(map_b).collect();
        if name == "l0" {
            sum += mean(&pairs.iter().map(|(a, b)| ((*a).clone(), (*b).clone())).collect::<Vec<_>>());
            num_maps += 1;
            continue;
        }
        let statistics = |x: &Plane| statistics(x, (full.width, full.height), pooling);
        let of_both: Vec<_> = pairs.iter().map(|(a, b)| (statistics(a), statistics(b))).collect();
        sum += mean(&of_both.iter().map(|((m, _), (n, _))| (m.clone(), n.clone())).collect::<Vec<_>>());
        sum += mean(&of_both.iter().map(|((_, s), (_, t))| (s.clone(), t.clone())).collect::<Vec<_>>());
        num_maps += 2;
    }
    sum / f64::from(num_maps)
}

/// HVSQ of two images of one size.
pub fn hvsq(a: &[Plane; 3], b: &[Plane; 3], bank: &Bank, pooling: &Pooling, distance: Distance) -> f64 {
    hvsq_of_region(a, b, bank, pooling, distance, &|_, _| true)
}

/// Pooled mean and standard deviation of a map of any level of an image of `full` size.
pub fn statistics(x: &Plane, full: (usize, usize), pooling: &Pooling) -> (Plane, Plane) {
    let pooled = |x: &Plane| match pooling {
        Pooling::Uniform(p) => uniform_pooled(x, full, *p),
        Pooling::Gaze(gaze) => gaze_pooled(x, gaze),
    };
    let (mean, square) = (pooled(x), pooled(&x.map(|v| v * v)));
    let deviation = mean.values.iter().zip(&square.values).map(|(m, q)| (q - m * m).max(1e-7).sqrt()).collect();
    let deviation = Plane { values: deviation, ..mean };
    (mean, deviation)
}

fn ycrcb(rgb: &[Plane; 3]) -> [Plane; 3] {
    let at = |c: usize, x: usize, y: usize| rgb[c].at(x, y);
    let luma = |x, y| 0.299 * at(0, x, y) + 0.587 * at(1, x, y) + 0.114 * at(2, x, y);
    let (w, h) = (rgb[0].width, rgb[0].height);
    [
        Plane::new(w, h, luma),
        Plane::new(w, h, |x, y| 0.5 + 0.713 * (at(0, x, y) - luma(x, y))),
        Plane::new(w, h, |x, y| 0.5 + 0.564 * (at(2, x, y) - luma(x, y))),
    ]
}

/// Cross-correlation, the border reflected without repeating the edge.
fn filtered(x: &Plane, filter: &Filter) -> Plane {
    let place = |i: usize, tap: usize, n: usize| {
        let at = (i + tap) as i64 - 2;
        let last = n as i64 - 1;
        (if at < 0 {
            -at
        } else if at > last {
            2 * last - at
        } else {
            at
        }) as usize
    };
    Plane::new(x.width, x.height, |column, row| {
        let mut sum = 0.0;
        for (i, taps) in filter.iter().enumerate() {
            for (j, tap) in taps.iter().enumerate() {
                sum += tap * x.at(place(column, j, x.width), place(row, i, x.height));
            }
        }
        sum
    })
}

fn halved(x: &Plane) -> Plane {
    Plane::new(x.width / 2, x.height / 2, |c, r| {
        let (c, r) = (2 * c, 2 * r);
        0.25 * (x.at(c, r) + x.at(c + 1, r) + x.at(c, r + 1) + x.at(c + 1, r + 1))
    })
}
