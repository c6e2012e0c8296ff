//! Writers that leave nothing half-written under the final name.

use crate::error::{Error, Result};
use crate::image::RgbImage8;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

/// Writes the file `path` through `write`, atomically: into a temporary file of the same directory, synced to disk,
/// then renamed. On any error the temporary file is removed and a file that was there before stays as it was.
///
/// # Errors
/// [`Error::Io`] when the directory is missing or cannot be written, or when `write` fails.
pub fn write_atomically(
    path: impl AsRef<Path>,
    write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<()> {
    write_and_rename(path.as_ref(), true, write)
}

/// Writes `image` as an 8-bit RGB PNG, atomically. Unlike [`write_atomically`] it does not wait for the disk: frames
/// are written by the hundred and can be rendered again.
///
/// # Errors
/// [`Error::Io`] as in [`write_atomically`]; [`Error::Parameter`] when `image.data` does not have the declared size.
pub fn save_png(path: impl AsRef<Path>, image: &RgbImage8) -> Result<()> {
    image.validate()?;
    write_and_rename(path.as_ref(), false, |out| {
        use ::image::ImageEncoder as _;
        ::image::codecs::png::PngEncoder::new(out)
            .write_image(&image.data, image.width, image.height, ::image::ExtendedColorType::Rgb8)
            .map_err(|error| match error {
                ::image::ImageError::IoError(error) => error,
                other => io::Error::other(other),
            })
    })
}

fn write_and_rename(path: &Path, sync: bool, write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>) -> Result<()> {
    let directory = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let mut builder = tempfile::Builder::new();
    builder.prefix(".").suffix(".part");
    // Temporary files are private by default; this one becomes an ordinary file, for which the umask decides.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let temporary = builder.tempfile_in(directory).map_err(|source| Error::io("create", path, source))?;
    let (file, temporary_path) = temporary.into_parts();
    let mut out = BufWriter::with_capacity(1 << 18, file);
    let written = write(&mut out).and_then(|()| out.flush()).and_then(|()| match sync {
        true => out.get_ref().sync_all(),
        false => Ok(()),
    });
    written.map_err(|source| Error::io("write", path, source))?;
    drop(out);
    temporary_path.persist(path).map_err(|failure| Error::io("write", path, failure.error))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn failed_write_keeps_the_old_file_and_leaves_no_other() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.txt");
        write_atomically(&path, |out| out.write_all(b"old")).unwrap();
        let error = write_atomically(&path, |out| {
            out.write_all(b"ne")?;
            Err(io::Error::from(io::ErrorKind::StorageFull))
        });
        assert!(error.unwrap_err().hint().is_some());
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn missing_directory_and_directory_in_the_way_are_errors() {
        let dir = tempfile::tempdir().unwrap();
        assert!(write_atomically(dir.path().join("no/such/x"), |_| Ok(())).is_err());
        std::fs::create_dir(dir.path().join("d")).unwrap();
        std::fs::write(dir.path().join("d/inside"), b"x").unwrap();
        assert!(write_atomically(dir.path().join("d"), |_| Ok(())).is_err());
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[cfg(unix)]
    #[test]
    fn written_files_have_the_permissions_of_ordinary_files() {
        use std::os::unix::fs::PermissionsExt;
        let dir = tempfile::tempdir().unwrap();
        File::create(dir.path().join("plain")).unwrap();
        write_atomically(dir.path().join("ours"), |_| Ok(())).unwrap();
        let mode = |name: &str| std::fs::metadata(dir.path().join(name)).unwrap().permissions().mode();
        assert_eq!(mode("plain"), mode("ours"));
    }

    #[test]
    fn png_round_trip_is_exact() {
        let dir = tempfile::tempdir().unwrap();
        let image = RgbImage8 { width: 3, height: 2, data: (0..18).map(|i| i * 14).collect() };
        save_png(dir.path().join("x.png"), &image).unwrap();
        assert_eq!(crate::io::images::decode_rgb(dir.path().join("x.png")).unwrap(), image);
        let broken = RgbImage8 { data: vec![0; 5], ..image };
        assert!(matches!(save_png(dir.path().join("y.png"), &broken), Err(Error::Parameter { .. })));
        assert!(!dir.path().join("y.png").exists());
    }
}
