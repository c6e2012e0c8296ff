//! Scenes of tests, how they are rendered with gradients, and how they are handed to the float64 reference.

pub mod scenes;

use burn::tensor::{Device, Tensor, TensorData};
use gazesplat_core::{Camera, GaussianCloud};
use gazesplat_render::{
    ColorMax, MeansProbe, Pass, PoseProbe, Probes, RenderOptions, RenderStats, Rendered, Residual, SplatStats, Splats,
    Termination, TerminationLut, cpu_device, render, render_with,
};
use gazesplat_testkit::reference;
use std::cell::RefCell;

/// What is rendered.
#[derive(Clone)]
pub struct Scene {
    /// The Gaussians.
    pub cloud: GaussianCloud,
    /// The view.
    pub camera: Camera,
    /// The options; depth is on, so that all channels are tested.
    pub options: RenderOptions,
}

/// A rendered frame on the host.
#[derive(Clone, PartialEq)]
pub struct Frame {
    /// `[H, W, channels]`: RGB, alpha, and depth where asked for.
    pub image: Vec<f32>,
    /// Values per pixel.
    pub channels: usize,
    /// What was skipped.
    pub stats: RenderStats,
    /// Counters of each Gaussian, empty where not asked for.
    pub splat_stats: SplatStats,
}

/// Gradients of Σ upstream · image with respect to the parameters as stored, flat.
#[derive(Clone, PartialEq)]
pub struct Gradients {
    /// `[N, 3]`.
    pub means: Vec<f32>,
    /// `[N, 4]`.
    pub quats: Vec<f32>,
    /// `[N, 3]`.
    pub log_scales: Vec<f32>,
    /// `[N]`.
    pub opacity_logits: Vec<f32>,
    /// `[N, K, 3]`.
    pub sh: Vec<f32>,
    /// `[N, 4]`: gradient of the image-plane mean in pixels, and the sums of its absolute values over pixels.
    pub means2d: Vec<f32>,
    /// `[6]`: of the camera's pose as a twist from the left, (ω, v).
    pub pose: Vec<f32>,
}

impl Gradients {
    /// Names and values of all groups of rows.
    pub fn groups(&self) -> [(&'static str, &[f32]); 6] {
        [
            ("means", &self.means),
            ("quats", &self.quats),
            ("log_scales", &self.log_scales),
            ("opacity_logits", &self.opacity_logits),
            ("sh", &self.sh),
            ("means2d", &self.means2d),
        ]
    }

    /// Asserts that every value is finite.
    #[track_caller]
    pub fn assert_finite(&self, what: &str) {
        for (name, values) in self.groups() {
            gazesplat_testkit::close::assert_finite(&format!("{what}: gradient of {name}"), values);
        }
        gazesplat_testkit::close::assert_finite(&format!("{what}: gradient of the pose"), &self.pose);
    }

    /// Rows `keep` of every group; the pose has none.
    pub fn rows(&self, keep: &[usize]) -> Self {
        let n = self.opacity_logits.len();
        let pick = |values: &[f32]| {
            let width = values.len() / n;
            keep.iter().flat_map(|&i| values[i * width..(i + 1) * width].to_vec()).collect()
        };
        Self {
            means: pick(&self.means),
            quats: pick(&self.quats),
            log_scales: pick(&self.log_scales),
            opacity_logits: pick(&self.opacity_logits),
            sh: pick(&self.sh),
            means2d: pick(&self.means2d),
            pose: self.pose.clone(),
        }
    }
}

thread_local! {
    /// The device that this thread's scenes are rendered on, where it is not the default one.
    static DEVICE: RefCell<Option<Device>> = const { RefCell::new(None) };
}

/// The device that scenes are rendered on: NdArray, or the GPU inside [`on_gpu!`] tests.
pub fn device() -> Device {
    DEVICE.with_borrow(|device| device.clone().unwrap_or_else(cpu_device))
}

/// True inside the tests that [`on_gpu!`] makes.
pub fn is_on_gpu() -> bool {
    gazesplat_render::is_gpu(&device())
}

/// Runs the body of a test on the GPU; skipped aloud where there is none.
pub fn with_gpu(body: fn()) {
    let Some(gpu) = gazesplat_testkit::devices::required_gpu(gazesplat_render::device::gpu_device(None)) else {
        return;
    };
    DEVICE.set(Some(gpu));
    body();
    DEVICE.set(None);
}

/// Makes a second test of each body named, which renders on the GPU.
macro_rules! on_gpu {
    ($($body:ident),+ $(,)?) => {
        /// The same bodies on the GPU.
        mod on_gpu {
            $(
                #[test]
                fn $body() {
                    crate::common::with_gpu(super::$body);
                }
            )+
        }
    };
}
pub(crate) use on_gpu;

/// Every CPU device of this build, with its name; inside [`on_gpu!`] tests the GPU alone.
pub fn devices() -> Vec<(&'static str, Device)> {
    if is_on_gpu() {
        return vec![("wgpu", device())];
    }
    let mut devices = vec![("ndarray", cpu_device())];
    if cfg!(feature = "flex") {
        #[cfg(feature = "flex")]
        devices.push(("flex", gazesplat_render::flex_device()));
    } else {
        eprintln!("SKIPPED: Flex is not part of this build");
    }
    devices
}

/// Values of a tensor.
pub fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_to_vec().expect("tensors of the renderer are f32")
}

impl Scene {
    /// Number of values per pixel.
    pub fn channels(&self) -> usize {
        if self.options.depth { 5 } else { 4 }
    }

    /// Number of values of the image.
    pub fn image_len(&self) -> usize {
        (self.camera.intrinsics.width * self.camera.intrinsics.height) as usize * self.channels()
    }

    /// Renders on the [`device`] of this test, without gradients.
    pub fn frame(&self) -> Frame {
        self.frame_on(&device())
    }

    /// Counts on the [`device`] of this test, without an image.
    pub fn counted(&self) -> gazesplat_render::Counted {
        let splats = Splats::from_cloud(&self.cloud, &device()).expect("it fits");
        gazesplat_render::count(&splats, &self.camera, &self.options).expect("the scene is legal")
    }

    /// Renders without gradients.
    pub fn frame_on(&self, device: &Device) -> Frame {
        let splats = Splats::from_cloud(&self.cloud, device).expect("it fits");
        let out = render(&splats, &self.camera, &self.options).expect("the scene is legal");
        self.collect(host(out.image), out.stats, out.splat_stats)
    }

    /// Expected depth on the [`device`] of this test, `[H, W]`.
    pub fn expected_depth(&self) -> Vec<f32> {
        let splats = Splats::from_cloud(&self.cloud, &device()).expect("it fits");
        let out = render(&splats, &self.camera, &self.options).expect("the scene is legal");
        host(out.expected_depth().expect("the scene asks for depth"))
    }

    /// Gradients of Σ upstream · expected depth on the [`device`] of this test; `upstream` is `[H, W]`.
    pub fn expected_depth_gradients(&self, upstream: &[f32]) -> Gradients {
        self.gradients_of(&device(), |out| {
            let depth = out.expected_depth().expect("the scene asks for depth");
            let weights = TensorData::new(upstream.to_vec(), depth.dims());
            (depth.clone() * Tensor::from_data(weights, &depth.device())).sum()
        })
        .1
    }

    /// Renders on the [`device`] of this test and pulls `upstream` (as long as the image) back to the parameters.
    pub fn frame_and_gradients(&self, upstream: &[f32]) -> (Frame, Gradients) {
        self.frame_and_gradients_on(&device(), upstream)
    }

    /// Renders and pulls `upstream` (as long as the image) back to the parameters.
    pub fn frame_and_gradients_on(&self, device: &Device, upstream: &[f32]) -> (Frame, Gradients) {
        self.gradients_of(device, |out| {
            let weights = TensorData::new(upstream.to_vec(), out.image.dims());
            (out.image.clone() * Tensor::<3>::from_data(weights, &out.image.device())).sum()
        })
    }

    /// Renders, and the gradients of `loss` with respect to the parameters.
    fn gradients_of(&self, device: &Device, loss: impl FnOnce(&Rendered) -> Tensor<1>) -> (Frame, Gradients) {
        let device = device.clone().autodiff();
        let n = self.cloud.len();
        let splats = Splats::from_cloud(&self.cloud, &device).expect("it fits").require_grad();
        let (probe, pose) = (MeansProbe::new(n, &device), PoseProbe::new(&device));
        let probes = Probes { means: Some(&probe), pose: Some(&pose) };
        let options = RenderOptions { pass: training(self.options.pass), ..self.options.clone() };
        let out = render_with(&splats, probes, &self.camera, &options).expect("the scene is legal");
        let grads = loss(&out).backward();
        let frame = self.collect(host(out.image), out.stats, out.splat_stats);
        fn values<const D: usize>(gradient: Option<Tensor<D>>, len: usize) -> Vec<f32> {
            gradient.map_or_else(|| vec![0.0; len], host)
        }
        let gradients = Gradients {
            means: values(splats.means.grad(&grads), 3 * n),
            quats: values(splats.quats.grad(&grads), 4 * n),
            log_scales: values(splats.log_scales.grad(&grads), 3 * n),
            opacity_logits: values(splats.opacity_logits.grad(&grads), n),
            sh: values(splats.sh.grad(&grads), 3 * n * self.cloud.num_coefficients()),
            means2d: values(probe.gradient(&grads), 4 * n),
            pose: values(pose.gradient(&grads), 6),
        };
        (frame, gradients)
    }

    /// Why the renderer refuses these options, `None` when it does not.
    pub fn refusal(&self, options: &RenderOptions) -> Option<gazesplat_render::Error> {
        render(&Splats::from_cloud(&self.cloud, &device()).expect("it fits"), &self.camera, options).err()
    }

    fn collect(&self, image: Vec<f32>, stats: RenderStats, splat_stats: SplatStats) -> Frame {
        assert_eq!(image.len(), self.image_len(), "size of the image");
        Frame { image, channels: self.channels(), stats, splat_stats }
    }

    /// The Gaussians as the reference takes them.
    pub fn reference_gaussians(&self) -> reference::Gaussians {
        let wide = |v: &[[f32; 3]]| v.iter().map(|r| r.map(f64::from)).collect();
        reference::Gaussians {
            means: wide(&self.cloud.means),
            quats: self.cloud.quats.iter().map(|q| q.map(f64::from)).collect(),
            log_scales: wide(&self.cloud.log_scales),
            opacity_logits: self.cloud.opacity_logits.iter().map(|&o| f64::from(o)).collect(),
            num_coefficients: self.cloud.num_coefficients(),
            sh: wide(&self.cloud.sh),
        }
    }

    /// The view as the reference takes it.
    pub fn reference_camera(&self) -> reference::Camera {
        let p = self.camera.intrinsics;
        reference::Camera {
            width: p.width as usize,
            height: p.height as usize,
            focal: [p.fx, p.fy].map(f64::from),
            center: [p.cx, p.cy].map(f64::from),
            camera_from_world: std::array::from_fn(|row| {
                self.camera.camera_from_world.row(row).to_array().map(f64::from)
            }),
        }
    }

    /// The options as the reference takes them.
    pub fn reference_options(&self) -> reference::Options {
        let (stop, table) = match &self.options.termination {
            Termination::Fixed(stop) => (*stop, None),
            Termination::Lut(lut) => (lut.also_fixed().unwrap_or(0.0), Some(reference_table(lut))),
        };
        reference::Options {
            near: self.options.near.into(),
            alpha_max: self.options.alpha_max.into(),
            stop: stop.into(),
            table,
            background: self.options.background.map(f64::from),
            sh_degree: self.options.sh_degree.unwrap_or(self.cloud.sh_degree),
            antialiased: self.options.antialiased,
            ..reference::Options::default()
        }
    }

    /// The float64 reference of this scene.
    pub fn reference(&self) -> reference::Frame {
        reference::render(&self.reference_gaussians(), &self.reference_camera(), &self.reference_options())
    }
}

fn reference_table(lut: &TerminationLut) -> reference::Table {
    reference::Table {
        size: lut.size(),
        limits: lut.limits().iter().map(|&v| v.into()).collect(),
        residual: match lut.residual() {
            Residual::Drop => reference::TableResidual::Drop,
            Residual::Background => reference::TableResidual::Background,
            Residual::Mean => reference::TableResidual::Mean,
            Residual::Centre => reference::TableResidual::Centre,
        },
        is_tile_bound: lut.color_max() == ColorMax::Tile,
    }
}

/// The pass with gradients that belongs to a pass.
fn training(pass: Pass) -> Pass {
    match pass {
        Pass::SmoothCutoff => Pass::SmoothCutoff,
        _ => Pass::Train,
    }
}

/// The image of a reference frame, interleaved like the renderer's: RGB, alpha, depth.
pub fn interleaved(frame: &reference::Frame, channels: usize) -> Vec<f64> {
    let mut image = Vec::with_capacity(frame.alpha.len() * channels);
    for ((color, &alpha), &depth) in frame.color.iter().zip(&frame.alpha).zip(&frame.depth) {
        image.extend(color);
        image.extend(&[alpha, depth][..channels - 3]);
    }
    image
}

/// Values of the pixels that are not fragile, of an interleaved image.
pub fn sturdy<T: Copy>(image: &[T], channels: usize, fragile: &[bool]) -> Vec<T> {
    image.chunks_exact(channels).zip(fragile).filter(|(_, f)| !**f).flat_map(|(p, _)| p.to_vec()).collect()
}
