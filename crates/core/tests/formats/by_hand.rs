//! Files made byte by byte from the descriptions of the formats, and frames of another encoder.

use crate::support::*;
use gazesplat_core::GaussianCloud;
use gazesplat_core::io::model::load_with_report;

/// One Gaussian of degree 1 by hand: position (1, −2, 0.5), opacity 128/255, colours 255 127 0, log
/// scales −10, 0, 5.9375, and coefficients 127/128, 0, −1 of the first.
pub fn spz_by_hand(version: u32, rotation: &[u8]) -> Vec<u8> {
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
    let zeros = include_bytes!("../data/zeros_1000.zst");
    let sizes = [9, 1, 3, 3, 4, 0].map(|bytes: u64| 250 * bytes);
    // 250 Gaussians of degree 0: rotations are the 1000 zeros, the others shorter runs of zeros.
    let frames: [&[u8]; 5] = [
        include_bytes!("../data/ramp_2250.zst"),
        &raw_frame(&[7; 250]),
        include_bytes!("../data/ramp_750.zst"),
        include_bytes!("../data/ramp_750.zst"),
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
