//! A 3D Gaussian model as host data, exactly as the 3DGS PLY format stores it.

use crate::error::{Error, Result};
use glam::Vec3;

/// N Gaussians with spherical-harmonics colour.
///
/// Values are stored as they are optimised: scales as natural logarithms, opacities as logits, quaternions (w, x, y, z)
/// unnormalised. All vectors have the same number of rows N; `sh` has N · (sh_degree + 1)² rows.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct GaussianCloud {
    /// Centres, `[N, 3]`, world units.
    pub means: Vec<[f32; 3]>,
    /// Rotations (w, x, y, z), `[N, 4]`, any non-zero length.
    pub quats: Vec<[f32; 4]>,
    /// Natural logarithms of the three standard deviations, `[N, 3]`.
    pub log_scales: Vec<[f32; 3]>,
    /// Logits of the opacities, `[N]`.
    pub opacity_logits: Vec<f32>,
    /// Degree of the spherical harmonics, 0 to 4.
    pub sh_degree: u32,
    /// SH coefficients, `[N, (sh_degree + 1)², 3]`: Gaussian-major, then coefficient, then RGB.
    pub sh: Vec<[f32; 3]>,
}

impl GaussianCloud {
    /// N Gaussians with all values 0, the shape of `sh_degree`.
    pub fn zeros(num_gaussians: usize, sh_degree: u32) -> Self {
        Self {
            means: vec![[0.0; 3]; num_gaussians],
            quats: vec![[0.0; 4]; num_gaussians],
            log_scales: vec![[0.0; 3]; num_gaussians],
            opacity_logits: vec![0.0; num_gaussians],
            sh_degree,
            sh: vec![[0.0; 3]; num_gaussians * crate::sh::num_coefficients(sh_degree)],
        }
    }

    /// Number of Gaussians N.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// True when there is no Gaussian.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// SH coefficients per Gaussian and colour channel: (degree + 1)².
    pub fn num_coefficients(&self) -> usize {
        crate::sh::num_coefficients(self.sh_degree)
    }

    /// SH coefficients of Gaussian `index`, `[(sh_degree + 1)², 3]`.
    ///
    /// # Panics
    ///
    /// If `index` is not below [`GaussianCloud::len`].
    pub fn sh_of(&self, index: usize) -> &[[f32; 3]] {
        let k = self.num_coefficients();
        &self.sh[index * k..(index + 1) * k]
    }

    /// The Gaussians at `indices`, in that order; repeated indices repeat the Gaussian.
    ///
    /// # Panics
    ///
    /// If an index is not below [`GaussianCloud::len`].
    pub fn select(&self, indices: &[usize]) -> Self {
        Self {
            means: indices.iter().map(|&i| self.means[i]).collect(),
            quats: indices.iter().map(|&i| self.quats[i]).collect(),
            log_scales: indices.iter().map(|&i| self.log_scales[i]).collect(),
            opacity_logits: indices.iter().map(|&i| self.opacity_logits[i]).collect(),
            sh_degree: self.sh_degree,
            sh: indices.iter().flat_map(|&i| self.sh_of(i).iter().copied()).collect(),
        }
    }

    /// The same Gaussians with SH of `degree`: higher coefficients are cut off, missing ones are 0.
    pub fn with_sh_degree(&self, degree: u32) -> Self {
        let k = crate::sh::num_coefficients(degree);
        let kept = k.min(self.num_coefficients());
        let mut sh = vec![[0.0; 3]; self.len() * k];
        for (index, row) in sh.chunks_exact_mut(k).enumerate() {
            row[..kept].copy_from_slice(&self.sh_of(index)[..kept]);
        }
        Self { sh_degree: degree, sh, ..self.clone() }
    }

    /// Lowest SH degree that holds every coefficient that is not 0.
    pub fn highest_nonzero_degree(&self) -> u32 {
        let rows = self.sh.chunks_exact(self.num_coefficients());
        let last = rows.filter_map(|row| row.iter().rposition(|c| *c != [0.0; 3])).max().unwrap_or(0);
        (0..self.sh_degree).find(|&degree| crate::sh::num_coefficients(degree) > last).unwrap_or(self.sh_degree)
    }

    /// This cloud followed by `other`, with the higher of the two SH degrees.
    pub fn concat(&self, other: &Self) -> Self {
        let degree = self.sh_degree.max(other.sh_degree);
        let mut joined = self.with_sh_degree(degree);
        joined.means.extend_from_slice(&other.means);
        joined.quats.extend_from_slice(&other.quats);
        joined.log_scales.extend_from_slice(&other.log_scales);
        joined.opacity_logits.extend_from_slice(&other.opacity_logits);
        joined.sh.extend_from_slice(&other.with_sh_degree(degree).sh);
        joined
    }

    /// Smallest and largest coordinates of the centres; `None` for an empty cloud. NaN coordinates are passed over.
    pub fn bounds(&self) -> Option<(Vec3, Vec3)> {
        let first = Vec3::from(*self.means.first()?);
        Some(self.means.iter().fold((first, first), |(low, high), &mean| {
            let mean = Vec3::from(mean);
            (low.min(mean), high.max(mean))
        }))
    }

    /// True when every stored value of Gaussian `index` is finite and its quaternion has a direction.
    ///
    /// # Panics
    ///
    /// If `index` is not below [`GaussianCloud::len`].
    pub fn is_row_valid(&self, index: usize) -> bool {
        let finite = |values: &[f32]| values.iter().all(|v| v.is_finite());
        finite(&self.means[index])
            && finite(&self.quats[index])
            && finite(&self.log_scales[index])
            && self.opacity_logits[index].is_finite()
            && finite(self.sh_of(index).as_flattened())
            && self.quats[index] != [0.0; 4]
    }

    /// Checks that all vectors have the rows they should have.
    ///
    /// # Errors
    ///
    /// [`Error::Parameter`] naming the vector with the wrong number of rows.
    pub fn validate_shape(&self) -> Result<()> {
        let n = self.len();
        if self.sh_degree > crate::sh::MAX_DEGREE {
            let max = crate::sh::MAX_DEGREE;
            return Err(Error::parameter("sh_degree", format!("found {}, expected 0 to {max}", self.sh_degree)));
        }
        let rows = [
            ("quats", self.quats.len(), n),
            ("log_scales", self.log_scales.len(), n),
            ("opacity_logits", self.opacity_logits.len(), n),
            ("sh", self.sh.len(), n * self.num_coefficients()),
        ];
        match rows.into_iter().find(|(_, found, expected)| found != expected) {
            Some((name, found, expected)) => Err(Error::parameter(
                name,
                format!("found {found} rows, expected {expected} for {n} Gaussians of SH degree {}", self.sh_degree),
            )),
            None => Ok(()),
        }
    }

    /// Checks the shape, that all values are finite and that no quaternion is zero.
    ///
    /// # Errors
    ///
    /// [`Error::Parameter`] naming the vector with the wrong number of rows, or the first bad Gaussian.
    pub fn validate(&self) -> Result<()> {
        self.validate_shape()?;
        match (0..self.len()).find(|&index| !self.is_row_valid(index)) {
            Some(index) => {
                Err(Error::parameter(format!("Gaussian {index}"), "a value is not finite or the quaternion is zero"))
            }
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud(n: usize, degree: u32) -> GaussianCloud {
        let mut cloud = GaussianCloud::zeros(n, degree);
        for i in 0..n {
            cloud.means[i] = [i as f32, -(i as f32), 0.5];
            cloud.quats[i] = [1.0, 0.0, 0.0, i as f32];
            cloud.opacity_logits[i] = i as f32;
        }
        let k = cloud.num_coefficients();
        for (j, row) in cloud.sh.iter_mut().enumerate() {
            *row = [(j / k) as f32, (j % k) as f32, 1.0];
        }
        cloud
    }

    #[test]
    fn select_keeps_rows_together() {
        let picked = cloud(5, 2).select(&[3, 0, 3]);
        assert_eq!(picked.means, [[3.0, -3.0, 0.5], [0.0, 0.0, 0.5], [3.0, -3.0, 0.5]]);
        assert_eq!(picked.sh_of(2), cloud(5, 2).sh_of(3));
        assert!(picked.validate().is_ok());
    }

    #[test]
    fn concat_raises_to_the_higher_degree() {
        let joined = cloud(2, 1).concat(&cloud(3, 3));
        assert_eq!((joined.len(), joined.sh_degree), (5, 3));
        assert!(joined.validate().is_ok());
        assert_eq!(&joined.sh_of(1)[..4], cloud(2, 1).sh_of(1));
        assert!(joined.sh_of(1)[4..].iter().all(|&c| c == [0.0; 3]));
        assert_eq!(joined.sh_of(4), cloud(3, 3).sh_of(2));
    }

    #[test]
    fn lower_degree_cuts_and_higher_pads() {
        let c = cloud(3, 2);
        assert_eq!(c.with_sh_degree(4).with_sh_degree(2), c);
        assert_eq!(c.with_sh_degree(0).sh_of(2), &c.sh_of(2)[..1]);
    }

    #[test]
    fn highest_degree_in_use_is_found() {
        for degree in 0..=3 {
            assert_eq!(cloud(3, degree).highest_nonzero_degree(), degree);
            assert_eq!(cloud(3, degree).with_sh_degree(4).highest_nonzero_degree(), degree);
        }
        let mut sparse = GaussianCloud::zeros(5, 3);
        assert_eq!(sparse.highest_nonzero_degree(), 0);
        sparse.sh[2 * 16 + 4] = [0.0, -1.0, 0.0];
        assert_eq!(sparse.highest_nonzero_degree(), 2);
        assert_eq!(GaussianCloud::zeros(0, 3).highest_nonzero_degree(), 0);
    }

    #[test]
    fn bounds_enclose_the_centres() {
        assert_eq!(cloud(4, 0).bounds(), Some((Vec3::new(0.0, -3.0, 0.5), Vec3::new(3.0, 0.0, 0.5))));
        assert_eq!(GaussianCloud::default().bounds(), None);
    }

    #[test]
    fn validate_names_what_is_wrong() {
        let mut c = cloud(3, 1);
        c.sh.pop();
        assert!(c.validate().expect_err("rows differ").to_string().contains("sh: found 11 rows, expected 12"));
        let mut c = cloud(3, 1);
        c.log_scales[2][1] = f32::NAN;
        assert!(c.validate().expect_err("NaN").to_string().contains("Gaussian 2"));
        let mut c = cloud(3, 1);
        c.quats[1] = [0.0; 4];
        assert!(c.validate().is_err());
    }
}
