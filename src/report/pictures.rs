//! Images for a page: small enough, encoded, and differences made visible.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use gazesplat_core::RgbImage8;
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;

/// Longer side of a picture in a report, pixels: two of them fit beside each other on a wide screen.
const MAX_SIDE: u32 = 960;

/// An absolute difference of this much, of 0..1, and more has the brightest colour of an error map.
pub const ERROR_SCALE: f32 = 0.25;

/// A JPEG as `data:` address; larger images are reduced to the page's size.
pub fn data_uri(image: &RgbImage8, quality: u8) -> String {
    let image = fitted(image, MAX_SIDE);
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, quality)
        .encode(&image.data, image.width, image.height, ExtendedColorType::Rgb8)
        .expect("an RGB image of at most 960 pixels a side encodes into memory");
    format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg))
}

/// The image with its longer side at most `max_side` pixels.
pub fn fitted(image: &RgbImage8, max_side: u32) -> RgbImage8 {
    let side = image.width.max(image.height);
    if side <= max_side {
        return image.clone();
    }
    let fit = |n: u32| (n * max_side / side).max(1);
    image.resized_area(fit(image.width), fit(image.height))
}

/// Mean absolute difference of the channels of each pixel, dark to bright over 0..[`ERROR_SCALE`].
pub fn error_map(a: &RgbImage8, b: &RgbImage8) -> RgbImage8 {
    let pixels = a.data.as_chunks::<3>().0.iter().zip(b.data.as_chunks::<3>().0);
    let data = pixels.flat_map(|(p, q)| {
        let sum: u32 = (0..3).map(|c| u32::from(p[c].abs_diff(q[c]))).sum();
        heat(sum as f32 / (3.0 * 255.0) / ERROR_SCALE)
    });
    RgbImage8 { width: a.width, height: a.height, data: data.collect() }
}

/// Black, violet, red, amber, pale yellow: rises evenly in lightness, so it reads in greyscale too.
pub fn heat(x: f32) -> [u8; 3] {
    const STOPS: [[f32; 3]; 5] =
        [[8.0, 8.0, 16.0], [84.0, 20.0, 110.0], [187.0, 55.0, 84.0], [249.0, 142.0, 9.0], [252.0, 255.0, 190.0]];
    let x = x.clamp(0.0, 1.0) * (STOPS.len() - 1) as f32;
    let i = (x as usize).min(STOPS.len() - 2);
    let t = x - i as f32;
    std::array::from_fn(|c| (STOPS[i][c] * (1.0 - t) + STOPS[i + 1][c] * t + 0.5) as u8)
}

/// The colours of an error map as a CSS gradient.
pub fn heat_gradient() -> String {
    let stops: Vec<String> =
        (0..=4).map(|i| heat(i as f32 / 4.0)).map(|[r, g, b]| format!("rgb({r} {g} {b})")).collect();
    format!("linear-gradient(90deg, {})", stops.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_images_have_a_dark_error_map() {
        let a = RgbImage8 { width: 1, height: 2, data: vec![9, 8, 7, 200, 100, 0] };
        assert_eq!(error_map(&a, &a).data, [heat(0.0), heat(0.0)].concat());
        let b = RgbImage8 { data: vec![255; 6], ..a.clone() };
        assert_eq!(error_map(&a, &b).data[..3], heat(1.0));
    }

    #[test]
    fn large_images_are_reduced() {
        let image = RgbImage8 { width: 2000, height: 1000, data: vec![128; 6_000_000] };
        assert_eq!((fitted(&image, 960).width, fitted(&image, 960).height), (960, 480));
        assert!(data_uri(&image, 80).starts_with("data:image/jpeg;base64,/9j/"));
    }
}
