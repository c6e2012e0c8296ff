//! Maps against the golden record, and every adjoint against its operation, on a GPU.

use super::*;
use crate::kernels::cpu::pyramid::tests::{assert_golden_map, golden_image};
use gazesplat_testkit::Rng;
use gazesplat_testkit::devices::required_gpu;

fn gpu() -> Option<Gpu> {
    required_gpu(gazesplat_render::device::gpu_device(None)).and_then(|device| Gpu::from_device(&device))
}

fn noise(rng: &mut Rng, n: usize) -> Vec<f32> {
    (0..n).map(|_| (2.0 * rng.unit() - 1.0) as f32).collect()
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
}

fn planes(gpu: &Gpu, (width, height): (usize, usize), values: &[f32]) -> Planes {
    let num_planes = values.len() / (width * height);
    Planes { width, height, num_planes, data: gpu.upload_f32(values, &[num_planes, height, width]) }
}

fn read(gpu: &Gpu, planes: &Planes) -> Vec<f32> {
    gpu.read_f32(&planes.data).unwrap()
}

/// ⟨A x, y⟩ = ⟨x, Aᵀ y⟩, relative to the norms (hvsq.md §12, test 9).
fn assert_adjoint(a: (&[f32], &[f32]), b: (&[f32], &[f32]), what: &str) {
    let (left, right) = (dot(a.0, a.1), dot(b.0, b.1));
    let norm = (dot(a.0, a.0) * dot(a.1, a.1)).sqrt();
    assert!((left - right).abs() <= 1e-5 * norm, "{what}: {left} {right}");
}

#[test]
fn golden_maps_of_the_pyramid() {
    let Some(gpu) = gpu() else { return };
    let filters = Filters::new(&gpu, &FilterBank::sp5());
    let image = gpu.upload_f32(&golden_image(), &[96, 160, 3]);
    let image = Resize::new(&gpu, (160, 96), (160, 96)).planes(&gpu, &image).unwrap();
    let high = correlate(&gpu, &image, &filters.high).unwrap();
    assert_golden_map("L0.h0", &read(&gpu, &high), (160, 96));
    let mut low = correlate(&gpu, &image, &filters.low).unwrap();
    for l in 0..4 {
        let size = (160 >> l, 96 >> l);
        let grouped: Vec<f32> =
            filters.bands.iter().flat_map(|g| read(&gpu, &correlate(&gpu, &low, g).unwrap())).collect();
        for (o, band) in grouped.chunks_exact(3 * size.0 * size.1).enumerate() {
            assert_golden_map(&format!("L{l}.b{o}"), band, size);
            let alone = read(&gpu, &correlate(&gpu, &low, &filters.single_bands[o]).unwrap());
            assert_golden_map(&format!("L{l}.b{o}"), &alone, size);
        }
        low = halve(&gpu, &low).unwrap();
    }
    assert_golden_map("L4.l0", &read(&gpu, &low), (10, 6));
}

#[test]
fn adjoint_of_every_filter_with_its_border() {
    let Some(gpu) = gpu() else { return };
    let mut rng = Rng::new(4);
    let filters = Filters::new(&gpu, &FilterBank::sp5());
    for size in [(4, 4), (5, 67), (16, 16), (18, 33), (64, 9), (67, 5)] {
        for group in filters.bands.iter().chain([&filters.low, &filters.high]) {
            let n = size.0 * size.1;
            let (x, y) = (noise(&mut rng, 2 * n), noise(&mut rng, 2 * n * group.num_filters));
            let out = read(&gpu, &correlate(&gpu, &planes(&gpu, size, &x), group).unwrap());
            let v_x = Planes::zeros(&gpu, size.0, size.1, 2).unwrap();
            correlate_bwd(&gpu, &planes(&gpu, size, &y), group, &v_x);
            assert_adjoint((&out, &y), (&x, &read(&gpu, &v_x)), &format!("{size:?}"));
        }
    }
}

#[test]
fn adjoint_of_halving_colour_and_resizing() {
    let Some(gpu) = gpu() else { return };
    let mut rng = Rng::new(5);
    for size in [(2, 2), (6, 34), (34, 6)] {
        let n = size.0 * size.1;
        let (x, y) = (noise(&mut rng, 3 * n), noise(&mut rng, 3 * n / 4));
        let half = read(&gpu, &halve(&gpu, &planes(&gpu, size, &x)).unwrap());
        let v_x = halve_bwd(&gpu, &planes(&gpu, (size.0 / 2, size.1 / 2), &y)).unwrap();
        assert_adjoint((&half, &y), (&x, &read(&gpu, &v_x)), &format!("halve {size:?}"));
    }
    for (from, to) in [((1, 1), (32, 32)), ((2, 33), (32, 64)), ((45, 37), (64, 64)), ((64, 32), (64, 32))] {
        let resize = Resize::new(&gpu, from, to);
        let channels = 4;
        let of = |values: &[f32]| {
            let image = gpu.upload_f32(values, &[from.1, from.0, channels]);
            read(&gpu, &resize.planes(&gpu, &image).unwrap())
        };
        let x = noise(&mut rng, from.0 * from.1 * channels);
        // Affine: the planes of black are not zero.
        let linear: Vec<f32> = of(&x).iter().zip(of(&vec![0.0; x.len()])).map(|(v, o)| v - o).collect();
        let y = noise(&mut rng, linear.len());
        let v_image = resize.planes_bwd(&gpu, &planes(&gpu, to, &y), channels).unwrap();
        assert_adjoint((&linear, &y), (&x, &gpu.read_f32(&v_image).unwrap()), &format!("resize {from:?} {to:?}"));
    }
}
