//! The `transform_matrix` of a frame: checked, made rigid, turned to OpenCV axes.

use glam::{DMat3, DMat4, DVec3};
use serde_json::Value;

/// Largest difference of an entry to the nearest rotation that is taken for rounding. Text files with four digits stay
/// below 1e-3; a shear or a non-uniform scale that matters does not.
const MAX_SHEAR: f64 = 0.02;

/// Rigid world-from-camera transform with OpenCV axes of a camera-to-world matrix with OpenGL axes.
///
/// The rotation is replaced by the nearest orthonormal one. A uniform scale is divided out: exporters leave it there
/// when they scale a scene, and it changes neither the camera's position nor its rays.
///
/// # Errors
/// A sentence saying what is wrong with the matrix.
pub(super) fn world_from_camera(matrix: Option<&Value>) -> Result<DMat4, String> {
    let rows = parse(matrix)?;
    let columns = [0, 1, 2, 3].map(|c| DVec3::new(rows[0][c], rows[1][c], rows[2][c]));
    if !columns.iter().all(|column| column.as_vec3().is_finite()) {
        return Err("`transform_matrix` has an entry that is not finite".into());
    }
    let linear = DMat3::from_cols(columns[0], columns[1], columns[2]);
    let determinant = linear.determinant();
    if determinant < 0.0 {
        return Err("`transform_matrix` mirrors space (negative determinant), expected a rotation".into());
    }
    let scale = determinant.cbrt();
    // The threshold is far below any scale in use and far above what rounding leaves of a singular matrix.
    if scale < 1e-5 * linear.to_cols_array().iter().fold(f64::MIN_POSITIVE, |m, x| m.max(x.abs())) {
        return Err("`transform_matrix` is singular, expected a rotation".into());
    }
    let linear = linear * scale.recip();
    let rotation = nearest_rotation(linear);
    let shear = (rotation - linear).to_cols_array().iter().fold(0.0_f64, |m, x| m.max(x.abs()));
    if shear.is_nan() || shear > MAX_SHEAR {
        return Err(format!(
            "`transform_matrix` is sheared or scaled unevenly (off a rotation by {shear:.3}, at most {MAX_SHEAR})"
        ));
    }
    let opencv = DMat3::from_cols(rotation.x_axis, -rotation.y_axis, -rotation.z_axis);
    let mut transform = DMat4::from_mat3(opencv);
    transform.w_axis = columns[3].extend(1.0);
    Ok(transform)
}

/// Rows of a 3×4 or 4×4 matrix.
fn parse(matrix: Option<&Value>) -> Result<Vec<[f64; 4]>, String> {
    let Some(matrix) = matrix else { return Err("the key `transform_matrix` is missing".into()) };
    let wrong_shape = || "`transform_matrix` is no array of 3 or 4 rows of 4 numbers".to_owned();
    let rows = matrix.as_array().filter(|rows| matches!(rows.len(), 3 | 4)).ok_or_else(wrong_shape)?;
    let parse_row = |row: &Value| {
        let entries: Option<Vec<f64>> = row.as_array()?.iter().map(Value::as_f64).collect();
        <[f64; 4]>::try_from(entries?).ok()
    };
    let rows: Vec<[f64; 4]> = rows.iter().map(parse_row).collect::<Option<_>>().ok_or_else(wrong_shape)?;
    if let Some(last) = rows.get(3)
        && last.iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(found, expected)| (found - expected).abs() > 1e-3)
    {
        return Err(format!("the last row of `transform_matrix` is {last:?}, expected [0, 0, 0, 1]"));
    }
    Ok(rows)
}

/// The rotation of the polar decomposition (Higham 1986): the mean of a matrix and its inverse transpose, repeated.
fn nearest_rotation(linear: DMat3) -> DMat3 {
    let mut rotation = linear;
    for _ in 0..30 {
        rotation = (rotation + rotation.inverse().transpose()) * 0.5;
    }
    rotation
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn matrix(linear: DMat3) -> Value {
        let r = linear.transpose().to_cols_array_2d();
        json!([
            [r[0][0], r[0][1], r[0][2], 1.0],
            [r[1][0], r[1][1], r[1][2], 2.0],
            [r[2][0], r[2][1], r[2][2], 3.0],
            [0, 0, 0, 1]
        ])
    }

    #[test]
    fn opengl_identity_looks_along_minus_z() {
        let pose = world_from_camera(Some(&matrix(DMat3::IDENTITY))).unwrap();
        assert_eq!(pose.transform_vector3(DVec3::Z), -DVec3::Z);
        assert_eq!(pose.transform_vector3(DVec3::Y), -DVec3::Y);
        assert_eq!(pose.w_axis.truncate(), DVec3::new(1.0, 2.0, 3.0));
    }

    #[test]
    fn uniform_scale_and_rounding_are_removed() {
        let rotation = DMat3::from_axis_angle(DVec3::new(1.0, 2.0, 2.0) / 3.0, 0.7);
        let expected = world_from_camera(Some(&matrix(rotation))).unwrap();
        let rounded = DMat3::from_cols_array(&rotation.to_cols_array().map(|x| (x * 1e4).round() / 1e4));
        let found = world_from_camera(Some(&matrix(rounded * 0.01))).unwrap();
        assert!(found.abs_diff_eq(expected, 1e-3));
        assert!((DMat3::from_mat4(found).determinant() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn matrices_that_are_no_pose_are_refused() {
        let mirrored = DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0));
        let uneven = DMat3::from_diagonal(DVec3::new(1.0, 1.2, 1.0));
        for (linear, word) in [(mirrored, "mirrors"), (uneven, "unevenly"), (DMat3::ZERO, "singular")] {
            let message = world_from_camera(Some(&matrix(linear))).unwrap_err();
            assert!(message.contains(word), "{message}");
        }
        assert!(world_from_camera(None).unwrap_err().contains("missing"));
        assert!(world_from_camera(Some(&json!([[1, 0, 0], [0, 1, 0], [0, 0, 1]]))).unwrap_err().contains("rows of 4"));
        let overflow = json!([[1e300, 0, 0, 0], [0, 1e300, 0, 0], [0, 0, 1e300, 0]]);
        assert!(world_from_camera(Some(&overflow)).unwrap_err().contains("finite"));
        let tail = json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 2]]);
        assert!(world_from_camera(Some(&tail)).unwrap_err().contains("last row"));
    }
}
