//! Where tensors live: the CPU, or a GPU adapter reached through wgpu (Vulkan, Metal, DirectX 12).

use crate::error::{Error, Result};
use burn::backend::DispatchDevice;
use std::fmt;
use std::str::FromStr;

pub use burn::tensor::Device;

/// A device as people name it: `cpu`, `gpu` or `gpu:N`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DeviceChoice {
    /// The CPU, through burn-ndarray.
    #[default]
    Cpu,
    /// The best GPU adapter: the first of [`adapters`] that is not a software driver, else the first.
    Gpu,
    /// The adapter of that number in [`adapters`].
    GpuIndex(usize),
}

impl FromStr for DeviceChoice {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let refused = || format!("expected `cpu`, `gpu` or `gpu:N`, found `{text}`");
        match text {
            "cpu" => Ok(Self::Cpu),
            "gpu" => Ok(Self::Gpu),
            _ => text.strip_prefix("gpu:").and_then(parse_index).map(Self::GpuIndex).ok_or_else(refused),
        }
    }
}

/// A number as [`DeviceChoice`] writes it: each has one spelling, `+0` and `00` are none.
fn parse_index(text: &str) -> Option<usize> {
    let is_plain = text.bytes().all(|b| b.is_ascii_digit()) && (text == "0" || !text.starts_with('0'));
    if is_plain { text.parse().ok() } else { None }
}

impl fmt::Display for DeviceChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cpu => f.write_str("cpu"),
            Self::Gpu => f.write_str("gpu"),
            Self::GpuIndex(index) => write!(f, "gpu:{index}"),
        }
    }
}

impl DeviceChoice {
    /// Opens the device.
    ///
    /// # Errors
    /// [`Error::NoAdapter`] when there is no such GPU, or this build knows none; [`Error::Limit`] when it lacks what the
    /// kernels need.
    pub fn open(self) -> Result<Device> {
        match self {
            Self::Cpu => Ok(cpu_device()),
            Self::Gpu => gpu_device(None),
            Self::GpuIndex(index) => gpu_device(Some(index)),
        }
    }
}

/// The CPU as a Burn device: burn-ndarray, the default CPU backend of this project.
pub fn cpu_device() -> Device {
    Device::ndarray()
}

/// The CPU through Burn's successor of burn-ndarray; the kernels are the same.
#[cfg(feature = "flex")]
pub fn flex_device() -> Device {
    Device::flex()
}

/// True for a device whose work is submitted and read back, rather than done in place.
pub fn is_gpu(device: &Device) -> bool {
    fn of(device: &DispatchDevice) -> bool {
        match device {
            #[cfg(feature = "gpu")]
            DispatchDevice::Cube(_) => true,
            DispatchDevice::Autodiff(inner) => of(inner),
            _ => false,
        }
    }
    of(device.as_dispatch())
}

/// A GPU adapter of this machine.
#[derive(Debug, Clone, PartialEq)]
pub struct Adapter {
    /// Name, as the driver gives it.
    pub name: String,
    /// `discrete GPU`, `integrated GPU`, `virtual GPU`, `software` or `other`.
    pub kind: &'static str,
    /// Graphics API, as in `Vulkan`.
    pub api: String,
    /// Driver and its version.
    pub driver: String,
    /// Largest buffer a kernel can be given, bytes.
    pub max_buffer_bytes: u64,
    /// Buffers one kernel can be given.
    pub max_buffers: u32,
    /// Units (threads) of one workgroup.
    pub max_units: u32,
    /// Workgroup memory, bytes.
    pub max_shared_bytes: u32,
    /// Workgroups along one axis of a dispatch.
    pub max_workgroups: u32,
    /// Subgroup (plane) sizes.
    pub plane_sizes: [u32; 2],
    /// True for the adapter that `gpu` without a number means.
    pub is_default: bool,
    /// Whether it has what the kernels need; else [`Error::Limit`] with the first thing it has too little of.
    pub usable: Result<()>,
}

impl Adapter {
    /// True for a driver that computes on the CPU: for tests, slower than the CPU kernels.
    pub fn is_software(&self) -> bool {
        self.kind == SOFTWARE
    }
}

/// The [`Adapter::kind`] of a driver that computes on the CPU.
const SOFTWARE: &str = "software";

/// The GPU adapters of this machine, in the order of `gpu:N`; empty without a graphics driver.
#[cfg(feature = "gpu")]
pub fn adapters() -> Vec<Adapter> {
    wgpu_adapters::list()
}

/// The GPU adapters of this machine: none that this build knows.
#[cfg(not(feature = "gpu"))]
pub fn adapters() -> Vec<Adapter> {
    Vec::new()
}

/// Opens the GPU adapter `index` of [`adapters`], the default one for `None`. Opening it again gives the same device.
///
/// # Errors
/// As [`DeviceChoice::open`].
#[cfg(feature = "gpu")]
pub fn gpu_device(index: Option<usize>) -> Result<Device> {
    wgpu_adapters::open(index)
}

/// A GPU: none in this build.
///
/// # Errors
/// Always [`Error::NoAdapter`].
#[cfg(not(feature = "gpu"))]
pub fn gpu_device(_index: Option<usize>) -> Result<Device> {
    Err(Error::NoAdapter { message: "this program was built without the feature `gpu`".into() })
}

#[cfg(feature = "gpu")]
mod wgpu_adapters {
    use super::{Adapter, Device, Error, Result, SOFTWARE};
    use crate::gpu::{check_device, check_limits};
    use burn::tensor::DeviceKind;
    use burn_wgpu::WgpuBackend;
    use burn_wgpu::wgpu::{AdapterInfo, Backend, DeviceType, Instance, InstanceDescriptor, Limits};
    use std::sync::{Mutex, PoisonError};

    /// Graphics APIs with compute shaders of the size our kernels need, best first. OpenGL is left out: its limits on
    /// buffers per kernel are too low.
    const APIS: [(Backend, WgpuBackend); 3] = [
        (Backend::Vulkan, WgpuBackend::Vulkan),
        (Backend::Metal, WgpuBackend::Metal),
        (Backend::Dx12, WgpuBackend::Dx12),
    ];

    /// The first API with a hardware adapter, else the first with any, and its adapters.
    fn settled() -> Option<(WgpuBackend, Vec<(AdapterInfo, Limits)>)> {
        let mut software = None;
        for (api, pinned) in APIS {
            let instance = Instance::new(InstanceDescriptor {
                backends: api.into(),
                ..InstanceDescriptor::new_without_display_handle()
            });
            let found = cubecl::future::block_on(instance.enumerate_adapters(api.into()));
            let found: Vec<_> = found.iter().map(|a| (a.get_info(), a.limits())).collect();
            if found.iter().any(|(info, _)| info.device_type != DeviceType::Cpu) {
                return Some((pinned, found));
            }
            if software.is_none() && !found.is_empty() {
                software = Some((pinned, found));
            }
        }
        software
    }

    fn default_index(found: &[(AdapterInfo, Limits)]) -> usize {
        let rank = |info: &AdapterInfo| match info.device_type {
            DeviceType::DiscreteGpu => 0,
            DeviceType::IntegratedGpu => 1,
            DeviceType::VirtualGpu => 2,
            DeviceType::Other => 3,
            DeviceType::Cpu => 4,
        };
        (0..found.len()).min_by_key(|&i| rank(&found[i].0)).unwrap_or(0)
    }

    pub(super) fn list() -> Vec<Adapter> {
        let found = settled().map(|(_, found)| found).unwrap_or_default();
        let default = default_index(&found);
        found
            .into_iter()
            .enumerate()
            .map(|(index, (info, limits))| Adapter {
                name: info.name,
                kind: match info.device_type {
                    DeviceType::DiscreteGpu => "discrete GPU",
                    DeviceType::IntegratedGpu => "integrated GPU",
                    DeviceType::VirtualGpu => "virtual GPU",
                    DeviceType::Cpu => SOFTWARE,
                    DeviceType::Other => "other",
                },
                api: format!("{:?}", info.backend),
                driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
                max_buffer_bytes: limits.max_storage_buffer_binding_size.min(limits.max_buffer_size),
                max_buffers: limits.max_storage_buffers_per_shader_stage,
                max_units: limits.max_compute_invocations_per_workgroup.min(limits.max_compute_workgroup_size_x),
                max_shared_bytes: limits.max_compute_workgroup_storage_size,
                max_workgroups: limits.max_compute_workgroups_per_dimension,
                plane_sizes: [info.subgroup_min_size, info.subgroup_max_size],
                is_default: index == default,
                usable: check_limits(
                    limits.max_compute_invocations_per_workgroup.min(limits.max_compute_workgroup_size_x),
                    limits.max_storage_buffers_per_shader_stage,
                    limits.max_compute_workgroup_storage_size as usize,
                ),
            })
            .collect()
    }

    /// Devices opened so far, by index: an adapter can be opened once only.
    static OPENED: Mutex<Vec<(usize, Device)>> = Mutex::new(Vec::new());

    pub(super) fn open(index: Option<usize>) -> Result<Device> {
        let mut opened = OPENED.lock().unwrap_or_else(PoisonError::into_inner);
        let refused = |message: String| Error::NoAdapter { message };
        let (api, found) =
            settled().ok_or_else(|| refused("no Vulkan, Metal or DirectX 12 driver answers on this machine".into()))?;
        let index = index.unwrap_or_else(|| default_index(&found));
        if let Some((_, device)) = opened.iter().find(|(i, _)| *i == index) {
            return Ok(device.clone());
        }
        let Some((info, _)) = found.get(index) else {
            let last = found.len() - 1;
            let others = if last == 0 { "only gpu:0".to_owned() } else { format!("gpu:0 to gpu:{last}") };
            return Err(refused(format!("gpu:{index} was asked for, this machine has {others}")));
        };
        let same_kind = found[..index].iter().filter(|(i, _)| i.device_type == info.device_type).count();
        let kind = match info.device_type {
            DeviceType::DiscreteGpu => DeviceKind::DiscreteGpu(same_kind),
            DeviceType::IntegratedGpu => DeviceKind::IntegratedGpu(same_kind),
            DeviceType::VirtualGpu => DeviceKind::VirtualGpu(same_kind),
            DeviceType::Cpu if same_kind == 0 => DeviceKind::Cpu,
            DeviceType::Cpu => return Err(refused(format!("gpu:{index} is a second software driver: name the first"))),
            DeviceType::Other if index == default_index(&found) => DeviceKind::DefaultDevice,
            DeviceType::Other => {
                return Err(refused(format!("gpu:{index} does not say what it is, and is not the first")));
            }
        };
        let options = Device::wgpu_options().device_kind(kind).graphics_api(api);
        let device = options.init().map_err(|e| refused(format!("gpu:{index} ({}): {e}", info.name)))?;
        check_device(&device)?;
        opened.push((index, device.clone()));
        Ok(device)
    }
}

#[cfg(test)]
mod tests {
    use super::DeviceChoice;

    #[test]
    fn choices_read_back_and_nonsense_is_refused() {
        for choice in [DeviceChoice::Cpu, DeviceChoice::Gpu, DeviceChoice::GpuIndex(0), DeviceChoice::GpuIndex(10)] {
            assert_eq!(choice.to_string().parse(), Ok(choice));
        }
        for bad in ["", "GPU", "gpu:", "gpu:-1", "gpu:+0", "gpu:00", "gpu:01", "gpu: 0", "gpu:1 ", "cuda", "cpu:0"] {
            assert!(bad.parse::<DeviceChoice>().is_err(), "{bad}");
        }
    }
}
