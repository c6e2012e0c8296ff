//! 3D Gaussian splatting as Markov chain Monte Carlo (Kheradmand 2024): dead Gaussians are moved onto live ones, the
//! number grows to a cap, positions carry noise, opacities and scales are kept small.
//!
//! Sources are drawn with probability proportional to opacity. Deviations, both ours: in runs that are too short for
//! 5 % growth to reach the cap by mid-run, growth is raised to what does, and refinements come more often (the paper
//! knows one length only); and Gaussians with a non-finite parameter, or of absurd size or distance, count as dead.

use super::relocation::{MAX_PARTS, RelocationTable};
use super::{StepContext, Strategy, noise::add_noise};
use crate::config::DensifySection;
use crate::event::DensifyReport;
use crate::losses::LossTerm;
use crate::optim::{Columns, Group, Optimized};
use crate::rng::{Stream, draw, uniform_f64};
use crate::simd::{dispatch_simd, exp, sum_lanes};
use rayon::prelude::*;

/// A standard deviation beyond this many scene extents is broken, not large: skies need less than ten.
const MAX_SCALE_EXTENTS: f32 = 100.0;
/// A centre beyond this many scene extents from the origin of the scene is lost: no view can resolve its parallax.
const MAX_DISTANCE_EXTENTS: f32 = 1e4;
/// Shortest interval of refinements in steps: new Gaussians need a few views before opacity says which of them live.
const MIN_INTERVAL: u32 = 5;

/// When refinements happen and how much they add.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plan {
    /// First refinement, counted from step 1.
    pub start: u32,
    /// No refinement after this step.
    pub stop: u32,
    /// Steps between two.
    pub every: u32,
    /// Growth factor of each, above 1.
    pub growth: f32,
}

impl Plan {
    /// The plan of a run of `num_steps` that begins with `num_initial` Gaussians.
    pub fn new(section: &DensifySection, num_steps: u32, num_initial: usize) -> Self {
        let every = (num_steps / 100).clamp(MIN_INTERVAL.min(section.every), section.every);
        let start = section.start.min(num_steps / 20).max(1);
        let stop = (f64::from(num_steps) * f64::from(section.stop)).round() as u32;
        let num_until_middle = (num_steps / 2).min(stop).saturating_sub(start) / every;
        let needed = section.cap as f64 / num_initial.max(1) as f64;
        let raised = if num_until_middle > 0 { needed.powf(1.0 / f64::from(num_until_middle)) } else { 1.0 };
        Self { start, stop, every, growth: (1.0 + section.growth).max(raised as f32) }
    }

    fn is_due(&self, step: u32) -> bool {
        step >= self.start && step <= self.stop && (step - self.start).is_multiple_of(self.every)
    }
}

/// The strategy and its constants.
#[derive(Debug, Clone)]
pub struct Mcmc {
    section: DensifySection,
    plan: Plan,
    extent: f32,
    center: [f32; 3],
    table: RelocationTable,
}

impl Mcmc {
    /// A strategy for a run of `num_steps` from `num_initial` Gaussians in a scene of radius `extent` around `center`.
    pub fn new(section: &DensifySection, num_steps: u32, num_initial: usize, center: [f32; 3], extent: f32) -> Self {
        let plan = Plan::new(section, num_steps, num_initial);
        Self { section: section.clone(), plan, extent, center, table: RelocationTable::default() }
    }

    /// When refinements happen and how much they add.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Weights of the rows as sources (their opacities, 0 for dead ones), the dead rows, and how many of those are broken.
    fn survey(&self, params: &Columns) -> (Vec<f64>, Vec<usize>, usize) {
        let max_log_scale = (MAX_SCALE_EXTENTS * self.extent).ln();
        let max_distance = MAX_DISTANCE_EXTENTS * self.extent;
        let states: Vec<(f64, bool)> = (0..params.num_rows())
            .into_par_iter()
            .map(|i| {
                let finite = Group::ALL.into_iter().all(|g| params.row(g, i).iter().all(|v| v.is_finite()));
                let large = params.row(Group::LogScales, i).iter().any(|s| *s > max_log_scale);
                let far =
                    params.row(Group::Means, i).iter().zip(self.center).any(|(x, c)| (x - c).abs() > max_distance);
                if !finite || large || far {
                    return (0.0, true);
                }
                let opacity = sigmoid(f64::from(params.of(Group::OpacityLogits)[i]));
                (if opacity <= f64::from(self.section.min_opacity) { 0.0 } else { opacity }, false)
            })
            .collect();
        let dead = (0..states.len()).filter(|&i| states[i].0 == 0.0).collect();
        let num_broken = states.iter().filter(|s| s.1).count();
        (states.into_iter().map(|s| s.0).collect(), dead, num_broken)
    }

    /// `count` rows drawn by weight, and the division of the drawn ones done: each keeps its place with the opacity and
    /// scale of one of its parts. Empty when no row has a weight.
    fn draw_sources(
        &self,
        state: &mut Optimized,
        weights: &[f64],
        count: usize,
        context: &StepContext,
        first_index: usize,
    ) -> Vec<usize> {
        let mut cumulative = Vec::with_capacity(weights.len());
        let mut total = 0.0;
        for weight in weights {
            total += weight;
            cumulative.push(total);
        }
        if total <= 0.0 {
            return Vec::new();
        }
        let last = weights.iter().rposition(|w| *w > 0.0).expect("the total is positive");
        let sources: Vec<usize> = (0..count)
            .into_par_iter()
            .map(|i| {
                let words = draw(context.seed, Stream::Sampling, context.step, (first_index + i) as u64);
                let u = uniform_f64(words[0], words[1]) * total;
                cumulative.partition_point(|c| *c <= u).min(last)
            })
            .collect();
        let mut num_drawn = vec![0usize; weights.len()];
        for &source in &sources {
            num_drawn[source] += 1;
        }
        for (row, &drawn) in num_drawn.iter().enumerate().filter(|(_, drawn)| **drawn > 0) {
            let (opacity, factor) = self.table.split(weights[row], (drawn + 1).min(MAX_PARTS));
            // Never below the threshold of death: a part has to get the chance to grow.
            let opacity = opacity.clamp(f64::from(self.section.min_opacity), 1.0 - 1e-6);
            state.params.of_mut(Group::OpacityLogits)[row] = (opacity / (1.0 - opacity)).ln() as f32;
            let shift = factor.ln() as f32;
            state.params.row_mut(Group::LogScales, row).iter_mut().for_each(|s| *s += shift);
            state.zero_moments(row);
        }
        sources
    }

    fn refine(&self, state: &mut Optimized, context: &StepContext) -> DensifyReport {
        let (weights, dead, num_broken) = self.survey(&state.params);
        let sources = self.draw_sources(state, &weights, dead.len(), context, 0);
        for (&target, &source) in dead.iter().zip(&sources) {
            state.replace(target, source);
        }
        let grown = (state.num_rows() as f64 * f64::from(self.plan.growth)).round() as usize;
        let num_added = grown.min(self.section.cap).saturating_sub(state.num_rows());
        let mut num_appended = 0;
        if num_added > 0 {
            let (weights, ..) = self.survey(&state.params);
            let sources = self.draw_sources(state, &weights, num_added, context, dead.len());
            state.append_copies(&sources);
            num_appended = sources.len();
        }
        let moved = sources.len().min(dead.len());
        DensifyReport {
            num_relocated: moved.saturating_sub(num_broken),
            num_relocated_broken: num_broken.min(moved),
            num_added: num_appended,
            num_gaussians: state.num_rows(),
        }
    }
}

impl Strategy for Mcmc {
    fn regularize(&mut self, params: &Columns, grads: &mut Columns) -> Vec<LossTerm> {
        let opacity_weight = self.section.opacity_regularizer;
        let scale_weight = self.section.scale_regularizer;
        let mut terms = Vec::with_capacity(2);
        if opacity_weight > 0.0 {
            let (values, grads) = (params.of(Group::OpacityLogits), grads.of_mut(Group::OpacityLogits));
            let value = regularize(values, grads, opacity_weight, opacity_chunk);
            terms.push(LossTerm { name: "opacity_regularizer", value });
        }
        if scale_weight > 0.0 {
            let (values, grads) = (params.of(Group::LogScales), grads.of_mut(Group::LogScales));
            let value = regularize(values, grads, scale_weight, scale_chunk);
            terms.push(LossTerm { name: "scale_regularizer", value });
        }
        terms
    }

    fn after_update(&mut self, state: &mut Optimized, context: &StepContext) -> Option<DensifyReport> {
        let report = self.plan.is_due(context.step).then(|| self.refine(state, context));
        add_noise(&mut state.params, context.means_lr * self.section.noise, context.seed, context.step);
        report
    }
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// Values per job of a regulariser.
const CHUNK: usize = 8192;

/// Mean of f(value), with `weight` times its gradient added to `grads`; `chunk` adds weight · f' and returns Σ f.
fn regularize(values: &[f32], grads: &mut [f32], weight: f32, chunk: fn(&[f32], &mut [f32], f32) -> f64) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let factor = weight / values.len() as f32;
    let sums: Vec<f64> = grads
        .par_chunks_mut(CHUNK)
        .zip(values.par_chunks(CHUNK))
        .map(|(grads, values)| chunk(values, grads, factor))
        .collect();
    (sums.iter().sum::<f64>() / values.len() as f64) as f32
}

dispatch_simd! {
    fn opacity_chunk(values: &[f32], grads: &mut [f32], factor: f32) -> f64 = opacity_kernel;
}

dispatch_simd! {
    fn scale_chunk(values: &[f32], grads: &mut [f32], factor: f32) -> f64 = scale_kernel;
}

/// f = σ(logit).
#[inline(always)]
fn opacity_kernel<const FMA: bool>(values: &[f32], grads: &mut [f32], factor: f32) -> f64 {
    let mut buffer = [0.0f32; 256];
    let mut sum = 0.0;
    for (values, grads) in values.chunks(256).zip(grads.chunks_mut(256)) {
        let opacities = &mut buffer[..values.len()];
        for ((o, v), g) in opacities.iter_mut().zip(values).zip(grads) {
            *o = 1.0 / (1.0 + exp::<FMA>(-v));
            *g += factor * *o * (1.0 - *o);
        }
        sum += sum_lanes(opacities);
    }
    sum
}

/// f = exp(log scale).
#[inline(always)]
fn scale_kernel<const FMA: bool>(values: &[f32], grads: &mut [f32], factor: f32) -> f64 {
    let mut buffer = [0.0f32; 256];
    let mut sum = 0.0;
    for (values, grads) in values.chunks(256).zip(grads.chunks_mut(256)) {
        let scales = &mut buffer[..values.len()];
        for ((s, v), g) in scales.iter_mut().zip(values).zip(grads) {
            *s = exp::<FMA>(*v);
            *g += factor * *s;
        }
        sum += sum_lanes(scales);
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optim::{Adam, AdamSettings};

    fn state(opacities: &[f32]) -> Optimized {
        let n = opacities.len();
        let logits = opacities.iter().map(|o| (o / (1.0 - o)).ln()).collect();
        let means = (0..3 * n).map(|i| i as f32).collect();
        let data = [means, [1.0, 0.0, 0.0, 0.0].repeat(n), vec![-2.0; 3 * n], logits, vec![0.1; 3 * n]];
        let params = Columns { data, widths: [3, 4, 3, 1, 3] };
        let adam = Adam::new(&params, AdamSettings::default());
        Optimized { params, adam }
    }

    fn quiet(cap: usize) -> DensifySection {
        DensifySection { cap, noise: 0.0, ..DensifySection::default() }
    }

    const CONTEXT: StepContext = StepContext { step: 500, seed: 3, means_lr: 1e-4 };

    #[test]
    fn relocation_keeps_the_composited_opacity_at_every_place() {
        let mut opacities = vec![0.6f32; 50];
        opacities.extend([0.001; 30]);
        let mut state = state(&opacities);
        let mcmc = Mcmc::new(&quiet(80), 30_000, 80, [0.0; 3], 10.0);
        let report = mcmc.refine(&mut state, &CONTEXT);
        assert_eq!((report.num_relocated, report.num_added, report.num_gaussians), (30, 0, 80));
        for row in 0..50 {
            let place = state.params.row(Group::Means, row).to_vec();
            let transmittance: f64 = (0..80)
                .filter(|&i| state.params.row(Group::Means, i) == place)
                .map(|i| 1.0 - sigmoid(f64::from(state.params.of(Group::OpacityLogits)[i])))
                .product();
            assert!((1.0 - transmittance - 0.6).abs() < 1e-5, "{row}: {transmittance}");
        }
    }

    #[test]
    fn growth_ends_at_the_cap() {
        let mut state = state(&[0.5; 100]);
        let mcmc = Mcmc::new(&quiet(108), 30_000, 100, [0.0; 3], 10.0);
        assert_eq!(mcmc.refine(&mut state, &CONTEXT).num_added, 5);
        assert_eq!(mcmc.refine(&mut state, &CONTEXT).num_added, 3);
        assert_eq!(mcmc.refine(&mut state, &CONTEXT).num_added, 0);
        assert_eq!(state.adam.first.num_rows(), 108);
    }

    #[test]
    fn broken_gaussians_are_replaced_and_counted() {
        let mut state = state(&[0.5; 10]);
        state.params.row_mut(Group::Sh, 2)[1] = f32::NAN;
        state.params.row_mut(Group::LogScales, 4)[0] = 40.0;
        state.params.row_mut(Group::Means, 6)[2] = 1e7;
        let mcmc = Mcmc::new(&quiet(10), 30_000, 10, [0.0; 3], 10.0);
        let report = mcmc.refine(&mut state, &CONTEXT);
        assert_eq!((report.num_relocated, report.num_relocated_broken), (0, 3));
        assert!(state.params.data.iter().flatten().all(|v| v.is_finite()));
    }

    #[test]
    fn a_model_without_live_gaussians_is_left_alone() {
        let mut state = state(&[0.001; 10]);
        let before = state.clone();
        let mcmc = Mcmc::new(&quiet(20), 30_000, 10, [0.0; 3], 10.0);
        assert_eq!(mcmc.refine(&mut state, &CONTEXT).num_relocated, 0);
        assert_eq!(state, before);
    }

    #[test]
    fn short_runs_refine_more_often_and_reach_the_cap_by_mid_run() {
        let section = DensifySection { cap: 60_000, ..DensifySection::default() };
        let plan = Plan::new(&section, 30_000, 13_302);
        assert_eq!((plan.start, plan.stop, plan.every), (500, 25_000, 100));
        assert!((plan.growth - 1.05).abs() < 1e-6);
        for steps in [100, 300, 3000] {
            let plan = Plan::new(&section, steps, 13_302);
            let mut n = 13_302.0;
            for step in 1..=steps / 2 {
                if plan.is_due(step) {
                    n *= f64::from(plan.growth);
                }
            }
            assert!(n >= 59_000.0, "{steps}: {n} {plan:?}");
        }
        Plan::new(&section, 1, 13_302);
    }

    #[test]
    fn regulariser_gradients_equal_finite_differences() {
        let state = state(&[0.3, 0.7, 0.01, 0.5]);
        let mut mcmc = Mcmc::new(&quiet(4), 30_000, 4, [0.0; 3], 1.0);
        let value = |mcmc: &mut Mcmc, params: &Columns| {
            let mut grads = params.zeros_like();
            let terms = mcmc.regularize(params, &mut grads);
            (0.01 * f64::from(terms[0].value) + 0.01 * f64::from(terms[1].value), grads)
        };
        let (_, grads) = value(&mut mcmc, &state.params);
        for group in [Group::OpacityLogits, Group::LogScales] {
            let (mut up, mut down) = (state.params.clone(), state.params.clone());
            up.of_mut(group)[1] += 0.05;
            down.of_mut(group)[1] -= 0.05;
            let expected = (value(&mut mcmc, &up).0 - value(&mut mcmc, &down).0) / 0.1;
            assert!((f64::from(grads.of(group)[1]) - expected).abs() < 2e-6, "{group:?}");
        }
    }
}
