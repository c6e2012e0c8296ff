//! Where a command computes: opened before any work, named, and guarded against the panics of a driver that fails.

use crate::console::Console;
use crate::diagnostics::Result;
use gazesplat_render::device::{Adapter, Device, adapters};
use gazesplat_render::{DeviceChoice, cpu_device, is_gpu};
use std::any::Any;
use std::panic::{self, AssertUnwindSafe, PanicHookInfo};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, Once, PoisonError};

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
        let device = guarded(|| Ok(choice.open()?))?;
        let is_chosen = |index: usize, adapter: &Adapter| match choice {
            DeviceChoice::GpuIndex(chosen) => index == chosen,
            DeviceChoice::Cpu | DeviceChoice::Gpu => adapter.is_default,
        };
        let opened = Self {
            device,
            adapter: adapters().into_iter().enumerate().find(|(index, adapter)| is_chosen(*index, adapter)),
        };
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

    /// Does `work`. On a GPU a panic becomes an error: the layers between us and the driver panic when the adapter is
    /// lost. On the CPU a panic is a mistake of ours and is shown as one.
    ///
    /// # Errors
    /// Those of `work`; when it panicked on a GPU, that the GPU stopped, with what was said.
    pub fn guard<T>(&self, work: impl FnOnce() -> Result<T>) -> Result<T> {
        if self.is_gpu() { guarded(work) } else { work() }
    }
}

impl Default for ComputeDevice {
    fn default() -> Self {
        Self::cpu()
    }
}

/// Calls of [`guarded`] in progress.
static NUM_GUARDS: AtomicUsize = AtomicUsize::new(0);

/// What the first panic under a guard said: a thread of the driver's fails first, ours for want of its answer.
static FIRST_PANIC: Mutex<Option<String>> = Mutex::new(None);

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
    NUM_GUARDS.fetch_add(1, Ordering::SeqCst);
    // Nothing that a panic left half-changed is used afterwards, but for the last model, which is checked.
    let caught = panic::catch_unwind(AssertUnwindSafe(work));
    NUM_GUARDS.fetch_sub(1, Ordering::SeqCst);
    caught.unwrap_or_else(|payload| {
        let first = FIRST_PANIC.lock().unwrap_or_else(PoisonError::into_inner).take();
        let said = first.unwrap_or_else(|| text_of(payload.as_ref()).to_owned());
        Err(gazesplat_render::Error::device(&said).into())
    })
}

fn keep(info: &PanicHookInfo<'_>) {
    let said = text_of(info.payload());
    // Burn's advice to its callers is none to ours.
    let said = said.split_once("at runtime: ").map_or(said, |(_, cause)| cause);
    let place = info.location().map_or_else(String::new, |l| format!(" ({}:{})", in_crate(l.file()), l.line()));
    // Without the rest of the message, which may be a backtrace: the place stays readable.
    let cause = said.split("\nBacktrace").next().unwrap_or_default();
    tracing::info!("panic{place}: {cause}");
    FIRST_PANIC.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert_with(|| format!("{cause}{place}"));
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
    use super::{ComputeDevice, guarded, in_crate};
    use crate::Failure;

    // One test, since what panics say is kept in one place for the whole process.
    #[test]
    fn panic_under_guard_is_an_error_with_message_place_and_hint() {
        let failure = guarded(|| -> crate::Result<()> { panic!("device lost\nBacktrace:\n 1: main") });
        let report = failure.expect_err("it panicked").report(false);
        assert!(report.starts_with("error: the GPU stopped: device lost (src/commands/device.rs:"), "{report}");
        assert!(!report.contains("Backtrace") && report.contains("\nhint: "), "{report}");

        // The cause is what the driver's thread said, not that it no longer answers.
        let failure = guarded(|| -> crate::Result<()> {
            let driver = std::thread::spawn(|| panic!("the driver fell over"));
            driver.join().map_err(|_| Failure::new("unreachable")).expect("an answer");
            Ok(())
        });
        assert!(failure.expect_err("it panicked").message().contains("the driver fell over"));
    }

    #[test]
    fn errors_and_results_pass_the_guard() {
        assert_eq!(guarded(|| Ok(3)).expect("no panic"), 3);
        assert_eq!(guarded(|| Err::<(), _>(Failure::new("no"))).expect_err("refused").message(), "no");
        assert_eq!(ComputeDevice::cpu().describe(), "CPU");
    }

    #[test]
    fn source_paths_start_at_their_crate() {
        assert_eq!(in_crate("/home/me/.cargo/registry/src/index/wgpu-29.0.0/src/lib.rs"), "wgpu-29.0.0/src/lib.rs");
        assert_eq!(in_crate("crates/render/src/gpu.rs"), "render/src/gpu.rs");
        assert_eq!(in_crate("build.rs"), "build.rs");
    }
}
