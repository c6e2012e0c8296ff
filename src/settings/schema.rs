//! What a command can be set by: its presets, and the tree of its keys with the types that read them.

use crate::terms::{PruneTerms, TermSection};
use gazesplat_train::Config;
use gazesplat_train::prune::PruneConfig;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value as Json;
use toml::Table;

/// The settings of one command: those of a library crate, with the terms that only this program knows grown into them.
#[derive(Debug)]
pub struct Schema {
    /// The command whose `--help` lists the keys.
    pub command: &'static str,
    /// An assignment, for hints.
    pub example: &'static str,
    /// Presets by name: each holds only what differs from the defaults.
    pub presets: &'static [(&'static str, &'static str)],
    tree: fn() -> Json,
    check: fn(&Table, Option<&str>) -> Result<(), toml::de::Error>,
}

/// Settings of `train`.
pub static TRAIN: Schema = Schema {
    command: "train",
    example: "train.steps=3000",
    presets: &[
        ("quick", include_str!("../../configs/train/quick.toml")),
        ("quality", include_str!("../../configs/train/quality.toml")),
        ("finetune", include_str!("../../configs/train/finetune.toml")),
    ],
    tree: tree::<Config, TermSection>,
    check: check::<Config, TermSection>,
};

/// Settings of `prune`.
pub static PRUNE: Schema = Schema {
    command: "prune",
    example: "prune.budget=0.1",
    presets: &[
        ("quick", include_str!("../../configs/prune/quick.toml")),
        ("paper", include_str!("../../configs/prune/paper.toml")),
    ],
    tree: tree::<PruneConfig, PruneTerms>,
    check: check::<PruneConfig, PruneTerms>,
};

impl Schema {
    /// The default settings as a tree of objects whose leaves are default values; `null` for "no default".
    pub(super) fn known_keys(&self) -> Json {
        (self.tree)()
    }

    /// Reads `table` by the types; `text` is what it was read from, whose places an error then has.
    pub(super) fn check(&self, table: &Table, text: Option<&str>) -> Result<(), toml::de::Error> {
        (self.check)(table, text)
    }
}

const PLAIN: &str = "settings are plain tables of numbers and text";

fn tree<C: Default + Serialize, T: Default + Serialize>() -> Json {
    let mut keys = serde_json::to_value(C::default()).expect(PLAIN);
    graft(&mut keys, serde_json::to_value(T::default()).expect(PLAIN));
    keys
}

/// Adds the branches of `more` to `tree`.
fn graft(tree: &mut Json, more: Json) {
    match (tree, more) {
        (Json::Object(tree), Json::Object(more)) => {
            for (key, child) in more {
                graft(tree.entry(key).or_insert(Json::Null), child);
            }
        }
        (tree, more) => *tree = more,
    }
}

fn check<C: DeserializeOwned, T: DeserializeOwned + Default + Serialize>(
    table: &Table,
    text: Option<&str>,
) -> Result<(), toml::de::Error> {
    match text {
        // By the text, so that the place of what is wrong can be shown.
        Some(text) if split::<T>(table.clone()).0 == *table => toml::from_str::<C>(text).map(drop),
        _ => read::<C, T>(table.clone()).map(drop),
    }
}

/// What of a table belongs to a library crate, and what to the terms of this program: the keys that `T` has in the sections
/// of the settings. A section of which nothing is left may be one that only `T` knows.
fn split<T: Default + Serialize>(mut table: Table) -> (Table, Table) {
    // JSON has a place for keys without a default.
    let known = serde_json::to_value(T::default()).expect(PLAIN);
    let mut terms = Table::new();
    for (section, known) in known.as_object().into_iter().flatten() {
        let (Some(toml::Value::Table(found)), Some(known)) = (table.get_mut(section), known.as_object()) else {
            continue;
        };
        let own: Table = known.keys().filter_map(|key| found.remove_entry(key)).collect();
        if found.is_empty() {
            table.remove(section);
        }
        if !own.is_empty() {
            terms.insert(section.clone(), own.into());
        }
    }
    (table, terms)
}

/// Both parts of a table by their types.
pub(super) fn read<C: DeserializeOwned, T: DeserializeOwned + Default + Serialize>(
    table: Table,
) -> Result<(C, T), toml::de::Error> {
    let (config, terms) = split::<T>(table);
    Ok((config.try_into()?, terms.try_into()?))
}
