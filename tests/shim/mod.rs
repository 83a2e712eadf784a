//! A Vulkan loader between the engine and the system's loader: it counts created and destroyed objects, makes calls fail on
//! request, fills new memory with a pattern, places canaries behind each buffer, and hides features of devices. There is
//! one state per thread, since the engine calls Vulkan on its caller's thread unless another is started.
#![allow(dead_code, missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "each test file uses its part")]
#![allow(clippy::missing_safety_doc, clippy::undocumented_unsafe_blocks, reason = "passes on what it is given")]

use ash::vk;
use nertca_vk::gpu::instance::Loader;
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::ffi::{CStr, c_char, c_void};
use std::sync::OnceLock;

/// Calls that are to fail.
#[derive(Debug, Clone, Copy, Default)]
pub enum Failing {
    #[default]
    None,
    /// The n-th call that can fail, counted from 1.
    Once(u32, vk::Result),
    /// The n-th call and all that follow.
    From(u32, vk::Result),
    /// Every call of a function.
    Every(&'static str, vk::Result),
}

/// A pattern in new memory, and the results of its checks.
#[derive(Default)]
struct Poison {
    word: u32,
    /// Host addresses of memory.
    mapped: BTreeMap<vk::DeviceMemory, usize>,
    /// Buffers with their size, and their addresses once they are bound.
    buffers: BTreeMap<vk::Buffer, (u64, Option<usize>)>,
    filled: u32,
    unreachable: u32,
    broken: Vec<String>,
}

#[derive(Default)]
struct State {
    instance: vk::Instance,
    calls: u32,
    failing: Failing,
    failed: Vec<&'static str>,
    /// Objects alive by kind.
    alive: BTreeMap<&'static str, i64>,
    poison: Option<Poison>,
    /// Code of a shader, and the code that the driver receives instead.
    planted: Option<(Vec<u32>, Vec<u32>)>,
    /// Capabilities that devices claim to have.
    poor: Option<Poor>,
}

/// Capabilities that a device may still claim to have.
#[derive(Debug, Clone, Copy)]
pub struct Poor {
    /// Device extensions.
    pub extensions: bool,
    /// Buffer addresses and 16-bit floats.
    pub features: bool,
    /// Timestamps.
    pub timestamps: bool,
    /// Function that lowers limits.
    pub limits: fn(&mut vk::PhysicalDeviceLimits),
    /// Bytes of each heap that are free for use, where the device reports this.
    pub free_memory: Option<u64>,
}

thread_local! {
    static STATE: RefCell<State> = RefCell::default();
}

fn with<T>(body: impl FnOnce(&mut State) -> T) -> T {
    STATE.with_borrow_mut(body)
}

/// Results of one session.
#[derive(Debug)]
pub struct Outcome {
    /// Calls that could fail.
    pub calls: u32,
    /// Calls that were made to fail.
    pub failed: Vec<&'static str>,
    /// Number of objects created minus the number destroyed, by kind, where not 0.
    pub left: BTreeMap<&'static str, i64>,
}

/// Resets the counters.
pub fn begin(failing: Failing) {
    with(|state| *state = State { failing, ..State::default() });
}

/// Changes the calls that are to fail, without a reset of the counters.
pub fn fail(failing: Failing) {
    with(|state| state.failing = failing);
}

/// Number of live memory allocations.
pub fn pieces_of_memory() -> i64 {
    with(|state| state.alive.get(std::any::type_name::<vk::DeviceMemory>()).copied().unwrap_or_default())
}

/// Returns the results since the last reset.
pub fn end() -> Outcome {
    with(|state| {
        let left = state.alive.iter().filter(|(_, n)| **n != 0).map(|(kind, n)| (*kind, *n)).collect();
        Outcome { calls: state.calls, failed: std::mem::take(&mut state.failed), left }
    })
}

/// Bytes behind each buffer that must not be accessed.
pub const CANARY_BYTES: u64 = 4096;

/// Begins to fill new buffers, and the canaries behind them, with `word`.
pub fn begin_poison(word: u32) {
    begin(Failing::None);
    with(|state| state.poison = Some(Poison { word, ..Poison::default() }));
}

/// Number of buffers that were filled, number that could not be filled because they have no host address, and the canaries
/// that were found overwritten when their buffer was destroyed.
pub fn end_poison() -> (u32, u32, Vec<String>) {
    with(|state| {
        let poison = state.poison.take().unwrap();
        (poison.filled, poison.unreachable, poison.broken)
    })
}

/// Hides capabilities of devices from now on.
pub fn impoverish(poor: Poor) {
    begin(Failing::None);
    with(|state| state.poor = Some(poor));
}

/// Passes `faulty` to the driver from now on where the engine uses `code`.
pub fn plant(code: Vec<u32>, faulty: Vec<u32>) {
    with(|state| state.planted = Some((code, faulty)));
}

/// The loader for opening a device.
pub fn loader() -> Loader {
    unsafe { Loader::new(get_instance_proc_addr) }
}

/// The entry points of this loader, for a host that creates a device itself.
pub fn entry() -> ash::Entry {
    unsafe { ash::Entry::from_static_fn(ash::StaticFn { get_instance_proc_addr }) }
}

type Void = unsafe extern "system" fn();
type Callbacks = *const vk::AllocationCallbacks<'static>;

fn system() -> &'static ash::Entry {
    static ENTRY: OnceLock<ash::Entry> = OnceLock::new();
    ENTRY.get_or_init(|| unsafe { ash::Entry::load() }.unwrap())
}

/// Parent object of a call, which gives the address of the real function.
trait Parent: Copy {
    unsafe fn real(self, name: &CStr) -> Void;
}

impl Parent for vk::Instance {
    unsafe fn real(self, name: &CStr) -> Void {
        unsafe { (system().static_fn().get_instance_proc_addr)(self, name.as_ptr()) }.unwrap()
    }
}

impl Parent for vk::PhysicalDevice {
    unsafe fn real(self, name: &CStr) -> Void {
        unsafe { with(|state| state.instance).real(name) }
    }
}

impl Parent for vk::Device {
    unsafe fn real(self, name: &CStr) -> Void {
        let find = unsafe { with(|state| state.instance).real(c"vkGetDeviceProcAddr") };
        let find: vk::PFN_vkGetDeviceProcAddr = unsafe { std::mem::transmute(find) };
        unsafe { find(self, name.as_ptr()) }.unwrap()
    }
}

impl Parent for vk::CommandBuffer {
    unsafe fn real(self, name: &CStr) -> Void {
        unsafe { with(|state| state.instance).real(name) }
    }
}

impl Parent for vk::Queue {
    unsafe fn real(self, name: &CStr) -> Void {
        unsafe { with(|state| state.instance).real(name) }
    }
}

/// Counts a call; returns its error if it is to fail.
fn attempt(name: &'static str) -> Option<vk::Result> {
    with(|state| {
        state.calls += 1;
        let code = match state.failing {
            Failing::Once(n, code) if state.calls == n => code,
            Failing::From(n, code) if state.calls >= n => code,
            Failing::Every(which, code) if which == name => code,
            _ => return None,
        };
        state.failed.push(name);
        Some(code)
    })
}

fn count(kind: &'static str, by: i64) {
    with(|state| *state.alive.entry(kind).or_default() += by);
}

/// Functions that create an object, `vkCreateX(parent, info, callbacks, out)`.
macro_rules! creating {
    ($($name:ident($parent:ty, $info:ty) -> $handle:ty;)*) => {
        $(
            #[allow(non_snake_case)]
            unsafe extern "system" fn $name(
                parent: $parent,
                info: *const $info,
                callbacks: Callbacks,
                out: *mut $handle,
            ) -> vk::Result {
                type Real = unsafe extern "system" fn($parent, *const $info, Callbacks, *mut $handle) -> vk::Result;
                if let Some(code) = attempt(stringify!($name)) {
                    return code;
                }
                let name = CStr::from_bytes_with_nul(concat!(stringify!($name), "\0").as_bytes()).unwrap();
                let real: Real = unsafe { std::mem::transmute(parent.real(name)) };
                let code = unsafe { real(parent, info, callbacks, out) };
                if code == vk::Result::SUCCESS {
                    count(std::any::type_name::<$handle>(), 1);
                }
                code
            }
        )*

        fn creating(name: &str) -> Option<*const ()> {
            match name {
                $(stringify!($name) => Some($name as *const ()),)*
                _ => None,
            }
        }
    };
}

/// Functions that destroy an object, `vkDestroyX(parent, handle, callbacks)`.
macro_rules! destroying {
    ($($name:ident($parent:ty, $handle:ty);)*) => {
        $(
            #[allow(non_snake_case)]
            unsafe extern "system" fn $name(parent: $parent, handle: $handle, callbacks: Callbacks) {
                type Real = unsafe extern "system" fn($parent, $handle, Callbacks);
                if handle != <$handle>::null() {
                    count(std::any::type_name::<$handle>(), -1);
                }
                let name = CStr::from_bytes_with_nul(concat!(stringify!($name), "\0").as_bytes()).unwrap();
                let real: Real = unsafe { std::mem::transmute(parent.real(name)) };
                unsafe { real(parent, handle, callbacks) }
            }
        )*

        fn destroying(name: &str) -> Option<*const ()> {
            match name {
                $(stringify!($name) => Some($name as *const ()),)*
                _ => None,
            }
        }
    };
}

/// Other functions that may fail.
macro_rules! fallible {
    ($($name:ident($parent:ty $(, $arg:ident: $type:ty)*);)*) => {
        $(
            #[allow(non_snake_case)]
            unsafe extern "system" fn $name(parent: $parent $(, $arg: $type)*) -> vk::Result {
                type Real = unsafe extern "system" fn($parent $(, $type)*) -> vk::Result;
                let name = CStr::from_bytes_with_nul(concat!(stringify!($name), "\0").as_bytes()).unwrap();
                let call = || {
                    let real: Real = unsafe { std::mem::transmute(parent.real(name)) };
                    unsafe { real(parent $(, $arg)*) }
                };
                match attempt(stringify!($name)) {
                    Some(code) => {
                        // Even if it reports a failure, no work is running after a wait has returned.
                        if stringify!($name) == "vkWaitSemaphores" {
                            let _ = call();
                        }
                        code
                    }
                    None => call(),
                }
            }
        )*

        fn fallible(name: &str) -> Option<*const ()> {
            match name {
                $(stringify!($name) => Some($name as *const ()),)*
                _ => None,
            }
        }
    };
}

creating! {
    vkCreateDebugUtilsMessengerEXT(vk::Instance, vk::DebugUtilsMessengerCreateInfoEXT<'static>)
        -> vk::DebugUtilsMessengerEXT;
    vkCreateDevice(vk::PhysicalDevice, vk::DeviceCreateInfo<'static>) -> vk::Device;
    vkAllocateMemory(vk::Device, vk::MemoryAllocateInfo<'static>) -> vk::DeviceMemory;
    vkCreateBufferView(vk::Device, vk::BufferViewCreateInfo<'static>) -> vk::BufferView;
    vkCreateCommandPool(vk::Device, vk::CommandPoolCreateInfo<'static>) -> vk::CommandPool;
    vkCreateDescriptorPool(vk::Device, vk::DescriptorPoolCreateInfo<'static>) -> vk::DescriptorPool;
    vkCreateDescriptorSetLayout(vk::Device, vk::DescriptorSetLayoutCreateInfo<'static>) -> vk::DescriptorSetLayout;
    vkCreateImage(vk::Device, vk::ImageCreateInfo<'static>) -> vk::Image;
    vkCreateImageView(vk::Device, vk::ImageViewCreateInfo<'static>) -> vk::ImageView;
    vkCreatePipelineCache(vk::Device, vk::PipelineCacheCreateInfo<'static>) -> vk::PipelineCache;
    vkCreatePipelineLayout(vk::Device, vk::PipelineLayoutCreateInfo<'static>) -> vk::PipelineLayout;
    vkCreateQueryPool(vk::Device, vk::QueryPoolCreateInfo<'static>) -> vk::QueryPool;
    vkCreateSampler(vk::Device, vk::SamplerCreateInfo<'static>) -> vk::Sampler;
    vkCreateSemaphore(vk::Device, vk::SemaphoreCreateInfo<'static>) -> vk::Semaphore;
}

destroying! {
    vkDestroyDebugUtilsMessengerEXT(vk::Instance, vk::DebugUtilsMessengerEXT);
    vkFreeMemory(vk::Device, vk::DeviceMemory);
    vkDestroyBufferView(vk::Device, vk::BufferView);
    vkDestroyCommandPool(vk::Device, vk::CommandPool);
    vkDestroyDescriptorPool(vk::Device, vk::DescriptorPool);
    vkDestroyDescriptorSetLayout(vk::Device, vk::DescriptorSetLayout);
    vkDestroyImage(vk::Device, vk::Image);
    vkDestroyImageView(vk::Device, vk::ImageView);
    vkDestroyPipeline(vk::Device, vk::Pipeline);
    vkDestroyPipelineCache(vk::Device, vk::PipelineCache);
    vkDestroyPipelineLayout(vk::Device, vk::PipelineLayout);
    vkDestroyQueryPool(vk::Device, vk::QueryPool);
    vkDestroySampler(vk::Device, vk::Sampler);
    vkDestroySemaphore(vk::Device, vk::Semaphore);
    vkDestroyShaderModule(vk::Device, vk::ShaderModule);
}

fallible! {
    vkEnumeratePhysicalDevices(vk::Instance, count: *mut u32, out: *mut vk::PhysicalDevice);
    vkGetPhysicalDeviceCooperativeMatrixPropertiesKHR(
        vk::PhysicalDevice, count: *mut u32, out: *mut vk::CooperativeMatrixPropertiesKHR<'static>);
    vkAllocateCommandBuffers(
        vk::Device, info: *const vk::CommandBufferAllocateInfo<'static>, out: *mut vk::CommandBuffer);
    vkAllocateDescriptorSets(
        vk::Device, info: *const vk::DescriptorSetAllocateInfo<'static>, out: *mut vk::DescriptorSet);
    vkBindImageMemory(vk::Device, image: vk::Image, memory: vk::DeviceMemory, offset: u64);
    vkWaitSemaphores(vk::Device, info: *const vk::SemaphoreWaitInfo<'static>, timeout: u64);
    vkGetMemoryFdKHR(vk::Device, info: *const vk::MemoryGetFdInfoKHR<'static>, fd: *mut i32);
    vkGetPipelineCacheData(vk::Device, cache: vk::PipelineCache, size: *mut usize, data: *mut c_void);
    vkGetQueryPoolResults(
        vk::Device, pool: vk::QueryPool, first: u32, count: u32, size: usize, data: *mut c_void, stride: u64,
        flags: vk::QueryResultFlags);
    vkBeginCommandBuffer(vk::CommandBuffer, info: *const vk::CommandBufferBeginInfo<'static>);
    vkEndCommandBuffer(vk::CommandBuffer);
    vkQueueSubmit(vk::Queue, count: u32, submits: *const vk::SubmitInfo<'static>, fence: vk::Fence);
}

// Functions with a different signature, or that do more than count.

#[allow(non_snake_case)]
unsafe extern "system" fn vkEnumerateInstanceLayerProperties(
    count: *mut u32,
    out: *mut vk::LayerProperties,
) -> vk::Result {
    if let Some(code) = attempt("vkEnumerateInstanceLayerProperties") {
        return code;
    }
    let real: vk::PFN_vkEnumerateInstanceLayerProperties =
        unsafe { std::mem::transmute(vk::Instance::null().real(c"vkEnumerateInstanceLayerProperties")) };
    unsafe { real(count, out) }
}

#[allow(non_snake_case)]
unsafe extern "system" fn vkEnumerateInstanceExtensionProperties(
    layer: *const c_char,
    count: *mut u32,
    out: *mut vk::ExtensionProperties,
) -> vk::Result {
    if let Some(code) = attempt("vkEnumerateInstanceExtensionProperties") {
        return code;
    }
    let real: vk::PFN_vkEnumerateInstanceExtensionProperties =
        unsafe { std::mem::transmute(vk::Instance::null().real(c"vkEnumerateInstanceExtensionProperties")) };
    unsafe { real(layer, count, out) }
}

#[allow(non_snake_case)]
unsafe extern "system" fn vkEnumerateDeviceExtensionProperties(
    device: vk::PhysicalDevice,
    layer: *const c_char,
    count: *mut u32,
    out: *mut vk::ExtensionProperties,
) -> vk::Result {
    if let Some(code) = attempt("vkEnumerateDeviceExtensionProperties") {
        return code;
    }
    if with(|state| state.poor).is_some_and(|poor| !poor.extensions) {
        unsafe { *count = 0 };
        return vk::Result::SUCCESS;
    }
    let real: vk::PFN_vkEnumerateDeviceExtensionProperties =
        unsafe { std::mem::transmute(device.real(c"vkEnumerateDeviceExtensionProperties")) };
    unsafe { real(device, layer, count, out) }
}

#[allow(non_snake_case)]
unsafe extern "system" fn vkGetPhysicalDeviceProperties2(
    device: vk::PhysicalDevice,
    out: *mut vk::PhysicalDeviceProperties2<'_>,
) {
    let real: vk::PFN_vkGetPhysicalDeviceProperties2 =
        unsafe { std::mem::transmute(device.real(c"vkGetPhysicalDeviceProperties2")) };
    unsafe { real(device, out) };
    if let Some(poor) = with(|state| state.poor) {
        (poor.limits)(unsafe { &mut (*out).properties.limits });
    }
}

#[allow(non_snake_case)]
unsafe extern "system" fn vkGetPhysicalDeviceFeatures2(
    device: vk::PhysicalDevice,
    out: *mut vk::PhysicalDeviceFeatures2<'_>,
) {
    let real: vk::PFN_vkGetPhysicalDeviceFeatures2 =
        unsafe { std::mem::transmute(device.real(c"vkGetPhysicalDeviceFeatures2")) };
    unsafe { real(device, out) };
    if with(|state| state.poor).is_none_or(|poor| poor.features) {
        return;
    }
    let mut next = unsafe { (*out).p_next.cast::<vk::BaseOutStructure<'_>>() };
    while let Some(structure) = unsafe { next.as_mut() } {
        if structure.s_type == vk::StructureType::PHYSICAL_DEVICE_VULKAN_1_2_FEATURES {
            let features = unsafe { &mut *next.cast::<vk::PhysicalDeviceVulkan12Features<'_>>() };
            features.buffer_device_address = vk::FALSE;
            features.shader_float16 = vk::FALSE;
        }
        next = structure.p_next;
    }
}

#[allow(non_snake_case)]
unsafe extern "system" fn vkGetPhysicalDeviceMemoryProperties2(
    device: vk::PhysicalDevice,
    out: *mut vk::PhysicalDeviceMemoryProperties2<'_>,
) {
    let real: vk::PFN_vkGetPhysicalDeviceMemoryProperties2 =
        unsafe { std::mem::transmute(device.real(c"vkGetPhysicalDeviceMemoryProperties2")) };
    unsafe { real(device, out) };
    let Some(free) = with(|state| state.poor).and_then(|poor| poor.free_memory) else { return };
    let mut next = unsafe { (*out).p_next }.cast::<vk::BaseOutStructure<'_>>();
    while let Some(structure) = unsafe { next.as_mut() } {
        if structure.s_type == vk::StructureType::PHYSICAL_DEVICE_MEMORY_BUDGET_PROPERTIES_EXT {
            let told = unsafe { &mut *next.cast::<vk::PhysicalDeviceMemoryBudgetPropertiesEXT<'_>>() };
            told.heap_budget = told.heap_usage.map(|usage| usage + free);
        }
        next = structure.p_next;
    }
}

#[allow(non_snake_case)]
unsafe extern "system" fn vkGetPhysicalDeviceQueueFamilyProperties(
    device: vk::PhysicalDevice,
    count: *mut u32,
    out: *mut vk::QueueFamilyProperties,
) {
    let real: vk::PFN_vkGetPhysicalDeviceQueueFamilyProperties =
        unsafe { std::mem::transmute(device.real(c"vkGetPhysicalDeviceQueueFamilyProperties")) };
    unsafe { real(device, count, out) };
    if !out.is_null() && with(|state| state.poor).is_some_and(|poor| !poor.timestamps) {
        for family in unsafe { std::slice::from_raw_parts_mut(out, *count as usize) } {
            family.timestamp_valid_bits = 0;
        }
    }
}

#[allow(non_snake_case)]
unsafe extern "system" fn vkCreateInstance(
    info: *const vk::InstanceCreateInfo<'_>,
    callbacks: *const vk::AllocationCallbacks<'_>,
    out: *mut vk::Instance,
) -> vk::Result {
    if let Some(code) = attempt("vkCreateInstance") {
        return code;
    }
    let real: vk::PFN_vkCreateInstance = unsafe { std::mem::transmute(vk::Instance::null().real(c"vkCreateInstance")) };
    let code = unsafe { real(info, callbacks, out) };
    if code == vk::Result::SUCCESS {
        with(|state| state.instance = unsafe { *out });
        count(std::any::type_name::<vk::Instance>(), 1);
    }
    code
}

#[allow(non_snake_case)]
unsafe extern "system" fn vkDestroyInstance(instance: vk::Instance, callbacks: *const vk::AllocationCallbacks<'_>) {
    let real: vk::PFN_vkDestroyInstance = unsafe { std::mem::transmute(instance.real(c"vkDestroyInstance")) };
    count(std::any::type_name::<vk::Instance>(), -1);
    unsafe { real(instance, callbacks) }
}

#[allow(non_snake_case)]
unsafe extern "system" fn vkDestroyDevice(device: vk::Device, callbacks: *const vk::AllocationCallbacks<'_>) {
    let real: vk::PFN_vkDestroyDevice = unsafe { std::mem::transmute(device.real(c"vkDestroyDevice")) };
    count(std::any::type_name::<vk::Device>(), -1);
    unsafe { real(device, callbacks) }
}

#[allow(non_snake_case)]
unsafe extern "system" fn vkCreateComputePipelines(
    device: vk::Device,
    cache: vk::PipelineCache,
    n: u32,
    infos: *const vk::ComputePipelineCreateInfo<'_>,
    callbacks: *const vk::AllocationCallbacks<'_>,
    out: *mut vk::Pipeline,
) -> vk::Result {
    if let Some(code) = attempt("vkCreateComputePipelines") {
        unsafe { std::slice::from_raw_parts_mut(out, n as usize) }.fill(vk::Pipeline::null());
        return code;
    }
    let real: vk::PFN_vkCreateComputePipelines =
        unsafe { std::mem::transmute(device.real(c"vkCreateComputePipelines")) };
    let code = unsafe { real(device, cache, n, infos, callbacks, out) };
    if code == vk::Result::SUCCESS {
        count(std::any::type_name::<vk::Pipeline>(), i64::from(n));
    }
    code
}

#[allow(non_snake_case)]
unsafe extern "system" fn vkCreateShaderModule(
    device: vk::Device,
    info: *const vk::ShaderModuleCreateInfo<'_>,
    callbacks: *const vk::AllocationCallbacks<'_>,
    out: *mut vk::ShaderModule,
) -> vk::Result {
    if let Some(code) = attempt("vkCreateShaderModule") {
        return code;
    }
    let real: vk::PFN_vkCreateShaderModule = unsafe { std::mem::transmute(device.real(c"vkCreateShaderModule")) };
    let mut info = unsafe { *info };
    let words = unsafe { std::slice::from_raw_parts(info.p_code, info.code_size / 4) };
    let faulty = with(|state| state.planted.clone().filter(|(code, _)| code == words).map(|(_, faulty)| faulty));
    if let Some(faulty) = &faulty {
        (info.p_code, info.code_size) = (faulty.as_ptr(), 4 * faulty.len());
    }
    let code = unsafe { real(device, &info, callbacks, out) };
    if code == vk::Result::SUCCESS {
        count(std::any::type_name::<vk::ShaderModule>(), 1);
    }
    code
}

#[allow(non_snake_case)]
unsafe extern "system" fn vkCreateBuffer(
    device: vk::Device,
    info: *const vk::BufferCreateInfo<'_>,
    callbacks: *const vk::AllocationCallbacks<'_>,
    out: *mut vk::Buffer,
) -> vk::Result {
    if let Some(code) = attempt("vkCreateBuffer") {
        return code;
    }
    let real: vk::PFN_vkCreateBuffer = unsafe { std::mem::transmute(device.real(c"vkCreateBuffer")) };
    let mut info = unsafe { *info };
    let size = info.size;
    if with(|state| state.poison.is_some()) {
        info.size += CANARY_BYTES;
    }
    let code = unsafe { real(device, &info, callbacks, out) };
    if code == vk::Result::SUCCESS {
        count(std::any::type_name::<vk::Buffer>(), 1);
        with(|state| {
            if let Some(poison) = &mut state.poison {
                poison.buffers.insert(unsafe { *out }, (size, None));
            }
        });
    }
    code
}

#[allow(non_snake_case)]
unsafe extern "system" fn vkMapMemory(
    device: vk::Device,
    memory: vk::DeviceMemory,
    offset: u64,
    size: u64,
    flags: vk::MemoryMapFlags,
    out: *mut *mut c_void,
) -> vk::Result {
    if let Some(code) = attempt("vkMapMemory") {
        return code;
    }
    let real: vk::PFN_vkMapMemory = unsafe { std::mem::transmute(device.real(c"vkMapMemory")) };
    let code = unsafe { real(device, memory, offset, size, flags, out) };
    with(|state| {
        if let (vk::Result::SUCCESS, Some(poison)) = (code, &mut state.poison) {
            poison.mapped.insert(memory, unsafe { *out }.expose_provenance() - offset as usize);
        }
    });
    code
}

/// Words of a bound buffer and of the canary behind it.
unsafe fn words<'a>(address: usize, bytes: u64) -> &'a mut [u32] {
    unsafe { std::slice::from_raw_parts_mut(std::ptr::with_exposed_provenance_mut(address), bytes as usize / 4) }
}

#[allow(non_snake_case)]
unsafe extern "system" fn vkBindBufferMemory(
    device: vk::Device,
    buffer: vk::Buffer,
    memory: vk::DeviceMemory,
    offset: u64,
) -> vk::Result {
    if let Some(code) = attempt("vkBindBufferMemory") {
        return code;
    }
    let real: vk::PFN_vkBindBufferMemory = unsafe { std::mem::transmute(device.real(c"vkBindBufferMemory")) };
    let code = unsafe { real(device, buffer, memory, offset) };
    with(|state| {
        let Some(poison) = &mut state.poison else { return };
        let (size, address) = poison.buffers.get_mut(&buffer).unwrap();
        match poison.mapped.get(&memory) {
            Some(base) => {
                let at = base + offset as usize;
                *address = Some(at);
                poison.filled += 1;
                unsafe { words(at, *size + CANARY_BYTES) }.fill(poison.word);
            }
            None => poison.unreachable += 1,
        }
    });
    code
}

#[allow(non_snake_case)]
unsafe extern "system" fn vkDestroyBuffer(
    device: vk::Device,
    buffer: vk::Buffer,
    callbacks: *const vk::AllocationCallbacks<'_>,
) {
    if buffer != vk::Buffer::null() {
        count(std::any::type_name::<vk::Buffer>(), -1);
    }
    with(|state| {
        let Some(poison) = &mut state.poison else { return };
        if let Some((size, Some(address))) = poison.buffers.remove(&buffer) {
            let canary = unsafe { words(address + size as usize, CANARY_BYTES) };
            if let Some(at) = canary.iter().position(|word| *word != poison.word) {
                let found = canary[at];
                poison
                    .broken
                    .push(format!("a buffer of {size} bytes: {found:#010x} written {} bytes behind it", 4 * at));
            }
        }
    });
    let real: vk::PFN_vkDestroyBuffer = unsafe { std::mem::transmute(device.real(c"vkDestroyBuffer")) };
    unsafe { real(device, buffer, callbacks) }
}

fn special(name: &str) -> Option<*const ()> {
    Some(match name {
        "vkGetInstanceProcAddr" => get_instance_proc_addr as *const (),
        "vkGetDeviceProcAddr" => get_device_proc_addr as *const (),
        "vkEnumerateInstanceLayerProperties" => vkEnumerateInstanceLayerProperties as *const (),
        "vkEnumerateInstanceExtensionProperties" => vkEnumerateInstanceExtensionProperties as *const (),
        "vkEnumerateDeviceExtensionProperties" => vkEnumerateDeviceExtensionProperties as *const (),
        "vkGetPhysicalDeviceProperties2" => vkGetPhysicalDeviceProperties2 as *const (),
        "vkGetPhysicalDeviceFeatures2" => vkGetPhysicalDeviceFeatures2 as *const (),
        "vkGetPhysicalDeviceMemoryProperties2" => vkGetPhysicalDeviceMemoryProperties2 as *const (),
        "vkGetPhysicalDeviceQueueFamilyProperties" => vkGetPhysicalDeviceQueueFamilyProperties as *const (),
        "vkCreateInstance" => vkCreateInstance as *const (),
        "vkDestroyInstance" => vkDestroyInstance as *const (),
        "vkDestroyDevice" => vkDestroyDevice as *const (),
        "vkCreateComputePipelines" => vkCreateComputePipelines as *const (),
        "vkCreateShaderModule" => vkCreateShaderModule as *const (),
        "vkCreateBuffer" => vkCreateBuffer as *const (),
        "vkMapMemory" => vkMapMemory as *const (),
        "vkBindBufferMemory" => vkBindBufferMemory as *const (),
        "vkDestroyBuffer" => vkDestroyBuffer as *const (),
        _ => return None,
    })
}

/// Returns the shim's function in place of a real one, if there is one.
unsafe fn ours(real: vk::PFN_vkVoidFunction, name: *const c_char) -> vk::PFN_vkVoidFunction {
    let text = unsafe { CStr::from_ptr(name) }.to_str().unwrap();
    let found = special(text).or_else(|| creating(text)).or_else(|| destroying(text)).or_else(|| fallible(text));
    match found {
        Some(function) if real.is_some() => Some(unsafe { std::mem::transmute::<*const (), Void>(function) }),
        _ => {
            let made = ["vkCreate", "vkAllocate", "vkDestroy", "vkFree"].iter().any(|start| text.starts_with(start));
            assert!(real.is_none() || !made || UNUSED.contains(&text), "{text} is not counted");
            real
        }
    }
}

/// Functions that `ash` and the allocator load and the engine never calls.
const UNUSED: [&str; 22] = [
    "vkCreateFence",
    "vkDestroyFence",
    "vkCreateEvent",
    "vkDestroyEvent",
    "vkCreateGraphicsPipelines",
    "vkCreateFramebuffer",
    "vkDestroyFramebuffer",
    "vkCreateRenderPass",
    "vkCreateRenderPass2",
    "vkDestroyRenderPass",
    "vkCreateSamplerYcbcrConversion",
    "vkDestroySamplerYcbcrConversion",
    "vkCreateDescriptorUpdateTemplate",
    "vkDestroyDescriptorUpdateTemplate",
    "vkCreatePrivateDataSlot",
    "vkDestroyPrivateDataSlot",
    // These are freed with their pools.
    "vkFreeCommandBuffers",
    "vkFreeDescriptorSets",
    "vkCreateDebugReportCallbackEXT",
    "vkDestroyDebugReportCallbackEXT",
    "vkCreateHeadlessSurfaceEXT",
    "vkDestroySurfaceKHR",
];

unsafe extern "system" fn get_instance_proc_addr(
    instance: vk::Instance,
    name: *const c_char,
) -> vk::PFN_vkVoidFunction {
    let real = unsafe { (system().static_fn().get_instance_proc_addr)(instance, name) };
    unsafe { ours(real, name) }
}

unsafe extern "system" fn get_device_proc_addr(device: vk::Device, name: *const c_char) -> vk::PFN_vkVoidFunction {
    let find = unsafe { with(|state| state.instance).real(c"vkGetDeviceProcAddr") };
    let find: vk::PFN_vkGetDeviceProcAddr = unsafe { std::mem::transmute(find) };
    unsafe { ours(find(device, name), name) }
}
