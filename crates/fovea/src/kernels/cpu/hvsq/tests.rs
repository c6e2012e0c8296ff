//! Gradients by finite differences, closed forms, invariances, and what NaN does, in float64 and float32.

use super::*;
use crate::hvs::pooling::Growth;
use gazesplat_core::{Display, Gaze, PixelGrid};
use gazesplat_testkit::Rng;
use gazesplat_testkit::reference::hvsq::images::{interleaved, pair};

const NOTHING: Wanted<'static, f64> = Wanted { gradient: false, map: false, regions: None };
const GRADIENT: Wanted<'static, f64> = Wanted { gradient: true, map: false, regions: None };

fn uniform(size_px: f64) -> Pooling {
    Pooling::Uniform { size_px }
}

/// Pools of a few pixels at the border.
fn gaze(x: f64, y: f64) -> Pooling {
    Pooling::Gaze(GazePooling {
        display: Display::from_fov_deg(100.0).unwrap(),
        gaze: Gaze::new(x, y).unwrap(),
        alpha: 0.4,
        growth: Growth::Quadratic,
        grid: PixelGrid::Centres,
    })
}

fn poolings() -> Vec<Pooling> {
    [1.0, 2.0, 2.5, 3.0, 4.0, 12.0, 32.0].map(uniform).into_iter().chain([gaze(0.5, 0.5), gaze(0.2, 0.9)]).collect()
}

fn plan<T: Real>(size: (usize, usize), pooling: Pooling, distance: Distance) -> Plan<T> {
    Plan::new(size, &FilterBank::sp5(), &pooling, distance)
}

fn view<T>(data: &[T], size: (usize, usize)) -> ImageView<'_, T> {
    ImageView { width: size.0, height: size.1, channels: data.len() / (size.0 * size.1), data }
}

fn noise(seed: u64, n: usize) -> Vec<f64> {
    let mut rng = Rng::new(seed);
    (0..n).map(|_| rng.unit()).collect()
}

fn value(plan: &Plan<f64>, reference: &[f64], image: &[f64]) -> f64 {
    let size = plan.size();
    plan.compare(&plan.statistics(&view(reference, size)), &view(image, size), NOTHING).values[0]
}

/// Along random directions, with noise images: variances far above the clamp. For L1 the step is small enough to cross
/// few kinks.
#[test]
fn gradient_equals_finite_differences() {
    for (size, channels) in [((32, 32), 3), ((45, 37), 4)] {
        let n = size.0 * size.1 * channels;
        let (reference, image) = (noise(1, n), noise(2, n));
        for pooling in poolings() {
            for distance in [Distance::Mse, Distance::L1] {
                let plan = plan::<f64>(size, pooling, distance);
                let statistics = plan.statistics(&view(&reference, size));
                let found = plan.compare(&statistics, &view(&image, size), GRADIENT);
                // Rounding of 1e-16 over the step, curvature times its square; an L1 has kinks every few 1e-5.
                let (step, bound) = if distance == Distance::Mse { (1e-5, 1e-6) } else { (1e-8, 2e-4) };
                for direction in 0..10 {
                    let along: Vec<f64> = noise(10 + direction, n).iter().map(|v| 2.0 * v - 1.0).collect();
                    let at = |t: f64| {
                        let moved: Vec<f64> = image.iter().zip(&along).map(|(v, d)| v + t * d).collect();
                        plan.compare(&statistics, &view(&moved, size), NOTHING).values[0]
                    };
                    let expected = (at(step) - at(-step)) / (2.0 * step);
                    let slope: f64 = found.v_image.iter().zip(&along).map(|(v, d)| v * d).sum();
                    // Relative to the gradient: a random direction may be all but orthogonal to it.
                    let norm: f64 = found.v_image.iter().map(|v| v * v).sum::<f64>().sqrt();
                    let error = (slope - expected).abs() / norm;
                    assert!(
                        error < bound,
                        "{size:?} {pooling:?} {distance:?}: {slope:e} {expected:e}, off by {error:e}"
                    );
                }
            }
        }
    }
}

#[test]
fn gradient_of_a_region_equals_finite_differences() {
    let size = (40, 33);
    let n = size.0 * size.1 * 3;
    let (reference, image) = (noise(3, n), noise(4, n));
    let labels: Vec<u8> = (0..size.0 * size.1).map(|i| u8::from(i % size.0 > 13)).collect();
    let regions = Regions::<f64>::new(&labels, size, 1);
    for pooling in [uniform(1.0), uniform(2.0), uniform(3.0), gaze(0.3, 0.3)] {
        let plan = plan::<f64>(size, pooling, Distance::Mse);
        let statistics = plan.statistics(&view(&reference, size));
        let wanted = |gradient| Wanted { gradient, map: false, regions: Some(&regions) };
        let found = plan.compare(&statistics, &view(&image, size), wanted(true));
        let along: Vec<f64> = noise(5, n).iter().map(|v| 2.0 * v - 1.0).collect();
        let at = |t: f64| {
            let moved: Vec<f64> = image.iter().zip(&along).map(|(v, d)| v + t * d).collect();
            plan.compare(&statistics, &view(&moved, size), wanted(false)).values[0]
        };
        let expected = (at(1e-5) - at(-1e-5)) / 2e-5;
        let slope: f64 = found.v_image.iter().zip(&along).map(|(v, d)| v * d).sum();
        assert!((slope / expected - 1.0).abs() < 1e-6, "{pooling:?}: {slope:e} {expected:e}");
    }
}

#[test]
fn equal_images_have_no_distance_and_no_gradient() {
    let size = (50, 40);
    for image in [noise(7, 50 * 40 * 3), vec![0.25; 50 * 40 * 3]] {
        let image: Vec<f32> = image.iter().map(|v| *v as f32).collect();
        for pooling in poolings() {
            for distance in [Distance::Mse, Distance::L1] {
                let plan = plan::<f32>(size, pooling, distance);
                let wanted = Wanted { gradient: true, map: true, regions: None };
                let found = plan.compare(&plan.statistics(&view(&image, size)), &view(&image, size), wanted);
                assert_eq!(found.values, [0.0], "{pooling:?} {distance:?}");
                assert!(found.v_image.iter().chain(&found.map).all(|v| *v == 0.0), "{pooling:?} {distance:?}");
            }
        }
    }
}

/// A shift of all channels moves Y alone; filters answer with their sums, the bands with nothing, deviations stay.
#[test]
fn constant_shift_has_its_closed_form() {
    let size = (64, 32);
    let image = noise(8, 64 * 32 * 3);
    let shift = 0.125;
    let shifted: Vec<f64> = image.iter().map(|v| v + shift).collect();
    // Sum of squares over the high-pass and the residual, one channel of three.
    let expected = ((-0.029_463_52 * shift).powi(2) + (0.999_179_84 * shift).powi(2)) / (3.0 * 51.0);
    for pooling in poolings() {
        let found = value(&plan(size, pooling, Distance::Mse), &image, &shifted);
        assert!((found / expected - 1.0).abs() < 1e-9, "{pooling:?}: {found:e} {expected:e}");
    }
}

/// One cell: means and deviations of whole maps.
#[test]
fn pool_as_large_as_the_image_takes_global_statistics() {
    let size = (32, 32);
    let (a, b) = (noise(9, 32 * 32 * 3), noise(10, 32 * 32 * 3));
    let plan = plan::<f64>(size, uniform(32.0), Distance::Mse);
    let planes = [&a, &b].map(|image| plan.resize.planes(&view(image, size)));
    let mut expected = 0.0;
    let [planes_a, planes_b] = planes;
    for (plane_a, plane_b) in planes_a.iter().zip(&planes_b) {
        let [low_a, low_b] = [plane_a, plane_b].map(|plane| plan.levels(plane));
        let mut add = |a: &Plane<f64>, b: &Plane<f64>, kernel: &Kernel<f64>| {
            let [a, b] = [a, b].map(|plane| {
                let n = (plane.width * plane.height) as f64;
                let mut row = vec![0.0; plane.width];
                let (mut sum, mut squares) = (0.0, 0.0);
                for y in 0..plane.height {
                    correlate_row::<f64, false, 1>(plane, y, &[*kernel], false, &mut row);
                    sum += row.iter().sum::<f64>();
                    squares += row.iter().map(|v| v * v).sum::<f64>();
                }
                (sum / n, (squares / n - (sum / n).powi(2)).max(MIN_VARIANCE).sqrt())
            });
            expected += (a.0 - b.0).powi(2) + (a.1 - b.1).powi(2);
        };
        add(plane_a, plane_b, &plan.filters.high);
        for l in 0..BAND_LEVELS {
            for kernel in &plan.filters.bands {
                add(&low_a[l], &low_b[l], kernel);
            }
        }
        let residuals = (0..2).flat_map(|y| low_a[4].row(y).iter().zip(low_b[4].row(y)).collect::<Vec<_>>());
        expected += residuals.map(|(a, b)| (a - b).powi(2)).sum::<f64>() / 4.0;
    }
    let found = value(&plan, &a, &b);
    assert!((found / (expected / 153.0) - 1.0).abs() < 1e-9, "{found:e} {expected:e}");
}

#[test]
fn symmetric_and_unchanged_by_mirroring() {
    let size = (64, 32);
    let (a, b) = (noise(11, 64 * 32 * 3), noise(12, 64 * 32 * 3));
    let mirrored = |image: &[f64]| -> Vec<f64> {
        image.chunks(64 * 3).flat_map(|row| row.chunks(3).rev().flatten().copied().collect::<Vec<_>>()).collect()
    };
    for pooling in [1.0, 2.0, 2.5, 3.0, 7.0, 12.0].map(uniform).into_iter().chain([gaze(0.5, 0.3)]) {
        for distance in [Distance::Mse, Distance::L1] {
            let plan = plan::<f64>(size, pooling, distance);
            let found = value(&plan, &a, &b);
            for (other, what) in
                [(value(&plan, &b, &a), "exchanged"), (value(&plan, &mirrored(&a), &mirrored(&b)), "mirrored")]
            {
                assert!((other / found - 1.0).abs() < 1e-6, "{pooling:?} {distance:?} {what}: {other:e} {found:e}");
            }
        }
    }
}

/// Noise against itself shifted by a pixel: the same texture to an eye that pools.
#[test]
fn shifted_noise_looks_alike_in_large_pools() {
    let size = (160, 96);
    let wide = noise(13, 161 * 96 * 3);
    let cut =
        |x0: usize| -> Vec<f64> { wide.chunks(161 * 3).flat_map(|row| row[3 * x0..][..160 * 3].to_vec()).collect() };
    let (a, b) = (cut(0), cut(1));
    let at = |p: f64| value(&plan(size, uniform(p), Distance::Mse), &a, &b);
    let (one, three, twelve) = (at(1.0), at(3.0), at(12.0));
    assert!(three < one / 20.0, "1/{}", one / three);
    assert!(twelve < one / 200.0, "1/{}", one / twelve);
}

/// The general path, with every level pooled, against the two short cuts.
#[test]
fn skipped_identities_change_nothing() {
    let size = (64, 32);
    let (a, b) = (noise(14, 64 * 32 * 3), noise(15, 64 * 32 * 3));
    for p in [1.0, 2.0, 4.0, 8.0] {
        for distance in [Distance::Mse, Distance::L1] {
            let short = plan::<f64>(size, uniform(p), distance);
            let mut general = short.clone();
            let pools = (0..BAND_LEVELS).map(|l| {
                let cells = |n: usize| (n as f64 / p) as usize;
                Pools::new((64 >> l, 32 >> l), (cells(64), cells(32))).never_identity()
            });
            general.pooling = PlannedPooling::Uniform(pools.collect());
            let found = [&short, &general]
                .map(|plan| plan.compare(&plan.statistics(&view(&a, size)), &view(&b, size), GRADIENT));
            let (one, two) = (found[0].values[0], found[1].values[0]);
            assert!((one / two - 1.0).abs() < 1e-9, "p {p} {distance:?}: {one:e} {two:e}");
            let d = gazesplat_testkit::difference(&found[0].v_image, &found[1].v_image);
            // Variances of single samples are rounding errors: their clamp must hold.
            assert!(d.relative_l2 < 1e-6, "p {p} {distance:?}: {d:?}");
        }
    }
}

/// A step below and above the smallest variance in a flat image.
#[test]
fn gradient_is_finite_where_variances_vanish() {
    let size = (32, 32);
    let flat = vec![0.5f32; 32 * 32 * 3];
    for step in [1e-7, 1e-4, 1e-2] {
        let mut image = flat.clone();
        for (i, v) in image.iter_mut().enumerate() {
            *v += if i / 3 % 32 >= 16 { step } else { 0.0 };
        }
        for pooling in poolings() {
            for distance in [Distance::Mse, Distance::L1] {
                let plan = plan::<f32>(size, pooling, distance);
                let wanted = Wanted { gradient: true, map: false, regions: None };
                let found = plan.compare(&plan.statistics(&view(&flat, size)), &view(&image, size), wanted);
                assert!(found.values[0].is_finite() && found.v_image.iter().all(|v| v.is_finite()), "{step}");
            }
        }
    }
}

#[test]
fn nan_in_either_image_shows_in_the_value() {
    let size = (40, 36);
    let clean: Vec<f64> = noise(16, 40 * 36 * 3);
    let mut spoilt = clean.clone();
    spoilt[3 * (17 * 40 + 5) + 2] = f64::NAN;
    for pooling in poolings() {
        for distance in [Distance::Mse, Distance::L1] {
            let plan = plan::<f64>(size, pooling, distance);
            assert!(value(&plan, &clean, &spoilt).is_nan(), "{pooling:?} {distance:?}");
            assert!(value(&plan, &spoilt, &clean).is_nan(), "{pooling:?} {distance:?}");
        }
    }
}

/// Shares of the regions add up, and so do the pixels of the map.
#[test]
fn regions_and_map_add_up_to_the_value() {
    let size = (96, 64);
    let (a, b) = (noise(17, 96 * 64 * 3), noise(18, 96 * 64 * 3));
    let labels: Vec<u8> = (0..96 * 64).map(|i| ((i % 96) / 20 + (i / 96) / 30) as u8 % 3).collect();
    let regions = Regions::<f64>::new(&labels, size, 4);
    assert!(regions.is_empty(3));
    for pooling in poolings() {
        let plan = plan::<f64>(size, pooling, Distance::Mse);
        let statistics = plan.statistics(&view(&a, size));
        let whole = plan.compare(&statistics, &view(&b, size), Wanted { map: true, ..NOTHING });
        let parts = plan.compare(&statistics, &view(&b, size), Wanted { regions: Some(&regions), ..NOTHING });
        let share = |k: usize| labels.iter().filter(|l| usize::from(**l) == k).count() as f64 / (96.0 * 64.0);
        let sum: f64 = (0..3).map(|k| share(k) * parts.values[k]).sum();
        let value = whole.values[0];
        assert!((sum / value - 1.0).abs() < 1e-9, "{pooling:?}: {sum:e} {value:e}");
        // Bilinear enlargement by whole factors keeps sums but at the border.
        let mean = whole.map.iter().sum::<f64>() / (96.0 * 64.0);
        assert!((mean / value - 1.0).abs() < 0.05, "{pooling:?}: {mean:e} {value:e}");
        assert!(parts.values[3].is_nan());
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let size = (150, 90);
    let [a, b] = pair(90, 150).map(|i| interleaved(&i, 4));
    for pooling in [uniform(1.0), uniform(2.0), uniform(3.0), uniform(7.5), gaze(0.3, 0.6)] {
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let plan = plan::<f32>(size, pooling, Distance::L1);
                let wanted = Wanted { gradient: true, map: true, regions: None };
                plan.compare(&plan.statistics(&view(&a, size)), &view(&b, size), wanted)
            })
        };
        let (one, four) = (run(1), run(4));
        assert_eq!(one.values[0].to_bits(), four.values[0].to_bits());
        assert!(one.v_image == four.v_image && one.map == four.map, "{pooling:?}");
    }
}

/// Adam over an image of noise, towards another: HVSQ falls at least fifty times.
#[test]
fn minimising_hvsq_leads_to_its_reference() {
    let size = (160, 96);
    let target: Vec<f32> = interleaved(&pair(96, 160)[0], 3);
    let mut image: Vec<f32> = noise(19, target.len()).iter().map(|v| *v as f32).collect();
    let plan = plan::<f32>(size, uniform(3.0), Distance::L1);
    let statistics = plan.statistics(&view(&target, size));
    let wanted = Wanted { gradient: true, map: false, regions: None };
    let (mut m, mut v) = (vec![0.0f32; image.len()], vec![0.0f32; image.len()]);
    let mut first = None;
    let mut last = 0.0;
    for step in 1..=200 {
        let found = plan.compare(&statistics, &view(&image, size), wanted);
        last = found.values[0];
        first.get_or_insert(last);
        let (correct_m, correct_v) = (1.0 - 0.9f32.powi(step), 1.0 - 0.999f32.powi(step));
        for (((x, g), m), v) in image.iter_mut().zip(&found.v_image).zip(&mut m).zip(&mut v) {
            *m = 0.9 * *m + 0.1 * g;
            *v = 0.999 * *v + 0.001 * g * g;
            *x -= 0.01 * (*m / correct_m) / ((*v / correct_v).sqrt() + 1e-15);
        }
    }
    let ratio = first.unwrap() / last;
    assert!(ratio >= 50.0, "only {ratio} times");
}

/// The kernel in float64 against the plain program of the specification, pools of fractional sizes and odd images included.
#[test]
fn kernel_in_float64_is_the_plain_reference() {
    use gazesplat_testkit::reference::hvsq as plain;
    let bank = FilterBank::sp5();
    let plain_bank = plain::Bank { low: *bank.low(), high: *bank.high(), bands: bank.bands().to_vec() };
    for size in [(64, 32), (45, 37), (70, 97)] {
        let n = size.0 * size.1 * 3;
        let (reference, image) = (noise(21, n), noise(22, n));
        let planes =
            |data: &[f64]| [0, 1, 2].map(|c| plain::Plane::new(size.0, size.1, |x, y| data[3 * (y * size.0 + x) + c]));
        let (a, b) = (planes(&image), planes(&reference));
        for distance in [Distance::Mse, Distance::L1] {
            let plain_distance = if distance == Distance::Mse { plain::Distance::Mse } else { plain::Distance::L1 };
            let check = |pooling: Pooling, plain_pooling: plain::Pooling, bound: f64| {
                let found = value(&plan::<f64>(size, pooling, distance), &reference, &image);
                let expected = plain::hvsq(&a, &b, &plain_bank, &plain_pooling, plain_distance);
                let error = (found / expected - 1.0).abs();
                assert!(error < bound, "{size:?} {pooling:?} {distance:?}: {found:e} {expected:e}, off by {error:e}");
            };
            for p in [1.0, 1.5, 2.0, 2.5, 3.0, 7.3, 12.0, 29.7] {
                check(uniform(p), plain::Pooling::Uniform(p), 1e-10);
            }
            let width = 2.0 * 50f64.to_radians().tan();
            for gaze_at in [[0.5, 0.5], [0.2, 0.9], [3.0, -2.0]] {
                let plain_gaze = plain::Gaze { width, gaze: gaze_at, alpha: 0.4, end_points: false };
                // The arc cosine of the plain program has half of the digits near the gaze.
                check(gaze(gaze_at[0], gaze_at[1]), plain::Pooling::Gaze(plain_gaze), 1e-7);
            }
        }
    }
}
