//! The compressed PLY of SuperSplat and PlayCanvas: 16 bytes per Gaussian, and one per SH coefficient.
//!
//! Rows come in chunks of 256. A `chunk` element holds the bounds of the values of its rows (position, log scale, colour,
//! as floats), a `vertex` four 32-bit words with values between these bounds, and an optional `sh` element the other
//! coefficients as bytes, channel-major as in the plain layout. Neighbours in the file should be neighbours in space: the
//! smaller a chunk, the finer its steps. The writer keeps the order it is given.
//!
//! | word | bits, from the highest | error after a round trip |
//! |---|---|---|
//! | `packed_position` | x 11, y 10, z 11 | half of (extent of the chunk) / 2047, y: / 1023 |
//! | `packed_rotation` | index of the largest of w x y z 2, the other three 10 each, −½√2 to ½√2 | √2 / 2046 per stored component |
//! | `packed_scale` | as the position, of log scales | half of (range in the chunk) / 2047, second axis: / 1023 |
//! | `packed_color` | r g b 8 each between the bounds, opacity 8 | half of (range in the chunk) / 255; opacity 1/510 |
//! | `f_rest_*` | 8, −4 to 4 | 1/64; 1/32 in the first and the last step; clamped beyond |

use super::UnusableRow;
use super::fast::start_of_header;
use super::header::{Header, list_or_none};
use crate::error::{Error, Result};
use crate::gaussian_cloud::GaussianCloud;
use crate::io::quantize::{from_smallest_three, logit_from_u8, normalized, opacity_to_u8, smallest_three};
use crate::sh::{self, color_from_dc, dc_from_color};
use ply_rs_bw::ply::{ElementDef, Encoding, PropertyType, ScalarType};
use std::f32::consts::SQRT_2;
use std::io::Write;
use std::path::Path;

/// Rows that share their bounds.
const ROWS_PER_CHUNK: usize = 256;

/// Bounds of a chunk in the order of the file: position, log scale, colour; smallest values first.
const BOUNDS: [[&str; 3]; 6] = [
    ["min_x", "min_y", "min_z"],
    ["max_x", "max_y", "max_z"],
    ["min_scale_x", "min_scale_y", "min_scale_z"],
    ["max_scale_x", "max_scale_y", "max_scale_z"],
    ["min_r", "min_g", "min_b"],
    ["max_r", "max_g", "max_b"],
];

/// The packed words of a row, in the order of the file.
const WORDS: [&str; 4] = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];

/// The coefficients beyond these are clamped; half the range that 256 steps cover.
const MAX_SH: f32 = 4.0;

/// Highest SH degree that programs read from this format.
pub(in crate::io) const MAX_DEGREE: u32 = 3;

/// Bits of the three parts of a word that holds a vector.
const VECTOR_BITS: [u32; 3] = [11, 10, 11];

/// Reads the model whose `header` has been read. Unusable rows are in the cloud and listed beside it, in order.
pub(super) fn read(path: &Path, bytes: &[u8], header: &Header) -> Result<(GaussianCloud, Vec<UnusableRow>)> {
    if header.encoding != Encoding::BinaryLittleEndian {
        let message = "a compressed PLY that is not binary little endian";
        return Err(Error::unsupported(path, message, "export the model again, or as a plain PLY"));
    }
    let mut tables = Tables::new(path, bytes, header.data_offset);
    let elements: Vec<&ElementDef> =
        header.before.iter().chain(std::iter::once(&header.vertex)).chain(&header.after).collect();
    let tables: Vec<Table<'_>> = elements.into_iter().map(|element| tables.next(element)).collect::<Result<_>>()?;
    let named = |name: &str| tables.iter().find(|table| table.element.name == name);
    let [vertex, chunks] = ["vertex", "chunk"].map(|name| {
        named(name).ok_or_else(|| {
            Error::format(path, format!("a compressed PLY without a `{name}` element"), "export the model again")
        })
    });
    let (vertex, chunks) = (vertex?, chunks?);
    let (num_rows, num_chunks) = (vertex.element.count, vertex.element.count.div_ceil(ROWS_PER_CHUNK));
    if chunks.element.count < num_chunks {
        let message = format!("found {} chunks, expected {num_chunks} for {num_rows} rows", chunks.element.count);
        return Err(Error::format(path, message, "the file is damaged: export it again"));
    }
    let words = WORDS.map(|name| vertex.column(name, ScalarType::UInt));
    let [position, rotation, scale, color] = all(words).map_err(|missing| vertex.lacks(path, &missing))?;
    let num_bounds = if chunks.column(BOUNDS[4][0], ScalarType::Float).is_ok() { 6 } else { 4 };
    let bounds: Vec<[usize; 3]> = BOUNDS[..num_bounds]
        .iter()
        .map(|names| all(names.map(|name| chunks.column(name, ScalarType::Float))))
        .collect::<std::result::Result<_, _>>()
        .map_err(|missing| chunks.lacks(path, &missing))?;
    let rest = named("sh").map(|table| rest_columns(path, table, num_rows).map(|columns| (table, columns)));
    let (rest_table, rest) = rest.transpose()?.unzip();
    let rest = rest.unwrap_or_default();

    let degree = sh::degree_from_rest(rest.len()).unwrap_or(0);
    let per_channel = rest.len() / 3;
    let mut cloud = GaussianCloud::zeros(num_rows, degree);
    let k = cloud.num_coefficients();
    for index in 0..num_rows {
        let chunk = chunks.row(index / ROWS_PER_CHUNK);
        let bound = |which: usize| bounds[which].map(|at| f32::from_bits(word(chunk, at)));
        let row = vertex.row(index);
        cloud.means[index] = lerp(bound(0), bound(1), unpacked_vector(word(row, position)));
        cloud.log_scales[index] = lerp(bound(2), bound(3), unpacked_vector(word(row, scale)));
        cloud.quats[index] = unpacked_rotation(word(row, rotation));
        let [r, g, b, opacity] = word(row, color).to_be_bytes();
        let share = [r, g, b].map(|level| f64::from(level) / 255.0);
        let rgb = if num_bounds == 6 { lerp(bound(4), bound(5), share) } else { share.map(|v| v as f32) };
        cloud.sh[index * k] = rgb.map(dc_from_color);
        cloud.opacity_logits[index] = logit_from_u8(opacity);
        if let Some(table) = rest_table {
            let row = table.row(index);
            for (j, coefficient) in cloud.sh[index * k + 1..(index + 1) * k].iter_mut().enumerate() {
                *coefficient = [0, 1, 2].map(|channel| sh_from_u8(row[rest[channel * per_channel + j]]));
            }
        }
    }
    let unusable = UnusableRow::all_of(&cloud);
    Ok((cloud, unusable))
}

/// Writes `cloud` as a compressed PLY with `comments` in the header; the file appears complete or not at all. Returns how
/// many coefficients beyond ±4 were clamped.
///
/// # Errors
///
/// [`Error::Parameter`] when the vectors of `cloud` differ in their number of rows, a value is not finite, or the SH degree
/// is above 3; [`Error::Io`] when writing fails.
pub fn save_compressed(path: impl AsRef<Path>, cloud: &GaussianCloud, comments: &[String]) -> Result<usize> {
    cloud.validate()?;
    if cloud.sh_degree > MAX_DEGREE {
        let message = format!("found {}, a compressed PLY holds 0 to {MAX_DEGREE}", cloud.sh_degree);
        return Err(Error::parameter("sh_degree", message));
    }
    crate::io::write_atomically(path.as_ref(), |out| write(out, cloud, comments))?;
    let rest = (0..cloud.len()).flat_map(|index| &cloud.sh_of(index)[1..]).flatten();
    Ok(rest.filter(|v| v.abs() > MAX_SH).count())
}

fn write(out: &mut impl Write, cloud: &GaussianCloud, comments: &[String]) -> std::io::Result<()> {
    let (n, num_rest) = (cloud.len(), sh::num_rest(cloud.sh_degree));
    let mut text = start_of_header(comments);
    let mut line = |line: String| text.push_str(&format!("{line}\n"));
    line(format!("element chunk {}", n.div_ceil(ROWS_PER_CHUNK)));
    BOUNDS.iter().flatten().for_each(|name| line(format!("property float {name}")));
    line(format!("element vertex {n}"));
    WORDS.iter().for_each(|name| line(format!("property uint {name}")));
    if num_rest > 0 {
        line(format!("element sh {n}"));
        (0..num_rest).for_each(|i| line(format!("property uchar f_rest_{i}")));
    }
    line("end_header".into());
    out.write_all(text.as_bytes())?;

    let chunks = || (0..n).step_by(ROWS_PER_CHUNK).map(|first| Chunk::new(cloud, first..n.min(first + ROWS_PER_CHUNK)));
    for chunk in chunks() {
        for value in chunk.bounds.as_flattened() {
            out.write_all(&value.to_le_bytes())?;
        }
    }
    for chunk in chunks() {
        for index in chunk.rows.clone() {
            for word in chunk.words(cloud, index) {
                out.write_all(&word.to_le_bytes())?;
            }
        }
    }
    for index in (0..n).filter(|_| num_rest > 0) {
        let rest = &cloud.sh_of(index)[1..];
        for channel in 0..3 {
            for coefficient in rest {
                out.write_all(&[sh_to_u8(coefficient[channel])])?;
            }
        }
    }
    Ok(())
}

/// Rows with their bounds, in the order of [`BOUNDS`].
struct Chunk {
    rows: std::ops::Range<usize>,
    bounds: [[f32; 3]; 6],
}

impl Chunk {
    fn new(cloud: &GaussianCloud, rows: std::ops::Range<usize>) -> Self {
        let mut bounds = [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]].repeat(3);
        for index in rows.clone() {
            let values = [cloud.means[index], cloud.log_scales[index], cloud.sh_of(index)[0].map(color_from_dc)];
            for (pair, values) in bounds.chunks_exact_mut(2).zip(values) {
                for (axis, value) in values.into_iter().enumerate() {
                    pair[0][axis] = pair[0][axis].min(value);
                    pair[1][axis] = pair[1][axis].max(value);
                }
            }
        }
        Self { rows, bounds: [bounds[0], bounds[1], bounds[2], bounds[3], bounds[4], bounds[5]] }
    }

    fn words(&self, cloud: &GaussianCloud, index: usize) -> [u32; 4] {
        let [p0, p1, s0, s1, c0, c1] = self.bounds;
        let position = packed_vector(relative(p0, p1, cloud.means[index]));
        let scale = packed_vector(relative(s0, s1, cloud.log_scales[index]));
        let [r, g, b] = relative(c0, c1, cloud.sh_of(index)[0].map(color_from_dc)).map(|t| level(t, 8) as u8);
        let color = u32::from_be_bytes([r, g, b, opacity_to_u8(cloud.opacity_logits[index])]);
        [position, packed_rotation(cloud.quats[index]), scale, color]
    }
}

/// `t` in 0..1 as a whole number of `bits` bits, halves rounded up.
fn level(t: f64, bits: u32) -> u32 {
    let top = f64::from((1_u32 << bits) - 1);
    (t * top + 0.5).min(top) as u32
}

/// Where `values` lie between their bounds, 0 where the bounds are one. In `f64`, as a range may exceed what `f32` holds.
fn relative(low: [f32; 3], high: [f32; 3], values: [f32; 3]) -> [f64; 3] {
    [0, 1, 2].map(|axis| {
        let (low, high) = (f64::from(low[axis]), f64::from(high[axis]));
        if high > low { (f64::from(values[axis]) - low) / (high - low) } else { 0.0 }
    })
}

/// In `f64`, so that what is rounded is the value alone, and not bounds that are far larger.
fn lerp(low: [f32; 3], high: [f32; 3], t: [f64; 3]) -> [f32; 3] {
    [0, 1, 2].map(|axis| (f64::from(low[axis]) * (1.0 - t[axis]) + f64::from(high[axis]) * t[axis]) as f32)
}

fn packed_vector(t: [f64; 3]) -> u32 {
    t.iter().zip(VECTOR_BITS).fold(0, |word, (&t, bits)| (word << bits) | level(t, bits))
}

fn unpacked_vector(word: u32) -> [f64; 3] {
    let part = |shift: u32, bits: u32| {
        let top = (1 << bits) - 1;
        f64::from((word >> shift) & top) / f64::from(top)
    };
    [part(21, 11), part(11, 10), part(0, 11)]
}

fn packed_rotation(quat: [f32; 4]) -> u32 {
    let (largest, others) = smallest_three(normalized(quat));
    // A component that is not the largest is at most ½√2 long.
    let part = |word, component: f32| (word << 10) | level(f64::from(component / SQRT_2 + 0.5).max(0.0), 10);
    others.into_iter().fold(largest as u32, part)
}

fn unpacked_rotation(word: u32) -> [f32; 4] {
    let part = |shift: u32| (((word >> shift) & 1023) as f32 / 1023.0 - 0.5) * SQRT_2;
    from_smallest_three((word >> 30) as usize, [part(20), part(10), part(0)])
}

fn sh_to_u8(value: f32) -> u8 {
    // The cast saturates.
    ((value / (2.0 * MAX_SH) + 0.5) * 256.0) as u8
}

fn sh_from_u8(level: u8) -> f32 {
    let t = match level {
        0 => 0.0,
        255 => 1.0,
        level => (f32::from(level) + 0.5) / 256.0,
    };
    (t - 0.5) * 2.0 * MAX_SH
}

/// The little-endian word at byte `at` of a row.
fn word(row: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([row[at], row[at + 1], row[at + 2], row[at + 3]])
}

/// All values, or the first error.
fn all<T: Copy + Default, E, const K: usize>(values: [std::result::Result<T, E>; K]) -> std::result::Result<[T; K], E> {
    let mut found = [T::default(); K];
    for (place, value) in found.iter_mut().zip(values) {
        *place = value?;
    }
    Ok(found)
}

fn rest_columns(path: &Path, table: &Table<'_>, num_rows: usize) -> Result<Vec<usize>> {
    if table.element.count != num_rows {
        let message = format!("found {} rows of `sh`, expected {num_rows}, one per vertex", table.element.count);
        return Err(Error::format(path, message, "the file is damaged: export it again"));
    }
    let num_rest = table.element.properties.len();
    if sh::degree_from_rest(num_rest).is_none() {
        let message = format!("found {num_rest} properties of `sh`, expected 0, 9, 24, 45 or 72 (SH degree 0 to 4)");
        return Err(Error::format(path, message, "export the model with complete spherical harmonics of one degree"));
    }
    let columns = (0..num_rest).map(|i| table.column(&format!("f_rest_{i}"), ScalarType::UChar));
    columns.collect::<std::result::Result<_, _>>().map_err(|missing| table.lacks(path, &missing))
}

/// An element whose rows all have the same size and are known to be there.
struct Table<'a> {
    element: &'a ElementDef,
    data: &'a [u8],
    row_bytes: usize,
}

impl Table<'_> {
    fn row(&self, index: usize) -> &[u8] {
        &self.data[index * self.row_bytes..(index + 1) * self.row_bytes]
    }

    /// Offset of the property `name` of the type `kind` in a row, or its name.
    fn column(&self, name: &str, kind: ScalarType) -> std::result::Result<usize, String> {
        let mut at = 0;
        for (other, property) in &self.element.properties {
            match &property.data_type {
                PropertyType::Scalar(found) if other == name && *found == kind => return Ok(at),
                PropertyType::Scalar(found) => at += num_bytes(found),
                PropertyType::List(..) => break,
            }
        }
        Err(name.to_owned())
    }

    fn lacks(&self, path: &Path, name: &str) -> Error {
        let found: Vec<String> = self.element.properties.keys().cloned().collect();
        let message =
            format!("`{}` has no `{name}` of the usual type; it has: {}", self.element.name, list_or_none(&found));
        Error::format(path, message, "export the model again")
    }
}

/// Hands out the elements of a file in their order.
struct Tables<'a> {
    path: &'a Path,
    rest: &'a [u8],
}

impl<'a> Tables<'a> {
    fn new(path: &'a Path, bytes: &'a [u8], data_offset: usize) -> Self {
        Self { path, rest: &bytes[data_offset..] }
    }

    fn next(&mut self, element: &'a ElementDef) -> Result<Table<'a>> {
        let mut row_bytes = 0;
        for property in element.properties.values() {
            let PropertyType::Scalar(kind) = &property.data_type else {
                let message = format!("a compressed PLY with lists in its element `{}`", element.name);
                return Err(Error::unsupported(self.path, message, "export the model as a plain PLY"));
            };
            row_bytes += num_bytes(kind);
        }
        let size = element.count.checked_mul(row_bytes).filter(|size| *size <= self.rest.len());
        let Some(size) = size else {
            let found = self.rest.len() / row_bytes.max(1);
            return Err(Error::format(
                self.path,
                format!("truncated: found {found} of {} rows of `{}`", element.count, element.name),
                "the file was not written or copied completely: copy or export it again",
            ));
        };
        // An element without properties takes no bytes; its count may be anything and counts for nothing.
        let (data, rest) = self.rest.split_at(size);
        self.rest = rest;
        Ok(Table { element, data, row_bytes })
    }
}

fn num_bytes(kind: &ScalarType) -> usize {
    match kind {
        ScalarType::Char | ScalarType::UChar => 1,
        ScalarType::Short | ScalarType::UShort => 2,
        ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
        ScalarType::Double => 8,
    }
}
