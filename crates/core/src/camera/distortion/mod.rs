//! Lens distortion of photographs. Everything is rendered with a pinhole; photographs are undistorted on load.
//!
//! A calibration maps a ray to a pixel in two steps: normalised coordinates (x/z, y/z) are distorted by the lens model,
//! then scaled by the focal lengths and moved to the principal point. [`LensDistortion::distort`] is the first step,
//! [`LensDistortion::undistort`] its inverse, [`LensDistortion::undistort_image`] resamples a photograph.

mod models;
mod undistort;

pub use models::LensModel;
pub use undistort::UndistortedImage;

/// Calibration of a photograph as taken: intrinsics in pixels of `width` × `height` and a lens model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LensDistortion {
    /// How rays bend.
    pub model: LensModel,
    /// Width in pixels of the photograph the intrinsics belong to.
    pub width: u32,
    /// Height in pixels of the photograph the intrinsics belong to.
    pub height: u32,
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point x, pixels; the top-left pixel has its centre at (0.5, 0.5).
    pub cx: f64,
    /// Principal point y, pixels.
    pub cy: f64,
    /// Coefficients in the order of [`LensModel::coefficient_names`], the rest 0.
    pub coefficients: [f64; 8],
    /// Largest undistorted radius up to which the model is one-to-one; beyond it rays fold back into the image.
    max_radius: f64,
}

/// Newton steps; from the guess of [`LensDistortion::initial_guess`] convergence takes three to six.
const MAX_NEWTON_STEPS: usize = 30;

impl LensDistortion {
    /// A calibration of photographs of `size` = \[width, height\] pixels; `focal` and `center` are (x, y) in pixels.
    pub fn new(model: LensModel, size: [u32; 2], focal: [f64; 2], center: [f64; 2], coefficients: [f64; 8]) -> Self {
        let ([width, height], [fx, fy], [cx, cy]) = (size, focal, center);
        let max_radius = models::max_radius(model, &coefficients);
        Self { model, width, height, fx, fy, cx, cy, coefficients, max_radius }
    }

    /// A calibration without distortion.
    pub fn pinhole(size: [u32; 2], focal: [f64; 2], center: [f64; 2]) -> Self {
        Self::new(LensModel::Pinhole, size, focal, center, [0.0; 8])
    }

    /// True when photographs are not what a pinhole with these intrinsics sees.
    pub fn is_distorted(&self) -> bool {
        match self.model {
            LensModel::SimplePinhole | LensModel::Pinhole => false,
            // A fisheye is not a pinhole even with all coefficients at zero.
            LensModel::OpenCvFisheye
            | LensModel::SimpleRadialFisheye
            | LensModel::RadialFisheye
            | LensModel::ThinPrismFisheye => true,
            LensModel::Fov
            | LensModel::SimpleRadial
            | LensModel::Radial
            | LensModel::OpenCv
            | LensModel::FullOpenCv
            | LensModel::Perspective => self.coefficients != [0.0; 8],
        }
    }

    /// The same lens for photographs stored at another size: every length scales with its axis.
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let (sx, sy) = (f64::from(width) / f64::from(self.width), f64::from(height) / f64::from(self.height));
        Self { width, height, fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy, ..*self }
    }

    /// Distorted normalised coordinates of the undistorted ones `ray` = (x/z, y/z).
    pub fn distort(&self, ray: [f64; 2]) -> [f64; 2] {
        models::distort(self.model, &self.coefficients, ray)
    }

    /// Undistorted normalised coordinates whose [`distort`](Self::distort) is `distorted`, by Newton's method; residual
    /// below 1e-10. `None` when no ray of the one-to-one region around the axis lands there.
    pub fn undistort(&self, distorted: [f64; 2]) -> Option<[f64; 2]> {
        if self.max_radius == f64::INFINITY {
            return Some(distorted);
        }
        let mut ray = self.initial_guess(distorted);
        let mut residual = self.residual(ray, distorted);
        for _ in 0..MAX_NEWTON_STEPS {
            if norm(residual) < 1e-15 {
                break;
            }
            let Some(step) = self.newton_step(ray, residual) else { break };
            // Halving keeps the step from jumping over the fold of strongly distorting lenses.
            let improved = (0..12).map(|k| 0.5_f64.powi(k)).find_map(|damping| {
                let next = [ray[0] - damping * step[0], ray[1] - damping * step[1]];
                let next_residual = self.residual(next, distorted);
                (norm(next_residual) < norm(residual)).then_some((next, next_residual))
            });
            let Some(next) = improved else { break };
            (ray, residual) = next;
        }
        (norm(residual) < 1e-10 * (1.0 + norm(distorted)) && self.is_one_to_one(ray)).then_some(ray)
    }

    /// True when `ray` lies where the model is one-to-one, so that its image belongs to it alone.
    fn is_one_to_one(&self, ray: [f64; 2]) -> bool {
        // Squares, because this is asked for every pixel and `hypot` is slow.
        ray[0] * ray[0] + ray[1] * ray[1] <= self.max_radius * self.max_radius
    }

    /// The ray of the radial part of the model alone, by bisection: it is monotone up to `max_radius`.
    fn initial_guess(&self, distorted: [f64; 2]) -> [f64; 2] {
        let target = norm(distorted);
        if target == 0.0 {
            return [0.0; 2];
        }
        let (mut low, mut high) = (0.0, self.max_radius);
        for _ in 0..40 {
            let middle = 0.5 * (low + high);
            if models::radial_profile(self.model, &self.coefficients, middle) < target {
                low = middle;
            } else {
                high = middle;
            }
        }
        distorted.map(|d| d / target * low)
    }

    fn residual(&self, ray: [f64; 2], distorted: [f64; 2]) -> [f64; 2] {
        let image = self.distort(ray);
        [image[0] - distorted[0], image[1] - distorted[1]]
    }

    /// Jacobian⁻¹ · residual with central differences; `None` where the Jacobian is singular.
    fn newton_step(&self, ray: [f64; 2], residual: [f64; 2]) -> Option<[f64; 2]> {
        let h = 1e-6 * (1.0 + norm(ray));
        let column = |axis: usize| {
            let (mut a, mut b) = (ray, ray);
            a[axis] -= h;
            b[axis] += h;
            let (a, b) = (self.distort(a), self.distort(b));
            [(b[0] - a[0]) / (2.0 * h), (b[1] - a[1]) / (2.0 * h)]
        };
        let ([a, c], [b, d]) = (column(0), column(1));
        let det = a * d - b * c;
        (det.abs() > 1e-12)
            .then(|| [(d * residual[0] - b * residual[1]) / det, (a * residual[1] - c * residual[0]) / det])
    }
}

fn norm([x, y]: [f64; 2]) -> f64 {
    x.hypot(y)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The calibration of `fox_distorted` (COLMAP's own fit).
    pub(crate) fn phone() -> LensDistortion {
        let k = [0.05603777274611943, -0.07716996855036008, -0.0016494203659386333, -0.002254313154242736];
        LensDistortion::new(
            LensModel::OpenCv,
            [1080, 1920],
            [1375.7194740975829, 1375.146970686464],
            [540.0, 960.0],
            [k[0], k[1], k[2], k[3], 0.0, 0.0, 0.0, 0.0],
        )
    }

    fn lens(model: LensModel, coefficients: [f64; 8]) -> LensDistortion {
        LensDistortion::new(model, [640, 480], [500.0, 500.0], [320.0, 240.0], coefficients)
    }

    proptest! {
        #[test]
        fn undistort_inverts_distort_for_every_model(
            x in -0.7..0.7_f64, y in -0.7..0.7_f64, k1 in -0.15..0.15_f64, k2 in -0.03..0.03_f64,
            p1 in -0.004..0.004_f64, p2 in -0.004..0.004_f64, omega in 0.05..1.2_f64,
        ) {
            let k = [k1, k2, p1, p2, 0.2 * k2, -0.1 * k2, 0.05 * k2, 0.001];
            for model in LensModel::ALL {
                let mut k = match model {
                    LensModel::Fov => [omega, 0., 0., 0., 0., 0., 0., 0.],
                    _ => k,
                };
                k[model.coefficient_names().len()..].fill(0.0);
                let lens = lens(model, k);
                let there = lens.distort([x, y]);
                let back = lens.undistort(there);
                prop_assert!(back.is_some(), "{model:?} {k:?}");
                let back = back.unwrap();
                prop_assert!(norm([back[0] - x, back[1] - y]) < 1e-6, "{model:?} {back:?}");
            }
        }
    }

    #[test]
    fn opencv_formula_matches_a_value_computed_by_hand() {
        // x = 0.5, y = −0.25: r² = 0.3125, radial factor 1 + 0.1·r² − 0.2·r⁴ = 1.01171875.
        let lens = lens(LensModel::OpenCv, [0.1, -0.2, 0.01, 0.02, 0.0, 0.0, 0.0, 0.0]);
        let [x, y] = lens.distort([0.5, -0.25]);
        assert!((x - (0.5 * 1.01171875 + 2.0 * 0.01 * -0.125 + 0.02 * (0.3125 + 0.5))).abs() < 1e-15);
        assert!((y - (-0.25 * 1.01171875 + 2.0 * 0.02 * -0.125 + 0.01 * (0.3125 + 0.125))).abs() < 1e-15);
    }

    #[test]
    fn zero_coefficients_of_a_fisheye_are_the_equidistant_projection() {
        let lens = lens(LensModel::OpenCvFisheye, [0.0; 8]);
        assert!((lens.distort([1.0, 0.0])[0] - std::f64::consts::FRAC_PI_4).abs() < 1e-15);
        assert!(lens.is_distorted());
        assert!(
            (lens.undistort([1.2, 0.3]).unwrap()[0] - 1.2 / 1.2_f64.hypot(0.3) * 1.2_f64.hypot(0.3).tan()).abs() < 1e-9
        );
    }

    #[test]
    fn points_beyond_the_fold_have_no_ray() {
        // r − 0.3 r³ rises up to r = 1.054, where it is 0.703.
        let barrel = lens(LensModel::SimpleRadial, [-0.3, 0., 0., 0., 0., 0., 0., 0.]);
        assert!(barrel.undistort([0.70, 0.0]).is_some());
        assert_eq!(barrel.undistort([0.71, 0.0]), None);
        assert!(barrel.undistort([0.0, 0.0]) == Some([0.0, 0.0]));
    }

    #[test]
    fn resized_calibration_sees_the_same_rays() {
        let (full, half) = (phone(), phone().resized(540, 960));
        assert_eq!((half.cx, half.width, half.coefficients), (270.0, 540, full.coefficients));
        assert_eq!(half.distort([0.2, 0.3]), full.distort([0.2, 0.3]));
    }
}
