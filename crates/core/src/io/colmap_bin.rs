//! The binary files of a COLMAP model, little endian: `cameras.bin`, `images.bin`, `points3D.bin`.
//!
//! Each starts with a 64-bit number of records. No number in the files is believed before the bytes it promises are
//! known to be there.

use super::colmap::{
    BINARY_FILES, ColmapModel, EXPORT_HINT, RawImage, add_camera, add_image, add_point, unknown_model,
};
use crate::camera::distortion::LensModel;
use crate::error::{Error, Result};
use std::collections::HashSet;
use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind, Read};
use std::path::Path;

/// Longest image name that is read; a name without its end is damage.
const MAX_NAME_BYTES: u64 = 4096;

/// Reads the binary model in the directory `dir`; `points3D.bin` may be missing.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] with the byte where reading stopped, [`Error::Unsupported`] for unknown camera models.
pub fn read(dir: &Path) -> Result<ColmapModel> {
    let [cameras, images, points] = BINARY_FILES.map(|file| dir.join(file));
    let mut model = ColmapModel::default();
    read_cameras(&cameras, &mut model)?;
    read_images(&images, &mut model)?;
    if points.exists() {
        read_points(&points, &mut model)?;
    }
    Ok(model)
}

fn read_cameras(path: &Path, model: &mut ColmapModel) -> Result<()> {
    let mut reader = BinReader::open(path)?;
    // Id, model, width, height and the three parameters of the smallest model.
    for _ in 0..reader.count("cameras", 4 + 4 + 8 + 8 + 3 * 8)? {
        let start = reader.offset;
        let id = reader.u32("a camera id")?;
        let model_id = reader.u32("a camera model")? as i32;
        let lens_model = LensModel::from_colmap_id(model_id)
            .ok_or_else(|| unknown_model(path, id, &format!("number {model_id}")))?;
        let size = [reader.u64("an image width")?, reader.u64("an image height")?];
        let mut params = [0.0; 12];
        let params = &mut params[..lens_model.num_params()];
        for param in params.iter_mut() {
            *param = reader.f64("a camera parameter")?;
        }
        add_camera(&mut model.cameras, id, lens_model, size, params)
            .map_err(|message| reader.error_at(start, &message))?;
    }
    reader.finish("cameras")
}

fn read_images(path: &Path, model: &mut ColmapModel) -> Result<()> {
    let mut reader = BinReader::open(path)?;
    let mut seen = HashSet::new();
    // Id, quaternion, translation, camera id, an empty name with its end, the number of points.
    for _ in 0..reader.count("images", 4 + 7 * 8 + 4 + 1 + 8)? {
        let start = reader.offset;
        let id = reader.u32("an image id")?;
        let mut pose = [0.0; 7];
        for value in &mut pose {
            *value = reader.f64("a pose")?;
        }
        let [w, x, y, z, tx, ty, tz] = pose;
        let camera_id = reader.u32("a camera id")?;
        let name = reader.name()?;
        let num_points = reader.count("2D points", 24)?;
        reader.skip(24 * num_points as u64)?;
        let image = RawImage { id, quat_wxyz: [w, x, y, z], translation: [tx, ty, tz], camera_id, name };
        add_image(model, &mut seen, image).map_err(|message| reader.error_at(start, &message))?;
    }
    reader.finish("images")
}

fn read_points(path: &Path, model: &mut ColmapModel) -> Result<()> {
    let mut reader = BinReader::open(path)?;
    // Id, position, colour, error, the number of observations.
    let count = reader.count("points", 8 + 3 * 8 + 3 + 8 + 8)?;
    model.points.positions.reserve(count);
    model.points.colors.reserve(count);
    for _ in 0..count {
        let record = reader.bytes::<43>("a point")?;
        let coordinate = |i: usize| {
            let mut bytes = [0; 8];
            bytes.copy_from_slice(&record[8 + 8 * i..16 + 8 * i]);
            f64::from_le_bytes(bytes)
        };
        add_point(model, [coordinate(0), coordinate(1), coordinate(2)], [record[32], record[33], record[34]]);
        let track = reader.count("observations", 8)?;
        reader.skip(8 * track as u64)?;
    }
    reader.finish("points")
}

/// A file read forwards that knows how much of it is left.
struct BinReader<'a> {
    path: &'a Path,
    reader: BufReader<File>,
    offset: u64,
    len: u64,
}

impl<'a> BinReader<'a> {
    fn open(path: &'a Path) -> Result<Self> {
        let io_error = |source| Error::io("read", path, source);
        let file = File::open(path).map_err(io_error)?;
        let metadata = file.metadata().map_err(io_error)?;
        if metadata.is_dir() {
            return Err(io_error(ErrorKind::IsADirectory.into()));
        }
        Ok(Self { path, reader: BufReader::with_capacity(1 << 16, file), offset: 0, len: metadata.len() })
    }

    fn remaining(&self) -> u64 {
        self.len.saturating_sub(self.offset)
    }

    fn error_at(&self, offset: u64, message: &str) -> Error {
        Error::format(self.path, format!("at byte {offset}: {message}"), EXPORT_HINT)
    }

    fn bytes<const N: usize>(&mut self, what: &str) -> Result<[u8; N]> {
        let mut bytes = [0; N];
        if self.remaining() < N as u64 {
            let message = format!(
                "the file ends inside {what}: expected {N} bytes, found {} (it has {} bytes in all)",
                self.remaining(),
                self.len
            );
            return Err(self.error_at(self.offset, &message));
        }
        self.reader.read_exact(&mut bytes).map_err(|source| Error::io("read", self.path, source))?;
        self.offset += N as u64;
        Ok(bytes)
    }

    fn u32(&mut self, what: &str) -> Result<u32> {
        self.bytes(what).map(u32::from_le_bytes)
    }

    fn u64(&mut self, what: &str) -> Result<u64> {
        self.bytes(what).map(u64::from_le_bytes)
    }

    fn f64(&mut self, what: &str) -> Result<f64> {
        self.bytes(what).map(f64::from_le_bytes)
    }

    /// A number of records of at least `min_bytes` each, all of which fit in the rest of the file.
    fn count(&mut self, what: &str, min_bytes: u64) -> Result<usize> {
        let start = self.offset;
        let count = self.u64(&format!("the number of {what}"))?;
        let room = self.remaining() / min_bytes;
        match usize::try_from(count) {
            Ok(fitting) if count <= room => Ok(fitting),
            _ => {
                let message = format!(
                    "{count} {what} are declared, the {} bytes that follow hold at most {room}",
                    self.remaining()
                );
                Err(self.error_at(start, &message))
            }
        }
    }

    /// Bytes up to a zero byte, as UTF-8.
    fn name(&mut self) -> Result<String> {
        let start = self.offset;
        let mut bytes = Vec::new();
        let read = self.reader.by_ref().take(MAX_NAME_BYTES).read_until(0, &mut bytes);
        self.offset += read.map_err(|source| Error::io("read", self.path, source))? as u64;
        if bytes.pop() != Some(0) {
            return Err(self.error_at(start, &format!("an image name has no end within {} bytes", bytes.len())));
        }
        String::from_utf8(bytes).map_err(|_| self.error_at(start, "an image name is not UTF-8"))
    }

    /// Steps over `num_bytes`, which are known to be there.
    fn skip(&mut self, num_bytes: u64) -> Result<()> {
        let distance = i64::try_from(num_bytes).map_err(|_| self.error_at(self.offset, "a record is too long"))?;
        self.reader.seek_relative(distance).map_err(|source| Error::io("read", self.path, source))?;
        self.offset += num_bytes;
        Ok(())
    }

    /// Checks that nothing follows: a number of records that is too small would lose the rest without a word.
    fn finish(self, what: &str) -> Result<()> {
        match self.remaining() {
            0 => Ok(()),
            rest => Err(self.error_at(self.offset, &format!("{rest} bytes follow the last of the declared {what}"))),
        }
    }
}
