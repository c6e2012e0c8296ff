//! The two containers: one gzip stream (versions 2 and 3), or a plain header, a table of contents and one zstd frame per
//! stream (version 4).
//!
//! A header may promise anything: buffers grow with what is decompressed, never beyond what the header says, and a header
//! that says more than a compressor can have packed into the file is refused at once.

use super::axes::Axes;
use super::{FLAG_EXTENSIONS, Header, MAGIC};
use crate::error::{Error, Result};
use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use rayon::prelude::*;
use ruzstd::decoding::StreamingDecoder;
use ruzstd::encoding::{CompressionLevel, compress_to_vec};
use std::io::{self, Read, Write};
use std::path::Path;

/// Bytes of the header in a gzip stream.
const GZIP_HEADER_BYTES: usize = 16;
/// Bytes of the plain header of version 4.
const ZSTD_HEADER_BYTES: usize = 32;
/// Bytes of an entry of the table of contents: compressed and uncompressed size.
const TOC_ENTRY_BYTES: usize = 16;
/// Most bytes that one byte of a file can stand for: what gzip reaches at most (1032), and the limit that the reference
/// reader of version 4 sets, as zstd has none.
const MAX_RATIO: u64 = 1032;
/// The extension that names the axes of the file.
const AXES_EXTENSION: u32 = 0xadbe_0003;

const DAMAGED: &str = "the file is truncated or damaged: copy or export it again";

/// What a container holds: the header, the streams, the axes if the file names some.
pub(super) type Content = (Header, [Vec<u8>; 6], Option<Axes>);

/// Reads a gzip container.
pub(super) fn read_gzip(path: &Path, bytes: &[u8], notes: &mut Vec<String>) -> Result<Content> {
    let mut reader = GzDecoder::new(bytes);
    let mut head = [0; GZIP_HEADER_BYTES];
    reader.read_exact(&mut head).map_err(|error| {
        let message = format!("not a gzip stream with an SPZ header: {error}");
        Error::format(
            path,
            message,
            "SPZ files of versions 2 and 3 are gzip streams; this one is damaged or no SPZ file",
        )
    })?;
    let header = Header::parse(path, &head)?;
    if !(2..=3).contains(&header.version) {
        return Err(unknown_version(path, header.version, "2 and 3 in a gzip stream"));
    }
    check_ratio(path, &header, bytes.len())?;
    let mut streams: [Vec<u8>; 6] = Default::default();
    for ((stream, expected), name) in streams.iter_mut().zip(header.stream_bytes()).zip(STREAMS) {
        read_stream(path, &mut reader, expected, name, stream)?;
    }
    // The checksum stands at the end, behind records of extensions if there are any.
    let mut rest = Vec::new();
    (&mut reader).take(1 << 20).read_to_end(&mut rest).map_err(|error| broken(path, "end", &error))?;
    let mut axes = None;
    if header.flags & FLAG_EXTENSIONS != 0 {
        axes = read_extensions(path, &rest, notes)?;
    } else if !rest.is_empty() {
        notes.push(format!("{} bytes after the last stream were passed over", rest.len()));
    }
    Ok((header, streams, axes))
}

/// Reads a container of version 4.
pub(super) fn read_zstd(path: &Path, bytes: &[u8], notes: &mut Vec<String>) -> Result<Content> {
    let Some(head) = bytes.get(..ZSTD_HEADER_BYTES) else {
        let message = format!("truncated: found {} bytes, expected a header of {ZSTD_HEADER_BYTES}", bytes.len());
        return Err(Error::format(path, message, DAMAGED));
    };
    let mut common = [0; 16];
    common.copy_from_slice(&head[..16]);
    let header = Header::parse(path, &common)?;
    if header.version != 4 {
        return Err(unknown_version(path, header.version, "4 with a plain header"));
    }
    check_ratio(path, &header, bytes.len())?;
    let expected = header.stream_bytes();
    let (num_streams, num_used) = (usize::from(head[15]), if header.sh_degree == 0 { 5 } else { 6 });
    // Some writers list the empty stream of degree 0.
    if num_streams != num_used && num_streams != expected.len() {
        let message = format!("found {num_streams} streams, expected {num_used}");
        return Err(Error::format(path, message, DAMAGED));
    }
    let toc_start = u32::from_le_bytes([head[16], head[17], head[18], head[19]]) as usize;
    let toc = toc_start.checked_add(num_streams * TOC_ENTRY_BYTES).and_then(|end| bytes.get(toc_start..end));
    let Some(toc) = toc.filter(|_| toc_start >= ZSTD_HEADER_BYTES) else {
        let message = format!("the table of contents at byte {toc_start} is not within the {} bytes", bytes.len());
        return Err(Error::format(path, message, DAMAGED));
    };
    let mut axes = None;
    if header.flags & FLAG_EXTENSIONS != 0 {
        axes = read_extensions(path, &bytes[ZSTD_HEADER_BYTES..toc_start], notes)?;
    }
    let mut rest = &bytes[toc_start + toc.len()..];
    let mut frames = Vec::with_capacity(num_streams);
    for ((entry, expected), name) in toc.chunks_exact(TOC_ENTRY_BYTES).zip(expected).zip(STREAMS) {
        let number = |at: usize| u64::from_le_bytes(std::array::from_fn(|i| entry[at + i]));
        let (compressed, uncompressed) = (number(0), number(8));
        if uncompressed != expected {
            let message = format!("the stream of {name} declares {uncompressed} bytes, expected {expected}");
            return Err(Error::format(path, message, DAMAGED));
        }
        let frame = usize::try_from(compressed).ok().and_then(|size| rest.split_at_checked(size));
        let Some((frame, after)) = frame else {
            let message = format!("truncated: the stream of {name} has {compressed} bytes, {} are left", rest.len());
            return Err(Error::format(path, message, DAMAGED));
        };
        frames.push((frame, expected, name));
        rest = after;
    }
    if !rest.is_empty() {
        notes.push(format!("{} bytes after the last stream were passed over", rest.len()));
    }
    let decoded: Vec<Result<Vec<u8>>> = frames
        .into_par_iter()
        .map(|(frame, expected, name)| {
            let mut stream = Vec::new();
            if expected > 0 {
                let mut decoder = StreamingDecoder::new(frame).map_err(|error| broken(path, name, &error))?;
                read_stream(path, &mut decoder, expected, name, &mut stream)?;
                expect_end(path, &mut decoder, expected, name)?;
            }
            Ok(stream)
        })
        .collect();
    let mut streams: [Vec<u8>; 6] = Default::default();
    for (stream, decoded) in streams.iter_mut().zip(decoded) {
        *stream = decoded?;
    }
    Ok((header, streams, axes))
}

/// Names of the streams in the order of the file.
const STREAMS: [&str; 6] = ["positions", "alphas", "colours", "scales", "rotations", "spherical harmonics"];

/// Appends exactly `expected` bytes to `stream`, whose buffer grows with them.
fn read_stream(path: &Path, reader: &mut impl Read, expected: u64, name: &str, stream: &mut Vec<u8>) -> Result<()> {
    let num_read = reader.take(expected).read_to_end(stream).map_err(|error| broken(path, name, &error))? as u64;
    if num_read < expected {
        let message = format!("truncated: found {num_read} of {expected} bytes of {name}");
        return Err(Error::format(path, message, DAMAGED));
    }
    Ok(())
}

fn expect_end(path: &Path, reader: &mut impl Read, expected: u64, name: &str) -> Result<()> {
    match reader.read(&mut [0]).map_err(|error| broken(path, name, &error))? {
        0 => Ok(()),
        _ => Err(Error::format(path, format!("the stream of {name} holds more than {expected} bytes"), DAMAGED)),
    }
}

fn broken(path: &Path, name: &str, error: &dyn std::error::Error) -> Error {
    Error::format(path, format!("the stream of {name} does not decompress: {error}"), DAMAGED)
}

fn check_ratio(path: &Path, header: &Header, num_bytes: usize) -> Result<()> {
    let expected: u64 = header.stream_bytes().iter().sum();
    if expected <= num_bytes as u64 * MAX_RATIO {
        return Ok(());
    }
    let message = format!(
        "the header declares {} Gaussians of SH degree {}, {expected} bytes; a file of {num_bytes} bytes holds at most {}",
        header.num_points,
        header.sh_degree,
        num_bytes as u64 * MAX_RATIO
    );
    Err(Error::format(path, message, DAMAGED))
}

fn unknown_version(path: &Path, version: u32, expected: &str) -> Error {
    Error::unsupported(path, format!("SPZ version {version}; versions {expected} are read"), "export the model again")
}

/// Walks the records type, length, content. Of those known to be in use only the one that names the axes changes a model.
fn read_extensions(path: &Path, mut bytes: &[u8], notes: &mut Vec<String>) -> Result<Option<Axes>> {
    let mut axes = None;
    while !bytes.is_empty() {
        let word = |at: usize| Some(u32::from_le_bytes(*bytes.get(at..at + 4)?.first_chunk()?));
        let record = word(0).zip(word(4)).and_then(|(kind, length)| {
            let content = bytes.get(8..8_usize.checked_add(length as usize)?)?;
            Some((kind, content))
        });
        let Some((kind, content)) = record else {
            return Err(Error::format(path, "a record of an extension is longer than the file", DAMAGED));
        };
        match (kind, content) {
            (AXES_EXTENSION, &[a, b, c, d]) => {
                let number = u32::from_le_bytes([a, b, c, d]);
                axes = match number {
                    0 => None,
                    _ => Some(Axes::of_number(number).ok_or_else(|| {
                        let message = format!("the model is stored in the coordinate system {number}; 1 to 8 are read");
                        Error::unsupported(path, message, "export the model in the axes right, up, back")
                    })?),
                };
            }
            _ => notes.push(format!("an extension of type {kind:#010x} ({} bytes) was passed over", content.len())),
        }
        bytes = &bytes[8 + content.len()..];
    }
    Ok(axes)
}

fn common_header(header: &Header, last: u8) -> [u8; 16] {
    let mut bytes = [0; 16];
    bytes[..4].copy_from_slice(MAGIC);
    bytes[4..8].copy_from_slice(&header.version.to_le_bytes());
    bytes[8..12].copy_from_slice(&(header.num_points as u32).to_le_bytes());
    bytes[12..].copy_from_slice(&[header.sh_degree as u8, header.fractional_bits as u8, header.flags, last]);
    bytes
}

/// Writes a gzip container.
pub(super) fn write_gzip(out: &mut impl Write, header: &Header, streams: &[Vec<u8>; 6]) -> io::Result<()> {
    let mut encoder = GzEncoder::new(out, Compression::default());
    encoder.write_all(&common_header(header, 0))?;
    for stream in streams {
        encoder.write_all(stream)?;
    }
    encoder.finish().map(|_| ())
}

/// Writes a container of version 4.
pub(super) fn write_zstd(out: &mut impl Write, header: &Header, streams: &[Vec<u8>; 6]) -> io::Result<()> {
    let num_streams = if header.sh_degree == 0 { 5 } else { 6 };
    let used = &streams[..num_streams];
    let frames: Vec<Vec<u8>> =
        used.par_iter().map(|stream| compress_to_vec(stream.as_slice(), CompressionLevel::Fastest)).collect();
    out.write_all(&common_header(header, num_streams as u8))?;
    out.write_all(&(ZSTD_HEADER_BYTES as u32).to_le_bytes())?;
    out.write_all(&[0; 12])?;
    for (frame, stream) in frames.iter().zip(used) {
        out.write_all(&(frame.len() as u64).to_le_bytes())?;
        out.write_all(&(stream.len() as u64).to_le_bytes())?;
    }
    frames.iter().try_for_each(|frame| out.write_all(frame))
}
