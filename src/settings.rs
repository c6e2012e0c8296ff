//! Settings in layers: defaults, a preset or TOML file, then `--set key=value`, the later one winning.
//!
//! A key that does not exist is refused with the nearest one that does, a value of the wrong type with what was
//! expected; for files the place is shown. The tree of known keys is the serialised default of what a command is set by
//! ([`Schema`]), so nothing here names a key and nothing can fall behind.

mod keys;
mod schema;

pub use keys::describe_keys;
pub use schema::{PRUNE, Schema, TRAIN};

use crate::diagnostics::{Failure, Result};
use crate::terms::{PruneTerms, TermSection};
use gazesplat_train::Config;
use gazesplat_train::prune::PruneConfig;
use keys::{Problem, check_table, find, unknown_key};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value as Json;
use std::path::Path;
use toml::Table;
use toml::de::DeTable;

/// The values given so far, without the defaults.
#[derive(Debug, Clone)]
pub struct Settings {
    table: Table,
    schema: &'static Schema,
}

impl Default for Settings {
    fn default() -> Self {
        Self::new()
    }
}

impl Settings {
    /// Settings of training, no value given: all defaults.
    pub fn new() -> Self {
        Self::of(&TRAIN)
    }

    /// Settings of `schema`, no value given: all defaults.
    pub fn of(schema: &'static Schema) -> Self {
        Self { table: Table::new(), schema }
    }

    /// Settings of `schema` with the values given so far in `sections`, which both have.
    pub fn carried_to(&self, schema: &'static Schema, sections: &[&str]) -> Self {
        let carried = self.table.iter().filter(|(key, _)| sections.contains(&key.as_str()));
        Self { table: carried.map(|(key, value)| (key.clone(), value.clone())).collect(), schema }
    }

    /// Layers a preset (`quick`) or a TOML file over the values so far; an existing file wins over a preset of that name.
    ///
    /// # Errors
    /// When there is neither such a file nor such a preset, when it is no TOML, or holds an unknown key or a wrong value.
    pub fn with_config(self, name_or_path: &Path) -> Result<Self> {
        let preset = self.schema.presets.iter().find(|(name, _)| Path::new(name) == name_or_path);
        match preset {
            Some((name, text)) if !name_or_path.exists() => self.with_text(Path::new(&format!("preset {name}")), text),
            _ => self.with_file(name_or_path),
        }
    }

    /// Layers a TOML file over the values so far.
    ///
    /// # Errors
    /// When the file cannot be read, is no TOML, or holds an unknown key or a wrong value.
    pub fn with_file(self, path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).map_err(|e| {
            Failure::io("read", path, e).hint(format!(
                "give a TOML file or one of the presets {}",
                self.schema.presets.iter().map(|(name, _)| format!("`{name}`")).collect::<Vec<_>>().join(", ")
            ))
        })?;
        self.with_text(path, &text)
    }

    fn with_text(mut self, path: &Path, text: &str) -> Result<Self> {
        let at = |problem: Problem| {
            let failure = Failure::new(format!("`{}`: {}", path.display(), problem.message)).hint_if(problem.hint);
            match problem.span {
                Some(span) => failure.excerpt(path, text, span, problem.label),
                None => failure,
            }
        };
        let document = DeTable::parse(text).map_err(|e| at(Problem::from_toml(&e)))?;
        check_table(document.get_ref(), &self.schema.known_keys(), self.schema, "").map_err(&at)?;
        // A second reading by the types themselves: names of variants, ranges of integers.
        let layer: Table = toml::from_str(text).map_err(|e| at(Problem::from_toml(&e)))?;
        self.schema.check(&layer, Some(text)).map_err(|e| at(Problem::from_toml(&e).of_value("", &Json::Null)))?;
        merge(&mut self.table, layer);
        Ok(self)
    }

    /// Layers one `key=value` over the values so far. The value is TOML; text needs no quotes and a list no brackets.
    ///
    /// # Errors
    /// When the key is unknown or the value does not fit it.
    pub fn with_override(self, assignment: &str) -> Result<Self> {
        let refuse =
            |problem: Problem| Failure::new(format!("`--set {assignment}`: {}", problem.message)).hint_if(problem.hint);
        let Some((key, raw)) = assignment.split_once('=') else {
            return Err(refuse(
                Problem::new("expected `key=value`").hint(format!("for example `--set {}`", self.schema.example)),
            ));
        };
        let (key, raw) = (key.trim(), raw.trim());
        let keys = self.schema.known_keys();
        let is_key = !key.is_empty() && key.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.'));
        if !is_key || find(&keys, key).is_none_or(Json::is_object) {
            return Err(refuse(unknown_key(key, &keys, self.schema)));
        }
        let quoted = toml::Value::String(raw.to_owned()).to_string();
        let readings = [raw.to_owned(), quoted, format!("[{raw}]")];
        let mut first_problem = None;
        for reading in readings {
            match self.with_assignment(key, &reading, &keys) {
                Ok(settings) => return Ok(settings),
                // Bare text is no TOML; the reading in quotes has the better reason.
                Err(_) if DeTable::parse(&format!("v = {reading}")).is_err() => {}
                Err(problem) => {
                    first_problem.get_or_insert(problem);
                }
            }
        }
        Err(refuse(first_problem.unwrap_or_else(|| Problem::new(format!("`{raw}` is not a value")))))
    }

    fn with_assignment(&self, key: &str, value: &str, keys: &Json) -> std::result::Result<Self, Problem> {
        let text = format!("{key} = {value}\n");
        let document = DeTable::parse(&text).map_err(|e| Problem::from_toml(&e))?;
        check_table(document.get_ref(), keys, self.schema, "")?;
        let layer: Table = toml::from_str(&text).map_err(|e| Problem::from_toml(&e))?;
        self.schema.check(&layer, None).map_err(|e| Problem::from_toml(&e).of_value(key, keys))?;
        let mut next = self.clone();
        merge(&mut next.table, layer);
        Ok(next)
    }

    /// Layers several `key=value`, in order.
    ///
    /// # Errors
    /// As [`Settings::with_override`], for the first that is wrong.
    pub fn with_overrides(self, assignments: &[String]) -> Result<Self> {
        assignments.iter().try_fold(self, |settings, a| settings.with_override(a))
    }

    /// The defaults with the given values over them.
    ///
    /// # Errors
    /// When the values contradict each other or are out of their range.
    pub fn resolve(&self) -> Result<Config> {
        let (config, _): (Config, TermSection) = self.read()?;
        config.validate()?;
        Ok(config)
    }

    /// The defaults of the terms that this program adds, with the given values over them.
    ///
    /// # Errors
    /// When a value is out of its range.
    pub fn resolve_terms(&self) -> Result<TermSection> {
        let (_, terms): (Config, TermSection) = self.read()?;
        terms.loss.hvsq.validate()?;
        Ok(terms)
    }

    /// As [`Settings::resolve`] and [`Settings::resolve_terms`], for pruning.
    ///
    /// # Errors
    /// When the values contradict each other or are out of their range.
    pub fn resolve_pruning(&self) -> Result<(PruneConfig, PruneTerms)> {
        let (config, terms): (PruneConfig, PruneTerms) = self.read()?;
        config.validate()?;
        terms.validate()?;
        Ok((config, terms))
    }

    fn read<C: DeserializeOwned, T: DeserializeOwned + Default + Serialize>(&self) -> Result<(C, T)> {
        schema::read(self.table.clone()).map_err(|e| Failure::new(e.message().to_owned()))
    }
}

/// The resolved settings as TOML, every key present that has a value.
pub fn to_toml(config: &impl Serialize) -> String {
    toml::to_string_pretty(config).expect("settings are plain tables of numbers and text")
}

/// The resolved settings of a run with its terms as TOML.
pub fn run_to_toml(config: &impl Serialize, terms: &impl Serialize) -> String {
    format!("{}\n{}", to_toml(config), to_toml(terms))
}

fn merge(base: &mut Table, layer: Table) {
    for (key, value) in layer {
        match (base.get_mut(&key), value) {
            (Some(toml::Value::Table(old)), toml::Value::Table(new)) => merge(old, new),
            (_, value) => {
                base.insert(key, value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(text: &str) -> String {
        format!("{:?}", Settings::new().with_text(Path::new("my.toml"), text).expect_err("must be refused"))
    }

    fn set_refused(assignment: &str) -> String {
        format!("{:?}", Settings::new().with_override(assignment).expect_err("must be refused"))
    }

    #[test]
    fn later_layers_win() {
        let settings = Settings::new()
            .with_text(Path::new("a.toml"), "[train]\nsteps = 10\nseed = 3\n")
            .and_then(|s| s.with_override("train.steps=20"))
            .expect("valid");
        let config = settings.resolve().expect("valid");
        assert_eq!((config.train.steps, config.train.seed), (20, 3));
    }

    #[test]
    fn misspelt_key_is_refused_with_place_and_nearest() {
        let report = refused("[train]\nsteps = 10\nsede = 3\n");
        assert!(report.contains("`train.sede` is not a setting"), "{report}");
        assert!(report.contains("my.toml:3:1"), "{report}");
        assert!(report.ends_with("hint: did you mean `train.seed`?"), "{report}");
    }

    #[test]
    fn key_in_the_wrong_section_is_pointed_home() {
        assert!(set_refused("cap=5").contains("did you mean `densify.cap`?"));
        assert!(set_refused("train.cap=5").contains("did you mean `densify.cap`?"));
        assert!(set_refused("train=5").contains("name one of its keys"));
    }

    #[test]
    fn wrong_type_names_key_and_expectation() {
        let report = refused("[train]\nsteps = \"many\"\n");
        assert!(report.contains("`train.steps` expects a whole number, 0 or more"), "{report}");
        assert!(report.contains("found the text `\"many\"`") && report.contains("my.toml:2:9"), "{report}");
        assert!(set_refused("train.steps=-3").contains("expects a whole number, 0 or more"));
        assert!(set_refused("train.steps=1.5").contains("found the number `1.5`"));
        assert!(set_refused("train.steps=many").contains("found the text `\"many\"`"));
        assert!(set_refused("train.steps").contains("expected `key=value`"));
    }

    #[test]
    fn text_needs_no_quotes() {
        let settings = Settings::new().with_override("data.images=images_4").expect("valid");
        assert_eq!(settings.resolve().expect("valid").data.images.as_deref(), Some("images_4"));
    }

    #[test]
    fn background_takes_a_name_or_a_colour() {
        for value in ["white", "1,0.5,0", "[1, 0.5, 0]"] {
            Settings::new().with_override(&format!("data.background={value}")).expect(value);
        }
        let report = set_refused("data.background=pink");
        assert!(report.contains("`data.background`") && report.contains("the default is `\"black\"`"), "{report}");
    }

    #[test]
    fn presets_are_valid_and_differ_from_the_defaults() {
        let defaults = to_toml(&Config::default());
        for (name, text) in TRAIN.presets {
            let config = Settings::new().with_text(Path::new(name), text).and_then(|s| s.resolve()).expect(name);
            assert_ne!(to_toml(&config), defaults, "{name} changes nothing");
        }
    }

    #[test]
    fn presets_of_pruning_are_those_of_the_specification() {
        let resolved = |preset: &str| {
            let settings = Settings::of(&PRUNE).with_config(Path::new(preset)).expect(preset);
            settings.resolve_pruning().expect(preset).0
        };
        let (quick, paper) = (resolved("quick"), resolved("paper"));
        assert_eq!(quick, PruneConfig::default());
        let plan = paper.plan();
        assert_eq!((plan.reference, plan.prune, plan.adapt, plan.event_every), (5000, 45_000, 5000, 1000));
        assert_eq!((plan.opacity_clamp, paper.prune.final_clamp), (0.1, true));
        assert_eq!(paper.guard.views, gazesplat_train::prune::GuardViews::Test);
        let misspelt = Settings::of(&PRUNE).with_override("prune.bugdet=1").expect_err("unknown");
        assert!(format!("{misspelt:?}").contains("did you mean `prune.budget`?"), "{misspelt:?}");
        let of_training = Settings::of(&PRUNE).with_override("densify.cap=1").expect_err("unknown");
        assert!(format!("{of_training:?}").contains("`densify.cap` is not a setting"), "{of_training:?}");
    }

    #[test]
    fn sections_that_two_commands_share_are_carried_over() {
        let run = Settings::new().with_overrides(&["data.max_side=320".to_owned(), "train.steps=7".to_owned()]);
        let carried = run.expect("valid").carried_to(&PRUNE, &["data", "render"]);
        let (config, _) = carried.resolve_pruning().expect("valid");
        assert_eq!(config.data.max_side, 320);
    }

    #[test]
    fn terms_of_the_program_are_settings_like_any_other() {
        let settings = Settings::new()
            .with_text(Path::new("a.toml"), "[loss]\nssim_weight = 0.1\n[loss.hvsq]\nweight = 50\n")
            .and_then(|s| s.with_override("loss.hvsq.pooling_px=7"))
            .and_then(|s| s.with_override("loss.hvsq.distance=mse"))
            .expect("valid");
        let (config, terms) = (settings.resolve().expect("valid"), settings.resolve_terms().expect("valid"));
        assert_eq!(config.loss.ssim_weight, 0.1);
        assert_eq!((terms.loss.hvsq.weight, terms.loss.hvsq.pooling_px), (50.0, 7.0));
        let text = run_to_toml(&config, &terms);
        let again = Settings::new().with_text(Path::new("s.toml"), &text).expect("reads back");
        assert_eq!(run_to_toml(&again.resolve().expect("valid"), &again.resolve_terms().expect("valid")), text);

        assert!(set_refused("loss.hvsq.wieght=3").contains("did you mean `loss.hvsq.weight`?"));
        assert!(set_refused("loss.hvsq.distance=l3").contains("`loss.hvsq.distance`"));
        assert!(set_refused("loss.hvsq=3").contains("name one of its keys"));
        assert!(refused("[loss.hvsq]\npooling_px = true\n").contains("my.toml:2:14"));
        assert!(refused("[loss.hvsq]\ndistance = \"l3\"\n").contains("l3"));
        let settings = Settings::new().with_override("loss.hvsq.pooling_px=0.5").expect("a number");
        assert!(settings.resolve_terms().is_err());
    }

    #[test]
    fn resolved_settings_read_back_unchanged() {
        let config = Settings::new().with_override("train.seed=7").and_then(|s| s.resolve()).expect("valid");
        let again = Settings::new().with_text(Path::new("s.toml"), &to_toml(&config)).and_then(|s| s.resolve());
        assert_eq!(to_toml(&again.expect("valid")), to_toml(&config));
    }
}
