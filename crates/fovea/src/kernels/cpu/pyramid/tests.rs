//! Filters against their definition, and every adjoint against its operation.

use super::*;
use gazesplat_testkit::Rng;

fn noise(rng: &mut Rng, n: usize) -> Vec<f64> {
    (0..n).map(|_| 2.0 * rng.unit() - 1.0).collect()
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn plane(width: usize, height: usize, values: &[f64]) -> Plane<f64> {
    let mut plane = Plane::zeros(width, height);
    plane.fill_rows(|y, row| row.copy_from_slice(&values[y * width..][..width]));
    plane
}

#[test]
fn borders_are_reflected_without_repeating_the_edge() {
    assert_eq!([-2, -1, 0, 5, 6, 7].map(|i| reflect(i, 6)), [2, 1, 0, 5, 4, 3]);
}

/// Σ of the definition, with every tap.
#[test]
fn filters_match_their_definition() {
    let mut rng = Rng::new(3);
    let filters = Filters::<f64>::new(&FilterBank::sp5());
    assert!(filters.antisymmetric);
    for (width, height) in [(4, 4), (8, 6), (36, 5), (64, 9)] {
        let values = noise(&mut rng, width * height);
        let plane = plane(width, height, &values);
        let mut out = vec![0.0; 6 * width];
        let mut other = out.clone();
        for y in 0..height {
            correlate_row::<f64, false, 6>(&plane, y, &filters.bands, true, &mut out);
            correlate_row::<f64, false, 6>(&plane, y, &filters.bands, false, &mut other);
            for (o, k) in filters.bands.iter().enumerate() {
                for x in 0..width {
                    let mut sum = 0.0;
                    for i in 0..5 {
                        for j in 0..5 {
                            let (r, c) = ((y + i) as isize - 2, (x + j) as isize - 2);
                            sum += k[5 * i + j] * values[reflect(r, height) * width + reflect(c, width)];
                        }
                    }
                    assert!((out[o * width + x] - sum).abs() < 1e-14);
                    assert!((other[o * width + x] - sum).abs() < 1e-14);
                }
            }
        }
    }
}

/// ⟨A x, y⟩ = ⟨x, Aᵀ y⟩.
#[test]
fn adjoint_of_every_filter_with_its_border() {
    let mut rng = Rng::new(4);
    let filters = Filters::<f64>::new(&FilterBank::sp5());
    let kernels = [&filters.bands[..], &[filters.low, filters.high]].concat();
    for (width, height) in [(4, 4), (8, 5), (32, 4), (40, 7), (68, 6)] {
        let (x, v) = (noise(&mut rng, width * height), noise(&mut rng, width * height));
        let plane = plane(width, height, &x);
        for kernel in &kernels {
            let kernel = &[*kernel][..];
            let (mut forward, mut v_x) = (vec![0.0; width * height], vec![0.0; width * height]);
            let padded: Vec<Vec<f64>> =
                v.chunks(width).map(|row| [&[0.0; GRADIENT_PAD][..], row, &[0.0; GRADIENT_PAD]].concat()).collect();
            let zeros = vec![0.0; width + 2 * GRADIENT_PAD];
            let mut reached = vec![0.0; width + 4];
            for y in 0..height {
                let rows = y * width..(y + 1) * width;
                correlate_row::<f64, false, 1>(&plane, y, kernel, false, &mut forward[rows.clone()]);
                correlate_row_bwd::<f64, false, 1>(
                    |_, r| &padded[r],
                    &zeros,
                    (y, height),
                    &[flipped(&kernel[0])],
                    &mut reached,
                    &mut v_x[rows],
                );
            }
            let (a, b) = (dot(&forward, &v), dot(&x, &v_x));
            assert!((a - b).abs() <= 1e-12 * (1.0 + a.abs()), "{width}×{height}: {a} {b}");
        }
    }
}

#[test]
fn adjoint_of_halving_colour_and_resizing() {
    let mut rng = Rng::new(5);
    let (x, v) = (noise(&mut rng, 8 * 6), noise(&mut rng, 4 * 3));
    let half = halve(&plane(8, 6, &x));
    let forward: Vec<f64> = (0..3).flat_map(|y| half.row(y).to_vec()).collect();
    let mut v_x = vec![0.0; 48];
    halve_bwd(&v, &mut v_x, 8);
    assert!((dot(&forward, &v) - dot(&x, &v_x)).abs() < 1e-13);

    for from in [(2usize, 3usize), (31, 17), (32, 64), (33, 67), (67, 2)] {
        let to = (from.0.next_multiple_of(32), from.1.next_multiple_of(32));
        let resize = Resize::<f64>::new(from, to);
        let x = noise(&mut rng, from.0 * from.1 * 4);
        let mut v: [Vec<f64>; 3] = std::array::from_fn(|_| noise(&mut rng, to.0 * to.1));
        let view = |data| ImageView { width: from.0, height: from.1, channels: 4, data };
        let zero = vec![0.0; x.len()];
        // The colour transform has a constant part, which the gradient does not see.
        let (planes, offsets) = (resize.planes(&view(&x)), resize.planes(&view(&zero)));
        let mut forward = 0.0;
        for c in 0..3 {
            for y in 0..to.1 {
                let difference = planes[c].row(y).iter().zip(offsets[c].row(y)).map(|(a, b)| a - b);
                forward += dot(&difference.collect::<Vec<_>>(), &v[c][y * to.0..][..to.0]);
            }
        }
        let v_x = resize.planes_bwd(&mut v, 4);
        let backward = dot(&x, &v_x);
        assert!((forward - backward).abs() < 1e-11 * (1.0 + forward.abs()), "{from:?}: {forward} {backward}");
    }
}

/// Checks the map `key` of formula image a, three channels of `width` × `height`, against the record, to 1e-6 (hvsq.md
/// §12, test 2).
pub(crate) fn assert_golden_map(key: &str, values: &[f32], (width, height): (usize, usize)) {
    let json = gazesplat_testkit::golden::find("hvsq_formula").expect("shipped").load_json();
    let expected = &json["pyramid"][key];
    assert_eq!(expected["shape"], serde_json::json!([3, height, width]), "{key}");
    let sum = |f: fn(f64) -> f64| values.iter().map(|v| f(f64::from(*v))).sum::<f64>() / values.len() as f64;
    let sample = values[3.min(height - 1) * width + 4.min(width - 1)];
    for (name, found) in [("mean", sum(|v| v)), ("rms", sum(|v| v * v).sqrt()), ("c0_3_4", f64::from(sample))] {
        let expected = expected[name].as_f64().expect("a number");
        assert!((found - expected).abs() < 1e-6, "{key} {name}: {found} instead of {expected}");
    }
}

/// Formula image a.
pub(crate) fn golden_image() -> Vec<f32> {
    use gazesplat_testkit::reference::hvsq::images::{interleaved, pair};
    interleaved(&pair(96, 160)[0], 3)
}

#[test]
fn golden_maps_of_the_pyramid() {
    let data = golden_image();
    let filters = Filters::<f32>::new(&FilterBank::sp5());
    let image = ImageView { width: 160, height: 96, channels: 3, data: &data };
    let planes = Resize::new((160, 96), (160, 96)).planes(&image);
    let filtered = |planes: &[Plane<f32>], kernel: &Kernel<f32>| -> Vec<f32> {
        let rows = planes.iter().flat_map(|plane| (0..plane.height).map(move |y| (plane, y)));
        let row = |(plane, y): (&Plane<f32>, usize)| {
            let mut row = vec![0.0; plane.width];
            correlate_row::<f32, false, 1>(plane, y, &[*kernel], false, &mut row);
            row
        };
        rows.flat_map(row).collect()
    };
    assert_golden_map("L0.h0", &filtered(&planes, &filters.high), (160, 96));
    let mut low: Vec<Plane<f32>> = planes
        .iter()
        .map(|p| {
            let values = filtered(std::slice::from_ref(p), &filters.low);
            let mut low = Plane::zeros(160, 96);
            low.fill_rows(|y, row| row.copy_from_slice(&values[y * 160..][..160]));
            low
        })
        .collect();
    for l in 0..4 {
        for (o, kernel) in filters.bands.iter().enumerate() {
            assert_golden_map(&format!("L{l}.b{o}"), &filtered(&low, kernel), (160 >> l, 96 >> l));
        }
        low = low.iter().map(halve).collect();
    }
    let residual: Vec<f32> = low.iter().flat_map(|p| (0..6).flat_map(|y| p.row(y).to_vec())).collect();
    assert_golden_map("L4.l0", &residual, (10, 6));
}
