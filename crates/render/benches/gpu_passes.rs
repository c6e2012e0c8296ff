//! Time of each pass on a GPU, and of whole frames at 1080p by number of Gaussians.
//!
//! Work on a GPU is queued: every sample ends with waiting for the queue, so a pass is measured with its launches. A
//! software driver is measured at the smaller sizes only, and its name stands on the first line.

use criterion::{Criterion, criterion_group, criterion_main};
use gazesplat_core::synthetic::{bench_camera, bench_cloud};
use gazesplat_render::device::{adapters, gpu_device};
use gazesplat_render::gpu::Gpu;
use gazesplat_render::kernels::cpu::bin::TileGrid;
use gazesplat_render::kernels::cpu::project::ViewSpec;
use gazesplat_render::kernels::cpu::rasterize::RasterOptions;
use gazesplat_render::kernels::gpu::bin::bin;
use gazesplat_render::kernels::gpu::project::{GaussianBuffers, project};
use gazesplat_render::kernels::gpu::project_bwd::project_bwd;
use gazesplat_render::kernels::gpu::rasterize::rasterize;
use gazesplat_render::kernels::gpu::rasterize_bwd::rasterize_bwd;
use gazesplat_render::layout::{ALPHA_MAX, NEAR, T_STOP};
use gazesplat_render::view_params::view_params;
use gazesplat_render::{RenderOptions, Splats, render};

const OPTIONS: RasterOptions = RasterOptions {
    alpha_max: ALPHA_MAX,
    t_stop: T_STOP,
    lut: None,
    background: [0.0; 3],
    depth: false,
    smooth_cutoff: false,
    absolute_gradients: true,
};

fn wait(gpu: &Gpu) {
    cubecl::future::block_on(gpu.client.sync()).expect("the adapter answers");
}

fn gpu_passes(c: &mut Criterion) {
    let device = match gpu_device(None) {
        Ok(device) => device,
        Err(error) => {
            println!("SKIPPED: {error}");
            return;
        }
    };
    let adapter = adapters().into_iter().find(|a| a.is_default).expect("it was just opened");
    println!("adapter: {} ({}, {}, {})", adapter.name, adapter.kind, adapter.api, adapter.driver);
    let gpu = Gpu::from_device(&device).expect("a GPU device");
    let is_software = adapter.kind == "software";
    let (num, width, height) = if is_software { (50_000, 640, 480) } else { (300_000, 1000, 1000) };
    let cloud = bench_cloud(num, 1);
    let camera = bench_camera(width, height);
    let view = ViewSpec {
        params: view_params(&camera).expect("the bench camera is valid"),
        width: camera.intrinsics.width,
        height: camera.intrinsics.height,
        near: NEAR,
        antialiased: false,
    };
    let grid = TileGrid::new(view.width, view.height);
    let buffer = |values: &[f32]| gpu.upload_u32(bytemuck::cast_slice(values), &[values.len()]);
    let g = GaussianBuffers {
        means: buffer(cloud.means.as_flattened()),
        quats: buffer(cloud.quats.as_flattened()),
        log_scales: buffer(cloud.log_scales.as_flattened()),
        opacity_logits: buffer(&cloud.opacity_logits),
        sh: buffer(cloud.sh.as_flattened()),
        len: num,
        num_coefficients: cloud.num_coefficients(),
        sh_degree: cloud.sh_degree,
    };
    let fits = "the bench scene is within limits";
    let projected = project(&gpu, &g, &view).expect(fits);
    let lists = bin(&gpu, &g, &projected, grid, false).expect(fits);
    let raster = rasterize(&gpu, &lists, &OPTIONS, true).expect(fits);
    let v_image = raster.image.clone();
    let records = rasterize_bwd(&gpu, &lists, &OPTIONS, &raster, v_image.clone(), false).expect(fits);
    println!("visible {}, pairs {}", lists.num_visible, lists.num_pairs);
    let mut group = c.benchmark_group(format!("GPU, {num} Gaussians {width}x{height}"));
    group.sample_size(10);
    let mut pass = |name: &str, run: &dyn Fn()| {
        group.bench_function(name, |b| {
            b.iter(|| {
                run();
                wait(&gpu);
            });
        });
    };
    pass("project", &|| drop(project(&gpu, &g, &view).expect(fits)));
    pass("bin with sort and read-back", &|| drop(bin(&gpu, &g, &projected, grid, false).expect(fits)));
    pass("rasterize", &|| drop(rasterize(&gpu, &lists, &OPTIONS, true).expect(fits)));
    pass("rasterize_bwd", &|| {
        drop(rasterize_bwd(&gpu, &lists, &OPTIONS, &raster, v_image.clone(), false).expect(fits));
    });
    pass("project_bwd", &|| drop(project_bwd(&gpu, &g, &view, &lists, records.clone(), false).expect(fits)));
    group.finish();
    let mut group = c.benchmark_group("GPU, frame at 1920x1080");
    group.sample_size(10);
    for num in [100_000, 500_000, 1_000_000, 3_000_000] {
        if is_software && num > 100_000 {
            println!("SKIPPED on a software driver: {num} Gaussians");
            continue;
        }
        let splats = Splats::from_cloud(&bench_cloud(num, 1), &device).expect("it fits");
        let camera = bench_camera(1920, 1080);
        group.bench_function(format!("{num} Gaussians"), |b| {
            b.iter(|| {
                let frame = render(&splats, &camera, &RenderOptions::default()).expect(fits);
                wait(&gpu);
                frame
            });
        });
    }
    group.finish();
}

criterion_group!(benches, gpu_passes);
criterion_main!(benches);
