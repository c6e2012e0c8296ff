//! Rows of a packed buffer, reordered, appended and widened.
//!
//! One unit per value of the result finds its section, row and column, and copies the value or writes 0. Values are
//! copied whatever they are. The padding between two sections is left undefined; nothing reads it. Sorting gives rows
//! with a mean that is not finite the last places.

use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::Result;
use gazesplat_render::gpu::device_fn::is_finite;
use gazesplat_render::gpu::{Gpu, cube_dim, packed::PackedLayout};
use gazesplat_render::kernels::gpu::sort::radix_sort;

/// First values of the sections of a packed buffer; means begin at 0.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
pub struct Sections {
    pub quats: u32,
    pub log_scales: u32,
    pub opacity_logits: u32,
    pub sh: u32,
    pub num_rows: u32,
    pub sh_width: u32,
}

impl SectionsLaunch {
    /// The sections of `layout`.
    pub fn of(layout: &PackedLayout) -> Self {
        let [_, quats, log_scales, opacity_logits, sh, _] = layout.offsets.map(|o| o as u32);
        Self::new(quats, log_scales, opacity_logits, sh, layout.num_rows as u32, layout.widths()[4] as u32)
    }
}

/// Bits of a coordinate in a Morton key.
const MORTON_BITS: u32 = 10;
/// Cells of an axis.
const MORTON_CELLS: f32 = 1024.0;

/// The rows in the order of a Morton curve through the cube of `half` world units around `center`; what is outside
/// counts as on its surface. Rows of one cell keep their order.
///
/// # Errors
/// [`gazesplat_render::Error::Limit`] when a buffer is larger than the adapter takes.
pub fn morton_order(
    gpu: &Gpu,
    layout: &PackedLayout,
    params: &CubeTensor,
    center: [f32; 3],
    half: f32,
) -> Result<CubeTensor> {
    let n = layout.num_rows;
    let keys = gpu.empty("bytes of sort keys", &[n], DType::U32)?;
    let rows = gpu.empty("bytes of sorted rows", &[n], DType::U32)?;
    morton_keys::launch(
        &gpu.client,
        gpu.units(n),
        cube_dim(),
        params.clone().into_buffer_arg(),
        keys.clone().into_buffer_arg(),
        rows.clone().into_buffer_arg(),
        center[0] - half,
        center[1] - half,
        center[2] - half,
        MORTON_CELLS / (2.0 * half),
        n as u32,
    );
    let count = gpu.upload_u32(&[n as u32], &[1]);
    Ok(radix_sort(gpu, keys, rows, n, &count, 0, 3 * MORTON_BITS)?.1)
}

/// Packed parameters and moments of one layout.
#[derive(Debug, Clone)]
pub struct PackedRows {
    /// Where the groups lie.
    pub layout: PackedLayout,
    /// The parameters.
    pub params: CubeTensor,
    /// First moments.
    pub first: CubeTensor,
    /// Second moments.
    pub second: CubeTensor,
}

impl PackedRows {
    /// All three buffers, each with the rows of `new` that `listed` says.
    ///
    /// # Errors
    /// As [`select_rows`].
    pub fn selected(&self, gpu: &Gpu, new: PackedLayout, list: &CubeTensor, listed: Listed) -> Result<Self> {
        let select = |from: &CubeTensor| select_rows(gpu, &self.layout, from.clone(), &new, list, listed);
        Ok(Self {
            params: select(&self.params)?,
            first: select(&self.first)?,
            second: select(&self.second)?,
            layout: new,
        })
    }
}

/// Which rows a result is made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Listed {
    /// The rows of the source, then copies of the listed ones.
    Copied,
    /// The rows of the source, then as many rows of zeros as are listed.
    Zero,
    /// The listed rows.
    Only,
}

/// A packed buffer of `new` layout from `from` of `old` layout: columns that only `new` has are 0.
///
/// # Errors
/// [`gazesplat_render::Error::Limit`] when the result is larger than the adapter takes.
pub fn select_rows(
    gpu: &Gpu,
    old: &PackedLayout,
    from: CubeTensor,
    new: &PackedLayout,
    rows: &CubeTensor,
    listed: Listed,
) -> Result<CubeTensor> {
    let to = gpu.empty("bytes of packed parameters", &[new.len()], DType::F32)?;
    let first_listed = if listed == Listed::Only { 0 } else { old.num_rows };
    copy_rows::launch(
        &gpu.client,
        gpu.units(new.len()),
        cube_dim(),
        from.into_buffer_arg(),
        rows.clone().into_buffer_arg(),
        to.clone().into_buffer_arg(),
        SectionsLaunch::of(old),
        SectionsLaunch::of(new),
        first_listed as u32,
        listed == Listed::Zero,
    );
    Ok(to)
}

#[cube(launch)]
fn copy_rows(
    from: &[f32],
    rows: &[u32],
    to: &mut [f32],
    old: Sections,
    new: Sections,
    first_listed: u32,
    #[comptime] listed_are_zero: bool,
) {
    let at = ABSOLUTE_POS as u32;
    if ABSOLUTE_POS < to.len() {
        // 1. The section.
        let mut start = 0u32;
        let mut old_start = 0u32;
        let mut width = 3u32;
        let mut old_width = 3u32;
        if at >= new.sh {
            start = new.sh;
            old_start = old.sh;
            width = new.sh_width;
            old_width = old.sh_width;
        } else if at >= new.opacity_logits {
            start = new.opacity_logits;
            old_start = old.opacity_logits;
            width = 1u32;
            old_width = 1u32;
        } else if at >= new.log_scales {
            start = new.log_scales;
            old_start = old.log_scales;
        } else if at >= new.quats {
            start = new.quats;
            old_start = old.quats;
            width = 4u32;
            old_width = 4u32;
        }
        // 2. Row and column.
        let row = (at - start) / width;
        let column = (at - start) % width;
        if row < new.num_rows {
            // 3. The row it comes from.
            let mut source = row;
            let mut is_zero = column >= old_width;
            if row >= first_listed {
                if listed_are_zero {
                    is_zero = true;
                } else {
                    source = rows[(row - first_listed) as usize];
                }
            }
            let mut value = 0.0f32;
            if !is_zero {
                value = from[(old_start + source * old_width + column) as usize];
            }
            to[ABSOLUTE_POS] = value;
        }
    }
}

/// A copy of `len` words.
///
/// # Errors
/// As [`select_rows`].
pub fn copied_words(gpu: &Gpu, from: &CubeTensor, len: usize) -> Result<CubeTensor> {
    let to = gpu.empty("bytes of words of rows", &[len], from.dtype)?;
    copy_words::launch(
        &gpu.client,
        gpu.units(len),
        cube_dim(),
        from.clone().into_buffer_arg(),
        to.clone().into_buffer_arg(),
        len as u32,
    );
    Ok(to)
}

#[cube(launch)]
fn copy_words(from: &[u32], to: &mut [u32], len: u32) {
    if ABSOLUTE_POS < len as usize {
        to[ABSOLUTE_POS] = from[ABSOLUTE_POS];
    }
}

/// A copy of a whole buffer: what is written in place must belong to nobody else.
///
/// # Errors
/// As [`select_rows`].
pub fn copied(gpu: &Gpu, from: CubeTensor, len: usize) -> Result<CubeTensor> {
    let to = gpu.empty("bytes of packed parameters", &[len], DType::F32)?;
    copy_all::launch(
        &gpu.client,
        gpu.units(len),
        cube_dim(),
        from.into_buffer_arg(),
        to.clone().into_buffer_arg(),
        len as u32,
    );
    Ok(to)
}

#[cube(launch)]
fn copy_all(from: &[f32], to: &mut [f32], len: u32) {
    if ABSOLUTE_POS < len as usize {
        to[ABSOLUTE_POS] = from[ABSOLUTE_POS];
    }
}

/// Lowers opacity logits above `max_logit` to it, and forgets the moments of all opacities; NaN stays. All three buffers
/// are overwritten in place.
pub fn clamp_opacities(
    gpu: &Gpu,
    layout: &PackedLayout,
    params: &CubeTensor,
    first: &CubeTensor,
    second: &CubeTensor,
    max_logit: f32,
) {
    clamp_rows::launch(
        &gpu.client,
        gpu.units(layout.num_rows),
        cube_dim(),
        params.clone().into_buffer_arg(),
        first.clone().into_buffer_arg(),
        second.clone().into_buffer_arg(),
        layout.offsets[3] as u32,
        max_logit,
        layout.num_rows as u32,
    );
}

#[cube(launch)]
fn clamp_rows(params: &mut [f32], first: &mut [f32], second: &mut [f32], start: u32, max_logit: f32, num_rows: u32) {
    if ABSOLUTE_POS < num_rows as usize {
        let at = ABSOLUTE_POS + start as usize;
        if params[at] > max_logit {
            params[at] = max_logit;
        }
        first[at] = 0.0f32;
        second[at] = 0.0f32;
    }
}

/// Forgets the values of a row.
#[cube]
pub fn zero_row(values: &mut [f32], at: &Sections, row: u32) {
    for i in 0..3u32 {
        values[(3u32 * row + i) as usize] = 0.0f32;
        values[(at.log_scales + 3u32 * row + i) as usize] = 0.0f32;
    }
    for i in 0..4u32 {
        values[(at.quats + 4u32 * row + i) as usize] = 0.0f32;
    }
    values[(at.opacity_logits + row) as usize] = 0.0f32;
    for i in 0..at.sh_width {
        values[(at.sh + at.sh_width * row + i) as usize] = 0.0f32;
    }
}

/// Overwrites row `target` with row `source`.
#[cube]
pub fn copy_row(values: &mut [f32], at: &Sections, target: u32, source: u32) {
    for i in 0..3u32 {
        values[(3u32 * target + i) as usize] = values[(3u32 * source + i) as usize];
        values[(at.log_scales + 3u32 * target + i) as usize] = values[(at.log_scales + 3u32 * source + i) as usize];
    }
    for i in 0..4u32 {
        values[(at.quats + 4u32 * target + i) as usize] = values[(at.quats + 4u32 * source + i) as usize];
    }
    values[(at.opacity_logits + target) as usize] = values[(at.opacity_logits + source) as usize];
    for i in 0..at.sh_width {
        values[(at.sh + at.sh_width * target + i) as usize] = values[(at.sh + at.sh_width * source + i) as usize];
    }
}

#[cube(launch)]
fn morton_keys(
    params: &[f32],
    keys: &mut [u32],
    rows: &mut [u32],
    low_x: f32,
    low_y: f32,
    low_z: f32,
    cells_per_unit: f32,
    num_rows: u32,
) {
    let row = ABSOLUTE_POS;
    if row < num_rows as usize {
        let x = params[3 * row];
        let y = params[3 * row + 1];
        let z = params[3 * row + 2];
        // The key of a row that is nowhere: the largest of 30 bits.
        let mut key = 0x3fff_ffffu32;
        if is_finite(x) && is_finite(y) && is_finite(z) {
            let x = spread(cell(x, low_x, cells_per_unit));
            let y = spread(cell(y, low_y, cells_per_unit));
            let z = spread(cell(z, low_z, cells_per_unit));
            key = x | (y << 1u32) | (z << 2u32);
        }
        keys[row] = key;
        rows[row] = row as u32;
    }
}

/// Cell of a coordinate along its axis.
#[cube]
fn cell(coordinate: f32, low: f32, cells_per_unit: f32) -> u32 {
    let cell = (coordinate - low) * cells_per_unit;
    f32::clamp(cell, 0.0f32, MORTON_CELLS - 1.0f32) as u32
}

/// Puts two zero bits between the low ten bits of `v`.
#[cube]
fn spread(v: u32) -> u32 {
    let v = (v | (v << 16u32)) & 0x0300_00ffu32;
    let v = (v | (v << 8u32)) & 0x0300_f00fu32;
    let v = (v | (v << 4u32)) & 0x030c_30c3u32;
    (v | (v << 2u32)) & 0x0924_9249u32
}
