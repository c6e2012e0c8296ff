//! temp
use gazesplat_core::synthetic::{bench_camera, bench_cloud};
use gazesplat_render::kernels::cpu::bin::{TileGrid, bin};
use gazesplat_render::kernels::cpu::project::{GaussianSlices, ViewSpec, project};
use gazesplat_render::kernels::cpu::project_bwd::project_bwd;
use gazesplat_render::kernels::cpu::rasterize::{RasterOptions, rasterize};
use gazesplat_render::kernels::cpu::rasterize_bwd::rasterize_bwd;
use gazesplat_render::kernels::cpu::stats::StatsLevel;
use gazesplat_render::simd::{SimdLevel, force_level};
fn cpu() -> f64 { let s = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap(); s.split_whitespace().next().unwrap().parse::<f64>().unwrap() * 1e-6 }
fn main() {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    pool.install(|| {
    let cloud = bench_cloud(300_000, 1);
    let camera = bench_camera(1000, 1000);
    let g = GaussianSlices { means: cloud.means.as_flattened(), quats: cloud.quats.as_flattened(), log_scales: cloud.log_scales.as_flattened(), opacity_logits: &cloud.opacity_logits, sh: cloud.sh.as_flattened(), num_coefficients: cloud.num_coefficients(), sh_degree: cloud.sh_degree };
    let spec = ViewSpec { params: gazesplat_render::view_params::view_params(&camera).unwrap(), width: 1000, height: 1000, near: 0.01 };
    let o = RasterOptions { alpha_max: 0.999, t_stop: 1e-4, background: [0.0; 3], depth: false, smooth_cutoff: false };
    let time = |name: &str, per: f64, f: &mut dyn FnMut()| { let mut best = f64::MAX; for _ in 0..7 { let t = cpu(); f(); best = best.min(cpu() - t); } println!("{name}: {best:.2} ms {}", if per > 0.0 { format!("{:.3} ns/lane-px", best * 1e6 / per) } else { String::new() }); };
    let s = project(&g, &spec, None);
    let grid = TileGrid::new(1000, 1000);
    let l = bin(&s, grid, true).unwrap();
    let r = rasterize(s.rows(), &l, &o, StatsLevel::None, true);
    let n = r.stats.num_lane_pixels as f64;
    let all = rasterize(s.rows(), &l, &o, StatsLevel::All, false);
    println!("V {} pairs {} used {} lanes {} blended {} rows/pair {:.1}", s.len(), l.pair_splats.len(), r.stats.num_pairs_used, n, all.stats.num_blended, n / 16.0 / r.stats.num_pairs_used as f64);
    time("project", 0.0, &mut || { std::hint::black_box(project(&g, &spec, None)); });
    time("bin", 0.0, &mut || { std::hint::black_box(bin(&s, grid, true).unwrap()); });
    let v = vec![1e-3; r.image.len()];
    for level in SimdLevel::ALL { force_level(Some(level)); println!("{level:?}");
        time(" fwd", n, &mut || { std::hint::black_box(rasterize(s.rows(), &l, &o, StatsLevel::None, true)); });
        time(" bwd", n, &mut || { std::hint::black_box(rasterize_bwd(s.rows(), &l, &o, &r, &v, false)); });
    }
    force_level(None);
    time("dominance", n, &mut || { std::hint::black_box(rasterize(s.rows(), &l, &o, StatsLevel::Dominance, false)); });
    let p = rasterize_bwd(s.rows(), &l, &o, &r, &v, false);
    time("project_bwd", 0.0, &mut || { std::hint::black_box(project_bwd(&g, &spec, &s, &l, &p, false)); });
    });
}
