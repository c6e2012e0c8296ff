//! Pass 1: responses of a group of filters, pooled into grids. A unit computes one cell.

use super::super::pooling::{Pools, cell_end, cell_start, inverse_count};
use super::super::pyramid::Planes;
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::Result;
use gazesplat_render::gpu::{Gpu, cube_dim};

/// Means and means of squares of the responses, `[planes, rows of cells, columns of cells, 2]`; where pooling changes
/// nothing, the responses.
///
/// # Errors
/// [`gazesplat_render::Error::Limit`] when a buffer would be larger than the adapter takes.
pub(super) fn of(gpu: &Gpu, responses: &Planes, pools: &Pools) -> Result<CubeTensor> {
    if pools.is_identity() {
        return Ok(responses.data.clone());
    }
    let (columns, rows) = (pools.x.num_cells, pools.y.num_cells);
    let shape = [responses.num_planes, rows, columns, 2];
    let grids = gpu.empty("bytes of pooled statistics", &shape, DType::F32)?;
    let len = responses.num_planes * rows * columns;
    pool_kernel::launch(
        &gpu.client,
        gpu.units(len),
        cube_dim(),
        responses.data.clone().into_buffer_arg(),
        pools.x.words.clone().into_buffer_arg(),
        pools.y.words.clone().into_buffer_arg(),
        grids.clone().into_buffer_arg(),
        responses.width as u32,
        responses.height as u32,
        columns as u32,
        rows as u32,
        len as u32,
    );
    Ok(grids)
}

#[cube(launch)]
fn pool_kernel(
    responses: &[f32],
    columns: &[u32],
    rows: &[u32],
    grids: &mut [f32],
    width: u32,
    height: u32,
    num_columns: u32,
    num_rows: u32,
    len: u32,
) {
    let (width, height) = (width as usize, height as usize);
    let (num_columns, num_rows) = (num_columns as usize, num_rows as usize);
    if ABSOLUTE_POS < len as usize {
        let j = ABSOLUTE_POS % num_columns;
        let i = ABSOLUTE_POS / num_columns % num_rows;
        let plane = ABSOLUTE_POS / (num_columns * num_rows) * width * height;
        let mut sum = 0.0_f32;
        let mut squares = 0.0_f32;
        // Column by column: the error of a sum grows with the sides of the cell, not with its area.
        for x in cell_start(columns, j)..cell_end(columns, num_columns, j) {
            let mut column_sum = 0.0_f32;
            let mut column_squares = 0.0_f32;
            for y in cell_start(rows, i)..cell_end(rows, num_rows, i) {
                let value = responses[plane + y * width + x];
                column_sum += value;
                column_squares += value * value;
            }
            sum += column_sum;
            squares += column_squares;
        }
        let scale = inverse_count(columns, num_columns, j) * inverse_count(rows, num_rows, i);
        grids[2 * ABSOLUTE_POS] = sum * scale;
        grids[2 * ABSOLUTE_POS + 1] = squares * scale;
    }
}
