//! Projection of one Gaussian, float64.

use super::{ALPHA_MIN, Camera, Cutoff, Gaussians, Options};

/// A Gaussian on the image plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projected {
    /// Index of the Gaussian.
    pub index: u32,
    /// Centre in pixels.
    pub mean2d: [f64; 2],
    /// Covariance in pixels², dilated by 0.3: xx, xy, yy.
    pub cov2d: [f64; 3],
    /// Inverse of `cov2d`: xx, xy, yy.
    pub conic: [f64; 3],
    /// Depth along the optical axis.
    pub depth: f64,
    /// Opacity in (0, 1), compensated where asked for.
    pub opacity: f64,
    /// Colour of its SH seen from the camera.
    pub color: [f64; 3],
}

type Mat3 = [[f64; 3]; 3];

fn product(a: &Mat3, b: &Mat3) -> Mat3 {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

fn apply(a: &Mat3, v: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| (0..3).map(|k| a[i][k] * v[k]).sum())
}

fn inverse(m: &Mat3) -> Mat3 {
    let minor = |r: usize, c: usize| {
        let (r1, r2, c1, c2) = ((r + 1) % 3, (r + 2) % 3, (c + 1) % 3, (c + 2) % 3);
        m[r1][c1] * m[r2][c2] - m[r1][c2] * m[r2][c1]
    };
    let det: f64 = (0..3).map(|c| m[0][c] * minor(0, c)).sum();
    std::array::from_fn(|i| std::array::from_fn(|j| minor(j, i) / det))
}

fn rotation([w, x, y, z]: [f64; 4]) -> Mat3 {
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// Centre of the camera in world coordinates, −R⁻¹ t: the inverse, so that a rotation rounded to float32 is met exactly.
fn camera_center(camera: &Camera) -> [f64; 3] {
    let m = &camera.camera_from_world;
    let r: Mat3 = std::array::from_fn(|i| std::array::from_fn(|j| m[i][j]));
    apply(&inverse(&r), [m[0][3], m[1][3], m[2][3]]).map(|v| -v)
}

/// Projects Gaussian `i`; `None` when it is culled.
pub fn project(gaussians: &Gaussians, i: usize, camera: &Camera, options: &Options) -> Option<Projected> {
    let m = &camera.camera_from_world;
    let w: Mat3 = std::array::from_fn(|r| std::array::from_fn(|c| m[r][c]));
    let mean = gaussians.means[i];
    let rotated = apply(&w, mean);
    let [x, y, z] = [rotated[0] + m[0][3], rotated[1] + m[1][3], rotated[2] + m[2][3]];
    let quat = gaussians.quats[i];
    let squared: f64 = quat.iter().map(|q| q * q).sum();
    let stored = gaussians.num_coefficients;
    let sh = &gaussians.sh[i * stored..(i + 1) * stored];
    let parameters = mean.iter().chain(&quat).chain(&gaussians.log_scales[i]).chain(sh.iter().flatten());
    let all_finite = parameters.chain([&gaussians.opacity_logits[i]]).all(|v| v.is_finite());
    if !all_finite || z.is_nan() || z <= options.near || squared < 1e-6 {
        return None;
    }

    // Σ = R diag(s²) Rᵀ (Kerbl 2023, Eq. 6), in camera axes W Σ Wᵀ.
    let r = rotation(quat.map(|q| q / squared.sqrt()));
    let s = gaussians.log_scales[i].map(f64::exp);
    let m_scaled: Mat3 = std::array::from_fn(|a| std::array::from_fn(|b| r[a][b] * s[b]));
    let half = product(&w, &m_scaled);

    // J of EWA (Zwicker 2001, Eq. 29) at x/z, y/z clamped to the image and 15 % around it.
    let size = [camera.width as f64, camera.height as f64];
    let slope: [f64; 2] = std::array::from_fn(|a| {
        let low = -(0.15 * size[a] + camera.center[a]) / camera.focal[a];
        let high = (1.15 * size[a] - camera.center[a]) / camera.focal[a];
        ([x, y][a] / z).clamp(low, high)
    });
    let [fx, fy] = camera.focal;
    let j = [[fx / z, 0.0, -fx * slope[0] / z], [0.0, fy / z, -fy * slope[1] / z]];
    let jm: [[f64; 3]; 2] =
        std::array::from_fn(|a| std::array::from_fn(|b| (0..3).map(|k| j[a][k] * half[k][b]).sum()));
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let raw = [dot(jm[0], jm[0]), dot(jm[0], jm[1]), dot(jm[1], jm[1])];
    let cov2d = [raw[0] + 0.3, raw[1], raw[2] + 0.3];
    // Σ'_raw has determinant |jm₀ × jm₁|²; written like that nothing cancels for needles.
    let cross: [f64; 3] = std::array::from_fn(|a| {
        let (b, c) = ((a + 1) % 3, (a + 2) % 3);
        jm[0][b] * jm[1][c] - jm[0][c] * jm[1][b]
    });
    let det_raw = dot(cross, cross);
    let det = det_raw + 0.3 * (raw[0] + raw[2]) + 0.09;
    let conic = [cov2d[2] / det, -cov2d[1] / det, cov2d[0] / det];

    let mut opacity = 1.0 / (1.0 + (-gaussians.opacity_logits[i]).exp());
    if options.antialiased {
        opacity *= (det_raw / det).max(0.005f64.powi(2)).sqrt();
    }
    let below_cut = options.cutoff == Cutoff::Hard && opacity < ALPHA_MIN;
    if det <= 1e-6 || below_cut || !conic.iter().chain(&cov2d).all(|v| v.is_finite()) {
        return None;
    }

    let center = camera_center(camera);
    let offset: [f64; 3] = std::array::from_fn(|a| mean[a] - center[a]);
    let length = dot(offset, offset).sqrt();
    let basis = sh_basis(options.sh_degree, if length > 0.0 { offset.map(|v| v / length) } else { [0.0; 3] });
    let color = std::array::from_fn(|c| {
        let value: f64 = basis.iter().zip(sh).map(|(b, coefficient)| b * coefficient[c]).sum();
        (value + 0.5).max(0.0)
    });
    let mean2d = [fx * x / z + camera.center[0], fy * y / z + camera.center[1]];
    let index = u32::try_from(i).expect("scenes of tests are small");
    Some(Projected { index, mean2d, cov2d, conic, depth: z, opacity, color })
}

/// Real SH basis up to `degree` ≤ 4 at the unit vector (x, y, z), order and signs of the 3DGS PLY format.
pub fn sh_basis(degree: u32, [x, y, z]: [f64; 3]) -> Vec<f64> {
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let mut basis = vec![0.282_094_791_773_878_14];
    if degree >= 1 {
        basis.extend([-y, z, -x].map(|v| 0.488_602_511_902_919_9 * v));
    }
    if degree >= 2 {
        basis.extend([
            1.092_548_430_592_079_2 * x * y,
            -1.092_548_430_592_079_2 * y * z,
            0.315_391_565_252_520_05 * (2.0 * zz - xx - yy),
            -1.092_548_430_592_079_2 * x * z,
            0.546_274_215_296_039_6 * (xx - yy),
        ]);
    }
    if degree >= 3 {
        basis.extend([
            -0.590_043_589_926_643_5 * y * (3.0 * xx - yy),
            2.890_611_442_640_554 * x * y * z,
            -0.457_045_799_464_465_8 * y * (4.0 * zz - xx - yy),
            0.373_176_332_590_115_4 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -0.457_045_799_464_465_8 * x * (4.0 * zz - xx - yy),
            1.445_305_721_320_277 * z * (xx - yy),
            -0.590_043_589_926_643_5 * x * (xx - 3.0 * yy),
        ]);
    }
    if degree >= 4 {
        basis.extend([
            2.503_342_941_796_704_6 * x * y * (xx - yy),
            -1.770_130_769_779_930_4 * y * z * (3.0 * xx - yy),
            0.946_174_695_757_560_1 * x * y * (7.0 * zz - 1.0),
            -0.669_046_543_557_289_2 * y * z * (7.0 * zz - 3.0),
            0.105_785_546_915_204_31 * (zz * (35.0 * zz - 30.0) + 3.0),
            -0.669_046_543_557_289_2 * x * z * (7.0 * zz - 3.0),
            0.473_087_347_878_780_04 * (xx - yy) * (7.0 * zz - 1.0),
            -1.770_130_769_779_930_4 * x * z * (xx - 3.0 * yy),
            0.625_835_735_449_176_1 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)),
        ]);
    }
    basis
}

#[cfg(test)]
mod tests {
    use super::*;

    fn transposed(a: &Mat3) -> Mat3 {
        std::array::from_fn(|i| std::array::from_fn(|j| a[j][i]))
    }

    #[test]
    fn rotation_is_orthogonal_and_inverse_is_its_transpose() {
        let r = rotation([0.5, -0.1, 0.7, 0.5]);
        for (row, expected) in
            product(&r, &transposed(&r)).iter().zip([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        {
            for (a, b) in row.iter().zip(expected) {
                assert!((a - b).abs() < 1e-12);
            }
        }
        let (i, t) = (inverse(&r), transposed(&r));
        assert!((0..9).all(|k| (i[k / 3][k % 3] - t[k / 3][k % 3]).abs() < 1e-12));
    }
}
