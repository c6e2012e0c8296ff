//! `gazesplat info`: what is in a model, a scene, a camera path or a run; or which devices there are.

use super::{Model, devices, load_scene};
use crate::console::{Console, bytes, grouped};
use crate::diagnostics::{Failure, Result};
use crate::run_dir::RunDir;
use clap::Args;
use gazesplat_core::camera::path::CameraPath;
use gazesplat_core::io::ply;
use gazesplat_core::{Dataset, GaussianCloud, SparsePoints, View};
use gazesplat_train::Config;
use serde_json::{Value as Json, json};
use std::collections::BTreeMap;
use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Arguments of `info`.
#[derive(Debug, Args)]
#[command(
    group(clap::ArgGroup::new("subject").required(true).args(["path", "devices"])),
    after_help = "\
Examples:
  gazesplat info model.ply
  gazesplat info my_capture --json | jq .num_points
  gazesplat info --devices

--devices tells the CPU and every GPU adapter that a Vulkan, Metal or DirectX 12 driver offers,
numbered as `--device gpu:N` counts them, with the limits that matter and whether they suffice.
A software driver computes on the CPU: it is for tests."
)]
pub struct InfoArgs {
    /// A model file, a point cloud (PLY), a scene, a camera path (JSON), or the directory of a run
    pub path: Option<PathBuf>,
    /// Tell what `--device` can name on this machine
    #[arg(long)]
    pub devices: bool,
    /// JSON instead of a table
    #[arg(long)]
    pub json: bool,
}

/// Runs `info`.
///
/// # Errors
/// When there is nothing at the path that the program knows, or it is damaged.
pub fn command(args: &InfoArgs, console: &Console) -> Result<()> {
    let Some(path) = &args.path else { return devices::tell(args.json, console) };
    let mut facts = Facts::default();
    if path.is_dir() && path.join("point_cloud.ply").is_file() && !is_scene(path) {
        run(path, &mut facts, console)?;
    } else if path.is_dir() {
        scene(path, &mut facts, console)?;
    } else {
        file(path, &mut facts, console)?;
    }
    if args.json { console.json(&facts.json) } else { console.data(&facts.table()) }
}

/// The same facts for people and for programs.
#[derive(Default)]
struct Facts {
    rows: Vec<(&'static str, String)>,
    json: serde_json::Map<String, Json>,
}

impl Facts {
    fn add(&mut self, key: &str, value: impl Into<Json>, label: &'static str, text: impl Into<String>) {
        self.json.insert(key.to_owned(), value.into());
        self.rows.push((label, text.into()));
    }

    fn table(&self) -> String {
        let width = self.rows.iter().map(|r| r.0.chars().count()).max().unwrap_or(0);
        self.rows.iter().map(|(label, text)| format!("{label:width$}  {text}\n")).collect()
    }
}

fn is_scene(path: &Path) -> bool {
    ["sparse", "transforms.json", "transforms_train.json", "images.bin", "images.txt"]
        .iter()
        .any(|n| path.join(n).exists())
}

fn file(path: &Path, facts: &mut Facts, console: &Console) -> Result<()> {
    let mut head = Vec::new();
    let file = fs::File::open(path).map_err(|e| Failure::io("read", path, e))?;
    // Enough for the header of a model of degree 4 and for the start of any JSON.
    file.take(1 << 16).read_to_end(&mut head).map_err(|e| Failure::io("read", path, e))?;
    let head = String::from_utf8_lossy(&head);
    let is_json = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("json"));
    if is_json && !head.contains("\"transform_matrix\"") {
        return camera_path(path, facts);
    }
    if is_json {
        return scene(path, facts, console);
    }
    let is_of_gaussians = ["f_dc_0", "opacity", "packed_position"].iter().any(|property| head.contains(property));
    let has_points_only = head.starts_with("ply") && !is_of_gaussians;
    if has_points_only {
        return points(path, &ply::load_points(path)?, facts);
    }
    let model = Model::load(path, console)?;
    facts.add("kind", "model", "3D Gaussian model", path.display().to_string());
    let format = model.report.format.kind();
    facts.add("format", format, "format", format);
    model_facts(&model, facts);
    if !model.report.comments.is_empty() {
        facts.add("comments", model.report.comments.clone(), "comments", model.report.comments.join("; "));
    }
    Ok(())
}

fn points(path: &Path, points: &SparsePoints, facts: &mut Facts) -> Result<()> {
    facts.add("kind", "points", "point cloud", path.display().to_string());
    facts.add("num_points", points.positions.len(), "points", grouped(points.positions.len()));
    bounds(&points.positions, facts);
    Ok(())
}

fn model_facts(model: &Model, facts: &mut Facts) {
    let cloud = &model.cloud;
    if let Ok(file) = fs::metadata(&model.path) {
        facts.add("bytes", file.len(), "file size", bytes(file.len()));
    }
    facts.add("num_gaussians", cloud.len(), "Gaussians", grouped(cloud.len()));
    let num_sh = cloud.num_coefficients();
    let text = format!("{} ({num_sh} coefficients per channel)", cloud.sh_degree);
    facts.add("sh_degree", cloud.sh_degree, "SH degree", text);
    bounds(&cloud.means, facts);
    spread(facts, "opacity", "opacity", opacities(cloud));
    let scales = |pick: fn([f32; 3]) -> f32| cloud.log_scales.iter().map(|s| pick(*s)).collect::<Vec<f32>>();
    spread(facts, "scale", "scale (geometric mean)", scales(|s| ((s[0] + s[1] + s[2]) / 3.0).exp()));
    let longest_to_shortest = |s: [f32; 3]| (s[0].max(s[1]).max(s[2]) - s[0].min(s[1]).min(s[2])).exp();
    spread(facts, "anisotropy", "longest to shortest axis", scales(longest_to_shortest));
}

fn opacities(cloud: &GaussianCloud) -> Vec<f32> {
    cloud.opacity_logits.iter().map(|logit| 1.0 / (1.0 + (-logit).exp())).collect()
}

fn bounds(positions: &[[f32; 3]], facts: &mut Facts) {
    if positions.is_empty() {
        return;
    }
    let mut low = [0.0_f32; 3];
    let mut high = [0.0_f32; 3];
    for axis in 0..3 {
        let mut along: Vec<f32> = positions.iter().map(|p| p[axis]).filter(|v| v.is_finite()).collect();
        [low[axis], high[axis]] = percentiles(&mut along, [0.01, 0.99]);
    }
    let list = |v: [f32; 3]| v.map(|x| format!("{x:.3}")).join(", ");
    let text = format!("({}) to ({}), without the outermost 1 % on each side", list(low), list(high));
    facts.add("bounds_p1_p99", json!([low.map(short), high.map(short)]), "bounds", text);
}

fn spread(facts: &mut Facts, key: &str, label: &'static str, mut values: Vec<f32>) {
    if values.is_empty() {
        return;
    }
    let [p5, p50, p95] = percentiles(&mut values, [0.05, 0.5, 0.95]);
    let text = format!("{} median, {} to {} for the middle 90 %", digits(p50), digits(p5), digits(p95));
    facts.add(key, json!({ "p5": short(p5), "p50": short(p50), "p95": short(p95) }), label, text);
}

/// The `f64` that prints like `value`: JSON would show digits that an `f32` does not have.
fn short(value: f32) -> f64 {
    value.to_string().parse().unwrap_or(f64::NAN)
}

/// Four significant digits.
fn digits(value: f32) -> String {
    let magnitude = if value == 0.0 { 0 } else { value.abs().log10().floor() as i32 };
    format!("{value:.*}", (3 - magnitude).clamp(0, 8) as usize)
}

/// Nearest-rank percentiles of `values`, which are sorted on the way; 0 when there are none.
fn percentiles<const K: usize>(values: &mut [f32], at: [f32; K]) -> [f32; K] {
    values.sort_unstable_by(f32::total_cmp);
    at.map(|p| {
        let last = values.len().saturating_sub(1);
        values.get((p * last as f32).round() as usize).copied().unwrap_or(0.0)
    })
}

fn scene(path: &Path, facts: &mut Facts, console: &Console) -> Result<()> {
    let mut config = Config::default();
    config.data.max_side = 0;
    let dataset: Dataset = load_scene(path, &config, console)?;
    let views = dataset.all_views();
    facts.add("kind", "scene", "scene", path.display().to_string());
    facts.add("format", dataset.source.to_string(), "format", dataset.source.to_string());
    let text = format!("{} ({} for training, {} for testing)", views.len(), dataset.train.len(), dataset.test.len());
    facts.add("num_views", views.len(), "views", text);
    facts.json.insert("num_train".into(), dataset.train.len().into());
    facts.json.insert("num_test".into(), dataset.test.len().into());
    let sizes = counted(&views, |v| (v.camera.intrinsics.width, v.camera.intrinsics.height));
    let json: Vec<Json> = sizes.iter().map(|((w, h), n)| json!({ "width": w, "height": h, "num_views": n })).collect();
    let text = sizes.iter().map(|((w, h), n)| format!("{w} x {h} ({n} views)")).collect::<Vec<_>>().join(", ");
    facts.add("image_sizes", json, "image size", text);
    let fovs = views.iter().map(|v| v.camera.intrinsics.fov_x_rad().to_degrees());
    let (low, high) = fovs.fold((f32::INFINITY, 0.0_f32), |(l, h), f| (l.min(f), h.max(f)));
    let text = if high - low < 0.05 { format!("{low:.1}°") } else { format!("{low:.1}° to {high:.1}°") };
    facts.add("fov_x_deg", json!([short(low), short(high)]), "horizontal field of view", text);
    let lenses = counted(&views, |v| match &v.distortion {
        Some(lens) => format!("{} (undistorted on load)", lens.model.name()),
        None => "pinhole".to_owned(),
    });
    let text = lenses.iter().map(|(name, n)| format!("{name} ({n} views)")).collect::<Vec<_>>().join(", ");
    facts.add("lenses", json!(lenses), "lens", text);
    let num_masks = views.iter().filter(|v| v.mask_path.is_some()).count();
    if num_masks > 0 {
        facts.add("num_masks", num_masks, "masks", grouped(num_masks));
    }
    facts.add(
        "extent",
        dataset.scene_extent(),
        "extent of the cameras",
        format!("{:.3} world units", dataset.scene_extent()),
    );
    let num_points = dataset.points.positions.len();
    let text = if num_points == 0 { "none: training starts from random Gaussians".into() } else { grouped(num_points) };
    facts.add("num_points", num_points, "sparse points", text);
    bounds(&dataset.points.positions, facts);
    Ok(())
}

fn counted<K: Ord>(views: &[&View], key: impl Fn(&View) -> K) -> BTreeMap<K, usize> {
    let mut counts = BTreeMap::new();
    for view in views {
        *counts.entry(key(view)).or_insert(0) += 1;
    }
    counts
}

fn camera_path(path: &Path, facts: &mut Facts) -> Result<()> {
    let camera_path = CameraPath::load(path)?;
    let num_frames = camera_path.frames.len();
    facts.add("kind", "camera_path", "camera path", path.display().to_string());
    facts.add("num_frames", num_frames, "frames", grouped(num_frames));
    let secs = num_frames as f32 / camera_path.fps;
    facts.add("fps", short(camera_path.fps), "frames per second", format!("{} ({secs:.1} s)", camera_path.fps));
    if let Some((_, camera)) = camera_path.frames.first() {
        let pinhole = camera.intrinsics;
        let (width, height) = (pinhole.width, pinhole.height);
        facts.add("size", json!([width, height]), "image size", format!("{width} x {height}"));
        let fov = pinhole.fov_x_rad().to_degrees();
        facts.add("fov_x_deg", short(fov), "horizontal field of view", format!("{fov:.1}°"));
    }
    Ok(())
}

fn run(path: &Path, facts: &mut Facts, console: &Console) -> Result<()> {
    let run_dir = RunDir::open(path)?;
    facts.add("kind", "run", "run", path.display().to_string());
    model_facts(&Model::load(path, console)?, facts);
    let num_lines = fs::read_to_string(run_dir.metrics_path()).map_or(0, |text| text.lines().count());
    if num_lines > 0 {
        facts.add("num_logged_steps", num_lines, "logged steps", grouped(num_lines));
    }
    let eval = fs::read_to_string(run_dir.eval_path()).ok().and_then(|text| serde_json::from_str::<Json>(&text).ok());
    if let Some((psnr, ssim)) = eval.and_then(|e| Some((e.get("psnr")?.as_f64()?, e.get("ssim")?.as_f64()?))) {
        facts.add("psnr", psnr, "PSNR", format!("{psnr:.2} dB"));
        facts.add("ssim", ssim, "SSIM", format!("{ssim:.4}"));
    }
    for (label, file) in [("settings", run_dir.settings_path()), ("report", run_dir.report_path())] {
        if file.is_file() {
            facts.add(label, file.display().to_string(), label, file.display().to_string());
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_nearest_ranks() {
        assert_eq!(percentiles(&mut [5.0, 1.0, 3.0, 2.0, 4.0], [0.0, 0.5, 1.0]), [1.0, 3.0, 5.0]);
        assert_eq!(percentiles(&mut [], [0.5]), [0.0]);
    }

    #[test]
    fn numbers_keep_four_digits() {
        assert_eq!([0.012_345_f32, 1.0, 123.456, 0.0].map(digits), ["0.01235", "1.000", "123.5", "0.000"]);
    }
}
