//! Rigid motions as twists: the exponential and the logarithm of SE(3), and cameras that are moved by them.
//!
//! A twist is (ω, v): radians and world units. Its motion is applied from the left, in camera coordinates:
//! camera_from_world' = exp(ω, v) · camera_from_world (Solà 2018, "A micro Lie theory", Eq. 172–175).

use super::Camera;
use glam::{DMat3, DMat4, DQuat, DVec3};

/// (ω, v): radians, world units.
pub type Twist = [f64; 6];

/// Squared angles below which sin and cos cancel: there two terms of the series are exact to the last digit.
const SMALL_ANGLE2: f64 = 1e-8;

/// (1 − cos θ)/θ² and (θ − sin θ)/θ³.
fn coefficients(angle2: f64) -> (f64, f64) {
    if angle2 < SMALL_ANGLE2 {
        return (0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0);
    }
    let angle = angle2.sqrt();
    ((1.0 - angle.cos()) / angle2, (angle - angle.sin()) / (angle2 * angle))
}

fn parts(twist: Twist) -> (DVec3, DVec3) {
    let [a, b, c, x, y, z] = twist;
    (DVec3::new(a, b, c), DVec3::new(x, y, z))
}

/// The rigid motion of a twist. That of the zero twist is exactly the identity.
pub fn exp(twist: Twist) -> DMat4 {
    let (omega, v) = parts(twist);
    let (b, c) = coefficients(omega.length_squared());
    let translation = v + b * omega.cross(v) + c * omega.cross(omega.cross(v));
    DMat4::from_rotation_translation(DQuat::from_scaled_axis(omega), translation)
}

/// The twist of a rigid motion by less than half a turn.
pub fn log(motion: DMat4) -> Twist {
    let omega = DQuat::from_mat3(&DMat3::from_mat4(motion)).normalize().to_scaled_axis();
    let translation = motion.w_axis.truncate();
    let angle2 = omega.length_squared();
    let d = if angle2 < SMALL_ANGLE2 {
        1.0 / 12.0 + angle2 / 720.0
    } else {
        let angle = angle2.sqrt();
        (1.0 - 0.5 * angle * (0.5 * angle).cos() / (0.5 * angle).sin()) / angle2
    };
    let v = translation - 0.5 * omega.cross(translation) + d * omega.cross(omega.cross(translation));
    [omega.x, omega.y, omega.z, v.x, v.y, v.z]
}

impl Camera {
    /// The camera moved by `twist` in its own frame: camera_from_world' = exp(twist) · camera_from_world. By zero it is the
    /// same to the last bit.
    pub fn moved(&self, twist: Twist) -> Self {
        Self { camera_from_world: (exp(twist) * self.camera_from_world.as_dmat4()).as_mat4(), ..*self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Pinhole;
    use glam::Vec3;

    /// The series of the matrix exponential, its own definition.
    fn series(twist: Twist) -> DMat4 {
        let (w, v) = parts(twist);
        let generator = DMat4::from_cols_array(&[
            0.0, w.z, -w.y, 0.0, -w.z, 0.0, w.x, 0.0, w.y, -w.x, 0.0, 0.0, v.x, v.y, v.z, 0.0,
        ]);
        let (mut sum, mut term) = (DMat4::IDENTITY, DMat4::IDENTITY);
        for n in 1..40 {
            term = term * generator * f64::from(n).recip();
            sum += term;
        }
        sum
    }

    #[test]
    fn exp_is_the_series_and_log_its_inverse() {
        // Through both branches of the coefficients, and across where they meet.
        for scale in [0.0, 1e-12, 9e-5, 1.1e-4, 1e-3, 0.3, 2.5] {
            let twist = [0.6, -0.48, 0.64, 1.0, -2.0, 0.5].map(|x| x * scale);
            assert!(exp(twist).abs_diff_eq(series(twist), 1e-13), "{scale}");
            let back = log(exp(twist));
            // A rotation matrix holds an angle to about half the digits of its cosine: not so its quaternion.
            assert!(back.iter().zip(twist).all(|(a, b)| (a - b).abs() < 1e-12), "{scale}: {back:?} {twist:?}");
        }
    }

    #[test]
    fn zero_motion_keeps_every_bit() {
        let pinhole = Pinhole::from_fov_x(8, 6, 1.0);
        let camera = Camera::look_at(pinhole, Vec3::new(1.3, -0.2, 7.1), Vec3::new(0.1, 0.2, 0.3), Vec3::Y);
        assert_eq!(camera.moved([0.0; 6]), camera);
        // A camera that goes up by one sees the world one lower: +y is down.
        let moved = camera.moved([0.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
        let seen = |c: &Camera| c.camera_from_world.transform_point3(Vec3::ZERO);
        assert!((seen(&moved) - seen(&camera) - Vec3::Y).length() < 1e-6);
    }
}
