//! `gazesplat render`: a model seen from the cameras of a scene or along a path, as PNG files or a video.

use super::antialiased::AntialiasedArgs;
use super::device::ComputeDevice;
use super::frames::{self, NamedCamera};
use super::termination::TerminationArgs;
use super::{Model, Split, load_scene, log_machine};
use crate::cli::{DeviceArgs, SettingsArgs, Size, parse_fov_deg, parse_rgb, parse_size};
use crate::console::{Console, duration};
use crate::diagnostics::{Failure, Result};
use crate::progress;
use clap::Args;
use gazesplat_core::Pinhole;
use gazesplat_core::camera::path::CameraPath;
use gazesplat_render::{RenderOptions, RenderStats, Splats, StatsMode};
use serde_json::json;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Frames per second of a video along the views of a scene, which has no clock of its own.
const SCENE_FPS: f32 = 30.0;

/// Arguments of `render`.
#[derive(Debug, Args)]
#[command(
    group(clap::ArgGroup::new("cameras").required(true).args(["scene", "path"])),
    after_help = "\
Examples:
  gazesplat render runs/fox-1 --scene fox --split test --out frames
  gazesplat render model.ply --path orbit.json --size 1280x720 --out orbit.y4m --device gpu
  gazesplat render model.ply --scene fox --termination jnd --out frames
  gazesplat render model.ply --scene fox --antialiased --size 320x180 --out small
  gazesplat render model.ply --scene fox --depth --out frames    numpy.load('frames/0001_depth.npy')
  ffmpeg -i orbit.y4m -crf 16 orbit.mp4

--depth writes NumPy arrays of 32-bit floats, [height, width]: for each pixel the depth along the
viewing axis (camera z, not distance) in world units, each Gaussian weighted by what is seen of it,
and 0 where none is seen. `transforms.json` of nerfstudio takes such files as `depth_file_path`.

--antialiased draws as gsplat and nerfstudio do with `antialiased`. A model that says so itself, by
its run, the PLY comment `SplatRenderMode: mip` or the flag of SPZ, is drawn so without asking.

A .y4m video is raw: YUV 4:4:4, 8 bit, BT.709, limited range. Players and encoders read it as it is.

Gaussians with a value that is not finite are left out, with a warning that names the file and
their number; a model without any other is refused."
)]
pub struct RenderArgs {
    /// A model file (PLY, compressed PLY, `.splat`, SPZ), or the directory of a run
    pub model: PathBuf,
    /// Draw the views of this scene; its photographs are not decoded
    #[arg(long, value_name = "SCENE")]
    pub scene: Option<PathBuf>,
    /// Draw along this camera path: our JSON, INRIA `cameras.json` or nerfstudio `camera_path.json`
    #[arg(long, value_name = "FILE")]
    pub path: Option<PathBuf>,
    /// Which views of the scene
    #[arg(long, value_enum, default_value = "all", conflicts_with = "path")]
    pub split: Split,
    /// Image size in pixels instead of the camera's own; keeps its horizontal field of view
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    pub size: Option<Size>,
    /// Horizontal field of view in degrees instead of the camera's own
    #[arg(long, value_name = "DEG", value_parser = parse_fov_deg)]
    pub fov: Option<f32>,
    /// Largest opacity one Gaussian has in a pixel; INRIA's renderer uses 0.99 [default: the run's, or 0.999]
    #[arg(long, value_name = "ALPHA")]
    pub alpha_max: Option<f32>,
    /// Gaussians nearer than this are left out, world units [default: the run's, or 0.01]
    #[arg(long, value_name = "Z")]
    pub near: Option<f32>,
    /// Colour behind everything, channels 0 to 1 [default: the run's, or 0,0,0]
    #[arg(long, value_name = "R,G,B", value_parser = parse_rgb)]
    pub background: Option<[f32; 3]>,
    /// When a pixel stops
    #[command(flatten)]
    pub termination: TerminationArgs,
    /// Antialiasing
    #[command(flatten)]
    pub antialiased: AntialiasedArgs,
    /// Write the expected depth of every view beside its image, `<image stem>_depth.npy`
    #[arg(long)]
    pub depth: bool,
    /// Device
    #[command(flatten)]
    pub device: DeviceArgs,
    /// Print what each frame cost as JSON on standard output
    #[arg(long)]
    pub stats: bool,
    /// A directory for `<image stem>.png`, or a video FILE.y4m [default: RUN/renders, or renders/MODEL]
    #[arg(long, value_name = "DIR|FILE.y4m")]
    pub out: Option<PathBuf>,
}

/// Runs `render`.
///
/// # Errors
/// When the device cannot be used, the model, the cameras or an option is wrong, or the frames cannot be written.
pub fn command(args: &RenderArgs, console: &Console) -> Result<()> {
    let target = Target::new(args)?;
    if let (true, Target::Video(file)) = (args.depth, &target) {
        return Err(Failure::new(format!("`{}` is a video, which holds no depth", file.display()))
            .hint("name a directory with `--out`: `--depth` writes a file per view beside its image"));
    }
    args.termination.check()?;
    let device = ComputeDevice::open(args.device.device, console)?;
    render(args, &target, &device, console)
}

fn render(args: &RenderArgs, target: &Target, device: &ComputeDevice, console: &Console) -> Result<()> {
    log_machine();
    let model = Model::load_for_drawing(&args.model, console)?;
    let mut config = model.settings(&SettingsArgs::default())?;
    // Training may have looked at smaller images; frames have the scene's own size.
    config.data.max_side = 0;
    let mut options = RenderOptions { pass: gazesplat_render::Pass::Inference, ..config.render_options() };
    options.alpha_max = args.alpha_max.unwrap_or(options.alpha_max);
    options.near = args.near.unwrap_or(options.near);
    options.background = args.background.unwrap_or(options.background);
    options.antialiased = args.antialiased.or(options.antialiased);
    options.depth = args.depth;
    options.stats = if args.stats { StatsMode::All } else { StatsMode::None };
    options.termination = args.termination.termination()?;
    options.validate()?;

    let (mut cameras, fps): (Vec<NamedCamera>, f32) = match (&args.scene, &args.path) {
        (Some(scene), _) => {
            let views = args.split.views(&load_scene(scene, &config, console)?, scene)?;
            (views.into_iter().map(|v| (v.name, v.camera)).collect(), SCENE_FPS)
        }
        (None, Some(path)) => {
            let path = CameraPath::load(path)?;
            (path.frames, path.fps)
        }
        (None, None) => return Err(Failure::new("neither `--scene` nor `--path` was given")),
    };
    if cameras.is_empty() {
        return Err(Failure::new("there is no camera to draw from").hint("check the file given with `--path`"));
    }
    for (_, camera) in &mut cameras {
        camera.intrinsics = replaced(camera.intrinsics, args.size, args.fov);
    }

    let bar = progress::counting_bar(console, "rendering", cameras.len());
    let started = Instant::now();
    let mut stats: Vec<(String, RenderStats)> = Vec::new();
    device.guard(|| {
        let splats = Splats::from_cloud(&model.cloud, device.tensors())?;
        let mut frame = |camera: &NamedCamera| {
            let (drawn, counters) = frames::draw_with_depth(&splats, &camera.1, &options)?;
            stats.push((camera.0.clone(), counters));
            bar.inc(1);
            Ok(drawn)
        };
        match target {
            Target::Pngs(dir) => frames::write_pngs(dir, &cameras, frame),
            Target::Video(file) => frames::write_video(file, &cameras, fps, |camera| Ok(frame(camera)?.image)),
        }
    })?;
    bar.finish_and_clear();
    let (n, secs) = (cameras.len(), started.elapsed().as_secs_f64());
    match target {
        Target::Pngs(dir) => console.note(format_args!("{n} frames in `{}`, {}", dir.display(), duration(secs))),
        Target::Video(file) => console.note(format_args!(
            "{n} frames in `{}` (YUV 4:4:4, BT.709, limited range), {}",
            file.display(),
            duration(secs)
        )),
    }
    if args.stats {
        console.json(&stats_json(&stats))?;
    }
    Ok(())
}

/// Where the frames go.
enum Target {
    Pngs(PathBuf),
    Video(PathBuf),
}

impl Target {
    fn new(args: &RenderArgs) -> Result<Self> {
        let Some(out) = &args.out else {
            let dir = if args.model.is_dir() {
                args.model.join("renders")
            } else {
                Path::new("renders").join(args.model.file_stem().unwrap_or(args.model.as_os_str()))
            };
            return Ok(Self::Pngs(dir));
        };
        let extension = out.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
        if out.is_dir() {
            return Ok(Self::Pngs(out.clone()));
        }
        match extension.as_str() {
            "y4m" => Ok(Self::Video(out.clone())),
            "mp4" | "mkv" | "webm" | "mov" | "avi" | "gif" => {
                Err(Failure::new(format!("`{}`: `.{extension}` videos are not written", out.display())).hint(format!(
                    "write `{0}` and convert it: `ffmpeg -i {0} {1}`",
                    out.with_extension("y4m").display(),
                    out.display()
                )))
            }
            "png" | "jpg" | "jpeg" | "webp" => {
                Err(Failure::new(format!("`{}` is one image, expected a directory", out.display()))
                    .hint("every view becomes one PNG in the directory given with `--out`"))
            }
            _ => Ok(Self::Pngs(out.clone())),
        }
    }
}

/// Intrinsics with another size or field of view. A size of the same shape is a plain change of sampling; otherwise the
/// principal point moves to the centre and pixels are square.
fn replaced(own: Pinhole, size: Option<Size>, fov_deg: Option<f32>) -> Pinhole {
    let (width, height) = size.map_or((own.width, own.height), |s| (s.width, s.height));
    let same_shape = u64::from(width) * u64::from(own.height) == u64::from(height) * u64::from(own.width);
    match fov_deg {
        None if same_shape => own.resized(width, height),
        None => Pinhole::from_fov_x(width, height, own.fov_x_rad()),
        Some(deg) => Pinhole::from_fov_x(width, height, deg.to_radians()),
    }
}

fn stats_json(stats: &[(String, RenderStats)]) -> serde_json::Value {
    let views: Vec<_> = stats
        .iter()
        .map(|(name, s)| {
            let mut view = json!({ "name": name });
            if let (Some(view), Ok(serde_json::Value::Object(counters))) =
                (view.as_object_mut(), serde_json::to_value(s))
            {
                view.extend(counters);
            }
            view
        })
        .collect();
    json!({ "views": views })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn size_of_the_same_shape_only_samples_anew() {
        let own = Pinhole { width: 400, height: 300, fx: 300.0, fy: 310.0, cx: 190.0, cy: 155.0 };
        assert_eq!(replaced(own, None, None), own);
        assert_eq!(replaced(own, Some(Size { width: 800, height: 600 }), None), own.resized(800, 600));
        let wide = replaced(own, Some(Size { width: 800, height: 300 }), None);
        assert!((wide.fov_x_rad() - own.fov_x_rad()).abs() < 1e-6 && wide.fx == wide.fy && wide.cy == 150.0);
        let narrow = replaced(own, None, Some(20.0));
        assert!((narrow.fov_x_rad().to_degrees() - 20.0).abs() < 1e-4 && narrow.width == 400);
    }
}
