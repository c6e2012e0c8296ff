//! SPZ, the compact format of Niantic: quantised attributes, one stream each, compressed.
//!
//! Versions 2 and 3 are one gzip stream, version 4 has a plain header and one zstd frame per attribute; all three are read,
//! 3 and 4 are written. Coordinates go in and out as they are. The format's description calls its axes right, up, back, but
//! its own converter and `splat-transform` store those of the PLY file, and nothing here turns a model on the way (see
//! CONVENTIONS.md); only a file with the extension that names its axes is brought to right, down, forward, as PLY files
//! have them.
//!
//! | stream | stored as | error after a round trip |
//! |---|---|---|
//! | positions | 24-bit fixed point with f fractional bits | 2^-(f+1), f chosen as [`MAX_FRACTIONAL_BITS`] or what the range allows |
//! | alphas | 255 steps of the opacity | 1/510 |
//! | colours | 255 steps of ½ + 0.15 · DC | DC: 1 / (2 · 0.15 · 255) = 0.0131, clamped beyond ±3.33 |
//! | scales | sixteenths of the log scale from −10 | 1/32, clamped beyond −10 to 5.9375 |
//! | rotations, version 3 on | smallest three of x y z w: index 2 bits, sign and 9 bits each, of ½√2 | ½√2 / 1022 per stored component |
//! | rotations, version 2 | x y z in 127.5ths, w rebuilt | 1/255 per stored component |
//! | spherical harmonics | 128ths, of b bits only the upper ones used | 2^-b, clamped beyond −1 to 127/128 |
//!
//! The order of rows stays. Sources: the published description of the format (nianticlabs/spz, README).

mod axes;
mod container;
mod packed;

use super::ply::{PlyReport, UnusableRow, without_unusable};
use crate::error::{Error, Result};
use crate::gaussian_cloud::GaussianCloud;
use crate::sh;
use axes::Axes;
use packed::Packed;
use std::path::Path;

/// Most fractional bits the writer uses: steps of 1.5e-5 units up to ±128 units; larger models get coarser steps.
pub const MAX_FRACTIONAL_BITS: u32 = 16;

/// Which version to write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SpzVersion {
    /// One gzip stream; every reader in circulation takes it.
    V3,
    /// One zstd frame per attribute: read in parallel. The encoder here is a fast one, its files are larger than gzip's.
    V4,
}

/// How to write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SpzOptions {
    /// Version of the format.
    pub version: SpzVersion,
    /// Bits per SH coefficient of degree 1, 1 to 8. Default 5, as the reference implementation has it.
    pub sh1_bits: u32,
    /// Bits per SH coefficient of the higher degrees, 1 to 8. Default 4, as the reference implementation has it.
    pub sh_rest_bits: u32,
    /// The flag of a model that was trained for antialiased rendering. Default false.
    pub antialiased: bool,
}

impl Default for SpzOptions {
    fn default() -> Self {
        Self { version: SpzVersion::V3, sh1_bits: 5, sh_rest_bits: 4, antialiased: false }
    }
}

/// The fields of a header, whatever the container.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Header {
    version: u32,
    num_points: usize,
    sh_degree: u32,
    fractional_bits: u32,
    flags: u8,
}

/// The model was trained for antialiased rendering.
const FLAG_ANTIALIASED: u8 = 1;
/// The file has records of extensions.
const FLAG_EXTENSIONS: u8 = 2;

impl Header {
    /// Bytes of each stream: positions, alphas, colours, scales, rotations, spherical harmonics.
    fn stream_bytes(&self) -> [u64; 6] {
        let rotation = if self.version >= 3 { 4 } else { 3 };
        [9, 1, 3, 3, rotation, sh::num_rest(self.sh_degree) as u64].map(|bytes| bytes * self.num_points as u64)
    }

    /// Reads the twelve bytes after the magic and the byte of flags that all versions share.
    fn parse(path: &Path, bytes: &[u8; 16]) -> Result<Self> {
        let word = |at: usize| u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
        let [sh_degree, fractional_bits, flags] = [bytes[12], bytes[13], bytes[14]];
        let header = Self {
            version: word(4),
            num_points: word(8) as usize,
            sh_degree: sh_degree.into(),
            fractional_bits: fractional_bits.into(),
            flags,
        };
        if &bytes[..4] != MAGIC {
            let message = format!("the SPZ header starts with {:02x?}, expected {MAGIC:02x?} (`NGSP`)", &bytes[..4]);
            return Err(Error::format(path, message, "this is no SPZ file, or a damaged one: export it again"));
        }
        if header.sh_degree > sh::MAX_DEGREE {
            let message = format!("found SH degree {sh_degree}, expected 0 to {}", sh::MAX_DEGREE);
            return Err(Error::format(path, message, "the file is damaged: export it again"));
        }
        if header.fractional_bits > 23 {
            let message = format!("found {fractional_bits} fractional bits in 24-bit positions, expected 0 to 23");
            return Err(Error::format(path, message, "the file is damaged: export it again"));
        }
        Ok(header)
    }
}

/// The first bytes of the header.
const MAGIC: &[u8; 4] = b"NGSP";
/// The first bytes of a gzip stream.
const GZIP: &[u8; 2] = &[0x1f, 0x8b];

/// Whether a file that starts with `bytes` may be SPZ.
pub(super) fn is_spz(bytes: &[u8]) -> bool {
    bytes.starts_with(MAGIC) || bytes.starts_with(GZIP)
}

/// What a file holds.
pub(super) struct SpzContent {
    /// The model.
    pub cloud: GaussianCloud,
    /// What was left out of it.
    pub report: PlyReport,
    /// What was passed over, in sentences for people.
    pub notes: Vec<String>,
    /// Whether the model was trained for antialiased rendering.
    pub antialiased: bool,
}

/// Reads the model in `bytes`, the content of `path`.
pub(super) fn read(path: &Path, bytes: &[u8]) -> Result<SpzContent> {
    let mut notes = Vec::new();
    let (header, streams, axes) = if bytes.starts_with(MAGIC) {
        container::read_zstd(path, bytes, &mut notes)?
    } else {
        container::read_gzip(path, bytes, &mut notes)?
    };
    let mut cloud = Packed::of_streams(&header, &streams).unpack();
    if let Some(axes) = axes {
        axes::flip(&mut cloud, axes.signs_to(Axes::RDF));
    }
    let unusable = UnusableRow::all_of(&cloud);
    let (cloud, report) = without_unusable(cloud, &unusable);
    Ok(SpzContent { cloud, report, notes, antialiased: header.flags & FLAG_ANTIALIASED != 0 })
}

/// Writes `cloud`; the file appears complete or not at all. Returns how many values lay outside the range of the format
/// and were clamped.
///
/// # Errors
///
/// [`Error::Parameter`] when the vectors of `cloud` differ in their number of rows, a value is not finite, a position is
/// beyond ±2²³ units, or `options` is out of range; [`Error::Io`] when writing fails.
pub fn save(path: impl AsRef<Path>, cloud: &GaussianCloud, options: SpzOptions) -> Result<usize> {
    cloud.validate()?;
    for (name, bits) in [("sh1_bits", options.sh1_bits), ("sh_rest_bits", options.sh_rest_bits)] {
        if !(1..=8).contains(&bits) {
            return Err(Error::parameter(name, format!("found {bits}, expected 1 to 8")));
        }
    }
    if u32::try_from(cloud.len()).is_err() {
        let message = format!("found {}, an SPZ file holds at most {}", cloud.len(), u32::MAX);
        return Err(Error::parameter("number of Gaussians", message));
    }
    let fractional_bits = packed::fractional_bits(cloud)?;
    let (version, bits) = match options.version {
        SpzVersion::V3 => (3, [options.sh1_bits, options.sh_rest_bits]),
        SpzVersion::V4 => (4, [options.sh1_bits, options.sh_rest_bits]),
    };
    let flags = if options.antialiased { FLAG_ANTIALIASED } else { 0 };
    let header = Header { version, num_points: cloud.len(), sh_degree: cloud.sh_degree, fractional_bits, flags };
    let (streams, num_clamped) = packed::pack(cloud, fractional_bits, bits);
    super::write_atomically(path.as_ref(), |out| match options.version {
        SpzVersion::V3 => container::write_gzip(out, &header, &streams),
        SpzVersion::V4 => container::write_zstd(out, &header, &streams),
    })?;
    Ok(num_clamped)
}
