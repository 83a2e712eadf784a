//! Contexts: a device, a log, limits.

use crate::boundary::call;
use crate::handles::{self, Kind};
use crate::log;
use crate::options::{Options, text};
use crate::status::{Failure, NERTCA_ERROR_BUSY, Outcome, copy_text, nertca_status};
use crate::types::{nertca_log, nertca_vulkan, read};
use ash::vk::{self, Handle};
use nertca_vk::gpu::device::{Adoption, DeviceOptions, Gpu, QueueLock, list_devices};
use nertca_vk::gpu::pipeline::KeptPipelines;
use nertca_vk::kernels::cache::save_pipeline_cache;
use nertca_vk::kernels::tuning::{Layers, Tuning};
use std::ffi::{c_char, c_void};
use std::num::NonZeroU64;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use tracing::Dispatch;

/// A device with a log and limits. Make one per device; it can have any number of reconstructions.
pub struct nertca_context {
    _opaque: [u8; 0],
}

/// Object behind [`nertca_context`].
pub(super) struct Context {
    pub gpu: Option<Gpu>,
    pub tuning: Option<Tuning>,
    /// Reconstructions that follow one another need the same pipelines.
    _pipelines: Option<KeptPipelines>,
    pub log: Dispatch,
    pub deterministic: bool,
    /// Number of reconstructions and buffers that are alive.
    pub children: AtomicU32,
    process: u32,
}

impl Kind for Context {
    const NAME: &'static str = "context";

    fn process(&self) -> u32 {
        self.process
    }
}

impl Context {
    pub fn device(&self) -> Outcome<&Gpu> {
        let none = || nertca_vk::error::Error::NoDevice("the context was created without a device".into());
        Ok(self.gpu.as_ref().ok_or_else(none)?)
    }
}

/// Reference of a reconstruction or buffer to its context, which counts it.
pub(super) struct Claim {
    pub context: Arc<Context>,
}

impl Claim {
    pub fn new(context: &Arc<Context>) -> Claim {
        context.children.fetch_add(1, Ordering::AcqRel);
        Claim { context: context.clone() }
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        self.context.children.fetch_sub(1, Ordering::AcqRel);
    }
}

/// Runs a body on the context of a handle, with the context's log.
pub(super) fn on_context<H>(handle: *const H, body: impl FnOnce(&Arc<Context>) -> Outcome<()>) -> nertca_status {
    call(handle, || {
        let context = handles::get::<Context, H>(handle)?;
        tracing::dispatcher::with_default(&context.log, || body(&context))
    })
}

/// Options that every context accepts.
const KNOWN: &str = "device, validation, cache_dir, memory_limit_mib, deterministic, layers";

struct Parsed {
    device: DeviceOptions,
    without_device: bool,
    deterministic: bool,
    layers: Option<Layers>,
}

fn parse(mut options: Options) -> Outcome<Parsed> {
    let truth = "true or false";
    let select = options.take("device").filter(|d| !d.is_empty());
    let without_device = select.as_deref() == Some("none");
    let memory_limit = options.take_as::<NonZeroU64>("memory_limit_mib", "a number of MiB, 1 or more")?;
    let memory_limit = memory_limit.map(|mib| mib.get().saturating_mul(1 << 20));
    let layers = match options.take("layers").as_deref() {
        None => None,
        Some("f32") => Some(Layers::F32),
        Some("matrices") => Some(Layers::Matrices),
        Some(other) => return Err(Failure::argument("layers", format!("`{other}` is neither f32 nor matrices"))),
    };
    let parsed = Parsed {
        device: DeviceOptions {
            select,
            validation: options.take_as("validation", truth)?.unwrap_or(false),
            cache_dir: options.take("cache_dir").map(Into::into),
            memory_limit,
            ..DeviceOptions::default()
        },
        without_device,
        deterministic: options.take_as("deterministic", truth)?.unwrap_or(false),
        layers,
    };
    options.finish(KNOWN)?;
    Ok(parsed)
}

fn tuning(gpu: &Gpu, layers: Option<Layers>) -> Tuning {
    let tuning = Tuning::for_device(gpu.info());
    match layers {
        None => tuning,
        Some(layers) => tuning.with_layers(layers, format!("{layers:?} layers, as requested")),
    }
}

/// # Safety
/// `options` must be null or end with a zero, `log` be null or as long as its `size` says, `out` be null or writable.
unsafe fn create(
    options: *const c_char,
    log: *const nertca_log,
    out: *mut *mut nertca_context,
    open: impl FnOnce(&Parsed) -> Outcome<Option<Gpu>>,
) -> Outcome<()> {
    if out.is_null() {
        return Err(Failure::argument("context", "is null"));
    }
    // SAFETY: `out` is not null, and callers of this function guarantee that it can be written.
    unsafe { out.write_unaligned(std::ptr::null_mut()) };
    // SAFETY: `log` is not null here, and callers of this function guarantee that it is as long as its size says.
    let log = log::dispatch(if log.is_null() { None } else { Some(unsafe { read(log) }?) })?;
    // SAFETY: callers of this function guarantee that `options` is null or ends with a zero.
    let parsed = parse(Options::parse(unsafe { text("options", options) }?.unwrap_or_default())?)?;
    tracing::dispatcher::with_default(&log, || {
        let gpu = open(&parsed)?;
        let tuning = gpu.as_ref().map(|gpu| tuning(gpu, parsed.layers));
        if let (Some(gpu), Some(tuning)) = (&gpu, &tuning) {
            tracing::info!("{}: {}", gpu.info().name, tuning.reasons.join("; "));
        }
        let context = Arc::new(Context {
            _pipelines: gpu.as_ref().map(Gpu::keep_pipelines),
            gpu,
            tuning,
            log: log.clone(),
            deterministic: parsed.deterministic,
            children: AtomicU32::new(0),
            process: std::process::id(),
        });
        let handle = handles::insert(context)?;
        // SAFETY: `out` was checked and written above, and the caller's memory is still valid.
        unsafe { out.write_unaligned(std::ptr::without_provenance_mut(handle)) };
        Ok(())
    })
}

/// Opens a device.
///
/// `options` are lines of `key = value` or a JSON object, or null for defaults: `device` (index, part of the name or UUID, the
/// best device by default; `none` for a context that checks and keeps frames but cannot train), `validation` (true turns on the
/// Khronos validation layer, which then reports to the log), `cache_dir` (directory in which compiled kernels are kept between
/// processes), `memory_limit_mib` (limit on the device memory of everything made from the context), `deterministic` (true
/// refuses whatever would make results depend on timing: frames added while training in the background), `layers` (f32 or
/// matrices: computation of the network's layers; chosen for the device by default).
///
/// `log` may be null. `*context` is null on failure; `nertca_last_error(NULL, ...)` then returns the text. Callable from any
/// thread.
///
/// # Safety
/// `options` must be null or end with a zero, `log` be null or as long as its `size` says, `context` be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_context_create(
    options: *const c_char,
    log: *const nertca_log,
    context: *mut *mut nertca_context,
) -> nertca_status {
    call(std::ptr::null::<c_void>(), || {
        // SAFETY: the header requires the same of these pointers as `create` does.
        unsafe {
            create(options, log, context, |parsed| {
                if parsed.without_device { Ok(None) } else { Ok(Some(Gpu::open(&parsed.device)?)) }
            })
        }
    })
}

struct CallerLock {
    lock: unsafe extern "C" fn(*mut c_void),
    unlock: unsafe extern "C" fn(*mut c_void),
    user: *mut c_void,
}

// SAFETY: the header requires functions and a pointer that may be used on any thread.
unsafe impl Send for CallerLock {}
// SAFETY: as for `Send`: the header requires functions that any thread may call, and `QueueLock` passes them nothing but
// `user`.
unsafe impl Sync for CallerLock {}

impl QueueLock for CallerLock {
    fn lock(&self) {
        // SAFETY: the header requires a function that takes `user`, valid for the lifetime of the context.
        unsafe { (self.lock)(self.user) }
    }

    fn unlock(&self) {
        // SAFETY: the header requires a function that takes `user`, valid for the lifetime of the context; `lock` was called
        // before.
        unsafe { (self.unlock)(self.user) }
    }
}

/// Makes a context like `nertca_context_create`, on the caller's Vulkan device: both then share one GPU, its memory and, if
/// wanted, buffers. The options `device` and `validation` do not apply. Instance, device and queue must outlive the context,
/// which does not destroy them.
///
/// # Safety
/// `options`, `log` and `context` as in `nertca_context_create`; the handles in `vulkan` must be valid and made as its fields
/// say.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_context_adopt(
    vulkan: *const nertca_vulkan,
    options: *const c_char,
    log: *const nertca_log,
    context: *mut *mut nertca_context,
) -> nertca_status {
    call(std::ptr::null::<c_void>(), || {
        // SAFETY: the header requires that `vulkan` is null or as long as its size says.
        let theirs = unsafe { read(vulkan) }?;
        for (name, handle) in [
            ("vulkan.instance", theirs.instance),
            ("vulkan.physical_device", theirs.physical_device),
            ("vulkan.device", theirs.device),
            ("vulkan.queue", theirs.queue),
        ] {
            if handle.is_null() {
                return Err(Failure::argument(name, "is null"));
            }
        }
        let queue_lock: Option<Box<dyn QueueLock>> = match (theirs.lock, theirs.unlock) {
            (None, None) => None,
            (Some(lock), Some(unlock)) => Some(Box::new(CallerLock { lock, unlock, user: theirs.user })),
            _ => return Err(Failure::argument("vulkan.lock", "lock and unlock must be given together")),
        };
        let raw = |handle: *mut c_void| handle.expose_provenance() as u64;
        let adoption = Adoption {
            get_instance_proc_addr: (!theirs.get_instance_proc_addr.is_null()).then(|| {
                // SAFETY: the caller guarantees that the pointer is this function.
                unsafe {
                    std::mem::transmute::<*const c_void, vk::PFN_vkGetInstanceProcAddr>(theirs.get_instance_proc_addr)
                }
            }),
            instance: vk::Instance::from_raw(raw(theirs.instance)),
            physical_device: vk::PhysicalDevice::from_raw(raw(theirs.physical_device)),
            device: vk::Device::from_raw(raw(theirs.device)),
            queue: vk::Queue::from_raw(raw(theirs.queue)),
            queue_family: theirs.queue_family,
            buffer_device_address: theirs.buffer_device_address != 0,
            external_memory_fd: theirs.external_memory_fd != 0,
            external_semaphore_fd: theirs.external_semaphore_fd != 0,
            subgroup_size_control: theirs.subgroup_size_control != 0,
            cooperative_matrix: theirs.cooperative_matrix != 0,
            queue_lock,
        };
        // SAFETY: the header requires valid handles that were made as the fields of `vulkan` say, and of the other pointers the
        // same as `create` does.
        unsafe { create(options, log, context, |parsed| Ok(Some(Gpu::adopt(adoption, &parsed.device)?))) }
    })
}

/// Describes the device and the computation paths chosen for it, as JSON. `text`, `size` and `length` work as in
/// `nertca_last_error`, but the part about memory may be longer at the next call. Callable from any thread.
///
/// # Safety
/// `text` must hold `size` bytes; `length` must be writable or null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_context_describe(
    context: *mut nertca_context,
    text: *mut c_char,
    size: usize,
    length: *mut usize,
) -> nertca_status {
    on_context(context, |context| {
        let described = serde_json::json!({
            "device": context.gpu.as_ref().map(Gpu::info),
            "tuning": context.tuning,
            "memory_in_use": context.gpu.as_ref().map(Gpu::memory_in_use),
            "free_memory": context.gpu.as_ref().and_then(|gpu| gpu.memory().free),
            "validation_messages": context.gpu.as_ref().map(Gpu::validation_messages),
            "deterministic": context.deterministic,
        });
        // SAFETY: the header requires that `text` holds `size` bytes and that `length` is null or can be written.
        unsafe { copy_text(&described.to_string(), text, size, length) }
    })
}

/// Lists all Vulkan devices of this machine, usable or not, as JSON. `text`, `size` and `length` work as in
/// `nertca_last_error`, but the part about free memory may be longer at the next call. Callable from any thread.
///
/// # Safety
/// `text` must hold `size` bytes; `length` must be writable or null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_devices(text: *mut c_char, size: usize, length: *mut usize) -> nertca_status {
    call(std::ptr::null::<c_void>(), || {
        let devices = serde_json::json!(list_devices()?);
        // SAFETY: the header requires that `text` holds `size` bytes and that `length` is null or can be written.
        unsafe { copy_text(&devices.to_string(), text, size, length) }
    })
}

/// Closes the device. Null is allowed, and does nothing.
///
/// Waits for calls on the context in other threads.
///
/// @return NERTCA_ERROR_BUSY, with nothing done, while reconstructions, buffers or semaphores made from it exist, or from inside a callback
/// of a call on it.
///
/// # Safety
/// Any value is allowed: a stale handle is an error.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_context_destroy(context: *mut nertca_context) -> nertca_status {
    if context.is_null() {
        return super::status::NERTCA_OK;
    }
    call(context, || {
        if handles::is_active(context) {
            return Err(Failure::new(NERTCA_ERROR_BUSY, "context: it is in use by a call in this thread"));
        }
        let children = handles::get::<Context, nertca_context>(context)?.children.load(Ordering::Acquire);
        if children > 0 {
            let problem = format!(
                "context: {children} reconstructions, buffers or semaphores that were created from it still exist"
            );
            return Err(Failure::new(NERTCA_ERROR_BUSY, problem));
        }
        let context = handles::remove::<Context, nertca_context>(context)?;
        if let Some(Err(error)) = context.gpu.as_ref().map(save_pipeline_cache) {
            // Without the cache, the next start only takes longer.
            tracing::dispatcher::with_default(&context.log, || tracing::warn!("{error}"));
        }
        Ok(())
    })
}
