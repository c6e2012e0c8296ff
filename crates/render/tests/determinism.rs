//! One scene, one result: the same bits on any number of threads and on every call.

use gazesplat_render::cluster::morton_order;
use gazesplat_render::{Pass, StatsMode};

use crate::common::scenes::{Draw, random, upstream};
use crate::common::{Frame, Gradients, Scene};

fn large() -> Scene {
    let draw = Draw { n: 6000, size: [213, 150], sh_degree: 2, log_scale: [-4.5, -2.0], ..Draw::default() };
    let mut scene = random(77, draw);
    scene.options.stats = StatsMode::All;
    scene
}

fn on_threads(scene: &Scene, upstream: &[f32], num_threads: usize) -> (Frame, Gradients) {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(num_threads).build().expect("the pool starts");
    pool.install(|| scene.frame_and_gradients(upstream))
}

#[test]
fn image_gradients_and_counters_are_the_same_bits_on_any_number_of_threads() {
    let scene = large();
    let upstream = upstream(5, &scene);
    let (frame, gradients) = on_threads(&scene, &upstream, 1);
    assert!(frame.stats.num_visible > 4000 && gradients.means.iter().filter(|&&v| v != 0.0).count() > 3000);
    for num_threads in [2, 3, 7] {
        let (other, other_gradients) = on_threads(&scene, &upstream, num_threads);
        assert!(other.image == frame.image, "image on {num_threads} threads");
        assert!(other.stats == frame.stats, "statistics on {num_threads} threads");
        assert!(other.splat_stats == frame.splat_stats, "counters on {num_threads} threads");
        for ((name, values), (_, expected)) in other_gradients.groups().into_iter().zip(gradients.groups()) {
            assert!(values == expected, "gradient of {name} on {num_threads} threads");
        }
    }
}

#[test]
fn counting_does_not_change_the_image() {
    let mut scene = large();
    let expected = scene.frame().image;
    for stats in [StatsMode::None, StatsMode::Tiles, StatsMode::Dominance] {
        scene.options.stats = stats;
        assert!(scene.frame().image == expected, "{stats:?}");
    }
}

#[test]
fn depth_does_not_change_the_other_channels() {
    let mut scene = large();
    let with_depth = scene.frame().image;
    scene.options.depth = false;
    let without: Vec<[f32; 4]> = scene.frame().image.chunks_exact(4).map(|p| [p[0], p[1], p[2], p[3]]).collect();
    assert!(with_depth.chunks_exact(5).zip(&without).all(|(a, b)| a[..4] == b[..]));
}

#[test]
fn skipping_whole_clusters_does_not_change_the_image() {
    let mut scene = large();
    // A narrow view of a wide model whose rows are spatially sorted.
    scene.camera.intrinsics.fx *= 4.0;
    scene.camera.intrinsics.fy *= 4.0;
    let order = morton_order(&scene.cloud.means);
    let pick = |i: &u32| *i as usize;
    let cloud = &scene.cloud;
    let k = cloud.num_coefficients();
    scene.cloud = gazesplat_core::GaussianCloud {
        means: order.iter().map(|i| cloud.means[pick(i)]).collect(),
        quats: order.iter().map(|i| cloud.quats[pick(i)]).collect(),
        log_scales: order.iter().map(|i| cloud.log_scales[pick(i)]).collect(),
        opacity_logits: order.iter().map(|i| cloud.opacity_logits[pick(i)]).collect(),
        sh_degree: cloud.sh_degree,
        sh: order.iter().flat_map(|i| cloud.sh[pick(i) * k..(pick(i) + 1) * k].to_vec()).collect(),
    };
    let skipping = scene.frame();
    scene.options.pass = Pass::Train;
    let reading = scene.frame();
    println!("{} of {} Gaussians skipped with their cluster", skipping.stats.num_culled_by_cluster, scene.cloud.len());
    assert!(skipping.stats.num_culled_by_cluster > 0 && reading.stats.num_culled_by_cluster == 0);
    assert!(skipping.image == reading.image && skipping.splat_stats == reading.splat_stats);
}

crate::common::on_gpu!(counting_does_not_change_the_image, depth_does_not_change_the_other_channels,);
