//! Checkpoints of a trainer: what of a run is no function of its seed and step.
//!
//! That is the model with its moments, the step, when the rows were last sorted, with how many Gaussians the run began, and
//! the corrections of the poses, and what its strategy has seen and done since. Views, backgrounds, noise and draws are
//! counter-based, so on a CPU a resumed run ends in the same bytes. The file is long by its tests: every kind of state has one.

use super::{Trainer, check_scene};
use crate::checkpoint::{self, differences, fingerprint_of_cameras};
use crate::config::Config;
use crate::error::{Error, Result};
use crate::event::DensifyReport;
use crate::optim::{AdamSettings, ModelState};
use crate::poses::ViewPose;
use burn::tensor::Device;
use gazesplat_core::dataset::Dataset;
use gazesplat_core::io::images::ImageCache;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::Arc;

/// Kind of run, as checkpoints name it.
const KIND: &str = "train";
/// The vector of what the strategy knows.
const MEMORY: &str = "densify";
/// Settings that change nothing of the model.
const FREE: &[&str] = &["train.threads", "train.checkpoint_every", "train.checkpoint_keep", "data.cache_bytes"];

/// What a checkpoint holds beside the model.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Record<N> {
    /// Version of the library: another one may train another model.
    version: String,
    config: Config,
    origin: Origin,
    step: u32,
    sorted_at: u32,
    num_initial: usize,
    /// Corrections of the poses, if they are refined.
    #[serde(default)]
    poses: Option<Vec<ViewPose>>,
    totals: DensifyReport,
    noted: N,
}

/// The scene of a run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct Origin {
    /// Names of the training views, then of the test views.
    views: [Vec<String>; 2],
    /// Fingerprint of the cameras of the training views.
    cameras: String,
    /// Bits of the radius of the scene: a decimal number may lose its last digit.
    extent: u32,
}

impl Trainer {
    /// Writes everything the run needs to go on, and what the caller wants to find again. A file that was there before
    /// stays until the new one is complete on the disk.
    ///
    /// # Errors
    /// When the device does not answer, an earlier step failed, or the file cannot be written.
    pub fn save(&mut self, path: &Path, noted: &impl Serialize) -> Result<()> {
        self.settle()?;
        self.settle_poses()?;
        let record = Record {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            config: self.config.clone(),
            origin: self.origin(),
            step: self.step,
            sorted_at: self.sorted_at,
            num_initial: self.num_initial,
            poses: self.recorded_poses(),
            totals: self.totals,
            noted,
        };
        let state = self.state.snapshot()?.to_host()?;
        let memory = self.strategy.memory()?;
        let vectors: Vec<(&str, &[f32])> = memory.iter().map(|values| (MEMORY, values.as_slice())).collect();
        checkpoint::save_with(path, KIND, &record, &[("state", &state)], &vectors)
    }

    /// Takes up the run that left the checkpoint at `path`, and returns what its caller had noted. Terms that were added
    /// to the loss are added again by the caller.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] when the file is damaged, or of another scene, version or settings, each difference named; as
    /// [`Trainer::from_cloud`].
    pub fn resume<N: DeserializeOwned>(
        dataset: &Dataset,
        images: Arc<ImageCache>,
        config: &Config,
        device: &Device,
        path: &Path,
    ) -> Result<(Self, N)> {
        config.validate()?;
        let mut loaded: checkpoint::Loaded<Record<N>> = checkpoint::load(path, KIND, &["state"])?;
        let refuse = |message: String| Error::Checkpoint { path: path.to_owned(), message };
        let state = loaded.take("state").ok_or_else(|| refuse("damaged: the model is missing".to_owned()))?;
        let memory = loaded.take_vector(MEMORY);
        let Record { version, config: recorded, origin, step, sorted_at, num_initial, poses, totals, noted } =
            loaded.meta;
        let current = env!("CARGO_PKG_VERSION");
        if version != current {
            return Err(refuse(format!("it is of version {version}, this is {current}")));
        }
        let found = differences(&recorded, config, FREE);
        if !found.is_empty() {
            return Err(refuse(format!("its settings differ: {}", found.join(", "))));
        }
        let size = (state.rows.params.num_rows(), state.rows.params.num_coefficients());
        check_scene(dataset, &images, size, config, device)?;
        let state = ModelState::from_host(state, AdamSettings::default(), device)?;
        let mut trainer = Self::around(state, num_initial, dataset, images, config);
        let expected = trainer.origin();
        if origin != expected {
            let what = if origin.views == expected.views { "with other cameras" } else { "on other views" };
            return Err(refuse(format!("it is of a run {what}")));
        }
        if !trainer.restore_poses(poses) {
            return Err(refuse("damaged: its camera poses are not those of its views".to_owned()));
        }
        if let Some(memory) = memory
            && !trainer.strategy.remember(memory, trainer.state.num_rows(), device)
        {
            return Err(refuse("damaged: the statistic of densification does not fit the model".to_owned()));
        }
        (trainer.step, trainer.sorted_at, trainer.totals) = (step, sorted_at, totals);
        Ok((trainer, noted))
    }

    fn origin(&self) -> Origin {
        let names = |images: &ImageCache| images.views().iter().map(|view| view.name.clone()).collect();
        Origin {
            views: [names(&self.images), names(&self.test_images)],
            cameras: fingerprint_of_cameras(self.images.views().iter().map(|view| &view.camera)),
            extent: self.extent.to_bits(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::StrategyKind;
    use gazesplat_core::synthetic::{SynthOptions, write_scene};
    use gazesplat_render::{cpu_device, device::gpu_device};
    use gazesplat_testkit::devices::required_gpu;

    /// Long enough for two sortings of the rows: they are at least 200 steps apart.
    const NUM_STEPS: u32 = 520;

    fn scene(num_views: usize) -> (tempfile::TempDir, Dataset) {
        let dir = tempfile::tempdir().expect("temporary directory");
        let options = SynthOptions {
            num_views,
            width: 40,
            height: 28,
            samples_per_side: 1,
            num_points: 150,
            ..SynthOptions::default()
        };
        let dataset = write_scene(dir.path(), &options).expect("writable");
        (dir, dataset)
    }

    fn config() -> Config {
        let mut config = Config::default();
        config.train.steps = NUM_STEPS;
        config.densify.cap = 400;
        config.model.sh_degree = 2;
        config.data.background = crate::config::Background::Named(crate::config::NamedBackground::Random);
        config
    }

    fn images(dataset: &Dataset) -> Arc<ImageCache> {
        Arc::new(ImageCache::new(dataset.train.clone(), 1 << 30))
    }

    fn resumed(dataset: &Dataset, config: &Config, device: &Device, path: &Path) -> Result<(Trainer, String)> {
        Trainer::resume(dataset, images(dataset), config, device, path)
    }

    /// Everything that the end of a run is made of: parameters, moments, updates; and the last sorting.
    fn end(mut trainer: Trainer) -> (crate::optim::HostState, u32) {
        while trainer.step < NUM_STEPS {
            trainer.step().expect("trains");
        }
        (trainer.state.snapshot().and_then(|s| s.to_host()).expect("readable"), trainer.sorted_at)
    }

    /// A run of ADC in which everything happens as often as in one of MCMC: refinements to five sixths of it, and opacity
    /// resets, which leave some rows to remove.
    fn adc(absolute_gradients: bool) -> Config {
        let mut config = config();
        config.densify.strategy = StrategyKind::Adc;
        config.densify.absolute_gradients = absolute_gradients;
        (config.densify.stop, config.densify.reset_every) = (Some(5.0 / 6.0), 130);
        config
    }

    #[test]
    fn interrupted_runs_end_in_the_bytes_of_the_uninterrupted_one() {
        interrupted_everywhere(&config());
    }

    #[test]
    fn interrupted_runs_of_adc_end_in_the_bytes_of_the_uninterrupted_one() {
        for absolute_gradients in [false, true] {
            interrupted_everywhere(&adc(absolute_gradients));
        }
    }

    fn interrupted_everywhere(config: &Config) {
        let (dir, dataset) = scene(7);
        let (config, device) = (config.clone(), cpu_device());
        let fresh = || Trainer::new(&dataset, images(&dataset), &config, &device).expect("valid");
        // Where something changes: the stop falls before, at and after it.
        let (mut watched, mut stops) = (fresh(), vec![0, 1]);
        let mut kinds = [0; 3];
        let mut before = (watched.num_gaussians(), watched.state.num_coefficients(), watched.sorted_at);
        while watched.step < NUM_STEPS {
            watched.step().expect("trains");
            let after = (watched.num_gaussians(), watched.state.num_coefficients(), watched.sorted_at);
            let changes = [before.0 != after.0, before.1 != after.1, before.2 != after.2];
            for (kind, changed) in changes.into_iter().enumerate() {
                // Of each kind the first two are enough.
                if changed && kinds[kind] < 2 {
                    kinds[kind] += 1;
                    stops.extend([watched.step - 1, watched.step, watched.step + 1]);
                }
            }
            before = after;
        }
        assert_eq!(kinds, [2; 3], "growth, SH bands and sortings are met");
        stops.retain(|&stop| stop < NUM_STEPS);
        stops.sort_unstable();
        stops.dedup();
        let totals = watched.totals;
        let expected = end(watched);
        let path = dir.path().join("checkpoint");
        // One run that is interrupted at all of them, each time taken up from the file.
        let mut trainer = fresh();
        for stop in stops {
            while trainer.step < stop {
                trainer.step().expect("trains");
            }
            trainer.save(&path, &format!("at {stop}")).expect("writable");
            let (again, noted) = resumed(&dataset, &config, &device, &path).expect("valid");
            assert_eq!((again.step, again.sorted_at, noted), (stop, trainer.sorted_at, format!("at {stop}")));
            assert_eq!(again.totals, trainer.totals);
            trainer = again;
        }
        let is_adc = config.densify.strategy == StrategyKind::Adc;
        assert_eq!((totals.num_split > 0, totals.num_opacity_resets > 1), (is_adc, is_adc), "{totals:?}");
        assert!(end(trainer) == expected);
    }

    /// Everything of [`end`], and the corrections of the poses.
    fn end_with_poses(mut trainer: Trainer) -> (crate::optim::HostState, Vec<ViewPose>) {
        while trainer.step < trainer.config.train.steps {
            trainer.step().expect("trains");
        }
        trainer.settle_poses().expect("readable");
        let poses = trainer.recorded_poses().expect("asked for");
        (trainer.state.snapshot().and_then(|s| s.to_host()).expect("readable"), poses)
    }

    /// At, before and after the ends of epochs of six views, and on a GPU where gradients of poses still wait to be read.
    #[test]
    fn refined_poses_are_resumed_bit_for_bit() {
        let (dir, dataset) = scene(7);
        let mut config = config();
        (config.train.steps, config.train.refine_poses, config.poses.start) = (50, true, 3000);
        let mut devices = vec![cpu_device()];
        devices.extend(required_gpu(gpu_device(None)));
        for device in devices {
            let fresh = || Trainer::new(&dataset, images(&dataset), &config, &device).expect("valid");
            let expected = end_with_poses(fresh());
            assert!(expected.1.iter().all(|pose| pose.num_updates > 5 && pose.twist != [0.0; 6]), "{:?}", expected.1);
            let path = dir.path().join("checkpoint");
            let mut trainer = fresh();
            for stop in [0, 3, 5, 6, 7, 11, 12, 20, 33, 48, 49, 50] {
                while trainer.step < stop {
                    trainer.step().expect("trains");
                }
                trainer.save(&path, &"noted").expect("writable");
                trainer = resumed(&dataset, &config, &device, &path).expect("valid").0;
            }
            assert!(end_with_poses(trainer) == expected);
        }
        // Records that fit no run of these settings.
        let mut trainer = Trainer::new(&dataset, images(&dataset), &config, &cpu_device()).expect("valid");
        assert!(!trainer.restore_poses(None) && !trainer.restore_poses(Some(vec![ViewPose::default(); 5])));
        assert!(trainer.restore_poses(Some(vec![ViewPose::default(); 6])));
        config.train.refine_poses = false;
        let mut trainer = Trainer::new(&dataset, images(&dataset), &config, &cpu_device()).expect("valid");
        assert!(!trainer.restore_poses(Some(vec![ViewPose::default(); 6])) && trainer.restore_poses(None));
    }

    /// Images grow at steps 80 and 160; rows lag from 512 on, and after the last refinement, at 667, until the sweep of the
    /// last step.
    #[test]
    fn interrupted_runs_from_coarse_to_fine_with_rows_that_lag_end_in_the_same_bytes() {
        const STEPS: u32 = 800;
        let (dir, dataset) = scene(7);
        let (mut config, device) = (config(), cpu_device());
        config.train.steps = STEPS;
        (config.train.num_downscales, config.optim.visible_only) = (2, true);
        let path = dir.path().join("checkpoint");
        let run = |trainer: &mut Trainer, to: u32| {
            while trainer.step < to {
                trainer.step().expect("trains");
            }
            trainer.state.snapshot().and_then(|s| s.to_host()).expect("readable")
        };
        let fresh = || Trainer::new(&dataset, images(&dataset), &config, &device).expect("valid");
        let mut whole = fresh();
        let lagging = run(&mut whole, STEPS - 1);
        assert!(lagging.last.iter().any(|&word| word + 5 < STEPS), "some rows are behind");
        let expected = run(&mut whole, STEPS);
        let mut trainer = fresh();
        for stop in [79, 80, 81, 159, 160, 161, 511, 512, 513, 640, 668, 767, 768, 769, 790] {
            run(&mut trainer, stop);
            // Whoever looks changes nothing.
            trainer.to_cloud().expect("readable");
            trainer.evaluate().expect("readable");
            trainer.save(&path, &"noted").expect("writable");
            trainer = resumed_plainly(&dataset, &config, &device, &path);
        }
        assert!(run(&mut trainer, STEPS - 1) == lagging);
        assert!(run(&mut trainer, STEPS) == expected);
        // A checkpoint whose words fit no model is damaged, not a panic.
        trainer.save(&path, &"noted").expect("writable");
        let mut state = expected;
        for last in [vec![STEPS; 3], vec![STEPS + 1; state.rows.num_rows()], vec![3; state.rows.num_rows()]] {
            state.last = last;
            let meta = serde_json::json!(null);
            checkpoint::save(&path, KIND, &meta, &[("state", &state)]).expect("writable");
            let loaded = checkpoint::load::<serde_json::Value>(&path, KIND, &["state"]);
            let said = loaded.expect_err("refused").to_string();
            assert!(said.contains("damaged: `state.last` does not fit"), "{said}");
        }
    }

    fn resumed_plainly(dataset: &Dataset, config: &Config, device: &Device, path: &Path) -> Trainer {
        let resumed: Result<(Trainer, String)> = Trainer::resume(dataset, images(dataset), config, device, path);
        resumed.expect("valid").0
    }

    /// The device repeats its bits from run to run, so that the tolerance is none.
    #[test]
    fn a_gpu_goes_on_as_if_nothing_had_happened() {
        for config in [config(), adc(false)] {
            interrupted_on_a_gpu(config);
        }
    }

    fn interrupted_on_a_gpu(mut config: Config) {
        let Some(device) = required_gpu(gpu_device(None)) else { return };
        let (dir, dataset) = scene(5);
        config.train.steps = 40;
        let path = dir.path().join("checkpoint");
        let mut trainer = Trainer::new(&dataset, images(&dataset), &config, &device).expect("valid");
        let run = |trainer: &mut Trainer, to: u32| {
            while trainer.step < to {
                trainer.step().expect("trains");
            }
        };
        run(&mut trainer, 23);
        trainer.save(&path, &"noted").expect("writable");
        let (mut again, _) = resumed(&dataset, &config, &device, &path).expect("valid");
        run(&mut trainer, 40);
        run(&mut again, 40);
        assert!(trainer.to_cloud().expect("readable") == again.to_cloud().expect("readable"));
    }

    #[test]
    fn checkpoints_of_other_runs_are_refused_with_what_differs() {
        let (dir, dataset) = scene(7);
        let (config, device, path) = (config(), cpu_device(), dir.path().join("checkpoint"));
        let mut trainer = Trainer::new(&dataset, images(&dataset), &config, &device).expect("valid");
        trainer.step().expect("trains");
        trainer.save(&path, &"noted").expect("writable");
        let refused = |dataset: &Dataset, config: &Config| {
            let error = resumed(dataset, config, &device, &path).err().expect("refused");
            assert!(error.hint().is_some());
            error.to_string()
        };
        let mut other = config.clone();
        (other.train.seed, other.densify.noise) = (4, 1.5);
        let said = refused(&dataset, &other);
        assert!(said.contains("train.seed = 0, now 4") && said.contains("densify.noise = "), "{said}");
        let mut longer = adc(false);
        longer.densify.strategy = StrategyKind::Mcmc;
        let said = refused(&dataset, &longer);
        assert!(said.contains("densify.stop = null, now 0.8333"), "{said}");
        let mut faster = config.clone();
        (faster.train.threads, faster.train.checkpoint_every, faster.data.cache_bytes) = (3, 7, 1 << 20);
        resumed(&dataset, &faster, &device, &path).expect("the model does not depend on these");
        assert!(refused(&scene(8).1, &config).contains("on other views"));
        let mut moved = dataset.clone();
        moved.train[2].camera.intrinsics.fx += 0.5;
        assert!(refused(&moved, &config).contains("with other cameras"));
        let whole = std::fs::read(&path).expect("readable");
        let version = format!("\\\"version\\\":\\\"{}", env!("CARGO_PKG_VERSION"));
        let at = whole.windows(version.len()).position(|w| w == version.as_bytes()).expect("it is recorded");
        let mut of_another = whole.clone();
        of_another[at + version.len() - 1] = b'x';
        std::fs::write(&path, of_another).expect("writable");
        assert!(refused(&dataset, &config).contains("it is of version "));
        std::fs::write(&path, &whole[..whole.len() - 9]).expect("writable");
        assert!(refused(&dataset, &config).contains("damaged"));
        // A save that fails leaves what was there.
        std::fs::write(&path, &whole).expect("writable");
        assert!(trainer.save(&dir.path().join("none/checkpoint"), &"noted").is_err());
        resumed(&dataset, &config, &device, &path).expect("still there");
    }
}
