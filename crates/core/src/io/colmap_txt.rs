//! The text files of a COLMAP model: `cameras.txt`, `images.txt`, `points3D.txt`.
//!
//! Fields are separated by blanks, `#` starts a comment line. In `images.txt` every image takes two lines, the second of
//! which, its 2D points, may be empty.

use super::colmap::{ColmapModel, EXPORT_HINT, RawImage, TEXT_FILES, add_camera, add_image, add_point, unknown_model};
use crate::camera::distortion::LensModel;
use crate::error::{Error, Result};
use std::collections::HashSet;
use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind};
use std::path::Path;
use std::str::FromStr;

/// Reads the text model in the directory `dir`; `points3D.txt` may be missing.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] with the line, [`Error::Unsupported`] for unknown camera models.
pub fn read(dir: &Path) -> Result<ColmapModel> {
    let [cameras, images, points] = TEXT_FILES.map(|file| dir.join(file));
    let mut model = ColmapModel::default();
    read_cameras(&cameras, &mut model)?;
    read_images(&images, &mut model)?;
    if points.exists() {
        read_points(&points, &mut model)?;
    }
    Ok(model)
}

fn read_cameras(path: &Path, model: &mut ColmapModel) -> Result<()> {
    let mut lines = Lines::open(path)?;
    while let Some(mut fields) = lines.next_record()? {
        let id = fields.parse("a camera id")?;
        let name = fields.next("a camera model")?;
        let lens_model = LensModel::from_name(name).ok_or_else(|| unknown_model(path, id, &format!("`{name}`")))?;
        let size = [fields.parse("an image width")?, fields.parse("an image height")?];
        let mut params = Vec::new();
        for i in 0..lens_model.num_params() {
            params.push(fields.parse(&format!("parameter {} of {} of {name}", i + 1, lens_model.num_params()))?);
        }
        fields.expect_end(&format!("the {} parameters of {name}", lens_model.num_params()))?;
        add_camera(&mut model.cameras, id, lens_model, size, &params).map_err(|message| fields.error(&message))?;
    }
    Ok(())
}

fn read_images(path: &Path, model: &mut ColmapModel) -> Result<()> {
    let mut lines = Lines::open(path)?;
    let mut seen = HashSet::new();
    while let Some(mut fields) = lines.next_record()? {
        let id = fields.parse("an image id")?;
        let quat_wxyz = fields.parse_array("a quaternion")?;
        let translation = fields.parse_array("a translation")?;
        let camera_id = fields.parse("a camera id")?;
        let name = fields.rest().to_owned();
        let image = RawImage { id, quat_wxyz, translation, camera_id, name };
        add_image(model, &mut seen, image).map_err(|message| fields.error(&message))?;
        lines.next_line()?;
    }
    Ok(())
}

fn read_points(path: &Path, model: &mut ColmapModel) -> Result<()> {
    let mut lines = Lines::open(path)?;
    while let Some(mut fields) = lines.next_record()? {
        fields.next("a point id")?;
        let position = fields.parse_array("a position")?;
        let color = fields.parse_array("a colour, 0 to 255,")?;
        fields.next("a reprojection error")?;
        add_point(model, position, color);
    }
    Ok(())
}

/// Lines of a file, one in memory at a time.
struct Lines<'a> {
    path: &'a Path,
    reader: BufReader<File>,
    line: String,
    number: usize,
}

impl<'a> Lines<'a> {
    fn open(path: &'a Path) -> Result<Self> {
        let file = File::open(path).map_err(|source| Error::io("read", path, source))?;
        Ok(Self { path, reader: BufReader::with_capacity(1 << 16, file), line: String::new(), number: 0 })
    }

    /// Reads the next line into `self.line`; false at the end of the file.
    fn next_line(&mut self) -> Result<bool> {
        self.line.clear();
        self.number += 1;
        match self.reader.read_line(&mut self.line) {
            Ok(num_bytes) => Ok(num_bytes > 0),
            Err(source) if source.kind() == ErrorKind::InvalidData => {
                Err(Error::format(self.path, format!("line {} is not UTF-8 text", self.number), EXPORT_HINT))
            }
            Err(source) => Err(Error::io("read", self.path, source)),
        }
    }

    /// The fields of the next line that is neither blank nor a comment.
    fn next_record(&mut self) -> Result<Option<Fields<'_>>> {
        loop {
            if !self.next_line()? {
                return Ok(None);
            }
            let text = self.line.trim_start_matches('\u{feff}').trim();
            if !text.is_empty() && !text.starts_with('#') {
                break;
            }
        }
        let rest = self.line.trim_start_matches('\u{feff}').trim();
        Ok(Some(Fields { path: self.path, number: self.number, rest }))
    }
}

/// What is left of a line.
struct Fields<'a> {
    path: &'a Path,
    number: usize,
    rest: &'a str,
}

impl<'a> Fields<'a> {
    fn error(&self, message: &str) -> Error {
        Error::format(self.path, format!("line {}: {message}", self.number), EXPORT_HINT)
    }

    fn next(&mut self, what: &str) -> Result<&'a str> {
        if self.rest.is_empty() {
            return Err(self.error(&format!("the line ends where {what} is expected")));
        }
        let (field, rest) = self.rest.split_once(char::is_whitespace).unwrap_or((self.rest, ""));
        self.rest = rest.trim_start();
        Ok(field)
    }

    fn parse<T: FromStr>(&mut self, what: &str) -> Result<T> {
        let field = self.next(what)?;
        field.parse().map_err(|_| self.error(&format!("found `{field}` where {what} is expected")))
    }

    fn parse_array<T: FromStr + Default + Copy, const N: usize>(&mut self, what: &str) -> Result<[T; N]> {
        let mut values = [T::default(); N];
        for value in &mut values {
            *value = self.parse(what)?;
        }
        Ok(values)
    }

    /// Everything that is left: names may contain blanks.
    fn rest(&mut self) -> &'a str {
        std::mem::take(&mut self.rest)
    }

    fn expect_end(&self, what: &str) -> Result<()> {
        if self.rest.is_empty() { Ok(()) } else { Err(self.error(&format!("`{}` follows {what}", self.rest))) }
    }
}
