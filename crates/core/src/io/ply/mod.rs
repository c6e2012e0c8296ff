//! 3D Gaussian models and point clouds as PLY files.
//!
//! The 3DGS layout (Kerbl 2023, reference implementation) is one `vertex` element with the properties
//! `x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3`, all 32-bit floats, binary little endian. `f_rest` is
//! channel-major on disk (all red coefficients, then green, then blue), `[N, K, 3]` coefficient-major in memory.
//!
//! Files whose vertices are all-float little-endian rows, in any property order, are scattered in parallel straight from
//! a memory map; anything else (ASCII, big endian, other types, lists, elements before the vertices) goes through
//! `ply-rs-bw` row by row. SuperSplat's packed layout is recognised by its properties; how exact it is says the
//! table at the top of `compressed.rs`.

mod attributes;
mod compressed;
mod fallback;
mod fast;
mod header;
mod points;

pub(super) use compressed::MAX_DEGREE as MAX_COMPRESSED_DEGREE;
pub use compressed::save_compressed;
pub use points::load_points;

use crate::error::Result;
use crate::gaussian_cloud::GaussianCloud;
use crate::io::file_bytes::FileBytes;
use attributes::Attributes;
use header::Header;
use std::io::Write;
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
/// - [`crate::Error::Io`] when the file cannot be read.
/// - [`crate::Error::Format`] when it is no PLY, its header is malformed, attributes are missing (all of them are named), the
///   number of `f_rest` properties fits no degree, or rows are missing at the end.
/// - [`crate::Error::Unsupported`] for other formats of splats, which are recognised by their first bytes;
///   [`crate::io::model::load_with_report`] reads some of them.
pub fn load_with_report(path: impl AsRef<Path>) -> Result<(GaussianCloud, PlyReport)> {
    let path = path.as_ref();
    let bytes = FileBytes::open(path)?;
    let PlyContent { cloud, report, .. } = read(path, &bytes)?;
    Ok((cloud, report))
}

/// A model with what its file says about it.
pub(super) struct PlyContent {
    pub cloud: GaussianCloud,
    pub report: PlyReport,
    /// Whether the file has the packed layout of SuperSplat.
    pub is_compressed: bool,
    /// Comment lines of the header, without the word `comment`.
    pub comments: Vec<String>,
}

/// Reads the model in `bytes`, the content of `path`, as [`load_with_report`] does.
pub(super) fn read(path: &Path, bytes: &[u8]) -> Result<PlyContent> {
    let header = Header::parse(path, bytes)?;
    let is_compressed = header.column("packed_position").is_some();
    let (cloud, unusable) = if is_compressed {
        compressed::read(path, bytes, &header)?
    } else {
        let attributes = Attributes::of_gaussians(path, &header)?;
        if header.is_all_float_little_endian() {
            fast::read(path, bytes, &header, &attributes)?
        } else {
            fallback::read_gaussians(path, bytes, &header, &attributes)?
        }
    };
    let (cloud, report) = without_unusable(cloud, &unusable);
    Ok(PlyContent { cloud, report, is_compressed, comments: header.comments })
}

/// Writes `cloud` in the 3DGS layout, binary little endian, normals zero. The file appears complete or not at all.
///
/// # Errors
///
/// [`crate::Error::Parameter`] when the vectors of `cloud` differ in their number of rows, [`crate::Error::Io`] when writing fails.
pub fn save(path: impl AsRef<Path>, cloud: &GaussianCloud) -> Result<()> {
    save_with_comments(path, cloud, &[])
}

/// Writes `cloud` as [`save`] does, with `comments` in the header: one line each, which other programs pass over.
/// Characters outside printable ASCII become `?`: readers in circulation count the characters of the header instead of
/// its bytes.
///
/// # Errors
///
/// As [`save`].
pub fn save_with_comments(path: impl AsRef<Path>, cloud: &GaussianCloud, comments: &[String]) -> Result<()> {
    cloud.validate_shape()?;
    crate::io::write_atomically(path.as_ref(), |file| fast::write(file, cloud, comments))
}

/// Writes `cloud` as [`save`] does, to any writer.
///
/// # Errors
///
/// `InvalidInput` when the vectors of `cloud` differ in their number of rows; what the writer returns.
pub fn write_to(out: &mut impl Write, cloud: &GaussianCloud) -> std::io::Result<()> {
    cloud.validate_shape().map_err(|e| std::io::Error::new(std::io::ErrorKind::InvalidInput, e))?;
    fast::write(out, cloud, &[])
}

/// A row that cannot be drawn, found while reading.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::io) struct UnusableRow {
    index: usize,
    is_finite: bool,
}

/// Leaves the `unusable` rows out and counts them.
pub(in crate::io) fn without_unusable(cloud: GaussianCloud, unusable: &[UnusableRow]) -> (GaussianCloud, PlyReport) {
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

impl UnusableRow {
    /// The rows of `cloud` that cannot be drawn, in order.
    pub(in crate::io) fn all_of(cloud: &GaussianCloud) -> Vec<Self> {
        let bad = |&index: &usize| !cloud.is_row_valid(index);
        // Of the two faults a zero quaternion is the one that leaves all values finite.
        (0..cloud.len()).filter(bad).map(|index| Self { index, is_finite: has_zero_quat_only(cloud, index) }).collect()
    }
}

fn has_zero_quat_only(cloud: &GaussianCloud, index: usize) -> bool {
    let mut row = cloud.select(&[index]);
    row.quats[0] = [1.0, 0.0, 0.0, 0.0];
    row.is_row_valid(0)
}
