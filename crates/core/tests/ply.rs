//! 3DGS PLY files: round trips, odd layouts, damaged files, real models.

#![expect(clippy::unwrap_used, reason = "a helper of a test may panic like the test")]

use gazesplat_core::io::ply::{load, load_points, load_with_report, save};
use gazesplat_core::rng::Rng;
use gazesplat_core::{Error, GaussianCloud};
use proptest::prelude::*;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

fn random_cloud(num_gaussians: usize, degree: u32, seed: u64) -> GaussianCloud {
    let mut rng = Rng::new(seed);
    let mut cloud = GaussianCloud::zeros(num_gaussians, degree);
    let mut fill = |values: &mut [f32]| values.iter_mut().for_each(|v| *v = rng.normal());
    fill(cloud.means.as_flattened_mut());
    fill(cloud.quats.as_flattened_mut());
    fill(cloud.log_scales.as_flattened_mut());
    fill(&mut cloud.opacity_logits);
    fill(cloud.sh.as_flattened_mut());
    cloud
}

fn written(bytes: &[u8]) -> (TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("model.ply");
    std::fs::write(&path, bytes).unwrap();
    (dir, path)
}

fn saved(cloud: &GaussianCloud) -> Vec<u8> {
    let dir = tempfile::tempdir().unwrap();
    save(dir.path().join("a.ply"), cloud).unwrap();
    std::fs::read(dir.path().join("a.ply")).unwrap()
}

/// Property names of a model in the order of the reference implementation.
fn names(degree: u32) -> Vec<String> {
    let numbered = |name: &str, n: usize| (0..n).map(|i| format!("{name}_{i}")).collect::<Vec<_>>();
    let mut names: Vec<String> = ["x", "y", "z", "nx", "ny", "nz"].map(String::from).to_vec();
    names.extend(numbered("f_dc", 3));
    names.extend(numbered("f_rest", [0, 9, 24, 45, 72][degree as usize]));
    names.push("opacity".into());
    names.extend(numbered("scale", 3));
    names.extend(numbered("rot", 4));
    names
}

/// Values of Gaussian `i` in the order of [`names`]; written from the format's definition, not from the code under test.
fn row(cloud: &GaussianCloud, i: usize) -> Vec<f32> {
    let sh = cloud.sh_of(i);
    let mut row = cloud.means[i].to_vec();
    row.extend([0.0; 3]);
    row.extend(sh[0]);
    (0..3).for_each(|channel| row.extend(sh[1..].iter().map(|c| c[channel])));
    row.push(cloud.opacity_logits[i]);
    row.extend(cloud.log_scales[i]);
    row.extend(cloud.quats[i]);
    row
}

fn header(format: &str, num_rows: usize, properties: &[(String, &str)]) -> Vec<u8> {
    let mut text = format!("ply\nformat {format} 1.0\ncomment made by a test\nelement vertex {num_rows}\n");
    properties.iter().for_each(|(name, kind)| text.push_str(&format!("property {kind} {name}\n")));
    text.push_str("end_header\n");
    text.into_bytes()
}

fn float_properties(degree: u32) -> Vec<(String, &'static str)> {
    names(degree).into_iter().map(|name| (name, "float")).collect()
}

fn message(result: Result<impl std::fmt::Debug, Error>) -> String {
    let error = result.expect_err("the file is bad");
    format!("{error} | hint: {}", error.hint().unwrap_or_default())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn saved_models_load_as_they_were(degree in 0u32..=4, n in 0usize..200, seed: u64) {
        let cloud = random_cloud(n, degree, seed);
        let (_dir, path) = written(&saved(&cloud));
        let (loaded, report) = load_with_report(&path).unwrap();
        prop_assert_eq!(loaded, cloud);
        prop_assert_eq!((report.num_rows, report.num_dropped_non_finite, report.num_dropped_zero_quat), (n, 0, 0));
    }

    #[test]
    fn any_property_order_and_extra_columns_change_nothing(degree in 0u32..=3, seed: u64, is_mixed: bool) {
        let cloud = random_cloud(7, degree, seed);
        let mut rng = Rng::new(seed ^ 1);
        let mut properties = float_properties(degree);
        // A non-float column sends the file through the other reader.
        properties.push(("extra".into(), if is_mixed { "uchar" } else { "float" }));
        properties.push(("another".into(), "float"));
        let mut order: Vec<usize> = (0..properties.len()).collect();
        rng.shuffle(&mut order);
        let shuffled: Vec<_> = order.iter().map(|&i| properties[i].clone()).collect();
        let mut bytes = header("binary_little_endian", 7, &shuffled);
        for i in 0..7 {
            let mut values = row(&cloud, i);
            values.extend([7.0, f32::NAN]);
            for &column in &order {
                match properties[column].1 {
                    "uchar" => bytes.push(7),
                    _ => bytes.extend(values[column].to_le_bytes()),
                }
            }
        }
        let (_dir, path) = written(&bytes);
        prop_assert_eq!(load(&path).unwrap(), cloud);
    }
}

#[test]
fn saved_bytes_are_the_layout_of_the_reference() {
    let cloud = random_cloud(5, 3, 2);
    let mut expected = format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", cloud.len());
    names(3).iter().for_each(|name| expected.push_str(&format!("property float {name}\n")));
    expected.push_str("end_header\n");
    let mut expected = expected.into_bytes();
    (0..5).for_each(|i| row(&cloud, i).iter().for_each(|v| expected.extend(v.to_le_bytes())));
    assert_eq!(saved(&cloud), expected);
}

#[test]
fn models_larger_than_a_block_round_trip() {
    let cloud = random_cloud(150_001, 1, 5);
    let (_dir, path) = written(&saved(&cloud));
    assert!(load(&path).unwrap() == cloud);
}

#[test]
fn ascii_big_endian_and_double_load_like_little_endian() {
    let cloud = random_cloud(9, 2, 3);
    let rows: Vec<Vec<f32>> = (0..9).map(|i| row(&cloud, i)).collect();
    let mut ascii = header("ascii", 9, &float_properties(2));
    for row in &rows {
        let text: Vec<String> = row.iter().map(f32::to_string).collect();
        ascii.extend(format!("{} \r\n", text.join("  ")).into_bytes());
    }
    let mut big = header("binary_big_endian", 9, &float_properties(2));
    rows.iter().flatten().for_each(|v| big.extend(v.to_be_bytes()));
    let doubles: Vec<_> = names(2).into_iter().map(|name| (name, "double")).collect();
    let mut double = header("binary_little_endian", 9, &doubles);
    rows.iter().flatten().for_each(|v| double.extend(f64::from(*v).to_le_bytes()));
    for bytes in [ascii, big, double] {
        let (_dir, path) = written(&bytes);
        assert_eq!(load(&path).unwrap(), cloud);
    }
}

#[test]
fn missing_normals_and_foreign_elements_are_fine() {
    let cloud = random_cloud(4, 1, 4);
    let kept: Vec<usize> = (0..names(1).len()).filter(|i| !(3..6).contains(i)).collect();
    let mut text = String::from("ply\r\nformat binary_little_endian 1.0\r\nelement meta 2\r\n");
    text.push_str("property list uchar int ids\r\nproperty uchar kind\r\nelement vertex 4\r\n");
    kept.iter().for_each(|&i| text.push_str(&format!("property float {}\r\n", names(1)[i])));
    text.push_str("element face 0\r\nproperty list uchar int vertex_indices\r\nend_header\r\n");
    let mut bytes = text.into_bytes();
    for ids in [&[1i32, 2, 3][..], &[]] {
        bytes.push(ids.len() as u8);
        ids.iter().for_each(|id| bytes.extend(id.to_le_bytes()));
        bytes.push(9);
    }
    (0..4).for_each(|i| kept.iter().for_each(|&column| bytes.extend(row(&cloud, i)[column].to_le_bytes())));
    let (_dir, path) = written(&bytes);
    assert_eq!(load(&path).unwrap(), cloud);
}

#[test]
fn rows_that_cannot_be_drawn_are_dropped_and_counted() {
    let mut cloud = random_cloud(10, 1, 6);
    cloud.means[1][2] = f32::NAN;
    cloud.sh[4 * 4 + 3][1] = f32::INFINITY;
    cloud.opacity_logits[9] = f32::NEG_INFINITY;
    cloud.quats[6] = [0.0; 4];
    let expected = cloud.select(&[0, 2, 3, 5, 7, 8]);
    let (_dir, path) = written(&saved(&cloud));
    let (loaded, report) = load_with_report(&path).unwrap();
    assert_eq!(loaded, expected);
    assert_eq!((report.num_rows, report.num_dropped_non_finite, report.num_dropped_zero_quat), (10, 3, 1));

    let mut ascii = header("ascii", 10, &float_properties(1));
    for i in 0..10 {
        row(&cloud, i).iter().for_each(|v| ascii.extend(format!("{v} ").into_bytes()));
    }
    let (_dir, path) = written(&ascii);
    assert_eq!(load_with_report(&path).unwrap(), (expected, report));
}

#[test]
fn truncation_anywhere_is_an_error_and_never_a_panic() {
    let bytes = saved(&random_cloud(3, 1, 7));
    let data = bytes.len() - 3 * 4 * names(1).len();
    for length in 0..bytes.len() {
        let (_dir, path) = written(&bytes[..length]);
        let message = message(load(&path));
        if length >= data {
            let rows = (length - data) / (4 * names(1).len());
            assert!(message.contains(&format!("truncated: found {rows} of 3 vertex rows")), "{message}");
        }
        assert!(load_points(&path).is_err());
    }
    let ascii = b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n4 5";
    let (_dir, path) = written(ascii);
    assert!(message(load_points(&path)).contains("found 1 of 2 vertex rows"));
}

#[test]
fn absurd_counts_allocate_nothing() {
    for format in ["binary_little_endian", "binary_big_endian", "ascii"] {
        for count in ["18446744073709551615", "4611686018427387904", "99999999999999999999999"] {
            let text = String::from_utf8(header(format, 77, &float_properties(3))).unwrap();
            let (_dir, path) = written(text.replace(" 77\n", &format!(" {count}\n")).as_bytes());
            assert!(load(&path).is_err());
        }
    }
    let (_dir, path) = written(b"ply\nformat ascii 1.0\nelement nothing 18446744073709551615\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n");
    assert_eq!(load_points(&path).unwrap().positions.len(), 0);
}

#[test]
fn errors_name_what_is_missing_and_what_the_file_is() {
    let without = |missing: &[&str]| {
        let properties: Vec<_> =
            float_properties(1).into_iter().filter(|(n, _)| !missing.contains(&n.as_str())).collect();
        let (_dir, path) = written(&header("binary_little_endian", 0, &properties));
        message(load(&path))
    };
    assert!(without(&["opacity", "rot_2"]).contains("missing: opacity, rot_2;"));
    assert!(without(&["f_rest_4"]).contains("missing: f_rest_4"), "{}", without(&["f_rest_4"]));
    assert!(without(&["f_rest_8"]).contains("found 8 f_rest properties, expected 0, 9, 24, 45 or 72"));
    let of = |name: &str, bytes: &[u8]| {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        message(load(&path))
    };
    let points =
        b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
    assert!(of("p.ply", points).contains("point cloud"));
    assert!(
        of("m.ply", b"ply\nformat ascii 1.0\nelement face 0\nend_header\n")
            .contains("no `vertex` element; the file has: face")
    );
    let packed = b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty uint packed_position\nend_header\n";
    assert!(of("c.ply", packed).contains("compressed PLY"));
    assert!(of("x.spz", &[0x1f, 0x8b, 8, 0]).contains("SPZ"));
    assert!(of("x.sog", b"PK\x03\x04").contains("SOG"));
    assert!(of("x.json", b"{}").contains("JSON"));
    assert!(of("x.splat", &[0; 32]).contains(".splat"));
    assert!(of("x.ply", b"hello").contains("not a PLY"));
    assert!(of("x.ply", b"").contains("empty"));
    let twice = b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float x\nend_header\n";
    assert!(of("x.ply", twice).contains("declared twice"));
    let word = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 two 3\n";
    let (_dir, path) = written(word);
    assert!(message(load_points(&path)).contains("`two` is not a number"));
    assert!(matches!(load(Path::new("no/such/file.ply")), Err(Error::Io { .. })));
    assert!(matches!(load(std::env::temp_dir()), Err(Error::Io { .. })));
}

#[test]
fn points_take_their_colours_in_every_form() {
    let header = |kind: &str| {
        format!(
            "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\nproperty {kind} red\nproperty {kind} green\nproperty {kind} blue\nend_header\n"
        )
    };
    for (kind, rows) in [
        ("uchar", "1 2 3 255 0 51\nnan 0 0 1 1 1\n"),
        ("float", "1 2 3 1 -1 .2\n0 inf 0 1 1 1\n"),
        ("ushort", "1 2 3 65535 0 13107\n-nan 0 0 1 1 1\n"),
    ] {
        let (_dir, path) = written(format!("{}{rows}", header(kind)).as_bytes());
        let points = load_points(&path).unwrap();
        assert_eq!(points.positions, [[1.0, 2.0, 3.0]], "{kind}");
        assert_eq!(points.colors, [[255, 0, 51]], "{kind}");
    }
    let (_dir, path) = written(b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n");
    assert_eq!(load_points(&path).unwrap().colors, [[128; 3]]);
    let (_dir, path) = written(&saved(&GaussianCloud { quats: vec![[1.0; 4]; 2], ..GaussianCloud::zeros(2, 1) }));
    assert_eq!(load_points(&path).unwrap().colors, [[128; 3]; 2]);
}

#[test]
fn inconsistent_clouds_are_not_written() {
    let dir = tempfile::tempdir().unwrap();
    let mut cloud = random_cloud(3, 1, 1);
    cloud.quats.pop();
    assert!(matches!(save(dir.path().join("a.ply"), &cloud), Err(Error::Parameter { .. })));
    assert!(!dir.path().join("a.ply").exists());
}

#[test]
fn real_models_load_and_come_back_byte_for_byte() {
    for (name, num_gaussians, degree) in [("model_plush", 15_105, 3), ("model_flowers", 200_001, 2)] {
        let Some(path) = gazesplat_testkit::data_path(&format!("{name}/point_cloud.ply")) else { return };
        let (cloud, report) = load_with_report(&path).unwrap();
        assert_eq!((cloud.len(), cloud.sh_degree, report.num_rows), (num_gaussians, degree, num_gaussians));
        cloud.validate().unwrap();
        // Both files have zero normals and the standard order, so that only the header may differ.
        let original = std::fs::read(&path).unwrap();
        let data = num_gaussians * 4 * names(degree).len();
        let ours = saved(&cloud);
        assert!(ours[ours.len() - data..] == original[original.len() - data..], "{name}");
    }
}

#[test]
fn real_point_cloud_loads() {
    let Some(path) = gazesplat_testkit::data_path("garden_points/points3D.ply") else { return };
    let points = load_points(&path).unwrap();
    assert_eq!((points.positions.len(), points.colors.len()), (138_766, 138_766));
    assert!(points.colors.iter().any(|c| *c != points.colors[0]));
}
