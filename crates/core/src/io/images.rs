//! Photographs: decoding, removing lens distortion, fitting to the size of their view.

pub use super::image_cache::{CacheStats, ImageCache};
use super::jpeg;
use super::locate::{MAX_SIDE, same_aspect};
use crate::color::{from_u8, to_u8};
use crate::error::{Error, Result};
use crate::image::{RgbImage8, area};
use crate::view::View;
use ::image::metadata::Orientation;
use ::image::{DynamicImage, ImageDecoder, ImageError, ImageFormat, ImageReader, Limits};
use std::fs::File;
use std::io::{BufRead, BufReader, Cursor, ErrorKind, Seek};
use std::path::Path;

/// Bytes one decoded image may take: 2 GiB, the largest 16-bit RGBA photograph of 16384 × 16384 pixels. Files that
/// declare more are damaged, and are refused before memory is asked for.
const MAX_DECODED_BYTES: u64 = 1 << 31;

/// The photograph of a view as training sees it, at the size of the view's camera.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TrainingImage {
    /// Straight (not premultiplied) RGB, sRGB-encoded.
    pub image: RgbImage8,
    /// Alpha `[h, w]`, 255 = opaque; `None` when the photograph is opaque everywhere.
    pub alpha: Option<Vec<u8>>,
    /// `[h, w]`: 0 where the pixel carries no loss (mask of the photograph, blank after undistortion); `None` when every
    /// pixel counts.
    pub mask: Option<Vec<u8>>,
}

impl TrainingImage {
    /// The photograph over a background of sRGB-encoded `background`, 0..1: c·α + b·(1 − α).
    pub fn composited(&self, background: [f32; 3]) -> RgbImage8 {
        let mut image = self.image.clone();
        let Some(alpha) = &self.alpha else { return image };
        for (pixel, &alpha) in image.data.chunks_exact_mut(3).zip(alpha) {
            let a = from_u8(alpha);
            for (value, b) in pixel.iter_mut().zip(background) {
                *value = to_u8(from_u8(*value) * a + b * (1.0 - a));
            }
        }
        image
    }

    /// Bytes of pixel data held.
    pub fn num_bytes(&self) -> usize {
        self.image.data.len() + self.alpha.as_ref().map_or(0, Vec::len) + self.mask.as_ref().map_or(0, Vec::len)
    }

    /// Exact-area resampling of all parts; unchanged at the same size.
    pub(super) fn resized(self, width: u32, height: u32) -> Self {
        let (from, to) = ([self.image.width, self.image.height], [width, height]);
        if from == to {
            return self;
        }
        let (data, alpha) = match &self.alpha {
            Some(alpha) => {
                let (data, alpha) = area::resize_rgba(&self.image.data, alpha, from, to);
                (data, Some(alpha))
            }
            None => (area::resize_rgb(&self.image.data, from, to), None),
        };
        let mask = self.mask.map(|mask| area::resize_mask(&mask, from, to));
        Self { image: RgbImage8 { width, height, data }, alpha, mask }
    }
}

/// Size \[width, height\] in pixels from the header of the image file `path`; nothing is decoded.
///
/// # Errors
/// As [`decode_rgb`].
pub fn image_size(path: impl AsRef<Path>) -> Result<[u32; 2]> {
    let path = path.as_ref();
    let file = File::open(path).map_err(|source| Error::io("read", path, source))?;
    header_size(path, BufReader::new(file))
}

/// Decodes a JPEG or PNG (told by content, not by name) into 8-bit RGB: 16-bit values are rounded, grey is repeated,
/// alpha is dropped.
///
/// # Errors
/// [`Error::Io`] when the file cannot be read, [`Error::Format`] when it does not decode, [`Error::Unsupported`] for
/// other image formats.
pub fn decode_rgb(path: impl AsRef<Path>) -> Result<RgbImage8> {
    decode(path.as_ref(), |_| true).map(|decoded| decoded.image)
}

/// The photograph of `view` at the size of its camera: decoded, undistorted at its full size, then reduced by exact
/// area, its mask with it. It is taken as it is stored, as COLMAP takes it; where only the turn that its EXIF orientation
/// asks for makes it fit its camera, it is turned.
///
/// # Errors
/// As [`decode_rgb`], for the photograph and its mask; [`Error::Format`] when their sizes do not fit the view;
/// [`Error::Parameter`] when the view has no photograph.
pub fn load_view_image(view: &View) -> Result<TrainingImage> {
    let Some(path) = &view.image_path else {
        return Err(Error::parameter(&view.name, "the view has no photograph, it is a bare camera"));
    };
    let pinhole = &view.camera.intrinsics;
    let fits = |size: [u32; 2]| match &view.distortion {
        Some(lens) => size == [lens.width, lens.height],
        None => same_aspect(size, [pinhole.width, pinhole.height]),
    };
    let mut photo = decode(path, fits)?;
    let size = [photo.image.width, photo.image.height];
    photo.mask = match &view.mask_path {
        Some(mask_path) => decode_mask(mask_path, size)?,
        None => None,
    };
    if let Some(lens) = &view.distortion {
        if !fits(size) {
            return Err(size_mismatch(path, size, [lens.width, lens.height]));
        }
        let undistorted = lens.undistort_image(&photo.image, photo.alpha.as_deref(), photo.mask.as_deref());
        photo = TrainingImage { image: undistorted.image, alpha: undistorted.alpha, mask: undistorted.mask };
    } else if !fits(size) {
        return Err(size_mismatch(path, size, [pinhole.width, pinhole.height]));
    }
    Ok(photo.resized(pinhole.width, pinhole.height))
}

/// The image, turned as its EXIF orientation says if its size `fits` only then.
fn decode(path: &Path, fits: impl Fn([u32; 2]) -> bool) -> Result<TrainingImage> {
    let mut decoded = decode_any(path)?;
    if !fits([decoded.width(), decoded.height()]) && fits([decoded.height(), decoded.width()]) {
        let orientation = orientation(path)?;
        if swaps_sides(orientation) {
            decoded.apply_orientation(orientation);
        }
    }
    let (width, height) = (decoded.width(), decoded.height());
    if !decoded.color().has_alpha() {
        let image = RgbImage8 { width, height, data: decoded.into_rgb8().into_raw() };
        return Ok(TrainingImage { image, alpha: None, mask: None });
    }
    let rgba = decoded.into_rgba8().into_raw();
    let alpha: Vec<u8> = rgba.chunks_exact(4).map(|pixel| pixel[3]).collect();
    let data = rgba.chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
    let alpha = alpha.iter().any(|&a| a != 255).then_some(alpha);
    Ok(TrainingImage { image: RgbImage8 { width, height, data }, alpha, mask: None })
}

/// Mask `[h, w]` of a photograph of `size`: 0 or 255; `None` when it masks nothing. Masks of another size of the same
/// photograph are sampled at the nearest pixel.
fn decode_mask(path: &Path, size: [u32; 2]) -> Result<Option<Vec<u8>>> {
    let decoded = decode_any(path)?;
    let mask_size = [decoded.width(), decoded.height()];
    if !same_aspect(mask_size, size) {
        return Err(size_mismatch(path, mask_size, size));
    }
    let luma = decoded.into_luma8().into_raw();
    let [width, height] = size.map(|side| side as usize);
    let [mask_width, mask_height] = mask_size.map(|side| side as usize);
    let nearest = |i: usize, n: usize, num_mask: usize| (2 * i + 1) * num_mask / (2 * n);
    let mask: Vec<u8> = (0..height)
        .flat_map(|y| {
            let row = nearest(y, height, mask_height) * mask_width;
            (0..width).map(move |x| row + nearest(x, width, mask_width))
        })
        .map(|i| if luma[i] == 0 { 0 } else { 255 })
        .collect();
    Ok(mask.contains(&0).then_some(mask))
}

/// Size \[width, height\] of the image file `path` as its EXIF orientation shows it, if that is another than the stored one.
///
/// # Errors
/// As [`decode_rgb`].
pub(super) fn turned_size(path: &Path) -> Result<Option<[u32; 2]>> {
    let [width, height] = image_size(path)?;
    Ok(swaps_sides(orientation(path)?).then_some([height, width]))
}

fn orientation(path: &Path) -> Result<Orientation> {
    let file = File::open(path).map_err(|source| Error::io("read", path, source))?;
    let mut decoder = reader(path, BufReader::new(file))?.into_decoder().map_err(|error| image_error(path, error))?;
    decoder.orientation().map_err(|error| image_error(path, error))
}

fn swaps_sides(orientation: Orientation) -> bool {
    use Orientation::{Rotate90, Rotate90FlipH, Rotate270, Rotate270FlipH};
    matches!(orientation, Rotate90 | Rotate270 | Rotate90FlipH | Rotate270FlipH)
}

const REPLACE_HINT: &str = "replace the file by an intact JPEG or PNG";

/// The whole image in the pixel type of the file.
fn decode_any(path: &Path) -> Result<DynamicImage> {
    let bytes = std::fs::read(path).map_err(|source| Error::io("read", path, source))?;
    header_size(path, Cursor::new(&bytes))?;
    if bytes.starts_with(&jpeg::START) && !jpeg::is_complete(&bytes) {
        let message = format!("the image does not decode: the JPEG ends early, after {} bytes", bytes.len());
        return Err(Error::format(path, message, REPLACE_HINT));
    }
    reader(path, Cursor::new(&bytes))?.decode().map_err(|error| image_error(path, error))
}

fn header_size(path: &Path, source: impl BufRead + Seek) -> Result<[u32; 2]> {
    let (width, height) = reader(path, source)?.into_dimensions().map_err(|error| image_error(path, error))?;
    if width == 0 || height == 0 || width > MAX_SIDE || height > MAX_SIDE {
        return Err(Error::format(
            path,
            format!("the image declares {width} × {height} pixels, expected sides of 1 to {MAX_SIDE}"),
            REPLACE_HINT,
        ));
    }
    Ok([width, height])
}

/// A reader of the format the content tells, else the one the name tells.
fn reader<R: BufRead + Seek>(path: &Path, source: R) -> Result<ImageReader<R>> {
    let guessed = ImageReader::new(source).with_guessed_format();
    let mut reader = guessed.map_err(|source| Error::io("read", path, source))?;
    if let (None, Ok(format)) = (reader.format(), ImageFormat::from_path(path)) {
        reader.set_format(format);
    }
    let mut limits = Limits::default();
    limits.max_alloc = Some(MAX_DECODED_BYTES);
    reader.limits(limits);
    Ok(reader)
}

fn image_error(path: &Path, error: ImageError) -> Error {
    match error {
        ImageError::IoError(source)
            if !matches!(source.kind(), ErrorKind::UnexpectedEof | ErrorKind::InvalidData | ErrorKind::Other) =>
        {
            Error::io("read", path, source)
        }
        ImageError::Unsupported(reason) => {
            Error::unsupported(path, format!("{reason}; JPEG and PNG are supported"), "convert the image to PNG")
        }
        other => Error::format(path, format!("the image does not decode: {other}"), REPLACE_HINT),
    }
}

fn size_mismatch(path: &Path, found: [u32; 2], expected: [u32; 2]) -> Error {
    Error::format(
        path,
        format!("the image has {} × {} pixels, expected {} × {}", found[0], found[1], expected[0], expected[1]),
        "use images and masks of the size, or of a reduced size, of the photographs that were reconstructed",
    )
}
