//! Compact model formats: round trips within the bounds their tables state, files made by hand from the descriptions of
//! the formats, damaged files.

#![expect(clippy::unwrap_used, reason = "a helper of a test may panic like the test")]

use gazesplat_core::io::model::{self, ModelFormat, SaveOptions, load_with_report};
use gazesplat_core::rng::Rng;
use gazesplat_core::{Error, GaussianCloud};
use proptest::prelude::*;
use std::io::Write;
use std::path::PathBuf;
use tempfile::TempDir;

const COMPACT: [ModelFormat; 4] =
    [ModelFormat::CompressedPly, ModelFormat::Splat, ModelFormat::Spz3, ModelFormat::Spz4];

/// Values as trained models have them, some near the ends of the formats' ranges.
fn random_cloud(num_gaussians: usize, degree: u32, seed: u64) -> GaussianCloud {
    let mut rng = Rng::new(seed);
    let mut cloud = GaussianCloud::zeros(num_gaussians, degree);
    cloud.means.as_flattened_mut().iter_mut().for_each(|v| *v = rng.range(-60.0, 60.0));
    cloud.quats.as_flattened_mut().iter_mut().for_each(|v| *v = 3.0 * rng.normal());
    cloud.log_scales.as_flattened_mut().iter_mut().for_each(|v| *v = rng.range(-10.0, 5.9));
    cloud.opacity_logits.iter_mut().for_each(|v| *v = rng.range(-9.0, 9.0));
    let k = cloud.num_coefficients();
    for (index, coefficient) in cloud.sh.iter_mut().enumerate() {
        // DC of colours in 0..1 and other coefficients up to 127/128: what every format holds.
        let limit = if index % k == 0 { 1.77 } else { 127.0 / 128.0 };
        *coefficient = [0; 3].map(|_| rng.range(-limit, limit));
    }
    cloud
}

fn file(name: &str, bytes: &[u8]) -> (TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    (dir, path)
}

fn name(format: ModelFormat) -> &'static str {
    match format {
        ModelFormat::Ply | ModelFormat::CompressedPly => "model.ply",
        ModelFormat::Splat => "model.splat",
        ModelFormat::Spz3 | ModelFormat::Spz4 => "model.spz",
    }
}

fn saved_with(cloud: &GaussianCloud, format: ModelFormat, sh_bits: Option<u32>) -> Vec<u8> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(name(format));
    model::save(&path, cloud, &SaveOptions { format, sh_bits, comments: Vec::new() }).unwrap();
    std::fs::read(path).unwrap()
}

fn saved(cloud: &GaussianCloud, format: ModelFormat) -> Vec<u8> {
    saved_with(cloud, format, None)
}

fn loaded(name: &str, bytes: &[u8]) -> GaussianCloud {
    let (_dir, path) = file(name, bytes);
    model::load(path).unwrap()
}

fn message(name: &str, bytes: &[u8]) -> String {
    let (_dir, path) = file(name, bytes);
    let error = model::load(&path).expect_err("the file is bad");
    assert!(error.to_string().contains(name), "the file is named: {error}");
    format!("{error} | hint: {}", error.hint().unwrap_or_default())
}

fn opacity(logit: f32) -> f64 {
    1.0 / (1.0 + (-f64::from(logit)).exp())
}

fn unit(q: [f32; 4]) -> [f64; 4] {
    let q = q.map(f64::from);
    let length = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    q.map(|v| v / length)
}

/// Largest difference over the components of two rotations, with the sign that brings them nearest.
fn rotation_error(a: [f32; 4], b: [f32; 4]) -> f64 {
    let (a, b) = (unit(a), unit(b));
    let of = |sign: f64| a.iter().zip(b).map(|(a, b)| (a - sign * b).abs()).fold(0.0, f64::max);
    of(1.0).min(of(-1.0))
}

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
const SH_C0: f64 = 0.282_094_791_773_878_14;

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

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

    /// Damage of any kind is an error or another model, never a panic; memory follows the file, not its header.
    #[test]
    fn damaged_files_never_panic(
        which in 0usize..5, cut in proptest::option::of(0.0f64..1.0), flips in proptest::collection::vec((0.0f64..1.0, 1u8..=255), 0..6),
        in_header: bool, seed: u64,
    ) {
        let cloud = random_cloud(300, 1, seed);
        let format = [ModelFormat::Ply, COMPACT[0], COMPACT[1], COMPACT[2], COMPACT[3]][which];
        let mut bytes = saved(&cloud, format);
        if let Some(cut) = cut {
            bytes.truncate((cut * bytes.len() as f64) as usize);
        }
        let reach = if in_header { bytes.len().min(160) } else { bytes.len() };
        for (at, mask) in flips {
            if reach > 0 {
                bytes[(at * reach as f64) as usize] ^= mask;
            }
        }
        let (_dir, path) = file(name(format), &bytes);
        if let Ok((model, _)) = load_with_report(&path) {
            prop_assert!(model.validate().is_ok(), "what is loaded can be drawn");
        }
    }

    #[test]
    fn foreign_bytes_never_panic(start in 0usize..4, bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
        let heads: [&[u8]; 4] = [b"NGSP\x04\0\0\0", &[0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 3], b"ply\n", b""];
        let content = [heads[start], &bytes].concat();
        for name in ["a.spz", "a.splat", "a.ply"] {
            let (_dir, path) = file(name, &content);
            let _ = load_with_report(&path);
        }
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
fn models_that_cannot_be_stored_are_refused_and_the_old_file_stays() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("old");
    std::fs::write(&path, b"old").unwrap();
    let mut far = random_cloud(3, 0, 1);
    far.means[1][2] = -9e6;
    let mut broken = random_cloud(3, 0, 1);
    broken.opacity_logits[2] = f32::NAN;
    for format in COMPACT {
        let options = SaveOptions { format, sh_bits: None, comments: Vec::new() };
        let error = model::save(&path, &broken, &options).unwrap_err();
        assert!(matches!(error, Error::Parameter { .. }) && error.to_string().contains("Gaussian 2"), "{format}");
        if matches!(format, ModelFormat::Spz3 | ModelFormat::Spz4) {
            let error = model::save(&path, &far, &options).unwrap_err().to_string();
            assert!(error.contains("Gaussian 1") && error.contains("9000000"), "{error}");
        }
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
    }
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
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

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

/// One Gaussian of degree 1 by hand: position (1, −2, 0.5), opacity 128/255, colours 255 127 0, log
/// scales −10, 0, 5.9375, and coefficients 127/128, 0, −1 of the first.
fn spz_by_hand(version: u32, rotation: &[u8]) -> Vec<u8> {
    let mut bytes = b"NGSP".to_vec();
    bytes.extend(version.to_le_bytes());
    bytes.extend(1_u32.to_le_bytes());
    bytes.extend([1, 8, 0, 0]);
    for coordinate in [256_i32, -512, 128] {
        bytes.extend(&coordinate.to_le_bytes()[..3]);
    }
    bytes.push(128);
    bytes.extend([255, 127, 0]);
    bytes.extend([0, 160, 255]);
    bytes.extend(rotation);
    bytes.extend([255, 128, 0, 192, 128, 128, 128, 64, 128]);
    bytes
}

fn assert_is_the_one_by_hand(cloud: &GaussianCloud, what: &str) {
    assert_eq!(cloud.means, [[1.0, -2.0, 0.5]], "{what}");
    assert_eq!(cloud.log_scales, [[-10.0, 0.0, 5.9375]], "{what}");
    assert!((opacity(cloud.opacity_logits[0]) - 128.0 / 255.0).abs() < 1e-6, "{what}");
    let dc = cloud.sh[0];
    assert!((dc[0] - 0.5 / 0.15).abs() < 1e-5 && (dc[2] + 0.5 / 0.15).abs() < 1e-5, "{what}: {dc:?}");
    assert_eq!(&cloud.sh[1..], [[127.0 / 128.0, 0.0, -1.0], [0.5, 0.0, 0.0], [0.0, -0.5, 0.0]], "{what}");
}

#[test]
fn spz_of_versions_2_and_3_by_hand() {
    // Version 2: x y z = 0.6, 0, 0 → 204, 127.5 is not a level: 128 stands for 1/255.
    let v2 = loaded("a.spz", &gzip(&spz_by_hand(2, &[204, 128, 127])));
    assert_is_the_one_by_hand(&v2, "version 2");
    let expected = [0.8, 0.6, 1.0 / 255.0, -1.0 / 255.0];
    assert!(rotation_error(v2.quats[0], expected) < 1e-4, "{:?}", v2.quats[0]);
    // Version 3: largest is w (index 3), x = −511 steps of ½√2, y and z 0: −90° about x.
    let word = 3_u32 << 30 | (1 << 9 | 511) << 20;
    let v3 = loaded("a.spz", &gzip(&spz_by_hand(3, &word.to_le_bytes())));
    assert_is_the_one_by_hand(&v3, "version 3");
    assert!(rotation_error(v3.quats[0], [0.5_f32.sqrt(), -(0.5_f32.sqrt()), 0.0, 0.0]) < 1e-6, "{:?}", v3.quats[0]);
}

/// The streams of [`spz_by_hand`] in version 4; `extensions` stand between the header and the table of contents.
fn spz4_by_hand(extensions: &[u8], frames: &[&[u8]], sizes: &[u64]) -> Vec<u8> {
    let mut bytes = b"NGSP\x04\0\0\0\x01\0\0\0\x01\x08".to_vec();
    bytes.extend([if extensions.is_empty() { 0 } else { 2 }, frames.len() as u8]);
    bytes.extend((32 + extensions.len() as u32).to_le_bytes());
    bytes.extend([0; 12]);
    bytes.extend(extensions);
    for (frame, size) in frames.iter().zip(sizes) {
        bytes.extend((frame.len() as u64).to_le_bytes());
        bytes.extend(size.to_le_bytes());
    }
    frames.iter().for_each(|frame| bytes.extend(*frame));
    bytes
}

/// A zstd frame (RFC 8878) of one raw block of at most 255 bytes: single segment, one byte of content size.
fn raw_frame(content: &[u8]) -> Vec<u8> {
    let mut frame = vec![0x28, 0xb5, 0x2f, 0xfd, 0x20, content.len() as u8];
    let block = (content.len() as u32) << 3 | 1;
    frame.extend(&block.to_le_bytes()[..3]);
    frame.extend(content);
    frame
}

fn frames_by_hand() -> (Vec<Vec<u8>>, Vec<u64>) {
    let word = 3_u32 << 30 | (1 << 9 | 511) << 20;
    let all = spz_by_hand(3, &word.to_le_bytes());
    let mut rest = &all[16..];
    let sizes = [9, 1, 3, 3, 4, 9];
    let mut frames = Vec::new();
    for size in sizes {
        let (stream, after) = rest.split_at(size as usize);
        frames.push(raw_frame(stream));
        rest = after;
    }
    (frames, sizes.to_vec())
}

#[test]
fn spz_of_version_4_by_hand_with_extensions() {
    let (frames, sizes) = frames_by_hand();
    let frames: Vec<&[u8]> = frames.iter().map(Vec::as_slice).collect();
    let plain = loaded("a.spz", &spz4_by_hand(&[], &frames, &sizes));
    assert_is_the_one_by_hand(&plain, "version 4");
    let record =
        |kind: u32, content: &[u8]| [&kind.to_le_bytes()[..], &(content.len() as u32).to_le_bytes(), content].concat();
    // An unknown record is passed over and said; one that names RDF changes nothing.
    let known = [record(0x1234_0001, b"hello"), record(0xadbe_0003, &[6, 0, 0, 0])].concat();
    let (_dir, path) = file("a.spz", &spz4_by_hand(&known, &frames, &sizes));
    let (cloud, report) = load_with_report(&path).unwrap();
    assert_eq!(cloud, plain);
    assert!(report.notes.iter().any(|note| note.contains("0x12340001 (5 bytes)")), "{:?}", report.notes);
    // From RUB y and z change their signs; Y₁₋₁ goes with y, Y₁₀ with z, Y₁₁ with x.
    let rub = loaded("a.spz", &spz4_by_hand(&record(0xadbe_0003, &[4, 0, 0, 0]), &frames, &sizes));
    assert_eq!(rub.means, [[1.0, 2.0, -0.5]]);
    assert_eq!(&rub.sh[1..], [[-127.0 / 128.0, 0.0, 1.0], [-0.5, 0.0, 0.0], [0.0, -0.5, 0.0]]);
    let turned = message("a.spz", &spz4_by_hand(&record(0xadbe_0003, &[12, 0, 0, 0]), &frames, &sizes));
    assert!(turned.contains("coordinate system 12"), "{turned}");
    let long = [&0x1234_0001_u32.to_le_bytes()[..], &u32::MAX.to_le_bytes()].concat();
    assert!(message("a.spz", &spz4_by_hand(&long, &frames, &sizes)).contains("longer than the file"));
}

/// Frames of another encoder: `zstd` 1.5 at level 19 of the bytes 0..=255 four times over, and of 1000 zeros.
#[test]
fn frames_of_the_reference_encoder_are_read() {
    let zeros = include_bytes!("data/zeros_1000.zst");
    let sizes = [9, 1, 3, 3, 4, 0].map(|bytes: u64| 250 * bytes);
    // 250 Gaussians of degree 0: rotations are the 1000 zeros, the others shorter runs of zeros.
    let frames: [&[u8]; 5] = [
        include_bytes!("data/ramp_2250.zst"),
        &raw_frame(&[7; 250]),
        include_bytes!("data/ramp_750.zst"),
        include_bytes!("data/ramp_750.zst"),
        zeros,
    ];
    let mut bytes = spz4_by_hand(&[], &frames, &sizes);
    bytes[8] = 250;
    bytes[12] = 0;
    let cloud = loaded("a.spz", &bytes);
    assert_eq!(cloud.len(), 250);
    // Bytes 0 1 2, 3 4 5, 6 7 8 with 8 fractional bits.
    let fixed = |bytes: [u8; 4]| i32::from_le_bytes(bytes) as f32 / 256.0;
    assert_eq!(cloud.means[0], [[0, 1, 2, 0], [3, 4, 5, 0], [6, 7, 8, 0]].map(fixed));
    assert_eq!(cloud.log_scales[10], [30.0, 31.0, 32.0].map(|v: f32| v / 16.0 - 10.0));
}

#[test]
fn splat_and_compressed_ply_by_hand() {
    let mut row = Vec::new();
    [1.0_f32, -2.0, 0.5, 1.0, 0.5, 2.0].iter().for_each(|v| row.extend(v.to_le_bytes()));
    row.extend([255, 0, 51, 51, 128, 255, 128, 128]);
    let cloud = loaded("a.splat", &row);
    assert_eq!((cloud.means[0], cloud.quats[0]), ([1.0, -2.0, 0.5], [0.0, 127.0 / 128.0, 0.0, 0.0]));
    assert_eq!(cloud.log_scales[0], [0.0, -std::f32::consts::LN_2, std::f32::consts::LN_2]);
    assert!(
        (f64::from(cloud.sh[0][0]) - 0.5 / SH_C0).abs() < 1e-6 && (opacity(cloud.opacity_logits[0]) - 0.2).abs() < 1e-6
    );

    // Older files have no bounds of colours; r g b are then 0..1.
    for has_colors in [true, false] {
        let mut text = "ply\nformat binary_little_endian 1.0\ncomment by hand\nelement chunk 1\n".to_owned();
        let mut bounds = vec![-1.0_f32, 0.0, 10.0, 1.0, 2.0, 30.0, -4.0, -3.0, -2.0, 0.0, 1.0, 2.0];
        let mut names: Vec<String> =
            ["min", "max"].iter().flat_map(|m| ["x", "y", "z"].map(|a| format!("{m}_{a}"))).collect();
        names.extend(["min", "max"].iter().flat_map(|m| ["x", "y", "z"].map(|a| format!("{m}_scale_{a}"))));
        if has_colors {
            names.extend(["min", "max"].iter().flat_map(|m| ["r", "g", "b"].map(|a| format!("{m}_{a}"))));
            bounds.extend([0.0, 0.5, 1.0, 1.0, 1.5, 2.0]);
        }
        names.iter().for_each(|name| text.push_str(&format!("property float {name}\n")));
        text.push_str("element vertex 1\nproperty uint packed_position\nproperty uint packed_rotation\nproperty uint packed_scale\nproperty uint packed_color\nelement sh 1\n");
        (0..9).for_each(|i| text.push_str(&format!("property uchar f_rest_{i}\n")));
        text.push_str("end_header\n");
        let mut bytes = text.into_bytes();
        bounds.iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        // x at its maximum, y at its minimum, z at 1023/2047; largest is x (index 1), w = 1023 → ½√2, y and z 511.
        let words = [2047 << 21 | 1023, 1 << 30 | 1023 << 20 | 511 << 10 | 511, 1023 << 11, 0xff_00_80_33_u32];
        words.iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend([0, 127, 255, 64, 128, 129, 1, 2, 254]);
        let cloud = loaded("a.ply", &bytes);
        let z = 10.0 + 20.0 * 1023.0 / 2047.0;
        assert!((cloud.means[0][0], cloud.means[0][1]) == (1.0, 0.0) && (cloud.means[0][2] - z).abs() < 1e-5);
        assert_eq!(cloud.log_scales[0], [-4.0, 1.0, -2.0]);
        let m = (511.0_f64 / 1023.0 - 0.5) * std::f64::consts::SQRT_2;
        let q = [std::f64::consts::FRAC_1_SQRT_2, (0.5 - 2.0 * m * m).sqrt(), m, m].map(|v| v as f32);
        assert!(rotation_error(cloud.quats[0], q) < 1e-6, "{:?}", cloud.quats[0]);
        let rgb = if has_colors { [1.0, 0.5, 1.0 + 128.0 / 255.0] } else { [1.0, 0.0, 128.0 / 255.0] };
        for (dc, rgb) in cloud.sh[0].iter().zip(rgb) {
            assert!((f64::from(*dc) * SH_C0 + 0.5 - rgb).abs() < 1e-6);
        }
        assert!((opacity(cloud.opacity_logits[0]) - 0.2).abs() < 1e-6);
        // Channel-major: the first coefficient of R, G, B is bytes 0, 3, 6.
        let level = |v: f32| (v + 0.5) / 32.0 - 4.0;
        assert_eq!(cloud.sh[1], [-4.0, level(64.0), level(1.0)]);
        assert_eq!(cloud.sh[3], [4.0, level(129.0), level(254.0)]);
    }
}

#[test]
fn refusals_say_what_was_found_and_expected() {
    let cloud = random_cloud(300, 1, 2);
    let [packed, _, v3, v4] = COMPACT.map(|format| saved(&cloud, format));
    assert!(message("a.ply", &packed[..packed.len() - 1]).contains("truncated: found 299 of 300 rows of `sh`"));
    assert!(message("a.splat", &[1; 33]).contains("found 33 bytes, expected a multiple of 32"));
    assert!(message("a.splat", b"").contains("found 0 bytes"));
    assert!(message("a.spz", &v4[..v4.len() - 1]).contains("truncated: the stream of spherical harmonics has"));
    assert!(message("a.spz", &v4[..20]).contains("truncated: found 20 bytes, expected a header of 32"));
    assert!(message("a.spz", &v3[..v3.len() / 2]).contains("does not decompress"));
    assert!(message("a.spz", &gzip(b"hello")).contains("not a gzip stream with an SPZ header"));
    assert!(message("a.gz", &gzip(&[7; 100])).contains("expected [4e, 47, 53, 50] (`NGSP`)"));
    assert!(message("a.spz", &gzip(&spz_by_hand(1, &[0; 3]))).contains("SPZ version 1; versions 2 and 3"));
    assert!(message("a.spz", &gzip(&spz_by_hand(3, &[0; 3]))).contains("truncated: found 8 of 9 bytes of spherical"));
    let with = |at: usize, value: u8| {
        let mut bytes = spz_by_hand(3, &[0; 4]);
        bytes[at] = value;
        message("a.spz", &gzip(&bytes))
    };
    assert!(with(12, 9).contains("found SH degree 9, expected 0 to 4"));
    assert!(with(13, 24).contains("found 24 fractional bits"));
    // A count that no file of this size can hold is refused before anything is decompressed.
    assert!(with(11, 0x7f).contains("the header declares 2130706433 Gaussians of SH degree 1"));
    let mut counted = v4.clone();
    counted[11] = 0xff;
    assert!(message("a.spz", &counted).contains("declares 4278190380 Gaussians"));
    let mut version = v4.clone();
    version[4] = 5;
    assert!(message("a.spz", &version).contains("SPZ version 5; versions 4 with a plain header are read"));
    let mut toc = v4.clone();
    toc[16] = 31;
    assert!(message("a.spz", &toc).contains("the table of contents at byte 31"));
    assert!(message("a.ply", &[&packed[..4], b"end_header\n"].concat()).contains("malformed PLY header"));
    let few = String::from_utf8_lossy(&packed).replace("element chunk 2", "element chunk 1");
    let few = few.split("end_header\n").next().unwrap().to_owned() + "end_header\n";
    let data = packed.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    assert!(
        message("a.ply", &[few.as_bytes(), &packed[data..]].concat()).contains("found 1 chunks, expected 2 for 300")
    );
}

#[test]
fn rows_that_are_not_finite_are_left_out_and_counted() {
    let cloud = random_cloud(4, 0, 2);
    let mut bytes = saved(&cloud, ModelFormat::Splat);
    bytes[32..36].copy_from_slice(&f32::NAN.to_le_bytes());
    // A scale of 0 has no logarithm; 128 128 128 128 is no rotation.
    bytes[64 + 12..64 + 16].copy_from_slice(&0.0_f32.to_le_bytes());
    bytes[96 + 28..96 + 32].copy_from_slice(&[128; 4]);
    let (_dir, path) = file("a.splat", &bytes);
    let (model, report) = load_with_report(&path).unwrap();
    assert_eq!((model.len(), report.num_rows), (1, 4));
    assert_eq!((report.num_dropped_non_finite, report.num_dropped_zero_quat), (2, 1));
    let mut packed = saved(&random_cloud(300, 0, 2), ModelFormat::CompressedPly);
    let data = packed.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    // The second chunk, of 44 rows, has a bound that is not a number.
    packed[data + 72..data + 76].copy_from_slice(&f32::INFINITY.to_le_bytes());
    let (_dir, path) = file("a.ply", &packed);
    let (model, report) = load_with_report(&path).unwrap();
    assert_eq!((model.len(), report.num_dropped_non_finite), (256, 44));
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
