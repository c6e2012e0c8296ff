//! Where test files lie: the workspace root and the directory of photo scenes and models.

use std::path::{Path, PathBuf};

/// Environment variable that names the directory of scenes and models.
pub const DATA_VARIABLE: &str = "GAZESPLAT_DATA";

/// Root directory of the workspace (two levels above this crate).
pub fn workspace_root() -> PathBuf {
    let manifest = Path::new(env!("CARGO_MANIFEST_DIR"));
    manifest.ancestors().nth(2).expect("this crate lies in crates/testkit of the workspace").to_path_buf()
}

/// Directory of scenes and models: `GAZESPLAT_DATA`, else `../shared/data` seen from the workspace root.
///
/// `None` when that directory is missing; this is then said on stderr, so that a test that returns early is skipped aloud:
///
/// ```
/// let Some(data) = gazesplat_testkit::data_dir() else { return };
/// assert!(data.is_dir());
/// ```
pub fn data_dir() -> Option<PathBuf> {
    let dir = match std::env::var_os(DATA_VARIABLE) {
        Some(value) if !value.is_empty() => PathBuf::from(value),
        _ => workspace_root().join("../shared/data"),
    };
    if dir.is_dir() {
        return Some(dir);
    }
    eprintln!("SKIPPED: no test data: {} is not a directory (set {DATA_VARIABLE})", dir.display());
    None
}

/// A file or directory below [`data_dir`], `relative` as in `"plush/images"`.
///
/// `None`, said on stderr, when the data directory or this entry of it is missing.
pub fn data_path(relative: &str) -> Option<PathBuf> {
    let path = data_dir()?.join(relative);
    if path.exists() {
        return Some(path);
    }
    eprintln!("SKIPPED: no test data: {} does not exist", path.display());
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn workspace_root_holds_the_workspace_manifest() {
        let manifest = std::fs::read_to_string(workspace_root().join("Cargo.toml")).expect("the root has a manifest");
        assert!(manifest.contains("[workspace]"));
    }

    #[test]
    fn missing_entry_of_the_data_directory_is_none() {
        assert_eq!(data_path("no such scene"), None);
    }
}
