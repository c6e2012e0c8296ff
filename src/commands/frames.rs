//! Renders as 8-bit frames, and where they go: a directory of PNG files, with depth maps beside them, or one video.

use crate::diagnostics::{Failure, Result};
use crate::run_dir::create_all;
use crate::{npy, y4m};
use gazesplat_core::{Camera, RgbImage8, io};
use gazesplat_render::{RenderOptions, RenderStats, Splats};
use gazesplat_train::evaluate::{expected_depth, rgb};
use std::collections::HashMap;
use std::path::Path;

/// A camera and what its frame is called.
pub(crate) type NamedCamera = (String, Camera);

/// Draws one frame, with the counters of the work.
pub(crate) fn draw(splats: &Splats, camera: &Camera, options: &RenderOptions) -> Result<(RgbImage8, RenderStats)> {
    let rendered = gazesplat_render::render(splats, camera, options)?;
    let stats = rendered.stats;
    Ok((rgb(rendered)?.to_rgb8(), stats))
}

/// As [`draw`]; with the expected depth, `[H, W]` in world units, if the options ask for it.
pub(crate) fn draw_with_depth(
    splats: &Splats,
    camera: &Camera,
    options: &RenderOptions,
) -> Result<(Frame, RenderStats)> {
    let rendered = gazesplat_render::render(splats, camera, options)?;
    let stats = rendered.stats;
    let depth = expected_depth(&rendered)?;
    Ok((Frame { image: rgb(rendered)?.to_rgb8(), depth }, stats))
}

/// What is written of one camera.
pub(crate) struct Frame {
    /// The colours.
    pub image: RgbImage8,
    /// The expected depth, `[H, W]` in world units.
    pub depth: Option<Vec<f32>>,
}

/// Writes the frame of every camera into `<stem>.png` below `dir`, and its depth into `<stem>_depth.npy`.
pub(crate) fn write_pngs(
    dir: &Path,
    cameras: &[NamedCamera],
    mut frame: impl FnMut(&NamedCamera) -> Result<Frame>,
) -> Result<()> {
    let files = png_names(cameras)?;
    if dir.is_file() {
        return Err(Failure::new(format!("`{}` is a file, expected a directory", dir.display()))
            .hint("give a directory or a file that ends in `.y4m`"));
    }
    create_all(dir)?;
    for (file, camera) in files.iter().zip(cameras) {
        let Frame { image, depth } = frame(camera)?;
        io::save_png(dir.join(file), &image)?;
        if let Some(depth) = depth {
            let stem = file.strip_suffix(".png").unwrap_or(file);
            let (height, width) = (image.height as usize, image.width as usize);
            io::write_atomically(dir.join(format!("{stem}_depth.npy")), |out| {
                npy::write_f32(out, &depth, height, width)
            })?;
        }
    }
    Ok(())
}

/// `<stem>.png` for each camera.
pub(crate) fn png_names(cameras: &[NamedCamera]) -> Result<Vec<String>> {
    let mut first_with: HashMap<String, &str> = HashMap::new();
    let mut files = Vec::with_capacity(cameras.len());
    for (name, _) in cameras {
        let stem = Path::new(name).file_stem().map_or_else(|| name.clone(), |s| s.to_string_lossy().into_owned());
        let file = format!("{stem}.png");
        // File systems that ignore case would let one frame replace the other.
        if let Some(other) = first_with.insert(file.to_lowercase(), name) {
            return Err(Failure::new(format!("views `{other}` and `{name}` would both be written to `{file}`"))
                .hint("write a video with `--out FILE.y4m`, or rename one of the images"));
        }
        files.push(file);
    }
    Ok(files)
}

/// Writes the frame of every camera into one Y4M video, one after the other.
pub(crate) fn write_video(
    path: &Path,
    cameras: &[NamedCamera],
    fps: f32,
    mut frame: impl FnMut(&NamedCamera) -> Result<RgbImage8>,
) -> Result<()> {
    let size = |c: &NamedCamera| (c.1.intrinsics.width, c.1.intrinsics.height);
    let first = cameras.first().ok_or_else(|| Failure::new("a video needs at least one frame"))?;
    if let Some(other) = cameras.iter().find(|c| size(c) != size(first)) {
        let ((w0, h0), (w1, h1)) = (size(first), size(other));
        return Err(Failure::new(format!(
            "a video needs frames of one size, found {w0}x{h0} (`{}`) and {w1}x{h1} (`{}`)",
            first.0, other.0
        ))
        .hint(format!("add `--size {w0}x{h0}`, or write PNG files with `--out DIR`")));
    }
    if let Some(parent) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
        create_all(parent)?;
    }
    let mut failure = None;
    let written = io::write_atomically(path, |file| {
        y4m::write_header(file, size(first).0, size(first).1, fps)?;
        for camera in cameras {
            match frame(camera) {
                Ok(image) => y4m::write_frame(file, &image)?,
                Err(e) => {
                    failure = Some(e);
                    return Err(std::io::Error::other("a frame could not be rendered"));
                }
            }
        }
        Ok(())
    });
    match failure {
        Some(failure) => Err(failure),
        None => Ok(written?),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gazesplat_core::Pinhole;
    use glam::Mat4;

    fn camera(name: &str, width: u32) -> NamedCamera {
        let intrinsics = Pinhole::from_fov_x(width, 4, 1.0);
        (name.to_owned(), Camera { intrinsics, camera_from_world: Mat4::IDENTITY })
    }

    #[test]
    fn colliding_stems_are_refused() {
        let failure = png_names(&[camera("a/01.png", 4), camera("b/01.jpg", 4)]).expect_err("both are 01.png");
        assert!(failure.message().contains("`a/01.png` and `b/01.jpg`"));
        assert_eq!(png_names(&[camera("a/01.JPG", 4), camera("02", 4)]).expect("differ"), ["01.png", "02.png"]);
    }

    #[test]
    fn video_of_two_sizes_is_refused_before_anything_is_written() {
        let dir = tempfile::tempdir().expect("temporary directory");
        let path = dir.path().join("a.y4m");
        let failure =
            write_video(&path, &[camera("a", 4), camera("b", 5)], 30.0, |_| unreachable!("no frame is drawn"));
        assert!(failure.expect_err("two sizes").report(false).contains("--size 4x4"));
        assert!(!path.exists());
    }

    #[test]
    fn video_that_fails_leaves_no_file() {
        let dir = tempfile::tempdir().expect("temporary directory");
        let path = dir.path().join("a.y4m");
        let failure = write_video(&path, &[camera("a", 4)], 30.0, |_| Err(Failure::new("no frame today")));
        assert_eq!(failure.expect_err("drawing fails").message(), "no frame today");
        assert_eq!(std::fs::read_dir(dir.path()).expect("readable").count(), 0);
    }
}
