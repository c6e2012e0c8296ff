//! Gaze-dependent statistics: chains of mips of the responses of one filter, both images at once, two mips sampled at
//! every pixel, and the adjoint of it all.
//!
//! A sample holds x and x² of the first image, then of the second; a chain is their area means, every mip half the size of
//! the one before, down to one sample, one behind the other in one buffer: a pixel samples any two of it. Mips are never
//! stored enlarged. A unit computes one sample, one pixel, or one gradient; gradients by a mip are gathered along columns
//! of pixels first, then along rows.
//!
//! Above 400 lines: what builds a chain, what samples it and the adjoints share its layout and are read together.

use super::super::pooling::{
    cell_end, cell_start, end_cell, first_cell, inverse_count, up_source_at, up_start, up_weight,
};
use super::super::pyramid::{Group, Planes, correlate};
use super::compare::{Pooled, compare_statistics, mixed, mixed_pooled};
use super::{Context, Tally, tally_sum};
use crate::hvs::pooling::GazePooling;
use crate::kernels::cpu::hvsq::gaze::GazeLevel as HostLevel;
use crate::kernels::cpu::pooling::Axis as HostAxis;
use crate::kernels::gpu::pooling::{Axis, words};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::Result;
use gazesplat_render::gpu::{Gpu, cube_dim};

/// Values of a sample.
const SAMPLE: usize = 4;
/// Words that say of a mip where things are: its width and height, its first sample, and in the tables of all mips where
/// those of its enlargement along columns and rows begin.
const MIP_WORDS: usize = 5;

/// One mip of a level.
#[derive(Debug, Clone)]
struct Mip {
    width: usize,
    height: usize,
    /// Its first sample in the chain.
    first: usize,
    /// Area means of the mip before.
    columns: Axis,
    rows: Axis,
    /// Enlargement to the level.
    up_columns: Axis,
    up_rows: Axis,
}

/// Pooling of one level.
#[derive(Debug, Clone)]
pub(super) struct GazeLevel {
    width: usize,
    height: usize,
    mips: Vec<Mip>,
    num_samples: usize,
    /// What [`MIP_WORDS`] says of every mip, then the tables.
    tables: CubeTensor,
    /// `[2, height, width]`: first of the two mips of every pixel, and the bits of the weight of the second.
    lods: CubeTensor,
}

impl GazeLevel {
    pub fn new(gpu: &Gpu, pooling: &GazePooling, (width, height): (usize, usize)) -> Self {
        let host = HostLevel::<f32>::new(pooling, (width, height));
        let sizes: Vec<(usize, usize)> = host.mip_sizes().collect();
        let axis = |samples, cells| HostAxis::<f32>::new(samples, cells);
        let (mut mips, mut heads, mut tables) = (Vec::new(), Vec::new(), Vec::new());
        let mut first = 0;
        for (k, &(w, h)) in sizes.iter().enumerate() {
            let finer = sizes[k.saturating_sub(1)];
            let (up_columns, up_rows) = (axis(width, w), axis(height, h));
            heads.extend([w, h, first].map(|v| v as u32));
            for up in [&up_columns, &up_rows] {
                heads.push((sizes.len() * MIP_WORDS + tables.len()) as u32);
                tables.extend(words(up));
            }
            mips.push(Mip {
                width: w,
                height: h,
                first,
                columns: Axis::new(gpu, &axis(finer.0, w)),
                rows: Axis::new(gpu, &axis(finer.1, h)),
                up_columns: Axis::new(gpu, &up_columns),
                up_rows: Axis::new(gpu, &up_rows),
            });
            // All three planes of a mip lie together.
            first += 3 * w * h;
        }
        heads.extend(tables);
        let lods: Vec<u32> = host.lods().map(|(first, _)| first as u32).collect();
        let weights = host.lods().map(|(_, weight)| weight.to_bits());
        let lods: Vec<u32> = lods.into_iter().chain(weights).collect();
        Self {
            width,
            height,
            mips,
            num_samples: first,
            tables: gpu.upload_u32(&heads, &[heads.len()]),
            lods: gpu.upload_u32(&lods, &[lods.len()]),
        }
    }

    /// Compares the responses of two triples of planes to one filter; the gradient by the responses of the first, `None`
    /// when not wanted.
    ///
    /// # Errors
    /// [`gazesplat_render::Error::Limit`] when a buffer would be larger than the adapter takes.
    pub fn compare(
        &self,
        gpu: &Gpu,
        planes: [&Planes; 2],
        filter: &Group,
        context: &Context,
        tally: &mut Tally,
    ) -> Result<Option<Planes>> {
        let chain = self.chain(gpu, planes, filter)?;
        let len = 3 * self.width * self.height;
        let shape = [if context.gradient { len } else { 1 }, 2];
        let v_pixels = gpu.empty("bytes of gradients by pooled statistics", &shape, DType::F32)?;
        let first_sum = tally.reserve(len);
        compare_kernel::launch(
            &gpu.client,
            gpu.units(len),
            cube_dim(),
            chain.clone().into_buffer_arg(),
            self.tables.clone().into_buffer_arg(),
            self.lods.clone().into_buffer_arg(),
            context.weights_or(&chain).into_buffer_arg(),
            v_pixels.clone().into_buffer_arg(),
            tally.sums.clone().into_buffer_arg(),
            self.width as u32,
            self.height as u32,
            len as u32,
            first_sum,
            context.scale,
            context.is_l1(),
            context.gradient,
            context.weights.is_some(),
        );
        if !context.gradient {
            return Ok(None);
        }
        self.gradient(gpu, &chain, &v_pixels).map(Some)
    }

    /// Both images' responses and squares, and all mips of them: `[samples, 4]`.
    fn chain(&self, gpu: &Gpu, [found, reference]: [&Planes; 2], filter: &Group) -> Result<CubeTensor> {
        let (found, reference) = (correlate(gpu, found, filter)?, correlate(gpu, reference, filter)?);
        let chain = gpu.empty("bytes of mips of responses", &[self.num_samples, SAMPLE], DType::F32)?;
        samples_kernel::launch(
            &gpu.client,
            gpu.units(found.len()),
            cube_dim(),
            found.data.clone().into_buffer_arg(),
            reference.data.clone().into_buffer_arg(),
            chain.clone().into_buffer_arg(),
            found.len() as u32,
        );
        for pair in self.mips.windows(2) {
            let [finer, mip] = pair else { unreachable!("windows of two") };
            let len = 3 * mip.width * mip.height;
            mip_kernel::launch(
                &gpu.client,
                gpu.units(len),
                cube_dim(),
                chain.clone().into_buffer_arg(),
                mip.columns.words.clone().into_buffer_arg(),
                mip.rows.words.clone().into_buffer_arg(),
                finer.first as u32,
                finer.width as u32,
                finer.height as u32,
                mip.first as u32,
                mip.width as u32,
                mip.height as u32,
                len as u32,
            );
        }
        Ok(chain)
    }

    /// The gradient by the responses, from those by the pooled statistics of every pixel.
    fn gradient(&self, gpu: &Gpu, chain: &CubeTensor, v_pixels: &CubeTensor) -> Result<Planes> {
        let what = "bytes of gradients by mips";
        // Stands in for a coarser mip where there is none.
        let mut v_coarser = gpu.zeros(what, &[1, 2], DType::F32)?;
        for (k, mip) in self.mips.iter().enumerate().rev() {
            let v_rows = gpu.empty(what, &[3 * mip.height * self.width, 2], DType::F32)?;
            let len = 3 * mip.height * self.width;
            gather_rows_kernel::launch(
                &gpu.client,
                gpu.units(len),
                cube_dim(),
                v_pixels.clone().into_buffer_arg(),
                mip.up_rows.words.clone().into_buffer_arg(),
                self.lods.clone().into_buffer_arg(),
                v_rows.clone().into_buffer_arg(),
                self.width as u32,
                self.height as u32,
                mip.height as u32,
                k as u32,
                len as u32,
            );
            let v_mip = gpu.empty(what, &[3 * mip.height * mip.width, 2], DType::F32)?;
            let len = 3 * mip.height * mip.width;
            let (columns, rows) = self.mips.get(k + 1).map_or((&mip.columns, &mip.rows), |c| (&c.columns, &c.rows));
            gather_columns_kernel::launch(
                &gpu.client,
                gpu.units(len),
                cube_dim(),
                v_rows.into_buffer_arg(),
                mip.up_columns.words.clone().into_buffer_arg(),
                v_coarser.into_buffer_arg(),
                columns.words.clone().into_buffer_arg(),
                rows.words.clone().into_buffer_arg(),
                v_mip.clone().into_buffer_arg(),
                self.width as u32,
                mip.width as u32,
                mip.height as u32,
                columns.num_cells as u32,
                rows.num_cells as u32,
                len as u32,
                k + 1 < self.mips.len(),
            );
            v_coarser = v_mip;
        }
        let v_responses = Planes::empty(gpu, self.width, self.height, 3)?;
        responses_kernel::launch(
            &gpu.client,
            gpu.units(v_responses.len()),
            cube_dim(),
            v_coarser.into_buffer_arg(),
            chain.clone().into_buffer_arg(),
            v_responses.data.clone().into_buffer_arg(),
            v_responses.len() as u32,
        );
        Ok(v_responses)
    }
}

#[cube(launch)]
fn samples_kernel(found: &[f32], reference: &[f32], chain: &mut [f32], len: u32) {
    if ABSOLUTE_POS < len as usize {
        let a = found[ABSOLUTE_POS];
        let b = reference[ABSOLUTE_POS];
        chain[SAMPLE * ABSOLUTE_POS] = a;
        chain[SAMPLE * ABSOLUTE_POS + 1] = a * a;
        chain[SAMPLE * ABSOLUTE_POS + 2] = b;
        chain[SAMPLE * ABSOLUTE_POS + 3] = b * b;
    }
}

#[cube(launch)]
fn mip_kernel(
    chain: &mut [f32],
    columns: &[u32],
    rows: &[u32],
    finer_first: u32,
    finer_width: u32,
    finer_height: u32,
    first: u32,
    width: u32,
    height: u32,
    len: u32,
) {
    let (width, height) = (width as usize, height as usize);
    let (finer_width, finer_height) = (finer_width as usize, finer_height as usize);
    if ABSOLUTE_POS < len as usize {
        let j = ABSOLUTE_POS % width;
        let i = ABSOLUTE_POS / width % height;
        let plane = finer_first as usize + ABSOLUTE_POS / (width * height) * (finer_width * finer_height);
        let scale = inverse_count(rows, height, i) * inverse_count(columns, width, j);
        #[unroll]
        for q in 0..SAMPLE {
            let mut sum = 0.0_f32;
            for y in cell_start(rows, i)..cell_end(rows, height, i) {
                for x in cell_start(columns, j)..cell_end(columns, width, j) {
                    sum += chain[SAMPLE * (plane + y * finer_width + x) + q];
                }
            }
            chain[SAMPLE * (first as usize + ABSOLUTE_POS) + q] = sum * scale;
        }
    }
}

/// Sample `at` of a chain.
#[cube]
fn sample(chain: &[f32], at: usize) -> Pooled {
    Pooled {
        mean: chain[SAMPLE * at],
        square: chain[SAMPLE * at + 1],
        other_mean: chain[SAMPLE * at + 2],
        other_square: chain[SAMPLE * at + 3],
    }
}

/// Mip `k`, bilinearly enlarged, at a pixel of plane `plane`.
#[cube]
fn sampled(chain: &[f32], tables: &[u32], k: usize, plane: usize, width: usize, height: usize, pixel: usize) -> Pooled {
    let head = MIP_WORDS * k;
    let mip_width = tables[head] as usize;
    let mip_height = tables[head + 1] as usize;
    let first = tables[head + 2] as usize + plane * mip_width * mip_height;
    let across = up_source_at(tables, tables[head + 3] as usize, width, mip_width, pixel % width);
    let down = up_source_at(tables, tables[head + 4] as usize, height, mip_height, pixel / width);
    let upper = first + down.first * mip_width;
    let lower = first + down.second * mip_width;
    let above =
        mixed_pooled(&sample(chain, upper + across.first), &sample(chain, upper + across.second), across.weight);
    let below =
        mixed_pooled(&sample(chain, lower + across.first), &sample(chain, lower + across.second), across.weight);
    mixed_pooled(&above, &below, down.weight)
}

#[cube(launch)]
fn compare_kernel(
    chain: &[f32],
    tables: &[u32],
    lods: &[u32],
    weights: &[f32],
    v_pixels: &mut [f32],
    sums: &mut [f32],
    width: u32,
    height: u32,
    len: u32,
    first_sum: u32,
    scale: f32,
    #[comptime] is_l1: bool,
    #[comptime] gradient: bool,
    #[comptime] weighted: bool,
) {
    let (width, height) = (width as usize, height as usize);
    let size = width * height;
    let mut sum = 0.0_f32;
    if ABSOLUTE_POS < len as usize {
        let pixel = ABSOLUTE_POS % size;
        let plane = ABSOLUTE_POS / size;
        let k = lods[pixel] as usize;
        let weight = f32::reinterpret(lods[size + pixel]);
        let mut pooled = sampled(chain, tables, k, plane, width, height, pixel);
        if weight != 0.0_f32 {
            let second = sampled(chain, tables, k + 1, plane, width, height, pixel);
            pooled.mean = mixed(pooled.mean, second.mean, weight);
            pooled.square = mixed(pooled.square, second.square, weight);
            pooled.other_mean = mixed(pooled.other_mean, second.other_mean, weight);
            pooled.other_square = mixed(pooled.other_square, second.other_square, weight);
        }
        let compared = compare_statistics(&pooled, scale, is_l1);
        sum = compared.distance;
        let mut v_mean = compared.v_mean;
        let mut v_square = compared.v_square;
        if comptime![weighted] {
            sum *= weights[pixel];
            v_mean *= weights[pixel];
            v_square *= weights[pixel];
        }
        if comptime![gradient] {
            v_pixels[2 * ABSOLUTE_POS] = v_mean;
            v_pixels[2 * ABSOLUTE_POS + 1] = v_square;
        }
    }
    tally_sum(sums, sum, first_sum, len as usize, scale);
}

/// Gradients by mip `k` enlarged along rows only, as far as pixels sample it directly.
#[cube(launch)]
fn gather_rows_kernel(
    v_pixels: &[f32],
    up_rows: &[u32],
    lods: &[u32],
    v_rows: &mut [f32],
    width: u32,
    height: u32,
    mip_height: u32,
    k: u32,
    len: u32,
) {
    let (width, height, mip_height) = (width as usize, height as usize, mip_height as usize);
    let size = width * height;
    if ABSOLUTE_POS < len as usize {
        let x = ABSOLUTE_POS % width;
        let i = ABSOLUTE_POS / width % mip_height;
        let plane = ABSOLUTE_POS / (width * mip_height) * size;
        let mut v_mean = 0.0_f32;
        let mut v_square = 0.0_f32;
        for y in up_start(up_rows, height, mip_height, i.max(1) - 1)..up_start(up_rows, height, mip_height, i + 1) {
            let pixel = y * width + x;
            let first = lods[pixel];
            if first == k || first + 1 == k {
                let weight = f32::reinterpret(lods[size + pixel]);
                let by_mip = select(first == k, 1.0_f32 - weight, weight);
                let w = up_weight(up_rows, height, mip_height, i, y) * by_mip;
                v_mean += w * v_pixels[2 * (plane + pixel)];
                v_square += w * v_pixels[2 * (plane + pixel) + 1];
            }
        }
        v_rows[2 * ABSOLUTE_POS] = v_mean;
        v_rows[2 * ABSOLUTE_POS + 1] = v_square;
    }
}

/// Gradients by a mip: of the pixels that sample it, and what the next coarser one passes on, whose area means are in
/// `columns` and `rows`.
#[cube(launch)]
fn gather_columns_kernel(
    v_rows: &[f32],
    up_columns: &[u32],
    v_coarser: &[f32],
    columns: &[u32],
    rows: &[u32],
    v_mip: &mut [f32],
    width: u32,
    mip_width: u32,
    mip_height: u32,
    num_columns: u32,
    num_rows: u32,
    len: u32,
    #[comptime] has_coarser: bool,
) {
    let (width, mip_width, mip_height) = (width as usize, mip_width as usize, mip_height as usize);
    let (num_columns, num_rows) = (num_columns as usize, num_rows as usize);
    if ABSOLUTE_POS < len as usize {
        let j = ABSOLUTE_POS % mip_width;
        let row = ABSOLUTE_POS / mip_width;
        let mut v_mean = 0.0_f32;
        let mut v_square = 0.0_f32;
        for x in up_start(up_columns, width, mip_width, j.max(1) - 1)..up_start(up_columns, width, mip_width, j + 1) {
            let weight = up_weight(up_columns, width, mip_width, j, x);
            v_mean += weight * v_rows[2 * (row * width + x)];
            v_square += weight * v_rows[2 * (row * width + x) + 1];
        }
        if comptime![has_coarser] {
            let i = row % mip_height;
            let plane = row / mip_height * num_rows;
            for c in first_cell(rows, num_rows, i)..end_cell(rows, mip_height, num_rows, i) {
                for d in first_cell(columns, num_columns, j)..end_cell(columns, mip_width, num_columns, j) {
                    let count = inverse_count(rows, num_rows, c) * inverse_count(columns, num_columns, d);
                    let at = 2 * ((plane + c) * num_columns + d);
                    v_mean += count * v_coarser[at];
                    v_square += count * v_coarser[at + 1];
                }
            }
        }
        v_mip[2 * ABSOLUTE_POS] = v_mean;
        v_mip[2 * ABSOLUTE_POS + 1] = v_square;
    }
}

/// Gradients by the responses from those by the finest mip.
#[cube(launch)]
fn responses_kernel(v_mip: &[f32], chain: &[f32], v_responses: &mut [f32], len: u32) {
    if ABSOLUTE_POS < len as usize {
        let value = chain[SAMPLE * ABSOLUTE_POS];
        v_responses[ABSOLUTE_POS] = v_mip[2 * ABSOLUTE_POS] + (value + value) * v_mip[2 * ABSOLUTE_POS + 1];
    }
}
