//! Golden files: a `.json` with scalars and a `.safetensors` of the same stem with arrays (`tests/golden/README.md`).

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use safetensors::{Dtype, SafeTensors};
use serde_json::Value;

use crate::data::workspace_root;

/// Environment variable that names one directory to take golden files from, instead of the ones of the project.
pub const GOLDEN_VARIABLE: &str = "GAZESPLAT_GOLDEN";

/// Values of one array, in C order, as they are stored.
#[derive(Debug, Clone, PartialEq)]
pub enum Values {
    /// float64.
    F64(Vec<f64>),
    /// float32.
    F32(Vec<f32>),
    /// Signed integers, 32 or 64 bits.
    Int(Vec<i64>),
    /// Booleans or bytes, true where not 0.
    Bool(Vec<bool>),
}

/// One named array of a golden file.
#[derive(Debug, Clone, PartialEq)]
pub struct Array {
    /// Sizes of the axes, slowest first.
    pub shape: Vec<usize>,
    /// The values.
    pub values: Values,
}

/// Where a golden record lies.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct GoldenFile {
    /// File name without extension, as in `render_one`.
    pub stem: String,
    /// The file with scalars. The arrays lie beside it.
    pub json: PathBuf,
}

/// A golden record in memory.
#[derive(Debug, Clone)]
pub struct Golden {
    /// File name without extension.
    pub stem: String,
    /// The scalars.
    pub json: Value,
    arrays: BTreeMap<String, Array>,
}

/// Directories golden files are taken from: the one that `GAZESPLAT_GOLDEN` names and no other; else `tests/golden` of
/// the workspace, and after it `../shared/golden` for the files that are too large for the repository, where present.
pub fn golden_dirs() -> Vec<PathBuf> {
    if let Some(dir) = std::env::var_os(GOLDEN_VARIABLE).filter(|v| !v.is_empty()) {
        let dir = PathBuf::from(dir);
        // Cargo runs tests in the directory of their package; a relative path is meant from where cargo was called.
        return vec![if dir.is_dir() || dir.is_absolute() { dir } else { workspace_root().join(dir) }];
    }
    let mut dirs = vec![workspace_root().join("tests/golden")];
    let large = workspace_root().join("../shared/golden");
    if large.is_dir() {
        dirs.push(large);
    } else {
        eprintln!("SKIPPED: golden files above 1 MiB: {} is not there", large.display());
    }
    dirs
}

/// All golden records whose stem starts with `prefix`, sorted; of records with the same stem the first directory wins.
///
/// # Panics
/// If there is none: a test over no files must not pass.
pub fn list(prefix: &str) -> Vec<GoldenFile> {
    let dirs = golden_dirs();
    let found = list_in(&dirs, prefix);
    assert!(!found.is_empty(), "no golden file {prefix}*.json in {dirs:?}");
    found
}

/// The record `stem`, `None` when no directory has it.
pub fn find(stem: &str) -> Option<GoldenFile> {
    list_in(&golden_dirs(), stem).into_iter().find(|f| f.stem == stem)
}

fn list_in(dirs: &[PathBuf], prefix: &str) -> Vec<GoldenFile> {
    let mut found = BTreeMap::new();
    for dir in dirs {
        let Ok(entries) = std::fs::read_dir(dir) else { continue };
        for path in entries.filter_map(|e| Some(e.ok()?.path())) {
            let Some(stem) = path.file_stem().and_then(|s| s.to_str()) else { continue };
            if path.extension().is_some_and(|e| e == "json") && stem.starts_with(prefix) {
                found.entry(stem.to_string()).or_insert(path);
            }
        }
    }
    found.into_iter().map(|(stem, json)| GoldenFile { stem, json }).collect()
}

impl GoldenFile {
    /// Reads the scalars alone, of a record that has no arrays.
    ///
    /// # Panics
    /// If the file is missing or damaged, naming it.
    pub fn load_json(&self) -> Value {
        serde_json::from_slice(&read(&self.json)).unwrap_or_else(|e| panic!("{}: {e}", self.json.display()))
    }

    /// Reads the record.
    ///
    /// # Panics
    /// If a file is missing or damaged, naming it: golden data that cannot be read is a failed test.
    pub fn load(&self) -> Golden {
        let json = self.load_json();
        let path = self.json.with_extension("safetensors");
        let arrays = parse(&read(&path)).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        Golden { stem: self.stem.clone(), json, arrays }
    }
}

fn read(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap_or_else(|e| panic!("golden file {}: {e}", path.display()))
}

fn parse(bytes: &[u8]) -> Result<BTreeMap<String, Array>, String> {
    let file = SafeTensors::deserialize(bytes).map_err(|e| e.to_string())?;
    let mut arrays = BTreeMap::new();
    for (name, view) in file.iter() {
        let data = view.data();
        let values = match view.dtype() {
            Dtype::F64 => Values::F64(chunks(data).map(f64::from_le_bytes).collect()),
            Dtype::F32 => Values::F32(chunks(data).map(f32::from_le_bytes).collect()),
            Dtype::I64 => Values::Int(chunks(data).map(i64::from_le_bytes).collect()),
            Dtype::I32 => Values::Int(chunks(data).map(|b| i64::from(i32::from_le_bytes(b))).collect()),
            Dtype::U8 | Dtype::BOOL => Values::Bool(data.iter().map(|&b| b != 0).collect()),
            other => return Err(format!("array {name} has the unexpected type {other:?}")),
        };
        arrays.insert(name.to_string(), Array { shape: view.shape().to_vec(), values });
    }
    Ok(arrays)
}

fn chunks<const N: usize>(data: &[u8]) -> impl Iterator<Item = [u8; N]> + '_ {
    data.chunks_exact(N).map(|c| c.try_into().expect("chunks_exact yields N bytes"))
}

impl Golden {
    /// The array, `None` when the record lacks it.
    pub fn array(&self, name: &str) -> Option<&Array> {
        self.arrays.get(name)
    }

    /// Names of all arrays, sorted.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.arrays.keys().map(String::as_str)
    }

    /// Shape of an array.
    ///
    /// # Panics
    /// If the record lacks it.
    pub fn shape(&self, name: &str) -> &[usize] {
        &self.required(name).shape
    }

    /// Values of a float array in float64 (an exact promotion where float32 is stored).
    ///
    /// # Panics
    /// If the record lacks it or it holds no floats.
    pub fn f64(&self, name: &str) -> Vec<f64> {
        match &self.required(name).values {
            Values::F64(v) => v.clone(),
            Values::F32(v) => v.iter().map(|&x| f64::from(x)).collect(),
            other => panic!("{}: array {name} holds no floats but {}", self.stem, kind(other)),
        }
    }

    /// Values of a float32 array: inputs, which have to be taken bit by bit.
    ///
    /// # Panics
    /// If the record lacks it or it holds another type.
    pub fn f32(&self, name: &str) -> Vec<f32> {
        match &self.required(name).values {
            Values::F32(v) => v.clone(),
            Values::F64(v) if v.iter().all(|&x| f64::from(x as f32) == x) => v.iter().map(|&x| x as f32).collect(),
            other => panic!("{}: array {name} is not float32 but {}", self.stem, kind(other)),
        }
    }

    /// Values of an integer or boolean array.
    ///
    /// # Panics
    /// If the record lacks it or it holds floats.
    pub fn int(&self, name: &str) -> Vec<i64> {
        match &self.required(name).values {
            Values::Int(v) => v.clone(),
            Values::Bool(v) => v.iter().map(|&x| i64::from(x)).collect(),
            other => panic!("{}: array {name} holds no integers but {}", self.stem, kind(other)),
        }
    }

    /// Values of a boolean or integer array, true where not 0.
    ///
    /// # Panics
    /// If the record lacks it or it holds floats.
    pub fn bool(&self, name: &str) -> Vec<bool> {
        self.int(name).into_iter().map(|x| x != 0).collect()
    }

    /// A number of the JSON, by path as in `"stats.fragile_pixels"`; `None` when absent. Keys that contain dots are
    /// reached by [`json`](Self::json) itself.
    pub fn number(&self, path: &str) -> Option<f64> {
        path.split('.').try_fold(&self.json, |value, key| value.get(key))?.as_f64()
    }

    fn required(&self, name: &str) -> &Array {
        self.array(name).unwrap_or_else(|| panic!("{}: array {name} is missing", self.stem))
    }
}

fn kind(values: &Values) -> &'static str {
    match values {
        Values::F64(_) => "float64",
        Values::F32(_) => "float32",
        Values::Int(_) => "integers",
        Values::Bool(_) => "booleans",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shipped(stem: &str) -> GoldenFile {
        GoldenFile { stem: stem.into(), json: workspace_root().join(format!("tests/golden/{stem}.json")) }
    }

    #[test]
    fn shipped_record_loads_with_shapes_and_types() {
        let golden = shipped("render_sh3_eval1").load();
        assert_eq!(golden.shape("in.sh"), [32, 16, 3]);
        assert_eq!(golden.f32("in.means").len(), 96);
        assert_eq!(golden.f64("out.color").len(), 48 * 64 * 3);
        assert_eq!(golden.bool("out.fragile").len(), 48 * 64);
        assert_eq!(golden.int("proj.order").len(), 32);
        assert_eq!(golden.number("stats.gaussians_valid"), Some(32.0));
    }

    #[test]
    #[should_panic(expected = "array out.nothing is missing")]
    fn missing_array_is_named() {
        shipped("render_one").load().f64("out.nothing");
    }

    #[test]
    fn damaged_arrays_are_refused() {
        assert!(parse(b"").is_err());
        assert!(parse(&[255; 32]).is_err());
    }

    #[test]
    fn list_holds_each_stem_once_and_sorted() {
        let dir = workspace_root().join("tests/golden");
        let files = list_in(&[dir.clone(), dir], "render_");
        assert!(files.len() >= 10);
        assert!(files.windows(2).all(|w| w[0].stem < w[1].stem));
    }
}
