//! Checkpoints: one file with everything an interrupted run needs to go on, complete or absent.
//!
//! The file is a safetensors file: tensors of parameters and moments, and a JSON text with the rest in its header. What the
//! text holds is the business of who writes it; here it is bound to a kind of run and a version.

use crate::error::{Error, Result};
use crate::kernels::cpu::rows::Rows;
use crate::optim::state::lag::are_words_valid;
use crate::optim::{Columns, Group, HostState};
use gazesplat_core::io::write_atomically;
use gazesplat_core::{Camera, GaussianCloud};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use serde::{Serialize, de::DeserializeOwned};
use std::collections::HashMap;
use std::io::Write as _;
use std::path::Path;

/// Format of the tensors and of what every checkpoint holds.
const FORMAT: &str = "gazesplat checkpoint 1";

/// Before the names of vectors.
const VECTORS: &str = "vectors";

/// Writes a checkpoint of a run of kind `kind`: `meta` and the named states. A checkpoint that was there before stays
/// until the new one is complete on the disk.
///
/// # Errors
/// [`Error::Scene`] when the file cannot be written.
pub fn save(path: &Path, kind: &str, meta: &impl Serialize, states: &[(&str, &HostState)]) -> Result<()> {
    save_with(path, kind, meta, states, &[])
}

/// [`save`], with named vectors beside the states.
///
/// # Errors
/// As [`save`].
pub fn save_with(
    path: &Path,
    kind: &str,
    meta: &impl Serialize,
    states: &[(&str, &HostState)],
    vectors: &[(&str, &[f32])],
) -> Result<()> {
    let mut info = HashMap::from([
        ("format".to_owned(), FORMAT.to_owned()),
        ("kind".to_owned(), kind.to_owned()),
        ("meta".to_owned(), serde_json::to_string(meta).expect("our records are plain data")),
    ]);
    let mut tensors = Vec::new();
    for (name, state) in states {
        if !state.last.is_empty() {
            let view = TensorView::new(Dtype::U32, vec![state.last.len()], bytemuck::cast_slice(&state.last))
                .expect("a word per row");
            tensors.push((format!("{name}.last"), view));
        }
        info.insert(format!("{name}.num_updates"), state.num_updates.to_string());
        let Rows { params, first, second } = &state.rows;
        for (part, columns) in [("params", params), ("first", first), ("second", second)] {
            for group in Group::ALL {
                let shape = vec![columns.num_rows(), columns.widths[group as usize]];
                let view = TensorView::new(Dtype::F32, shape, bytemuck::cast_slice(columns.of(group)))
                    .expect("columns have the size of their shape");
                tensors.push((format!("{name}.{part}.{}", group.name()), view));
            }
        }
    }
    for (name, values) in vectors {
        let view = TensorView::new(Dtype::F32, vec![values.len()], bytemuck::cast_slice(values))
            .expect("a vector has the size of its shape");
        tensors.push((format!("{VECTORS}.{name}"), view));
    }
    let bytes = safetensors::serialize(tensors, Some(info)).expect("finite shapes and plain text");
    Ok(write_atomically(path, |file| file.write_all(&bytes))?)
}

/// A checkpoint, read.
#[derive(Debug)]
pub struct Loaded<M> {
    /// What [`save`] was given.
    pub meta: M,
    states: Vec<(String, HostState)>,
    vectors: Vec<(String, Vec<f32>)>,
}

impl<M> Loaded<M> {
    /// Takes the state of that name out.
    pub fn take(&mut self, name: &str) -> Option<HostState> {
        let at = self.states.iter().position(|(found, _)| found == name)?;
        Some(self.states.swap_remove(at).1)
    }

    /// Takes the vector of that name out.
    pub fn take_vector(&mut self, name: &str) -> Option<Vec<f32>> {
        let at = self.vectors.iter().position(|(found, _)| found == name)?;
        Some(self.vectors.swap_remove(at).1)
    }
}

/// Reads a checkpoint of a run of kind `kind` with the states `names`, as many of them as there are.
///
/// # Errors
/// [`Error::Checkpoint`] for a file that is damaged, of another version or of another kind of run; [`Error::Scene`] when it
/// cannot be read.
pub fn load<M: DeserializeOwned>(path: &Path, kind: &str, names: &[&str]) -> Result<Loaded<M>> {
    let refuse = |message: String| Error::Checkpoint { path: path.to_owned(), message };
    let bytes = std::fs::read(path).map_err(|source| gazesplat_core::Error::Io {
        action: "read",
        path: path.to_owned(),
        source,
    })?;
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(|e| refuse(format!("damaged: {e}")))?;
    let file = SafeTensors::deserialize(&bytes).map_err(|e| refuse(format!("damaged: {e}")))?;
    let none = HashMap::new();
    let info = header.metadata().as_ref().unwrap_or(&none);
    let text = |key: &str| info.get(key).map(String::as_str).unwrap_or_default();
    if text("format") != FORMAT {
        return Err(refuse(format!("its format is `{}`, expected `{FORMAT}`", text("format"))));
    }
    if text("kind") != kind {
        return Err(refuse(format!("it is of a run of `{}`, expected `{kind}`", text("kind"))));
    }
    let meta = serde_json::from_str(text("meta")).map_err(|e| refuse(format!("of another version: {e}")))?;
    let mut states = Vec::new();
    for &name in names {
        let Some(num_updates) = info.get(&format!("{name}.num_updates")) else { continue };
        let num_updates = num_updates.parse().map_err(|e| refuse(format!("damaged: updates of `{name}`: {e}")))?;
        let part = |part: &str| columns(&file, &format!("{name}.{part}")).map_err(&refuse);
        let rows = Rows { params: part("params")?, first: part("first")?, second: part("second")? };
        if rows.params.widths != rows.first.widths
            || rows.params.widths != rows.second.widths
            || rows.params.num_rows() != rows.first.num_rows()
            || rows.params.num_rows() != rows.second.num_rows()
        {
            return Err(refuse(format!("damaged: the moments of `{name}` do not fit its parameters")));
        }
        let last = words(&file, &format!("{name}.last"), rows.num_rows(), num_updates).map_err(refuse)?;
        states.push((name.to_owned(), HostState { rows, num_updates, last }));
    }
    let mut vectors = Vec::new();
    for (name, tensor) in file.tensors() {
        let Some(name) = name.strip_prefix(VECTORS).and_then(|rest| rest.strip_prefix('.')) else { continue };
        if tensor.dtype() != Dtype::F32 {
            return Err(refuse(format!("damaged: `{name}` is {:?}", tensor.dtype())));
        }
        vectors.push((name.to_owned(), tensor.data().chunks_exact(4).map(float).collect()));
    }
    Ok(Loaded { meta, states, vectors })
}

/// A word per row, or none where no row lags.
fn words(
    file: &SafeTensors<'_>,
    name: &str,
    num_rows: usize,
    num_updates: u32,
) -> std::result::Result<Vec<u32>, String> {
    let Ok(tensor) = file.tensor(name) else { return Ok(Vec::new()) };
    let word = |bytes: &[u8]| u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
    let words: Vec<u32> = tensor.data().chunks_exact(4).map(word).collect();
    match tensor.dtype() == Dtype::U32 && words.len() == num_rows && are_words_valid(&words, num_updates) {
        true => Ok(words),
        false => Err(format!("damaged: `{name}` does not fit {num_rows} Gaussians after {num_updates} updates")),
    }
}

/// Parameters, or moments of them, under `prefix`.
fn columns(file: &SafeTensors<'_>, prefix: &str) -> std::result::Result<Columns, String> {
    let mut columns = Columns::default();
    let mut num_rows = None;
    for group in Group::ALL {
        let name = format!("{prefix}.{}", group.name());
        let tensor = file.tensor(&name).map_err(|e| format!("damaged: {e}"))?;
        let shape = tensor.shape();
        let expected_width = match group {
            Group::Means | Group::LogScales => Some(3),
            Group::Quats => Some(4),
            Group::OpacityLogits => Some(1),
            Group::Sh => None,
        };
        let fits = tensor.dtype() == Dtype::F32
            && shape.len() == 2
            && num_rows.is_none_or(|n| n == shape[0])
            && expected_width.map_or_else(|| shape[1] % 3 == 0 && shape[1] > 0, |w| w == shape[1]);
        if !fits {
            return Err(format!("damaged: `{name}` is {:?} {shape:?}", tensor.dtype()));
        }
        num_rows = Some(shape[0]);
        columns.widths[group as usize] = shape[1];
        columns.data[group as usize] = tensor.data().chunks_exact(4).map(float).collect();
    }
    Ok(columns)
}

fn float(bytes: &[u8]) -> f32 {
    f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])
}

/// FNV-1a over the bits of all parameters: tells models apart, not attackers.
pub fn fingerprint(cloud: &GaussianCloud) -> String {
    hashed(
        [cloud.means.as_flattened(), cloud.quats.as_flattened(), cloud.log_scales.as_flattened()]
            .into_iter()
            .chain([cloud.opacity_logits.as_slice(), cloud.sh.as_flattened()])
            .flatten()
            .copied(),
    )
}

/// The same over sizes, lenses and poses.
pub(crate) fn fingerprint_of_cameras<'a>(cameras: impl Iterator<Item = &'a Camera>) -> String {
    let values = |camera: &Camera| {
        let p = camera.intrinsics;
        let lens = [p.width as f32, p.height as f32, p.fx, p.fy, p.cx, p.cy];
        lens.into_iter().chain(camera.camera_from_world.to_cols_array())
    };
    hashed(cameras.flat_map(values))
}

fn hashed(values: impl Iterator<Item = f32>) -> String {
    let step = |hash: u64, value: f32| (hash ^ u64::from(value.to_bits())).wrapping_mul(0x0000_0100_0000_01b3);
    format!("{:016x}", values.fold(0xcbf2_9ce4_8422_2325, step))
}

/// Settings that differ, as `key = old, now new`, but for those of `free`, which change nothing of the result.
pub fn differences(old: &impl Serialize, new: &impl Serialize, free: &[&str]) -> Vec<String> {
    fn compare(path: &str, old: &serde_json::Value, new: &serde_json::Value, free: &[&str], out: &mut Vec<String>) {
        match (old.as_object(), new.as_object()) {
            (Some(a), Some(b)) => {
                for (key, value) in a {
                    let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                    compare(&path, value, b.get(key).unwrap_or(&serde_json::Value::Null), free, out);
                }
            }
            _ if old == new || free.contains(&path) => {}
            _ => out.push(format!("{path} = {old}, now {new}")),
        }
    }
    // Through the same text as the recorded ones went: reading a number back may cost its last digit.
    fn tree(config: &impl Serialize) -> serde_json::Value {
        let text = serde_json::to_string(config).expect("settings are plain data");
        serde_json::from_str(&text).expect("our own text")
    }
    let (mut out, old) = (Vec::new(), tree(&tree(old)));
    compare("", &old, &tree(&tree(new)), free, &mut out);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state() -> HostState {
        let widths = [3, 4, 3, 1, 12];
        let columns = |add: f32| Columns { data: widths.map(|w| (0..2 * w).map(|i| i as f32 + add).collect()), widths };
        let rows = Rows { params: columns(0.25), first: columns(f32::MIN_POSITIVE), second: columns(f32::EPSILON) };
        HostState { rows, num_updates: 7, last: Vec::new() }
    }

    #[test]
    fn what_is_saved_comes_back_bit_for_bit() {
        let dir = tempfile::tempdir().expect("temporary directory");
        let path = dir.path().join("checkpoint");
        let (states, memory) = ([("state", &state()), ("best", &state())], [0.1, f32::MIN_POSITIVE, -0.0]);
        save_with(&path, "test", &(3u32, "text"), &states, &[("memory", &memory)]).expect("writable");
        let mut loaded: Loaded<(u32, String)> = load(&path, "test", &["state", "best", "none"]).expect("readable");
        let bits = |values: Vec<f32>| values.into_iter().map(f32::to_bits).collect::<Vec<_>>();
        assert_eq!(loaded.take_vector("memory").map(bits), Some(bits(memory.to_vec())));
        assert_eq!(loaded.take_vector("memory"), None);
        assert_eq!(loaded.meta, (3, "text".to_owned()));
        assert_eq!(loaded.take("state"), Some(state()));
        assert_eq!(loaded.take("best"), Some(state()));
        assert_eq!(loaded.take("none"), None);
    }

    #[test]
    fn damaged_and_foreign_files_are_refused_with_the_reason() {
        let dir = tempfile::tempdir().expect("temporary directory");
        let path = dir.path().join("checkpoint");
        let refused = |kind: &str| load::<(u32, String)>(&path, kind, &["state"]).expect_err("refused").to_string();
        assert!(refused("test").contains("cannot read"), "{}", refused("test"));
        save(&path, "test", &(3u32, "text"), &[("state", &state())]).expect("writable");
        assert!(refused("other").contains("of a run of `test`, expected `other`"));
        let bytes = std::fs::read(&path).expect("readable");
        for len in [0, 7, 8, 100, bytes.len() / 2, bytes.len() - 1] {
            std::fs::write(&path, &bytes[..len]).expect("writable");
            assert!(refused("test").contains("damaged"), "{len}: {}", refused("test"));
        }
        std::fs::write(&path, b"not a checkpoint at all, but a text").expect("writable");
        assert!(refused("test").contains("damaged"));
        save(&path, "test", &"another version", &[("state", &state())]).expect("writable");
        assert!(refused("test").contains("of another version"));
    }
}
