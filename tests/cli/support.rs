//! A directory of its own for each test, a small scene and a small run made once, and the end of a process as text.

use assert_cmd::cargo::cargo_bin_cmd;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::LazyLock;
use tempfile::TempDir;

/// How a process ended.
pub struct Ended {
    pub code: i32,
    pub stdout: String,
    pub stderr: String,
}

impl Ended {
    /// Asserts success.
    #[track_caller]
    pub fn done(self) -> Self {
        assert_eq!(self.code, 0, "stderr:\n{}", self.stderr);
        self
    }

    /// Asserts an error of the input: status 2, no data, a hint. Returns what was said.
    #[track_caller]
    pub fn refused(self) -> String {
        assert_eq!(self.code, 2, "stdout:\n{}\nstderr:\n{}", self.stdout, self.stderr);
        assert_eq!(self.stdout, "");
        assert!(self.stderr.contains("error: "), "{}", self.stderr);
        assert!(self.stderr.contains("\nhint: "), "no hint:\n{}", self.stderr);
        assert!(!self.stderr.contains("panicked"), "{}", self.stderr);
        self.stderr
    }
}

/// A temporary directory in which commands run, so that the paths in their output are short and the same everywhere.
pub struct Place(TempDir);

impl Place {
    pub fn new() -> Self {
        Self(tempfile::tempdir().expect("temporary directory"))
    }

    /// A place with the small scene in `scene`.
    pub fn with_scene() -> Self {
        let place = Self::new();
        copy(&SCENE.path("scene"), &place.path("scene"));
        place
    }

    /// A place with the small scene in `scene` and a run on it in `run`.
    pub fn with_run() -> Self {
        let place = Self::with_scene();
        copy(&RUN.path("run"), &place.path("run"));
        place
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    pub fn command(&self, args: &[&str]) -> assert_cmd::Command {
        let mut command = cargo_bin_cmd!("gazesplat");
        command.args(args).current_dir(self.0.path()).env_remove("RUST_LOG").env("NO_COLOR", "1");
        command
    }

    /// Runs `gazesplat` with `args` here.
    pub fn run(&self, args: &[&str]) -> Ended {
        Self::end(self.command(args))
    }

    /// Runs `gazesplat` with `args` here, where no Vulkan driver can be found.
    #[cfg(target_os = "linux")]
    pub fn run_without_gpu(&self, args: &[&str]) -> Ended {
        let mut command = self.command(args);
        // The second name is that of loaders before 1.3.207.
        command.env("VK_DRIVER_FILES", "/nonexistent").env("VK_ICD_FILENAMES", "/nonexistent");
        command.env_remove("VK_ADD_DRIVER_FILES");
        Self::end(command)
    }

    /// Starts `gazesplat` with `args` here and kills it as soon as `is_time`; returns when it has ended either way.
    pub fn kill_when(&self, args: &[&str], is_time: impl Fn() -> bool) {
        let mut command = std::process::Command::new(assert_cmd::cargo::cargo_bin!("gazesplat"));
        command.args(args).current_dir(self.0.path()).stdout(Stdio::null()).stderr(Stdio::null());
        let mut child = command.spawn().expect("the program starts");
        while child.try_wait().expect("it can be waited for").is_none() {
            if is_time() {
                child.kill().expect("it can be killed");
                child.wait().expect("it can be waited for");
                return;
            }
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
    }

    fn end(mut command: assert_cmd::Command) -> Ended {
        let output = command.output().expect("the program starts");
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        Ended { code: output.status.code().unwrap_or(-1), stdout: text(&output.stdout), stderr: text(&output.stderr) }
    }

    /// Names in a directory, sorted; empty when there is none.
    pub fn list(&self, name: &str) -> Vec<String> {
        let Ok(entries) = fs::read_dir(self.path(name)) else { return Vec::new() };
        let mut names: Vec<String> =
            entries.map(|e| e.expect("readable").file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    pub fn read(&self, name: &str) -> String {
        fs::read_to_string(self.path(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
    }

    pub fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        fs::write(self.path(name), content).expect("writable");
    }

    /// Replaces text in a file, wherever it stands.
    pub fn edit(&self, name: &str, from: &str, to: &str) {
        let text = self.read(name);
        assert!(text.contains(from), "{name} has no `{from}`");
        self.write(name, text.replace(from, to));
    }

    /// Replaces bytes of a file by as many others.
    pub fn edit_bytes(&self, name: &str, from: &[u8], to: &[u8]) {
        let mut bytes = fs::read(self.path(name)).expect("readable");
        let at =
            bytes.windows(from.len()).position(|w| w == from).unwrap_or_else(|| panic!("{name} lacks these bytes"));
        bytes[at..at + from.len()].copy_from_slice(to);
        self.write(name, bytes);
    }
}

/// Overwrites the first value of the first `num_rows` rows of the binary model `name` by NaN.
pub fn break_rows(place: &Place, name: &str, num_rows: usize) {
    let mut bytes = fs::read(place.path(name)).expect("readable");
    let end = b"end_header\n";
    let data = bytes.windows(end.len()).position(|w| w == end).expect("a PLY header") + end.len();
    let header = String::from_utf8_lossy(&bytes[..data]).into_owned();
    let row_bytes = 4 * header.matches("property float").count();
    for row in bytes[data..].chunks_exact_mut(row_bytes).take(num_rows) {
        row[..4].copy_from_slice(&f32::NAN.to_le_bytes());
    }
    place.write(name, bytes);
}

/// Options of a training that is over in a moment.
pub const SHORT: [&str; 8] =
    ["--set", "train.steps=40", "--set", "densify.cap=600", "--set", "train.threads=2", "--set", "model.sh_degree=1"];

static SCENE: LazyLock<Place> = LazyLock::new(|| {
    let place = Place::new();
    place.run(&["synth", "--out", "scene", "--views", "9", "--size", "64x48", "--points", "400"]).done();
    place
});

static RUN: LazyLock<Place> = LazyLock::new(|| {
    let place = Place::with_scene();
    place.run(&[&["train", "scene", "--out", "run"], SHORT.as_slice()].concat()).done();
    place
});

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).expect("writable");
    for entry in fs::read_dir(from).expect("readable") {
        let entry = entry.expect("readable");
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &target);
        } else {
            fs::copy(entry.path(), target).expect("writable");
        }
    }
}

/// Writes weights of LPIPS as a safetensors file: those of VGG16 in shape, two channels wide. `change` may spoil them: it gets
/// the header and the values.
pub fn write_lpips_weights(place: &Place, name: &str, change: impl FnOnce(&mut serde_json::Value, &mut [f32])) {
    let (mut header, mut values) = (serde_json::Map::new(), Vec::new());
    let mut add = |name: String, shape: &[usize], low: f32| {
        let (num, begin) = (shape.iter().product::<usize>(), 4 * values.len());
        // Any numbers between `low` and 0.6.
        values.extend((0..num).map(|i| low + (0.6 - low) * ((i * 37 + 11) % 64) as f32 / 64.0));
        let range = [begin, 4 * values.len()];
        header.insert(name, serde_json::json!({ "dtype": "F32", "shape": shape, "data_offsets": range }));
    };
    let blocks: [&[usize]; 5] = [&[0, 2], &[5, 7], &[10, 12, 14], &[17, 19, 21], &[24, 26, 28]];
    let mut num_in = 3;
    for (block, features) in blocks.iter().enumerate() {
        for feature in *features {
            add(format!("net.slice{}.{feature}.weight", block + 1), &[2, num_in, 3, 3], -0.4);
            add(format!("net.slice{}.{feature}.bias", block + 1), &[2], 0.1);
            num_in = 2;
        }
        add(format!("lin{block}.model.1.weight"), &[1, 2, 1, 1], 0.2);
    }
    let mut header = serde_json::Value::Object(header);
    change(&mut header, &mut values);
    let header = header.to_string();
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend(header.into_bytes());
    bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    place.write(name, bytes);
}
