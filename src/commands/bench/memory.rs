//! `gazesplat bench memory`: does a capture of any size train in bounded memory?
//!
//! A capture of many photographs is made in a temporary directory and trained on for some hundred steps by the very command
//! that people use, in a process of its own, whose peak resident memory is then compared with the bound. The photographs are
//! JPEG files of a ray-cast room; of `--pictures` different ones each view has a file name of its own, a hard link, so that
//! the disk need not hold thousands. The cache knows views, not files: each is decoded on its own, and takes its own place.

use crate::cli::{Size, parse_size};
use crate::console::{Console, bytes, grouped};
use crate::diagnostics::{Failure, Result};
use crate::memory::{peak_resident_bytes, peak_resident_bytes_of};
use crate::progress;
use crate::run_dir::{cannot_write, create_all, to_json, write_text};
use clap::Args;
use gazesplat_core::image::RgbImage8;
use gazesplat_core::io::images::decode_rgb;
use gazesplat_core::io::model;
use gazesplat_core::synthetic::{SynthOptions, write_scene};
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use serde::Serialize;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

/// Arguments of `bench memory`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  gazesplat bench memory                             2,000 photographs of 1080p in a cache of 512 MiB
  gazesplat bench memory --views 200 --steps 50 --cache-bytes 67108864

Status 1 when the training took more memory than the bound and its parameters. Memory is read from the
system's account of the process, which only Linux keeps.")]
pub struct MemoryArgs {
    /// Photographs of the capture
    #[arg(long, value_name = "N", default_value_t = 2000)]
    pub views: usize,
    /// Their size in pixels
    #[arg(long, value_name = "WxH", default_value = "1920x1080", value_parser = parse_size)]
    pub size: Size,
    /// How many of them show something of their own; the others are links to these, decoded all the same
    #[arg(long, value_name = "N", default_value_t = 16)]
    pub pictures: usize,
    /// Budget of the image cache, `data.cache_bytes`
    #[arg(long, value_name = "BYTES", default_value_t = 512 << 20)]
    pub cache_bytes: usize,
    /// Steps of training, of one photograph each
    #[arg(long, value_name = "N", default_value_t = 300)]
    pub steps: u32,
    /// Most Gaussians of the model
    #[arg(long, value_name = "N", default_value_t = 100_000)]
    pub cap: usize,
    /// Memory that the training may take beside its parameters
    #[arg(long, value_name = "BYTES", default_value_t = 3 << 29)]
    pub max_bytes: u64,
    /// Write the JSON to this file too
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
}

/// Time between two looks at the memory of the training.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// What came of it; bytes.
#[derive(Debug, Serialize)]
struct Figures {
    views: usize,
    width: u32,
    height: u32,
    pictures: usize,
    /// All photographs, decoded.
    decoded_bytes: u64,
    cache_bytes: usize,
    image_bytes_peak: u64,
    image_hits: u64,
    image_misses: u64,
    steps: u32,
    num_gaussians: usize,
    /// Parameters of the model alone, without their gradients and moments.
    parameter_bytes: u64,
    peak_resident_bytes: u64,
    /// What the training may take: `--max-bytes` and the parameters.
    bound_bytes: u64,
}

/// Runs the bench.
///
/// # Errors
/// When the capture cannot be made, the training fails, or it takes more memory than the bound.
pub fn command(args: &MemoryArgs, console: &Console) -> Result<()> {
    if args.views < 9 || args.pictures == 0 || args.steps == 0 {
        return Err(Failure::new("there is nothing to measure")
            .hint("give 9 or more with `--views`, 1 or more with `--pictures` and `--steps`"));
    }
    if peak_resident_bytes().is_none() {
        return Err(Failure::new("this system keeps no account of a process's memory").hint("run the bench on Linux"));
    }
    let dir = tempfile::tempdir().map_err(|e| cannot_write(&std::env::temp_dir(), e))?;
    make_capture(dir.path(), args, console)?;
    let figures = train(dir.path(), args, console)?;
    if let Some(out) = &args.out {
        write_text(out, &format!("{}\n", to_json(&figures)))?;
    }
    console.note(format_args!(
        "{} photographs of {}x{} ({} decoded), cache {}: peak {}, bound {} ({} and the parameters of {} Gaussians)",
        grouped(args.views),
        args.size.width,
        args.size.height,
        bytes(figures.decoded_bytes),
        bytes(args.cache_bytes as u64),
        bytes(figures.peak_resident_bytes),
        bytes(figures.bound_bytes),
        bytes(args.max_bytes),
        grouped(figures.num_gaussians)
    ));
    console.json(&figures)?;
    if figures.peak_resident_bytes > figures.bound_bytes {
        return Err(Failure::check_failed(format!(
            "the training took {} bytes, at most {} were asked for",
            figures.peak_resident_bytes, figures.bound_bytes
        )));
    }
    Ok(())
}

/// Writes the capture into `dir`: photographs and `transforms.json`, with points to start from.
fn make_capture(dir: &Path, args: &MemoryArgs, console: &Console) -> Result<()> {
    let num_pictures = args.pictures.min(args.views);
    console.note(format_args!("making {} photographs, {num_pictures} of them different", grouped(args.views)));
    let options = SynthOptions {
        num_views: num_pictures,
        width: args.size.width,
        height: args.size.height,
        samples_per_side: 1,
        num_points: args.cap.min(20_000),
        ..SynthOptions::default()
    };
    let room = dir.join("room");
    write_scene(&room, &options)?;
    let described = room.join("transforms.json");
    let text = std::fs::read_to_string(&described).map_err(|e| Failure::io("read", &described, e))?;
    let mut transforms: Value = serde_json::from_str(&text).expect("our own file");
    let frames: Vec<Value> = transforms["frames"].as_array().cloned().unwrap_or_default();
    let images = dir.join("images");
    create_all(&images)?;
    for (index, frame) in frames.iter().enumerate() {
        let picture = decode_rgb(room.join(frame["file_path"].as_str().unwrap_or_default()))?;
        write_jpeg(&images.join(name(index)), &picture)?;
    }
    let bar = progress::counting_bar(console, "linking photographs", args.views);
    for index in frames.len()..args.views {
        let (from, to) = (images.join(name(index % frames.len())), images.join(name(index)));
        // Not every file system has links.
        std::fs::hard_link(&from, &to)
            .or_else(|_| std::fs::copy(&from, &to).map(drop))
            .map_err(|e| cannot_write(&to, e))?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    let frame = |index: usize| {
        let mut frame = frames[index % frames.len()].clone();
        frame["file_path"] = json!(format!("images/{}", name(index)));
        frame
    };
    transforms["frames"] = (0..args.views).map(frame).collect();
    transforms["ply_file_path"] = json!("room/points3D.ply");
    write_text(&dir.join("transforms.json"), &transforms.to_string())
}

fn name(index: usize) -> String {
    format!("{index:06}.jpg")
}

fn write_jpeg(path: &Path, image: &RgbImage8) -> Result<()> {
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, 92)
        .encode(&image.data, image.width, image.height, ExtendedColorType::Rgb8)
        .map_err(|e| Failure::new(format!("`{}`: {e}", path.display())).hint("choose another `--size`"))?;
    std::fs::write(path, jpeg).map_err(|e| cannot_write(path, e))
}

/// Trains on the capture in `dir` in a process of its own.
fn train(dir: &Path, args: &MemoryArgs, console: &Console) -> Result<Figures> {
    let program = std::env::current_exe().map_err(|e| Failure::new(format!("this program cannot be found: {e}")))?;
    let run = dir.join("run");
    let settings = [
        format!("train.steps={}", args.steps),
        "data.max_side=0".to_owned(),
        format!("data.cache_bytes={}", args.cache_bytes),
        format!("densify.cap={}", args.cap),
        // A few test views are enough to see both kinds share the cache; measuring hundreds takes longer than the training.
        format!("data.test_every={}", args.views.div_ceil(4)),
    ];
    let mut command = Command::new(program);
    command.arg("train").arg(dir).arg("--out").arg(&run);
    for setting in &settings {
        command.args(["--set", setting]);
    }
    console.note(format_args!("training on them, {} steps", grouped(args.steps as usize)));
    // What the training tells is of interest; its data channel is ours.
    let failed = |e: std::io::Error| Failure::new(format!("the training cannot be run: {e}"));
    let mut child = command.stdout(Stdio::null()).spawn().map_err(failed)?;
    // The account of a process is gone when it has ended; what it holds is the peak, so that only the last moment is missed.
    let mut peak = 0;
    let status = loop {
        peak = peak_resident_bytes_of(child.id()).unwrap_or(0).max(peak);
        match child.try_wait().map_err(failed)? {
            Some(status) => break status,
            None => std::thread::sleep(LOOK_EVERY),
        }
    };
    if !status.success() {
        return Err(Failure::new(format!("the training failed ({status})")).hint("what it said stands above"));
    }
    let log = run.join("metrics.jsonl");
    let text = std::fs::read_to_string(&log).map_err(|e| Failure::io("read", &log, e))?;
    let last: Value = text.lines().last().and_then(|line| serde_json::from_str(line).ok()).unwrap_or_default();
    let memory = |key: &str| {
        let missing = || Failure::new(format!("`{}` does not tell `memory.{key}`", log.display()));
        last["memory"][key].as_u64().ok_or_else(missing)
    };
    let cloud = model::load(run.join("point_cloud.ply"))?;
    let floats = 3 + 4 + 3 + 1 + 3 * cloud.num_coefficients();
    let parameter_bytes = (4 * floats * cloud.len()) as u64;
    let pixels = u64::from(args.size.width) * u64::from(args.size.height);
    Ok(Figures {
        views: args.views,
        width: args.size.width,
        height: args.size.height,
        pictures: args.pictures.min(args.views),
        decoded_bytes: 3 * pixels * args.views as u64,
        cache_bytes: args.cache_bytes,
        image_bytes_peak: memory("image_bytes_peak")?,
        image_hits: memory("image_hits")?,
        image_misses: memory("image_misses")?,
        steps: last["step"].as_u64().and_then(|step| u32::try_from(step).ok()).unwrap_or(0),
        num_gaussians: cloud.len(),
        parameter_bytes,
        peak_resident_bytes: peak,
        bound_bytes: args.max_bytes + parameter_bytes,
    })
}
