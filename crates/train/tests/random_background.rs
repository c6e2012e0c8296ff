//! A random background: photograph and render stand on the same colour, another one each step, the same again after a resume.

#![expect(clippy::unwrap_used, reason = "a helper of a test may panic like the test")]

use burn::tensor::Tensor;
use gazesplat_core::camera::{Camera, Pinhole};
use gazesplat_core::dataset::{Dataset, SparsePoints};
use gazesplat_core::io::images::ImageCache;
use gazesplat_core::{GaussianCloud, View};
use gazesplat_render::cpu_device;
use gazesplat_train::config::{Background, NamedBackground, StrategyKind};
use gazesplat_train::losses::{ImageLoss, ImageLossValue, LossTarget};
use gazesplat_train::{Config, Trainer};
use glam::{Mat4, Vec3};
use image::{Rgba, RgbaImage};
use std::path::Path;
use std::sync::{Arc, Mutex};

/// Longest distance of an 8-bit colour from the one it was rounded from.
const HALF_STEP: f32 = 0.5 / 255.0;

/// What a step compares: the background of the photograph, a transparent pixel of it, and of the render a pixel that no
/// Gaussian covers.
#[derive(Debug, Clone, PartialEq)]
struct Seen {
    background: [f32; 3],
    photo: [f32; 3],
    render: [f32; 3],
}

/// A term that looks on and asks for nothing.
struct Spy(Arc<Mutex<Vec<Seen>>>);

impl ImageLoss for Spy {
    fn evaluate(&self, image: Tensor<3>, target: &LossTarget) -> ImageLossValue {
        let pixel: Vec<f32> = image.clone().inner().into_data().try_to_vec().unwrap();
        let seen = Seen {
            background: target.background().unwrap(),
            photo: std::array::from_fn(|c| f32::from(target.rgb()[c]) / 255.0),
            render: [pixel[0], pixel[1], pixel[2]],
        };
        self.0.lock().unwrap().push(seen);
        let device = image.device();
        let loss = image.sum().mul_scalar(0.0);
        ImageLossValue { loss, terms: Tensor::zeros([1], &device).inner(), names: &["spy"] }
    }
}

/// Three views whose left half is transparent, of one Gaussian that is seen in their right half.
fn scene(dir: &Path) -> (Dataset, GaussianCloud) {
    let view = |index: u32| {
        let path = dir.join(format!("{index}.png"));
        let color = |x: u32| if x < 16 { Rgba([9, 9, 9, 0]) } else { Rgba([200, 40 + index as u8, 90, 255]) };
        RgbaImage::from_fn(32, 24, |x, _| color(x)).save(&path).unwrap();
        View {
            name: format!("{index}.png"),
            camera: Camera {
                intrinsics: Pinhole::from_fov_x(32, 24, 1.0),
                camera_from_world: Mat4::from_translation(Vec3::new(0.01 * index as f32, 0.0, 0.0)),
            },
            image_path: Some(path),
            distortion: None,
            mask_path: None,
        }
    };
    let dataset = Dataset { train: (0..3).map(view).collect(), points: SparsePoints::default(), ..Dataset::default() };
    let cloud = GaussianCloud {
        means: vec![[0.6, 0.0, 2.0]],
        quats: vec![[1.0, 0.0, 0.0, 0.0]],
        log_scales: vec![[-3.0; 3]],
        opacity_logits: vec![1.0],
        sh_degree: 0,
        sh: vec![[0.3; 3]],
    };
    (dataset, cloud)
}

fn config(background: NamedBackground) -> Config {
    let mut config = Config::default();
    config.train.steps = 20;
    config.model.sh_degree = 0;
    config.densify.strategy = StrategyKind::None;
    config.data.background = Background::Named(background);
    config
}

/// What `num_steps` steps see.
fn watched(trainer: &mut Trainer, num_steps: u32) -> Vec<Seen> {
    let seen = Arc::new(Mutex::new(Vec::new()));
    trainer.add_loss(1.0, Box::new(Spy(Arc::clone(&seen))));
    for _ in 0..num_steps {
        trainer.step().unwrap();
    }
    let seen = seen.lock().unwrap();
    seen.clone()
}

#[test]
fn photograph_and_render_stand_on_the_same_random_colour_in_every_step() {
    let dir = tempfile::tempdir().unwrap();
    let (dataset, cloud) = scene(dir.path());
    let device = cpu_device();
    let images = || Arc::new(ImageCache::new(dataset.train.clone(), 1 << 20));
    let fresh = |config: &Config| Trainer::from_cloud(&cloud, &dataset, images(), config, &device).unwrap();
    let random = config(NamedBackground::Random);
    let seen = watched(&mut fresh(&random), 20);
    for step in &seen {
        assert_eq!(step.render, step.background, "nothing covers the corner");
        for c in 0..3 {
            // The photograph is kept in 8 bits; what f32 adds is below a thousandth of that.
            assert!((step.photo[c] - step.background[c]).abs() <= 1.001 * HALF_STEP, "{step:?}");
        }
    }
    for (index, step) in seen.iter().enumerate() {
        assert!(seen[..index].iter().all(|other| other.background != step.background), "each step has its own");
    }
    for c in 0..3 {
        // Of 20 uniform numbers: all on one side of a half once in half a million draws; the seed is fixed.
        let is_low: Vec<bool> = seen.iter().map(|step| step.background[c] < 0.5).collect();
        assert!(is_low.contains(&true) && is_low.contains(&false), "channel {c}");
    }

    // Interrupted after 7 steps, the rest sees what it would have seen.
    let path = dir.path().join("checkpoint");
    let mut first = fresh(&random);
    assert_eq!(watched(&mut first, 7), seen[..7]);
    first.save(&path, &"noted").unwrap();
    let (mut second, _): (Trainer, String) = Trainer::resume(&dataset, images(), &random, &device, &path).unwrap();
    assert_eq!(watched(&mut second, 13), seen[7..]);

    let white = watched(&mut fresh(&config(NamedBackground::White)), 2);
    assert!(white.iter().all(|step| step.background == [1.0; 3] && step.render == [1.0; 3] && step.photo == [1.0; 3]));
}
