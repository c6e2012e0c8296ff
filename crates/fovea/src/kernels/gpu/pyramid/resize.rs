//! From the colours of an image to the planes of a pyramid: bilinear enlargement, then Y, Cr, Cb; and the adjoint. A unit
//! computes one pixel.

use super::Planes;
use crate::kernels::cpu::pooling::Axis as HostAxis;
use crate::kernels::gpu::pooling::{Axis, up_source, up_start, up_weight};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::Result;
use gazesplat_render::gpu::{Gpu, cube_dim};

/// How an image is brought to the size the pyramid needs.
#[derive(Debug, Clone)]
pub(crate) struct Resize {
    /// Size of the image: width, height.
    pub from: (usize, usize),
    /// Size of the planes.
    pub to: (usize, usize),
    columns: Axis,
    rows: Axis,
}

impl Resize {
    pub fn new(gpu: &Gpu, from: (usize, usize), to: (usize, usize)) -> Self {
        let axis = |to, from| Axis::new(gpu, &HostAxis::new(to, from));
        Self { from, to, columns: axis(to.0, from.0), rows: axis(to.1, from.1) }
    }

    /// Channels Y, Cr, Cb of the resized image, `[height, width, 3 or more]`, contiguous.
    ///
    /// # Errors
    /// [`gazesplat_render::Error::Limit`] when a buffer would be larger than the adapter takes.
    pub fn planes(&self, gpu: &Gpu, image: &CubeTensor) -> Result<Planes> {
        let planes = Planes::empty(gpu, self.to.0, self.to.1, 3)?;
        planes_kernel::launch(
            &gpu.client,
            gpu.units(self.to.0 * self.to.1),
            cube_dim(),
            image.clone().into_buffer_arg(),
            self.columns.words.clone().into_buffer_arg(),
            self.rows.words.clone().into_buffer_arg(),
            planes.data.clone().into_buffer_arg(),
            self.from.0 as u32,
            self.from.1 as u32,
            self.to.0 as u32,
            self.to.1 as u32,
            image.meta.shape()[2] as u32,
        );
        Ok(planes)
    }

    /// The gradient by the image, `[height, width, channels]`, zero beyond RGB, from those by the planes.
    ///
    /// # Errors
    /// As [`Resize::planes`].
    pub fn planes_bwd(&self, gpu: &Gpu, v_planes: &Planes, channels: usize) -> Result<CubeTensor> {
        let shape = [self.from.1, self.from.0, channels];
        let v_image = gpu.empty("bytes of the gradient of an image", &shape, DType::F32)?;
        planes_bwd_kernel::launch(
            &gpu.client,
            gpu.units(self.from.0 * self.from.1),
            cube_dim(),
            v_planes.data.clone().into_buffer_arg(),
            self.columns.words.clone().into_buffer_arg(),
            self.rows.words.clone().into_buffer_arg(),
            v_image.clone().into_buffer_arg(),
            self.from.0 as u32,
            self.from.1 as u32,
            self.to.0 as u32,
            self.to.1 as u32,
            channels as u32,
        );
        Ok(v_image)
    }
}

/// Two values mixed; the second is not looked at where it has no weight.
#[cube]
fn mixed(a: f32, b: f32, weight: f32) -> f32 {
    let mut value = a;
    if weight != 0.0_f32 {
        value = (1.0_f32 - weight) * a + weight * b;
    }
    value
}

#[cube(launch)]
fn planes_kernel(
    image: &[f32],
    columns: &[u32],
    rows: &[u32],
    planes: &mut [f32],
    from_width: u32,
    from_height: u32,
    width: u32,
    height: u32,
    channels: u32,
) {
    let (width, height, channels) = (width as usize, height as usize, channels as usize);
    let (from_width, from_height) = (from_width as usize, from_height as usize);
    let size = width * height;
    if ABSOLUTE_POS < size {
        let across = up_source(columns, width, from_width, ABSOLUTE_POS % width);
        let down = up_source(rows, height, from_height, ABSOLUTE_POS / width);
        let upper = down.first * from_width;
        let lower = down.second * from_width;
        let mut color = Array::<f32>::new(3usize);
        #[unroll]
        for c in 0..3usize {
            let a = image[(upper + across.first) * channels + c];
            let b = image[(upper + across.second) * channels + c];
            let d = image[(lower + across.first) * channels + c];
            let e = image[(lower + across.second) * channels + c];
            color[c] = mixed(mixed(a, b, across.weight), mixed(d, e, across.weight), down.weight);
        }
        let luma = (0.299_f32 * color[0] + 0.587_f32 * color[1]) + 0.114_f32 * color[2];
        planes[ABSOLUTE_POS] = luma;
        planes[size + ABSOLUTE_POS] = 0.5_f32 + 0.713_f32 * (color[0] - luma);
        planes[2 * size + ABSOLUTE_POS] = 0.5_f32 + 0.564_f32 * (color[2] - luma);
    }
}

#[cube(launch)]
fn planes_bwd_kernel(
    v_planes: &[f32],
    columns: &[u32],
    rows: &[u32],
    v_image: &mut [f32],
    from_width: u32,
    from_height: u32,
    width: u32,
    height: u32,
    channels: u32,
) {
    let (width, height, channels) = (width as usize, height as usize, channels as usize);
    let (from_width, from_height) = (from_width as usize, from_height as usize);
    if ABSOLUTE_POS < from_width * from_height {
        let (column, row) = (ABSOLUTE_POS % from_width, ABSOLUTE_POS / from_width);
        let mut v_luma = 0.0_f32;
        let mut v_red = 0.0_f32;
        let mut v_blue = 0.0_f32;
        // The places that this pixel contributes to.
        for y in up_start(rows, height, from_height, row.max(1) - 1)..up_start(rows, height, from_height, row + 1) {
            let by_row = up_weight(rows, height, from_height, row, y);
            for x in up_start(columns, width, from_width, column.max(1) - 1)
                ..up_start(columns, width, from_width, column + 1)
            {
                let weight = by_row * up_weight(columns, width, from_width, column, x);
                let at = y * width + x;
                v_luma += weight * v_planes[at];
                v_red += weight * v_planes[width * height + at];
                v_blue += weight * v_planes[2 * width * height + at];
            }
        }
        let v_cr = 0.713_f32 * v_red;
        let v_cb = 0.564_f32 * v_blue;
        let v_y = v_luma - (v_cr + v_cb);
        let to = ABSOLUTE_POS * channels;
        v_image[to] = 0.299_f32 * v_y + v_cr;
        v_image[to + 1] = 0.587_f32 * v_y;
        v_image[to + 2] = 0.114_f32 * v_y + v_cb;
        for c in 3..channels {
            v_image[to + c] = 0.0_f32;
        }
    }
}
