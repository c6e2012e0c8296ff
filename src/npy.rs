//! Depth maps as NumPy files: `float32`, exact, read by every numerical program and by nerfstudio as `depth_file_path`.
//!
//! Format: NEP 1 of NumPy, version 1.0: a magic, a header that is a Python literal padded to 64 bytes, the values in C order.

use std::io::{self, Write};

/// Alignment of the values.
const ALIGNMENT: usize = 64;

/// Writes `values`, `[height, width]`, as an array of little-endian `float32`.
///
/// # Errors
/// When `out` refuses.
pub fn write_f32(out: &mut impl Write, values: &[f32], height: usize, width: usize) -> io::Result<()> {
    let mut header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({height}, {width}), }}");
    // Magic, version and length are ten bytes; a newline ends the header.
    let padding = ALIGNMENT - (10 + header.len() + 1) % ALIGNMENT;
    header.extend(std::iter::repeat_n(' ', padding % ALIGNMENT));
    header.push('\n');
    out.write_all(b"\x93NUMPY\x01\x00")?;
    out.write_all(&(header.len() as u16).to_le_bytes())?;
    out.write_all(header.as_bytes())?;
    let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
    out.write_all(&bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn header_is_padded_and_values_follow_in_rows() {
        for (height, width) in [(1, 1), (2, 3), (1080, 1920), (0, 7)] {
            let values: Vec<f32> = (0..height * width).map(|i| i as f32 - 1.5).collect();
            let mut file = Vec::new();
            write_f32(&mut file, &values, height, width).expect("memory does not refuse");
            assert_eq!(file[..8], *b"\x93NUMPY\x01\x00");
            let len = usize::from(u16::from_le_bytes([file[8], file[9]]));
            assert_eq!((10 + len) % ALIGNMENT, 0);
            let header = std::str::from_utf8(&file[10..10 + len]).expect("ASCII");
            assert!(
                header.starts_with("{'descr': '<f4', 'fortran_order': False, 'shape': (") && header.ends_with('\n')
            );
            assert!(header.contains(&format!("({height}, {width})")));
            let read: Vec<f32> =
                file[10 + len..].chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
            assert_eq!(read, values);
        }
    }
}
