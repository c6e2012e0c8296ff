//! Sparse points: `x y z` with or without colours, the usual initialisation of a training run.

use super::fallback::for_each_row;
use super::header::Header;
use crate::color::to_u8;
use crate::dataset::SparsePoints;
use crate::error::{Error, Result};
use crate::io::file_bytes::FileBytes;
use crate::sh;
use ply_rs_bw::ply::{PropertyType, ScalarType};
use std::path::Path;

/// Colour of points whose file has none.
const GREY: [u8; 3] = [128; 3];

/// Where the colour of a point comes from.
enum Color {
    None,
    /// Columns and the factor that brings their values to 0..1.
    Rgb([usize; 3], f32),
    /// DC coefficients of a Gaussian model.
    Dc([usize; 3]),
}

/// Reads a point cloud: positions and colours (`red green blue`, `r g b` or `diffuse_*`, 8 or 16 bits or floats in 0..1; the
/// DC colour of a Gaussian model; grey if there is none). Points with a non-finite coordinate are left out.
///
/// # Errors
///
/// [`Error::Io`] when the file cannot be read; [`Error::Format`] when it is no PLY, has no `x y z` or is truncated.
pub fn load_points(path: impl AsRef<Path>) -> Result<SparsePoints> {
    let path = path.as_ref();
    let bytes = FileBytes::open(path)?;
    let header = Header::parse(path, &bytes)?;
    let missing: Vec<&str> = ["x", "y", "z"].into_iter().filter(|name| header.column(name).is_none()).collect();
    if !missing.is_empty() {
        let message = format!("vertex attributes missing: {}", missing.join(", "));
        return Err(Error::format(path, message, "a point cloud needs x, y and z"));
    }
    let position = ["x", "y", "z"].map(|name| header.column(name).expect("checked above"));
    let color = find_color(&header);

    let mut points = SparsePoints::default();
    for_each_row(path, &bytes, &header, |_, values| {
        let at = |columns: [usize; 3]| columns.map(|column| values[column]);
        let p = at(position);
        if p.iter().all(|v| v.is_finite()) {
            points.positions.push(p);
            points.colors.push(match color {
                Color::None => GREY,
                Color::Rgb(columns, scale) => at(columns).map(|v| to_u8(v * scale)),
                Color::Dc(columns) => at(columns).map(|v| to_u8(sh::color_from_dc(v))),
            });
        }
    })?;
    Ok(points)
}

fn find_color(header: &Header) -> Color {
    let columns = |names: [&str; 3]| -> Option<[usize; 3]> {
        let [r, g, b] = names.map(|name| header.column(name));
        Some([r?, g?, b?])
    };
    let rgb = columns(["red", "green", "blue"])
        .or_else(|| columns(["r", "g", "b"]))
        .or_else(|| columns(["diffuse_red", "diffuse_green", "diffuse_blue"]));
    if let Some(rgb) = rgb {
        let scale = match header.vertex.properties[rgb[0]].data_type {
            PropertyType::Scalar(ScalarType::Float | ScalarType::Double) => 1.0,
            PropertyType::Scalar(ScalarType::Short | ScalarType::UShort) => 1.0 / 65_535.0,
            _ => 1.0 / 255.0,
        };
        return Color::Rgb(rgb, scale);
    }
    columns(["f_dc_0", "f_dc_1", "f_dc_2"]).map_or(Color::None, Color::Dc)
}
