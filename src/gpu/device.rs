//! Instance, adapter choice, adoption of someone else's device, validation layer and debug names.

use super::capabilities::{DeviceInfo, DeviceKind, MATRIX_EXTENSIONS, compute_family, describe};
use crate::error::{Error, Result};
use ash::{ext, khr, vk};
use gpu_allocator::AllocationSizes;
use gpu_allocator::vulkan::{Allocator, AllocatorCreateDesc};
use std::ffi::{CStr, CString, c_void};
use std::mem::ManuallyDrop;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

const VALIDATION_LAYER: &CStr = c"VK_LAYER_KHRONOS_validation";

/// How to open a device.
#[derive(Debug, Clone, Default)]
pub struct DeviceOptions {
    /// Index, part of the name (any case) or UUID; `None` takes the best device.
    pub select: Option<String>,
    /// Turn the Khronos validation layer on, with synchronisation validation.
    pub validation: bool,
    /// Directory for the pipeline cache; `None` keeps it in memory only.
    pub cache_dir: Option<std::path::PathBuf>,
    /// Most bytes of buffers and volumes alive at once; `None` leaves the limit to the device.
    pub memory_limit: Option<u64>,
}

/// A device that someone else made and goes on owning; see [`Gpu::adopt`].
pub struct Adoption {
    /// `vkGetInstanceProcAddr` of the owner's loader; `None` takes the system's loader.
    pub get_instance_proc_addr: Option<vk::PFN_vkGetInstanceProcAddr>,
    /// Instance made for Vulkan 1.2 or newer.
    pub instance: vk::Instance,
    /// The physical device.
    pub physical_device: vk::PhysicalDevice,
    /// Device with the feature `timelineSemaphore`.
    pub device: vk::Device,
    /// A queue of it that computes.
    pub queue: vk::Queue,
    /// Family of the queue.
    pub queue_family: u32,
    /// The device was made with the feature `bufferDeviceAddress`.
    pub buffer_device_address: bool,
    /// The device was made with `VK_KHR_external_memory_fd`.
    pub external_memory_fd: bool,
    /// Held around every use of the queue; `None` when the queue is ours alone.
    pub queue_lock: Option<Box<dyn QueueLock>>,
}

/// Keeps several users of one queue apart.
pub trait QueueLock: Send + Sync {
    /// Waits until the queue is free and takes it.
    fn lock(&self);
    /// Gives it back.
    fn unlock(&self);
}

/// An open device. Cheap to clone; everything is freed when the last user is gone.
#[derive(Clone)]
pub struct Gpu {
    pub(super) shared: Arc<Shared>,
}

pub(super) struct Shared {
    pub(super) device: ash::Device,
    pub(super) debug_names: Option<ext::debug_utils::Device>,
    pub(super) queue: Mutex<vk::Queue>,
    pub(super) queue_family: u32,
    pub(super) allocator: Mutex<ManuallyDrop<Allocator>>,
    pub(super) pipeline_cache: vk::PipelineCache,
    pub(super) timeline: vk::Semaphore,
    pub(super) last_submitted: AtomicU64,
    pub(super) live_objects: AtomicU64,
    pub(super) info: DeviceInfo,
    pub(super) instance: ash::Instance,
    pub(super) physical: vk::PhysicalDevice,
    memory: Memory,
    /// Instance and device belong to someone else.
    adopted: bool,
    queue_lock: Option<Box<dyn QueueLock>>,
    cache_file: Option<std::path::PathBuf>,
    messenger: Option<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    messages: Box<Mutex<Vec<String>>>,
    _entry: ash::Entry,
}

/// Bytes of buffers and volumes.
struct Memory {
    in_use: AtomicU64,
    limit: u64,
}

/// A queue that is locked for its owner as well.
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

/// A poisoned lock only means another thread panicked; the guarded state stays valid.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

struct Instance {
    entry: ash::Entry,
    instance: ash::Instance,
}

fn create_instance(validation: bool) -> Result<Instance> {
    // SAFETY: loads the system's Vulkan loader, whose initialisers are trusted as any shared library's are.
    let entry = unsafe { ash::Entry::load() }.map_err(|e| {
        Error::NoDevice(format!(
            "the Vulkan loader could not be opened ({e}). Install it (Debian: libvulkan1) together with a driver \
             (GPU vendor's, or mesa-vulkan-drivers for a CPU driver)"
        ))
    })?;
    let app = vk::ApplicationInfo::default()
        .application_name(c"nertca-vk")
        .engine_name(c"nertca-vk")
        .api_version(vk::API_VERSION_1_2);
    let mut layers = Vec::new();
    let mut extensions = Vec::new();
    if validation {
        // SAFETY: entry is a loaded loader.
        let found = unsafe { entry.enumerate_instance_layer_properties() }
            .map_err(Error::vulkan("vkEnumerateInstanceLayerProperties", "loader"))?;
        if !found.iter().any(|l| l.layer_name_as_c_str().is_ok_and(|n| n == VALIDATION_LAYER)) {
            return Err(Error::NoDevice(
                "validation was asked for, but VK_LAYER_KHRONOS_validation is not installed \
                 (Debian: vulkan-validationlayers)"
                    .into(),
            ));
        }
        layers.push(VALIDATION_LAYER.as_ptr());
        extensions.push(ext::debug_utils::NAME.as_ptr());
    }
    let enabled = [vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION];
    let mut features = vk::ValidationFeaturesEXT::default().enabled_validation_features(&enabled);
    let mut create = vk::InstanceCreateInfo::default()
        .application_info(&app)
        .enabled_layer_names(&layers)
        .enabled_extension_names(&extensions);
    if validation {
        create = create.push_next(&mut features);
    }
    // SAFETY: `create` and all it points to live until the call returns.
    let instance = unsafe { entry.create_instance(&create, None) }
        .map_err(|code| Error::NoDevice(format!("vkCreateInstance failed: {code}")))?;
    Ok(Instance { entry, instance })
}

fn enumerate(entry: &ash::Entry, instance: &ash::Instance) -> Result<Vec<(vk::PhysicalDevice, DeviceInfo)>> {
    // SAFETY: the instance is alive.
    let physical = unsafe { instance.enumerate_physical_devices() }
        .map_err(|code| Error::NoDevice(format!("vkEnumeratePhysicalDevices failed: {code}")))?;
    Ok(physical.into_iter().enumerate().map(|(i, p)| (p, describe(entry, instance, i, p))).collect())
}

/// Lists every device the loader offers, usable or not.
///
/// # Errors
/// [`Error::NoDevice`] when there is no Vulkan loader.
pub fn list_devices() -> Result<Vec<DeviceInfo>> {
    let Instance { entry, instance } = create_instance(false)?;
    let found = enumerate(&entry, &instance).map(|all| all.into_iter().map(|(_, info)| info).collect());
    // SAFETY: nothing made from the instance survives.
    unsafe { instance.destroy_instance(None) };
    drop(entry);
    found
}

fn choose(
    all: Vec<(vk::PhysicalDevice, DeviceInfo)>,
    select: Option<&str>,
) -> Result<(vk::PhysicalDevice, DeviceInfo)> {
    let names = || {
        if all.is_empty() {
            "the loader offers none: install a driver (Debian: mesa-vulkan-drivers for a CPU driver)".to_owned()
        } else {
            let list: Vec<_> = all.iter().map(|(_, d)| format!("{} = {}", d.index, d.name)).collect();
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

unsafe extern "system" fn on_message(
    _severity: vk::DebugUtilsMessageSeverityFlagsEXT,
    _kind: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    user: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: the layer passes valid data; `user` is the boxed mutex, alive as long as the messenger.
    let (data, sink) = unsafe { (&*data, &*user.cast::<Mutex<Vec<String>>>()) };
    // SAFETY: the layer guarantees a valid text or none.
    let text = unsafe { data.message_as_c_str() }.map_or(String::new(), |t| t.to_string_lossy().into_owned());
    tracing::error!(target: "vulkan", "{text}");
    lock(sink).push(text);
    vk::FALSE
}

/// A device on its way to [`Shared`].
struct Own {
    physical: vk::PhysicalDevice,
    info: DeviceInfo,
    device: ash::Device,
    queue: vk::Queue,
    queue_family: u32,
    adopted: bool,
    queue_lock: Option<Box<dyn QueueLock>>,
}

impl Own {
    fn prepare(
        self,
        entry: &ash::Entry,
        instance: &ash::Instance,
        options: &DeviceOptions,
    ) -> Result<impl FnOnce(ash::Entry, ash::Instance) -> Shared + use<>> {
        let Own { physical, info, device, queue, queue_family, adopted, queue_lock } = self;
        let allocator = Allocator::new(&AllocatorCreateDesc {
            instance: instance.clone(),
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
        let mut kind =
            vk::SemaphoreTypeCreateInfo::default().semaphore_type(vk::SemaphoreType::TIMELINE).initial_value(0);
        // SAFETY: the device is alive; timeline semaphores are enabled.
        let timeline =
            unsafe { device.create_semaphore(&vk::SemaphoreCreateInfo::default().push_next(&mut kind), None) }
                .map_err(Error::vulkan("vkCreateSemaphore", "timeline"))?;
        let cache_file = options
            .cache_dir
            .as_ref()
            .map(|dir| dir.join(format!("pipelines-{}-{}.bin", info.uuid, env!("CARGO_PKG_VERSION"))));
        // An unreadable or foreign cache is ignored by the driver, which checks its header.
        let cached = cache_file.as_ref().and_then(|f| std::fs::read(f).ok()).unwrap_or_default();
        // SAFETY: `cached` lives until the call returns.
        let pipeline_cache = unsafe {
            device.create_pipeline_cache(&vk::PipelineCacheCreateInfo::default().initial_data(&cached), None)
        }
        .map_err(Error::vulkan("vkCreatePipelineCache", &info.name))?;
        let messages = Box::new(Mutex::new(Vec::new()));
        let mut messenger = None;
        let mut debug_names = None;
        if options.validation && !adopted {
            let debug = ext::debug_utils::Instance::new(entry, instance);
            let create = vk::DebugUtilsMessengerCreateInfoEXT::default()
                .message_severity(
                    vk::DebugUtilsMessageSeverityFlagsEXT::ERROR | vk::DebugUtilsMessageSeverityFlagsEXT::WARNING,
                )
                .message_type(
                    vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION | vk::DebugUtilsMessageTypeFlagsEXT::PERFORMANCE,
                )
                .pfn_user_callback(Some(on_message))
                .user_data(std::ptr::from_ref::<Mutex<Vec<String>>>(&messages).cast_mut().cast());
            // SAFETY: the callback and its data outlive the messenger, which `Shared::drop` destroys first.
            let handle = unsafe { debug.create_debug_utils_messenger(&create, None) }
                .map_err(Error::vulkan("vkCreateDebugUtilsMessengerEXT", "messenger"))?;
            messenger = Some((debug, handle));
            debug_names = Some(ext::debug_utils::Device::new(instance, &device));
        }
        let memory = Memory { in_use: AtomicU64::new(0), limit: options.memory_limit.unwrap_or(u64::MAX) };
        Ok(move |entry, instance| Shared {
            device,
            debug_names,
            queue: Mutex::new(queue),
            queue_family,
            allocator: Mutex::new(ManuallyDrop::new(allocator)),
            pipeline_cache,
            timeline,
            last_submitted: AtomicU64::new(0),
            live_objects: AtomicU64::new(0),
            info,
            instance,
            physical,
            memory,
            adopted,
            queue_lock,
            cache_file,
            messenger,
            messages,
            _entry: entry,
        })
    }
}

impl Gpu {
    /// Opens a device.
    ///
    /// # Errors
    /// [`Error::NoDevice`] when none fits, with the list of those found.
    pub fn open(options: &DeviceOptions) -> Result<Gpu> {
        let Instance { entry, instance } = create_instance(options.validation)?;
        let opened = Self::open_on(&entry, &instance, options);
        match opened {
            Ok(parts) => Ok(Gpu { shared: Arc::new(parts(entry, instance)) }),
            Err(e) => {
                // SAFETY: nothing made from the instance survives a failed `open_on`.
                unsafe { instance.destroy_instance(None) };
                Err(e)
            }
        }
    }

    fn open_on(
        entry: &ash::Entry,
        instance: &ash::Instance,
        options: &DeviceOptions,
    ) -> Result<impl FnOnce(ash::Entry, ash::Instance) -> Shared + use<>> {
        let (physical, info) = choose(enumerate(entry, instance)?, options.select.as_deref())?;
        let queue_family = compute_family(instance, physical)
            .ok_or_else(|| Error::NoDevice(format!("{}: no compute queue", info.name)))?;
        let priorities = [1.0];
        let queues =
            [vk::DeviceQueueCreateInfo::default().queue_family_index(queue_family).queue_priorities(&priorities)];
        let mut f12 = vk::PhysicalDeviceVulkan12Features::default()
            .timeline_semaphore(true)
            .buffer_device_address(info.buffer_device_address);
        let mut matrix = vk::PhysicalDeviceCooperativeMatrixFeaturesKHR::default().cooperative_matrix(true);
        let mut size = vk::PhysicalDeviceSubgroupSizeControlFeatures::default()
            .subgroup_size_control(true)
            .compute_full_subgroups(true);
        let mut extensions = Vec::new();
        if info.external_memory_fd {
            extensions.push(khr::external_memory_fd::NAME.as_ptr());
        }
        let mut create = vk::DeviceCreateInfo::default().queue_create_infos(&queues);
        if !info.matrices.is_empty() {
            f12 = f12.shader_float16(true).vulkan_memory_model(true).vulkan_memory_model_device_scope(true);
            extensions.extend(MATRIX_EXTENSIONS.map(CStr::as_ptr));
            create = create.push_next(&mut matrix).push_next(&mut size);
        }
        let create = create.enabled_extension_names(&extensions).push_next(&mut f12);
        // SAFETY: the chain lives until the call returns; the features were checked in `describe`.
        let device = unsafe { instance.create_device(physical, &create, None) }
            .map_err(Error::vulkan("vkCreateDevice", &info.name))?;
        // SAFETY: the family was requested with one queue.
        let queue = unsafe { device.get_device_queue(queue_family, 0) };
        let own = Own { physical, info, device, queue, queue_family, adopted: false, queue_lock: None };
        own.prepare(entry, instance, options)
    }

    /// Works on a device someone else made. Instance and device must outlive the last clone, and are left as they are.
    ///
    /// # Errors
    /// [`Error::NoDevice`] when the device lacks what the engine needs.
    ///
    /// # Safety
    /// The handles must be valid and belong together; the device must have been made with what `adoption` says, and
    /// the queue be used by others only while they hold the lock.
    pub unsafe fn adopt(adoption: Adoption, options: &DeviceOptions) -> Result<Gpu> {
        let entry = match adoption.get_instance_proc_addr {
            Some(get_instance_proc_addr) => {
                let functions = ash::StaticFn { get_instance_proc_addr };
                // SAFETY: the caller vouches for the function.
                unsafe { ash::Entry::from_static_fn(functions) }
            }
            // SAFETY: loads the system's Vulkan loader, whose initialisers are trusted as any shared library's are.
            None => unsafe { ash::Entry::load() }.map_err(|e| Error::NoDevice(format!("no Vulkan loader: {e}")))?,
        };
        // SAFETY: the caller vouches for the instance.
        let instance = unsafe { ash::Instance::load(entry.static_fn(), adoption.instance) };
        let mut info = describe(&entry, &instance, 0, adoption.physical_device);
        if let Some(why) = &info.unusable {
            return Err(Error::NoDevice(format!("{}: {why}", info.name)));
        }
        // SAFETY: as above.
        let device = unsafe { ash::Device::load(instance.fp_v1_0(), adoption.device) };
        // SAFETY: as above.
        let wait = unsafe { instance.get_device_proc_addr(adoption.device, c"vkWaitSemaphores".as_ptr()) };
        if wait.is_none() {
            return Err(Error::NoDevice(format!("{}: the device was not made for Vulkan 1.2", info.name)));
        }
        // What a device was made with cannot be asked of it.
        info.buffer_device_address &= adoption.buffer_device_address;
        info.external_memory_fd &= adoption.external_memory_fd;
        info.matrices.clear();
        let own = Own {
            physical: adoption.physical_device,
            info,
            device,
            queue: adoption.queue,
            queue_family: adoption.queue_family,
            adopted: true,
            queue_lock: adoption.queue_lock,
        };
        let finish = own.prepare(&entry, &instance, options)?;
        Ok(Gpu { shared: Arc::new(finish(entry, instance)) })
    }

    /// What this device is and can do.
    pub fn info(&self) -> &DeviceInfo {
        &self.shared.info
    }

    /// Errors and warnings of the validation layer so far; empty without validation.
    pub fn validation_messages(&self) -> Vec<String> {
        lock(&self.shared.messages).clone()
    }

    /// Buffers, pipelines and recordings alive at the moment; 0 once all are dropped.
    pub fn live_objects(&self) -> u64 {
        self.shared.live_objects.load(Ordering::Relaxed)
    }

    /// Bytes of buffers and volumes alive at the moment.
    pub fn memory_in_use(&self) -> u64 {
        self.shared.memory.in_use.load(Ordering::Relaxed)
    }

    /// Writes the pipeline cache to disk so that the next start compiles nothing.
    ///
    /// # Errors
    /// [`Error::Io`] when the directory cannot be written.
    pub fn save_pipeline_cache(&self) -> Result<()> {
        let Some(file) = &self.shared.cache_file else {
            return Ok(());
        };
        // SAFETY: the cache belongs to this device.
        let data = unsafe { self.shared.device.get_pipeline_cache_data(self.shared.pipeline_cache) }
            .map_err(Error::vulkan("vkGetPipelineCacheData", "pipeline cache"))?;
        crate::files::write_atomic(file, &data)
    }
}

impl Shared {
    pub(super) fn set_name<H: vk::Handle>(&self, handle: H, name: &str) {
        if let (Some(debug), Ok(name)) = (&self.debug_names, CString::new(name)) {
            let info = vk::DebugUtilsObjectNameInfoEXT::default().object_handle(handle).object_name(&name);
            // A missing name only makes messages less readable, so a failure is not an error.
            // SAFETY: the handle belongs to this device.
            let _ = unsafe { debug.set_debug_utils_object_name(&info) };
        }
    }

    /// The queue, for a submit.
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
        let before = self.memory.in_use.fetch_add(bytes, Ordering::Relaxed);
        if before.saturating_add(bytes) <= self.memory.limit {
            return Ok(());
        }
        self.release(bytes);
        Err(Error::OutOfMemory {
            object: object.into(),
            bytes,
            detail: format!("{before} bytes of the limit of {} are in use", self.memory.limit),
            may_pass: false,
        })
    }

    /// Gives back what [`Shared::reserve`] counted.
    pub(super) fn release(&self, bytes: u64) {
        self.memory.in_use.fetch_sub(bytes, Ordering::Relaxed);
    }

    pub(super) fn track(&self) {
        self.live_objects.fetch_add(1, Ordering::Relaxed);
    }

    pub(super) fn untrack(&self) {
        self.live_objects.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Drop for Shared {
    fn drop(&mut self) {
        let leaked = self.live_objects.load(Ordering::Relaxed);
        if leaked > 0 {
            tracing::error!(target: "vulkan", "{leaked} device objects were never freed");
        }
        // A lost device has nothing left to wait for.
        let _ = self.wait(self.last_submitted.load(Ordering::Acquire));
        // SAFETY: every object made from the device holds an `Arc` of this struct, so none is left; nothing of ours is
        // on the queue once the wait returns.
        unsafe {
            ManuallyDrop::drop(&mut *lock(&self.allocator));
            self.device.destroy_pipeline_cache(self.pipeline_cache, None);
            self.device.destroy_semaphore(self.timeline, None);
            if self.adopted {
                return;
            }
            self.device.destroy_device(None);
            if let Some((debug, messenger)) = self.messenger.take() {
                debug.destroy_debug_utils_messenger(messenger, None);
            }
            self.instance.destroy_instance(None);
        }
    }
}
