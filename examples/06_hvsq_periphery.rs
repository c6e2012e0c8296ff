//! Two pictures of the same PSNR that an eye tells apart: what HVSQ is for. Makes `docs/hvsq.jpg`.
//!
//! Somebody looks at the centre of a procedural room. In the first picture, every pixel beyond 10 degrees is exchanged for
//! one nearby, as near as the eye still averages there; the second has noise there, of exactly the strength that gives the
//! same PSNR. The eye finds the same statistics in the first, and new texture in the second. Below each, where HVSQ sees a
//! difference: on one scale, the brighter the more.
//!
//! ```sh
//! cargo run --release --example 06_hvsq_periphery -- docs/hvsq.jpg
//! ```

use gazesplat::report::pictures::heat;
use gazesplat_core::synthetic::{SynthOptions, write_scene};
use gazesplat_core::{Gaze, PixelGrid, RgbImage8};
use gazesplat_fovea::Hvsq;
use gazesplat_fovea::hvs::pooling::{GazePooling, Pooling};
use gazesplat_fovea::hvsq::{Distance, ImageView};
use gazesplat_train::losses::LossTarget;
use gazesplat_train::metrics::psnr;
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use std::error::Error;
use std::fs::File;
use std::path::PathBuf;
use std::sync::Arc;

/// Nearer to the gaze than this nothing is changed, degrees.
const UNCHANGED_DEG: f64 = 10.0;

/// Pixels are exchanged for others at most this many pooling sizes away: inside the pool around them.
const REACH: f64 = 0.5;

fn main() -> Result<(), Box<dyn Error>> {
    let out = PathBuf::from(std::env::args().nth(1).ok_or("usage: 06_hvsq_periphery OUT.jpg")?);
    let dir = std::env::temp_dir().join(format!("gazesplat-hvsq-periphery-{}", std::process::id()));
    let options = SynthOptions { num_views: 9, width: 480, height: 320, num_points: 100, ..SynthOptions::default() };
    let dataset = write_scene(&dir, &options)?;
    let photo = gazesplat_core::io::images::load_view_image(&dataset.train[2])?;
    std::fs::remove_dir_all(&dir)?;
    let pooling = GazePooling { gaze: Gaze::CENTRE, ..GazePooling::default() };
    let target = LossTarget::new(Arc::new(photo), [0.0; 3]);

    let exchanged = exchanged(&target, &pooling);
    let wanted = psnr(&exchanged.to_f32(), &target);
    let noisy = noisy(&target, &pooling, wanted);

    let hvsq = Hvsq::new(Pooling::Gaze(pooling), Distance::Mse)?;
    let reference = hvsq.reference(view(&target.photo().image.to_f32().data, &target))?;
    let mut panels = Vec::new();
    for (name, image) in [("exchanged", &exchanged), ("noisy", &noisy)] {
        let (value, map) = reference.value_and_map(view(&image.to_f32().data, &target))?;
        println!("{name}: {:.2} dB PSNR, HVSQ {value:.3e}", psnr(&image.to_f32(), &target));
        panels.push((image, map));
    }
    let largest = panels.iter().flat_map(|(_, map)| map).fold(0.0f32, |a, v| a.max(*v));
    let heats: Vec<RgbImage8> = panels
        .iter()
        .map(|(image, map)| {
            let data = map.iter().flat_map(|v| heat((v / largest).sqrt())).collect();
            RgbImage8 { width: image.width, height: image.height, data }
        })
        .collect();
    let sheet = beside([panels[0].0, panels[1].0], [&heats[0], &heats[1]]);
    JpegEncoder::new_with_quality(File::create(&out)?, 80).encode(
        &sheet.data,
        sheet.width,
        sheet.height,
        ExtendedColorType::Rgb8,
    )?;
    println!("wrote {}", out.display());
    Ok(())
}

fn view<'a>(data: &'a [f32], target: &LossTarget) -> ImageView<'a, f32> {
    let (width, height) = target.size();
    ImageView { width, height, channels: 3, data }
}

/// A number in −1..1 that pixel `i` and `stream` decide.
fn noise(i: usize, stream: u32) -> f64 {
    let mut word = (i as u32).wrapping_mul(0x9e37_79b9) ^ stream.wrapping_mul(0x85eb_ca6b);
    for _ in 0..2 {
        word = (word ^ (word >> 16)).wrapping_mul(0x7feb_352d);
        word = (word ^ (word >> 15)).wrapping_mul(0x846c_a68b);
    }
    f64::from(word ^ (word >> 16)) / f64::from(u32::MAX) * 2.0 - 1.0
}

/// The size of the pool around pixel `i`; `None` near the gaze.
fn pool_px(pooling: &GazePooling, size: (usize, usize), i: usize) -> Option<f64> {
    let (column, row) = (i % size.0, i / size.0);
    let (x, y) = (PixelGrid::Centres.place(column, size.0), PixelGrid::Centres.place(row, size.1));
    let e = pooling.display.eccentricity_rad(size, pooling.gaze, x, y);
    (e.to_degrees() > UNCHANGED_DEG).then(|| pooling.pooling_px(size, column, row))
}

/// The photograph with pixels exchanged for others in their pools.
fn exchanged(target: &LossTarget, pooling: &GazePooling) -> RgbImage8 {
    let size = target.size();
    let mut image = target.photo().image.clone();
    for i in 0..size.0 * size.1 {
        let Some(pool) = pool_px(pooling, size, i) else { continue };
        let moved = |place: usize, stream: u32, n: usize| {
            (place as f64 + noise(i, stream) * REACH * pool).round().clamp(0.0, n as f64 - 1.0) as usize
        };
        let from = moved(i / size.0, 1, size.1) * size.0 + moved(i % size.0, 2, size.0);
        image.data[3 * i..][..3].copy_from_slice(&target.rgb()[3 * from..][..3]);
    }
    image
}

/// The photograph with as much noise in the same places as makes the PSNR `wanted`.
fn noisy(target: &LossTarget, pooling: &GazePooling, wanted: f64) -> RgbImage8 {
    let size = target.size();
    let with = |strength: f64| {
        let mut image = target.photo().image.clone();
        for i in (0..size.0 * size.1).filter(|i| pool_px(pooling, size, *i).is_some()) {
            for (c, v) in image.data[3 * i..][..3].iter_mut().enumerate() {
                *v = (f64::from(*v) + strength * noise(i, 3 + c as u32)).round().clamp(0.0, 255.0) as u8;
            }
        }
        image
    };
    let (mut weak, mut strong) = (0.0, 255.0);
    for _ in 0..30 {
        let middle = 0.5 * (weak + strong);
        if psnr(&with(middle).to_f32(), target) > wanted { weak = middle } else { strong = middle }
    }
    with(weak)
}

/// Four pictures of one size on one sheet.
fn beside(upper: [&RgbImage8; 2], lower: [&RgbImage8; 2]) -> RgbImage8 {
    let (width, height) = (upper[0].width, upper[0].height);
    let row = |image: &RgbImage8, y: u32| image.data[(3 * y * width) as usize..][..3 * width as usize].to_vec();
    let rows = [upper, lower].into_iter().flat_map(|[a, b]| (0..height).map(move |y| (a, b, y)));
    let data = rows.flat_map(|(a, b, y)| [row(a, y), row(b, y)].concat()).collect();
    RgbImage8 { width: 2 * width, height: 2 * height, data }
}
