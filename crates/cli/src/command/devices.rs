//! The commands `devices` and `completions`.

use clap::Args;
use nertca_vk::error::{Error, Result};
use nertca_vk::gpu::capabilities::DeviceInfo;
use nertca_vk::gpu::details::{DeviceDetails, list_details};
use nertca_vk::gpu::device::list_devices;
use nertca_vk::gpu::memory::DeviceMemory;
use nertca_vk::kernels::tuning::Tuning;
use serde::Serialize;

/// Arguments of `devices`.
#[derive(Debug, Args)]
pub struct DevicesArgs {
    /// Print JSON instead of text, with all details of devices that a bug report needs.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `completions`.
#[derive(Debug, Args)]
pub struct CompletionsArgs {
    /// Shell to print completions for.
    pub shell: clap_complete::Shell,
}

#[derive(Serialize)]
struct Row {
    #[serde(flatten)]
    info: DeviceInfo,
    paths: Tuning,
    details: DeviceDetails,
}

/// Lists devices.
pub fn run(args: &DevicesArgs) -> Result<()> {
    let row = |(info, details): (DeviceInfo, DeviceDetails)| Row { paths: Tuning::for_device(&info), info, details };
    let rows: Vec<Row> = list_devices()?.into_iter().zip(list_details()?).map(row).collect();
    if args.json {
        out!("{}", nertca_vk::files::pretty_json(&rows)?);
    } else {
        for Row { info, paths, .. } in &rows {
            out!("{}: {} ({}, {})", info.index, info.name, info.kind, info.driver);
            out!("   uuid {}  Vulkan {}", info.uuid, info.api_version);
            out!(
                "   subgroup {}  shared memory {} KiB  workgroup {}  storage buffer {} MiB",
                info.subgroup_size,
                info.max_shared_memory >> 10,
                info.max_workgroup_invocations,
                info.max_storage_buffer_range >> 20
            );
            out!("   memory {}", DeviceMemory { bytes: info.device_memory, free: info.free_memory });
            out!(
                "   cooperative matrices {}  float16 {}  float atomics {}  64-bit integer atomics {}",
                match info.matrices.first() {
                    Some(s) => format!("{}x{}x{}", s.m, s.n, s.k),
                    None => "none".to_owned(),
                },
                info.float16,
                info.float_atomics,
                info.int64_atomics
            );
            match &info.unusable {
                Some(why) => out!("   not usable: {why}"),
                None => paths.reasons.iter().for_each(|r| out!("   - {r}")),
            }
        }
    }
    if rows.iter().all(|r| r.info.unusable.is_some()) {
        return Err(Error::NoDevice("install a Vulkan driver (Debian: mesa-vulkan-drivers for a CPU driver)".into()));
    }
    Ok(())
}

/// Prints shell completions for the program's command line.
pub fn completions(args: &CompletionsArgs, program: &mut clap::Command) -> Result<()> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, program, "nertca-vk", &mut script);
    out!("{}", String::from_utf8_lossy(&script).trim_end());
    Ok(())
}
