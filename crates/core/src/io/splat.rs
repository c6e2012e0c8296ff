//! `.splat` files, the format of the first WebGL viewers: 32 bytes per Gaussian, no header, no spherical harmonics.
//!
//! | bytes | value | error after a round trip |
//! |---|---|---|
//! | 0–11 | position, 3 × `f32` | none |
//! | 12–23 | standard deviations, 3 × `f32` | rounding of `exp` and `ln`; log scales −87 to 88 |
//! | 24–26 | DC colour, 0..1 in 255 steps | ½/255, clamped to 0..1 |
//! | 27 | opacity in 255 steps | ½/255 |
//! | 28–31 | unit quaternion w x y z, component c as 128 + 128 c | ½/128 before it is normalised; 1/128 above 127/128 |
//!
//! Rows stay in their order. The format has neither magic bytes nor a count: a file is recognised by its name.

use super::ply::{PlyReport, UnusableRow, without_unusable};
use super::quantize::{logit_from_u8, normalized, opacity_to_u8};
use crate::color::{from_u8, to_u8};
use crate::error::{Error, Result};
use crate::gaussian_cloud::GaussianCloud;
use crate::sh::{color_from_dc, dc_from_color};
use std::io::Write;
use std::path::Path;

/// Bytes per Gaussian.
pub const ROW_BYTES: usize = 32;

/// Reads the rows in `bytes`, the content of `path`.
pub(super) fn read(path: &Path, bytes: &[u8]) -> Result<(GaussianCloud, PlyReport)> {
    if bytes.is_empty() || !bytes.len().is_multiple_of(ROW_BYTES) {
        let message = format!(
            "found {} bytes, expected a multiple of {ROW_BYTES}, the size of a Gaussian in a `.splat` file",
            bytes.len()
        );
        return Err(Error::format(path, message, "the file is truncated or no `.splat` file: export it again"));
    }
    let mut cloud = GaussianCloud::zeros(bytes.len() / ROW_BYTES, 0);
    for (index, row) in bytes.chunks_exact(ROW_BYTES).enumerate() {
        let float = |at: usize| f32::from_le_bytes([row[at], row[at + 1], row[at + 2], row[at + 3]]);
        cloud.means[index] = [float(0), float(4), float(8)];
        // A scale of 0 has no logarithm, a negative one no meaning: such rows are left out below.
        cloud.log_scales[index] = [float(12), float(16), float(20)].map(f32::ln);
        cloud.sh[index] = [row[24], row[25], row[26]].map(|level| dc_from_color(from_u8(level)));
        cloud.opacity_logits[index] = logit_from_u8(row[27]);
        cloud.quats[index] = [row[28], row[29], row[30], row[31]].map(|level| (f32::from(level) - 128.0) / 128.0);
    }
    let unusable = UnusableRow::all_of(&cloud);
    Ok(without_unusable(cloud, &unusable))
}

/// Writes `cloud`; all but the constant spherical harmonic are left out. Returns how many colour channels lay outside
/// 0..1 and were clamped.
///
/// # Errors
///
/// What the writer returns.
pub(super) fn write(out: &mut impl Write, cloud: &GaussianCloud) -> std::io::Result<usize> {
    let mut num_clamped = 0;
    for index in 0..cloud.len() {
        let mut row = [0; ROW_BYTES];
        // Neither 0 nor infinity can be read back.
        let scales = cloud.log_scales[index].map(|log| log.exp().clamp(f32::MIN_POSITIVE, f32::MAX));
        for (bytes, value) in row.chunks_exact_mut(4).zip(cloud.means[index].iter().chain(&scales)) {
            bytes.copy_from_slice(&value.to_le_bytes());
        }
        let color = cloud.sh_of(index)[0].map(color_from_dc);
        num_clamped += color.iter().filter(|c| !(0.0..=1.0).contains(*c)).count();
        row[24..27].copy_from_slice(&color.map(to_u8));
        row[27] = opacity_to_u8(cloud.opacity_logits[index]);
        // The cast saturates: +1 would be 256.
        row[28..32].copy_from_slice(&normalized(cloud.quats[index]).map(|c| (c * 128.0 + 128.5) as u8));
        out.write_all(&row)?;
    }
    Ok(num_clamped)
}
