//! What comes back is what the tables of the formats say.

use crate::support::*;
use gazesplat_core::GaussianCloud;
use gazesplat_core::io::model::{self, ModelFormat, SaveOptions, load_with_report};
use proptest::prelude::*;

/// Half a step per attribute, from the tables of the formats: position and log scale per axis, DC, other coefficients
/// by index, opacity; and three times the step of a stored component of the rotation, which bounds the rebuilt
/// component m ≥ ½ of the smallest three: |Σ sᵢ δᵢ| / m ≤ √(1 − m²) · √3 δ / m ≤ 3 δ.
struct Bounds {
    position: [f64; 3],
    log_scale: [f64; 3],
    dc: [f64; 3],
    rest: Box<dyn Fn(usize) -> f64>,
    opacity: f64,
    rotation: f64,
}

fn check(before: &GaussianCloud, after: &GaussianCloud, bounds: impl Fn(usize) -> Bounds) {
    assert_eq!((before.len(), before.sh_degree), (after.len(), after.sh_degree));
    // Rounding of f32 on the way: a few units in the last place of the value.
    let near = |what: &str, i: usize, a: f32, b: f32, bound: f64| {
        let (error, slack) = ((f64::from(a) - f64::from(b)).abs(), 4e-7 * f64::from(a.abs().max(1.0)));
        assert!(error <= bound + slack, "{what} of Gaussian {i}: {a} became {b}, the bound is {bound}");
    };
    for i in 0..before.len() {
        let bounds = bounds(i);
        for axis in 0..3 {
            near("position", i, before.means[i][axis], after.means[i][axis], bounds.position[axis]);
            near("log scale", i, before.log_scales[i][axis], after.log_scales[i][axis], bounds.log_scale[axis]);
        }
        for (k, (a, b)) in before.sh_of(i).iter().zip(after.sh_of(i)).enumerate() {
            for channel in 0..3 {
                let bound = if k == 0 { bounds.dc[channel] } else { (bounds.rest)(k) };
                near("SH", i, a[channel], b[channel], bound);
            }
        }
        let error = (opacity(before.opacity_logits[i]) - opacity(after.opacity_logits[i])).abs();
        assert!(error <= bounds.opacity + 1e-6, "opacity of Gaussian {i}: {error}");
        let error = rotation_error(before.quats[i], after.quats[i]);
        assert!(error <= bounds.rotation + 1e-6, "rotation of Gaussian {i}: {error}, the bound is {}", bounds.rotation);
    }
}

const HALF_OPACITY_STEP: f64 = 0.5 / 255.0;

fn compressed_ply_round_trip(degree: u32, n: usize, seed: u64) {
    let cloud = random_cloud(n, degree, seed);
    let back = loaded("a.ply", &saved(&cloud, ModelFormat::CompressedPly));
    let range = |i: usize, value: &dyn Fn(usize) -> f32| {
        let first = i / 256 * 256;
        let rows = first..n.min(first + 256);
        let (low, high) = rows.map(value).fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(v), h.max(v)));
        f64::from(high) - f64::from(low)
    };
    check(&cloud, &back, |i| {
        let steps = [2047.0, 1023.0, 2047.0];
        Bounds {
            position: [0, 1, 2].map(|axis| 0.5 * range(i, &|j| cloud.means[j][axis]) / steps[axis]),
            log_scale: [0, 1, 2].map(|axis| 0.5 * range(i, &|j| cloud.log_scales[j][axis]) / steps[axis]),
            dc: [0, 1, 2].map(|c| 0.5 * range(i, &|j| cloud.sh_of(j)[0][c]) / 255.0),
            rest: Box::new(|_| 1.0 / 64.0),
            opacity: HALF_OPACITY_STEP,
            rotation: 3.0 * 0.5 * std::f64::consts::SQRT_2 / 1023.0,
        }
    });
}

/// A value that is small beside the bounds of its chunk, in which a sum of `f32` rounds by more than the value allows.
#[test]
fn compressed_ply_rounds_values_and_not_bounds() {
    compressed_ply_round_trip(0, 489, 2_303_411_106_195_465_651);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn spz_returns_every_value_within_half_a_step(
        degree in 0u32..=4, n in 1usize..600, seed: u64, is_v4: bool, bits in proptest::option::of(1u32..=8),
    ) {
        let cloud = random_cloud(n, degree, seed);
        let format = if is_v4 { ModelFormat::Spz4 } else { ModelFormat::Spz3 };
        let back = loaded("a.spz", &saved_with(&cloud, format, bits));
        // ±60 units leave 16 fractional bits.
        check(&cloud, &back, |_| Bounds {
            position: [0.5 / 65_536.0; 3],
            log_scale: [0.5 / 16.0; 3],
            dc: [0.5 / (0.15 * 255.0); 3],
            // b of 8 bits cover −1..1 in 2^b steps.
            rest: Box::new(move |k| 0.5_f64.powi(bits.unwrap_or(if k < 4 { 5 } else { 4 }) as i32)),
            opacity: HALF_OPACITY_STEP,
            rotation: 3.0 * 0.5 * std::f64::consts::FRAC_1_SQRT_2 / 511.0,
        });
    }

    #[test]
    fn compressed_ply_returns_every_value_within_half_a_step_of_its_chunk(
        degree in 0u32..=3, n in 1usize..1000, seed: u64,
    ) {
        compressed_ply_round_trip(degree, n, seed);
    }

    #[test]
    fn splat_returns_every_value_within_half_a_step(n in 1usize..300, seed: u64) {
        let cloud = random_cloud(n, 0, seed);
        let back = loaded("a.splat", &saved(&cloud, ModelFormat::Splat));
        check(&cloud, &back, |_| Bounds {
            position: [0.0; 3],
            // The logarithm of a rounded exponential: relative 2⁻²⁴ of the scale, absolute of its logarithm.
            log_scale: [1.2e-7 * 10.0; 3],
            dc: [0.5 / 255.0 / SH_C0; 3],
            rest: Box::new(|_| 0.0),
            opacity: HALF_OPACITY_STEP,
            // A step of 1/128 above 127/128, half of it elsewhere; lengths of the rows differ from 1 by twice that.
            rotation: 3.0 / 128.0,
        });
    }
}

#[test]
fn a_second_round_trip_changes_nothing_but_the_last_place() {
    let cloud = random_cloud(700, 2, 3);
    for format in [ModelFormat::Spz3, ModelFormat::Spz4, ModelFormat::Splat] {
        let once = saved(&cloud, format);
        let twice = saved(&loaded(name(format), &once), format);
        let (once, twice) = (loaded(name(format), &once), loaded(name(format), &twice));
        assert_eq!(once.means, twice.means, "{format}");
        assert_eq!(once.sh, twice.sh, "{format}");
        assert_eq!(once.opacity_logits, twice.opacity_logits, "{format}");
    }
}

#[test]
fn every_format_is_told_by_its_first_bytes_whatever_its_name() {
    let cloud = random_cloud(5, 1, 1);
    for (format, shown) in [
        (ModelFormat::Ply, ModelFormat::Ply),
        (ModelFormat::CompressedPly, ModelFormat::CompressedPly),
        (ModelFormat::Spz3, ModelFormat::Spz3),
        (ModelFormat::Spz4, ModelFormat::Spz3),
    ] {
        for name in ["model.bin", "model.splat"] {
            let (_dir, path) = file(name, &saved(&cloud, format));
            let (back, report) = load_with_report(&path).unwrap();
            assert_eq!((back.len(), report.format, report.num_rows), (5, shown, 5), "{format} as {name}");
        }
    }
}

#[test]
fn names_choose_the_format_to_write() {
    let of = |name: &str| ModelFormat::of_path(name.as_ref());
    assert_eq!(of("dir.splat/a b.PLY"), Some(ModelFormat::Ply));
    assert_eq!(of("größe.compressed.ply"), Some(ModelFormat::CompressedPly));
    assert_eq!(of("x.splat"), Some(ModelFormat::Splat));
    assert_eq!(of("x.spz"), Some(ModelFormat::Spz3));
    assert_eq!((of("x.gltf"), of("ply"), of("..")), (None, None, None));
    assert!(ModelFormat::ALL.into_iter().all(|f| f.to_string().parse() == Ok(f)));
    assert!("obj".parse::<ModelFormat>().unwrap_err().contains("compressed-ply"));
}

#[test]
fn bands_a_format_does_not_hold_are_left_out() {
    let cloud = random_cloud(4, 4, 8);
    assert_eq!(loaded("a.splat", &saved(&cloud, ModelFormat::Splat)).sh_degree, 0);
    assert_eq!(loaded("a.ply", &saved(&cloud, ModelFormat::CompressedPly)).sh_degree, 3);
    assert_eq!(loaded("a.spz", &saved(&cloud, ModelFormat::Spz3)).sh_degree, 4);
}

#[test]
fn values_beyond_the_range_are_clamped_and_counted() {
    let mut cloud = random_cloud(3, 1, 5);
    cloud.log_scales[0] = [-12.0, 7.0, 0.0];
    cloud.sh[0] = [4.0, -4.0, 0.0];
    cloud.sh[1] = [5.0, -5.0, 0.0];
    let dir = tempfile::tempdir().unwrap();
    let save = |format| {
        let options = SaveOptions { format, sh_bits: None, comments: Vec::new() };
        model::save(dir.path().join("x"), &cloud, &options).unwrap().num_clamped
    };
    assert_eq!(save(ModelFormat::Ply), 0);
    assert_eq!(save(ModelFormat::Spz3), 6);
    assert_eq!(save(ModelFormat::CompressedPly), 2);
    assert_eq!(save(ModelFormat::Splat), 2);
    assert_eq!(loaded("x.spz", &saved(&cloud, ModelFormat::Spz3)).log_scales[0], [-10.0, 5.9375, 0.0]);
}

#[test]
fn large_models_get_coarser_positions_instead_of_wrapped_ones() {
    let mut cloud = random_cloud(2, 0, 1);
    cloud.means = vec![[100_000.0, -3.25, 0.5], [0.0; 3]];
    let back = loaded("x.spz", &saved(&cloud, ModelFormat::Spz4));
    // 2¹⁷ > 100000 leaves 6 of 23 bits.
    assert_eq!(back.means, [[100_000.0, -3.25, 0.5], [0.0; 3]]);
}

#[test]
fn empty_models_round_trip() {
    for format in [ModelFormat::Ply, ModelFormat::CompressedPly, ModelFormat::Spz3, ModelFormat::Spz4] {
        let empty = GaussianCloud::zeros(0, 2);
        assert_eq!(loaded(name(format), &saved(&empty, format)), empty, "{format}");
    }
}

#[test]
fn comments_are_one_line_of_ascii_and_come_back() {
    let dir = tempfile::tempdir().unwrap();
    let cloud = random_cloud(3, 1, 1);
    for format in [ModelFormat::Ply, ModelFormat::CompressedPly] {
        let path = dir.path().join("a.ply");
        let comments = vec!["made by a test".into(), "Straße\nelement vertex 9 end_header".into()];
        model::save(&path, &cloud, &SaveOptions { format, sh_bits: None, comments }).unwrap();
        let (back, report) = load_with_report(&path).unwrap();
        assert_eq!(back.len(), 3);
        assert_eq!(report.comments, ["made by a test", "Stra?e?element vertex 9 end header"]);
    }
}

/// PLY files say it in a comment, SPZ files by a flag; `.splat` cannot.
#[test]
fn antialiased_models_say_so_in_every_format_that_can() {
    let dir = tempfile::tempdir().unwrap();
    let cloud = random_cloud(3, 1, 1);
    for format in ModelFormat::ALL {
        for comments in [vec!["made by a test".to_owned()], vec![model::ANTIALIASED_COMMENT.to_owned()]] {
            let asked = comments[0] == model::ANTIALIASED_COMMENT;
            let path = dir.path().join(name(format));
            model::save(&path, &cloud, &SaveOptions { format, sh_bits: None, comments }).unwrap();
            let report = load_with_report(&path).unwrap().1;
            assert_eq!(report.is_antialiased(), asked && format != ModelFormat::Splat, "{format}");
            assert!(report.notes.is_empty(), "{format}: {:?}", report.notes);
        }
    }
}

#[test]
fn real_models_keep_their_values_in_every_format() {
    let Some(path) = gazesplat_testkit::data_path("model_plush/point_cloud.ply") else { return };
    let cloud = model::load(path).unwrap();
    for format in COMPACT {
        let bytes = saved(&cloud, format);
        let back = loaded(name(format), &bytes);
        assert_eq!(back.len(), cloud.len());
        let errors =
            cloud.opacity_logits.iter().zip(&back.opacity_logits).map(|(a, b)| (opacity(*a) - opacity(*b)).abs());
        assert!(errors.fold(0.0, f64::max) <= HALF_OPACITY_STEP + 1e-6, "{format}");
    }
}
