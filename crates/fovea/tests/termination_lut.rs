//! Tables against the golden file (`tests/golden/README.md`), and the guarantee of the strict one.

use gazesplat_core::color::ColorSpace;
use gazesplat_core::color::ciede2000::delta_e;
use gazesplat_core::color::lab::lab_from_srgb;
use gazesplat_core::color::metric::metric_srgb;
use gazesplat_fovea::hvs::jnd::{Observer, Region, Rule};
use gazesplat_fovea::termination_lut::{LutRange, LutSpec, Sample, cubic_mean};
use gazesplat_render::{ColorMax, Residual, TerminationLut};
use gazesplat_testkit::{Rng, golden};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use std::time::Instant;

fn jnd_lut() -> golden::Golden {
    golden::find("jnd_lut").expect("tests/golden holds it").load()
}

fn spec(rule: Rule, space: ColorSpace, sample: Sample, residual: Residual) -> LutSpec {
    LutSpec { rule, space, read_as: space, sample, residual, ..LutSpec::strict() }
}

/// Largest relative difference.
fn worst(found: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(found.len(), expected.len());
    found.iter().zip(expected).map(|(f, e)| (f / e - 1.0).abs()).fold(0.0, f64::max)
}

#[test]
fn limits_of_the_grid_are_those_of_the_oracle() {
    let golden = jnd_lut();
    let (srgb, linear) = (ColorSpace::Srgb, ColorSpace::Linear);
    for (array, rule, space, sample, bound) in [
        ("T_vertex_linear", Rule::Vertex, linear, Sample::Centre, 1e-9),
        ("T_vertex_srgb", Rule::Vertex, srgb, Sample::Centre, 1e-9),
        ("T_vertex_linear_true", Rule::Exact, linear, Sample::Centre, 1e-6),
        ("T_vertex_srgb_true", Rule::Exact, srgb, Sample::Centre, 1e-6),
        ("T_voxelmin_linear", Rule::Vertex, linear, Sample::VoxelMin, 1e-9),
        ("T_voxelmin_srgb", Rule::Vertex, srgb, Sample::VoxelMin, 1e-9),
        ("dkl.hpe_raw.T_diag", Rule::DklDiagonal, linear, Sample::Centre, 1e-9),
        ("dkl.hpe_raw.T_diag_vertex", Rule::DklVertex, linear, Sample::Centre, 1e-9),
    ] {
        let expected = golden.f64(&format!("grid8.{array}"));
        let spec = spec(rule, space, sample, Residual::Drop);
        let found = spec.limits().expect("builds");
        let error = worst(&found, &expected);
        let range = LutRange::of(&found.iter().map(|&v| v as f32).collect::<Vec<_>>());
        println!("{array:28} relative difference {error:.1e}; {range:?}");
        assert!(error < bound, "{array}: {error:e}");
        // f32 rounds to 6e-8.
        let table: Vec<f64> = spec.build().expect("builds").values().iter().map(|&v| v.into()).collect();
        assert!(worst(&table, &expected) < 1e-6, "{array}");
        if let Some(mean) = golden.json["ranges"][format!("grid8.{array}")]["cubic_mean"].as_f64() {
            assert!((cubic_mean(&found) / mean - 1.0).abs() < bound, "{array}");
        }
    }
}

#[test]
fn limits_of_other_colours_are_those_of_the_oracle() {
    let golden = jnd_lut();
    let colors: Vec<DVec3> = golden.f64("points.linear").chunks_exact(3).map(DVec3::from_slice).collect();
    for (array, rule, space, bound) in [
        ("T_vertex_linear", Rule::Vertex, ColorSpace::Linear, 1e-9),
        ("T_vertex_srgb", Rule::Vertex, ColorSpace::Srgb, 1e-9),
        ("T_vertex_linear_true", Rule::Exact, ColorSpace::Linear, 1e-6),
        ("T_vertex_srgb_true", Rule::Exact, ColorSpace::Srgb, 1e-6),
        ("dkl.hpe_raw.T_diag", Rule::DklDiagonal, ColorSpace::Linear, 1e-9),
        ("dkl.hpe_raw.T_diag_vertex", Rule::DklVertex, ColorSpace::Linear, 1e-9),
    ] {
        let observer = Observer { rule, space, region: Region::Corner, jnd_de: 1.0 };
        let mut compared = 0;
        for (&color, expected) in colors.iter().zip(golden.f64(&format!("points.{array}"))) {
            // The oracle lets colours exceed 1, the rule clamps them as a display does.
            if rule == Rule::Exact && color.max_element() + expected > 1.0 {
                continue;
            }
            let found = observer.limit(color);
            assert!((found / expected - 1.0).abs() < bound, "{array} at {color}: {found}, expected {expected}");
            compared += 1;
        }
        println!("{array}: {compared} of {} colours", colors.len());
        assert!(compared > 150);
    }
}

/// Smallest, median and largest limit of the centred residual over that of the dropped one.
fn ratios(rule: Rule, space: ColorSpace, sample: Sample) -> [f64; 3] {
    let limits = |residual| spec(rule, space, sample, residual).limits().expect("builds");
    let mut all: Vec<f64> = limits(Residual::Centre).iter().zip(limits(Residual::Drop)).map(|(a, b)| a / b).collect();
    all.sort_by(f64::total_cmp);
    [all[0], 0.5 * (all[255] + all[256]), all[511]]
}

/// The ratios of the specification, 1.02 / 1.21 / 2.0, are those of the quadratic limits over the voxel minima of the encoded
/// metric: median and maximum to its digits. Its minimum is 1.0148, in the black voxel, which it has rounded up: no other
/// rule, space or sample has 1.02. What is proven of the minimum is the theorem, that no centred limit is below the corner one.
#[test]
fn centred_limits_of_the_table_are_1_to_2_times_the_corner_ones() {
    let [min, median, max] = ratios(Rule::Vertex, ColorSpace::Srgb, Sample::VoxelMin);
    println!("minimum {min:.4}, median {median:.4}, maximum {max:.4}");
    assert!(min >= 1.0, "{min}");
    for (found, expected) in [(median, 1.21), (max, 2.0)] {
        assert!((found - expected).abs() < 0.005, "{found}, expected {expected}");
    }
    // The same of the centres, against a second program that evaluates the closed form of G; to its four digits.
    for (space, expected) in [(ColorSpace::Srgb, [1.0139, 1.3176, 2.0]), (ColorSpace::Linear, [1.0134, 1.1814, 2.0])] {
        let found = ratios(Rule::Vertex, space, Sample::Centre);
        assert!(found.iter().zip(expected).all(|(f, e)| (f - e).abs() < 5e-5), "{space:?}: {found:?}");
    }
}

/// At greys it is a green residual that is seen first, not a grey one: the ratio is near 1 there, and 2 only for residuals
/// along the diagonal. It is 2 where the diagonal is the first to be seen: at violet blues.
#[test]
fn centring_gains_little_at_greys_because_a_grey_residual_is_seen_last() {
    let (green, diagonal) = (DVec3::Y, DVec3::ONE);
    let length = |g: DMat3, v: DVec3| v.dot(g * v).sqrt();
    // The second program's, to its digits.
    for (value, corner, centred, along) in
        [(0.0, 0.00581, 0.00588, 0.02499), (0.25, 0.00357, 0.00365, 0.01188), (1.0, 0.00462, 0.00468, 0.01986)]
    {
        let color = DVec3::splat(value);
        let g = metric_srgb(color);
        let limit = |region| Observer { rule: Rule::Vertex, space: ColorSpace::Srgb, region, jnd_de: 1.0 }.limit(color);
        assert!((limit(Region::Corner) * length(g, green) - 1.0).abs() < 1e-9, "{value}");
        assert!((limit(Region::Centred) * length(g, 2.0 * green - diagonal) - 2.0).abs() < 1e-9, "{value}");
        let found = [limit(Region::Corner), limit(Region::Centred), 1.0 / length(g, diagonal)];
        for (found, expected) in found.into_iter().zip([corner, centred, along]) {
            assert!((found - expected).abs() < 5.1e-6, "{value}: {found}, expected {expected}");
        }
    }
    let color = DVec3::new(0.6875, 0.1875, 0.9375);
    let limit = |region| Observer { rule: Rule::Vertex, space: ColorSpace::Srgb, region, jnd_de: 1.0 }.limit(color);
    assert!((limit(Region::Corner) * length(metric_srgb(color), diagonal) - 1.0).abs() < 1e-9);
    assert!((limit(Region::Centred) / limit(Region::Corner) - 2.0).abs() < 1e-9);
}

#[test]
fn the_same_table_comes_out_twice_and_on_one_thread() {
    let start = Instant::now();
    let table = LutSpec::strict().build().expect("builds");
    println!("strict: {:.2} s; {:?}", start.elapsed().as_secs_f64(), LutRange::of(table.values()));
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("one thread");
    let spec = LutSpec { size: 3, ..LutSpec::strict() };
    assert_eq!(pool.install(|| spec.build()).expect("builds"), spec.build().expect("builds"));
}

/// One pixel: colours and opacities front to back, the background, and the bound of its channels.
struct Front {
    splats: Vec<([f32; 3], f32)>,
    background: [f32; 3],
    color_max: f32,
}

/// 1 to 64 splats; colours up to 1, or beyond; alphas thin or opaque; greys, saturated and random colours.
fn front(rng: &mut Rng) -> Front {
    let len = 1 + rng.below(64);
    let brightest = [1.0, 1.0, 1.5, 3.0][rng.below(4)];
    let opaque = [0.05, 0.3, 0.999][rng.below(3)];
    let base: [f32; 3] = std::array::from_fn(|_| rng.range(0.0, brightest));
    let spread = [0.0, 0.05, 1.0][rng.below(3)];
    let contrast = rng.below(3);
    let corner = |rng: &mut Rng| std::array::from_fn(|_| if rng.below(2) == 0 { 0.0 } else { brightest });
    let far: [f32; 3] = corner(rng);
    let mut color = |k: usize| -> [f32; 3] {
        // What is behind may be as different as can be: black, white, primaries, mixed or all the same.
        match contrast {
            1 if k * 2 > len => return corner(rng),
            2 if k * 2 > len => return far,
            _ => {}
        }
        std::array::from_fn(|c| (base[c] + spread * (rng.unit() as f32 - 0.5)).clamp(0.0, brightest))
    };
    let colors: Vec<[f32; 3]> = (0..len).map(&mut color).collect();
    let background: [f32; 3] = color(len).map(|c| c.min(1.0));
    let splats: Vec<_> = colors.into_iter().map(|c| (c, rng.range(1.0 / 255.0, opaque))).collect();
    let channels = splats.iter().flat_map(|s| s.0).chain(background);
    Front { color_max: channels.fold(1.0, f32::max), splats, background }
}

/// The kernel's loop (spec of the renderer, and JND Sec. 3) and the full composite, in f32; ΔE₀₀ between them, and whether
/// the pixel stopped.
fn difference(front: &Front, lut: &TerminationLut) -> (f64, bool) {
    let color_max = if lut.color_max() == ColorMax::Tile { front.color_max } else { 1.0 };
    let composite = |lut: Option<&TerminationLut>| {
        let (mut t, mut color) = (1.0_f32, [0.0_f32; 3]);
        for &(c, alpha) in &front.splats {
            let is_ended = lut.is_some_and(|lut| {
                t * color_max <= lut.limit(color) || t * (1.0 - alpha) <= lut.also_fixed().unwrap_or(0.0)
            });
            if is_ended {
                return (t, color, true);
            }
            for (sum, c) in color.iter_mut().zip(c) {
                *sum += t * alpha * c;
            }
            t -= t * alpha;
        }
        (t, color, false)
    };
    let shown = |t: f32, color: [f32; 3], rest: [f32; 3]| {
        let channels: [f64; 3] = std::array::from_fn(|c| f64::from(color[c] + t * rest[c]).clamp(0.0, 1.0));
        lab_from_srgb(DVec3::from_array(channels))
    };
    let (t, color, _) = composite(None);
    let full = shown(t, color, front.background);
    let (t, color, is_stopped) = composite(Some(lut));
    let rest = match lut.residual() {
        _ if !is_stopped => front.background,
        Residual::Drop => [0.0; 3],
        Residual::Centre => [0.5 * color_max; 3],
        other => panic!("{other:?} carries no guarantee"),
    };
    (delta_e(full, shown(t, color, rest)), is_stopped)
}

/// Largest difference over `trials` fronts, how many exceeded one JND, how many stopped.
fn trials(lut: &TerminationLut, trials: u64) -> (f64, u64, u64) {
    (0..trials / 1000)
        .into_par_iter()
        .map(|seed| {
            let mut rng = Rng::new(0x6a6e_6400 + seed);
            let (mut worst, mut above, mut stopped) = (0.0_f64, 0, 0);
            for _ in 0..1000 {
                let (de, is_stopped) = difference(&front(&mut rng), lut);
                assert!(de.is_finite(), "a pixel is no number");
                worst = worst.max(de);
                above += u64::from(de > 1.0);
                stopped += u64::from(is_stopped);
            }
            (worst, above, stopped)
        })
        .reduce(|| (0.0, 0, 0), |a, b| (a.0.max(b.0), a.1 + b.1, a.2 + b.2))
}

#[test]
fn no_front_differs_by_more_than_one_jnd_under_the_strict_table() {
    let strict = LutSpec::strict();
    for residual in [Residual::Centre, Residual::Drop] {
        let lut = LutSpec { residual, ..strict.clone() }.build().expect("builds");
        let (worst, above, stopped) = trials(&lut, 1_000_000);
        println!("strict, {residual:?}: largest ΔE₀₀ {worst:.4}, {above} above 1, {stopped} of 1000000 stopped");
        assert!(stopped > 300_000, "the trials hardly stop");
        // 17³ samples of a cell leave some of it unseen.
        assert!(worst <= 1.05, "{residual:?}: {worst}");
    }
    // Counted, not promised: what the published choice admits.
    let (worst, above, stopped) = trials(&LutSpec::paper().build().expect("builds"), 100_000);
    println!("paper: largest ΔE₀₀ {worst:.2}, {above} above 1, {stopped} of 100000 stopped");
}

#[test]
fn the_naive_table_stops_every_colour_alike() {
    let spec = LutSpec { is_constant: true, ..LutSpec::paper() };
    let lut = spec.build().expect("builds");
    assert!(lut.values().iter().all(|&v| v == lut.values()[0]));
    // The cubic mean of the published table.
    assert!((f64::from(lut.values()[0]) / 5.063_442e-3 - 1.0).abs() < 1e-6);
}
