//! Details of a device for bug reports, beyond [`super::capabilities`]. No decision depends on them.

use super::instance::Instance;
use crate::error::Result;
use ash::{ext, khr, vk};
use serde::Serialize;
use std::ffi::CStr;

/// Description of a device by its driver.
#[derive(Debug, Clone, Serialize)]
pub struct DeviceDetails {
    /// PCI id of the vendor, hexadecimal.
    pub vendor_id: String,
    /// PCI id of the device, hexadecimal.
    pub device_id: String,
    /// Driver's version number, hexadecimal: vendors encode it differently.
    pub driver_version: String,
    /// Version of the conformance tests that the driver claims to pass.
    pub conformance_version: String,
    /// Subgroups of compute shaders.
    pub subgroups: Subgroups,
    /// Whether shaders have 64-bit integers.
    pub int64: bool,
    /// Whether there are atomics on 64-bit integers in buffers.
    pub buffer_int64_atomics: bool,
    /// Whether there are atomics on 64-bit integers in shared memory.
    pub shared_int64_atomics: bool,
    /// Whether storage buffers can have 16-bit values.
    pub storage_16_bit: bool,
    /// Products of cooperative matrices that the driver offers, whether or not our kernels can use them.
    pub matrix_products: Vec<MatrixProduct>,
    /// Families of queues.
    pub queues: Vec<QueueFamily>,
    /// Heaps of memory.
    pub heaps: Vec<Heap>,
    /// Types of memory: heap and properties.
    pub memory_types: Vec<String>,
    /// Maximum number of workgroups of a dispatch along each axis.
    pub max_workgroup_count: [u32; 3],
    /// Maximum number of invocations of a workgroup along each axis.
    pub max_workgroup_size: [u32; 3],
    /// Maximum number of simultaneous allocations.
    pub max_allocations: u32,
    /// Largest allocation, bytes.
    pub max_allocation_bytes: u64,
    /// Extensions with their versions.
    pub extensions: Vec<String>,
}

/// Subgroups of compute shaders.
#[derive(Debug, Clone, Serialize)]
pub struct Subgroups {
    /// Default number of invocations.
    pub default_size: u32,
    /// Minimum and maximum size that can be required; none where no size can be.
    pub sizes: Option<[u32; 2]>,
    /// Whether compute shaders support subgroup operations.
    pub in_compute: bool,
    /// Supported kinds of operations.
    pub operations: String,
}

/// A product of cooperative matrices: `m` x `k` times `k` x `n`.
#[derive(Debug, Clone, Serialize)]
pub struct MatrixProduct {
    /// Rows of the left operand.
    pub m: u32,
    /// Columns of the right operand.
    pub n: u32,
    /// Columns of the left operand.
    pub k: u32,
    /// Types of both operands, of the addend and of the result.
    pub types: String,
    /// Scope that shares a matrix.
    pub scope: String,
}

/// A family of queues.
#[derive(Debug, Clone, Serialize)]
pub struct QueueFamily {
    /// Capabilities of its queues.
    pub flags: String,
    /// Number of queues.
    pub count: u32,
    /// Number of valid bits of timestamps; 0 without timestamps.
    pub timestamp_bits: u32,
}

/// A heap of memory.
#[derive(Debug, Clone, Serialize)]
pub struct Heap {
    /// Size, bytes.
    pub bytes: u64,
    /// Properties of the heap.
    pub flags: String,
}

/// Lists the details of every device that the loader offers, in its order.
///
/// # Errors
/// [`crate::error::Error::NoDevice`] when there is no Vulkan loader.
pub fn list_details() -> Result<Vec<DeviceDetails>> {
    let instance = Instance::create(None, false)?;
    let devices = instance.devices()?;
    Ok(devices.into_iter().map(|(physical, _)| details(&instance, physical)).collect())
}

/// Lists the extensions with their versions, such as `VK_KHR_cooperative_matrix 2`.
fn extensions(instance: &Instance, physical: vk::PhysicalDevice) -> Vec<String> {
    // SAFETY: the caller takes `physical` from this instance.
    let found = unsafe { instance.enumerate_device_extension_properties(physical) }.unwrap_or_default();
    let name = |e: &vk::ExtensionProperties| e.extension_name_as_c_str().map(|n| n.to_string_lossy().into_owned());
    found.iter().filter_map(|e| name(e).ok().map(|name| format!("{name} {}", e.spec_version))).collect()
}

fn has(extensions: &[String], name: &CStr) -> bool {
    extensions.iter().any(|e| e.split(' ').next() == name.to_str().ok())
}

fn details(instance: &Instance, physical: vk::PhysicalDevice) -> DeviceDetails {
    let extensions = extensions(instance, physical);
    let mut driver = vk::PhysicalDeviceDriverProperties::default();
    let mut subgroup = vk::PhysicalDeviceSubgroupProperties::default();
    let mut sizes = vk::PhysicalDeviceSubgroupSizeControlProperties::default();
    let mut maintenance = vk::PhysicalDeviceMaintenance3Properties::default();
    let mut props = vk::PhysicalDeviceProperties2::default()
        .push_next(&mut driver)
        .push_next(&mut subgroup)
        .push_next(&mut maintenance);
    let sized = has(&extensions, ext::subgroup_size_control::NAME);
    if sized {
        props = props.push_next(&mut sizes);
    }
    // SAFETY: the chain lives until the call returns, and holds an extension's structure only where the device has it.
    unsafe { instance.get_physical_device_properties2(physical, &mut props) };
    let properties = props.properties;
    let mut f11 = vk::PhysicalDeviceVulkan11Features::default();
    let mut f12 = vk::PhysicalDeviceVulkan12Features::default();
    let mut features = vk::PhysicalDeviceFeatures2::default().push_next(&mut f11).push_next(&mut f12);
    // SAFETY: the chain lives until the call returns; its structures are of Vulkan 1.2, and ignored by older devices.
    unsafe { instance.get_physical_device_features2(physical, &mut features) };
    let int64 = features.features.shader_int64 == vk::TRUE;
    // SAFETY: the caller takes `physical` from this instance.
    let memory = unsafe { instance.get_physical_device_memory_properties(physical) };
    // SAFETY: `physical` belongs to this instance, which `instance` keeps alive.
    let queues = unsafe { instance.get_physical_device_queue_family_properties(physical) };
    let version = driver.conformance_version;
    DeviceDetails {
        vendor_id: format!("{:04x}", properties.vendor_id),
        device_id: format!("{:04x}", properties.device_id),
        driver_version: format!("{:08x}", properties.driver_version),
        conformance_version: format!("{}.{}.{}.{}", version.major, version.minor, version.subminor, version.patch),
        subgroups: Subgroups {
            default_size: subgroup.subgroup_size,
            sizes: sized.then_some([sizes.min_subgroup_size, sizes.max_subgroup_size]),
            in_compute: subgroup.supported_stages.contains(vk::ShaderStageFlags::COMPUTE),
            operations: words(subgroup.supported_operations),
        },
        int64,
        buffer_int64_atomics: f12.shader_buffer_int64_atomics == vk::TRUE,
        shared_int64_atomics: f12.shader_shared_int64_atomics == vk::TRUE,
        storage_16_bit: f11.storage_buffer16_bit_access == vk::TRUE,
        matrix_products: if has(&extensions, khr::cooperative_matrix::NAME) {
            matrix_products(instance, physical)
        } else {
            Vec::new()
        },
        queues: queues
            .iter()
            .map(|q| QueueFamily {
                flags: words(q.queue_flags),
                count: q.queue_count,
                timestamp_bits: q.timestamp_valid_bits,
            })
            .collect(),
        heaps: memory.memory_heaps[..memory.memory_heap_count as usize]
            .iter()
            .map(|heap| Heap { bytes: heap.size, flags: words(heap.flags) })
            .collect(),
        memory_types: memory.memory_types[..memory.memory_type_count as usize]
            .iter()
            .map(|kind| format!("heap {}: {}", kind.heap_index, words(kind.property_flags)))
            .collect(),
        max_workgroup_count: properties.limits.max_compute_work_group_count,
        max_workgroup_size: properties.limits.max_compute_work_group_size,
        max_allocations: properties.limits.max_memory_allocation_count,
        max_allocation_bytes: maintenance.max_memory_allocation_size,
        extensions,
    }
}

fn matrix_products(instance: &Instance, physical: vk::PhysicalDevice) -> Vec<MatrixProduct> {
    let loader = instance.cooperative_matrix();
    // SAFETY: the caller checked that this device of the instance offers the extension.
    let found = unsafe { loader.get_physical_device_cooperative_matrix_properties(physical) }.unwrap_or_default();
    let product = |p: &vk::CooperativeMatrixPropertiesKHR<'_>| MatrixProduct {
        m: p.m_size,
        n: p.n_size,
        k: p.k_size,
        types: words([p.a_type, p.b_type, p.c_type, p.result_type]),
        scope: words(p.scope),
    };
    found.iter().map(product).collect()
}

/// Returns Vulkan's own names in lower case, without brackets and commas.
fn words(flags: impl std::fmt::Debug) -> String {
    let text = format!("{flags:?}").to_lowercase().replace(" | ", " ");
    text.chars().filter(|c| !"[],".contains(*c)).collect()
}
