//! Scene, views and images of a pruning, before anything is pruned.

use super::super::{Model, load_scene};
use crate::console::Console;
use crate::diagnostics::Result;
use crate::progress;
use crate::settings::Settings;
use crate::terms::PruneTerms;
use gazesplat_core::dataset::Holdout;
use gazesplat_core::io::images::ImageCache;
use gazesplat_core::{Dataset, View};
use gazesplat_render::Splats;
use gazesplat_render::device::Device;
use gazesplat_train::Config;
use gazesplat_train::metrics::Guard;
use gazesplat_train::prune::{Basis, GuardViews, Job, Provenance, PruneConfig, Pruner, Split, split};
use serde_json::Value as Json;
use std::path::Path;
use std::sync::Arc;

/// What a pruning works on.
pub(crate) struct Stage {
    /// Settings of the model's training, with what pruning shares of them: what a result is measured with.
    pub train_config: Config,
    pub dataset: Dataset,
    pub split: Split,
    pub images: Arc<ImageCache>,
    pub guard_images: Arc<ImageCache>,
    pub test_images: Arc<ImageCache>,
}

impl Stage {
    /// Reads the scene and its images; `recorded` are the settings of the run that `model` comes from.
    pub fn new(
        model: &Model,
        scene: &Path,
        config: &PruneConfig,
        recorded: &Settings,
        device: &Device,
        console: &Console,
    ) -> Result<Self> {
        let mut train_config = recorded.resolve()?;
        // With another split it is not known which of these views the model was trained on.
        let is_same_split =
            train_config.data.test_every == config.data.test_every && train_config.data.images == config.data.images;
        let trained = (model.run.is_some() && is_same_split).then_some(train_config.data.holdout);
        (train_config.data, train_config.render) = (config.data.clone(), config.render.clone());
        train_config.model.antialiased = config.model.antialiased;
        // What training kept out is split here, by the same rule.
        train_config.data.holdout = Holdout::None;
        let dataset = load_scene(scene, &train_config, console)?;
        // Who would judge tells whether these are renders of the model, which its own settings do not say.
        let judging = split(&dataset, config.guard.views, Provenance::OwnRenders)?.guard;
        let judges = Arc::new(ImageCache::new(judging, config.data.cache_bytes));
        // All photographs share one budget.
        let cache = |views: &[View]| Arc::new(judges.beside(views.to_vec()));
        let quality = {
            let splats = Splats::from_cloud(&model.cloud, device)?;
            gazesplat_train::evaluate(&splats, &judges, &train_config.render_options(), &mut |_, _| {})?
        };
        let provenance = match (Basis::for_reference(quality.psnr), trained) {
            (Basis::Floor, _) => Provenance::OwnRenders,
            (Basis::Share, Some(holdout)) => Provenance::Trained(holdout),
            (Basis::Share, None) => Provenance::Unknown,
        };
        let split = split(&dataset, config.guard.views, provenance)?;
        if let Some(note) = &split.note {
            console.warn(note);
        }
        if split.views == GuardViews::Holdout {
            train_config.data.holdout = Holdout::Every8;
        }
        let (images, guard_images) = (cache(&split.gradient), cache(&split.guard));
        for images in [&images, &guard_images] {
            let bar = progress::counting_bar(console, "reading images", images.len());
            images.preload(|done, _| bar.set_position(done as u64))?;
            bar.finish_and_clear();
        }
        let test_images = cache(&dataset.test);
        Ok(Self { train_config, dataset, split, images, guard_images, test_images })
    }

    /// The pruning of `model`.
    pub fn job<'a>(
        &'a self,
        model: &'a Model,
        config: &'a PruneConfig,
        terms: &'a Json,
        device: &'a Device,
    ) -> Job<'a> {
        Job {
            cloud: &model.cloud,
            dataset: &self.dataset,
            images: Arc::clone(&self.images),
            guard_images: Arc::clone(&self.guard_images),
            counted: self.split.counted.iter().map(|view| (view.name.clone(), view.camera)).collect(),
            config,
            more_settings: terms,
            device,
        }
    }
}

/// `pruner` with the terms of the loss and the bounds that crate `train` knows nothing of.
pub(crate) fn with_terms(
    pruner: Pruner,
    config: &PruneConfig,
    terms: &PruneTerms,
    stage: &Stage,
    device: &Device,
) -> Result<Pruner> {
    let (loss, bound) = (config.guard.loss, terms.guard.hvsq.clone());
    bound.add_to(Guard::default())?;
    bound.check_views(&stage.split.guard)?;
    let mut pruner = pruner.with_guard(Box::new(move |reference, basis| {
        bound.add_to(basis.guard(reference, loss)).expect("its settings have been checked")
    }));
    if let Some((loss, _)) = terms.loss.hvsq.make(&stage.split.gradient, device)? {
        pruner.add_loss(terms.loss.hvsq.weight, loss);
    }
    Ok(pruner)
}
