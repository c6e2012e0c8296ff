//! Area means and bilinear enlargement along one axis, and both adjoints as gathers, on a GPU: the tables of
//! [`crate::kernels::cpu::pooling`] in one buffer per axis, and the device functions that read them.
//!
//! Positions are computed on the host, in integers or `f64`. Tables of `n` samples and `m` cells, word by word: first
//! sample of every cell and the one behind its last (`m` each), one over their number (`m`), first cell of every sample and
//! the one behind its last (`n` each); first value of every place (`n`), weight of the second (`n`), first place whose first
//! value is not below each value and one more (`m` + 1). Lengths are at least 1.

use crate::kernels::cpu::pooling::{Axis as HostAxis, Pools as HostPools};
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use gazesplat_render::gpu::Gpu;

/// One axis of a pooling.
#[derive(Debug, Clone)]
pub(crate) struct Axis {
    pub num_samples: usize,
    pub num_cells: usize,
    pub words: CubeTensor,
}

impl Axis {
    pub fn new(gpu: &Gpu, host: &HostAxis<f32>) -> Self {
        let words = words(host);
        let len = words.len();
        Self {
            num_samples: host.area.num_samples(),
            num_cells: host.area.num_cells(),
            words: gpu.upload_u32(&words, &[len]),
        }
    }
}

/// The tables of an axis.
pub(crate) fn words(axis: &HostAxis<f32>) -> Vec<u32> {
    let (area, up) = (&axis.area, &axis.up);
    let (n, m) = (area.num_samples(), area.num_cells());
    let mut words = Vec::with_capacity(4 * n + 4 * m + 1);
    words.extend((0..m).map(|i| area.cell(i).start as u32));
    words.extend((0..m).map(|i| area.cell(i).end as u32));
    words.extend((0..m).map(|i| area.inverse_count(i).to_bits()));
    words.extend((0..n).map(|s| area.cells_of(s).start as u32));
    words.extend((0..n).map(|s| area.cells_of(s).end as u32));
    words.extend((0..n).map(|s| up.first(s) as u32));
    words.extend((0..n).map(|s| up.source(s).2.to_bits()));
    words.extend((0..=m).map(|j| up.places(0..j).end as u32));
    words
}

/// Both axes of a pooling.
#[derive(Debug, Clone)]
pub(crate) struct Pools {
    pub x: Axis,
    pub y: Axis,
    is_identity: bool,
}

impl Pools {
    pub fn new(gpu: &Gpu, host: &HostPools<f32>) -> Self {
        Self { x: Axis::new(gpu, &host.x), y: Axis::new(gpu, &host.y), is_identity: host.is_identity() }
    }

    /// Whether pooling changes nothing.
    pub fn is_identity(&self) -> bool {
        self.is_identity
    }
}

/// First sample of cell `i` of `m`.
#[cube]
pub(crate) fn cell_start(words: &[u32], i: usize) -> usize {
    words[i] as usize
}

/// The sample behind the last one of cell `i` of `m`.
#[cube]
pub(crate) fn cell_end(words: &[u32], m: usize, i: usize) -> usize {
    words[m + i] as usize
}

/// One over the number of samples of cell `i` of `m`.
#[cube]
pub(crate) fn inverse_count(words: &[u32], m: usize, i: usize) -> f32 {
    f32::reinterpret(words[2 * m + i])
}

/// First cell that sample `s` belongs to.
#[cube]
pub(crate) fn first_cell(words: &[u32], m: usize, s: usize) -> usize {
    words[3 * m + s] as usize
}

/// The cell behind the last one that sample `s` of `n` belongs to.
#[cube]
pub(crate) fn end_cell(words: &[u32], n: usize, m: usize, s: usize) -> usize {
    words[3 * m + n + s] as usize
}

/// Both values of a place, and the weight of the second.
#[derive(CubeType)]
pub(crate) struct Source {
    pub(crate) first: usize,
    pub(crate) second: usize,
    pub(crate) weight: f32,
}

/// Where place `s` of `n` lies among `m` values.
#[cube]
pub(crate) fn up_source(words: &[u32], n: usize, m: usize, s: usize) -> Source {
    up_source_at(words, 0usize.runtime(), n, m, s)
}

/// As [`up_source`], by tables that begin at word `begin`.
#[cube]
pub(crate) fn up_source_at(words: &[u32], begin: usize, n: usize, m: usize, s: usize) -> Source {
    let at = begin + 3 * m + 2 * n;
    let first = words[at + s] as usize;
    let next = first + 1;
    Source { first, second: select(next < m, next, first), weight: f32::reinterpret(words[at + n + s]) }
}

/// First place of `n` whose first value is not below value `j`, 0 ≤ j ≤ m.
#[cube]
pub(crate) fn up_start(words: &[u32], n: usize, m: usize, j: usize) -> usize {
    words[3 * m + 4 * n + j] as usize
}

/// Weight of value `j` of `m` at place `s` of `n`, one of those from `up_start` of the value before it up to `up_start` of
/// the value after it.
#[cube]
pub(crate) fn up_weight(words: &[u32], n: usize, m: usize, j: usize, s: usize) -> f32 {
    let at = 3 * m + 2 * n;
    let weight = f32::reinterpret(words[at + n + s]);
    select(words[at + s] as usize == j, 1.0_f32 - weight, weight)
}
