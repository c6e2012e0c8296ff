//! Damaged, foreign and impossible models: what is said, and that nothing is lost.

use crate::by_hand::spz_by_hand;
use crate::support::*;
use gazesplat_core::Error;
use gazesplat_core::io::model::{self, ModelFormat, SaveOptions, load_with_report};
use proptest::prelude::*;

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

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

    /// Behind a container that is whole, where checksums catch nothing.
    #[test]
    fn any_content_of_a_whole_container_never_panics(
        version in 2u32..=3, count in 0u32..6, degree in 0u8..6, bits in 0u8..26, flags: u8,
        content in proptest::collection::vec(any::<u8>(), 0..700),
    ) {
        let mut bytes = b"NGSP".to_vec();
        bytes.extend(version.to_le_bytes());
        bytes.extend(count.to_le_bytes());
        bytes.extend([degree, bits, flags, 0]);
        bytes.extend(content);
        let (_dir, path) = file("a.spz", &gzip(&bytes));
        if let Ok((model, report)) = load_with_report(&path) {
            prop_assert!(model.validate().is_ok() && report.num_rows == count as usize);
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
