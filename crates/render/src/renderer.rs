//! Drawing frames: the public operations of this crate.

use crate::backend::{Frame, Parameters, Probe, RenderOps};
use crate::error::{Error, Result};
use crate::kernels::cpu::project::ViewSpec;
use crate::kernels::cpu::rasterize::RasterOptions;
use crate::layout::T_FLOOR;
use crate::options::{Pass, RenderOptions};
use crate::splats::Splats;
use crate::stats::{RenderStats, SplatStats};
use crate::view_params::view_params;
use burn::backend::Dispatch;
use burn::tensor::{Device, Int, Tensor};
use gazesplat_core::Camera;

/// A drawn frame.
#[derive(Debug, Clone)]
pub struct Rendered {
    /// `[H, W, 4]`: RGB composited over the background, and alpha = 1 − T; `[H, W, 5]` with depth, Σ T α z.
    pub image: Tensor<3>,
    /// Of a frame that keeps what a gradient needs: the Gaussians in view, those whose contour α = 1/255 reaches the image.
    /// The first [`RenderStats::num_visible`] values are their rows; on a GPU more may follow, which mean nothing.
    pub visible: Tensor<1, Int>,
    /// What was done and what was skipped.
    pub stats: RenderStats,
    /// Counters per Gaussian, if asked for.
    pub splat_stats: SplatStats,
}

/// A leaf that receives the image-plane gradient of the means: what densification decides by.
#[derive(Debug, Clone)]
pub struct MeansProbe(Tensor<2>);

impl MeansProbe {
    /// A probe for `num_splats` Gaussians on the autodiff device of the splats.
    pub fn new(num_splats: usize, device: &Device) -> Self {
        Self(Tensor::zeros([num_splats, 4], device).require_grad())
    }

    /// After `backward`: `[N, 4]` = (∂L/∂x, ∂L/∂y, Σ|∂L/∂x|, Σ|∂L/∂y|) of the projected means in pixels, the last two
    /// summed per pixel (Ye 2024), zero without [`RenderOptions::absolute_gradients`]. `None` if no gradient arrived.
    pub fn gradient(&self, gradients: &burn::tensor::Gradients) -> Option<Tensor<2>> {
        self.0.grad(gradients)
    }
}

/// A leaf that receives the gradient of the camera's pose: of a motion of the camera on top of the pose it has, as a twist
/// from the left, camera_from_world' = exp(ω, v) · camera_from_world. A step along it is taken with
/// [`Camera::moved`](gazesplat_core::Camera::moved); the next frame then takes a fresh probe.
#[derive(Debug, Clone)]
pub struct PoseProbe(Tensor<1>);

impl PoseProbe {
    /// A probe on the autodiff device of the splats.
    pub fn new(device: &Device) -> Self {
        Self(Tensor::zeros([6], device).require_grad())
    }

    /// After `backward`: `[6]` = ∂L/∂(ω, v), per radian about and per world unit along the axes of the camera (OpenCV: +x
    /// right, +y down, +z forward). `None` if no gradient arrived.
    pub fn gradient(&self, gradients: &burn::tensor::Gradients) -> Option<Tensor<1>> {
        self.0.grad(gradients)
    }
}

/// Leaves that receive gradients beside those of the splats. What is not asked for costs nothing.
#[derive(Debug, Clone, Copy, Default)]
pub struct Probes<'a> {
    /// Of the projected means.
    pub means: Option<&'a MeansProbe>,
    /// Of the pose. The sum over the splats is off by rounding of its parts only on the CPU, and by ⌈log₂ V⌉ more roundings
    /// of the sum of their magnitudes for V visible splats on a GPU; its order is fixed on both.
    pub pose: Option<&'a PoseProbe>,
}

/// Draws `splats` as `camera` sees them. Differentiable with respect to everything in `splats` that is tracked.
///
/// # Errors
/// [`Error::Parameter`] for options or a camera out of range, [`Error::Shape`] if the tensors do not fit together,
/// [`Error::Limit`] if the frame needs more pairs than there are indices.
pub fn render(splats: &Splats, camera: &Camera, options: &RenderOptions) -> Result<Rendered> {
    render_with(splats, Probes::default(), camera, options)
}

/// [`render`], with the image-plane gradient of the means delivered to `probe`.
///
/// # Errors
/// As [`render`].
pub fn render_probed(
    splats: &Splats,
    probe: &MeansProbe,
    camera: &Camera,
    options: &RenderOptions,
) -> Result<Rendered> {
    render_with(splats, Probes { means: Some(probe), ..Probes::default() }, camera, options)
}

/// [`render`], with further gradients delivered to `probes`.
///
/// # Errors
/// As [`render`].
pub fn render_with(splats: &Splats, probes: Probes<'_>, camera: &Camera, options: &RenderOptions) -> Result<Rendered> {
    let frame = frame(splats, camera, options)?;
    let out = <Dispatch as RenderOps>::render_forward(parameters(splats), probe(splats, probes), frame);
    let (stats, splat_stats) = out.outcome?;
    let visible = Tensor::from_dispatch(out.saved.global_from_compact);
    Ok(Rendered { image: Tensor::from_dispatch(out.image), visible, stats, splat_stats })
}

/// The leaves, empty where nobody asks.
fn probe(splats: &Splats, probes: Probes<'_>) -> Probe<Dispatch> {
    let device = splats.device();
    let means2d = probes.means.map_or_else(|| Tensor::zeros([0, 4], &device), |probe| probe.0.clone());
    let pose = probes.pose.map_or_else(|| Tensor::zeros([0], &device), |probe| probe.0.clone());
    Probe { means2d: means2d.into_dispatch(), pose: pose.into_dispatch() }
}

/// What a frame does and is worth, without the frame.
#[derive(Debug, Clone)]
pub struct Counted {
    /// What would be done and skipped.
    pub stats: RenderStats,
    /// Counters per Gaussian and tile.
    pub splat_stats: SplatStats,
}

/// Counts what drawing `splats` as `camera` sees them does, as [`render`] with the same options would, but draws nothing:
/// colours are not evaluated, unless a termination table asks for them, and no image is written; on a GPU, whose tiles end
/// where its rasteriser says, one is composited and dropped. [`crate::StatsMode::None`] counts
/// nothing but the frame's totals.
///
/// # Errors
/// As [`render`]; [`Error::Parameter`] for a pass with gradients.
pub fn count(splats: &Splats, camera: &Camera, options: &RenderOptions) -> Result<Counted> {
    if options.pass != Pass::Inference {
        return Err(Error::Parameter {
            name: "pass",
            found: format!("{:?}", options.pass),
            expected: "a pass for inference: counting keeps nothing for a gradient",
        });
    }
    let mut frame = Frame { draws: false, ..frame(splats, camera, options)? };
    if frame.raster.lut.is_none() {
        frame.sh_degree = 0;
    }
    let probe = probe(splats, Probes::default());
    let out = <Dispatch as RenderOps>::render_forward(parameters(splats), probe, frame);
    let (stats, splat_stats) = out.outcome?;
    Ok(Counted { stats, splat_stats })
}

fn parameters(splats: &Splats) -> Parameters<Dispatch> {
    Parameters {
        means: splats.means.clone().into_dispatch(),
        quats: splats.quats.clone().into_dispatch(),
        log_scales: splats.log_scales.clone().into_dispatch(),
        opacity_logits: splats.opacity_logits.clone().into_dispatch(),
        sh: splats.sh.clone().into_dispatch(),
    }
}

/// Checks everything that can be wrong before any work, and puts it into the form the kernels read.
fn frame(splats: &Splats, camera: &Camera, options: &RenderOptions) -> Result<Frame> {
    options.validate()?;
    check_shapes(splats)?;
    let stored = splats.sh_degree();
    let sh_degree = options.sh_degree.unwrap_or(stored).min(stored);
    let (t_stop, lut) = options.termination.resolve();
    Ok(Frame {
        view: ViewSpec {
            params: view_params(camera)?,
            width: camera.intrinsics.width,
            height: camera.intrinsics.height,
            near: options.near,
            antialiased: options.antialiased,
        },
        raster: RasterOptions {
            alpha_max: options.alpha_max,
            t_stop: t_stop.max(T_FLOOR),
            lut,
            background: options.background,
            depth: options.depth,
            smooth_cutoff: options.pass == Pass::SmoothCutoff,
            absolute_gradients: options.absolute_gradients,
        },
        sh_degree,
        stats: options.stats,
        keep: options.pass != Pass::Inference,
        draws: true,
    })
}

fn check_shapes(splats: &Splats) -> Result<()> {
    let n = splats.len();
    let check = |name, found: &[usize], expected: &[usize]| match found == expected {
        true => Ok(()),
        false => Err(Error::Shape { name, found: found.to_vec(), expected: expected.to_vec() }),
    };
    check("means", &splats.means.dims(), &[n, 3])?;
    check("quats", &splats.quats.dims(), &[n, 4])?;
    check("log_scales", &splats.log_scales.dims(), &[n, 3])?;
    check("opacity_logits", &splats.opacity_logits.dims(), &[n])?;
    let k = splats.num_coefficients();
    check("sh", &splats.sh.dims(), &[n, k.max(1), 3])
}
