//! Where a command computes: opened before any work, named, and guarded against the panics of a driver that fails.

use crate::console::Console;
use crate::diagnostics::{Failure, Result};
use gazesplat_render::device::{self, Adapter, Device};
use gazesplat_render::{DeviceChoice, cpu_device, is_gpu};
use std::any::Any;
use std::panic::{self, AssertUnwindSafe, PanicHookInfo};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, Once, PoisonError};

/// An open device, and what it is.
#[derive(Debug)]
pub struct ComputeDevice {
    device: Device,
    /// Number in the list of adapters, and what the driver says; `None` for the CPU.
    adapter: Option<(usize, Adapter)>,
}

impl ComputeDevice {
    /// The CPU, which is always there.
    pub fn cpu() -> Self {
        Self { device: cpu_device(), adapter: None }
    }

    /// Opens the device of that name and tells at `-v` which it is; warns of a software driver nobody asked for.
    ///
    /// # Errors
    /// When there is no such adapter, or it lacks what the kernels need.
    pub fn open(choice: DeviceChoice, console: &Console) -> Result<Self> {
        if choice == DeviceChoice::Cpu {
            return Ok(Self::cpu());
        }
        // Drivers have been seen to panic while they start.
        let (device, found) = guarded(|| Ok((choice.open()?, device::adapters())))?;
        let is_chosen = |index: usize, adapter: &Adapter| match choice {
            DeviceChoice::GpuIndex(chosen) => index == chosen,
            DeviceChoice::Cpu | DeviceChoice::Gpu => adapter.is_default,
        };
        let adapter = found.into_iter().enumerate().find(|(index, adapter)| is_chosen(*index, adapter));
        let opened = Self { device, adapter };
        tracing::info!("device: {}", opened.describe());
        match &opened.adapter {
            Some((_, adapter)) if choice == DeviceChoice::Gpu && adapter.is_software() => console.warn(format_args!(
                "`--device gpu` found no graphics card but the software driver {}: `--device cpu` is faster",
                adapter.name
            )),
            _ => {}
        }
        Ok(opened)
    }

    /// Where tensors are made.
    pub fn tensors(&self) -> &Device {
        &self.device
    }

    /// True for a GPU, whose content is lost with it.
    pub fn is_gpu(&self) -> bool {
        is_gpu(&self.device)
    }

    /// One line for people: `CPU`, or number, name, kind, API and driver of the adapter.
    pub fn describe(&self) -> String {
        match &self.adapter {
            Some((index, a)) => format!("gpu:{index}, {} ({}), {}, {}", a.name, a.kind, a.api, a.driver),
            None if self.is_gpu() => "GPU".to_owned(),
            None => "CPU".to_owned(),
        }
    }

    /// Does `work`, which should be what needs the device and little else. On a GPU a panic becomes an error: the layers
    /// between us and the driver panic when the adapter is lost. On the CPU a panic is a mistake of ours and is shown as
    /// one.
    ///
    /// # Errors
    /// Those of `work`; when it panicked on a GPU, that the GPU stopped, or, when the panic began in a crate of ours, an
    /// internal error, with what was said.
    pub fn guard<T>(&self, work: impl FnOnce() -> Result<T>) -> Result<T> {
        if self.is_gpu() { guarded(work) } else { work() }
    }
}

impl Default for ComputeDevice {
    fn default() -> Self {
        Self::cpu()
    }
}

/// The adapters of this machine, in the order of `gpu:N`.
///
/// # Errors
/// When a driver panics while it starts.
pub(crate) fn adapters() -> Result<Vec<Adapter>> {
    guarded(|| Ok(device::adapters()))
}

/// Calls of [`guarded`] in progress.
static NUM_GUARDS: AtomicUsize = AtomicUsize::new(0);

/// The first panic under a guard: a thread of the driver's fails first, ours for want of its answer.
static FIRST_PANIC: Mutex<Option<Panic>> = Mutex::new(None);

/// What a panic said.
#[derive(Debug)]
struct Panic {
    /// Message and place.
    said: String,
    /// Whether it is a mistake of this program, not what the layers below do when the device fails.
    is_ours: bool,
}

impl From<Panic> for Failure {
    fn from(panic: Panic) -> Self {
        if panic.is_ours {
            return Self::new(format!("internal error: {}", panic.said))
                .hint("this is a mistake in gazesplat: please report it, with the command and the output of `-v`");
        }
        gazesplat_render::Error::device(&panic.said).into()
    }
}

fn first_panic() -> MutexGuard<'static, Option<Panic>> {
    FIRST_PANIC.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Does `work` and turns a panic into an error. Panics of all threads are kept instead of printed meanwhile.
fn guarded<T>(work: impl FnOnce() -> Result<T>) -> Result<T> {
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let unguarded = panic::take_hook();
        panic::set_hook(Box::new(move |info| match NUM_GUARDS.load(Ordering::SeqCst) {
            0 => unguarded(info),
            _ => keep(info),
        }));
    });
    if NUM_GUARDS.fetch_add(1, Ordering::SeqCst) == 0 {
        // A panic of another thread under an earlier guard that nevertheless got its answer. In a guard within another
        // it stays: it may be why the inner one fails.
        *first_panic() = None;
    }
    // Nothing that a panic left half-changed is used afterwards, but for the last model, which is checked.
    let caught = panic::catch_unwind(AssertUnwindSafe(work));
    NUM_GUARDS.fetch_sub(1, Ordering::SeqCst);
    caught.unwrap_or_else(|payload| {
        let first = first_panic().take();
        Err(first.unwrap_or_else(|| Panic { said: text_of(payload.as_ref()).to_owned(), is_ours: false }).into())
    })
}

fn keep(info: &PanicHookInfo<'_>) {
    let message = text_of(info.payload());
    // Burn's advice to its callers is none to ours.
    let said = message.split_once(BURN_ADVICE).map_or(message, |(_, cause)| cause);
    let place = info.location().map_or_else(String::new, |l| format!(" ({}:{})", in_crate(l.file()), l.line()));
    // Without the rest of the message, which may be a backtrace: the place stays readable.
    let cause = said.split("\nBacktrace").next().unwrap_or_default();
    tracing::info!("panic{place}: {cause}");
    let is_ours = info.location().is_some_and(|l| is_our_file(l.file())) && !tells_device_error(message);
    first_panic().get_or_insert_with(|| Panic { said: format!("{cause}{place}"), is_ours });
}

/// What Burn says before the cause, when it panics for a device that failed.
const BURN_ADVICE: &str = "at runtime: ";

/// True for panics that have their place in our files, but not their cause: Burn's have that of their caller, and an
/// `expect` of ours may have met an [`Error::Device`](gazesplat_render::Error::Device), which it shows.
fn tells_device_error(message: &str) -> bool {
    message.contains(BURN_ADVICE) || message.contains("Device { message")
}

/// True for a source file of this workspace: cargo names those by their path from its root, all others by their full
/// path, in which our crates have our name when they are dependencies of another workspace.
fn is_our_file(file: &str) -> bool {
    let file = file.replace('\\', "/");
    match file.split_once("/registry/src/") {
        Some((_, within)) => within.split('/').nth(1).is_some_and(|name| name.starts_with("gazesplat")),
        None => file.starts_with("src/") || file.starts_with("crates/") || file.contains("gazesplat"),
    }
}

fn text_of(payload: &dyn Any) -> &str {
    payload
        .downcast_ref::<String>()
        .map(String::as_str)
        .or_else(|| payload.downcast_ref::<&str>().copied())
        .unwrap_or("a panic without a message")
}

/// A source path from the directory of its crate on: `…/crate-1.2.3/src/lib.rs` is `crate-1.2.3/src/lib.rs`.
fn in_crate(file: &str) -> &str {
    let Some(src) = file.rfind("/src/") else { return file };
    let start = file[..src].rfind('/').map_or(0, |slash| slash + 1);
    &file[start..]
}

#[cfg(test)]
mod tests {
    use super::{ComputeDevice, guarded, in_crate, is_our_file};
    use crate::Failure;
    use std::thread;
    use std::time::Duration;

    /// Panics in a file that is none of ours.
    fn panic_elsewhere() -> Duration {
        Duration::ZERO - Duration::from_secs(1)
    }

    // One test, since what panics say is kept in one place for the whole process.
    #[test]
    fn panic_under_guard_is_an_error_with_message_place_and_hint() {
        let report = guarded(|| Ok(panic_elsewhere())).expect_err("it panicked").report(false);
        assert!(report.starts_with("error: the GPU stopped: overflow when subtracting durations ("), "{report}");
        assert!(report.contains("\nhint: ") && report.contains("free memory of the card"), "{report}");

        // A mistake of ours is not put down to the card.
        let failure = guarded(|| -> crate::Result<()> { panic!("too few rows\nBacktrace:\n 1: main") });
        let report = failure.expect_err("it panicked").report(false);
        assert!(report.starts_with("error: internal error: too few rows (src/commands/device.rs:"), "{report}");
        assert!(report.contains("please report it") && !report.contains("the card"), "{report}");
        assert!(!report.contains("Backtrace"), "{report}");

        // Nor is what the card did put down to us, where our file is only where it shows.
        let lost = || Err::<u8, _>(gazesplat_render::Error::device(&"lost"));
        let failure = guarded(|| Ok(lost().expect("it fits"))).expect_err("it panicked");
        assert!(failure.message().starts_with("the GPU stopped: it fits: Device"), "{failure}");
        let failure = guarded(|| -> crate::Result<()> { panic!("use `try_into_data` to catch it at runtime: lost") });
        assert!(failure.expect_err("it panicked").message().starts_with("the GPU stopped: lost ("));

        // The cause is what the driver's thread said, not that it no longer answers.
        let failure = guarded(|| -> crate::Result<()> {
            let driver = thread::spawn(panic_elsewhere);
            driver.join().map_err(|_| Failure::new("unreachable")).expect("an answer");
            Ok(())
        });
        assert!(failure.expect_err("it panicked").message().contains("overflow when subtracting durations"));

        // A panic that a guard was told of and got over is not the cause under the next.
        let failure = guarded(|| -> crate::Result<()> {
            let _ = thread::spawn(panic_elsewhere).join();
            Err(Failure::new("the driver fell over"))
        });
        assert_eq!(failure.expect_err("it failed").message(), "the driver fell over");
        let failure = guarded(|| -> crate::Result<()> { panic!("another") }).expect_err("it panicked");
        assert!(failure.message().starts_with("internal error: another ("), "{failure}");

        assert_eq!(guarded(|| Ok(3)).expect("no panic"), 3);
        assert_eq!(guarded(|| Err::<(), _>(Failure::new("no"))).expect_err("refused").message(), "no");
    }

    #[test]
    fn the_cpu_is_told_as_such() {
        assert_eq!(ComputeDevice::cpu().describe(), "CPU");
    }

    #[test]
    fn files_of_this_workspace_are_ours() {
        for ours in [
            "crates/render/src/gpu.rs",
            "src\\commands\\train.rs",
            "/home/me/.cargo/registry/src/index/gazesplat-render-0.1.0/src/gpu.rs",
            "/home/me/.cargo/git/checkouts/gazesplat-12ab/34cd/crates/render/src/gpu.rs",
        ] {
            assert!(is_our_file(ours), "{ours}");
        }
        for other in [
            "/home/me/.cargo/registry/src/index/wgpu-29.0.0/src/lib.rs",
            "/home/gazesplat/.cargo/registry/src/index/wgpu-29.0.0/src/lib.rs",
            "/rustc/0123/library/std/src/thread/mod.rs",
        ] {
            assert!(!is_our_file(other), "{other}");
        }
    }

    #[test]
    fn source_paths_start_at_their_crate() {
        assert_eq!(in_crate("/home/me/.cargo/registry/src/index/wgpu-29.0.0/src/lib.rs"), "wgpu-29.0.0/src/lib.rs");
        assert_eq!(in_crate("crates/render/src/gpu.rs"), "render/src/gpu.rs");
        assert_eq!(in_crate("build.rs"), "build.rs");
    }
}
