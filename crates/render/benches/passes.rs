//! Time of each pass by number of Gaussians and image size, and of the rasterisers per lane-pixel and SIMD level.
//!
//! A lane-pixel is one lane of one tile row visited by one splat: 16 per row. The rasterisers run on one thread here,
//! so `thrpt` is lane-pixels per second of one core; its inverse is the figure of BENCHMARKS.md.

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use gazesplat_core::color::ColorSpace;
use gazesplat_core::synthetic::{bench_camera, bench_cloud};
use gazesplat_core::{Camera, GaussianCloud};
use gazesplat_render::TerminationLut;
use gazesplat_render::kernels::cpu::bin::{BinExtras, TileGrid, TileLists, bin};
use gazesplat_render::kernels::cpu::pose_bwd::pose_bwd;
use gazesplat_render::kernels::cpu::project::{GaussianSlices, ProjectedSplats, ViewSpec, project};
use gazesplat_render::kernels::cpu::project_bwd::project_bwd;
use gazesplat_render::kernels::cpu::rasterize::{RasterOptions, rasterize};
use gazesplat_render::kernels::cpu::rasterize_bwd::rasterize_bwd;
use gazesplat_render::kernels::cpu::sort::depth_order;
use gazesplat_render::kernels::cpu::stats::StatsLevel;
use gazesplat_render::layout::{ALPHA_MAX, NEAR, T_FLOOR, T_STOP, lane};
use gazesplat_render::simd::{SimdLevel, force_level};
use gazesplat_render::view_params::view_params;
use std::hint::black_box;

const OPTIONS: RasterOptions = RasterOptions {
    alpha_max: ALPHA_MAX,
    t_stop: T_STOP,
    lut: None,
    background: [0.0; 3],
    depth: false,
    smooth_cutoff: false,
    absolute_gradients: true,
};

const RECORDS: BinExtras = BinExtras { records: true, color_max: true };

fn slices(cloud: &GaussianCloud) -> GaussianSlices<'_> {
    GaussianSlices {
        means: cloud.means.as_flattened(),
        quats: cloud.quats.as_flattened(),
        log_scales: cloud.log_scales.as_flattened(),
        opacity_logits: &cloud.opacity_logits,
        sh: cloud.sh.as_flattened(),
        num_coefficients: cloud.num_coefficients(),
        sh_degree: cloud.sh_degree,
    }
}

fn view(camera: &Camera) -> ViewSpec {
    ViewSpec {
        params: view_params(camera).expect("the bench camera is valid"),
        width: camera.intrinsics.width,
        height: camera.intrinsics.height,
        near: NEAR,
        antialiased: false,
    }
}

fn binned(cloud: &GaussianCloud, camera: &Camera) -> (ProjectedSplats<'static>, TileLists<'static>) {
    let splats = project(&slices(cloud), &view(camera), None);
    let grid = TileGrid::new(camera.intrinsics.width, camera.intrinsics.height);
    let lists = bin(&splats, grid, RECORDS).expect("the bench scene is within limits");
    (splats, lists)
}

/// Passes at the scene of the step target, and at other sizes.
fn passes(c: &mut Criterion) {
    for (num, width, height) in
        [(50_000, 640, 480), (300_000, 1000, 1000), (300_000, 1920, 1080), (1_000_000, 1000, 1000)]
    {
        let cloud = bench_cloud(num, 1);
        let camera = bench_camera(width, height);
        let g = slices(&cloud);
        let spec = view(&camera);
        let (splats, lists) = binned(&cloud, &camera);
        let depths: Vec<f32> = splats.rows().iter().map(|s| s[lane::DEPTH]).collect();
        let raster = rasterize(splats.rows(), &lists, &OPTIONS, StatsLevel::None, true);
        let v_image = vec![1e-3; raster.image.len()];
        let pairs = rasterize_bwd(splats.rows(), &lists, &OPTIONS, &raster, &v_image, false);
        let mut group = c.benchmark_group(format!("{num} Gaussians {width}x{height}"));
        group.sample_size(10);
        println!("visible {}, pairs {}, {:?}", splats.len(), lists.pair_splats.len(), raster.stats);
        group.bench_function("project", |b| b.iter(|| project(black_box(&g), &spec, None)));
        group.bench_function("sort", |b| b.iter(|| depth_order(black_box(&depths))));
        group.bench_function("bin", |b| b.iter(|| bin(black_box(&splats), lists.grid, RECORDS)));
        group.bench_function("rasterize", |b| {
            b.iter(|| rasterize(splats.rows(), black_box(&lists), &OPTIONS, StatsLevel::None, true));
        });
        group.bench_function("statistics (dominance)", |b| {
            b.iter(|| rasterize(splats.rows(), black_box(&lists), &OPTIONS, StatsLevel::Dominance, false));
        });
        group.bench_function("rasterize_bwd", |b| {
            b.iter(|| rasterize_bwd(splats.rows(), black_box(&lists), &OPTIONS, &raster, &v_image, false));
        });
        group.bench_function("project_bwd", |b| {
            b.iter(|| project_bwd(black_box(&g), &spec, &splats, &lists, &pairs, false));
        });
        let v = project_bwd(&g, &spec, &splats, &lists, &pairs, false);
        group.bench_function("pose_bwd", |b| {
            b.iter(|| pose_bwd(black_box(&g), &spec, &splats.global_from_compact, &v));
        });
        group.finish();
    }
}

/// Limits from 0.005 to 0.03, smooth like real ones.
fn table() -> TerminationLut {
    let values = (0..512).map(|i| 0.005 + 0.001 * (i / 64 + 2 * (i / 8 % 8) + i % 8) as f32).collect();
    TerminationLut::new(8, values, ColorSpace::Srgb).expect("the table is legal")
}

/// Rasterisers per lane-pixel on one thread, at every SIMD level.
fn lane_pixels(c: &mut Criterion) {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("one thread is always to be had");
    let cloud = bench_cloud(300_000, 1);
    let camera = bench_camera(1000, 1000);
    let (splats, lists) = binned(&cloud, &camera);
    let raster = rasterize(splats.rows(), &lists, &OPTIONS, StatsLevel::None, true);
    let v_image = vec![1e-3; raster.image.len()];
    let mut group = c.benchmark_group("lane-pixels, one core");
    group.sample_size(10).throughput(Throughput::Elements(raster.stats.num_lane_pixels));
    for level in SimdLevel::ALL.into_iter().filter(|l| l.is_available()) {
        force_level(Some(level));
        group.bench_function(BenchmarkId::new("forward", format!("{level:?}")), |b| {
            b.iter(|| pool.install(|| rasterize(splats.rows(), black_box(&lists), &OPTIONS, StatsLevel::None, true)));
        });
        // The same list with a table whose limits are of the size of real ones.
        let options = RasterOptions { t_stop: T_FLOOR, lut: Some(table()), ..OPTIONS };
        group.bench_function(BenchmarkId::new("forward with table", format!("{level:?}")), |b| {
            b.iter(|| pool.install(|| rasterize(splats.rows(), black_box(&lists), &options, StatsLevel::None, true)));
        });
        group.bench_function(BenchmarkId::new("backward", format!("{level:?}")), |b| {
            b.iter(|| {
                pool.install(|| rasterize_bwd(splats.rows(), black_box(&lists), &OPTIONS, &raster, &v_image, false))
            });
        });
    }
    force_level(None);
    group.finish();
}

criterion_group!(benches, passes, lane_pixels);
criterion_main!(benches);
