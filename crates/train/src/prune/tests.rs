//! The loop against its specification, on the CPU and, where there is one, on a GPU: a scripted guard, roll-backs,
//! interruption. The file is long because all of it goes through one small scene and its helpers.

use super::config::{PruneSection, ReferenceSection};
use super::phase::Phase;
use super::pruner::GuardFactory;
use super::*;
use crate::init::{Initial, initial_cloud};
use crate::losses::LossTarget;
use crate::metrics::{Bound, Guard, ImageMetric};
use crate::{Config, Error};
use burn::tensor::Device;
use gazesplat_core::io::images::ImageCache;
use gazesplat_core::synthetic::{SynthOptions, write_scene};
use gazesplat_core::{Dataset, GaussianCloud, ImageF32};
use gazesplat_render::{cpu_device, device::gpu_device};
use gazesplat_testkit::devices::required_gpu;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, LazyLock};

/// A scene, its dense model, and what holds its photographs.
struct Scene {
    dataset: Dataset,
    cloud: GaussianCloud,
    _dir: tempfile::TempDir,
}

static SCENE: LazyLock<Scene> = LazyLock::new(|| {
    let dir = tempfile::tempdir().expect("temporary directory");
    let options = SynthOptions {
        num_views: 9,
        width: 48,
        height: 32,
        samples_per_side: 1,
        num_points: 300,
        ..SynthOptions::default()
    };
    let dataset = write_scene(dir.path(), &options).expect("writable");
    let mut config = Config::default();
    config.model.sh_degree = 1;
    config.init.opacity = 0.6;
    let Initial { cloud, .. } = initial_cloud(&dataset, &config).expect("there are points");
    Scene { dataset, cloud: cloud.with_sh_degree(1), _dir: dir }
});

/// Every device of this machine.
fn devices() -> Vec<Device> {
    let mut devices = vec![cpu_device()];
    devices.extend(required_gpu(gpu_device(None)));
    devices
}

/// Twelve steps with an event after every second, four of adaptation; two rounds of a twentieth.
fn config() -> PruneConfig {
    let prune = PruneSection {
        budget: 1.0,
        iterations: 12,
        adapt_iterations: 4,
        event_every: 2,
        rounds: 3,
        share: 0.05,
        ..PruneSection::default()
    };
    PruneConfig { prune, ..PruneConfig::default() }
}

fn images(views: &[gazesplat_core::View]) -> Arc<ImageCache> {
    Arc::new(ImageCache::new(views.to_vec(), 1 << 30))
}

fn job<'a>(config: &'a PruneConfig, cloud: &'a GaussianCloud, device: &'a Device) -> Job<'a> {
    let dataset = &SCENE.dataset;
    Job {
        cloud,
        dataset,
        images: images(&dataset.train[1..]),
        guard_images: images(&dataset.train[..1]),
        counted: dataset.train.iter().map(|v| (v.name.clone(), v.camera)).collect(),
        config,
        more_settings: &serde_json::Value::Null,
        device,
    }
}

fn pruner(config: &PruneConfig, device: &Device) -> Pruner {
    Pruner::new(&job(config, &SCENE.cloud, device)).expect("valid")
}

/// Passes and fails as told, and then passes.
struct Script {
    verdicts: Vec<bool>,
    next: AtomicUsize,
}

impl ImageMetric for Script {
    fn name(&self) -> &str {
        "script"
    }

    fn measure(&self, _image: &ImageF32, _target: &LossTarget) -> crate::Result<f64> {
        let verdict = self.verdicts.get(self.next.fetch_add(1, Ordering::Relaxed)).copied().unwrap_or(true);
        Ok(f64::from(u8::from(verdict)))
    }
}

/// A guard that follows `verdicts` after having let the reference pass.
fn scripted(verdicts: &[bool]) -> GuardFactory {
    let verdicts: Vec<bool> = std::iter::once(true).chain(verdicts.iter().copied()).collect();
    Box::new(move |_, _| {
        let script = Script { verdicts: verdicts.clone(), next: AtomicUsize::new(0) };
        Guard::default().with(Box::new(script), Bound::AtLeast(0.5))
    })
}

/// Runs to the end; the checks, and how it ended.
fn finish(pruner: &mut Pruner) -> (Vec<Check>, Outcome) {
    let mut checks = Vec::new();
    loop {
        match pruner.advance().expect("it runs") {
            Progress::Step(_) => {}
            Progress::Check(check) => checks.push(check),
            Progress::Finished(outcome) => return (checks, outcome),
        }
    }
}

/// What does not depend on the clock.
fn timeless(checks: &[Check]) -> Vec<Check> {
    let without_time =
        |check: &Check| Check { measured: Measured { render_ms: 0.0, ..check.measured }, ..check.clone() };
    checks.iter().map(without_time).collect()
}

/// spec/pruning.md, Sec. 10, test 11.
#[test]
fn loop_follows_a_scripted_guard_line_by_line() {
    const T: bool = true;
    const F: bool = false;
    for device in devices() {
        let config = config();
        // Events at 1, 3, 5, 7, 9, 11; the check at 12; three final rounds; adaptation after 14 and 16.
        let mut pruner = pruner(&config, &device).with_guard(scripted(&[T, T, F, F, T, F, F, T, T, F, F, F]));
        let mut checks = Vec::new();
        let (mut before_ninth, mut at_final, mut after_two) = (None, None, None);
        let outcome = loop {
            let host = |p: &mut Pruner| p.model().snapshot().and_then(|s| s.to_host()).expect("the device answers");
            if pruner.phase() == (Phase::Prune { due: true }) && pruner.iteration() == 9 {
                before_ninth = Some(host(&mut pruner));
            }
            match pruner.advance().expect("it runs") {
                Progress::Step(_) => {}
                Progress::Check(check) => {
                    if check.phase == Part::Final && at_final.is_none() {
                        at_final = Some(host(&mut pruner));
                    }
                    if pruner.phase() == (Phase::Final { round: 3 }) {
                        after_two = Some(host(&mut pruner));
                    }
                    checks.push(check);
                }
                Progress::Finished(outcome) => break outcome,
            }
        };
        let n = SCENE.cloud.len();
        let round = |n: usize| n - ((0.05 * n as f64) as usize).max(1);
        let event = |n: usize| round(round(round(n)));
        let (n1, n2) = (event(n), event(event(n)));
        let n5 = event(n2);
        let rounds = |n: usize| (round(n), round(round(n)));
        let (m1, m2) = rounds(n2);
        let m3 = round(m2);
        type Line = (Part, u32, usize, usize, f32, bool, bool);
        let line = |c: &Check| -> Line {
            (c.phase, c.iteration, c.measured.points, c.removed, c.gamma, c.accepted, c.rolled_back)
        };
        let found: Vec<Line> = checks.iter().map(line).collect();
        assert_eq!(
            found,
            [
                (Part::Reference, 0, n, 0, 0.0, T, F),
                (Part::Prune, 1, n, n - n1, 1e-4, T, F),
                (Part::Prune, 3, n1, n1 - n2, 3e-4, T, F),
                (Part::Prune, 5, n2, 0, 1e-4, F, F),
                (Part::Prune, 7, n2, 0, 0.0, F, F),
                (Part::Prune, 9, n2, n2 - n5, 1e-4, T, F),
                (Part::Prune, 11, n5, 0, 0.0, F, F),
                // Fails: the state that passed at 9, before its removal, comes back.
                (Part::Final, 12, n5, 0, 0.0, F, T),
                (Part::Final, 12, m1, n2 - m1, 0.0, T, F),
                (Part::Final, 12, m2, m1 - m2, 0.0, T, F),
                // The third round fails: two are kept.
                (Part::Final, 12, m3, m2 - m3, 0.0, F, T),
                (Part::Adapt, 14, m2, 0, 0.0, F, F),
                (Part::Adapt, 16, m2, 0, 0.0, F, F),
            ]
        );
        assert!(at_final == before_ninth && before_ninth.is_some(), "parameters, moments and updates come back");
        // Nothing passes in adaptation: the state of the final phase.
        assert_eq!((outcome.status, outcome.measured.points, outcome.points_dense), (Status::Ok, m2, n));
        let result = pruner.model().snapshot().and_then(|s| s.to_host()).expect("the device answers");
        assert_eq!(Some(result), after_two);
        assert_eq!(pruner.result().expect("the device answers").len(), m2);
    }
}

#[test]
fn dense_model_is_delivered_when_nothing_passes() {
    let (config, device) = (config(), cpu_device());
    let mut pruner = pruner(&config, &device).with_guard(scripted(&[false; 20]));
    let dense = pruner.to_cloud().expect("a CPU answers");
    let (checks, outcome) = finish(&mut pruner);
    assert_eq!((outcome.status, outcome.measured.points), (Status::NoPass, SCENE.cloud.len()));
    assert!(checks[1..].iter().all(|check| !check.accepted));
    assert_eq!(pruner.result().expect("a CPU answers"), dense);
}

/// Of states with equal numbers of Gaussians the one with the higher PSNR is delivered.
#[test]
fn adaptation_delivers_the_best_state_that_passes() {
    let (config, device) = (config(), cpu_device());
    let mut pruner = pruner(&config, &device).with_guard(scripted(&[]));
    let (checks, outcome) = finish(&mut pruner);
    let fewest =
        checks.iter().filter(|c| matches!(c.phase, Part::Final | Part::Adapt)).map(|c| c.measured.points).min();
    let of_fewest = checks.iter().filter(|c| c.accepted && Some(c.measured.points) == fewest);
    let highest = of_fewest.map(|c| c.measured.psnr).fold(0.0, f64::max);
    assert_eq!((Some(outcome.measured.points), outcome.measured.psnr), (fewest, highest));
}

/// spec/pruning.md, Sec. 10, test 12.
#[test]
fn step_after_a_rollback_is_the_step_without_the_excursion() {
    for device in devices() {
        let config = config();
        let mut pruner = pruner(&config, &device).with_guard(scripted(&[]));
        while pruner.iteration() < 2 {
            pruner.advance().expect("it runs");
        }
        let trainer = pruner.trainer();
        let snapshot = trainer.state().snapshot().expect("it fits");
        let host = |t: &mut crate::Trainer| t.state().snapshot().and_then(|s| s.to_host()).expect("the device answers");
        trainer.step().expect("it runs");
        let expected = host(trainer);
        // An excursion: a step, rows gone, opacities clamped.
        trainer.step().expect("it runs");
        trainer.state().select_rows((0..50).collect()).expect("it fits");
        trainer.state().clamp_opacities(0.1).expect("it fits");
        trainer.resume_at(2, &snapshot).expect("it fits");
        trainer.step().expect("it runs");
        assert!(host(trainer) == expected);
        assert_eq!(expected.num_updates, 3);
    }
}

/// spec/pruning.md, Sec. 10, test 14, and Sec. 9: anywhere in the run, the reference included.
#[test]
fn resumed_run_ends_as_the_uninterrupted_one() {
    let dir = tempfile::tempdir().expect("temporary directory");
    let path = dir.path().join("checkpoint");
    let mut config = config();
    config.reference = ReferenceSection { iterations: 3 };
    config.prune.budget = 1.000_000_000_000_000_2;
    config.guard.loss = 0.2;
    let device = cpu_device();
    let (whole_checks, whole_outcome, whole) = {
        let mut pruner = pruner(&config, &device);
        let (checks, outcome) = finish(&mut pruner);
        (checks, outcome, pruner.result().expect("a CPU answers"))
    };
    assert!(whole.len() < SCENE.cloud.len(), "something was removed");
    for calls in [2, 4, 5, 12, 23, 25, 29] {
        let mut checks = Vec::new();
        let mut first = pruner(&config, &device);
        for _ in 0..calls {
            match first.advance().expect("it runs") {
                Progress::Check(check) => checks.push(check),
                Progress::Step(_) | Progress::Finished(_) => {}
            }
        }
        first.save(&path, Noted { report_bytes: 77, elapsed_s: 1.5 }).expect("writable");
        drop(first);
        let (mut second, noted) = Pruner::resume(&job(&config, &SCENE.cloud, &device), &path).expect("readable");
        assert_eq!(noted, Noted { report_bytes: 77, elapsed_s: 1.5 });
        let (rest, outcome) = finish(&mut second);
        checks.extend(rest);
        assert_eq!(timeless(&checks), timeless(&whole_checks), "after {calls} calls");
        assert_eq!(outcome.measured.psnr, whole_outcome.measured.psnr);
        assert!(second.result().expect("a CPU answers") == whole, "after {calls} calls");
    }
}

#[test]
fn checkpoints_of_other_runs_are_refused_with_what_differs() {
    let dir = tempfile::tempdir().expect("temporary directory");
    let path = dir.path().join("checkpoint");
    let (config, device) = (config(), cpu_device());
    pruner(&config, &device).save(&path, Noted::default()).expect("writable");
    let refused = |config: &PruneConfig, cloud: &GaussianCloud| {
        let job = job(config, cloud, &device);
        Pruner::resume(&job, &path).err().expect("refused").to_string()
    };
    let mut other = config.clone();
    other.prune.share = 0.5;
    other.guard.views = GuardViews::Test;
    let message = refused(&other, &SCENE.cloud);
    assert!(message.contains(r#"guard.views = "holdout", now "test""#), "{message}");
    assert!(message.contains("prune.share = 0.05, now 0.5"), "{message}");
    let mut cloud = SCENE.cloud.clone();
    cloud.opacity_logits[3] += 1.0;
    assert!(refused(&config, &cloud).contains("of another model"));
    let more = serde_json::json!({ "loss": { "hvsq": { "weight": 100.0 } } });
    let with_more = Job { more_settings: &more, ..job(&config, &SCENE.cloud, &device) };
    let message = Pruner::resume(&with_more, &path).err().expect("refused").to_string();
    assert!(message.contains("null, now"), "{message}");
    let mut moved = job(&config, &SCENE.cloud, &device);
    moved.counted[0].1.intrinsics.fx += 1.0;
    assert!(Pruner::resume(&moved, &path).err().expect("refused").to_string().contains("with other cameras"));
    let mut threads = config.clone();
    threads.prune.threads = 5;
    Pruner::resume(&job(&threads, &SCENE.cloud, &device), &path).expect("the result does not depend on threads");
}

#[test]
fn what_cannot_be_pruned_is_refused_before_any_work() {
    let (config, device) = (config(), cpu_device());
    let refused = |job: &Job<'_>| match Pruner::new(job) {
        Err(error) => error.to_string(),
        Ok(_) => panic!("it must be refused"),
    };
    let few = SCENE.cloud.select(&(0..99).collect::<Vec<_>>());
    assert!(refused(&job(&config, &few, &device)).contains("nothing to prune: the model has 99 Gaussians"));
    let mut unseen = SCENE.cloud.clone();
    unseen.opacity_logits.fill(-10.0);
    assert!(refused(&job(&config, &unseen, &device)).contains("sees anything of the model"));
    let mut without = job(&config, &SCENE.cloud, &device);
    without.guard_images = images(&[]);
    assert!(refused(&without).contains("no view to judge"));
    let mut without = job(&config, &SCENE.cloud, &device);
    without.images = images(&[]);
    assert!(refused(&without).contains("no training views"));
    let mut without = job(&config, &SCENE.cloud, &device);
    without.counted.remove(2);
    assert!(refused(&without).contains("is not among the 6 views that are counted"), "{}", refused(&without));
    let mut wrong = config.clone();
    wrong.prune.event_every = 0;
    assert!(refused(&job(&wrong, &SCENE.cloud, &device)).starts_with("prune.event_every"));
}

#[test]
fn reference_below_the_guard_is_said_at_once() {
    let (config, device) = (config(), cpu_device());
    let never: GuardFactory =
        Box::new(|_, _| Guard::default().with(Box::new(crate::metrics::Psnr), Bound::AtLeast(99.0)));
    let mut pruner = pruner(&config, &device).with_guard(never);
    let Err(Error::Prune(message)) = pruner.advance() else { panic!("it must be refused") };
    assert!(message.contains("misses the guard before anything is removed"), "{message}");
}

#[test]
fn reference_that_is_no_number_is_refused() {
    let measured = |psnr| Measured {
        points: 100,
        psnr,
        ssim: 0.5,
        pairs_per_tile: 1.0,
        pairs_used_per_tile: 1.0,
        ws: 0.0,
        render_ms: 1.0,
        passed: true,
    };
    let message = guard::check_reference(&measured(f64::NAN)).expect_err("refused").to_string();
    assert!(message.contains("NaN dB and an SSIM of 0.5: nothing can be held against it"), "{message}");
    guard::check_reference(&measured(30.0)).expect("a number");
}

/// A step whose loss is no number names the view; the best state and the last checkpoint stay usable.
#[test]
fn loss_that_is_no_number_leaves_the_best_state_and_the_checkpoint() {
    let dir = tempfile::tempdir().expect("temporary directory");
    let path = dir.path().join("checkpoint");
    let (config, device) = (config(), cpu_device());
    let mut pruner = pruner(&config, &device);
    while pruner.iteration() < 3 {
        pruner.advance().expect("it runs");
    }
    pruner.save(&path, Noted::default()).expect("writable");
    let best = pruner.result().expect("a CPU answers");
    struct Broken;
    impl crate::losses::ImageLoss for Broken {
        fn evaluate(&self, image: burn::tensor::Tensor<3>, _: &LossTarget) -> crate::losses::ImageLossValue {
            let loss = image.sum().mul_scalar(f32::NAN);
            crate::losses::ImageLossValue { terms: loss.clone().inner(), loss, names: &["broken"] }
        }
    }
    pruner.add_loss(1.0, Box::new(Broken));
    let error = loop {
        match pruner.advance() {
            Ok(Progress::Finished(_)) => panic!("it must fail"),
            Ok(_) => {}
            Err(error) => break error,
        }
    };
    assert!(matches!(&error, Error::NonFiniteLoss { view, .. } if !view.is_empty()), "{error}");
    assert_eq!(pruner.result().expect("a CPU answers"), best);
    let (resumed, _) = Pruner::resume(&job(&config, &SCENE.cloud, &device), &path).expect("readable");
    assert_eq!(resumed.result().expect("a CPU answers"), best);
}

#[test]
fn judges_that_see_nothing_of_the_model_are_refused() {
    let (config, device) = (config(), cpu_device());
    let mut away = SCENE.dataset.train[0].clone();
    away.camera.camera_from_world.w_axis.y += 1e6;
    let mut job = job(&config, &SCENE.cloud, &device);
    job.guard_images = images(&[away]);
    let Err(Error::Prune(message)) = Pruner::new(&job).expect("training views see it").advance() else {
        panic!("it must be refused")
    };
    assert!(message.contains("none of the 1 views that judge sees anything"), "{message}");
}

/// The published schedule with rounds that remove nothing is plain training.
#[test]
fn without_rounds_nothing_goes_but_what_fades() {
    let mut config = config();
    config.prune.rounds = 0;
    config.scale_decay.constant = Some(0.01);
    let device = cpu_device();
    let mut pruner = pruner(&config, &device).with_guard(scripted(&[]));
    let (checks, outcome) = finish(&mut pruner);
    assert!(checks.iter().all(|c| c.removed == 0 && (c.phase != Part::Prune || c.gamma == 0.01)));
    assert_eq!(outcome.measured.points + checks.iter().map(|c| c.faded).sum::<usize>(), SCENE.cloud.len());
}
