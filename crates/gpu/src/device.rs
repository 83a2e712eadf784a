//! Choice of a device, adoption of an application's device, and the state that all objects made from a device share: queue,
//! allocator, timeline, debug names.

use super::calls::{CallCounters, Calls};
use super::capabilities::{DeviceInfo, DeviceKind, KernelFeatures, compute_family, family_at};
use super::instance::{Instance, Loader, remedy};
use super::lock::lock;
use super::memory::DeviceMemory;
use super::pace::PictureRequests;
use super::pipeline::Keeper;
use super::statistics::StatisticsKeeper;
use crate::error::{Error, Result};
use ash::{ext, khr, vk};
use gpu_allocator::AllocationSizes;
use gpu_allocator::vulkan::{Allocator, AllocatorCreateDesc};
use std::collections::BTreeSet;
use std::ffi::CString;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, Weak};

/// Options of opening a device.
#[derive(Debug, Clone, Default)]
pub struct DeviceOptions {
    /// Index, part of the name (any case) or UUID; `None` selects the best device.
    pub select: Option<String>,
    /// Whether to turn the Khronos validation layer on, with synchronisation validation.
    pub validation: bool,
    /// Directory for the pipeline cache; `None` keeps it in memory only.
    pub cache_dir: Option<std::path::PathBuf>,
    /// Maximum number of bytes of buffers and images alive at once; `None` leaves the limit to the device.
    pub memory_limit: Option<u64>,
    /// An application's own loader in place of the system's.
    pub loader: Option<Loader>,
    /// Whether to keep the driver's statistics of each pipeline; see [`Gpu::pipeline_statistics`].
    pub statistics: bool,
    /// Whether to avoid operations across a subgroup, as on a device that lacks them.
    pub without_subgroups: bool,
    /// Whether to avoid atomic operations on 64-bit integers, as on a device that lacks them.
    pub without_int64_atomics: bool,
}

/// A device that an application made and continues to own; see [`Gpu::adopt`].
pub struct Adoption {
    /// `vkGetInstanceProcAddr` of the owner's loader; `None` uses the system's loader.
    pub get_instance_proc_addr: Option<vk::PFN_vkGetInstanceProcAddr>,
    /// Instance made for Vulkan 1.2 or newer.
    pub instance: vk::Instance,
    /// The physical device.
    pub physical_device: vk::PhysicalDevice,
    /// Device with the feature `timelineSemaphore`.
    pub device: vk::Device,
    /// Queue of the device that supports compute.
    pub queue: vk::Queue,
    /// Family of the queue.
    pub queue_family: u32,
    /// Whether the device was made with the feature `bufferDeviceAddress`.
    pub buffer_device_address: bool,
    /// Whether the device was made with `VK_KHR_external_memory_fd`.
    pub external_memory_fd: bool,
    /// Whether the device was made with `VK_KHR_external_semaphore_fd`.
    pub external_semaphore_fd: bool,
    /// Whether the device was made with the features `subgroupSizeControl` and `computeFullSubgroups`, of
    /// `VK_EXT_subgroup_size_control` or Vulkan 1.3.
    pub subgroup_size_control: bool,
    /// Whether the device was made with `VK_KHR_cooperative_matrix` and its feature `cooperativeMatrix`, with `shaderFloat16`,
    /// `vulkanMemoryModel` and `vulkanMemoryModelDeviceScope`, and with all features of `subgroup_size_control`.
    pub cooperative_matrix: bool,
    /// Lock held around every use of the queue; `None` when nobody else uses the queue.
    pub queue_lock: Option<Box<dyn QueueLock>>,
}

impl Adoption {
    /// Refuses features that this physical device does not offer: kernels that use them would have undefined results.
    fn check_features(&self, device: &str, offered: &KernelFeatures) -> Result<()> {
        let claims = [
            ("subgroup_size_control", self.subgroup_size_control, &offered.subgroups[..]),
            ("cooperative_matrix", self.cooperative_matrix, &offered.matrices[..]),
        ];
        for (field, is_claimed, features) in claims {
            let lacking: Vec<&str> = features.iter().filter(|(_, offered)| !offered).map(|(name, _)| *name).collect();
            if is_claimed && !lacking.is_empty() {
                let problem = format!(
                    "{device} does not offer {}, so the device cannot have been created with it: omit the field",
                    lacking.join(", ")
                );
                return Err(Error::Claim { field, value: is_claimed, problem });
            }
        }
        Ok(())
    }
}

/// Lock that keeps several users of one queue apart.
pub trait QueueLock: Send + Sync {
    /// Waits until the queue is free, and takes it.
    fn lock(&self);
    /// Releases the queue.
    fn unlock(&self);
}

/// An open device. It is cheap to clone; everything is freed when the last clone is dropped.
#[derive(Clone)]
pub struct Gpu {
    pub(super) shared: Arc<Shared>,
}

/// State that every object made from a device keeps alive.
pub(super) struct Shared {
    pub(super) queue: Mutex<vk::Queue>,
    pub(super) queue_family: u32,
    /// Allocator; it frees its blocks when dropped, which needs the device below.
    pub(super) allocator: Mutex<Allocator>,
    pub(super) pipeline_cache: vk::PipelineCache,
    pub(super) timeline: vk::Semaphore,
    pub(super) last_submitted: AtomicU64,
    pub(super) live_objects: AtomicU64,
    pub(super) calls: CallCounters,
    pub(super) info: DeviceInfo,
    looks: PictureRequests,
    /// Pipelines that somebody keeps.
    pub(super) kept_pipelines: Mutex<Weak<Keeper>>,
    /// Shaders that were recorded so far.
    pub(super) recorded: Mutex<BTreeSet<&'static str>>,
    pub(super) physical: vk::PhysicalDevice,
    taken: MemoryUse,
    queue_lock: Option<Box<dyn QueueLock>>,
    cache_file: Option<std::path::PathBuf>,
    pub(super) statistics: Option<StatisticsKeeper>,
    pub(super) device: Device,
}

/// A device; it is destroyed on drop if it was made here.
pub(super) struct Device {
    raw: ash::Device,
    ours: bool,
    pub(super) debug_names: Option<ext::debug_utils::Device>,
    pub(super) instance: Instance,
}

impl std::ops::Deref for Device {
    type Target = ash::Device;

    fn deref(&self) -> &ash::Device {
        &self.raw
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        if self.ours {
            // SAFETY: made by us and destroyed once, here. Everything made from it is destroyed: it belongs to objects that
            // hold the `Shared` around this, or to that struct itself, which drops this field last.
            unsafe { self.raw.destroy_device(None) };
        }
    }
}

/// Counter and limit of the bytes of buffers and images.
struct MemoryUse {
    in_use: AtomicU64,
    limit: u64,
}

/// Queue locked both here and for its owner.
pub(super) struct LockedQueue<'a> {
    queue: MutexGuard<'a, vk::Queue>,
    theirs: Option<&'a dyn QueueLock>,
}

impl std::ops::Deref for LockedQueue<'_> {
    type Target = vk::Queue;

    fn deref(&self) -> &vk::Queue {
        &self.queue
    }
}

impl Drop for LockedQueue<'_> {
    fn drop(&mut self) {
        if let Some(theirs) = self.theirs {
            theirs.unlock();
        }
    }
}

/// Lists every device the loader offers, usable or not.
///
/// # Errors
/// [`Error::NoDevice`] when there is no Vulkan loader.
pub fn list_devices() -> Result<Vec<DeviceInfo>> {
    let devices = Instance::create(None, false)?.devices()?;
    Ok(devices.into_iter().map(|(_, info)| info).collect())
}

fn choose(
    all: Vec<(vk::PhysicalDevice, DeviceInfo)>,
    select: Option<&str>,
) -> Result<(vk::PhysicalDevice, DeviceInfo)> {
    let names = || {
        if all.is_empty() {
            format!("the Vulkan loader finds no device. {}", remedy())
        } else {
            let one = |d: &DeviceInfo| match &d.unusable {
                None => format!("{} = {}", d.index, d.name),
                Some(why) => format!("{} = {} (unusable: {why})", d.index, d.name),
            };
            let list: Vec<_> = all.iter().map(|(_, d)| one(d)).collect();
            format!("found: {}", list.join(", "))
        }
    };
    let rank = |d: &DeviceInfo| match d.kind {
        DeviceKind::Discrete => 0,
        DeviceKind::Integrated => 1,
        DeviceKind::Virtual => 2,
        DeviceKind::Cpu | DeviceKind::Other => 3,
    };
    let wanted = select.map(str::to_lowercase);
    let chosen = match &wanted {
        None => all.iter().filter(|(_, d)| d.unusable.is_none()).min_by_key(|(_, d)| rank(d)),
        Some(text) => all.iter().find(|(_, d)| {
            d.index.to_string() == *text || d.uuid == text.replace('-', "") || d.name.to_lowercase().contains(text)
        }),
    };
    match chosen {
        None => Err(Error::NoDevice(match select {
            Some(text) => format!("no device matches `{text}` ({})", names()),
            None => names(),
        })),
        Some((_, DeviceInfo { name, unusable: Some(why), .. })) => Err(Error::NoDevice(format!("{name}: {why}"))),
        Some(found) => Ok(found.clone()),
    }
}

impl Device {
    /// Creates a device with one queue, and with the capabilities that `info` lists.
    fn create(
        instance: Instance,
        physical: vk::PhysicalDevice,
        info: &DeviceInfo,
        queue_family: u32,
        with_statistics: bool,
    ) -> Result<Device> {
        let priorities = [1.0];
        let queues =
            [vk::DeviceQueueCreateInfo::default().queue_family_index(queue_family).queue_priorities(&priorities)];
        let mut f12 = vk::PhysicalDeviceVulkan12Features::default()
            .timeline_semaphore(true)
            .buffer_device_address(info.buffer_device_address)
            .shader_buffer_int64_atomics(info.int64_atomics);
        let features = vk::PhysicalDeviceFeatures::default().shader_int64(info.int64_atomics);
        let mut matrix = vk::PhysicalDeviceCooperativeMatrixFeaturesKHR::default().cooperative_matrix(true);
        let mut size = vk::PhysicalDeviceSubgroupSizeControlFeatures::default()
            .subgroup_size_control(true)
            .compute_full_subgroups(true);
        let mut statistics =
            vk::PhysicalDevicePipelineExecutablePropertiesFeaturesKHR::default().pipeline_executable_info(true);
        let mut extensions = Vec::new();
        if info.external_memory_fd {
            extensions.push(khr::external_memory_fd::NAME.as_ptr());
        }
        if info.external_semaphore_fd {
            extensions.push(khr::external_semaphore_fd::NAME.as_ptr());
        }
        if info.portability_subset {
            extensions.push(khr::portability_subset::NAME.as_ptr());
        }
        let mut create = vk::DeviceCreateInfo::default().queue_create_infos(&queues).enabled_features(&features);
        if !info.matrices.is_empty() {
            f12 = f12.shader_float16(true).vulkan_memory_model(true).vulkan_memory_model_device_scope(true);
            extensions.push(khr::cooperative_matrix::NAME.as_ptr());
            create = create.push_next(&mut matrix);
        }
        if !info.matrices.is_empty() || info.full_subgroups.is_some() {
            extensions.push(ext::subgroup_size_control::NAME.as_ptr());
            create = create.push_next(&mut size);
        }
        if with_statistics && info.pipeline_statistics {
            extensions.push(khr::pipeline_executable_properties::NAME.as_ptr());
            create = create.push_next(&mut statistics);
        }
        let create = create.enabled_extension_names(&extensions).push_next(&mut f12);
        // SAFETY: the chain consists of locals of this function; extensions and features are those `describe` found.
        let raw = unsafe { instance.create_device(physical, &create, None) }
            .map_err(Error::vulkan("vkCreateDevice", &info.name))?;
        let debug_names = instance.has_debug_names().then(|| ext::debug_utils::Device::new(&instance, &raw));
        Ok(Device { raw, ours: true, debug_names, instance })
    }
}

/// Parts from which a [`Gpu`] is made.
struct DeviceParts {
    physical: vk::PhysicalDevice,
    info: DeviceInfo,
    device: Device,
    queue: vk::Queue,
    queue_family: u32,
    queue_lock: Option<Box<dyn QueueLock>>,
}

impl DeviceParts {
    fn into_gpu(self, options: &DeviceOptions) -> Result<Gpu> {
        let DeviceParts { physical, info, device, queue, queue_family, queue_lock } = self;
        let allocator = Allocator::new(&AllocatorCreateDesc {
            instance: device.instance.clone(),
            device: device.clone(),
            physical_device: physical,
            debug_settings: Default::default(),
            buffer_device_address: info.buffer_device_address,
            allocation_sizes: match options.memory_limit {
                None => Default::default(),
                // Blocks are never smaller than 4 MiB.
                Some(limit) => AllocationSizes::new((limit / 8).min(256 << 20), (limit / 16).min(64 << 20)),
            },
        })
        .map_err(|e| Error::Internal(format!("gpu-allocator: {e}")))?;
        let statistics =
            (options.statistics && device.ours).then(|| StatisticsKeeper::new(&device.instance, &device, &info));
        let cache_file = options
            .cache_dir
            .as_ref()
            .map(|dir| dir.join(format!("pipelines-{}-{}.bin", info.uuid, env!("CARGO_PKG_VERSION"))));
        // From here on `Shared::drop` cleans up; null handles are ignored by Vulkan's destroy calls.
        let mut shared = Shared {
            queue: Mutex::new(queue),
            queue_family,
            allocator: Mutex::new(allocator),
            pipeline_cache: vk::PipelineCache::null(),
            timeline: vk::Semaphore::null(),
            last_submitted: AtomicU64::new(0),
            live_objects: AtomicU64::new(0),
            calls: CallCounters::default(),
            info,
            looks: PictureRequests::default(),
            kept_pipelines: Mutex::default(),
            recorded: Mutex::default(),
            physical,
            taken: MemoryUse { in_use: AtomicU64::new(0), limit: options.memory_limit.unwrap_or(u64::MAX) },
            queue_lock,
            cache_file,
            statistics,
            device,
        };
        let mut kind =
            vk::SemaphoreTypeCreateInfo::default().semaphore_type(vk::SemaphoreType::TIMELINE).initial_value(0);
        let create = vk::SemaphoreCreateInfo::default().push_next(&mut kind);
        // SAFETY: `shared` keeps the device alive, which was made with timeline semaphores.
        shared.timeline = unsafe { shared.device.create_semaphore(&create, None) }
            .map_err(Error::vulkan("vkCreateSemaphore", "timeline"))?;
        // An unreadable or foreign cache is ignored by the driver, which checks its header.
        let cached = shared.cache_file.as_ref().and_then(|f| std::fs::read(f).ok()).unwrap_or_default();
        let create = vk::PipelineCacheCreateInfo::default().initial_data(&cached);
        // SAFETY: `cached` lives until the call returns, and `shared` keeps the device alive.
        shared.pipeline_cache = unsafe { shared.device.create_pipeline_cache(&create, None) }
            .map_err(Error::vulkan("vkCreatePipelineCache", &shared.info.name))?;
        Ok(Gpu { shared: Arc::new(shared) })
    }
}

impl Gpu {
    /// Opens a device.
    ///
    /// # Errors
    /// [`Error::NoDevice`] when none fits, with the list of those found.
    pub fn open(options: &DeviceOptions) -> Result<Gpu> {
        let instance = Instance::create(options.loader, options.validation)?;
        let (physical, mut info) = choose(instance.devices()?, options.select.as_deref())?;
        instance.check_validation(&info)?;
        if options.without_subgroups {
            (info.full_subgroups, info.small_subgroups) = (None, None);
        }
        info.int64_atomics &= !options.without_int64_atomics;
        let queue_family = compute_family(&instance, physical)
            .ok_or_else(|| Error::NoDevice(format!("{}: the device has no compute queue", info.name)))?
            .index;
        let device = Device::create(instance, physical, &info, queue_family, options.statistics)?;
        // SAFETY: the device was made with one queue of this family.
        let queue = unsafe { device.get_device_queue(queue_family, 0) };
        DeviceParts { physical, info, device, queue, queue_family, queue_lock: None }.into_gpu(options)
    }

    /// Adopts a device that the caller made. Instance and device must outlive the last clone, and are not destroyed. Only two
    /// of the options apply: the pipeline cache and the memory limit.
    ///
    /// # Errors
    /// [`Error::NoDevice`] when the device lacks something the engine needs; [`Error::Claim`] for features that it cannot have
    /// been made with.
    ///
    /// # Safety
    /// The handles must be valid and belong together. The device must have been made with the features that `adoption` lists.
    /// Others may use the queue only while they hold the lock.
    pub unsafe fn adopt(adoption: Adoption, options: &DeviceOptions) -> Result<Gpu> {
        if adoption.cooperative_matrix && !adoption.subgroup_size_control {
            let problem = "also needs subgroup_size_control, because kernels on matrices require full subgroups".into();
            return Err(Error::Claim { field: "cooperative_matrix", value: true, problem });
        }
        let loader = adoption.get_instance_proc_addr.map(|function| {
            // SAFETY: the caller vouches that the function is that of the loader all handles come from.
            unsafe { Loader::new(function) }
        });
        // SAFETY: the caller vouches that the instance is valid and outlives the last clone.
        let instance = unsafe { Instance::adopt(loader, adoption.instance) }?;
        let mut info = instance.describe(0, adoption.physical_device);
        if let Some(why) = &info.unusable {
            return Err(Error::NoDevice(format!("{}: {why}", info.name)));
        }
        let offered = KernelFeatures::offered(&instance, adoption.physical_device)
            .map_err(Error::vulkan("vkEnumerateDeviceExtensionProperties", &info.name))?;
        adoption.check_features(&info.name, &offered)?;
        // SAFETY: the caller vouches that the device is valid and was made from this instance.
        let raw = unsafe { ash::Device::load(instance.fp_v1_0(), adoption.device) };
        // SAFETY: the device is the caller's, as in the line above; the name ends with a zero.
        let wait = unsafe { instance.get_device_proc_addr(adoption.device, c"vkWaitSemaphores".as_ptr()) };
        if wait.is_none() {
            return Err(Error::NoDevice(format!("{}: the device was not created for Vulkan 1.2", info.name)));
        }
        // Vulkan has no query for the features a device was made with.
        info.buffer_device_address &= adoption.buffer_device_address;
        let family = family_at(&instance, adoption.physical_device, adoption.queue_family);
        info.timestamp_bits = family.map_or(0, |family| family.timestamp_bits);
        if info.timestamp_bits == 0 {
            info.timestamp_period_ns = 0.0;
        }
        info.external_memory_fd &= adoption.external_memory_fd;
        info.external_semaphore_fd &= adoption.external_semaphore_fd;
        // Without 64-bit atomics, pairs of 32-bit integers give the same sums.
        info.int64_atomics = false;
        if !adoption.cooperative_matrix {
            info.matrices.clear();
        }
        if !adoption.subgroup_size_control {
            (info.full_subgroups, info.small_subgroups) = (None, None);
        }
        let parts = DeviceParts {
            physical: adoption.physical_device,
            info,
            device: Device { raw, ours: false, debug_names: None, instance },
            queue: adoption.queue,
            queue_family: adoption.queue_family,
            queue_lock: adoption.queue_lock,
        };
        parts.into_gpu(options)
    }

    /// Returns the device's properties and capabilities.
    pub fn info(&self) -> &DeviceInfo {
        &self.shared.info
    }

    /// Returns the record of requests for pictures computed on this device; see [`PictureRequests`].
    pub fn looks(&self) -> &PictureRequests {
        &self.shared.looks
    }

    /// Returns the validation layer's errors and warnings so far; empty without validation.
    pub fn validation_messages(&self) -> Vec<String> {
        self.shared.device.instance.messages()
    }

    /// Returns the number of buffers, pipelines and recordings that are alive; 0 once all are dropped.
    pub fn live_objects(&self) -> u64 {
        self.shared.live_objects.load(Ordering::Relaxed)
    }

    /// Returns the shaders whose dispatches were recorded so far, for reports of what was run on a device.
    pub fn recorded_shaders(&self) -> Vec<&'static str> {
        lock(&self.shared.recorded).iter().copied().collect()
    }

    /// Returns how often the host has called the device since it was opened.
    pub fn calls(&self) -> Calls {
        self.shared.calls.read()
    }

    /// Returns the bytes of buffers and images that are alive.
    pub fn memory_in_use(&self) -> u64 {
        self.shared.taken.in_use.load(Ordering::Relaxed)
    }

    /// Returns the pipeline cache and the file to keep it in, so that the next start compiles nothing; none without a file.
    ///
    /// # Errors
    /// Device errors.
    pub fn pipeline_cache(&self) -> Result<Option<(&std::path::Path, Vec<u8>)>> {
        let Some(file) = &self.shared.cache_file else {
            return Ok(None);
        };
        // SAFETY: the cache was made from this device, and both live as long as `self.shared`.
        let data = unsafe { self.shared.device.get_pipeline_cache_data(self.shared.pipeline_cache) }
            .map_err(Error::vulkan("vkGetPipelineCacheData", "pipeline cache"))?;
        Ok(Some((file, data)))
    }
}

impl Shared {
    pub(super) fn set_name<H: vk::Handle>(&self, handle: H, name: &str) {
        if let (Some(debug), Ok(name)) = (&self.device.debug_names, CString::new(name)) {
            let info = vk::DebugUtilsObjectNameInfoEXT::default().object_handle(handle).object_name(&name);
            // A missing name only makes messages less readable, so a failure is not an error.
            // SAFETY: callers pass handles that they just made from this device; the name lives until the call returns.
            let _ = unsafe { debug.set_debug_utils_object_name(&info) };
        }
    }

    /// Locks the queue, for a submit.
    pub(super) fn locked_queue(&self) -> LockedQueue<'_> {
        let queue = lock(&self.queue);
        let theirs = self.queue_lock.as_deref();
        if let Some(theirs) = theirs {
            theirs.lock();
        }
        LockedQueue { queue, theirs }
    }

    /// Counts `bytes` that are about to be allocated.
    pub(super) fn reserve(&self, object: &str, bytes: u64) -> Result<()> {
        let before = self.taken.in_use.fetch_add(bytes, Ordering::Relaxed);
        if before.saturating_add(bytes) <= self.taken.limit {
            return Ok(());
        }
        self.release(bytes);
        Err(Error::OutOfMemory {
            object: object.into(),
            bytes,
            detail: format!("{before} bytes of the limit of {} bytes are in use", self.taken.limit),
            may_pass: false,
        })
    }

    /// Returns the current state of the device's memory.
    pub(super) fn memory(&self) -> DeviceMemory {
        DeviceMemory::of(&self.device.instance, self.physical, self.info.free_memory.is_some())
    }

    /// Returns the error for a failed allocation of an object.
    pub(super) fn no_memory(&self, object: &str, bytes: u64, why: &impl std::fmt::Display) -> Error {
        Error::OutOfMemory {
            object: object.into(),
            bytes,
            detail: format!("{why}; {} has {}", self.info.name, self.memory()),
            may_pass: true,
        }
    }

    /// Subtracts bytes that [`Shared::reserve`] counted.
    pub(super) fn release(&self, bytes: u64) {
        self.taken.in_use.fetch_sub(bytes, Ordering::Relaxed);
    }

    pub(super) fn track(&self) {
        self.live_objects.fetch_add(1, Ordering::Relaxed);
    }

    pub(super) fn untrack(&self) {
        self.live_objects.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Shared {
    /// Waits until the timeline reaches a value that was submitted.
    pub(super) fn wait(&self, value: u64) -> Result<()> {
        let (semaphores, values) = ([self.timeline], [value]);
        let wait = vk::SemaphoreWaitInfo::default().semaphores(&semaphores).values(&values);
        // SAFETY: the semaphore is the timeline of this device; both live as long as `self`.
        unsafe { self.device.wait_semaphores(&wait, u64::MAX) }.map_err(Error::vulkan("vkWaitSemaphores", "timeline"))
    }
}

impl Drop for Shared {
    fn drop(&mut self) {
        let leaked = self.live_objects.load(Ordering::Relaxed);
        if leaked > 0 {
            tracing::error!(target: "vulkan", "{leaked} device objects were never freed");
        }
        let submitted = self.last_submitted.load(Ordering::Acquire);
        if submitted > 0 {
            // A lost device has nothing left to wait for.
            let _ = self.wait(submitted);
        }
        // SAFETY: pipelines and recordings, which use these two objects, hold an `Arc` of this struct, so none is left; none of
        // our work is on the queue once the wait returns. The device is destroyed afterwards, with the fields.
        unsafe {
            self.device.destroy_pipeline_cache(self.pipeline_cache, None);
            self.device.destroy_semaphore(self.timeline, None);
        }
    }
}
