//! 3D Gaussian models and point clouds as PLY files.
//!
//! The 3DGS layout (Kerbl 2023, reference implementation) is one `vertex` element with the properties
//! `x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3`, all 32-bit floats, binary little endian. `f_rest` is
//! channel-major on disk (all red coefficients, then green, then blue), `[N, K, 3]` coefficient-major in memory.
//!
//! Files whose vertices are all-float little-endian rows, in any property order, are scattered in parallel straight from
//! a memory map; anything else (ASCII, big endian, other types, lists, elements before the vertices) goes through
//! `ply-rs-bw` row by row.

mod attributes;
mod fallback;
mod fast;
mod header;
mod points;

pub use points::load_points;

use crate::error::{Error, Result};
use crate::gaussian_cloud::GaussianCloud;
use attributes::Attributes;
use header::Header;
use memmap2::Mmap;
use std::fs::File;
use std::io::{Read, Write};
use std::ops::Deref;
use std::path::Path;

/// What [`load_with_report`] found in the file besides the model.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PlyReport {
    /// Rows in the file.
    pub num_rows: usize,
    /// Rows left out because one of their values is NaN or infinite.
    pub num_dropped_non_finite: usize,
    /// Rows left out because their quaternion is zero, which is no rotation.
    pub num_dropped_zero_quat: usize,
}

/// Reads a 3DGS model; rows that cannot be drawn are left out (see [`load_with_report`]).
///
/// # Errors
///
/// As [`load_with_report`].
pub fn load(path: impl AsRef<Path>) -> Result<GaussianCloud> {
    load_with_report(path).map(|(cloud, _)| cloud)
}

/// Reads a 3DGS model of SH degree 0 to 4 (deduced from the number of `f_rest` properties) and says what was left out.
///
/// # Errors
///
/// - [`Error::Io`] when the file cannot be read.
/// - [`Error::Format`] when it is no PLY, its header is malformed, attributes are missing (all of them are named), the
///   number of `f_rest` properties fits no degree, or rows are missing at the end.
/// - [`Error::Unsupported`] for compressed PLY and other formats of splats, which are recognised by their first bytes.
pub fn load_with_report(path: impl AsRef<Path>) -> Result<(GaussianCloud, PlyReport)> {
    let path = path.as_ref();
    let bytes = FileBytes::open(path)?;
    let header = Header::parse(path, &bytes)?;
    let attributes = Attributes::of_gaussians(path, &header)?;
    let (cloud, unusable) = if header.is_all_float_little_endian() {
        fast::read(path, &bytes, &header, &attributes)?
    } else {
        fallback::read_gaussians(path, &bytes, &header, &attributes)?
    };
    Ok(without_unusable(cloud, &unusable))
}

/// Writes `cloud` in the 3DGS layout, binary little endian, normals zero. The file appears complete or not at all.
///
/// # Errors
///
/// [`Error::Parameter`] when the vectors of `cloud` differ in their number of rows, [`Error::Io`] when writing fails.
pub fn save(path: impl AsRef<Path>, cloud: &GaussianCloud) -> Result<()> {
    cloud.validate_shape()?;
    crate::io::write_atomically(path.as_ref(), |file| fast::write(file, cloud))
}

/// Writes `cloud` as [`save`] does, to any writer.
///
/// # Errors
///
/// `InvalidInput` when the vectors of `cloud` differ in their number of rows; what the writer returns.
pub fn write_to(out: &mut impl Write, cloud: &GaussianCloud) -> std::io::Result<()> {
    cloud.validate_shape().map_err(|e| std::io::Error::new(std::io::ErrorKind::InvalidInput, e))?;
    fast::write(out, cloud)
}

/// A row that cannot be drawn, found while reading.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct UnusableRow {
    index: usize,
    is_finite: bool,
}

fn without_unusable(cloud: GaussianCloud, unusable: &[UnusableRow]) -> (GaussianCloud, PlyReport) {
    let num_rows = cloud.len();
    let num_dropped_zero_quat = unusable.iter().filter(|row| row.is_finite).count();
    let num_dropped_non_finite = unusable.len() - num_dropped_zero_quat;
    let report = PlyReport { num_rows, num_dropped_non_finite, num_dropped_zero_quat };
    if unusable.is_empty() {
        return (cloud, report);
    }
    let mut is_kept = vec![true; num_rows];
    unusable.iter().for_each(|row| is_kept[row.index] = false);
    let kept: Vec<usize> = (0..num_rows).filter(|&index| is_kept[index]).collect();
    (cloud.select(&kept), report)
}

/// The content of a file: mapped when it is a regular file, read otherwise (pipes).
enum FileBytes {
    Mapped(Mmap),
    Read(Vec<u8>),
}

impl FileBytes {
    fn open(path: &Path) -> Result<Self> {
        let io = |source| Error::io("read", path, source);
        let mut file = File::open(path).map_err(io)?;
        let metadata = file.metadata().map_err(io)?;
        if metadata.is_dir() {
            return Err(io(std::io::ErrorKind::IsADirectory.into()));
        }
        if metadata.is_file() && metadata.len() > 0 {
            // SAFETY: the map is read-only and dropped before `load*` returns. Another process that truncates the file
            // meanwhile can end this one with a bus error, as with every mapped reader; copying the file first would
            // halve the measured throughput.
            return unsafe { Mmap::map(&file) }.map(Self::Mapped).map_err(io);
        }
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes).map_err(io)?;
        Ok(Self::Read(bytes))
    }
}

impl Deref for FileBytes {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match self {
            Self::Mapped(map) => map,
            Self::Read(bytes) => bytes,
        }
    }
}
