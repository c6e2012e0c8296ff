//! Draws one view with and without the table of just-noticeable differences, and says what was saved and what it cost.
//!
//! ```sh
//! cargo run --release --example 05_termination_lut -- model.ply
//! ```

use gazesplat_core::color::{ciede2000::delta_e, lab::lab_from_srgb};
use gazesplat_core::{Camera, Pinhole, io};
use gazesplat_fovea::termination_lut::LutSpec;
use gazesplat_render::{RenderOptions, Splats, StatsMode, Termination, cpu_device, render};
use glam::{DVec3, Mat4, Vec3};
use std::error::Error;

fn main() -> Result<(), Box<dyn Error>> {
    let model = std::env::args().nth(1).ok_or("usage: 05_termination_lut MODEL.ply")?;
    let cloud = io::ply::load(&model)?;
    let camera = front_view(&cloud.means);
    let splats = Splats::from_cloud(&cloud, &cpu_device())?;

    // `strict`: what a pixel leaves out differs from the whole by at most one unit of ΔE₀₀.
    let table = LutSpec::strict().build()?;
    let draw = |termination| -> Result<_, Box<dyn Error>> {
        let options = RenderOptions { termination, stats: StatsMode::All, ..RenderOptions::default() };
        let frame = render(&splats, &camera, &options)?;
        Ok((frame.image.into_data().try_to_vec::<f32>()?, frame.stats.num_blended))
    };
    let (full, all) = draw(Termination::Fixed(0.0))?;
    let (image, blended) = draw(Termination::Lut(table))?;

    let lab = |pixel: &[f32]| {
        lab_from_srgb(DVec3::new(pixel[0].into(), pixel[1].into(), pixel[2].into()).clamp(DVec3::ZERO, DVec3::ONE))
    };
    let pixels = full.chunks_exact(4).zip(image.chunks_exact(4));
    let worst = pixels.map(|(a, b)| delta_e(lab(a), lab(b))).max_by(f64::total_cmp).unwrap_or(0.0);
    println!("{:.1} % of the blends, largest ΔE₀₀ {worst:.3}", 100.0 * blended as f64 / all.max(1) as f64);
    Ok(())
}

/// A camera that looks at the middle of the means along +z, from where half of them fill the view.
fn front_view(means: &[[f32; 3]]) -> Camera {
    let median = |mut values: Vec<f32>| {
        values.sort_by(f32::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    };
    let center = Vec3::from_array(std::array::from_fn(|axis| median(means.iter().map(|m| m[axis]).collect())));
    let radius = median(means.iter().map(|m| center.distance(Vec3::from(*m))).collect()).max(1e-3);
    let pinhole = Pinhole::from_fov_x(640, 480, 60_f32.to_radians());
    Camera { camera_from_world: Mat4::from_translation(2.0 * radius * Vec3::Z - center), intrinsics: pinhole }
}
