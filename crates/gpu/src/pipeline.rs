//! Compute pipelines: SPIR-V, specialisation constants, binding table, limit checks.

use super::device::{Gpu, Shared};
use super::lock::lock;
use crate::error::{Error, Result};
use ash::vk;
use std::collections::HashMap;
use std::sync::{Arc, Mutex};

/// A compiled shader with its reflected declarations.
#[derive(Debug)]
pub struct KernelCode {
    /// Stage name, which shader file, debug label and bench row share.
    pub name: &'static str,
    /// Shader that this is a build of; equal to `name` for a shader without variants.
    pub shader: &'static str,
    /// SPIR-V bytes.
    pub spirv: &'static [u8],
    /// Bytes of push constants that the caller passes.
    pub push_bytes: u32,
    /// Buffers whose device address is also pushed, with its offset.
    pub addresses: &'static [(&'static str, u32)],
    /// Buffers the shader uses.
    pub bindings: &'static [BindingCode],
    /// Name and id of each specialisation constant.
    pub spec_constants: &'static [(&'static str, u32)],
}

/// Kind of a shader's binding.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BindingKind {
    /// A storage buffer.
    Storage,
    /// A buffer of few numbers that do not change during a dispatch.
    Uniform,
    /// A buffer read through a texel-buffer view.
    Texel,
    /// A 3D image with its sampler.
    Volume,
}

/// One buffer or image a shader uses.
#[derive(Debug)]
pub struct BindingCode {
    /// Binding number.
    pub slot: u32,
    /// Name in the shader.
    pub name: &'static str,
    /// Kind of the binding.
    pub kind: BindingKind,
    /// Whether the shader may read it.
    pub reads: bool,
    /// Whether the shader may write it.
    pub writes: bool,
}

impl KernelCode {
    /// Returns the bytes of push constants, including addresses.
    pub(super) fn all_push_bytes(&self) -> u32 {
        self.addresses.iter().map(|(_, offset)| offset + 8).fold(self.push_bytes, u32::max)
    }
}

/// A pipeline ready to be recorded.
pub struct Pipeline {
    gpu: Arc<Shared>,
    pub(super) code: &'static KernelCode,
    pub(super) raw: vk::Pipeline,
    pub(super) layout: vk::PipelineLayout,
    pub(super) set_layout: vk::DescriptorSetLayout,
    /// Invocations per workgroup along x.
    pub local_size: u32,
}

/// Pipelines are kept while this exists; see [`Gpu::keep_pipelines`].
pub struct KeptPipelines {
    _keeper: Arc<Keeper>,
}

/// Pipelines by what they were built from. They belong to the device's user, because they keep the device alive.
#[derive(Default)]
pub(super) struct Keeper {
    pipelines: Mutex<HashMap<PipelineKey, Arc<Pipeline>>>,
}

#[derive(PartialEq, Eq, Hash)]
struct PipelineKey {
    name: &'static str,
    local_size: u32,
    spec: Vec<(String, u32)>,
    subgroups: Subgroups,
}

/// Requirements of a kernel on its subgroups.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Subgroups {
    /// No requirement.
    Any,
    /// All subgroups full, with this many invocations.
    Full(u32),
}

impl Gpu {
    /// Builds a pipeline. `spec` gives values by name; other constants keep the shader's default.
    ///
    /// # Errors
    /// [`Error::Internal`] for an unknown constant, [`Error::NoDevice`] when the kernel binds more than the device allows,
    /// [`Error::Vulkan`] when the driver refuses the shader.
    pub fn pipeline(&self, code: &'static KernelCode, local_size: u32, spec: &[(&str, u32)]) -> Result<Arc<Pipeline>> {
        self.kept_or_new(code, local_size, spec, Subgroups::Any)
    }

    /// Builds a pipeline like [`Gpu::pipeline`], with full subgroups of the size
    /// [`super::capabilities::DeviceInfo::matrix_subgroup`]. It is for cooperative matrices, which only devices with
    /// [`super::capabilities::DeviceInfo::matrices`] have.
    ///
    /// # Errors
    /// Fails like [`Gpu::pipeline`].
    pub fn matrix_pipeline(
        &self,
        code: &'static KernelCode,
        local_size: u32,
        spec: &[(&str, u32)],
    ) -> Result<Arc<Pipeline>> {
        if self.info().matrices.is_empty() {
            return Err(Error::Internal(format!(
                "kernel {}: {} has no cooperative matrices",
                code.name,
                self.info().name
            )));
        }
        self.kept_or_new(code, local_size, spec, Subgroups::Full(self.info().matrix_subgroup))
    }

    /// Builds a kernel whose subgroups must be full, with `size` invocations each: [`DeviceInfo::full_subgroups`] or
    /// [`DeviceInfo::small_subgroups`].
    ///
    /// [`DeviceInfo::full_subgroups`]: crate::capabilities::DeviceInfo::full_subgroups
    /// [`DeviceInfo::small_subgroups`]: crate::capabilities::DeviceInfo::small_subgroups
    ///
    /// # Errors
    /// Fails like [`Gpu::pipeline`]; [`Error::Internal`] where subgroups cannot be full.
    pub fn subgroup_pipeline(
        &self,
        code: &'static KernelCode,
        local_size: u32,
        size: u32,
        spec: &[(&str, u32)],
    ) -> Result<Arc<Pipeline>> {
        let info = self.info();
        if ![info.full_subgroups, info.small_subgroups].contains(&Some(size))
            || !local_size.is_multiple_of(size)
            || local_size / size > info.max_workgroup_subgroups
        {
            let problem = format!("{local_size} invocations are not a multiple of the subgroup size, {size}");
            return Err(Error::Internal(format!("kernel {}: {problem}", code.name)));
        }
        self.kept_or_new(code, local_size, spec, Subgroups::Full(size))
    }

    /// Keeps the pipelines that are built from now on, so that building one again takes no time, until the result and those of all
    /// other calls are dropped. A session that fits again and again needs the same ones each time.
    #[must_use]
    pub fn keep_pipelines(&self) -> KeptPipelines {
        let mut kept = lock(&self.shared.kept_pipelines);
        let keeper = kept.upgrade().unwrap_or_default();
        *kept = Arc::downgrade(&keeper);
        KeptPipelines { _keeper: keeper }
    }

    fn kept_or_new(
        &self,
        code: &'static KernelCode,
        local_size: u32,
        spec: &[(&str, u32)],
        subgroups: Subgroups,
    ) -> Result<Arc<Pipeline>> {
        let keeper = lock(&self.shared.kept_pipelines).upgrade();
        let Some(keeper) = keeper else {
            return Ok(Arc::new(self.make_pipeline(code, local_size, spec, subgroups)?));
        };
        let spec_values = spec.iter().map(|(name, value)| ((*name).to_owned(), *value)).collect();
        let key = PipelineKey { name: code.name, local_size, spec: spec_values, subgroups };
        if let Some(known) = lock(&keeper.pipelines).get(&key) {
            return Ok(known.clone());
        }
        // Another thread may build the same meanwhile: then one of them is kept.
        let made = Arc::new(self.make_pipeline(code, local_size, spec, subgroups)?);
        lock(&keeper.pipelines).insert(key, made.clone());
        Ok(made)
    }

    fn make_pipeline(
        &self,
        code: &'static KernelCode,
        local_size: u32,
        spec: &[(&str, u32)],
        subgroups: Subgroups,
    ) -> Result<Pipeline> {
        let info = self.info();
        if local_size == 0
            || local_size > info.max_workgroup_invocations
            || code.all_push_bytes() > info.max_push_constants
        {
            return Err(Error::Internal(format!(
                "kernel {}: {local_size} invocations and {} bytes of push constants exceed the limits of {}",
                code.name,
                code.all_push_bytes(),
                info.name
            )));
        }
        if !code.addresses.is_empty() && !info.buffer_device_address {
            return Err(Error::Internal(format!(
                "kernel {}: {} does not support buffer addresses",
                code.name, info.name
            )));
        }
        let buffers = code.bindings.iter().filter(|b| descriptor_type(b) == vk::DescriptorType::STORAGE_BUFFER).count();
        if buffers > info.max_storage_buffers as usize {
            return Err(Error::NoDevice(format!(
                "{}: kernel {} binds {buffers} storage buffers, but the device allows {}",
                info.name, code.name, info.max_storage_buffers
            )));
        }
        let mut entries = Vec::new();
        let mut values: Vec<u32> = Vec::new();
        for (name, value) in [("local_size_x", local_size)].iter().chain(spec) {
            let (_, id) = code.spec_constants.iter().find(|(n, _)| n == name).ok_or_else(|| {
                Error::Internal(format!("kernel {} has no specialisation constant `{name}`", code.name))
            })?;
            entries
                .push(vk::SpecializationMapEntry::default().constant_id(*id).offset(4 * values.len() as u32).size(4));
            values.push(*value);
        }
        let shared = &self.shared;
        let device = &shared.device;
        let slots: Vec<_> = code
            .bindings
            .iter()
            .map(|b| {
                vk::DescriptorSetLayoutBinding::default()
                    .binding(b.slot)
                    .descriptor_type(descriptor_type(b))
                    .descriptor_count(1)
                    .stage_flags(vk::ShaderStageFlags::COMPUTE)
            })
            .collect();
        shared.track();
        // From here on `Pipeline::drop` cleans up; null handles are ignored by Vulkan's destroy calls.
        let mut pipeline = Pipeline {
            gpu: shared.clone(),
            code,
            raw: vk::Pipeline::null(),
            layout: vk::PipelineLayout::null(),
            set_layout: vk::DescriptorSetLayout::null(),
            local_size,
        };
        let create = vk::DescriptorSetLayoutCreateInfo::default().bindings(&slots);
        // SAFETY: the create info and `slots` live until the call returns; `pipeline` keeps the device alive.
        pipeline.set_layout = unsafe { device.create_descriptor_set_layout(&create, None) }
            .map_err(Error::vulkan("vkCreateDescriptorSetLayout", code.name))?;
        let sets = [pipeline.set_layout];
        let ranges =
            [vk::PushConstantRange::default().stage_flags(vk::ShaderStageFlags::COMPUTE).size(code.all_push_bytes())];
        let mut create = vk::PipelineLayoutCreateInfo::default().set_layouts(&sets);
        if code.all_push_bytes() > 0 {
            create = create.push_constant_ranges(&ranges);
        }
        // SAFETY: the create info, `sets` and `ranges` live until the call returns; the set layout was just made.
        pipeline.layout = unsafe { device.create_pipeline_layout(&create, None) }
            .map_err(Error::vulkan("vkCreatePipelineLayout", code.name))?;
        let words: Vec<u32> = bytemuck::pod_collect_to_vec(code.spirv);
        // SAFETY: the words are valid SPIR-V, made by shaderc at build time.
        let module = unsafe { device.create_shader_module(&vk::ShaderModuleCreateInfo::default().code(&words), None) }
            .map_err(Error::vulkan("vkCreateShaderModule", code.name))?;
        let specialization =
            vk::SpecializationInfo::default().map_entries(&entries).data(bytemuck::cast_slice(&values));
        let mut subgroup_size = vk::PipelineShaderStageRequiredSubgroupSizeCreateInfo::default();
        let mut stage = vk::PipelineShaderStageCreateInfo::default()
            .stage(vk::ShaderStageFlags::COMPUTE)
            .module(module)
            .name(c"main")
            .specialization_info(&specialization);
        if let Subgroups::Full(size) = subgroups {
            stage = stage.flags(vk::PipelineShaderStageCreateFlags::REQUIRE_FULL_SUBGROUPS);
            if info.asks_for_subgroups {
                subgroup_size = subgroup_size.required_subgroup_size(size);
                stage = stage.push_next(&mut subgroup_size);
            }
        }
        let create = [vk::ComputePipelineCreateInfo::default()
            .flags(shared.pipeline_flags())
            .stage(stage)
            .layout(pipeline.layout)];
        // Before the call, so that a kernel on which a driver spends minutes can be named.
        tracing::debug!("compiling {} for {local_size} invocations", code.name);
        // SAFETY: module and layout were just made; entries and values live until the call returns, and the entries lie
        // inside the values.
        let made = unsafe { device.create_compute_pipelines(shared.pipeline_cache, &create, None) };
        // SAFETY: the module was made above and is not needed after pipeline creation, whether that succeeded or not.
        unsafe { device.destroy_shader_module(module, None) };
        pipeline.raw = made
            .map_err(|(_, code)| code)
            .map_err(Error::vulkan("vkCreateComputePipelines", code.name))?
            .into_iter()
            .next()
            .unwrap_or_default();
        shared.set_name(pipeline.raw, code.name);
        if let Some(keeper) = &shared.statistics {
            keeper.note(pipeline.raw, code, local_size, spec)?;
        }
        Ok(pipeline)
    }
}

pub(super) fn descriptor_type(binding: &BindingCode) -> vk::DescriptorType {
    match binding.kind {
        BindingKind::Storage => vk::DescriptorType::STORAGE_BUFFER,
        BindingKind::Uniform => vk::DescriptorType::UNIFORM_BUFFER,
        BindingKind::Texel => vk::DescriptorType::UNIFORM_TEXEL_BUFFER,
        BindingKind::Volume => vk::DescriptorType::COMBINED_IMAGE_SAMPLER,
    }
}

impl Drop for Pipeline {
    fn drop(&mut self) {
        // SAFETY: recordings hold an `Arc` of the pipelines they use, so no submit in flight needs this one; null handles
        // are ignored.
        unsafe {
            self.gpu.device.destroy_pipeline(self.raw, None);
            self.gpu.device.destroy_pipeline_layout(self.layout, None);
            self.gpu.device.destroy_descriptor_set_layout(self.set_layout, None);
        }
        self.gpu.untrack();
    }
}
