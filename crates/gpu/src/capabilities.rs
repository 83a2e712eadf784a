//! Capabilities of a device, with workarounds for faults of drivers.

use super::memory::DeviceMemory;
use ash::{ext, khr, nv, vk};
use serde::Serialize;
use std::ffi::CStr;
use std::fmt;

/// Properties and capabilities of a device that this engine uses.
#[derive(Debug, Clone, Serialize)]
pub struct DeviceInfo {
    /// Position in the loader's list.
    pub index: usize,
    /// Name given by the driver.
    pub name: String,
    /// Kind of processor.
    pub kind: DeviceKind,
    /// Manufacturer.
    pub vendor: Vendor,
    /// Device UUID, hexadecimal.
    pub uuid: String,
    /// Driver name and version text.
    pub driver: String,
    /// Supported Vulkan version.
    pub api_version: String,
    /// Whether the driver is Mesa's llvmpipe (CPU).
    pub is_llvmpipe: bool,
    /// Major version of Mesa, when the driver is from Mesa.
    pub mesa_major: Option<u32>,
    /// Default subgroup size.
    pub subgroup_size: u32,
    /// Size of the full subgroups that a compute shader's workgroup can be required to consist of, where they also exchange
    /// values (shuffles); none where the device lacks either ability.
    pub full_subgroups: Option<u32>,
    /// Subgroup size for workgroups that are smaller than `full_subgroups`; none where full subgroups are not larger than 32 or
    /// no smaller size can be requested.
    pub small_subgroups: Option<u32>,
    /// Subgroup size that kernels on matrices require.
    pub matrix_subgroup: u32,
    /// Whether shaders can require a subgroup size.
    pub asks_for_subgroups: bool,
    /// Maximum number of subgroups of a workgroup that requires a subgroup size.
    pub max_workgroup_subgroups: u32,
    /// Maximum shared memory of a workgroup, bytes.
    pub max_shared_memory: u32,
    /// Maximum number of invocations of a workgroup.
    pub max_workgroup_invocations: u32,
    /// Maximum number of workgroups of one dispatch along x.
    pub max_workgroup_count: u32,
    /// Maximum range of one storage buffer binding, bytes.
    pub max_storage_buffer_range: u32,
    /// Maximum number of storage buffers that a kernel may bind: the smaller of the limits per stage and per set.
    pub max_storage_buffers: u32,
    /// Maximum number of elements of one texel buffer.
    pub max_texel_buffer_elements: u32,
    /// Maximum number of bytes of push constants.
    pub max_push_constants: u32,
    /// Nanoseconds per timestamp tick; 0 when the queue has no timestamps.
    pub timestamp_period_ns: f32,
    /// Number of valid bits of the queue's timestamps.
    pub timestamp_bits: u32,
    /// Size of the largest device-local heap, bytes.
    pub device_memory: u64,
    /// Part of that heap that this process could allocate when the device was described, bytes; none where the device does not
    /// report it (`VK_EXT_memory_budget`). [`super::device::Gpu::memory`] reads the current value.
    pub free_memory: Option<u64>,
    /// Whether shaders can read buffers through their addresses.
    pub buffer_device_address: bool,
    /// Shapes of cooperative matrices with f16 operands and f32 sums at subgroup scope; empty when the device lacks them or
    /// something else that the kernels need (16-bit floats, Vulkan's memory model, subgroups of a fixed size).
    pub matrices: Vec<MatrixShape>,
    /// Number of streaming multiprocessors or similar units; 0 when the driver does not report it.
    pub multiprocessors: u32,
    /// Whether the device offers 16-bit float arithmetic.
    pub float16: bool,
    /// Whether the device offers float atomics on buffers.
    pub float_atomics: bool,
    /// Whether the device adds 64-bit integers in buffers atomically (`shaderInt64`, `shaderBufferInt64Atomics`) without
    /// crashing.
    pub int64_atomics: bool,
    /// Whether memory can be exported as file descriptors (`VK_KHR_external_memory_fd`).
    pub external_memory_fd: bool,
    /// Whether semaphores can be exported as file descriptors (`VK_KHR_external_semaphore_fd`).
    pub external_semaphore_fd: bool,
    /// Whether the driver reports statistics of the pipelines it compiles (`VK_KHR_pipeline_executable_properties`).
    pub pipeline_statistics: bool,
    /// Whether the driver implements Vulkan on top of another interface, as on macOS (`VK_KHR_portability_subset`).
    pub portability_subset: bool,
    /// Reason why this device cannot be used; none if it can.
    pub unusable: Option<String>,
}

/// Manufacturers of devices for which sizes of kernels are chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Vendor {
    /// AMD.
    Amd,
    /// Intel.
    Intel,
    /// NVIDIA.
    Nvidia,
    /// Any other manufacturer, including drivers that compute on a CPU.
    Other,
}

impl Vendor {
    /// Returns the manufacturer with this PCI id.
    fn of(id: u32) -> Vendor {
        match id {
            0x1002 => Vendor::Amd,
            0x8086 => Vendor::Intel,
            0x10de => Vendor::Nvidia,
            _ => Vendor::Other,
        }
    }
}

impl DeviceInfo {
    /// Tells whether the device is the host's own processor.
    pub fn is_cpu(&self) -> bool {
        self.kind == DeviceKind::Cpu
    }
}

/// Kind of processor of a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum DeviceKind {
    /// A GPU with memory of its own.
    Discrete,
    /// A GPU that shares the host's memory.
    Integrated,
    /// A GPU passed through by a virtual machine.
    Virtual,
    /// The host's own processor.
    Cpu,
    /// Any other kind.
    Other,
}

impl fmt::Display for DeviceKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            DeviceKind::Discrete => "discrete",
            DeviceKind::Integrated => "integrated",
            DeviceKind::Virtual => "virtual",
            DeviceKind::Cpu => "cpu",
            DeviceKind::Other => "other",
        })
    }
}

/// A product of cooperative matrices: `m` x `k` times `k` x `n`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct MatrixShape {
    /// Rows of the left operand.
    pub m: u32,
    /// Columns of the right operand.
    pub n: u32,
    /// Columns of the left operand.
    pub k: u32,
    /// Whether the device also has matrices of that shape with f16 sums. If so, numbers become f16 in registers; otherwise they
    /// go through shared memory.
    pub f16_sums: bool,
}

fn c_chars(text: &[std::ffi::c_char]) -> String {
    text.iter().take_while(|c| **c != 0).map(|c| char::from(*c as u8)).collect()
}

/// Vulkan's names of the features that some kernels need beyond those every device has, and whether a device offers them.
#[derive(Debug, Clone, Copy)]
pub(super) struct KernelFeatures {
    /// Features for kernels whose workgroups consist of full subgroups of a given size.
    pub subgroups: [(&'static str, bool); 2],
    /// Features for kernels on cooperative matrices, which need `subgroups` as well.
    pub matrices: [(&'static str, bool); 4],
}

impl KernelFeatures {
    pub fn of(instance: &ash::Instance, physical: vk::PhysicalDevice, has: impl Fn(&CStr) -> bool) -> KernelFeatures {
        let mut matrix = vk::PhysicalDeviceCooperativeMatrixFeaturesKHR::default();
        let mut size = vk::PhysicalDeviceSubgroupSizeControlFeatures::default();
        let mut f12 = vk::PhysicalDeviceVulkan12Features::default();
        let mut features = vk::PhysicalDeviceFeatures2::default().push_next(&mut f12);
        if has(khr::cooperative_matrix::NAME) {
            features = features.push_next(&mut matrix);
        }
        if has(ext::subgroup_size_control::NAME) {
            features = features.push_next(&mut size);
        }
        // SAFETY: the device offers the extensions whose structures are chained; these live until the call returns, and that of
        // Vulkan 1.2 is ignored by older devices.
        unsafe { instance.get_physical_device_features2(physical, &mut features) };
        let on = |feature: vk::Bool32| feature == vk::TRUE;
        KernelFeatures {
            subgroups: [
                ("subgroupSizeControl", on(size.subgroup_size_control)),
                ("computeFullSubgroups", on(size.compute_full_subgroups)),
            ],
            matrices: [
                ("cooperativeMatrix", on(matrix.cooperative_matrix)),
                ("shaderFloat16", on(f12.shader_float16)),
                ("vulkanMemoryModel", on(f12.vulkan_memory_model)),
                // Integer atomics of other kernels have device scope.
                ("vulkanMemoryModelDeviceScope", on(f12.vulkan_memory_model_device_scope)),
            ],
        }
    }

    /// Returns the features that a physical device offers.
    pub fn offered(instance: &ash::Instance, physical: vk::PhysicalDevice) -> Result<KernelFeatures, vk::Result> {
        // SAFETY: callers take `physical` from this instance.
        let extensions = unsafe { instance.enumerate_device_extension_properties(physical) }?;
        Ok(KernelFeatures::of(instance, physical, |name| is_among(&extensions, name)))
    }

    /// Tells whether all features for kernels on matrices are offered.
    fn take_matrices(&self) -> bool {
        self.subgroups.iter().chain(&self.matrices).all(|(_, offered)| *offered)
    }
}

fn is_among(extensions: &[vk::ExtensionProperties], name: &CStr) -> bool {
    extensions.iter().any(|e| e.extension_name_as_c_str().is_ok_and(|n| n == name))
}

/// Subgroup sizes of a device's shaders.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct SubgroupSizes {
    default: u32,
    /// Minimum and maximum.
    range: (u32, u32),
    /// Whether compute shaders can require a size in this range.
    can_ask: bool,
    /// Maximum number of subgroups of a workgroup that requires a subgroup size.
    max: u32,
    /// Whether workgroups can be required to consist of full subgroups.
    full: bool,
    /// Whether lanes exchange values.
    exchanges: bool,
}

/// Subgroup size for workgroups of this many lanes.
const USUAL_SUBGROUP: u32 = 32;

impl SubgroupSizes {
    fn of(instance: &ash::Instance, physical: vk::PhysicalDevice, has_size_control: bool) -> SubgroupSizes {
        let mut size = vk::PhysicalDeviceSubgroupSizeControlFeatures::default();
        let mut sizes = vk::PhysicalDeviceSubgroupSizeControlProperties::default();
        let mut subgroup = vk::PhysicalDeviceSubgroupProperties::default();
        let mut features = vk::PhysicalDeviceFeatures2::default();
        let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut subgroup);
        if has_size_control {
            features = features.push_next(&mut size);
            properties = properties.push_next(&mut sizes);
        }
        // SAFETY: the device has the extension of the chained structures where they are chained; these live until the calls
        // return.
        unsafe {
            instance.get_physical_device_features2(physical, &mut features);
            instance.get_physical_device_properties2(physical, &mut properties);
        }
        let compute = vk::ShaderStageFlags::COMPUTE;
        let can_ask = size.subgroup_size_control == vk::TRUE && sizes.required_subgroup_size_stages.contains(compute);
        SubgroupSizes {
            default: subgroup.subgroup_size,
            range: (sizes.min_subgroup_size, sizes.max_subgroup_size),
            can_ask,
            max: sizes.max_compute_workgroup_subgroups,
            full: size.subgroup_size_control == vk::TRUE && size.compute_full_subgroups == vk::TRUE,
            exchanges: subgroup.supported_stages.contains(compute)
                && subgroup.supported_operations.contains(vk::SubgroupFeatureFlags::SHUFFLE),
        }
    }

    /// Returns [`DeviceInfo::full_subgroups`].
    fn full(&self) -> Option<u32> {
        (self.full && self.exchanges && self.default.is_power_of_two()).then_some(self.default)
    }

    /// Returns [`DeviceInfo::small_subgroups`].
    fn small(&self) -> Option<u32> {
        let usual = self.can_ask && (self.range.0..=self.range.1).contains(&USUAL_SUBGROUP);
        self.full().filter(|size| *size > USUAL_SUBGROUP && usual).map(|_| USUAL_SUBGROUP)
    }

    /// Returns [`DeviceInfo::matrix_subgroup`]; none where the size is not known. The default size is the best by the
    /// compilers' estimates, among Intel's 16 and 32 and AMD's 32 and 64.
    fn for_matrices(&self) -> Option<u32> {
        let (min, max) = self.range;
        let is_known = self.can_ask || (min, max) == (self.default, self.default);
        (self.full && is_known).then_some(self.default.clamp(min, max.max(min)))
    }
}

/// Returns the matrix shapes our kernels can use on a device with their [`KernelFeatures`], the shape with the most work per
/// product first; or the reason why the query failed.
fn matrix_shapes(
    entry: &ash::Entry,
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
) -> Result<Vec<MatrixShape>, String> {
    let loader = khr::cooperative_matrix::Instance::new(entry, instance);
    // SAFETY: the caller checked that this device of the instance offers the extension.
    let found = unsafe { loader.get_physical_device_cooperative_matrix_properties(physical) }
        .map_err(|code| format!("vkGetPhysicalDeviceCooperativeMatrixPropertiesKHR failed: {code}"))?;
    Ok(usable_shapes(&found))
}

/// Returns the shapes our kernels can use among the products that a device lists, the best first.
fn usable_shapes(found: &[vk::CooperativeMatrixPropertiesKHR<'_>]) -> Vec<MatrixShape> {
    let (f16, f32) = (vk::ComponentTypeKHR::FLOAT16, vk::ComponentTypeKHR::FLOAT32);
    let size = |p: &vk::CooperativeMatrixPropertiesKHR<'_>| (p.m_size, p.n_size, p.k_size);
    let of_subgroups = || found.iter().filter(|p| p.scope == vk::ScopeKHR::SUBGROUP);
    let mut shapes: Vec<MatrixShape> = of_subgroups()
        .filter(|p| p.a_type == f16 && p.b_type == f16 && p.c_type == f32 && p.result_type == f32)
        .map(|p| MatrixShape {
            m: p.m_size,
            n: p.n_size,
            k: p.k_size,
            f16_sums: of_subgroups().any(|q| q.c_type == f16 && size(p) == size(q)),
        })
        .collect();
    // Rows are handled eight f16 at a time, and widths are multiples of 16.
    let fits = |size: u32| size.is_multiple_of(8) && 16 % size == 0;
    shapes.retain(|s| [s.m, s.n, s.k].into_iter().all(fits));
    // The largest product reuses its operands most. Shapes without f16 sums come last, because their numbers go through shared
    // memory.
    shapes.sort_by_key(|s| std::cmp::Reverse((s.f16_sums, s.m * s.n * s.k, s.m)));
    shapes
}

/// Tells whether a device exports binary semaphores as opaque file descriptors, by which another device can import them.
fn exports_semaphores(instance: &ash::Instance, physical: vk::PhysicalDevice) -> bool {
    let asked =
        vk::PhysicalDeviceExternalSemaphoreInfo::default().handle_type(vk::ExternalSemaphoreHandleTypeFlags::OPAQUE_FD);
    let mut offered = vk::ExternalSemaphoreProperties::default();
    // SAFETY: callers take `physical` from this instance, and the function belongs to Vulkan 1.1.
    unsafe { instance.get_physical_device_external_semaphore_properties(physical, &asked, &mut offered) };
    let needed = vk::ExternalSemaphoreFeatureFlags::EXPORTABLE | vk::ExternalSemaphoreFeatureFlags::IMPORTABLE;
    offered.external_semaphore_features.contains(needed)
}

pub(super) fn describe(
    entry: &ash::Entry,
    instance: &ash::Instance,
    index: usize,
    physical: vk::PhysicalDevice,
) -> DeviceInfo {
    let mut driver = vk::PhysicalDeviceDriverProperties::default();
    let mut ids = vk::PhysicalDeviceIDProperties::default();
    let mut subgroup = vk::PhysicalDeviceSubgroupProperties::default();
    let mut multiprocessors = vk::PhysicalDeviceShaderSMBuiltinsPropertiesNV::default();
    // SAFETY: callers take `physical` from this instance.
    let (extensions, mut fault) = match unsafe { instance.enumerate_device_extension_properties(physical) } {
        Ok(extensions) => (extensions, None),
        Err(code) => (Vec::new(), Some(format!("vkEnumerateDeviceExtensionProperties failed: {code}"))),
    };
    let has = |name: &CStr| is_among(&extensions, name);
    let mut props =
        vk::PhysicalDeviceProperties2::default().push_next(&mut driver).push_next(&mut ids).push_next(&mut subgroup);
    if has(nv::shader_sm_builtins::NAME) {
        props = props.push_next(&mut multiprocessors);
    }
    // SAFETY: the chain lives until the call returns, and holds an extension's structure only where the device has it.
    unsafe { instance.get_physical_device_properties2(physical, &mut props) };
    let properties = props.properties;
    let mut f12 = vk::PhysicalDeviceVulkan12Features::default();
    let mut statistics = vk::PhysicalDevicePipelineExecutablePropertiesFeaturesKHR::default();
    let mut features = vk::PhysicalDeviceFeatures2::default().push_next(&mut f12);
    if has(khr::pipeline_executable_properties::NAME) {
        features = features.push_next(&mut statistics);
    }
    // SAFETY: the chain lives until the call returns; it holds an extension's structure only where the device has it, and
    // that of Vulkan 1.2 is ignored by older devices.
    unsafe { instance.get_physical_device_features2(physical, &mut features) };
    // A fault of llvmpipe (seen in Mesa 26.2.6): with 16 lanes per subgroup, as with LP_NATIVE_VECTOR_WIDTH=512, the simplest
    // product of matrices crashes the process, and so do atomics on 64-bit integers.
    let crashes = driver.driver_id == vk::DriverId::MESA_LLVMPIPE && subgroup.subgroup_size > 8;
    let adds_int64 = features.features.shader_int64 == vk::TRUE && f12.shader_buffer_int64_atomics == vk::TRUE;
    let int64_atomics = adds_int64 && !crashes;
    let memory = DeviceMemory::of(instance, physical, has(ext::memory_budget::NAME));
    let limits = properties.limits;
    let version = properties.api_version;
    let sizes = SubgroupSizes::of(instance, physical, has(ext::subgroup_size_control::NAME));
    let matrix_subgroup = sizes.for_matrices();
    let takes_matrices = KernelFeatures::of(instance, physical, has).take_matrices();
    let matrices = if crashes || matrix_subgroup.is_none() || !takes_matrices {
        Vec::new()
    } else {
        matrix_shapes(entry, instance, physical).unwrap_or_else(|why| {
            fault = Some(why);
            Vec::new()
        })
    };
    let unusable = if fault.is_some() {
        fault
    } else if version < vk::API_VERSION_1_2 {
        Some("Vulkan 1.2 is needed".to_owned())
    } else if f12.timeline_semaphore == vk::FALSE {
        Some("timeline semaphores are needed".to_owned())
    } else if compute_family(instance, physical).is_none() {
        Some("the device has no compute queue".to_owned())
    } else {
        None
    };
    let timestamp_bits = compute_family(instance, physical).map_or(0, |family| family.timestamp_bits);
    let driver_info = c_chars(&driver.driver_info);
    DeviceInfo {
        index,
        name: c_chars(&properties.device_name),
        kind: match properties.device_type {
            vk::PhysicalDeviceType::DISCRETE_GPU => DeviceKind::Discrete,
            vk::PhysicalDeviceType::INTEGRATED_GPU => DeviceKind::Integrated,
            vk::PhysicalDeviceType::VIRTUAL_GPU => DeviceKind::Virtual,
            vk::PhysicalDeviceType::CPU => DeviceKind::Cpu,
            _ => DeviceKind::Other,
        },
        vendor: Vendor::of(properties.vendor_id),
        uuid: ids.device_uuid.iter().map(|b| format!("{b:02x}")).collect(),
        mesa_major: driver_info.strip_prefix("Mesa ").and_then(|v| v.split('.').next()).and_then(|v| v.parse().ok()),
        driver: format!("{} {}", c_chars(&driver.driver_name), driver_info),
        api_version: format!(
            "{}.{}.{}",
            vk::api_version_major(version),
            vk::api_version_minor(version),
            vk::api_version_patch(version)
        ),
        is_llvmpipe: driver.driver_id == vk::DriverId::MESA_LLVMPIPE,
        subgroup_size: subgroup.subgroup_size,
        full_subgroups: sizes.full(),
        small_subgroups: sizes.small(),
        matrix_subgroup: matrix_subgroup.unwrap_or(subgroup.subgroup_size),
        asks_for_subgroups: sizes.can_ask,
        max_workgroup_subgroups: sizes.max,
        max_shared_memory: limits.max_compute_shared_memory_size,
        max_workgroup_invocations: limits.max_compute_work_group_invocations,
        max_workgroup_count: limits.max_compute_work_group_count[0],
        max_storage_buffer_range: limits.max_storage_buffer_range,
        max_storage_buffers: limits
            .max_per_stage_descriptor_storage_buffers
            .min(limits.max_descriptor_set_storage_buffers),
        max_texel_buffer_elements: limits.max_texel_buffer_elements,
        max_push_constants: limits.max_push_constants_size,
        timestamp_period_ns: if timestamp_bits > 0 { limits.timestamp_period } else { 0.0 },
        timestamp_bits,
        device_memory: memory.bytes,
        free_memory: memory.free,
        buffer_device_address: f12.buffer_device_address == vk::TRUE,
        matrices,
        multiprocessors: multiprocessors.shader_sm_count,
        float16: f12.shader_float16 == vk::TRUE,
        float_atomics: has(ext::shader_atomic_float::NAME),
        int64_atomics,
        external_memory_fd: has(khr::external_memory_fd::NAME),
        external_semaphore_fd: has(khr::external_semaphore_fd::NAME) && exports_semaphores(instance, physical),
        pipeline_statistics: has(khr::pipeline_executable_properties::NAME)
            && statistics.pipeline_executable_info == vk::TRUE,
        portability_subset: has(khr::portability_subset::NAME),
        unusable,
    }
}

/// A queue family that supports compute.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ComputeFamily {
    /// Index among the device's families.
    pub index: u32,
    /// Number of valid bits of its timestamps; 0 without timestamps.
    pub timestamp_bits: u32,
}

/// Chooses the family whose queue we use: preferably one without graphics, so that drawing the screen does not wait for our
/// work.
pub(super) fn compute_family(instance: &ash::Instance, physical: vk::PhysicalDevice) -> Option<ComputeFamily> {
    // SAFETY: callers take `physical` from this instance.
    best_family(&unsafe { instance.get_physical_device_queue_family_properties(physical) })
}

/// Returns a family of a device by its index.
pub(super) fn family_at(instance: &ash::Instance, physical: vk::PhysicalDevice, index: u32) -> Option<ComputeFamily> {
    // SAFETY: callers take `physical` from this instance.
    let families = unsafe { instance.get_physical_device_queue_family_properties(physical) };
    families.get(index as usize).map(|f| ComputeFamily { index, timestamp_bits: f.timestamp_valid_bits })
}

fn best_family(families: &[vk::QueueFamilyProperties]) -> Option<ComputeFamily> {
    let computes = |f: &vk::QueueFamilyProperties| f.queue_count > 0 && f.queue_flags.contains(vk::QueueFlags::COMPUTE);
    let draws = |f: &vk::QueueFamilyProperties| f.queue_flags.contains(vk::QueueFlags::GRAPHICS);
    // Without timestamps nothing can be measured; among equals, the first is the driver's own choice.
    let usable = families.iter().enumerate().filter(|(_, f)| computes(f));
    let best = usable.min_by_key(|(_, f)| (f.timestamp_valid_bits == 0, draws(f)));
    best.map(|(i, f)| ComputeFamily { index: i as u32, timestamp_bits: f.timestamp_valid_bits })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn subgroups_are_of_a_size_that_the_device_has() {
        let sizes =
            |default, range| SubgroupSizes { default, range, can_ask: true, max: 32, full: true, exchanges: true };
        let fixed = |default, range| SubgroupSizes { can_ask: false, ..sizes(default, range) };
        let chosen = |sizes: SubgroupSizes| (sizes.full(), sizes.small(), sizes.for_matrices());
        // In this order: NVIDIA; AMD's chips of both generations, as Mesa's drivers report them; Intel; llvmpipe.
        assert_eq!(chosen(sizes(32, (32, 32))), (Some(32), None, Some(32)));
        assert_eq!(chosen(sizes(64, (32, 64))), (Some(64), Some(32), Some(64)));
        assert_eq!(chosen(sizes(64, (64, 64))), (Some(64), None, Some(64)));
        assert_eq!(chosen(sizes(32, (16, 32))), (Some(32), None, Some(32)));
        assert_eq!(chosen(sizes(8, (8, 8))), (Some(8), None, Some(8)));
        // Where no size can be required, the default is used; kernels on matrices must know the size, so they need it to be the
        // only one.
        assert_eq!(chosen(fixed(32, (32, 32))), (Some(32), None, Some(32)));
        assert_eq!(chosen(fixed(64, (32, 64))), (Some(64), None, None));
        assert_eq!(SubgroupSizes { full: false, ..sizes(32, (32, 32)) }.full(), None);
    }

    #[test]
    fn shapes_without_f16_sums_come_last() {
        use vk::ComponentTypeKHR as Type;
        let product = |[m_size, n_size, k_size]: [u32; 3], operands, sums| vk::CooperativeMatrixPropertiesKHR {
            m_size,
            n_size,
            k_size,
            a_type: operands,
            b_type: operands,
            c_type: sums,
            result_type: sums,
            scope: vk::ScopeKHR::SUBGROUP,
            ..Default::default()
        };
        let (half, single) = (Type::FLOAT16, Type::FLOAT32);
        let taken =
            |found: &[_]| usable_shapes(found).iter().map(|s| ([s.m, s.n, s.k], s.f16_sums)).collect::<Vec<_>>();
        let (large, small) = ([16, 16, 16], [8, 8, 16]);
        // Cases: Intel's first chips with matrices; a shape of either kind; shapes that our kernels cannot use.
        assert_eq!(taken(&[product(small, half, single)]), [(small, false)]);
        let both = [product(large, half, single), product(small, half, half), product(small, half, single)];
        assert_eq!(taken(&both), [(small, true), (large, false)]);
        let workgroup = vk::CooperativeMatrixPropertiesKHR { scope: vk::ScopeKHR::WORKGROUP, ..both[1] };
        assert_eq!(taken(&[both[2], workgroup]), [(small, false)]);
        assert_eq!(taken(&[product([16, 8, 4], half, single), product(large, Type::SINT8, Type::SINT32)]), []);
    }

    #[test]
    fn queues_that_only_compute_come_first() {
        use vk::QueueFlags as Flags;
        let family = |queue_flags, timestamp_valid_bits| vk::QueueFamilyProperties {
            queue_flags,
            queue_count: 1,
            timestamp_valid_bits,
            ..Default::default()
        };
        let all = family(Flags::GRAPHICS | Flags::COMPUTE | Flags::TRANSFER, 64);
        let (copies, alone) = (family(Flags::TRANSFER, 64), family(Flags::COMPUTE | Flags::TRANSFER, 36));
        let none = vk::QueueFamilyProperties { queue_count: 0, ..alone };
        let taken = |families: &[_]| best_family(families).map(|f| (f.index, f.timestamp_bits));
        assert_eq!(taken(&[all, copies, alone]), Some((2, 36)));
        assert_eq!(taken(&[copies, all, all]), Some((1, 64)));
        assert_eq!(taken(&[all, none]), Some((0, 64)));
        assert_eq!(taken(&[all, family(Flags::COMPUTE, 0)]), Some((0, 64)), "nothing could be measured");
        assert_eq!(taken(&[copies]), None);
    }

    #[test]
    fn kinds_are_written_as_they_are_shown() {
        use DeviceKind::*;
        for (kind, name) in
            [(Discrete, "discrete"), (Integrated, "integrated"), (Virtual, "virtual"), (Cpu, "cpu"), (Other, "other")]
        {
            assert_eq!(kind.to_string(), name);
            assert_eq!(serde_json::to_value(kind).unwrap(), name);
        }
    }
}
