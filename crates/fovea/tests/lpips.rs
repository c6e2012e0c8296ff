//! LPIPS against a program of plain loops in double precision, with random weights of a narrow network.

#![expect(clippy::unwrap_used, reason = "a helper of a test may panic like the test")]

use burn::tensor::Device;
use gazesplat_core::RgbImage8;
use gazesplat_core::image::ImageF32;
use gazesplat_core::io::images::TrainingImage;
use gazesplat_fovea::Error;
use gazesplat_fovea::lpips::Lpips;
use gazesplat_render::{cpu_device, device::gpu_device};
use gazesplat_testkit::Rng;
use gazesplat_testkit::devices::required_gpu;
use gazesplat_train::losses::LossTarget;
use gazesplat_train::metrics::ImageMetric;
use safetensors::{Dtype, tensor::TensorView};
use std::path::PathBuf;
use std::sync::Arc;

/// Width after each convolution, blocks of 2, 2, 3, 3 and 3; VGG16 has 64 to 512.
const BLOCKS: [&[usize]; 5] = [&[4, 5], &[6, 5], &[7, 6, 8], &[8, 7, 8], &[6, 8, 7]];
/// Where they stand among the layers of VGG16.
const FEATURES: [&[usize]; 5] = [&[0, 2], &[5, 7], &[10, 12, 14], &[17, 19, 21], &[24, 26, 28]];

/// f32 against f64. A value passes 13 convolutions of at most 9 · 8 + 1 terms and as many roundings each, plus some 30 in
/// scaling, lengths, weights and means: 1000 roundings of 2⁻²⁴ at random signs, of sums whose terms may cancel to a fifth
/// of their size: √1000 · 2⁻²⁴ · 5 = 1e-5.
const TOLERANCE: f64 = 1e-5;

#[derive(Clone)]
struct Tensor {
    name: String,
    shape: Vec<usize>,
    values: Vec<f32>,
}

/// Weights under the names of torchvision and of the two-file layout, or of the state dict of the `lpips` package.
fn weights(of_package: bool) -> Vec<Tensor> {
    let mut rng = Rng::new(7);
    let mut random = |n: usize, low: f32, high: f32| -> Vec<f32> { (0..n).map(|_| rng.range(low, high)).collect() };
    let (mut tensors, mut num_in) = (Vec::new(), 3);
    for (block, (widths, features)) in BLOCKS.iter().zip(FEATURES).enumerate() {
        for (&num_out, feature) in widths.iter().zip(features) {
            let name =
                if of_package { format!("net.slice{}.{feature}", block + 1) } else { format!("features.{feature}") };
            let bound = (6.0 / (9 * num_in) as f32).sqrt();
            let kernel = random(num_out * num_in * 9, -bound, bound);
            tensors.push(Tensor { name: format!("{name}.weight"), shape: vec![num_out, num_in, 3, 3], values: kernel });
            let bias = random(num_out, -0.1, 0.3);
            tensors.push(Tensor { name: format!("{name}.bias"), shape: vec![num_out], values: bias });
            num_in = num_out;
        }
        let name =
            if of_package { format!("lins.{block}.model.1.weight") } else { format!("lin{block}.model.1.weight") };
        tensors.push(Tensor { name, shape: vec![1, num_in, 1, 1], values: random(num_in, 0.0, 1.0) });
    }
    tensors
}

struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn write(&self, tensors: &[Tensor]) -> PathBuf {
        let views = tensors.iter().map(|t| {
            let bytes = le_bytes(&t.values);
            (t.name.clone(), t.shape.clone(), bytes)
        });
        let views: Vec<_> = views.collect();
        let views = views.iter().map(|(n, s, b)| (n.clone(), TensorView::new(Dtype::F32, s.clone(), b).unwrap()));
        let path = self.0.path().join("weights.safetensors");
        std::fs::write(&path, safetensors::serialize(views, None).unwrap()).unwrap();
        path
    }
}

fn le_bytes(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// Sides that are odd at several levels, so that halving drops a row or a column.
fn image(seed: u64) -> ImageF32 {
    let mut rng = Rng::new(seed);
    ImageF32 { width: 39, height: 27, data: (0..39 * 27 * 3).map(|_| rng.range(-0.1, 1.1)).collect() }
}

/// Planes `[C][H][W]`.
type Planes = Vec<Vec<Vec<f64>>>;

/// The distance by its definition: sums in the order they are written down.
fn oracle(tensors: &[Tensor], a: &ImageF32, b: &ImageF32) -> f64 {
    let scaled = |image: &ImageF32| -> Planes {
        let (shift, scale) = ([-0.030, -0.088, -0.188], [0.458, 0.448, 0.450]);
        let at = |c: usize, y: usize, x: usize| {
            let value = f64::from(image.data[3 * (y * image.width as usize + x) + c]).clamp(0.0, 1.0);
            (2.0 * value - 1.0 - shift[c]) / scale[c]
        };
        let row = |c, y| (0..image.width as usize).map(|x| at(c, y, x)).collect();
        (0..3).map(|c| (0..image.height as usize).map(|y| row(c, y)).collect()).collect()
    };
    let mut planes = [scaled(a), scaled(b)];
    let mut next = tensors.iter();
    let mut total = 0.0;
    for (block, widths) in BLOCKS.iter().enumerate() {
        if block > 0 {
            planes = planes.map(|p| halved(&p));
        }
        for _ in *widths {
            let (kernel, bias) = (next.next().unwrap(), next.next().unwrap());
            planes = planes.map(|p| convolved(&p, kernel, bias));
        }
        let lin = next.next().unwrap();
        let (height, width) = (planes[0][0].len(), planes[0][0][0].len());
        let mut sum = 0.0;
        for y in 0..height {
            for x in 0..width {
                let length = |p: &Planes| p.iter().map(|plane| plane[y][x].powi(2)).sum::<f64>().sqrt() + 1e-10;
                let (first, second) = (length(&planes[0]), length(&planes[1]));
                for (c, weight) in lin.values.iter().enumerate() {
                    let d = planes[0][c][y][x] / first - planes[1][c][y][x] / second;
                    sum += f64::from(*weight) * d * d;
                }
            }
        }
        total += sum / (height * width) as f64;
    }
    total
}

fn convolved(input: &Planes, kernel: &Tensor, bias: &Tensor) -> Planes {
    let (height, width) = (input[0].len() as isize, input[0][0].len() as isize);
    let at = |c: usize, y: isize, x: isize| {
        if (0..height).contains(&y) && (0..width).contains(&x) { input[c][y as usize][x as usize] } else { 0.0 }
    };
    let value = |out: usize, y: isize, x: isize| {
        let mut sum = f64::from(bias.values[out]);
        for c in 0..input.len() {
            for (i, dy) in (-1..=1).enumerate() {
                for (j, dx) in (-1..=1).enumerate() {
                    let weight = kernel.values[((out * input.len() + c) * 3 + i) * 3 + j];
                    sum += f64::from(weight) * at(c, y + dy, x + dx);
                }
            }
        }
        sum.max(0.0)
    };
    let row = |out, y| (0..width).map(|x| value(out, y, x)).collect();
    (0..kernel.shape[0]).map(|out| (0..height).map(|y| row(out, y)).collect()).collect()
}

fn halved(input: &Planes) -> Planes {
    let largest = |plane: &[Vec<f64>], y: usize, x: usize| {
        plane[2 * y][2 * x].max(plane[2 * y][2 * x + 1]).max(plane[2 * y + 1][2 * x]).max(plane[2 * y + 1][2 * x + 1])
    };
    let halved = |plane: &Vec<Vec<f64>>| {
        let row = |y| (0..plane[0].len() / 2).map(|x| largest(plane, y, x)).collect();
        (0..plane.len() / 2).map(row).collect()
    };
    input.iter().map(halved).collect()
}

fn devices() -> Vec<(&'static str, Device)> {
    let mut devices = vec![("ndarray", cpu_device())];
    #[cfg(feature = "flex")]
    devices.push(("flex", gazesplat_render::device::flex_device()));
    devices.extend(required_gpu(gpu_device(None)).map(|gpu| ("gpu", gpu)));
    devices
}

#[test]
fn distance_is_that_of_the_definition_on_every_device() {
    let place = Place::new();
    let tensors = weights(false);
    let path = place.write(&tensors);
    for (a, b) in [(image(1), image(2)), (image(3), image(4))] {
        let expected = oracle(&tensors, &a, &b);
        assert!(expected > 0.05, "these images differ: {expected}");
        for (name, device) in devices() {
            let found = Lpips::load(&path, &device).unwrap().distance(&a, &b).unwrap();
            let error = (found - expected).abs() / expected;
            println!("{name}: {found} for {expected}, relative error {error:.1e}");
            assert!(error <= TOLERANCE, "{name}: {found}, expected {expected}");
        }
    }
}

#[test]
fn both_namings_give_the_same_network() {
    let place = Place::new();
    let distance = |of_package| {
        Lpips::load(&place.write(&weights(of_package)), &cpu_device()).unwrap().distance(&image(1), &image(2)).unwrap()
    };
    assert_eq!(distance(true), distance(false));
}

#[test]
fn distance_is_symmetric_and_zero_between_equal_images() {
    let place = Place::new();
    let path = place.write(&weights(true));
    for (name, device) in devices() {
        let lpips = Lpips::load(&path, &device).unwrap();
        let (a, b) = (image(5), image(6));
        assert_eq!(lpips.distance(&a, &b).unwrap(), lpips.distance(&b, &a).unwrap(), "{name}");
        assert_eq!(lpips.distance(&a, &a).unwrap(), 0.0, "{name}");
        // Beyond the range there is nothing to see.
        let clamped = ImageF32 { data: a.data.iter().map(|v| v.clamp(0.0, 1.0)).collect(), ..a.clone() };
        assert_eq!(lpips.distance(&a, &clamped).unwrap(), 0.0, "{name}");
        let mut broken = a.clone();
        broken.data[77] = f32::NAN;
        assert!(lpips.distance(&broken, &b).unwrap().is_nan(), "{name}");
    }
}

#[test]
fn masked_pixels_do_not_differ() {
    let place = Place::new();
    let lpips = Lpips::load(&place.write(&weights(false)), &cpu_device()).unwrap();
    let photo = image(8).to_rgb8();
    let mut render =
        ImageF32 { width: 39, height: 27, data: photo.data.iter().map(|&v| f32::from(v) / 255.0).collect() };
    let target = |mask: Option<Vec<u8>>| {
        let image = RgbImage8 { width: 39, height: 27, data: photo.data.clone() };
        LossTarget::new(Arc::new(TrainingImage { image, alpha: None, mask }), [0.0; 3])
    };
    assert_eq!((lpips.name(), lpips.measure(&render, &target(None)).unwrap()), ("lpips", 0.0));
    render.data[3 * 500] = 1.0 - render.data[3 * 500];
    assert!(lpips.measure(&render, &target(None)).unwrap() > 0.0);
    let mut mask = vec![255; 39 * 27];
    mask[500] = 0;
    assert_eq!(lpips.measure(&render, &target(Some(mask))).unwrap(), 0.0);
}

#[test]
fn images_that_cannot_be_compared_are_refused() {
    let place = Place::new();
    let lpips = Lpips::load(&place.write(&weights(false)), &cpu_device()).unwrap();
    let small = ImageF32 { width: 15, height: 40, data: vec![0.5; 15 * 40 * 3] };
    let said = lpips.distance(&small, &small).unwrap_err().to_string();
    assert_eq!(said, "image for LPIPS is [40, 15, 3], expected [16, 16, 3]");
    let other = ImageF32 { width: 40, height: 15, data: small.data.clone() };
    assert!(matches!(lpips.distance(&small, &other), Err(Error::Shape { .. })));
}

#[test]
fn files_that_are_no_weights_are_refused_with_the_reason() {
    let place = Place::new();
    let refused = |path: &PathBuf| {
        let error = Lpips::load(path, &cpu_device()).unwrap_err();
        assert!(error.hint().is_some() && matches!(error, Error::File { .. }));
        error.to_string()
    };
    let broken = |name: &str, change: &dyn Fn(&mut Tensor)| {
        let mut tensors = weights(false);
        change(tensors.iter_mut().find(|t| t.name == name).unwrap());
        refused(&place.write(&tensors))
    };
    let whole = weights(false);
    for name in ["features.0.weight", "features.28.bias", "lin3.model.1.weight"] {
        let rest: Vec<Tensor> = whole.iter().filter(|t| t.name != name).cloned().collect();
        let said = refused(&place.write(&rest));
        assert!(said.contains(&format!("the tensor `{name}` is missing, or `")), "{said}");
    }
    let said = broken("features.5.weight", &|t| t.shape.swap(0, 1));
    assert!(said.contains("`features.5.weight` has the shape [5, 6, 3, 3], expected [N, 5, 3, 3]"), "{said}");
    let said = broken("lin1.model.1.weight", &|t| t.shape = vec![5]);
    assert!(said.contains("`lin1.model.1.weight` has the shape [5], expected [1, 5, 1, 1]"), "{said}");
    let said = broken("features.7.bias", &|t| t.values[2] = f32::NAN);
    assert!(said.contains("value 2 of `features.7.bias` is NaN"), "{said}");
    let said = broken("lin2.model.1.weight", &|t| t.values[1] = -0.25);
    assert!(said.contains("`lin2.model.1.weight` has the value -0.25, expected none below 0"), "{said}");
    let path = place.0.path().join("text");
    std::fs::write(&path, "these are no weights").unwrap();
    assert!(refused(&path).contains("no safetensors file"));
    assert!(refused(&place.0.path().join("none")).contains("cannot be read"));
}
