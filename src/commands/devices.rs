//! `gazesplat info --devices`: what `--device` can name on this machine, and what the program would make of it.

use super::{device, vector_instructions};
use crate::console::{Console, bytes, grouped};
use crate::diagnostics::Result;
use gazesplat_render::device::Adapter;
use serde_json::{Value as Json, json};
use std::fmt::Write as _;

/// Tells the devices on standard output; without a GPU adapter, the remedy on standard error.
///
/// # Errors
/// When a driver panics while it starts, or standard output refuses.
pub(crate) fn tell(is_json: bool, console: &Console) -> Result<()> {
    let found = device::adapters()?;
    if found.is_empty() {
        console.warn(NO_ADAPTER);
    }
    let num_threads = rayon::current_num_threads();
    if is_json {
        let gpus: Vec<Json> = found.iter().enumerate().map(|(index, adapter)| to_json(index, adapter)).collect();
        let cpu = json!({ "num_threads": num_threads, "vector_instructions": vector_instructions() });
        console.json(&json!({ "cpu": cpu, "gpus": gpus }))
    } else {
        console.data(&table(num_threads, &found))
    }
}

/// Said where no adapter answers.
const NO_ADAPTER: &str = "no GPU adapter answers, `--device gpu` cannot be used: install the driver of your card (or, \
                          on Debian, the software driver `mesa-vulkan-drivers` with the loader `libvulkan1`)";

fn table(num_threads: usize, adapters: &[Adapter]) -> String {
    let mut text = String::new();
    // Writing into a `String` cannot fail.
    let _ = writeln!(text, "{:5}  {num_threads} threads, vector instructions {}", "cpu", vector_instructions());
    for (index, adapter) in adapters.iter().enumerate() {
        let _ = writeln!(text, "{:5}  {}", format!("gpu:{index}"), adapter.name);
        for (label, value) in facts(adapter) {
            let _ = writeln!(text, "{:7}{label:19}  {value}", "");
        }
    }
    text
}

fn facts(a: &Adapter) -> Vec<(&'static str, String)> {
    let [smallest, largest] = a.plane_sizes;
    let subgroup = match smallest == largest {
        true => smallest.to_string(),
        false => format!("{smallest} to {largest}"),
    };
    vec![
        ("kind", a.kind.to_owned()),
        ("API", a.api.clone()),
        ("driver", a.driver.clone()),
        ("largest buffer", bytes(a.max_buffer_bytes)),
        ("buffers per kernel", grouped(a.max_buffers as usize)),
        ("units per workgroup", grouped(a.max_units as usize)),
        ("workgroup memory", bytes(u64::from(a.max_shared_bytes))),
        ("workgroups per axis", grouped(a.max_workgroups as usize)),
        ("units per subgroup", subgroup),
        ("use", verdict(a)),
    ]
}

/// Whether the program can use the adapter, and when it does.
fn verdict(adapter: &Adapter) -> String {
    let name = if adapter.is_default { "by `--device gpu` and by its number" } else { "by its number" };
    match shortage(adapter) {
        Some((what, needed, has)) => format!("cannot be used, lacks {what}: needs {needed}, has {has}"),
        None if adapter.is_software() => format!("will be used {name}; for tests, `--device cpu` is faster"),
        None => format!("will be used {name}"),
    }
}

/// The first thing the adapter has too little of, how much the kernels need, and how much there is.
fn shortage(adapter: &Adapter) -> Option<(&'static str, u64, u64)> {
    match adapter.usable {
        Err(gazesplat_render::Error::Limit { what, needed, limit }) => Some((what, needed, limit)),
        _ => None,
    }
}

fn to_json(index: usize, a: &Adapter) -> Json {
    let lacks = shortage(a).map(|(what, needed, has)| json!({ "what": what, "needed": needed, "has": has }));
    json!({
        "device": format!("gpu:{index}"),
        "name": a.name,
        "kind": a.kind,
        "api": a.api,
        "driver": a.driver,
        "max_buffer_bytes": a.max_buffer_bytes,
        "max_buffers": a.max_buffers,
        "max_units": a.max_units,
        "max_shared_bytes": a.max_shared_bytes,
        "max_workgroups": a.max_workgroups,
        "subgroup_sizes": a.plane_sizes,
        "is_default": a.is_default,
        "is_usable": a.usable.is_ok(),
        "lacks": lacks,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use insta::assert_snapshot;

    fn adapter() -> Adapter {
        Adapter {
            name: "Example 9000".to_owned(),
            kind: "discrete GPU",
            api: "Vulkan".to_owned(),
            driver: "example 1.2.3".to_owned(),
            max_buffer_bytes: 2_147_483_644,
            max_buffers: 64,
            max_units: 1024,
            max_shared_bytes: 49_152,
            max_workgroups: 65_535,
            plane_sizes: [32, 64],
            is_default: true,
            usable: Ok(()),
        }
    }

    #[test]
    fn adapters_are_told_with_their_limits_and_their_use() {
        let small = Adapter {
            name: "Tiny".to_owned(),
            max_buffers: 4,
            plane_sizes: [8, 8],
            is_default: false,
            usable: Err(gazesplat_render::Error::Limit { what: "storage buffers of a kernel", needed: 8, limit: 4 }),
            ..adapter()
        };
        let text = table(2, &[adapter(), small]);
        assert_snapshot!(text.split_once('\n').expect("the line of the CPU").1, @r"
        gpu:0  Example 9000
               kind                 discrete GPU
               API                  Vulkan
               driver               example 1.2.3
               largest buffer       2.1 GB
               buffers per kernel   64
               units per workgroup  1,024
               workgroup memory     49.2 kB
               workgroups per axis  65,535
               units per subgroup   32 to 64
               use                  will be used by `--device gpu` and by its number
        gpu:1  Tiny
               kind                 discrete GPU
               API                  Vulkan
               driver               example 1.2.3
               largest buffer       2.1 GB
               buffers per kernel   4
               units per workgroup  1,024
               workgroup memory     49.2 kB
               workgroups per axis  65,535
               units per subgroup   8
               use                  cannot be used, lacks storage buffers of a kernel: needs 8, has 4
        ");
    }

    #[test]
    fn software_driver_is_told_as_slower() {
        assert!(verdict(&Adapter { kind: "software", ..adapter() }).contains("`--device cpu` is faster"));
    }
}
