//! Drivers' statistics of the pipelines they compile, kept on demand: `VK_KHR_pipeline_executable_properties`.

use super::capabilities::DeviceInfo;
use super::device::{Gpu, Shared};
use super::lock::lock;
use super::pipeline::KernelCode;
use crate::error::{Error, Result};
use ash::{khr, vk};
use std::collections::BTreeMap;
use std::sync::Mutex;

/// Statistics of one built pipeline.
#[derive(Debug, Clone, PartialEq)]
pub struct PipelineStatistics {
    /// Name of the kernel.
    pub kernel: &'static str,
    /// Invocations of a workgroup.
    pub lanes: u32,
    /// Specialisation constants that were set.
    pub constants: BTreeMap<String, u32>,
    /// Invocations of a subgroup; none where the driver does not report them.
    pub subgroup_size: Option<u32>,
    /// Numbers under the driver's own names; empty where it reports none.
    pub numbers: BTreeMap<String, f64>,
}

/// Statistics of the pipelines built so far.
pub(super) struct StatisticsKeeper {
    /// Functions of the extension; none where the driver does not have it, in which case pipelines are listed without
    /// numbers.
    functions: Option<khr::pipeline_executable_properties::Device>,
    found: Mutex<Vec<PipelineStatistics>>,
}

impl StatisticsKeeper {
    pub(super) fn new(instance: &ash::Instance, device: &ash::Device, info: &DeviceInfo) -> StatisticsKeeper {
        let functions =
            info.pipeline_statistics.then(|| khr::pipeline_executable_properties::Device::new(instance, device));
        StatisticsKeeper { functions, found: Mutex::default() }
    }

    /// Returns the flags that a pipeline must be made with.
    pub(super) fn flags(&self) -> vk::PipelineCreateFlags {
        match self.functions {
            Some(_) => vk::PipelineCreateFlags::CAPTURE_STATISTICS_KHR,
            None => vk::PipelineCreateFlags::empty(),
        }
    }

    /// Adds a pipeline that was just made with [`StatisticsKeeper::flags`].
    pub(super) fn note(&self, raw: vk::Pipeline, code: &KernelCode, lanes: u32, spec: &[(&str, u32)]) -> Result<()> {
        let mut pipeline = PipelineStatistics {
            kernel: code.name,
            lanes,
            constants: spec.iter().map(|(name, value)| ((*name).to_owned(), *value)).collect(),
            subgroup_size: None,
            numbers: BTreeMap::new(),
        };
        if let Some(functions) = &self.functions {
            let about = vk::PipelineInfoKHR::default().pipeline(raw);
            // SAFETY: the device was made with the extension and its feature, and the pipeline from the device.
            let executables = unsafe { functions.get_pipeline_executable_properties(&about) }
                .map_err(Error::vulkan("vkGetPipelineExecutablePropertiesKHR", code.name))?;
            // The driver may have built a kernel for several subgroup sizes; it runs the last one.
            if let Some(last) = executables.len().checked_sub(1) {
                pipeline.subgroup_size = Some(executables[last].subgroup_size).filter(|size| *size > 0);
                let about = vk::PipelineExecutableInfoKHR::default().pipeline(raw).executable_index(last as u32);
                // SAFETY: the pipeline was made with the flag for statistics and has an executable of this index.
                let found = unsafe { functions.get_pipeline_executable_statistics(&about) }
                    .map_err(Error::vulkan("vkGetPipelineExecutableStatisticsKHR", code.name))?;
                pipeline.numbers = found.iter().filter_map(|s| Some((name(s)?, value(s)))).collect();
            }
        }
        lock(&self.found).push(pipeline);
        Ok(())
    }
}

fn name(statistic: &vk::PipelineExecutableStatisticKHR<'_>) -> Option<String> {
    statistic.name_as_c_str().ok().map(|name| name.to_string_lossy().into_owned())
}

fn value(statistic: &vk::PipelineExecutableStatisticKHR<'_>) -> f64 {
    use vk::PipelineExecutableStatisticFormatKHR as Format;
    // SAFETY: the format says which of the union's members the driver has written.
    unsafe {
        match statistic.format {
            Format::BOOL32 => f64::from(statistic.value.b32),
            Format::INT64 => statistic.value.i64 as f64,
            Format::UINT64 => statistic.value.u64 as f64,
            _ => statistic.value.f64,
        }
    }
}

impl Shared {
    /// Returns the flags for new pipelines.
    pub(super) fn pipeline_flags(&self) -> vk::PipelineCreateFlags {
        self.statistics.as_ref().map_or(vk::PipelineCreateFlags::empty(), StatisticsKeeper::flags)
    }
}

impl Gpu {
    /// Returns the pipelines built so far, in their order; empty unless the device was opened to keep statistics.
    pub fn pipeline_statistics(&self) -> Vec<PipelineStatistics> {
        self.shared.statistics.as_ref().map_or(Vec::new(), |keeper| lock(&keeper.found).clone())
    }
}
