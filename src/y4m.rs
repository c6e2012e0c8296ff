//! Raw video that every player and encoder reads: YUV4MPEG2, 4:4:4, BT.709 limited range.
//!
//! 4:4:4 keeps every pixel's colour, so any size works and nothing is blurred before the encoder has its say. Frames are
//! sRGB-encoded; players treat BT.709 video alike, so values pass through the matrix without a change of transfer curve.

use gazesplat_core::RgbImage8;
use std::io::{self, Write};

/// Writes the stream header for frames of `width` × `height` at `fps` frames per second.
///
/// # Errors
/// When `out` refuses.
pub fn write_header(out: &mut impl Write, width: u32, height: u32, fps: f32) -> io::Result<()> {
    // Whole rates stay whole; others, such as 29.97, are told in thousandths.
    let (rate, per) = if fps.fract() == 0.0 { (fps, 1) } else { ((fps * 1000.0).round(), 1000) };
    // C444 names the sampling, XCOLORRANGE is FFmpeg's extension; the matrix has no field and is BT.709 by convention.
    writeln!(out, "YUV4MPEG2 W{width} H{height} F{rate}:{per} Ip A1:1 C444 XCOLORRANGE=LIMITED")
}

/// Appends one frame; `image` has the size that the header named.
///
/// # Errors
/// When `out` refuses.
pub fn write_frame(out: &mut impl Write, image: &RgbImage8) -> io::Result<()> {
    let num_pixels = image.data.len() / 3;
    let mut planes = vec![0_u8; 3 * num_pixels];
    let (y_plane, chroma) = planes.split_at_mut(num_pixels);
    let (cb_plane, cr_plane) = chroma.split_at_mut(num_pixels);
    for (i, rgb) in image.data.as_chunks::<3>().0.iter().enumerate() {
        [y_plane[i], cb_plane[i], cr_plane[i]] = ycbcr_from_rgb(*rgb);
    }
    out.write_all(b"FRAME\n")?;
    out.write_all(&planes)
}

/// 8-bit limited-range Y'CbCr of one R'G'B' pixel (Rec. ITU-R BT.709-6, items 3.2 to 3.4 and 4.6).
fn ycbcr_from_rgb(rgb: [u8; 3]) -> [u8; 3] {
    const KR: f32 = 0.2126;
    const KB: f32 = 0.0722;
    let [r, g, b] = rgb.map(|c| f32::from(c) / 255.0);
    let y = KR * r + (1.0 - KR - KB) * g + KB * b;
    let cb = (b - y) / (2.0 * (1.0 - KB));
    let cr = (r - y) / (2.0 * (1.0 - KR));
    [16.0 + 219.0 * y, 128.0 + 224.0 * cb, 128.0 + 224.0 * cr].map(|v| (v + 0.5) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn primaries_land_on_the_bt709_code_values() {
        assert_eq!(ycbcr_from_rgb([0, 0, 0]), [16, 128, 128]);
        assert_eq!(ycbcr_from_rgb([255, 255, 255]), [235, 128, 128]);
        assert_eq!(ycbcr_from_rgb([255, 0, 0]), [63, 102, 240]);
        assert_eq!(ycbcr_from_rgb([0, 255, 0]), [173, 42, 26]);
        assert_eq!(ycbcr_from_rgb([0, 0, 255]), [32, 240, 118]);
    }

    #[test]
    fn stream_is_header_and_planar_frames() {
        let image = RgbImage8 { width: 2, height: 1, data: vec![0, 0, 0, 255, 255, 255] };
        let mut out = Vec::new();
        write_header(&mut out, 2, 1, 30.0).expect("memory");
        write_frame(&mut out, &image).expect("memory");
        let (head, body) = out.split_at(out.len() - 12);
        assert_eq!(head, b"YUV4MPEG2 W2 H1 F30:1 Ip A1:1 C444 XCOLORRANGE=LIMITED\n");
        assert_eq!(body, b"FRAME\n\x10\xeb\x80\x80\x80\x80");
    }
}
