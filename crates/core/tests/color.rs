//! Colour science against published values and the golden file (`tests/golden/README.md`).

use gazesplat_core::color::ciede2000::delta_e;
use gazesplat_core::color::cones::{LMS_FROM_XYZ, dkl_from_linear};
use gazesplat_core::color::lab::{lab_from_linear, lab_from_srgb};
use gazesplat_core::color::metric::{metric_lab, metric_linear, metric_srgb};
use gazesplat_core::color::xyz::{XYZ_FROM_LINEAR, white};
use gazesplat_testkit::golden;
use glam::{DMat3, DVec3};

fn vectors(values: &[f64]) -> Vec<DVec3> {
    values.chunks_exact(3).map(DVec3::from_slice).collect()
}

fn matrices(values: &[f64]) -> Vec<DMat3> {
    // Rows in the file, columns in memory.
    values.chunks_exact(9).map(|m| DMat3::from_cols_slice(m).transpose()).collect()
}

/// Largest difference, relative to the largest entry.
fn relative(found: DMat3, expected: DMat3) -> f64 {
    let largest = |m: DMat3| m.to_cols_array().iter().fold(0.0, |a: f64, v| a.max(v.abs()));
    largest(found - expected) / largest(expected)
}

fn jnd_lut() -> golden::Golden {
    golden::find("jnd_lut").expect("tests/golden holds it").load()
}

#[test]
fn sharma_pairs_have_their_published_differences() {
    let path = gazesplat_testkit::workspace_root().join("tests/golden/ciede2000.json");
    let text = std::fs::read(&path).expect("tests/golden holds it");
    let json: serde_json::Value = serde_json::from_slice(&text).expect("valid JSON");
    let pairs = json["pairs"].as_array().expect("pairs");
    assert_eq!(pairs.len(), 34);
    let lab = |v: &serde_json::Value| DVec3::from_array(std::array::from_fn(|i| v[i].as_f64().expect("a number")));
    for pair in pairs {
        let (lab1, lab2) = (lab(&pair["lab1"]), lab(&pair["lab2"]));
        let found = delta_e(lab1, lab2);
        assert!((found - pair["published"].as_f64().expect("a number")).abs() <= 1e-4, "{pair}: {found}");
        assert!((found - delta_e(lab2, lab1)).abs() < 1e-12, "{pair}: not symmetric");
        // Exactly opposite hues may be resolved either way.
        if pair["hue_ambiguous"] == false {
            assert!((found - pair["dE"].as_f64().expect("a number")).abs() <= 1e-9, "{pair}: {found}");
        }
    }
}

#[test]
fn random_pairs_have_the_differences_of_the_oracle() {
    let golden = jnd_lut();
    let (lab1, lab2) = (vectors(&golden.f64("ciede2000.lab1")), vectors(&golden.f64("ciede2000.lab2")));
    let expected = golden.f64("ciede2000.dE");
    assert_eq!(expected.len(), 400);
    for ((&lab1, &lab2), &expected) in lab1.iter().zip(&lab2).zip(&expected) {
        assert!((delta_e(lab1, lab2) - expected).abs() <= 1e-9, "{lab1} {lab2}");
        assert!((delta_e(lab2, lab1) - expected).abs() <= 1e-9, "{lab1} {lab2}: not symmetric");
        assert_eq!(delta_e(lab1, lab1), 0.0);
    }
}

#[test]
fn matrices_are_those_of_the_oracle() {
    let golden = jnd_lut();
    let matrix = |name: &str| matrices(&golden.f64(&format!("matrix.{name}")))[0];
    assert!(relative(XYZ_FROM_LINEAR, matrix("srgb_to_xyz")) < 1e-15);
    assert!(relative(LMS_FROM_XYZ, matrix("xyz_to_lms_hpe")) < 1e-15);
    assert!(relative(dkl_from_linear(), matrix("hpe_raw")) < 1e-14);
    assert!((white() - DVec3::from_slice(&golden.f64("matrix.white_xyz"))).length() < 1e-15);
}

#[test]
fn lab_and_metric_are_those_of_the_oracle() {
    let golden = jnd_lut();
    for set in ["grid8", "points"] {
        let array = |name: &str| golden.f64(&format!("{set}.{name}"));
        let colors = vectors(&array("linear"));
        let (lab, lab_srgb) = (vectors(&array("lab")), vectors(&array("lab_of_srgb")));
        let [g_lab, g_linear, g_srgb] = ["G_lab", "G_linear", "G_srgb"].map(|n| matrices(&array(n)));
        let mut worst = 0.0_f64;
        for (i, &color) in colors.iter().enumerate() {
            assert!((lab_from_linear(color) - lab[i]).length() < 1e-9, "{set} {color}");
            assert!((lab_from_srgb(color) - lab_srgb[i]).length() < 1e-9, "{set} {color}");
            for (found, expected) in
                [(metric_lab(lab[i]), g_lab[i]), (metric_linear(color), g_linear[i]), (metric_srgb(color), g_srgb[i])]
            {
                worst = worst.max(relative(found, expected));
                assert!(relative(found, expected) < 1e-9, "{set} {color}: {found}, expected {expected}");
            }
        }
        println!("{set}: {} colours, worst relative difference of G {worst:.1e}", colors.len());
    }
}
