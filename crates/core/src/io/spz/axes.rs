//! Mirroring a model: the same Gaussians with some axes of the world pointing the other way.

use crate::gaussian_cloud::GaussianCloud;

/// Where +x, +y and +z point, +1 for right, up and back.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Axes([f32; 3]);

impl Axes {
    /// Right, down, forward: OpenCV, 3DGS PLY.
    pub const RDF: Self = Self([1.0, -1.0, -1.0]);

    /// The system with this number in the extension of the format that names one: 1 to 8, a bit per axis. `None` for those
    /// that are turned as well (9 to 16) and for numbers without a meaning.
    pub fn of_number(number: u32) -> Option<Self> {
        let bits = number.checked_sub(1).filter(|bits| *bits < 8)?;
        let sign = |bit: u32, of_set: f32| if bits >> bit & 1 == 1 { of_set } else { -of_set };
        // Set bits stand for right, up and forward.
        Some(Self([sign(0, 1.0), sign(1, 1.0), sign(2, -1.0)]))
    }

    /// Factors of the coordinates on the way from these axes to `other`.
    pub fn signs_to(self, other: Self) -> [f32; 3] {
        [0, 1, 2].map(|axis| self.0[axis] * other.0[axis])
    }
}

/// Multiplies the coordinates of the world by `signs`, each ±1.
///
/// A rotation R becomes M R M with M = diag(signs): its axis is turned as an axial vector. A real spherical harmonic
/// Y_lm is (up to its norm) a polynomial in z of parity l − |m| times the real (m ≥ 0) or imaginary (m < 0) part of
/// (x + i y)^|m|, so that each axis turns its sign by the parity of its powers.
pub(super) fn flip(cloud: &mut GaussianCloud, signs: [f32; 3]) {
    if signs == [1.0; 3] {
        return;
    }
    let [sx, sy, sz] = signs;
    for mean in &mut cloud.means {
        *mean = [mean[0] * sx, mean[1] * sy, mean[2] * sz];
    }
    for [_, x, y, z] in &mut cloud.quats {
        (*x, *y, *z) = (*x * sy * sz, *y * sx * sz, *z * sx * sy);
    }
    let of_coefficient: Vec<f32> = (0..=cloud.sh_degree as i32)
        .flat_map(|l| (-l..=l).map(move |m| (l, m)))
        .map(|(l, m)| {
            let along_z = sz.powi(l - m.abs());
            along_z * if m < 0 { sy * sx.powi(-m - 1) } else { sx.powi(m) }
        })
        .collect();
    for row in cloud.sh.chunks_exact_mut(of_coefficient.len()) {
        for (coefficient, sign) in row.iter_mut().zip(&of_coefficient) {
            *coefficient = coefficient.map(|v| v * sign);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_mean_what_their_bits_say() {
        assert_eq!(Axes::of_number(4), Some(Axes([1.0; 3])));
        assert_eq!(Axes::of_number(6), Some(Axes::RDF));
        assert_eq!(Axes::of_number(1), Some(Axes([-1.0, -1.0, 1.0])), "left, down, back");
        assert_eq!([0, 9, 16, 17].map(Axes::of_number), [None; 4]);
    }

    /// The basis of degree 2 with the signs of the 3DGS format, from its definition (Sloan 2008), without norms.
    fn basis([x, y, z]: [f32; 3]) -> [f32; 9] {
        [1.0, -y, z, -x, x * y, -y * z, 2.0 * z * z - x * x - y * y, -x * z, x * x - y * y]
    }

    #[test]
    fn mirrored_harmonics_show_the_same_colour_from_the_mirrored_side() {
        for signs in [[1.0, -1.0, -1.0], [-1.0, 1.0, 1.0], [-1.0, -1.0, 1.0], [1.0, 1.0, -1.0]] {
            let mut cloud = GaussianCloud::zeros(1, 2);
            (0..9).for_each(|k| cloud.sh[k] = [0.3 * k as f32 - 1.0, 1.0, -0.1 * k as f32]);
            let before = cloud.clone();
            flip(&mut cloud, signs);
            let direction = [0.36, 0.48, -0.8];
            let mirrored = [0, 1, 2].map(|axis| direction[axis] * signs[axis]);
            for channel in 0..3 {
                let color = |cloud: &GaussianCloud, d| -> f32 {
                    cloud.sh.iter().zip(basis(d)).map(|(c, y)| c[channel] * y).sum()
                };
                assert!((color(&before, direction) - color(&cloud, mirrored)).abs() < 1e-6, "{signs:?}");
            }
            flip(&mut cloud, signs);
            assert_eq!(cloud, before, "twice is not at all");
        }
    }

    #[test]
    fn mirrored_rotations_turn_mirrored_vectors() {
        let quat = glam::Quat::from_xyzw(0.3, -0.5, 0.2, 0.7).normalize();
        for signs in [[1.0, -1.0, -1.0], [-1.0, 1.0, 1.0], [1.0, -1.0, 1.0]] {
            let mut cloud = GaussianCloud::zeros(1, 0);
            cloud.quats[0] = [quat.w, quat.x, quat.y, quat.z];
            flip(&mut cloud, signs);
            let [w, x, y, z] = cloud.quats[0];
            let m = glam::Vec3::from(signs);
            let v = glam::Vec3::new(0.1, 0.7, -0.4);
            let expected = m * (quat * (m * v));
            assert!((glam::Quat::from_xyzw(x, y, z, w) * v - expected).length() < 1e-6, "{signs:?}");
        }
    }
}
