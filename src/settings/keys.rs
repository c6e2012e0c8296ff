//! The tree of known settings, and what is wrong with a key or value that does not fit it.
//!
//! The tree is that of a [`Schema`]: objects whose leaves are default values.

use super::schema::Schema;
use crate::diagnostics::nearest;
use serde_json::Value as Json;
use std::ops::Range;
use toml::de::{DeTable, DeValue};

/// Every key with its default, as `train.steps = 30000`: the list that `train --help` shows.
pub fn describe_keys(schema: &Schema) -> String {
    let mut lines = Vec::new();
    leaves(&schema.known_keys(), "", &mut |path, default| {
        lines.push(if default.is_null() { format!("  {path}") } else { format!("  {path} = {}", show(default)) });
    });
    lines.join("\n")
}

/// What is wrong with one value, before it is known where it came from.
#[derive(Debug)]
pub(super) struct Problem {
    pub(super) message: String,
    pub(super) hint: Option<String>,
    pub(super) span: Option<Range<usize>>,
    pub(super) label: String,
}

impl Problem {
    pub(super) fn new(message: impl Into<String>) -> Self {
        Self { message: message.into(), hint: None, span: None, label: "here".to_owned() }
    }

    pub(super) fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }

    fn at(mut self, span: Range<usize>, label: impl Into<String>) -> Self {
        (self.span, self.label) = (Some(span), label.into());
        self
    }

    /// The reason of serde in terms of settings: it knows neither the key nor its default.
    pub(super) fn of_value(mut self, key: &str, keys: &Json) -> Self {
        if self.message.contains("untagged enum") {
            self.message = "not one of the values it can have".to_owned();
        }
        if let Some(default) = find(keys, key) {
            self.message = format!("`{key}`: {}", self.message);
            self.hint = Some(format!("the default is `{}`", show(default)));
        }
        self
    }

    pub(super) fn from_toml(error: &toml::de::Error) -> Self {
        let mut lines = error.message().lines();
        let message = lines.next().unwrap_or("not valid TOML").to_owned();
        Self { message, hint: None, span: error.span(), label: lines.next().unwrap_or("here").to_owned() }
    }
}

pub(super) fn find<'a>(keys: &'a Json, path: &str) -> Option<&'a Json> {
    path.split('.').try_fold(keys, |node, part| node.as_object()?.get(part))
}

fn leaves<'a>(node: &'a Json, path: &str, visit: &mut impl FnMut(&str, &'a Json)) {
    match node {
        Json::Object(table) => {
            for (key, child) in table {
                leaves(child, &join(path, key), visit);
            }
        }
        leaf => visit(path, leaf),
    }
}

fn join(prefix: &str, key: &str) -> String {
    if prefix.is_empty() { key.to_owned() } else { format!("{prefix}.{key}") }
}

/// Walks a document beside the tree of known keys.
pub(super) fn check_table(table: &DeTable<'_>, keys: &Json, schema: &Schema, prefix: &str) -> Result<(), Problem> {
    for (key, value) in table.iter() {
        let path = join(prefix, key.get_ref());
        let Some(default) = find(keys, &path) else {
            return Err(unknown_key(&path, keys, schema).at(key.span(), "no such key"));
        };
        match (value.get_ref(), default) {
            (DeValue::Table(child), Json::Object(_)) => check_table(child, keys, schema, &path)?,
            (found, default) => {
                check_value(&path, found, default).map_err(|p| p.at(value.span(), "wrong kind of value"))?;
            }
        }
    }
    Ok(())
}

fn check_value(path: &str, found: &DeValue<'_>, default: &Json) -> Result<(), Problem> {
    let fits = match default {
        Json::Null => true,
        Json::Bool(_) => matches!(found, DeValue::Boolean(_)),
        // Some settings take a name or a list; which, their type says when it reads the value.
        Json::String(_) => matches!(found, DeValue::String(_) | DeValue::Array(_)),
        Json::Array(_) => matches!(found, DeValue::Array(_)),
        Json::Object(_) => false,
        Json::Number(n) if n.is_f64() => matches!(found, DeValue::Float(_) | DeValue::Integer(_)),
        Json::Number(n) => {
            matches!(found, DeValue::Integer(i) if !(n.is_u64() && i.as_str().starts_with('-')))
        }
    };
    if fits {
        return Ok(());
    }
    let expected = match default {
        Json::Bool(_) => "`true` or `false`",
        Json::String(_) => "text",
        Json::Array(_) => "a list",
        Json::Object(_) => "a table of keys",
        Json::Number(n) if n.is_f64() => "a number",
        _ => "a whole number, 0 or more",
    };
    let problem = Problem::new(format!("`{path}` expects {expected}, found {}", describe(found)));
    Err(match default {
        Json::Object(table) => problem.hint(format!("name one of its keys: {}", key_list(table))),
        _ => problem.hint(format!("the default is `{}`", show(default))),
    })
}

fn describe(value: &DeValue<'_>) -> String {
    match value {
        DeValue::String(s) => format!("the text `\"{s}\"`"),
        DeValue::Integer(i) => format!("the whole number `{i}`"),
        DeValue::Float(f) => format!("the number `{f}`"),
        DeValue::Boolean(b) => format!("`{b}`"),
        DeValue::Datetime(d) => format!("the date `{d}`"),
        DeValue::Array(_) => "a list".to_owned(),
        DeValue::Table(_) => "a table".to_owned(),
    }
}

/// A default as a person would write it in TOML; numbers in their shortest form, since settings are `f32`.
fn show(value: &Json) -> String {
    match value {
        Json::Number(n) => match n.as_f64() {
            Some(x) if n.is_f64() => format!("{:?}", x as f32),
            _ => n.to_string(),
        },
        Json::Array(items) => format!("[{}]", items.iter().map(show).collect::<Vec<_>>().join(", ")),
        other => other.to_string(),
    }
}

fn key_list(table: &serde_json::Map<String, Json>) -> String {
    table.keys().map(String::as_str).collect::<Vec<_>>().join(", ")
}

pub(super) fn unknown_key(path: &str, keys: &Json, schema: &Schema) -> Problem {
    let problem = Problem::new(format!("`{path}` is not a setting"));
    if let Some(Json::Object(table)) = find(keys, path) {
        return problem.hint(format!("it is a table; name one of its keys: {}", key_list(table)));
    }
    let mut paths = Vec::new();
    leaves(keys, "", &mut |p, _| paths.push(p.to_owned()));
    // A section may be misspelt, be missing, or the key may stand in the wrong one.
    let last = path.rsplit('.').next().unwrap_or(path);
    let same_key = paths.iter().find(|p| p.rsplit('.').next() == Some(last)).map(String::as_str);
    let sections = keys.as_object().into_iter().flat_map(|t| t.keys().map(String::as_str));
    let near = same_key.or_else(|| {
        if path.contains('.') { nearest(path, paths.iter().map(String::as_str)) } else { nearest(path, sections) }
    });
    let near = near.or_else(|| {
        let section = path.split_once('.').map(|(s, _)| s)?;
        let siblings = paths.iter().filter(|p| p.split_once('.').is_some_and(|(s, _)| s == section));
        siblings.max_by(|a, b| strsim::jaro(path, a).total_cmp(&strsim::jaro(path, b))).map(String::as_str)
    });
    match near {
        Some(near) => problem.hint(format!("did you mean `{near}`?")),
        None => problem.hint(format!("`gazesplat {} --help` lists every key", schema.command)),
    }
}
