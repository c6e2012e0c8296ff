//! Images as host data: packed 8-bit RGB for what is stored, `f32` for what is computed.

pub mod area;

use crate::color::{from_u8, to_u8};
use crate::error::{Error, Result};
use rayon::prelude::*;

/// Packed 8-bit RGB, sRGB-encoded, row 0 on top; `data` is `[height, width, 3]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RgbImage8 {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// `[height, width, 3]`.
    pub data: Vec<u8>,
}

impl RgbImage8 {
    /// An image of one colour.
    pub fn filled(width: u32, height: u32, color: [u8; 3]) -> Self {
        Self { width, height, data: color.repeat(num_pixels(width, height)) }
    }

    /// Number of pixels.
    pub fn num_pixels(&self) -> usize {
        num_pixels(self.width, self.height)
    }

    /// The pixel in column `x` of row `y`.
    ///
    /// # Panics
    /// When (x, y) is outside the image.
    pub fn pixel(&self, x: u32, y: u32) -> [u8; 3] {
        assert!(x < self.width && y < self.height, "pixel ({x}, {y}) of a {} × {} image", self.width, self.height);
        let i = 3 * (y as usize * self.width as usize + x as usize);
        [self.data[i], self.data[i + 1], self.data[i + 2]]
    }

    /// Checks that there is at least one pixel and that `data` has the declared size.
    ///
    /// # Errors
    /// [`Error::Parameter`] otherwise.
    pub fn validate(&self) -> Result<()> {
        validate(self.width, self.height, self.data.len())
    }

    /// The image at another size, each output pixel the mean over the area it covers; unchanged at the same size.
    ///
    /// # Panics
    /// When the new size is zero or the image is not valid, see [`Self::validate`].
    pub fn resized_area(&self, width: u32, height: u32) -> Self {
        if (width, height) == (self.width, self.height) {
            return self.clone();
        }
        let data = area::resize_rgb(&self.data, [self.width, self.height], [width, height]);
        Self { width, height, data }
    }

    /// The levels as values in 0..1.
    pub fn to_f32(&self) -> ImageF32 {
        ImageF32 { width: self.width, height: self.height, data: self.data.par_iter().map(|&v| from_u8(v)).collect() }
    }
}

/// RGB in `f32`, sRGB-encoded unless a name says otherwise, nominally 0..1, row 0 on top; `data` is `[height, width, 3]`.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageF32 {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// `[height, width, 3]`.
    pub data: Vec<f32>,
}

impl ImageF32 {
    /// An image of one colour.
    pub fn filled(width: u32, height: u32, color: [f32; 3]) -> Self {
        Self { width, height, data: color.repeat(num_pixels(width, height)) }
    }

    /// Number of pixels.
    pub fn num_pixels(&self) -> usize {
        num_pixels(self.width, self.height)
    }

    /// Checks that there is at least one pixel and that `data` has the declared size.
    ///
    /// # Errors
    /// [`Error::Parameter`] otherwise.
    pub fn validate(&self) -> Result<()> {
        validate(self.width, self.height, self.data.len())
    }

    /// Nearest 8-bit levels: clamped to 0..1, halves rounded up, NaN is 0.
    pub fn to_rgb8(&self) -> RgbImage8 {
        RgbImage8 { width: self.width, height: self.height, data: self.data.par_iter().map(|&v| to_u8(v)).collect() }
    }
}

fn num_pixels(width: u32, height: u32) -> usize {
    width as usize * height as usize
}

fn validate(width: u32, height: u32, num_values: usize) -> Result<()> {
    let expected = 3 * num_pixels(width, height);
    if expected == 0 || num_values != expected {
        return Err(Error::parameter(
            "image",
            format!(
                "{width} × {height} pixels of RGB have {expected} values, found {num_values}; at least one pixel is expected"
            ),
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_survive_the_way_through_f32() {
        let image = RgbImage8 { width: 16, height: 16, data: (0..768).map(|i| (i % 256) as u8).collect() };
        assert_eq!(image.to_f32().to_rgb8(), image);
        assert_eq!(image.pixel(1, 1), [51, 52, 53]);
    }

    #[test]
    fn declared_and_real_size_are_compared() {
        assert!(RgbImage8::filled(2, 3, [1, 2, 3]).validate().is_ok());
        assert!(RgbImage8 { width: 2, height: 2, data: vec![0; 11] }.validate().is_err());
        assert!(ImageF32 { width: 0, height: 2, data: vec![] }.validate().is_err());
    }
}
