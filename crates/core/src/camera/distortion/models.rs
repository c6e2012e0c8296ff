//! The lens models of COLMAP and their formulas in normalised image coordinates.
//!
//! Sources: OpenCV, "Camera Calibration and 3D Reconstruction" (rational and fisheye models); Devernay and Faugeras
//! 2001, "Straight lines have to be straight" (FOV); Kannala and Brandt 2006 (fisheye polynomial); Brown 1966
//! (tangential part). Names and parameter orders are those of COLMAP's `models.h`.

/// A camera model of COLMAP or nerfstudio: how a ray becomes a point of the photograph.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum LensModel {
    /// No distortion, one focal length.
    SimplePinhole,
    /// No distortion.
    Pinhole,
    /// One radial coefficient k1, one focal length.
    SimpleRadial,
    /// Two radial coefficients k1, k2, one focal length.
    Radial,
    /// Two radial and two tangential coefficients k1, k2, p1, p2.
    OpenCv,
    /// Equidistant fisheye with an odd polynomial k1 … k4 of the angle.
    OpenCvFisheye,
    /// Rational radial part k1 … k6, tangential part p1, p2.
    FullOpenCv,
    /// Field-of-view model with one parameter ω.
    Fov,
    /// Fisheye with k1, one focal length.
    SimpleRadialFisheye,
    /// Fisheye with k1, k2, one focal length.
    RadialFisheye,
    /// Fisheye with radial, tangential and thin-prism terms.
    ThinPrismFisheye,
    /// The perspective model of nerfstudio: a polynomial k1 … k4 and a tangential part p1, p2. COLMAP has none such.
    Perspective,
}

use LensModel as M;

impl LensModel {
    /// Every model of COLMAP, in the order of its numbers 0 to 10.
    pub const ALL: [Self; 11] = [
        M::SimplePinhole,
        M::Pinhole,
        M::SimpleRadial,
        M::Radial,
        M::OpenCv,
        M::OpenCvFisheye,
        M::FullOpenCv,
        M::Fov,
        M::SimpleRadialFisheye,
        M::RadialFisheye,
        M::ThinPrismFisheye,
    ];

    /// COLMAP's name, as `cameras.txt` has it; `PERSPECTIVE` is nobody's.
    pub const fn name(self) -> &'static str {
        match self {
            M::SimplePinhole => "SIMPLE_PINHOLE",
            M::Pinhole => "PINHOLE",
            M::SimpleRadial => "SIMPLE_RADIAL",
            M::Radial => "RADIAL",
            M::OpenCv => "OPENCV",
            M::OpenCvFisheye => "OPENCV_FISHEYE",
            M::FullOpenCv => "FULL_OPENCV",
            M::Fov => "FOV",
            M::SimpleRadialFisheye => "SIMPLE_RADIAL_FISHEYE",
            M::RadialFisheye => "RADIAL_FISHEYE",
            M::ThinPrismFisheye => "THIN_PRISM_FISHEYE",
            M::Perspective => "PERSPECTIVE",
        }
    }

    /// The model with COLMAP's name, upper case.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.name() == name)
    }

    /// The model with COLMAP's number in `cameras.bin`.
    pub fn from_colmap_id(id: i32) -> Option<Self> {
        usize::try_from(id).ok().and_then(|id| Self::ALL.get(id).copied())
    }

    /// Coefficients of the distortion, in COLMAP's order.
    pub const fn coefficient_names(self) -> &'static [&'static str] {
        match self {
            M::SimplePinhole | M::Pinhole => &[],
            M::SimpleRadial | M::SimpleRadialFisheye => &["k1"],
            M::Radial | M::RadialFisheye => &["k1", "k2"],
            M::OpenCv => &["k1", "k2", "p1", "p2"],
            M::OpenCvFisheye => &["k1", "k2", "k3", "k4"],
            M::FullOpenCv => &["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"],
            M::Fov => &["omega"],
            M::Perspective => &["k1", "k2", "p1", "p2", "k3", "k4"],
            M::ThinPrismFisheye => &["k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"],
        }
    }

    /// True when COLMAP stores one focal length for both axes.
    pub const fn has_single_focal(self) -> bool {
        matches!(self, M::SimplePinhole | M::SimpleRadial | M::Radial | M::SimpleRadialFisheye | M::RadialFisheye)
    }

    /// Number of parameters COLMAP stores: focal lengths, principal point, coefficients.
    pub const fn num_params(self) -> usize {
        let num_focal = if self.has_single_focal() { 1 } else { 2 };
        num_focal + 2 + self.coefficient_names().len()
    }

    /// The names of all models, for messages.
    pub fn supported() -> String {
        Self::ALL.map(Self::name).join(", ")
    }
}

/// Distorted coordinates of the ray (u, v).
pub(super) fn distort(model: LensModel, k: &[f64; 8], [u, v]: [f64; 2]) -> [f64; 2] {
    let r2 = u * u + v * v;
    match model {
        M::SimplePinhole | M::Pinhole => [u, v],
        M::SimpleRadial | M::Radial => {
            let radial = 1.0 + r2 * (k[0] + r2 * k[1]);
            [u * radial, v * radial]
        }
        M::OpenCv | M::FullOpenCv => {
            let radial = rational(k, r2);
            let [du, dv] = tangential(k[2], k[3], [u, v]);
            [u * radial + du, v * radial + dv]
        }
        M::Perspective => {
            let [du, dv] = tangential(k[2], k[3], [u, v]);
            let radial = polynomial(k, r2);
            [u * radial + du, v * radial + dv]
        }
        M::Fov => {
            let factor = fov_factor(k[0], r2.sqrt());
            [u * factor, v * factor]
        }
        M::OpenCvFisheye | M::SimpleRadialFisheye | M::RadialFisheye => {
            let r = r2.sqrt();
            let theta = r.atan();
            let factor = angle_per_radius(r) * fisheye_polynomial([k[0], k[1], k[2], k[3]], theta);
            [u * factor, v * factor]
        }
        M::ThinPrismFisheye => {
            let scale = angle_per_radius(r2.sqrt());
            let (u, v) = (u * scale, v * scale);
            let theta2 = u * u + v * v;
            let radial = fisheye_polynomial([k[0], k[1], k[4], k[5]], theta2.sqrt());
            let [du, dv] = tangential(k[2], k[3], [u, v]);
            [u * radial + du + k[6] * theta2, v * radial + dv + k[7] * theta2]
        }
    }
}

/// Distorted radius of the radius `r` with the radial part of the model alone.
pub(super) fn radial_profile(model: LensModel, k: &[f64; 8], r: f64) -> f64 {
    match model {
        M::OpenCv | M::FullOpenCv => r * rational(k, r * r),
        M::Perspective => r * polynomial(k, r * r),
        M::ThinPrismFisheye => {
            let theta = r.atan();
            theta * fisheye_polynomial([k[0], k[1], k[4], k[5]], theta)
        }
        _ => distort(model, k, [r, 0.0])[0],
    }
}

/// Largest radius up to which the radial part rises; at most tan 89°, the widest ray that is undistorted at all.
/// Infinite for pinholes.
pub(super) fn max_radius(model: LensModel, k: &[f64; 8]) -> f64 {
    if matches!(model, M::SimplePinhole | M::Pinhole) {
        return f64::INFINITY;
    }
    const NUM_STEPS: u32 = 1780;
    let radius = |step: u32| (f64::from(step) * 0.05).to_radians().tan();
    let mut previous = 0.0;
    for step in 1..=NUM_STEPS {
        let distorted = radial_profile(model, k, radius(step));
        // Also stops at NaN and at the pole of a rational model.
        if !(distorted > previous && distorted.is_finite()) {
            return radius(step - 1);
        }
        previous = distorted;
    }
    radius(NUM_STEPS)
}

fn rational(k: &[f64; 8], r2: f64) -> f64 {
    (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
}

/// 1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸.
fn polynomial(k: &[f64; 8], r2: f64) -> f64 {
    1.0 + r2 * (k[0] + r2 * (k[1] + r2 * (k[4] + r2 * k[5])))
}

fn tangential(p1: f64, p2: f64, [u, v]: [f64; 2]) -> [f64; 2] {
    let (uv, r2) = (u * v, u * u + v * v);
    [2.0 * p1 * uv + p2 * (r2 + 2.0 * u * u), 2.0 * p2 * uv + p1 * (r2 + 2.0 * v * v)]
}

/// atan(r) / r, 1 at 0.
fn angle_per_radius(r: f64) -> f64 {
    if r > 1e-8 { r.atan() / r } else { 1.0 }
}

/// Distorted angle over angle θ: 1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸.
fn fisheye_polynomial([k1, k2, k3, k4]: [f64; 4], theta: f64) -> f64 {
    let t2 = theta * theta;
    1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))
}

/// Distorted radius over radius, atan(2 r tan(ω/2)) / (r ω), with its limits for small r and ω.
fn fov_factor(omega: f64, r: f64) -> f64 {
    let (omega2, r2) = (omega * omega, r * r);
    if omega2 < 1e-8 {
        1.0 + omega2 * (1.0 / 12.0 - r2 / 3.0)
    } else if r2 < 1e-12 {
        2.0 * (0.5 * omega).tan() / omega
    } else {
        (2.0 * r * (0.5 * omega).tan()).atan() / (r * omega)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_and_parameter_counts_are_those_of_colmap() {
        let counts = LensModel::ALL.map(LensModel::num_params);
        assert_eq!(counts, [3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12]);
        assert_eq!(LensModel::from_colmap_id(4), Some(M::OpenCv));
        assert_eq!((LensModel::from_colmap_id(-1), LensModel::from_colmap_id(11)), (None, None));
        assert!(LensModel::ALL.into_iter().all(|m| LensModel::from_name(m.name()) == Some(m)));
    }

    #[test]
    fn fov_factor_is_continuous_at_its_branches() {
        for r in [0.0, 0.3, 1.0] {
            assert!((fov_factor(0.99e-4, r) - fov_factor(1.01e-4, r)).abs() < 1e-8);
        }
        for omega in [0.1, 1.0] {
            assert!((fov_factor(omega, 0.99e-6) - fov_factor(omega, 1.01e-6)).abs() < 1e-9);
        }
    }
}
