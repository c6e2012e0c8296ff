//! HVSQ at every vector width of this machine. A binary of its own: the width is forced for the whole process.

use gazesplat_fovea::Hvsq;
use gazesplat_fovea::hvs::pooling::{GazePooling, Pooling};
use gazesplat_fovea::hvsq::{Distance, ImageView};
use gazesplat_render::simd::{SimdLevel, force_level};
use gazesplat_testkit::difference;
use gazesplat_testkit::reference::hvsq::images::{interleaved, pair};

/// The tolerances of the golden data: 1e-5 for values, 1e-4 for gradients.
#[test]
fn vector_widths_agree() {
    let [a, b] = pair(90, 150).map(|i| interleaved(&i, 3));
    let view = |data| ImageView { width: 150, height: 90, channels: 3, data };
    let uniform = |size_px| Pooling::Uniform { size_px };
    for pooling in [uniform(1.0), uniform(3.0), Pooling::Gaze(GazePooling { alpha: 0.4, ..GazePooling::default() })] {
        let run = |level: SimdLevel| {
            force_level(Some(level));
            let reference = Hvsq::new(pooling, Distance::Mse).unwrap().reference(view(&a[..])).unwrap();
            reference.value_and_gradient(view(&b[..])).unwrap()
        };
        let found: Vec<_> = SimdLevel::ALL.into_iter().filter(|l| l.is_available()).map(run).collect();
        force_level(None);
        for (value, gradient) in &found[1..] {
            assert!((value / found[0].0 - 1.0).abs() < 1e-5, "{pooling:?}");
            assert!(difference(gradient, &found[0].1).relative_l2 < 1e-4, "{pooling:?}");
        }
    }
}
