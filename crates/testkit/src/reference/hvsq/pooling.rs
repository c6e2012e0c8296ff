//! Averages over pools of one size, and over pools that grow with the distance from the gaze.

use super::Plane;

/// Where somebody looks, and how the image is seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gaze {
    /// Width of the image over its distance.
    pub width: f64,
    /// Point looked at, in image units.
    pub gaze: [f64; 2],
    /// Growth: the pooling angle is α e².
    pub alpha: f64,
    /// Pixels on the ends of the image instead of at their centres.
    pub end_points: bool,
}

/// Pooling size in pixels of an image of `width` × `height`, at column `i` and row `j`.
pub fn pooling_px(gaze: &Gaze, width: usize, height: usize, i: usize, j: usize) -> f64 {
    let place = |i: usize, n: usize| {
        if gaze.end_points { i as f64 / (n - 1) as f64 } else { (i as f64 + 0.5) / n as f64 }
    };
    let w = gaze.width;
    let aspect = height as f64 / width as f64;
    let (x, y) = ((place(i, width) - 0.5) * w, (place(j, height) - 0.5) * w * aspect);
    let (gx, gy) = ((gaze.gaze[0] - 0.5) * w, (gaze.gaze[1] - 0.5) * w * aspect);
    let distance = (x * x + y * y + 1.0).sqrt();
    let cosine = (x * gx + y * gy + 1.0) / (distance * (gx * gx + gy * gy + 1.0).sqrt());
    let e = cosine.clamp(-1.0, 1.0).acos();
    let e_c = (1.0 / distance).clamp(-1.0, 1.0).acos();
    let q = gaze.alpha * e * e;
    let major = (e_c + q / 2.0).min(1.55).tan() - (e_c - q / 2.0).tan();
    let minor = 2.0 * distance * (q / 2.0).tan();
    (std::f64::consts::FRAC_PI_4 * major * minor).abs().sqrt() / w * width as f64
}

/// Means over `m` cells of `n` samples; cells may overlap.
fn cell_means(x: &Plane, columns: usize, rows: usize) -> Plane {
    let range = |i: usize, n: usize, m: usize| i * n / m..((i + 1) * n).div_ceil(m);
    Plane::new(columns, rows, |i, j| {
        let (mut sum, mut count) = (0.0, 0.0);
        for r in range(j, x.height, rows) {
            for c in range(i, x.width, columns) {
                sum += x.at(c, r);
                count += 1.0;
            }
        }
        sum / count
    })
}

/// Bilinear interpolation, half-pixel centres, clamped.
pub(super) fn resized(x: &Plane, width: usize, height: usize) -> Plane {
    let source = |s: usize, n: usize, m: usize| {
        let c = ((s as f64 + 0.5) * m as f64 / n as f64 - 0.5).max(0.0);
        let i = (c.floor() as usize).min(m - 1);
        (i, (i + 1).min(m - 1), c - i as f64)
    };
    Plane::new(width, height, |c, r| {
        let (x0, x1, wx) = source(c, width, x.width);
        let (y0, y1, wy) = source(r, height, x.height);
        let upper = (1.0 - wx) * x.at(x0, y0) + wx * x.at(x1, y0);
        let lower = (1.0 - wx) * x.at(x0, y1) + wx * x.at(x1, y1);
        (1.0 - wy) * upper + wy * lower
    })
}

/// Averages over squares of `p` pixels of an image of `full` size.
pub(super) fn uniform_pooled(x: &Plane, full: (usize, usize), p: f64) -> Plane {
    let cells = |n: usize| (n as f64 / p).floor() as usize;
    resized(&cell_means(x, cells(full.0), cells(full.1)), x.width, x.height)
}

/// Averages over pools around every pixel: two mips, blended.
pub(super) fn gaze_pooled(x: &Plane, gaze: &Gaze) -> Plane {
    let mut mips = vec![x.clone()];
    while let Some(last) = mips.last().filter(|m| m.width > 1 || m.height > 1) {
        mips.push(cell_means(last, (last.width / 2).max(1), (last.height / 2).max(1)));
    }
    let enlarged: Vec<Plane> = mips.iter().map(|m| resized(m, x.width, x.height)).collect();
    Plane::new(x.width, x.height, |c, r| {
        let lod = (1e-6 + pooling_px(gaze, x.width, x.height, c, r)).log2().max(0.0);
        let k = lod.floor() as usize;
        if k + 1 >= enlarged.len() {
            return enlarged[enlarged.len() - 1].at(c, r);
        }
        let f = lod - k as f64;
        (1.0 - f) * enlarged[k].at(c, r) + f * enlarged[k + 1].at(c, r)
    })
}
