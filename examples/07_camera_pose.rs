//! Finds where a picture of a known model was taken: descends along the gradient of the camera's pose until the render is
//! the picture.
//!
//! ```sh
//! cargo run --release --example 07_camera_pose
//! ```

use gazesplat_core::camera::se3;
use gazesplat_core::synthetic::{bench_camera, bench_cloud};
use gazesplat_render::{PoseProbe, Probes, RenderOptions, Splats, cpu_device, render, render_with};
use std::error::Error;

fn main() -> Result<(), Box<dyn Error>> {
    let truth = bench_camera(160, 160);
    let device = cpu_device().autodiff();
    let splats = Splats::from_cloud(&bench_cloud(20_000, 1), &device)?;
    let options = RenderOptions::train();
    let picture = render(&splats, &truth, &options)?.image;

    // Off by two degrees and some centimetres of a room of metres.
    let mut camera = truth.moved([0.02, -0.025, 0.015, 0.04, 0.03, -0.05]);
    let (mut first, mut second) = ([0.0; 6], [0.0; 6]);
    for step in 1..=200 {
        let probe = PoseProbe::new(&device);
        let image = render_with(&splats, Probes { pose: Some(&probe), ..Probes::default() }, &camera, &options)?.image;
        let loss = (image - picture.clone()).powi_scalar(2).mean();
        let gradient = probe.gradient(&loss.backward()).ok_or("nothing of the model is seen")?;
        let gradient = gradient.into_data().try_to_vec::<f32>()?;
        // Adam; the motion is a twist in the frame of the camera, and the next gradient one on top of it.
        let rate = 3e-3 * 0.98_f64.powi(step);
        let motion = std::array::from_fn(|k| {
            let g = f64::from(gradient[k]);
            first[k] = 0.9 * first[k] + 0.1 * g;
            second[k] = 0.99 * second[k] + 0.01 * g * g;
            let corrected = (first[k] / (1.0 - 0.9_f64.powi(step))) / (second[k] / (1.0 - 0.99_f64.powi(step))).sqrt();
            -rate * if corrected.is_finite() { corrected } else { 0.0 }
        });
        camera = camera.moved(motion);
        if step % 25 == 0 {
            let [a, b, c, ..] =
                se3::log(camera.camera_from_world.as_dmat4() * truth.camera_from_world.as_dmat4().inverse());
            let (turn, shift) = ((a * a + b * b + c * c).sqrt(), camera.position().distance(truth.position()));
            eprintln!("step {step}: off by {:.4} degrees and {shift:.5} world units", turn.to_degrees());
        }
    }
    Ok(())
}
