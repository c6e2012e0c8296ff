//! Random extreme values: whatever is stored, the image and the gradients are finite and nothing panics.

use gazesplat_core::{Camera, GaussianCloud, Pinhole};
use gazesplat_testkit::close::assert_finite;
use glam::{Mat4, Vec3};
use proptest::prelude::*;

use crate::common::Scene;
use crate::common::scenes::{options, upstream};

/// Any value a damaged or extreme file could hold, ordinary ones more often than not.
fn value(scale: f32) -> impl Strategy<Value = f32> {
    prop_oneof![
        12 => -scale..scale,
        1 => -1e3f32..1e3,
        1 => Just(0.0f32),
        1 => (-45i32..38).prop_map(|e| 10f32.powi(e)),
        1 => (-45i32..38).prop_map(|e| -(10f32.powi(e))),
        1 => prop::sample::select(vec![f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, f32::MIN, f32::MIN_POSITIVE, 1e-45]),
    ]
}

/// Mean, rotation, log scales, opacity logit and four SH coefficients.
type Row = ([f32; 3], [f32; 4], [f32; 3], f32, [[f32; 3]; 4]);

fn row() -> impl Strategy<Value = Row> {
    let three = |scale: f32| prop::array::uniform3(value(scale));
    (
        (value(2.0), value(2.0), value(4.0)).prop_map(|(x, y, z)| [x, y, z.abs()]),
        prop::array::uniform4(value(1.0)),
        three(5.0),
        value(8.0),
        // Colours far beyond any image would overflow float32 sums by right.
        prop::array::uniform4(prop::array::uniform3(
            prop_oneof![8 => -3f32..3.0, 1 => -1e6f32..1e6, 1 => Just(f32::NAN)],
        )),
    )
}

fn cloud(rows: Vec<Row>) -> GaussianCloud {
    let mut cloud = GaussianCloud { sh_degree: 1, ..GaussianCloud::default() };
    for (mean, quat, log_scales, opacity_logit, sh) in rows {
        cloud.means.push(mean);
        cloud.quats.push(quat);
        cloud.log_scales.push(log_scales);
        cloud.opacity_logits.push(opacity_logit);
        cloud.sh.extend(sh);
    }
    cloud
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 600, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn image_and_gradients_are_finite_for_any_values(
        rows in prop::collection::vec(row(), 0..24),
        size in (1u32..50, 1u32..40),
        focal in 1f32..300.0,
        principal in (-0.5f32..1.5, -0.5f32..1.5),
        angle in -3f32..3.0,
        seed in any::<u64>(),
    ) {
        let (width, height) = size;
        let intrinsics = Pinhole {
            width,
            height,
            fx: focal,
            fy: 1.1 * focal,
            cx: principal.0 * width as f32,
            cy: principal.1 * height as f32,
        };
        let camera_from_world = Mat4::from_axis_angle(Vec3::Z, angle);
        let scene = Scene { cloud: cloud(rows), camera: Camera { intrinsics, camera_from_world }, options: options() };
        let (frame, gradients) = scene.frame_and_gradients(&upstream(seed, &scene));
        assert_finite("image", &frame.image);
        gradients.assert_finite("random values");
        prop_assert!(frame.image.chunks_exact(5).all(|p| (0.0..=1.0).contains(&p[3])));
    }
}

crate::common::on_gpu!(image_and_gradients_are_finite_for_any_values,);
