//! Draws a 3D Gaussian model from a circle of cameras around its middle.
//!
//! ```sh
//! cargo run --release --example 01_render_ply -- model.ply frames
//! ```

use gazesplat_core::camera::path::CameraPath;
use gazesplat_core::{ImageF32, Pinhole, io};
use gazesplat_render::{RenderOptions, Splats, cpu_device, render};
use glam::Vec3;
use std::error::Error;
use std::path::Path;

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let (Some(model), Some(out)) = (args.next(), args.next()) else {
        return Err("usage: 01_render_ply MODEL.ply OUT_DIR".into());
    };
    let cloud = io::ply::load(&model)?;

    // The median is a robust middle: a few Gaussians of the far background would pull a mean away.
    let median = |axis: usize| {
        let mut along: Vec<f32> = cloud.means.iter().map(|mean| mean[axis]).collect();
        along.sort_by(f32::total_cmp);
        along.get(along.len() / 2).copied().unwrap_or(0.0)
    };
    let center = Vec3::new(median(0), median(1), median(2));
    let mut distances: Vec<f32> = cloud.means.iter().map(|mean| center.distance(Vec3::from(*mean))).collect();
    distances.sort_by(f32::total_cmp);
    let radius = 2.0 * distances.get(distances.len() / 2).copied().unwrap_or(1.0);

    // COLMAP worlds usually have +y pointing down.
    let pinhole = Pinhole::from_fov_x(640, 480, 60_f32.to_radians());
    let path = CameraPath::orbit(pinhole, center, -Vec3::Y, radius, 0.3 * radius, 12);

    let splats = Splats::from_cloud(&cloud, &cpu_device())?;
    std::fs::create_dir_all(&out)?;
    for (name, camera) in &path.frames {
        let frame = render(&splats, camera, &RenderOptions::default())?;
        let values = frame.image.into_data().try_to_vec::<f32>()?;
        let rgb = values.chunks_exact(4).flat_map(|pixel| pixel[..3].to_vec()).collect();
        let image = ImageF32 { width: pinhole.width, height: pinhole.height, data: rgb };
        io::save_png(Path::new(&out).join(format!("{name}.png")), &image.to_rgb8())?;
        eprintln!("{name}: {} of {} Gaussians in view", frame.stats.num_visible, frame.stats.num_splats);
    }
    Ok(())
}
