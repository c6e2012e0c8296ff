//! From the colours of an image to the planes of a pyramid: bilinear enlargement, then Y, Cr, Cb; and the adjoint.

use super::{Plane, RADIUS, reflect_columns};
use crate::kernels::cpu::pooling::Bilinear;
use crate::real::Real;
use rayon::prelude::*;

/// Colour values of an image on the host.
#[derive(Debug, Clone, Copy)]
pub struct ImageView<'a, T> {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Values per pixel, at least 3; the first three are RGB, sRGB-encoded, nominally 0..1; the others are not looked at.
    pub channels: usize,
    /// `[height, width, channels]`.
    pub data: &'a [T],
}

/// Y, Cr, Cb of an encoded colour (ITU-R BT.601).
#[inline(always)]
fn ycrcb<T: Real>(r: T, g: T, b: T) -> [T; 3] {
    let y = (T::of(0.299) * r + T::of(0.587) * g) + T::of(0.114) * b;
    [y, T::of(0.5) + T::of(0.713) * (r - y), T::of(0.5) + T::of(0.564) * (b - y)]
}

/// Adjoint of [`ycrcb`].
#[inline(always)]
fn ycrcb_bwd<T: Real>(v_y: T, v_cr: T, v_cb: T) -> [T; 3] {
    let v_cr = T::of(0.713) * v_cr;
    let v_cb = T::of(0.564) * v_cb;
    let v_y = v_y - (v_cr + v_cb);
    [T::of(0.299) * v_y + v_cr, T::of(0.587) * v_y, T::of(0.114) * v_y + v_cb]
}

/// How an image is brought to the size the pyramid needs.
#[derive(Debug, Clone)]
pub(crate) struct Resize<T> {
    /// Size of the image: width, height.
    pub from: (usize, usize),
    /// Size of the planes.
    pub to: (usize, usize),
    columns: Bilinear<T>,
    rows: Bilinear<T>,
}

impl<T: Real> Resize<T> {
    pub fn new(from: (usize, usize), to: (usize, usize)) -> Self {
        Self { from, to, columns: Bilinear::new(to.0, from.0), rows: Bilinear::new(to.1, from.1) }
    }

    /// Channels Y, Cr, Cb of the resized image. Bilinear interpolation keeps an image whose size is right as it is.
    pub fn planes(&self, image: &ImageView<'_, T>) -> [Plane<T>; 3] {
        let (width, height) = self.to;
        let mut planes: [Plane<T>; 3] = std::array::from_fn(|_| Plane::zeros(width, height));
        let [y_plane, cr_plane, cb_plane] = &mut planes;
        let rows = y_plane.rows_mut().zip(cr_plane.rows_mut()).zip(cb_plane.rows_mut()).enumerate();
        let c = image.channels;
        rows.for_each(|(row, ((ys, crs), cbs))| {
            let input = |r: usize| &image.data[r * image.width * c..][..image.width * c];
            let (upper, lower, down) = self.rows.source(row);
            let (upper, lower) = (input(upper), input(lower));
            for x in 0..width {
                let at = RADIUS + x;
                let (left, right, across) = self.columns.source(x);
                let value = |channel: usize| {
                    let mix = |row: &[T]| {
                        let (a, b) = (row[left * c + channel], row[right * c + channel]);
                        if across == T::ZERO { a } else { (T::ONE - across) * a + across * b }
                    };
                    if down == T::ZERO { mix(upper) } else { (T::ONE - down) * mix(upper) + down * mix(lower) }
                };
                [ys[at], crs[at], cbs[at]] = ycrcb(value(0), value(1), value(2));
            }
            for plane_row in [ys, crs, cbs] {
                reflect_columns(plane_row, width);
            }
        });
        planes
    }

    /// The gradient by the image, `[height, width, channels]`, zero beyond RGB, from those by the three planes, each
    /// `[height, width]` of the resized size; these are overwritten.
    pub fn planes_bwd(&self, v_planes: &mut [Vec<T>; 3], channels: usize) -> Vec<T> {
        let (width, _) = self.to;
        let [v_y, v_cr, v_cb] = v_planes;
        v_y.par_chunks_mut(width).zip(v_cr.par_chunks_mut(width)).zip(v_cb.par_chunks_mut(width)).for_each(
            |((v_y, v_cr), v_cb)| {
                for ((y, cr), cb) in v_y.iter_mut().zip(v_cr).zip(v_cb) {
                    [*y, *cr, *cb] = ycrcb_bwd(*y, *cr, *cb);
                }
            },
        );
        let v_planes = [&*v_y, &*v_cr, &*v_cb];
        let mut v_image = vec![T::ZERO; self.from.0 * self.from.1 * channels];
        v_image.par_chunks_mut(self.from.0 * channels).enumerate().for_each(|(row, v_row)| {
            let mut sums = vec![T::ZERO; width];
            for (channel, plane) in v_planes.iter().enumerate() {
                sums.fill(T::ZERO);
                for (r, weight) in self.rows.targets(row) {
                    for (sum, v) in sums.iter_mut().zip(&plane[r * width..][..width]) {
                        *sum += weight * *v;
                    }
                }
                for (x, pixel) in v_row.chunks_exact_mut(channels).enumerate() {
                    pixel[channel] = self.columns.gathered(x, &sums);
                }
            }
        });
        v_image
    }
}
