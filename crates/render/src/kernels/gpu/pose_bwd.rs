//! Gradient of the camera's pose: from the gradients of the parameters, summed over the visible splats.
//!
//! One unit per visible splat. A part in which anything overflows is left out, as its row is in [`super::project_bwd`]; what
//! is not visible is not even looked at, so NaN in it goes nowhere. A workgroup adds the parts of 256 splats as a tree, further
//! dispatches the sums of 256 workgroups: the order is fixed, and a sum over V parts is off by at most ⌈log₂ V⌉ rounding
//! errors of the sum of their magnitudes (Higham 2002, Eq. 4.6), 24 for sixteen million. Compensation is no use here: shader
//! compilers may cancel it. Units past the end of the last workgroup add zero. Nothing visible gives zero.

use super::bin::TileLists;
use super::project::{GaussianBuffers, row3, row4, view_launch};
use super::project_bwd::{ParameterGradients, color_direction_vjp};
use crate::error::Result;
use crate::gpu::device_fn::is_finite;
use crate::gpu::{Gpu, UNITS, cube_dim};
use crate::kernels::cpu::project::ViewSpec;
use crate::math::ewa::{ViewParams, to_camera, view_direction};
use crate::math::pose::{torque, twist_vjp};
use crate::math::sh::C0;
use crate::math::vec::Vec3;
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Values of a twist.
const LANES: usize = 6;

/// Gradient of the pose as a twist from the left, `[6]` = (ω, v): per radian and per world unit, in camera axes. `v` are the
/// gradients of the parameters that [`super::project_bwd::project_bwd`] gave, `lists` the splats it summed.
///
/// # Errors
/// [`crate::Error::Limit`] when a buffer is larger than the adapter takes: the sums take a fortieth of what the splats do.
pub fn pose_bwd(
    gpu: &Gpu,
    g: &GaussianBuffers,
    view: &ViewSpec,
    lists: &TileLists,
    v: &ParameterGradients,
) -> Result<CubeTensor> {
    if lists.num_visible == 0 {
        return gpu.zeros("bytes of a pose", &[LANES], DType::F32);
    }
    let mut num_sums = lists.num_visible.div_ceil(UNITS as usize);
    let mut sums = gpu.empty("bytes of sums", &[num_sums * LANES], DType::F32)?;
    sum_splats::launch(
        &gpu.client,
        gpu.cubes(num_sums),
        cube_dim(),
        g.means.clone().into_buffer_arg(),
        g.quats.clone().into_buffer_arg(),
        g.sh.clone().into_buffer_arg(),
        v.packed.clone().into_buffer_arg(),
        lists.global_from_compact.clone().into_buffer_arg(),
        sums.clone().into_buffer_arg(),
        view_launch(&view.params),
        v.layout.offsets[1] as u32,
        v.layout.offsets[4] as u32,
        lists.num_visible as u32,
        g.num_coefficients as u32,
        g.sh_degree,
    );
    while num_sums > 1 {
        let fewer = num_sums.div_ceil(UNITS as usize);
        let next = gpu.empty("bytes of sums", &[fewer * LANES], DType::F32)?;
        sum_sums::launch(
            &gpu.client,
            gpu.cubes(fewer),
            cube_dim(),
            sums.into_buffer_arg(),
            next.clone().into_buffer_arg(),
            num_sums as u32,
        );
        (sums, num_sums) = (next, fewer);
    }
    Ok(sums)
}

/// Adds the twists that the units of a workgroup have put into `shared`, lane by lane, as a tree; the sum is then in place of
/// the first. Every unit must call it.
#[cube]
fn sum_units(shared: &mut Shared<[f32]>) {
    let unit = UNIT_POS as usize;
    sync_cube();
    let mut distance = 1usize;
    while distance < UNITS as usize {
        if unit & (2 * distance - 1) == 0 {
            #[unroll]
            for l in 0..6usize {
                let other = shared[(unit + distance) * 6 + l];
                shared[unit * 6 + l] += other;
            }
        }
        sync_cube();
        distance *= 2;
    }
}

#[cube(launch)]
fn sum_splats(
    means: &[f32],
    quats: &[f32],
    sh: &[f32],
    gradients: &[f32],
    global_from_compact: &[u32],
    sums: &mut [f32],
    view: ViewParams,
    first_quat: u32,
    first_sh: u32,
    num_visible: u32,
    num_coefficients: u32,
    #[comptime] sh_degree: u32,
) {
    let mut shared = Shared::<[f32]>::new_slice(1536usize);
    let slot = UNIT_POS as usize * 6;
    #[unroll]
    for l in 0..6usize {
        shared[slot + l] = 0.0_f32;
    }
    let r = CUBE_POS * UNITS as usize + UNIT_POS as usize;
    if r < num_visible as usize {
        let i = global_from_compact[r] as usize;
        let mean = row3(means, i);
        let in_camera = to_camera(view, mean);
        let v_mean = row3(gradients, i);
        let at = first_quat as usize + 4 * i;
        let v_quat = crate::math::quat::Quat {
            w: gradients[at],
            x: gradients[at + 1],
            y: gradients[at + 2],
            z: gradients[at + 3],
        };
        let v_turn = torque(row4(quats, i), v_quat);
        let direction = view_direction(view, mean);
        let mut x = 0.0_f32;
        let mut y = 0.0_f32;
        let mut z = 0.0_f32;
        if comptime!(sh_degree > 0) {
            // The constant basis function tells the gradient of the colour, gated where the colour was clamped.
            let num_sh = 3 * num_coefficients as usize;
            let to = first_sh as usize + num_sh * i;
            let v_color = Vec3 { x: gradients[to] / C0, y: gradients[to + 1] / C0, z: gradients[to + 2] / C0 };
            let v_unit = color_direction_vjp(sh, num_sh * i, direction.unit, v_color, sh_degree);
            x = v_unit.x;
            y = v_unit.y;
            z = v_unit.z;
        }
        let part = twist_vjp(view.rotation, in_camera, v_mean, v_turn, direction.unit, Vec3 { x, y, z });
        let kept = is_finite(part.omega.x)
            && is_finite(part.omega.y)
            && is_finite(part.omega.z)
            && is_finite(part.v.x)
            && is_finite(part.v.y)
            && is_finite(part.v.z);
        if kept {
            shared[slot] = part.omega.x;
            shared[slot + 1] = part.omega.y;
            shared[slot + 2] = part.omega.z;
            shared[slot + 3] = part.v.x;
            shared[slot + 4] = part.v.y;
            shared[slot + 5] = part.v.z;
        }
    }
    sum_units(&mut shared);
    if UNIT_POS < 6u32 && CUBE_POS * (UNITS as usize) < num_visible as usize {
        sums[CUBE_POS * 6 + UNIT_POS as usize] = shared[UNIT_POS as usize];
    }
}

#[cube(launch)]
fn sum_sums(from: &[f32], to: &mut [f32], num_sums: u32) {
    let mut shared = Shared::<[f32]>::new_slice(1536usize);
    let slot = UNIT_POS as usize * 6;
    let r = CUBE_POS * UNITS as usize + UNIT_POS as usize;
    #[unroll]
    for l in 0..6usize {
        shared[slot + l] = 0.0_f32;
        if r < num_sums as usize {
            shared[slot + l] = from[r * 6 + l];
        }
    }
    sum_units(&mut shared);
    if UNIT_POS < 6u32 && CUBE_POS * (UNITS as usize) < num_sums as usize {
        to[CUBE_POS * 6 + UNIT_POS as usize] = shared[UNIT_POS as usize];
    }
}
