//! Every other PLY: any encoding, types and element order, row by row through `ply-rs-bw`.
//!
//! ASCII rows are split here: the library's grammar for numbers knows neither `nan` nor `.5` nor `1.`, which files
//! in circulation hold.

use super::UnusableRow;
use super::attributes::{Attributes, RowMut};
use super::header::Header;
use crate::error::{Error, Result};
use crate::gaussian_cloud::GaussianCloud;
use ply_rs_bw::parser::{ParseError, Parser};
use ply_rs_bw::ply::{ElementDef, Encoding, PropertyAccess, PropertyAccessResult, PropertyType};
use std::io::ErrorKind;
use std::path::Path;

/// Reads a Gaussian model. Unusable rows are in the cloud and listed beside it, in order.
pub(super) fn read_gaussians(
    path: &Path,
    bytes: &[u8],
    header: &Header,
    attributes: &Attributes,
) -> Result<(GaussianCloud, Vec<UnusableRow>)> {
    // A row takes at least as many bytes as it has properties, whatever the header claims.
    let most_rows = (bytes.len() - header.data_offset) / header.vertex.properties.len().max(1);
    let mut cloud = GaussianCloud::zeros(header.vertex.count.min(most_rows), attributes.sh_degree);
    let mut unusable = Vec::new();
    for_each_row(path, bytes, header, |index, values| {
        if index < cloud.len() {
            let state = attributes.scatter(|column| values[column], RowMut::of(&mut cloud, index));
            unusable.extend(UnusableRow::check(index, state));
        }
    })?;
    Ok((cloud, unusable))
}

/// Calls `each` with the index and the values of every vertex row; lists stand as 0, all numbers as `f32`.
pub(super) fn for_each_row(
    path: &Path,
    bytes: &[u8],
    header: &Header,
    mut each: impl FnMut(usize, &[f32]),
) -> Result<()> {
    let mut data = &bytes[header.data_offset..];
    let mut read_rows = |element: &ElementDef, each: &mut dyn FnMut(usize, &[f32])| -> Result<()> {
        // An element without properties takes no bytes; its count may be anything.
        let count = if element.properties.is_empty() { 0 } else { element.count };
        for index in 0..count {
            let row = match header.encoding {
                Encoding::Ascii => read_ascii_row(&mut data, element).map_err(|bad| {
                    bad.map(|token| {
                        let message = format!("`{}` row {index}: `{token}` is not a number", element.name);
                        Error::format(path, message, "the file is damaged: export it again")
                    })
                }),
                Encoding::BinaryLittleEndian => {
                    Parser::<Row>::new().read_little_endian_element(&mut data, element).map_err(|e| binary(path, &e))
                }
                Encoding::BinaryBigEndian => {
                    Parser::<Row>::new().read_big_endian_element(&mut data, element).map_err(|e| binary(path, &e))
                }
            };
            match row {
                Ok(row) => each(index, &row.values),
                Err(Some(error)) => return Err(error),
                Err(None) if element.name == "vertex" => return Err(header.truncated(path, index)),
                Err(None) => return Err(header.truncated(path, 0)),
            }
        }
        Ok(())
    };
    for element in &header.before {
        read_rows(element, &mut |_, _| ())?;
    }
    read_rows(&header.vertex, &mut each)
}

/// `None` stands for "the file ends here".
fn binary(path: &Path, error: &ParseError) -> Option<Error> {
    (error.kind() != ErrorKind::UnexpectedEof)
        .then(|| Error::format(path, format!("malformed PLY row: {error}"), "the file is damaged: export it again"))
}

/// Reads one row of whitespace-separated numbers. The error is the token that is no number, or `None` at the end of the
/// file.
fn read_ascii_row(data: &mut &[u8], element: &ElementDef) -> std::result::Result<Row, Option<String>> {
    let mut row = Row::new();
    for property in element.properties.values() {
        let value = read_ascii_number(data)?;
        match property.data_type {
            PropertyType::Scalar(_) => row.values.push(value),
            PropertyType::List(..) => {
                for _ in 0..value as u64 {
                    read_ascii_number(data)?;
                }
                row.values.push(0.0);
            }
        }
    }
    Ok(row)
}

fn read_ascii_number(data: &mut &[u8]) -> std::result::Result<f32, Option<String>> {
    let rest = data.trim_ascii_start();
    let length = rest.iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len());
    let (token, rest) = rest.split_at(length);
    *data = rest;
    if token.is_empty() {
        return Err(None);
    }
    let text = String::from_utf8_lossy(token);
    text.parse().map_err(|_| Some(text.chars().take(20).collect()))
}

/// One row as the library fills it: setters are called in the order of the header, so position is name enough.
struct Row {
    values: Vec<f32>,
}

impl Row {
    fn push(&mut self, value: f32) -> PropertyAccessResult {
        self.values.push(value);
        PropertyAccessResult::Set
    }
}

impl PropertyAccess for Row {
    fn new() -> Self {
        // Room for degree 3 with normals, so that the common row is allocated once.
        Self { values: Vec::with_capacity(64) }
    }

    fn set_property(&mut self, _name: &str, property: ply_rs_bw::ply::Property) -> PropertyAccessResult {
        self.push(property.to_f32_lossy().unwrap_or(0.0))
    }
}
