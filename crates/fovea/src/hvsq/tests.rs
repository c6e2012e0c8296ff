//! HVSQ as an operation, a loss and a metric: backends, masks, the cache, refusals.

use super::op::{HvsqTarget, hvsq};
use super::*;
use crate::hvs::pooling::GazePooling;
use burn::tensor::{Device, Tensor, TensorData};
use gazesplat_core::Gaze;
use gazesplat_core::color::from_u8;
use gazesplat_core::image::{ImageF32, RgbImage8};
use gazesplat_core::io::images::TrainingImage;
use gazesplat_testkit::Rng;
use gazesplat_testkit::devices::required_gpu;
use gazesplat_train::losses::{LossTarget, WeightedLosses};
use gazesplat_train::metrics::{Bound, Guard, ImageMetric};

const SIZE: (usize, usize) = (70, 45);

fn uniform(size_px: f64) -> Pooling {
    Pooling::Uniform { size_px }
}

fn loss_of(size_px: f64) -> Hvsq {
    Hvsq::new(uniform(size_px), Distance::L1).unwrap()
}

fn photo(seed: u64, mask: Option<Vec<u8>>) -> LossTarget {
    let mut rng = Rng::new(seed);
    let data = (0..SIZE.0 * SIZE.1 * 3).map(|_| rng.below(256) as u8).collect();
    let image = RgbImage8 { width: SIZE.0 as u32, height: SIZE.1 as u32, data };
    LossTarget::new(Arc::new(TrainingImage { image, alpha: None, mask }), [0.0; 3])
}

fn colors(target: &LossTarget) -> Vec<f32> {
    target.rgb().iter().map(|v| from_u8(*v)).collect()
}

fn noise(seed: u64, channels: usize) -> Vec<f32> {
    let mut rng = Rng::new(seed);
    (0..SIZE.0 * SIZE.1 * channels).map(|_| rng.unit() as f32).collect()
}

fn view(data: &[f32]) -> ImageView<'_, f32> {
    ImageView { width: SIZE.0, height: SIZE.1, channels: data.len() / (SIZE.0 * SIZE.1), data }
}

fn gpu() -> Option<Device> {
    required_gpu(gazesplat_render::device::gpu_device(None))
}

fn devices() -> Vec<Device> {
    #[cfg(feature = "flex")]
    let flex = Some(gazesplat_render::flex_device());
    #[cfg(not(feature = "flex"))]
    let flex = None;
    [Some(gazesplat_render::cpu_device()), flex, gpu()].into_iter().flatten().collect()
}

fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_to_vec().unwrap()
}

/// Value and gradient of `weight` times HVSQ through Burn.
fn differentiated(device: &Device, image: &[f32], target: HvsqTarget, weight: f32) -> (f32, Vec<f32>) {
    let channels = image.len() / (SIZE.0 * SIZE.1);
    let data = TensorData::new(image.to_vec(), [SIZE.1, SIZE.0, channels]);
    let image = Tensor::<3>::from_data(data, device).autodiff().require_grad();
    let value = hvsq(image.clone(), target).mul_scalar(weight);
    let gradients = value.backward();
    (values(value.inner())[0], values(image.grad(&gradients).expect("the image is a leaf")))
}

#[test]
fn every_backend_has_the_value_and_gradient_of_the_kernel() {
    let (target, image) = (photo(1, None), noise(2, 4));
    for pooling in [uniform(1.0), uniform(3.0), Pooling::Gaze(GazePooling { alpha: 0.5, ..GazePooling::default() })] {
        let reference = Hvsq::new(pooling, Distance::Mse).unwrap().reference(view(&colors(&target))).unwrap();
        let (value, gradient) = reference.value_and_gradient(view(&image)).unwrap();
        let tripled: Vec<f32> = gradient.iter().map(|v| 3.0 * v).collect();
        for device in devices() {
            let of = HvsqTarget { reference: reference.clone(), photo: None };
            let (found, v_image) = differentiated(&device, &image, of.clone(), 1.0);
            assert_eq!((found, &v_image), (value as f32, &gradient), "{pooling:?}");
            assert_eq!(differentiated(&device, &image, of.clone(), 3.0).1, tripled, "{pooling:?}");
            let plain = Tensor::from_data(TensorData::new(image.clone(), [SIZE.1, SIZE.0, 4]), &device);
            assert_eq!(values(hvsq(plain, of)), [value as f32]);
        }
    }
}

/// Relative error of a value of the GPU against one of the CPU (hvsq.md §12, test 14).
const GPU_VALUE: f64 = 1e-5;
/// Relative L2 error of gradients in f32 (hvsq.md §12, test 6): signs of tiny differences flip where distances are L1.
fn gpu_gradient(distance: Distance) -> f64 {
    if distance == Distance::L1 { 2e-2 } else { 1e-4 }
}

/// Looked at: the centre, a corner, far outside, a pixel centre.
fn gazes() -> impl Iterator<Item = Pooling> {
    [(0.5, 0.5), (0.0, 1.0), (3.0, -2.0), (20.5 / 70.0, 12.5 / 45.0)].into_iter().map(|(x, y)| {
        let gaze = Gaze::new(x, y).unwrap();
        Pooling::Gaze(GazePooling { gaze, alpha: 0.4, ..GazePooling::default() })
    })
}

fn noise_of(seed: u64, (width, height): (usize, usize), channels: usize) -> Vec<f32> {
    let mut rng = Rng::new(seed);
    (0..width * height * channels).map(|_| rng.unit() as f32).collect()
}

fn view_of(data: &[f32], (width, height): (usize, usize)) -> ImageView<'_, f32> {
    ImageView { width, height, channels: data.len() / (width * height), data }
}

/// Value and gradient in all forms, of sizes that no tile or workgroup divides, a single pixel among them.
#[test]
fn gpu_equals_cpu_in_value_and_gradient() {
    let Some(gpu) = gpu() else { return };
    let sizes = [((1, 1), 3), ((5, 70), 4), ((33, 47), 3), ((64, 32), 3), ((150, 90), 5)];
    let poolings = [1.0, 1.5, 2.0, 2.5, 3.0, 7.0, 12.0, 29.7, 32.0].map(uniform).into_iter().chain(gazes());
    for pooling in poolings {
        for distance in [Distance::Mse, Distance::L1] {
            for (size, channels) in sizes {
                let what = format!("{pooling:?} {distance:?} {size:?}");
                let (a, b) = (noise_of(1, size, 3), noise_of(2, size, channels));
                let (a, b) = (view_of(&a, size), view_of(&b, size));
                let hvsq = Hvsq::new(pooling, distance).unwrap();
                let (value, gradient) = hvsq.reference(a).unwrap().value_and_gradient(b).unwrap();
                let on_gpu = hvsq.reference_on(a, &gpu).unwrap();
                assert!(on_gpu.is_on_gpu() && on_gpu.size() == size);
                let (found, v_image) = on_gpu.value_and_gradient(b).unwrap();
                let alone = on_gpu.value(b).unwrap();
                for found in [found, alone] {
                    assert!((found / value - 1.0).abs() < GPU_VALUE, "{what}: {found:e} instead of {value:e}");
                }
                let d = gazesplat_testkit::difference(
                    &v_image,
                    &gradient.iter().map(|v| f64::from(*v)).collect::<Vec<_>>(),
                );
                assert!(d.relative_l2 < gpu_gradient(distance), "{what}: {d:?}");
                assert!(v_image.chunks_exact(channels).all(|pixel| pixel[3..].iter().all(|v| *v == 0.0)), "{what}");
            }
        }
    }
}

#[test]
fn gpu_equals_cpu_by_region() {
    let Some(gpu) = gpu() else { return };
    let size = (45, 70);
    let (a, b) = (noise_of(3, size, 3), noise_of(4, size, 3));
    let (a, b) = (view_of(&a, size), view_of(&b, size));
    let labels: Vec<u8> = (0..45 * 70).map(|i| ((i % 45) / 12 + (i / 45) / 30) as u8 % 3).collect();
    for pooling in [1.0, 2.0, 3.0, 7.5].map(uniform).into_iter().chain(gazes()) {
        for distance in [Distance::Mse, Distance::L1] {
            let hvsq = Hvsq::new(pooling, distance).unwrap();
            let expected = hvsq.reference(a).unwrap().by_region(b, &labels, 4).unwrap();
            let found = hvsq.reference_on(a, &gpu).unwrap().by_region(b, &labels, 4).unwrap();
            assert_eq!(found[3], None);
            for (found, expected) in found[..3].iter().zip(&expected) {
                let (found, expected) = (found.unwrap(), expected.unwrap());
                assert!((found / expected - 1.0).abs() < GPU_VALUE, "{pooling:?}: {found:e} {expected:e}");
            }
        }
    }
}

/// An image whose responses no adapter takes is refused by their bytes, before anything is allocated.
#[test]
fn images_too_large_for_the_adapter_are_refused() {
    let Some(gpu) = gpu() else { return };
    for pooling in [uniform(3.0), Pooling::Gaze(GazePooling::default())] {
        let hvsq = Hvsq::new(pooling, Distance::L1).unwrap();
        assert_eq!(hvsq.check_size_on((960, 540), &gpu), Ok(()));
        let refused = hvsq.check_size_on((1 << 16, 1 << 16), &gpu);
        assert!(matches!(refused, Err(Error::Render(gazesplat_render::Error::Limit { .. }))), "{refused:?}");
        assert_eq!(hvsq.check_size_on((1 << 16, 1 << 16), &gazesplat_render::cpu_device()), Ok(()));
    }
}

/// Equal images; two runs; NaN in either image.
#[test]
fn gpu_gives_zero_the_same_bits_and_nan() {
    let Some(gpu) = gpu() else { return };
    let size = (70, 45);
    let (a, b) = (noise_of(5, size, 3), noise_of(6, size, 3));
    let mut spoilt = a.clone();
    spoilt[3 * (17 * 70 + 5) + 2] = f32::NAN;
    let flat = vec![0.25f32; a.len()];
    let [a, b, spoilt, flat] = [&a, &b, &spoilt, &flat].map(|data| view_of(data, size));
    for pooling in [1.0, 2.0, 3.0, 7.5].map(uniform).into_iter().chain(gazes()) {
        for distance in [Distance::Mse, Distance::L1] {
            let hvsq = Hvsq::new(pooling, distance).unwrap();
            let reference = |image| hvsq.reference_on(image, &gpu).unwrap();
            for image in [a, flat] {
                let (value, v_image) = reference(image).value_and_gradient(image).unwrap();
                assert!(value == 0.0 && v_image.iter().all(|v| *v == 0.0), "{pooling:?} {distance:?}: {value:e}");
            }
            let run = || {
                let (value, v_image) = reference(a).value_and_gradient(b).unwrap();
                (value.to_bits(), v_image.iter().map(|v| v.to_bits()).collect::<Vec<_>>())
            };
            assert!(run() == run(), "{pooling:?} {distance:?}");
            assert!(reference(a).value(spoilt).unwrap().is_nan(), "{pooling:?} {distance:?}");
            assert!(reference(spoilt).value(a).unwrap().is_nan(), "{pooling:?} {distance:?}");
        }
    }
}

/// The operation with the reference on the adapter: as the kernels on the host, with a mask and without, and through the
/// loss, whose statistics live where the image does.
#[test]
fn operation_stays_on_the_gpu() {
    let Some(gpu) = gpu() else { return };
    let mut rng = Rng::new(20);
    let mask: Vec<u8> = (0..SIZE.0 * SIZE.1).map(|_| u8::from(rng.unit() > 0.3)).collect();
    let image = noise(21, 4);
    for (target, is_masked) in [(photo(22, None), false), (photo(22, Some(mask.clone())), true)] {
        for (p, distance) in [(1.0, Distance::Mse), (3.0, Distance::Mse), (3.0, Distance::L1)] {
            let cache = Arc::new(ReferenceCache::new(Hvsq::new(uniform(p), distance).unwrap(), 1 << 30));
            let of = |reference| HvsqTarget { reference, photo: Some(target.clone()) };
            let on_gpu = of(cache.get_on(&target, &gpu).unwrap());
            assert!(on_gpu.reference.is_on_gpu());
            let cpu = gazesplat_render::cpu_device();
            let (value, gradient) = differentiated(&cpu, &image, of(cache.get(&target).unwrap()), 3.0);
            let gradient: Vec<f64> = gradient.iter().map(|v| f64::from(*v)).collect();
            // An image on the host comes to the reference, too.
            for device in [&gpu, &cpu] {
                let (found, v_image) = differentiated(device, &image, on_gpu.clone(), 3.0);
                assert!(f64::from(found / value - 1.0).abs() < GPU_VALUE, "p {p}: {found:e} instead of {value:e}");
                let d = gazesplat_testkit::difference(&v_image, &gradient);
                assert!(d.relative_l2 < gpu_gradient(distance), "p {p}: {d:?}");
                for (v, m) in v_image.chunks_exact(4).zip(&mask).filter(|_| is_masked) {
                    assert_eq!(*m == 0, v.iter().all(|v| *v == 0.0));
                }
            }
            let losses = WeightedLosses::default().with(0.5, Box::new(HvsqLoss::new(Arc::clone(&cache))));
            let num_misses = cache.num_misses();
            let tensor = Tensor::from_data(TensorData::new(image.clone(), [SIZE.1, SIZE.0, 4]), &gpu);
            let report = losses.evaluate(tensor, &target).unwrap().read().unwrap();
            assert!(f64::from(report.get("hvsq").unwrap() * 3.0 / value - 1.0).abs() < GPU_VALUE, "{report:?}");
            let expected = if p == 1.0 { num_misses + 1 } else { num_misses };
            assert_eq!(cache.num_misses(), expected, "statistics on the GPU are kept like those on the host");
        }
    }
}

/// What is drawn under a mask changes neither value nor gradient.
#[test]
fn masked_pixels_do_not_matter() {
    let mut rng = Rng::new(3);
    let mask: Vec<u8> = (0..SIZE.0 * SIZE.1).map(|_| u8::from(rng.unit() > 0.3)).collect();
    let target = photo(4, Some(mask.clone()));
    let cache = ReferenceCache::new(loss_of(3.0), loss::DEFAULT_CACHE_BYTES);
    let image = noise(5, 3);
    let mut other = image.clone();
    for (pixel, _) in other.chunks_exact_mut(3).zip(&mask).filter(|(_, m)| **m == 0) {
        pixel.fill(f32::NAN);
    }
    let device = gazesplat_render::cpu_device();
    let of = || HvsqTarget { reference: cache.get(&target).unwrap(), photo: Some(target.clone()) };
    let (found, v_image) = differentiated(&device, &image, of(), 1.0);
    assert_eq!((found, v_image.clone()), differentiated(&device, &other, of(), 1.0));
    assert!(found > 0.0);
    for (v, m) in v_image.chunks_exact(3).zip(&mask) {
        assert_eq!(*m == 0, v.iter().all(|v| *v == 0.0));
    }
}

#[test]
fn loss_reports_its_term_and_metric_its_name() {
    let target = photo(6, None);
    let cache = Arc::new(ReferenceCache::new(loss_of(3.0), loss::DEFAULT_CACHE_BYTES));
    let losses = WeightedLosses::default().with(0.5, Box::new(HvsqLoss::new(Arc::clone(&cache))));
    let image = noise(7, 3);
    let expected = cache.get(&target).unwrap().value(view(&image)).unwrap();
    let device = gazesplat_render::cpu_device();
    let tensor = Tensor::from_data(TensorData::new(image.clone(), [SIZE.1, SIZE.0, 3]), &device);
    let report = losses.evaluate(tensor, &target).unwrap().read().unwrap();
    assert_eq!(report.get("hvsq"), Some(expected as f32));
    assert_eq!(report.total, 0.5 * expected as f32);

    let metric = HvsqMetric::new(cache);
    assert_eq!(metric.name(), "hvsq@3");
    let image = ImageF32 { width: SIZE.0 as u32, height: SIZE.1 as u32, data: image };
    assert_eq!(metric.measure(&image, &target).unwrap(), expected);
    let guard = Guard::default().with(Box::new(metric), Bound::AtMost(1.5 * expected));
    assert!(guard.holds(&[guard.measure(&image, &target).unwrap()]));
    let smaller = ImageF32::filled(3, 3, [0.0; 3]);
    assert!(guard.measure(&smaller, &target).is_err());
}

#[test]
fn statistics_are_computed_once_per_photograph_and_dropped_when_they_take_too_much() {
    let (one, two) = (photo(8, None), photo(9, None));
    let cache = ReferenceCache::new(loss_of(3.0), loss::DEFAULT_CACHE_BYTES);
    let image = noise(10, 3);
    let value =
        |cache: &ReferenceCache, target: &LossTarget| cache.get(target).unwrap().value(view(&image)).unwrap().to_bits();
    let first = [value(&cache, &one), value(&cache, &two)];
    assert_eq!([value(&cache, &one), value(&cache, &two.clone())], first);
    assert_eq!(cache.num_misses(), 2);

    let num_bytes = cache.get(&one).unwrap().num_bytes();
    let small = ReferenceCache::new(loss_of(3.0), num_bytes + num_bytes / 2);
    // Room for one: each takes the place of the other.
    for (target, num_misses) in [(&one, 1), (&one, 1), (&two, 2), (&two, 2), (&one, 3)] {
        let expected = if std::ptr::eq(target, &one) { first[0] } else { first[1] };
        assert_eq!(value(&small, target), expected);
        assert_eq!(small.num_misses(), num_misses);
    }
}

#[test]
fn transparent_photographs_are_kept_apart_by_their_background() {
    let data = vec![100; SIZE.0 * SIZE.1 * 3];
    let image = RgbImage8 { width: SIZE.0 as u32, height: SIZE.1 as u32, data };
    let alpha = (0..SIZE.0 * SIZE.1).map(|i| (i % 256) as u8).collect();
    let photo = Arc::new(TrainingImage { image, alpha: Some(alpha), mask: None });
    let cache = ReferenceCache::new(loss_of(3.0), loss::DEFAULT_CACHE_BYTES);
    for background in [[0.0; 3], [1.0; 3], [0.0; 3]] {
        let target = LossTarget::new(Arc::clone(&photo), background);
        let own = colors(&target);
        assert_eq!(cache.get(&target).unwrap().value(view(&own)).unwrap(), 0.0);
    }
    assert_eq!(cache.num_misses(), 2);
}

/// 50 grids of means and mean squares and the residual: half a float per value and map at p = 3 against two.
#[test]
fn cached_statistics_take_the_memory_of_their_grids() {
    let (width, height) = (960, 544);
    let data = vec![0.5; width * height * 3];
    let image = ImageView { width, height, channels: 3, data: &data };
    for (p, megabytes) in [(3.0, 35.0), (7.0, 6.5), (12.0, 2.3)] {
        let num_bytes = loss_of(p).reference(image).unwrap().num_bytes();
        assert!(num_bytes as f64 <= megabytes * 1e6, "p {p}: {num_bytes} bytes");
    }
}

#[test]
fn bad_input_is_refused_by_name() {
    let data = vec![0.5; 40 * 33 * 3];
    let image = |width, height, channels| ImageView { width, height, channels, data: &data[..] };
    let good = image(40, 33, 3);
    let parameter = |result: Result<HvsqReference>| match result {
        Err(Error::Parameter { name, .. }) => name,
        other => panic!("{other:?}"),
    };
    // Both sides are enlarged to 64 first.
    assert!(loss_of(64.0).reference(good).is_ok());
    assert_eq!(parameter(loss_of(64.5).reference(good)), "pooling size");
    let empty = ImageView { width: 0, data: &[], ..good };
    assert_eq!(parameter(loss_of(3.0).reference(empty)), "image size");
    assert_eq!(parameter(loss_of(3.0).reference(image(60, 33, 2))), "channels of an image");
    assert!(matches!(loss_of(3.0).reference(image(41, 33, 3)), Err(Error::Shape { .. })));
    assert!(matches!(Hvsq::new(uniform(0.5), Distance::L1), Err(Error::Parameter { name: "pooling size", .. })));
    let reference = loss_of(3.0).reference(good).unwrap();
    assert!(matches!(reference.value(image(33, 40, 3)), Err(Error::Shape { .. })));
    assert!(matches!(reference.by_region(good, &[0; 7], 2), Err(Error::Shape { .. })));
    assert_eq!(reference.by_region(good, &[0; 40 * 33], 2).unwrap(), [Some(0.0), None]);
}
