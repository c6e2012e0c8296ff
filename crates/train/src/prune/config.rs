//! Settings of pruning: plain data with defaults in place, unknown keys rejected.
//!
//! The defaults are the preset `quick`: the published schedule scaled by `prune.budget`, with a guard that never looks at
//! the test views.

use super::criterion::CriterionKind;
use crate::config::{Config, DataSection, DensifySection, LossSection, OptimSection, RenderSection, StrategyKind};
use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};

/// All settings of a pruning run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PruneConfig {
    /// Schedule and rounds.
    pub prune: PruneSection,
    /// Training before the reference is measured.
    pub reference: ReferenceSection,
    /// What the model must hold.
    pub guard: GuardSection,
    /// Shrinking of Gaussians in many tiles.
    pub scale_decay: ScaleDecaySection,
    /// Learning rates.
    pub optim: PruneOptimSection,
    /// Terms of the loss.
    pub loss: LossSection,
    /// Which images, at which size; those of the run the model comes from, if it comes from one.
    pub data: DataSection,
    /// The renderer; as `data`.
    pub render: RenderSection,
    /// What the model was trained for; as `data`.
    pub model: PruneModelSection,
}

/// What the model was trained for.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PruneModelSection {
    /// Count, judge and train on in the antialiased mode. Default false, or what the model says.
    pub antialiased: bool,
}

/// Schedule and rounds (RTGS Fig. 6).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PruneSection {
    /// What is worth keeping: `"ce"`, `"surface"`, `"opacity"`, `"max_contribution"` or `"significance"`. Default `"ce"`.
    pub criterion: CriterionKind,
    /// Scale of all numbers of steps below, above 0. Default 0.04; the published run is 1.
    pub budget: f64,
    /// Steps with pruning, before scaling. Default 45000.
    pub iterations: u32,
    /// Steps of adaptation after the last removal, before scaling. Default 5000.
    pub adapt_iterations: u32,
    /// Steps from one event to the next, before scaling; scaling leaves at least 100, if there were as many, and at most a
    /// sixth of the steps with pruning. Default 1000.
    pub event_every: u32,
    /// Rounds of removal in an event. Default 5.
    pub rounds: u32,
    /// Share of the Gaussians that a round removes, in [0, 1); at least one Gaussian. Default 0.02.
    pub share: f64,
    /// Gaussians below this opacity are removed at every event. Default 0.005.
    pub min_opacity: f32,
    /// Never fewer Gaussians than this. Default 1.
    pub min_points: usize,
    /// Opacities are lowered to this after a removal, so that each Gaussian earns its own again, in (min_opacity, 1]; 1 =
    /// they are left alone. Unset = 0.1, or 0.5 where events are closer than 250 steps.
    pub opacity_clamp: Option<f32>,
    /// Lower them once more after the last removal. Default false.
    pub final_clamp: bool,
    /// Seed of every random number of the run. Default 0.
    pub seed: u64,
    /// Worker threads; 0 = one per core. The result does not depend on it. Default 0.
    pub threads: usize,
}

impl Default for PruneSection {
    fn default() -> Self {
        Self {
            criterion: CriterionKind::Ce,
            budget: 0.04,
            iterations: 45_000,
            adapt_iterations: 5000,
            event_every: 1000,
            rounds: 5,
            share: 0.02,
            min_opacity: 0.005,
            min_points: 1,
            opacity_clamp: None,
            final_clamp: false,
            seed: 0,
            threads: 0,
        }
    }
}

/// Training before the reference is measured, for models that were made with other rules of rendering.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ReferenceSection {
    /// Steps, before scaling. Default 0; the published run takes 5000.
    pub iterations: u32,
}

/// Which views judge the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum GuardViews {
    /// Every 8th training view, kept out of gradient steps.
    #[default]
    Holdout,
    /// The same views, which stay in the gradient steps.
    Train,
    /// The test views: the published procedure, which leaks them into the choice of the model.
    Test,
}

impl GuardViews {
    /// Name, as in settings and reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Holdout => "holdout",
            Self::Train => "train",
            Self::Test => "test",
        }
    }
}

/// What the model must hold.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GuardSection {
    /// Which views judge: `"holdout"`, `"train"` or `"test"`. Default `"holdout"`.
    pub views: GuardViews,
    /// Share of PSNR (in dB) and of SSIM that may be lost, in [0, 1). Default 0.01.
    pub loss: f64,
}

impl Default for GuardSection {
    fn default() -> Self {
        Self { views: GuardViews::Holdout, loss: 0.01 }
    }
}

/// Unit of the scales that decay.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ScaleUnit {
    /// World units: the published strength.
    #[default]
    World,
    /// The extent of the scene, so that γ means the same in every scene.
    Extent,
}

/// Shrinking of Gaussians in many tiles (RTGS Eq. 4–6).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ScaleDecaySection {
    /// First γ above 0, of the first event that passes; 0 = no scale decay. Default 1e-4.
    pub start: f64,
    /// γ is multiplied by this after every event that passes and divided after one that fails. Default 3.
    pub factor: f64,
    /// A γ that the guard does not control. Unset by default.
    pub constant: Option<f64>,
    /// Unit of the scales: `"world"` or `"extent"`. Default `"world"`.
    pub unit: ScaleUnit,
}

impl Default for ScaleDecaySection {
    fn default() -> Self {
        Self { start: 1e-4, factor: 3.0, constant: None, unit: ScaleUnit::World }
    }
}

/// Learning rates of Adam; the means' falls log-linearly over the run, as in training.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PruneOptimSection {
    /// Rate of the means at the first step, in units of the scene extent. Default 1.6e-5.
    pub means_lr: f32,
    /// Rate of the means at the last step. Default 1.6e-6.
    pub means_lr_end: f32,
    /// Rate of the log scales. Default 5e-3.
    pub log_scales_lr: f32,
    /// Rate of the quaternions. Default 1e-3.
    pub quats_lr: f32,
    /// Rate of the opacity logits. Default 5e-2.
    pub opacity_lr: f32,
    /// Rate of the constant SH coefficient. Default 2.5e-3.
    pub sh_dc_lr: f32,
    /// The other SH coefficients learn this many times slower. Default 20.
    pub sh_rest_divisor: f32,
}

impl Default for PruneOptimSection {
    fn default() -> Self {
        let OptimSection { log_scales_lr, quats_lr, opacity_lr, sh_dc_lr, sh_rest_divisor, .. } =
            OptimSection::default();
        Self { means_lr: 1.6e-5, means_lr_end: 1.6e-6, log_scales_lr, quats_lr, opacity_lr, sh_dc_lr, sh_rest_divisor }
    }
}

/// The schedule of a run, scaled.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plan {
    /// Steps before the reference is measured.
    pub reference: u32,
    /// Steps with pruning, N_prune.
    pub prune: u32,
    /// Steps of adaptation, N_adapt.
    pub adapt: u32,
    /// Steps between two events, E.
    pub event_every: u32,
    /// Opacities are lowered to this after a removal; 1 = they are not.
    pub opacity_clamp: f32,
}

/// Events closer than this leave opacities too little time to recover from the published clamp.
const CLOSE_EVENTS: u32 = 250;
/// Scaled events are no closer than this, where the run is long enough.
const MIN_EVENT_EVERY: u32 = 100;

impl Plan {
    /// Whether an event follows step `step`, counted from 1: it ≡ 1 mod E.
    pub fn is_event(&self, step: u32) -> bool {
        step <= self.prune && step % self.event_every == 1 % self.event_every
    }

    /// Events of the run.
    pub fn num_events(&self) -> u32 {
        self.prune.div_ceil(self.event_every)
    }

    /// Steps after the reference, N.
    pub fn num_steps(&self) -> u32 {
        self.prune + self.adapt
    }
}

impl PruneConfig {
    /// The schedule: numbers of steps times the budget.
    pub fn plan(&self) -> Plan {
        let section = &self.prune;
        let scaled = |steps: u32| (f64::from(steps) * section.budget).round() as u32;
        let prune = scaled(section.iterations).max(1);
        let floor = MIN_EVENT_EVERY.min(section.event_every);
        let event_every = scaled(section.event_every).max(floor).min((prune / 6).max(1));
        let default_clamp = if event_every < CLOSE_EVENTS { 0.5 } else { 0.1 };
        Plan {
            reference: scaled(self.reference.iterations),
            prune,
            adapt: scaled(section.adapt_iterations),
            event_every,
            opacity_clamp: section.opacity_clamp.unwrap_or(default_clamp),
        }
    }

    /// The settings under which `num_steps` of these steps are trained, for a model of SH degree `sh_degree`.
    pub(super) fn training(&self, num_steps: u32, sh_degree: u32) -> Config {
        let mut config = Config {
            data: self.data.clone(),
            loss: self.loss.clone(),
            render: self.render.clone(),
            densify: DensifySection { strategy: StrategyKind::None, ..DensifySection::default() },
            ..Config::default()
        };
        config.train.steps = num_steps.max(1);
        config.train.seed = self.prune.seed;
        config.train.eval_every = 0;
        config.model.sh_degree = sh_degree;
        config.model.antialiased = self.model.antialiased;
        config.optim = OptimSection {
            means_lr: self.optim.means_lr,
            means_lr_end: self.optim.means_lr_end,
            log_scales_lr: self.optim.log_scales_lr,
            quats_lr: self.optim.quats_lr,
            opacity_lr: self.optim.opacity_lr,
            sh_dc_lr: self.optim.sh_dc_lr,
            sh_rest_divisor: self.optim.sh_rest_divisor,
            ..OptimSection::default()
        };
        config
    }

    /// Checks every range.
    ///
    /// # Errors
    /// [`Error::Parameter`] naming the first key that is out of its range.
    pub fn validate(&self) -> Result<()> {
        let check = |ok: bool, key: &str, found: &dyn std::fmt::Display, expected: &str| {
            if ok { Ok(()) } else { Err(Error::parameter(key, format!("found {found}, expected {expected}"))) }
        };
        let (p, budget, share) = (&self.prune, self.prune.budget, self.prune.share);
        check(budget > 0.0 && budget <= 100.0, "prune.budget", &budget, "a number above 0 and at most 100")?;
        let range = "1 to 10000000";
        check((1..=10_000_000).contains(&p.iterations), "prune.iterations", &p.iterations, range)?;
        check(p.adapt_iterations <= 10_000_000, "prune.adapt_iterations", &p.adapt_iterations, "at most 10000000")?;
        let reference = self.reference.iterations;
        check(reference <= 10_000_000, "reference.iterations", &reference, "at most 10000000")?;
        check(p.event_every >= 1, "prune.event_every", &p.event_every, "at least 1")?;
        check((0.0..1.0).contains(&share), "prune.share", &share, "a number in [0, 1)")?;
        let min_opacity = p.min_opacity;
        check((0.0..1.0).contains(&min_opacity), "prune.min_opacity", &min_opacity, "a number in [0, 1)")?;
        check(p.min_points >= 1, "prune.min_points", &p.min_points, "at least 1")?;
        let (clamp, expected) =
            (self.plan().opacity_clamp, format!("above prune.min_opacity = {min_opacity}, at most 1"));
        check(clamp > min_opacity && clamp <= 1.0, "prune.opacity_clamp", &clamp, &expected)?;
        check((0.0..1.0).contains(&self.guard.loss), "guard.loss", &self.guard.loss, "a number in [0, 1)")?;
        let decay = &self.scale_decay;
        let is_weight = |v: f64| v >= 0.0 && v.is_finite();
        check(is_weight(decay.start), "scale_decay.start", &decay.start, "a number of at least 0")?;
        let factor = decay.factor;
        check(factor >= 1.0 && factor.is_finite(), "scale_decay.factor", &factor, "a number of at least 1")?;
        if let Some(constant) = decay.constant {
            check(is_weight(constant), "scale_decay.constant", &constant, "a number of at least 0")?;
        }
        self.training(1, 0).validate()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_have_the_schedule_of_the_specification() {
        let plan = |budget: f64| {
            let prune = PruneSection { budget, ..PruneSection::default() };
            let reference = ReferenceSection { iterations: 5000 };
            PruneConfig { prune, reference, ..PruneConfig::default() }.plan()
        };
        let paper = plan(1.0);
        assert_eq!((paper.reference, paper.prune, paper.adapt, paper.event_every), (5000, 45_000, 5000, 1000));
        assert_eq!((paper.num_events(), paper.opacity_clamp), (45, 0.1));
        let quick = plan(0.04);
        assert_eq!((quick.reference, quick.prune, quick.adapt, quick.event_every), (200, 1800, 200, 100));
        assert_eq!((quick.num_events(), quick.opacity_clamp), (18, 0.5));
        assert_eq!((1..=quick.prune).filter(|&s| quick.is_event(s)).count(), 18);
        assert!(quick.is_event(1) && quick.is_event(101) && !quick.is_event(100));
        let short = plan(0.01);
        assert_eq!((short.prune, short.adapt, short.event_every), (450, 50, 75));
        let tiny = plan(1e-5);
        assert_eq!((tiny.prune, tiny.adapt, tiny.event_every), (1, 0, 1));
        assert!(tiny.is_event(1));
    }

    #[test]
    fn values_out_of_range_are_named() {
        PruneConfig::default().validate().expect("the defaults are valid");
        type Change = fn(&mut PruneConfig);
        let wrong: [(&str, Change); 10] = [
            ("prune.budget", |c| c.prune.budget = f64::NAN),
            ("prune.event_every", |c| c.prune.event_every = 0),
            ("prune.share", |c| c.prune.share = 1.0),
            ("prune.opacity_clamp", |c| c.prune.opacity_clamp = Some(0.005)),
            ("prune.opacity_clamp", |c| (c.prune.budget, c.prune.min_opacity) = (1.0, 0.2)),
            ("prune.min_points", |c| c.prune.min_points = 0),
            ("guard.loss", |c| c.guard.loss = 1.0),
            ("scale_decay.start", |c| c.scale_decay.start = -1.0),
            ("optim.means_lr", |c| c.optim.means_lr = 0.0),
            ("render.near", |c| c.render.near = 0.0),
        ];
        for (key, change) in wrong {
            let mut config = PruneConfig::default();
            change(&mut config);
            let message = config.validate().expect_err(key).to_string();
            assert!(message.starts_with(&format!("{key}: found ")), "{key}: {message}");
        }
    }
}
