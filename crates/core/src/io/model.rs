//! Gaussian models in any of the formats that are in circulation: one loader, one writer.
//!
//! | format | names | read | written | spherical harmonics |
//! |---|---|---|---|---|
//! | 3DGS PLY | `.ply` | yes | yes, exact | degree 0 to 4 |
//! | compressed PLY (SuperSplat) | `.compressed.ply`, `.ply` | yes | yes | degree 0 to 3, 8 bits |
//! | `.splat` | `.splat` | yes | yes | none |
//! | SPZ | `.spz` | versions 2 to 4 | versions 3 and 4 | degree 0 to 4, 1 to 8 bits |
//!
//! How exact each one is stands in the table at the top of its module: [`ply`], [`super::splat`], [`spz`].

use super::file_bytes::FileBytes;
use super::ply::PlyReport;
use super::spz::{SpzOptions, SpzVersion};
use super::{ply, splat, spz, write_atomically};
use crate::error::Result;
use crate::gaussian_cloud::GaussianCloud;
use crate::sh;
use std::fmt;
use std::path::Path;
use std::str::FromStr;

/// A file format of Gaussian models.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ModelFormat {
    /// The PLY of the 3DGS reference implementation: 32-bit floats, exact.
    Ply,
    /// The compressed PLY of SuperSplat.
    CompressedPly,
    /// 32 bytes per Gaussian, no spherical harmonics.
    Splat,
    /// SPZ of version 3; read: of any version.
    Spz3,
    /// SPZ of version 4.
    Spz4,
}

impl ModelFormat {
    /// Every format.
    pub const ALL: [Self; 5] = [Self::Ply, Self::CompressedPly, Self::Splat, Self::Spz3, Self::Spz4];

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::CompressedPly => "compressed-ply",
            Self::Splat => "splat",
            Self::Spz3 => "spz",
            Self::Spz4 => "spz4",
        }
    }

    /// What a person calls it.
    pub fn kind(self) -> &'static str {
        match self {
            Self::Ply => "3DGS PLY",
            Self::CompressedPly => "compressed PLY",
            Self::Splat => ".splat",
            Self::Spz3 | Self::Spz4 => "SPZ",
        }
    }

    /// The format that the name of a file to be written asks for: `.compressed.ply`, `.ply`, `.splat`, `.spz` (version 3,
    /// which every reader takes).
    pub fn of_path(path: &Path) -> Option<Self> {
        let name = path.file_name()?.to_string_lossy().to_lowercase();
        let endings = [
            (".compressed.ply", Self::CompressedPly),
            (".ply", Self::Ply),
            (".splat", Self::Splat),
            (".spz", Self::Spz3),
        ];
        endings.into_iter().find(|(ending, _)| name.ends_with(ending)).map(|(_, format)| format)
    }

    /// Highest SH degree it holds.
    pub fn max_sh_degree(self) -> u32 {
        match self {
            Self::Ply | Self::Spz3 | Self::Spz4 => sh::MAX_DEGREE,
            Self::CompressedPly => ply::MAX_COMPRESSED_DEGREE,
            Self::Splat => 0,
        }
    }
}

impl fmt::Display for ModelFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for ModelFormat {
    type Err = String;

    /// # Errors
    /// A sentence with the names there are.
    fn from_str(text: &str) -> std::result::Result<Self, String> {
        Self::ALL.into_iter().find(|format| format.name() == text).ok_or_else(|| {
            let names = Self::ALL.map(Self::name).join(", ");
            format!("`{text}` is no format of models; there are {names}")
        })
    }
}

/// The comment of a PLY file whose model was trained for antialiased rendering (Mip-Splatting); Brush writes the same. An SPZ
/// file has a flag for it, which comes as this comment and goes with it; `.splat` has no place for either.
pub const ANTIALIASED_COMMENT: &str = "SplatRenderMode: mip";

fn is_antialiased(comments: &[String]) -> bool {
    comments.iter().any(|comment| comment.trim().eq_ignore_ascii_case(ANTIALIASED_COMMENT))
}

/// What a file held besides the model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ModelReport {
    /// The format it was recognised as; an SPZ file of any version counts as [`ModelFormat::Spz3`].
    pub format: ModelFormat,
    /// Rows in the file.
    pub num_rows: usize,
    /// Rows left out because one of their values is NaN or infinite.
    pub num_dropped_non_finite: usize,
    /// Rows left out because their quaternion is zero, which is no rotation.
    pub num_dropped_zero_quat: usize,
    /// Comment lines of a PLY header; of an SPZ file [`ANTIALIASED_COMMENT`] where its flag is set.
    pub comments: Vec<String>,
    /// What was passed over, in sentences for people.
    pub notes: Vec<String>,
}

impl ModelReport {
    /// Whether the file says that the model was trained for antialiased rendering.
    pub fn is_antialiased(&self) -> bool {
        is_antialiased(&self.comments)
    }
}

/// Reads the model in the file `path`; its first bytes tell the format, the name only that of `.splat` files, which have
/// none of their own. Rows that cannot be drawn are left out and counted.
///
/// # Errors
///
/// [`crate::Error::Io`] when the file cannot be read; [`crate::Error::Format`] when it is damaged; [`crate::Error::Unsupported`] for formats and
/// versions that are not read. Each names the file, what was found and what was expected.
pub fn load_with_report(path: impl AsRef<Path>) -> Result<(GaussianCloud, ModelReport)> {
    let path = path.as_ref();
    let bytes = FileBytes::open(path)?;
    let is_splat = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("splat"));
    let is_ply = bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r\n");
    let (mut comments, mut notes) = (Vec::new(), Vec::new());
    let (cloud, rows, format) = if spz::is_spz(&bytes) {
        let content = spz::read(path, &bytes)?;
        let (cloud, rows) = (content.cloud, content.report);
        notes = content.notes;
        comments.extend(content.antialiased.then(|| ANTIALIASED_COMMENT.to_owned()));
        (cloud, rows, ModelFormat::Spz3)
    } else if is_splat && !is_ply {
        let (cloud, rows) = splat::read(path, &bytes)?;
        (cloud, rows, ModelFormat::Splat)
    } else {
        let content = ply::read(path, &bytes)?;
        comments = content.comments;
        let format = if content.is_compressed { ModelFormat::CompressedPly } else { ModelFormat::Ply };
        (content.cloud, content.report, format)
    };
    let PlyReport { num_rows, num_dropped_non_finite, num_dropped_zero_quat } = rows;
    let report = ModelReport { format, num_rows, num_dropped_non_finite, num_dropped_zero_quat, comments, notes };
    Ok((cloud, report))
}

/// Reads a model as [`load_with_report`] does.
///
/// # Errors
///
/// As [`load_with_report`].
pub fn load(path: impl AsRef<Path>) -> Result<GaussianCloud> {
    load_with_report(path).map(|(cloud, _)| cloud)
}

/// How to write a model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SaveOptions {
    /// The format.
    pub format: ModelFormat,
    /// Bits per SH coefficient in an SPZ file, 1 to 8; `None` = 5 for degree 1 and 4 for the others.
    pub sh_bits: Option<u32>,
    /// Comment lines for the header of a PLY file; other formats have no place for them, but SPZ for
    /// [`ANTIALIASED_COMMENT`].
    pub comments: Vec<String>,
}

/// What was lost in writing, besides the rounding that the tables of the formats state.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SaveReport {
    /// Values that lay outside the range of the format and were clamped.
    pub num_clamped: usize,
}

/// Writes `cloud` to the file `path`, which appears complete or not at all. SH bands that the format does not hold are
/// left out.
///
/// # Errors
///
/// [`crate::Error::Parameter`] when the vectors of `cloud` differ in their number of rows or a value cannot be stored;
/// [`crate::Error::Io`] when writing fails, a full disk included: a file that was there before stays as it was.
pub fn save(path: impl AsRef<Path>, cloud: &GaussianCloud, options: &SaveOptions) -> Result<SaveReport> {
    let path = path.as_ref();
    cloud.validate_shape()?;
    let cut = cloud.sh_degree > options.format.max_sh_degree();
    let cut = cut.then(|| cloud.with_sh_degree(options.format.max_sh_degree()));
    let cloud = cut.as_ref().unwrap_or(cloud);
    let spz_options = |version| {
        let antialiased = is_antialiased(&options.comments);
        let defaults = SpzOptions { version, antialiased, ..SpzOptions::default() };
        options.sh_bits.map_or(defaults, |bits| SpzOptions { sh1_bits: bits, sh_rest_bits: bits, ..defaults })
    };
    let num_clamped = match options.format {
        ModelFormat::Ply => ply::save_with_comments(path, cloud, &options.comments).map(|()| 0)?,
        ModelFormat::CompressedPly => ply::save_compressed(path, cloud, &options.comments)?,
        ModelFormat::Splat => {
            cloud.validate()?;
            let mut num_clamped = 0;
            write_atomically(path, |out| {
                num_clamped = splat::write(out, cloud)?;
                Ok(())
            })?;
            num_clamped
        }
        ModelFormat::Spz3 => spz::save(path, cloud, spz_options(SpzVersion::V3))?,
        ModelFormat::Spz4 => spz::save(path, cloud, spz_options(SpzVersion::V4))?,
    };
    Ok(SaveReport { num_clamped })
}
