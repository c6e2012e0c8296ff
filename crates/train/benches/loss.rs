//! The fused L1 + SSIM loss with its gradient, by image size: the kernel on the CPU, the operation on a GPU.

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use gazesplat_train::kernels::cpu::l1_ssim::{Comparison, Weights, similarity, similarity_and_gradient};
use std::hint::black_box;

const SIZES: [(usize, usize); 3] = [(359, 640), (1000, 1000), (1920, 1080)];

fn image_of(width: usize, height: usize) -> Vec<f32> {
    (0..width * height * 4).map(|i| (i * 7919 % 1009) as f32 / 1009.0).collect()
}

fn target_of(width: usize, height: usize) -> Vec<u8> {
    (0..width * height * 3).map(|i| (i * 104_729 % 256) as u8).collect()
}

fn loss(c: &mut Criterion) {
    let mut group = c.benchmark_group("l1_ssim");
    for (width, height) in SIZES {
        let (image, target) = (image_of(width, height), target_of(width, height));
        let comparison = Comparison { width, height, channels: 4, image: &image, target: &target[..], mask: None };
        group.throughput(Throughput::Elements((width * height) as u64));
        let size = format!("{width}x{height}");
        group.bench_function(BenchmarkId::new("value_and_gradient", &size), |b| {
            b.iter(|| black_box(similarity_and_gradient(black_box(&comparison), Weights { l1: 0.8, ssim: -0.2 })));
        });
        group.bench_function(BenchmarkId::new("value", &size), |b| {
            b.iter(|| black_box(similarity(black_box(&comparison))));
        });
    }
    group.finish();
}

/// Packing and upload of the photograph, the loss and its gradient. One value of the gradient comes to the host before
/// the clock stops: work is only queued until then.
fn loss_on_gpu(c: &mut Criterion) {
    use burn::tensor::{Tensor, TensorData};
    use gazesplat_core::image::RgbImage8;
    use gazesplat_core::io::images::TrainingImage;
    use gazesplat_train::losses::{L1Ssim, LossTarget, WeightedLosses};
    use std::sync::Arc;

    let device = match gazesplat_render::device::gpu_device(None) {
        Ok(device) => device,
        Err(error) => return eprintln!("SKIPPED l1_ssim on the GPU: {error}"),
    };
    let losses = WeightedLosses::default().with(1.0, Box::new(L1Ssim { ssim_weight: 0.2 }));
    let mut group = c.benchmark_group("l1_ssim_gpu");
    group.sample_size(10);
    for (width, height) in SIZES {
        let photo = RgbImage8 { width: width as u32, height: height as u32, data: target_of(width, height) };
        let photo = Arc::new(TrainingImage { image: photo, alpha: None, mask: None });
        let data = TensorData::new(image_of(width, height), [height, width, 4]);
        let image = Tensor::<3>::from_data(data, &device);
        group.throughput(Throughput::Elements((width * height) as u64));
        group.bench_function(BenchmarkId::new("value_and_gradient", format!("{width}x{height}")), |b| {
            b.iter(|| {
                let image = image.clone().autodiff().require_grad();
                let target = LossTarget::new(Arc::clone(&photo), [0.0; 3]);
                let pending = losses.evaluate(image.clone(), &target).expect("there is a loss");
                let gradients = pending.loss.backward();
                let v_image = image.grad(&gradients).expect("the image is a leaf");
                let last = v_image.slice([height - 1..height, width - 1..width, 0..1]).into_data();
                last.try_into_vec::<f32>().expect("the adapter answers")
            });
        });
    }
    group.finish();
}

criterion_group!(benches, loss, loss_on_gpu);
criterion_main!(benches);
