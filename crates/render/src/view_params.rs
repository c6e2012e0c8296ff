//! From a [`Camera`] to what the kernels read.

use crate::error::{Error, Result};
use crate::layout::JACOBIAN_MARGIN;
use crate::math::ewa::ViewParams;
use crate::math::vec::{Mat3, Vec3};
use gazesplat_core::Camera;

/// The kernel's view of `camera`: rigid transform, intrinsics, limits of the Jacobian, camera centre.
///
/// # Errors
/// [`Error::Parameter`] if the image is empty, a focal length is not positive, or anything is not finite.
pub fn view_params(camera: &Camera) -> Result<ViewParams> {
    let k = &camera.intrinsics;
    let m = camera.camera_from_world;
    let bad = |name, found: String, expected| Err(Error::Parameter { name, found, expected });
    if k.width == 0 || k.height == 0 {
        return bad("image size", format!("{}x{}", k.width, k.height), "at least 1x1 pixels");
    }
    if !(k.fx.is_finite() && k.fy.is_finite() && k.fx > 0.0 && k.fy > 0.0) {
        return bad("focal length", format!("{} x {}", k.fx, k.fy), "two finite values above 0");
    }
    if !(k.cx.is_finite() && k.cy.is_finite()) {
        return bad("principal point", format!("({}, {})", k.cx, k.cy), "two finite values");
    }
    if !m.is_finite() {
        return bad("camera pose", format!("{m}"), "a finite rigid transform");
    }
    let vec = |v: glam::Vec3| Vec3 { x: v.x, y: v.y, z: v.z };
    let (w, h) = (k.width as f32, k.height as f32);
    Ok(ViewParams {
        rotation: Mat3 {
            row0: vec(m.row(0).truncate()),
            row1: vec(m.row(1).truncate()),
            row2: vec(m.row(2).truncate()),
        },
        translation: vec(m.w_axis.truncate()),
        position: vec(camera.position()),
        fx: k.fx,
        fy: k.fy,
        cx: k.cx,
        cy: k.cy,
        min_x: -(JACOBIAN_MARGIN * w + k.cx) / k.fx,
        max_x: ((1.0 + JACOBIAN_MARGIN) * w - k.cx) / k.fx,
        min_y: -(JACOBIAN_MARGIN * h + k.cy) / k.fy,
        max_y: ((1.0 + JACOBIAN_MARGIN) * h - k.cy) / k.fy,
    })
}
