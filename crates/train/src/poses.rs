//! Refinement of camera poses: a rigid correction per training view, moved by Adam (Kingma 2015) beside the model.
//!
//! A correction is a twist (ω, v): the view is seen by exp(ω, v) · camera_from_world. A step multiplies another motion from
//! the left, whose gradient is what the renderer's pose probe gives, so that corrections are rigid motions however long they
//! are trained. All of it is float64 on the host, and 18 numbers per view.
//!
//! **Gauge.** A similarity that moves the whole scene and all cameras changes no image, so nothing in the loss holds the two
//! in place, and steps of Adam, which are as long for weak gradients as for strong ones, would walk along it: away from the
//! frame of the reconstruction, in which the poses of the test views and of other models are given. Weight decay would slow
//! that walk only, and pull on what the photographs do determine. Instead the part of the corrections that is such a common
//! motion (six modes and the scale) is taken out after every epoch: the loss cannot tell, and the frame stays where the given
//! poses have it in the mean.

use crate::config::PosesSection;
use crate::optim::AdamSettings;
use crate::optim::schedule::log_linear;
use gazesplat_core::Camera;
use gazesplat_core::camera::se3::{self, Twist};
use glam::{DMat3, DVec3, Mat3};
use serde::{Deserialize, Serialize};

/// The correction of one view with its optimiser.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(into = "Words", from = "Words")]
pub struct ViewPose {
    /// The correction: radians, world units.
    pub twist: Twist,
    /// First moments.
    pub first: Twist,
    /// Second moments.
    pub second: Twist,
    /// Updates done.
    pub num_updates: u32,
}

/// A [`ViewPose`] by its bits: a decimal number may lose its last digit.
#[derive(Serialize, Deserialize)]
struct Words {
    num_updates: u32,
    bits: [[u64; 6]; 3],
}

impl From<ViewPose> for Words {
    fn from(pose: ViewPose) -> Self {
        let bits = [pose.twist, pose.first, pose.second].map(|values| values.map(f64::to_bits));
        Self { num_updates: pose.num_updates, bits }
    }
}

impl From<Words> for ViewPose {
    fn from(Words { num_updates, bits }: Words) -> Self {
        let [twist, first, second] = bits.map(|words| words.map(f64::from_bits));
        Self { twist, first, second, num_updates }
    }
}

/// How far corrections moved the views from where they were given.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PoseChange {
    /// Mean and largest angle, degrees.
    pub degrees: [f64; 2],
    /// Mean and largest distance of the camera centres, scene extents.
    pub extents: [f64; 2],
}

/// The corrections of all training views of a run.
#[derive(Debug, Clone)]
pub struct PoseRefiner {
    section: PosesSection,
    num_steps: u32,
    /// Scene extent, world units.
    extent: f64,
    poses: Vec<ViewPose>,
    /// Orthonormal common motions, each with (ω, v / extent) of every view.
    gauge: Vec<Vec<Twist>>,
}

impl PoseRefiner {
    /// No correction of any of the `cameras`, in a scene of radius `extent` world units and a run of `num_steps` steps.
    pub fn new(cameras: &[Camera], section: &PosesSection, num_steps: u32, extent: f32) -> Self {
        let extent = f64::from(extent);
        let poses = vec![ViewPose::default(); cameras.len()];
        Self { section: section.clone(), num_steps, extent, poses, gauge: common_motions(cameras, extent) }
    }

    /// The corrections, in the order of the cameras.
    pub fn poses(&self) -> &[ViewPose] {
        &self.poses
    }

    /// Goes on with `poses`; `false`, and nothing changes, if they are not as many.
    pub fn restore(&mut self, poses: Vec<ViewPose>) -> bool {
        let fits = poses.len() == self.poses.len();
        if fits {
            self.poses = poses;
        }
        fits
    }

    /// First step, counted from 0, at which poses move.
    fn start(&self) -> u32 {
        (f64::from(self.section.start) * f64::from(self.num_steps) / 30_000.0).round() as u32
    }

    /// Whether poses move at `step`, counted from 0.
    pub fn is_moving(&self, step: u32) -> bool {
        step >= self.start()
    }

    /// The rate at `step`: radians, and scene extents.
    fn rate(&self, step: u32) -> f64 {
        let (start, last) = (self.start(), self.num_steps.saturating_sub(1));
        let progress = step.saturating_sub(start) as f32 / last.saturating_sub(start).max(1) as f32;
        f64::from(log_linear(self.section.lr, self.section.lr_end, progress))
    }

    /// One step of the correction of `view` against `gradient`, which step `step`, counted from 0, found. A gradient that is not
    /// finite moves nothing.
    pub fn update(&mut self, view: usize, step: u32, gradient: [f32; 6]) {
        if !gradient.iter().all(|g| g.is_finite()) {
            return;
        }
        let AdamSettings { beta1, beta2, epsilon, .. } = AdamSettings::default();
        let rate = self.rate(step);
        let pose = &mut self.poses[view];
        pose.num_updates += 1;
        let number = i32::try_from(pose.num_updates).unwrap_or(i32::MAX);
        let (bias1, bias2) = (1.0 - beta1.powi(number), 1.0 - beta2.powi(number));
        let mut motion = [0.0; 6];
        for k in 0..6 {
            let g = f64::from(gradient[k]);
            pose.first[k] = beta1 * pose.first[k] + (1.0 - beta1) * g;
            pose.second[k] = beta2 * pose.second[k] + (1.0 - beta2) * g * g;
            let direction = (pose.first[k] / bias1) / ((pose.second[k] / bias2).sqrt() + epsilon);
            motion[k] = -rate * if k < 3 { 1.0 } else { self.extent } * direction;
        }
        pose.twist = se3::log(se3::exp(motion) * se3::exp(pose.twist));
    }

    /// Takes out of the corrections what is a common motion, to first order.
    pub fn fix_gauge(&mut self) {
        for mode in &self.gauge {
            let share: f64 =
                self.poses.iter().zip(mode).map(|(pose, m)| dot(&scaled(&pose.twist, self.extent), m)).sum();
            for (pose, m) in self.poses.iter_mut().zip(mode) {
                for (k, (twist, m)) in pose.twist.iter_mut().zip(m).enumerate() {
                    *twist -= share * m * if k < 3 { 1.0 } else { self.extent };
                }
            }
        }
    }

    /// How far the corrections move `cameras`, those they were made for.
    pub fn change(&self, cameras: &[Camera]) -> PoseChange {
        let mut change = PoseChange::default();
        for (pose, camera) in self.poses.iter().zip(cameras) {
            let degrees = DVec3::from_slice(&pose.twist[..3]).length().to_degrees();
            let moved = camera.moved(pose.twist).position().distance(camera.position());
            for (figure, value) in
                [(&mut change.degrees, degrees), (&mut change.extents, f64::from(moved) / self.extent)]
            {
                figure[0] += value / self.poses.len() as f64;
                figure[1] = figure[1].max(value);
            }
        }
        change
    }
}

/// The twist with its v in scene extents.
fn scaled(twist: &Twist, extent: f64) -> Twist {
    std::array::from_fn(|k| if k < 3 { twist[k] } else { twist[k] / extent })
}

fn dot(a: &Twist, b: &Twist) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

/// Orthonormal basis of the corrections that together are one similarity of the world. A turn about axis e of the world moves
/// view i by Ad(C_i)(e, 0) = (R e, t × R e), a shift by (0, R e), growth by (0, t): the world's origin is put into the middle of
/// the cameras, so that these are as different as they can be.
fn common_motions(cameras: &[Camera], extent: f64) -> Vec<Vec<Twist>> {
    let center = cameras.iter().map(|c| c.position().as_dvec3()).sum::<DVec3>() / cameras.len().max(1) as f64;
    let rigid: Vec<(DMat3, DVec3)> = cameras
        .iter()
        .map(|camera| {
            let rotation = Mat3::from_mat4(camera.camera_from_world).as_dmat3();
            (rotation, (rotation * center + camera.camera_from_world.w_axis.truncate().as_dvec3()) / extent)
        })
        .collect();
    let joined = |omega: DVec3, v: DVec3| [omega.x, omega.y, omega.z, v.x, v.y, v.z];
    let mode = |of: &dyn Fn(&DMat3, DVec3) -> Twist| rigid.iter().map(|(r, t)| of(r, *t)).collect::<Vec<_>>();
    let axes = [DVec3::X, DVec3::Y, DVec3::Z];
    let mut modes: Vec<Vec<Twist>> = Vec::new();
    modes.extend(axes.map(|e| mode(&|r, _| joined(DVec3::ZERO, *r * e))));
    modes.extend(axes.map(|e| mode(&|r, t| joined(*r * e, t.cross(*r * e)))));
    modes.push(mode(&|_, t| joined(DVec3::ZERO, t)));
    // Gram and Schmidt, twice each, which is enough (Kahan): what is left of a mode that is none, as the scale of cameras that
    // share one place, is dropped.
    let mut basis: Vec<Vec<Twist>> = Vec::new();
    let product = |a: &[Twist], b: &[Twist]| a.iter().zip(b).map(|(x, y)| dot(x, y)).sum::<f64>();
    for mut mode in modes {
        let before = product(&mode, &mode).sqrt();
        for _ in 0..2 {
            for known in &basis {
                let share = product(&mode, known);
                for (m, k) in mode.iter_mut().zip(known) {
                    for (x, y) in m.iter_mut().zip(k) {
                        *x -= share * y;
                    }
                }
            }
        }
        let left = product(&mode, &mode).sqrt();
        // Rounding of the poses, which are float32, leaves this much of a mode that is none.
        if left > 1e-5 * (rigid.len() as f64).sqrt().max(before) {
            mode.iter_mut().flatten().for_each(|x| *x /= left);
            basis.push(mode);
        }
    }
    basis
}

#[cfg(test)]
mod tests {
    use super::*;
    use gazesplat_core::Pinhole;
    use glam::{Mat4, Vec3};

    fn ring(num_views: usize) -> Vec<Camera> {
        let pinhole = Pinhole::from_fov_x(80, 60, 1.0);
        let angle = |i: usize| i as f32 * 2.4;
        let eye = |i: usize| Vec3::new(30.0 + 2.0 * angle(i).cos(), 4.0 + 0.2 * i as f32, -7.0 + 2.0 * angle(i).sin());
        (0..num_views).map(|i| Camera::look_at(pinhole, eye(i), Vec3::new(30.0, 4.0, -7.0), Vec3::Y)).collect()
    }

    fn refiner(cameras: &[Camera]) -> PoseRefiner {
        PoseRefiner::new(cameras, &PosesSection::default(), 30_000, 2.5)
    }

    /// The corrections that one similarity of the world amounts to, exactly.
    fn corrections(cameras: &[Camera], motion: Twist, scale: f64) -> Vec<Twist> {
        let center = cameras.iter().map(|c| c.position().as_dvec3()).sum::<DVec3>() / cameras.len() as f64;
        let of = |camera: &Camera| {
            let mut pose = camera.camera_from_world.as_dmat4() * se3::exp(motion);
            let rotation = DMat3::from_mat4(pose);
            let position = -(rotation.transpose() * pose.w_axis.truncate());
            let moved = center + scale * (position - center);
            pose.w_axis = (-(rotation * moved)).extend(1.0);
            se3::log(pose * camera.camera_from_world.as_dmat4().inverse())
        };
        cameras.iter().map(of).collect()
    }

    #[test]
    fn a_common_motion_is_taken_out_and_nothing_else() {
        let cameras = ring(9);
        let mut refiner = refiner(&cameras);
        assert_eq!(refiner.gauge.len(), 7);
        let common = corrections(&cameras, [2e-4, -1e-4, 3e-4, 1e-3, -2e-3, 4e-3], 1.0 + 5e-4);
        for (pose, twist) in refiner.poses.iter_mut().zip(&common) {
            pose.twist = *twist;
        }
        let size = |r: &PoseRefiner| r.poses.iter().flat_map(|p| p.twist).fold(0.0_f64, |m, x| m.max(x.abs()));
        let before = size(&refiner);
        refiner.fix_gauge();
        // To first order: what stays is of the square of the motion, some 1e-2 of the lever times 1e-3.
        assert!(size(&refiner) < 2e-2 * before, "{} of {before}", size(&refiner));
        // A correction that is no common motion stays: projecting twice is projecting once.
        refiner.poses[4].twist = [1e-3, 2e-3, -1e-3, 0.01, 0.02, -0.01];
        refiner.fix_gauge();
        let once: Vec<Twist> = refiner.poses.iter().map(|p| p.twist).collect();
        assert!(once[4][1] > 1e-3, "most of it is the view's own: {:?}", once[4]);
        refiner.fix_gauge();
        for (pose, twist) in refiner.poses.iter().zip(once) {
            assert!(pose.twist.iter().zip(twist).all(|(a, b)| (a - b).abs() < 1e-12));
        }
    }

    #[test]
    fn what_few_cameras_leave_open_does_not_move() {
        // One view is its own gauge; two have the five parameters of an essential matrix; one place has no scale.
        let cameras = ring(2);
        let mut one = refiner(&cameras[..1]);
        one.poses[0].twist = [0.1, -0.2, 0.3, 0.4, 0.5, 0.6];
        one.fix_gauge();
        assert!(one.poses[0].twist.iter().all(|x| x.abs() < 1e-12), "{:?}", one.poses);
        assert_eq!((one.gauge.len(), refiner(&cameras).gauge.len()), (6, 7));
        let turned = |angle: f32| {
            let pose = Mat4::from_rotation_y(angle) * Mat4::from_translation(Vec3::new(3.0, -1.0, 2.0));
            Camera { camera_from_world: pose, ..cameras[0] }
        };
        assert_eq!(refiner(&[0.0, 0.5, 1.1, 2.0].map(turned)).gauge.len(), 6);
        assert!(PoseRefiner::new(&[], &PosesSection::default(), 10, 1.0).poses().is_empty());
    }

    #[test]
    fn the_first_step_is_as_long_as_the_rate_and_goes_against_the_gradient() {
        let cameras = ring(4);
        let section = PosesSection { lr: 1e-3, lr_end: 1e-5, start: 1000 };
        let mut refiner = PoseRefiner::new(&cameras, &section, 3000, 2.5);
        assert!(!refiner.is_moving(99) && refiner.is_moving(100));
        refiner.update(2, 100, [5.0, -1e-3, 0.0, 1e4, -2.0, 1e-6]);
        let expected = [-1e-3, 1e-3, 0.0, -2.5e-3, 2.5e-3, -2.5e-3];
        let twist = refiner.poses()[2].twist;
        assert!(twist.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-3 * 1e-3), "{twist:?}");
        assert!((refiner.rate(2999) - 1e-5).abs() < 1e-9);
        let before = refiner.poses().to_vec();
        refiner.update(1, 101, [1.0, f32::NAN, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(refiner.poses(), before, "a gradient that is no number moves nothing");
    }

    #[test]
    fn corrections_come_back_from_text_bit_for_bit() {
        let pose = ViewPose {
            twist: [0.1, -1e-300, f64::MIN_POSITIVE, 1.0 / 3.0, -0.0, 2e17],
            first: [std::f64::consts::PI; 6],
            second: [1e-20; 6],
            num_updates: 7,
        };
        let text = serde_json::to_string(&pose).expect("plain data");
        let back: ViewPose = serde_json::from_str(&text).expect("our own text");
        assert_eq!(Words::from(back).bits, Words::from(pose).bits);
        assert_eq!(back.num_updates, 7);
    }
}
