//! What both scene formats share: finding the files of a photograph and making its [`View`].

use super::images::{image_size, turned_size};
use crate::camera::distortion::LensDistortion;
use crate::camera::{Camera, Pinhole};
use crate::error::{Error, Result};
use crate::view::View;
use glam::DMat4;
use rayon::prelude::*;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Extensions of photographs, tried in this order when a scene names a file without one or with another one.
const IMAGE_EXTENSIONS: [&str; 6] = ["png", "jpg", "jpeg", "PNG", "JPG", "JPEG"];

/// The longest side a camera or an image may declare; larger numbers are damage, not photographs.
pub(super) const MAX_SIDE: u32 = 1 << 16;

/// A photograph of a scene whose file was found.
pub(super) struct Photo {
    /// The view's name.
    pub name: String,
    /// The image file.
    pub path: PathBuf,
    /// Its mask, if there is one.
    pub mask_path: Option<PathBuf>,
}

/// The image file meant by `path`: itself, or with an extension appended (NeRF-synthetic names none), or with another
/// one (downscaled copies are often stored as PNG beside a `.JPG` original).
pub(super) fn find_image(path: &Path) -> Option<PathBuf> {
    if path.is_file() {
        return Some(path.to_owned());
    }
    let known = path.extension().is_some_and(|e| IMAGE_EXTENSIONS.iter().any(|known| e.eq_ignore_ascii_case(known)));
    IMAGE_EXTENSIONS.into_iter().find_map(|extension| {
        let candidate = if known {
            path.with_extension(extension)
        } else {
            let mut name = path.as_os_str().to_owned();
            name.push(".");
            name.push(extension);
            name.into()
        };
        candidate.is_file().then_some(candidate)
    })
}

/// The directories in `base` that may hold the masks of the photographs in the directory `images` of it, best first:
/// `masks_4` beside `images_4`, whose masks have the size of its photographs, then `masks`.
pub(super) fn mask_dirs(base: &Path, images: &str) -> Vec<PathBuf> {
    let scaled = images.strip_prefix("images").filter(|suffix| !suffix.is_empty());
    scaled.map(|suffix| base.join(format!("masks{suffix}"))).into_iter().chain([base.join("masks")]).collect()
}

/// The mask of the photograph `name` in the first of `dirs` that has it: `<name>.png` as COLMAP has it, or `<stem>.png`.
pub(super) fn find_mask(dirs: &[PathBuf], name: &str) -> Option<PathBuf> {
    let in_dir = |dir: &PathBuf| {
        let candidates = [dir.join(format!("{name}.png")), dir.join(name).with_extension("png")];
        candidates.into_iter().find(|path| path.is_file())
    };
    dirs.iter().find_map(in_dir)
}

/// Sizes \[width, height\] of the photographs from their headers, in order.
///
/// # Errors
/// That of the first photograph whose header cannot be read.
pub(super) fn photo_sizes(photos: &[Photo]) -> Result<Vec<[u32; 2]>> {
    let sizes: Vec<Result<_>> = photos.par_iter().map(|photo| image_size(&photo.path)).collect();
    sizes.into_iter().collect()
}

/// Checks what every calibration must satisfy: finite numbers, positive focal lengths, a size that can exist.
///
/// # Errors
/// A sentence naming the number that is wrong.
pub(super) fn check_calibration(lens: &LensDistortion) -> std::result::Result<(), String> {
    for (name, side) in [("width", lens.width), ("height", lens.height)] {
        if !(1..=MAX_SIDE).contains(&side) {
            return Err(format!("image {name} {side}, expected 1 to {MAX_SIDE} pixels"));
        }
    }
    for (name, focal) in [("fx", lens.fx), ("fy", lens.fy)] {
        // A focal length below a thousandth of a pixel would be a field of view of 180°.
        if !(focal.is_finite() && focal > 1e-3) {
            return Err(format!("focal length {name} = {focal}, expected a positive number of pixels"));
        }
    }
    for (name, value) in [("cx", lens.cx), ("cy", lens.cy)] {
        if !value.is_finite() {
            return Err(format!("principal point {name} = {value}, expected a finite number"));
        }
    }
    match lens.coefficients.iter().find(|k| !k.is_finite()) {
        Some(k) => Err(format!("distortion coefficient {k}, expected a finite number")),
        None => Ok(()),
    }
}

/// True when images of these sizes can show the same view: equal aspect ratios within a pixel of rounding.
pub(super) fn same_aspect(a: [u32; 2], b: [u32; 2]) -> bool {
    let ([aw, ah], [bw, bh]) = (a.map(u64::from), b.map(u64::from));
    (aw * bh).abs_diff(ah * bw) <= (aw + ah).max(bw + bh)
}

/// Makes views of calibrated photographs; remembers the pinholes it has computed, as most views share one lens.
pub(super) struct ViewBuilder {
    max_side: u32,
    pinholes: HashMap<String, Pinhole>,
}

impl ViewBuilder {
    /// A builder of views whose longer side is at most `max_side` pixels; 0 = no limit.
    pub fn new(max_side: u32) -> Self {
        Self { max_side, pinholes: HashMap::new() }
    }

    /// The view of `photo`, which is stored with `size` pixels. `lens` may belong to another size of the same photograph,
    /// and to the photograph as its EXIF orientation shows it: cameras store turned pictures, some programs turn them
    /// before they calibrate, and the calibration tells.
    ///
    /// # Errors
    /// [`Error::Format`] when the aspect ratios of photograph and calibration differ either way.
    pub fn view(
        &mut self,
        photo: Photo,
        size: [u32; 2],
        lens: LensDistortion,
        camera_from_world: &DMat4,
    ) -> Result<View> {
        let expected = [lens.width, lens.height];
        let size = match same_aspect(size, expected) {
            true => size,
            false => turned_size(&photo.path)?.filter(|turned| same_aspect(*turned, expected)).unwrap_or(size),
        };
        let [width, height] = size;
        let lens = if size == [lens.width, lens.height] {
            lens
        } else if same_aspect(size, [lens.width, lens.height]) {
            lens.resized(width, height)
        } else {
            return Err(Error::format(
                &photo.path,
                format!("the photograph has {width} × {height} pixels, its camera {} × {}", lens.width, lens.height),
                "use the photographs the reconstruction was made from; a program may have turned or cropped them",
            ));
        };
        let pinhole = *self.pinholes.entry(format!("{lens:?}")).or_insert_with(|| lens.undistorted_pinhole());
        Ok(View {
            name: photo.name,
            camera: Camera {
                intrinsics: pinhole.fitted(self.max_side),
                camera_from_world: camera_from_world.as_mat4(),
            },
            image_path: Some(photo.path),
            distortion: lens.is_distorted().then_some(lens),
            mask_path: photo.mask_path,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounding_of_a_downscaled_size_is_no_other_aspect() {
        assert!(same_aspect([4946, 3286], [1237, 822]));
        assert!(same_aspect([1024, 768], [640, 479]));
        assert!(!same_aspect([1080, 1920], [1920, 1080]));
        assert!(!same_aspect([1080, 1920], [1080, 1900]));
    }

    #[test]
    fn extensions_are_found_but_directories_are_no_images() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        std::fs::create_dir(at("r_1")).unwrap();
        std::fs::write(at("r_1.png"), "").unwrap();
        std::fs::write(at("r.2.JPG"), "").unwrap();
        assert_eq!(find_image(&at("r_1")), Some(at("r_1.png")));
        assert_eq!(find_image(&at("r_1.jpg")), Some(at("r_1.png")));
        assert_eq!(find_image(&at("r.2")), Some(at("r.2.JPG")));
        assert_eq!(find_image(&at("r_3")), None);
    }
}
