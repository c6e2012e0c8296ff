//! The PLY header: `ply-rs-bw` reads the lines, this file checks what the readers rely on.

use crate::error::{Error, Result};
use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{DefaultElement, ElementDef, Encoding, PropertyType, ScalarType};
use std::path::Path;

/// A header is a few kilobytes; a file without `end_header` in its first MiB is not searched to its end.
const MAX_HEADER_BYTES: usize = 1 << 20;

/// Parsed header of a PLY file that has vertices.
pub(super) struct Header {
    /// Encoding of everything after the header.
    pub encoding: Encoding,
    /// Elements stored before the vertices.
    pub before: Vec<ElementDef>,
    /// The vertices.
    pub vertex: ElementDef,
    /// Elements stored after the vertices.
    pub after: Vec<ElementDef>,
    /// Comment lines, without the word `comment`.
    pub comments: Vec<String>,
    /// Offset of the first byte after the header.
    pub data_offset: usize,
}

impl Header {
    /// Reads the header of `bytes`, the content of `path`.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self> {
        if !bytes.starts_with(b"ply\n") && !bytes.starts_with(b"ply\r\n") {
            return Err(not_a_ply(path, bytes));
        }
        let data_offset = end_of_header(bytes).ok_or_else(|| {
            Error::format(
                path,
                "the PLY header has no `end_header` line",
                "the file is truncated or damaged: copy or export it again",
            )
        })?;
        let text = String::from_utf8_lossy(&bytes[..data_offset]);
        let parsed = Parser::<DefaultElement>::new()
            .read_header(&mut Reader::new(text.as_bytes()))
            .map_err(|e| Error::format(path, format!("malformed PLY header: {e}"), "export the file again"))?;
        check_for_duplicates(path, &text, parsed.elements.values())?;

        let encoding = parsed.encoding;
        let names: Vec<String> = parsed.elements.keys().cloned().collect();
        let mut elements: Vec<ElementDef> = parsed.elements.into_iter().map(|(_, element)| element).collect();
        let Some(position) = elements.iter().position(|element| element.name == "vertex") else {
            return Err(Error::format(
                path,
                format!("no `vertex` element; the file has: {}", list_or_none(&names)),
                "a model or point cloud is stored as `vertex` elements",
            ));
        };
        let after = elements.split_off(position + 1);
        let vertex = elements.pop().expect("`position` is an index of `elements`");
        Ok(Self { encoding, before: elements, vertex, after, comments: comments(&text), data_offset })
    }

    /// Index of the scalar property `name` in a vertex row.
    pub fn column(&self, name: &str) -> Option<usize> {
        let (index, _, property) = self.vertex.properties.get_full(name)?;
        matches!(property.data_type, PropertyType::Scalar(_)).then_some(index)
    }

    /// True when vertex rows are consecutive little-endian `f32`s right after the header.
    pub fn is_all_float_little_endian(&self) -> bool {
        self.encoding == Encoding::BinaryLittleEndian
            && self.before.is_empty()
            && self.vertex.properties.values().all(|p| p.data_type == PropertyType::Scalar(ScalarType::Float))
    }

    /// The error for a file that ends after `found` complete vertex rows.
    pub fn truncated(&self, path: &Path, found: usize) -> Error {
        Error::format(
            path,
            format!("truncated: found {found} of {} vertex rows", self.vertex.count),
            "the file was not written or copied completely: copy or export it again",
        )
    }
}

fn comments(text: &str) -> Vec<String> {
    text.lines().filter_map(|line| line.strip_prefix("comment ")).map(|line| line.trim().to_owned()).collect()
}

/// Names joined by commas, for messages.
pub(super) fn list_or_none(names: &[String]) -> String {
    if names.is_empty() { "none".into() } else { names.join(", ") }
}

fn end_of_header(bytes: &[u8]) -> Option<usize> {
    let head = &bytes[..bytes.len().min(MAX_HEADER_BYTES)];
    let mut start = 0;
    while let Some(length) = head[start..].iter().position(|&b| b == b'\n') {
        let line = &head[start..start + length];
        start += length + 1;
        if line.trim_ascii_end() == b"end_header" {
            return Some(start);
        }
    }
    None
}

/// The parser keeps one definition per name, so that a repeated name would shift every later column silently.
fn check_for_duplicates<'a>(path: &Path, text: &str, elements: impl Iterator<Item = &'a ElementDef>) -> Result<()> {
    let num_lines = |keyword: &str| text.lines().filter(|line| line.split_whitespace().next() == Some(keyword)).count();
    let (mut num_elements, mut num_properties) = (0, 0);
    for element in elements {
        num_elements += 1;
        num_properties += element.properties.len();
    }
    if (num_lines("element"), num_lines("property")) == (num_elements, num_properties) {
        return Ok(());
    }
    Err(Error::format(path, "an element or property is declared twice in the PLY header", "export the file again"))
}

fn not_a_ply(path: &Path, bytes: &[u8]) -> Error {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    let other = match (bytes, extension.as_str()) {
        ([], _) => return Error::format(path, "the file is empty, expected a PLY file", "export the model again"),
        ([0x1f, 0x8b, ..], "spz") => "an SPZ file",
        ([0x1f, 0x8b, ..], _) => "a gzip file",
        ([b'P', b'K', 3, 4, ..], "sog") => "a SOG bundle",
        ([b'P', b'K', 3, 4, ..], _) => "a zip archive",
        ([b'g', b'l', b'T', b'F', ..], _) => "a glTF file",
        (_, "splat") => "a `.splat` file",
        (_, "ksplat") => "a `.ksplat` file",
        (_, "spz") => "an SPZ file",
        ([b'{' | b'[', ..], _) => "a JSON file",
        _ => {
            let message = format!("not a PLY file: it starts with {:?}, expected `ply`", preview(bytes));
            return Error::format(path, message, "models are 3DGS PLY files, usually `point_cloud.ply`");
        }
    };
    Error::unsupported(
        path,
        format!(
            "this is {other}, expected a PLY file; models are read from PLY, compressed PLY, `.splat` and SPZ files"
        ),
        "convert it to one of them first",
    )
}

fn preview(bytes: &[u8]) -> String {
    String::from_utf8_lossy(&bytes[..bytes.len().min(8)]).into_owned()
}
