//! Devices that an application creates and shares: its queue, its memory, and the features enabled in them.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::undocumented_unsafe_blocks, reason = "tests of C functions")]

use crate::c_scene::*;
use ash::vk::{self, Handle};
use nertca_vk_abi::context::*;
use nertca_vk_abi::output::*;
use nertca_vk_abi::semaphores::*;
use nertca_vk_abi::status::*;
use nertca_vk_abi::types::*;
use std::ffi::{CString, c_void};
use std::ptr::{null, null_mut};
use std::sync::atomic::{AtomicI64, Ordering};

/// Number of times that an application's queue was locked and unlocked.
#[derive(Default)]
struct Uses {
    locked: AtomicI64,
    unlocked: AtomicI64,
}

unsafe extern "C" fn lock(uses: *mut c_void) {
    unsafe { &*uses.cast::<Uses>() }.locked.fetch_add(1, Ordering::SeqCst);
}

unsafe extern "C" fn unlock(uses: *mut c_void) {
    let uses = unsafe { &*uses.cast::<Uses>() };
    assert_eq!(
        uses.locked.load(Ordering::SeqCst),
        uses.unlocked.fetch_add(1, Ordering::SeqCst) + 1,
        "one holder at a time"
    );
}

/// Features with which an application creates its device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum With {
    /// Timeline semaphores only.
    Least,
    /// Full subgroups of a requested size and buffer addresses as well.
    Subgroups,
    /// Everything that matrix kernels need as well.
    Matrices,
}

/// A Vulkan application with its own device, under the validation layers.
struct Application {
    entry: ash::Entry,
    instance: ash::Instance,
    physical: vk::PhysicalDevice,
    device: ash::Device,
    with: With,
    addresses: bool,
    exports: bool,
    waits: bool,
    uses: Box<Uses>,
    messages: Box<std::sync::Mutex<Vec<String>>>,
    debug: (ash::ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT),
}

unsafe extern "system" fn heard(
    _: vk::DebugUtilsMessageSeverityFlagsEXT,
    _: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    user: *mut c_void,
) -> vk::Bool32 {
    let text = unsafe { (*data).message_as_c_str() }.map(|t| t.to_string_lossy().into_owned()).unwrap_or_default();
    unsafe { &*user.cast::<std::sync::Mutex<Vec<String>>>() }.lock().unwrap().push(text);
    vk::FALSE
}

/// Returns whether a device imports semaphores from opaque file descriptors: some drivers have the extension for other kinds alone.
unsafe fn imports_semaphores(instance: &ash::Instance, physical: vk::PhysicalDevice) -> bool {
    let opaque =
        vk::PhysicalDeviceExternalSemaphoreInfo::default().handle_type(vk::ExternalSemaphoreHandleTypeFlags::OPAQUE_FD);
    let mut offered = vk::ExternalSemaphoreProperties::default();
    unsafe { instance.get_physical_device_external_semaphore_properties(physical, &opaque, &mut offered) };
    offered.external_semaphore_features.contains(vk::ExternalSemaphoreFeatureFlags::IMPORTABLE)
}

impl Application {
    /// Creates an application with such a device; `None` where the physical device does not offer it.
    fn new(with: With) -> Option<Application> {
        unsafe {
            let entry = ash::Entry::load().unwrap();
            let info = vk::ApplicationInfo::default().api_version(vk::API_VERSION_1_2);
            let layers = [c"VK_LAYER_KHRONOS_validation".as_ptr()];
            let extensions = [ash::ext::debug_utils::NAME.as_ptr()];
            let create = vk::InstanceCreateInfo::default()
                .application_info(&info)
                .enabled_layer_names(&layers)
                .enabled_extension_names(&extensions);
            let instance = entry.create_instance(&create, None).unwrap();
            let messages = Box::new(std::sync::Mutex::new(Vec::new()));
            let debug = ash::ext::debug_utils::Instance::new(&entry, &instance);
            let create = vk::DebugUtilsMessengerCreateInfoEXT::default()
                .message_severity(vk::DebugUtilsMessageSeverityFlagsEXT::ERROR)
                .message_type(vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION)
                .pfn_user_callback(Some(heard))
                .user_data(std::ptr::from_ref(&*messages).cast_mut().cast());
            let messenger = debug.create_debug_utils_messenger(&create, None).unwrap();
            let physical = instance.enumerate_physical_devices().unwrap()[0];
            let known = instance.enumerate_device_extension_properties(physical).unwrap();
            let has = |name| known.iter().any(|e| e.extension_name_as_c_str() == Ok(name));
            let exports = has(ash::khr::external_memory_fd::NAME);
            let waits = has(ash::khr::external_semaphore_fd::NAME) && imports_semaphores(&instance, physical);
            let wanted = match with {
                With::Least => &[][..],
                With::Subgroups => &[ash::ext::subgroup_size_control::NAME],
                With::Matrices => &[ash::ext::subgroup_size_control::NAME, ash::khr::cooperative_matrix::NAME],
            };
            let mut names: Vec<_> = wanted.iter().map(|name| name.as_ptr()).collect();
            if exports {
                names.push(ash::khr::external_memory_fd::NAME.as_ptr());
            }
            if waits {
                names.push(ash::khr::external_semaphore_fd::NAME.as_ptr());
            }
            let mut offered = vk::PhysicalDeviceVulkan12Features::default();
            let mut of_device = vk::PhysicalDeviceFeatures2::default().push_next(&mut offered);
            instance.get_physical_device_features2(physical, &mut of_device);
            let addresses = with != With::Least && offered.buffer_device_address == vk::TRUE;
            let queues = [vk::DeviceQueueCreateInfo::default().queue_family_index(0).queue_priorities(&[1.0])];
            let is_with = |min| with == With::Matrices || with == min;
            let on_matrices = is_with(With::Matrices);
            let mut features = vk::PhysicalDeviceVulkan12Features::default()
                .timeline_semaphore(true)
                .buffer_device_address(addresses)
                .shader_float16(on_matrices)
                .vulkan_memory_model(on_matrices)
                .vulkan_memory_model_device_scope(on_matrices);
            let mut size = vk::PhysicalDeviceSubgroupSizeControlFeatures::default()
                .subgroup_size_control(true)
                .compute_full_subgroups(true);
            let mut matrix = vk::PhysicalDeviceCooperativeMatrixFeaturesKHR::default().cooperative_matrix(true);
            let mut create = vk::DeviceCreateInfo::default()
                .queue_create_infos(&queues)
                .enabled_extension_names(&names)
                .push_next(&mut features);
            if is_with(With::Subgroups) {
                create = create.push_next(&mut size);
            }
            if on_matrices {
                create = create.push_next(&mut matrix);
            }
            let made =
                wanted.iter().all(|name| has(name)).then(|| instance.create_device(physical, &create, None).unwrap());
            let debug = (debug, messenger);
            let Some(device) = made else {
                debug.0.destroy_debug_utils_messenger(debug.1, None);
                instance.destroy_instance(None);
                return None;
            };
            let uses = Box::default();
            Some(Application {
                entry,
                instance,
                physical,
                device,
                with,
                addresses,
                exports,
                waits,
                uses,
                messages,
                debug,
            })
        }
    }

    fn describe(&self) -> nertca_vulkan {
        let raw = |handle: u64| std::ptr::with_exposed_provenance_mut(handle as usize);
        nertca_vulkan {
            size: size_of::<nertca_vulkan>(),
            get_instance_proc_addr: self.entry.static_fn().get_instance_proc_addr as *const c_void,
            instance: raw(self.instance.handle().as_raw()),
            physical_device: raw(self.physical.as_raw()),
            device: raw(self.device.handle().as_raw()),
            queue: raw(unsafe { self.device.get_device_queue(0, 0) }.as_raw()),
            queue_family: 0,
            external_memory_fd: self.exports.into(),
            buffer_device_address: self.addresses.into(),
            lock: Some(lock),
            unlock: Some(unlock),
            user: std::ptr::from_ref(&*self.uses).cast_mut().cast(),
            subgroup_size_control: (self.with != With::Least).into(),
            cooperative_matrix: (self.with == With::Matrices).into(),
            external_semaphore_fd: self.waits.into(),
        }
    }

    fn close(self) {
        unsafe {
            // The application destroys the device, which the library has not destroyed and in which it has left no objects.
            self.device.device_wait_idle().unwrap();
            self.device.destroy_device(None);
            self.debug.0.destroy_debug_utils_messenger(self.debug.1, None);
            self.instance.destroy_instance(None);
        }
        assert_eq!(*self.messages.lock().unwrap(), Vec::<String>::new());
    }

    /// Makes a semaphore of the device from a descriptor.
    unsafe fn imported_semaphore(&self, fd: i32) -> vk::Semaphore {
        let semaphore = unsafe { self.device.create_semaphore(&vk::SemaphoreCreateInfo::default(), None) }.unwrap();
        let import = vk::ImportSemaphoreFdInfoKHR::default()
            .semaphore(semaphore)
            .handle_type(vk::ExternalSemaphoreHandleTypeFlags::OPAQUE_FD)
            .fd(fd);
        let imports = ash::khr::external_semaphore_fd::Device::new(&self.instance, &self.device);
        unsafe { imports.import_semaphore_fd(&import) }.unwrap();
        semaphore
    }

    /// Makes a buffer, with memory that `import` imports or, without it, that the host reads.
    unsafe fn buffer(&self, bytes: u64, import: Option<&Exported>) -> (vk::Buffer, vk::DeviceMemory) {
        let opaque = vk::ExternalMemoryHandleTypeFlags::OPAQUE_FD;
        let mut external = vk::ExternalMemoryBufferCreateInfo::default().handle_types(opaque);
        let usage = vk::BufferUsageFlags::TRANSFER_SRC
            | vk::BufferUsageFlags::STORAGE_BUFFER
            | vk::BufferUsageFlags::TRANSFER_DST;
        let mut create = vk::BufferCreateInfo::default().size(bytes).usage(usage);
        if import.is_some() {
            create = create.push_next(&mut external);
        }
        let buffer = unsafe { self.device.create_buffer(&create, None) }.unwrap();
        let mut info = vk::ImportMemoryFdInfoKHR::default().handle_type(opaque).fd(import.map_or(-1, |i| i.fd));
        let mut dedicated = vk::MemoryDedicatedAllocateInfo::default().buffer(buffer);
        let allocate = match import {
            Some(Exported { memory_type, allocated, .. }) => vk::MemoryAllocateInfo::default()
                .allocation_size(*allocated)
                .memory_type_index(*memory_type)
                .push_next(&mut info)
                .push_next(&mut dedicated),
            None => {
                let needs = unsafe { self.device.get_buffer_memory_requirements(buffer) };
                let memory = unsafe { self.instance.get_physical_device_memory_properties(self.physical) };
                let read = vk::MemoryPropertyFlags::HOST_VISIBLE | vk::MemoryPropertyFlags::HOST_COHERENT;
                let fits = |i: &u32| {
                    needs.memory_type_bits >> i & 1 == 1
                        && memory.memory_types[*i as usize].property_flags.contains(read)
                };
                let kind = (0..memory.memory_type_count).find(fits).unwrap();
                vk::MemoryAllocateInfo::default().allocation_size(needs.size).memory_type_index(kind)
            }
        };
        let memory = unsafe { self.device.allocate_memory(&allocate, None) }.unwrap();
        unsafe { self.device.bind_buffer_memory(buffer, memory, 0) }.unwrap();
        (buffer, memory)
    }

    /// Reads exported memory as another API would, through a copy on the device that waits for the semaphore of a descriptor.
    fn import(&self, exported: &Exported, signal: Option<i32>) -> Vec<f32> {
        /// A signal that was submitted arrives long before, in nanoseconds.
        const PATIENCE: u64 = 60_000_000_000;
        let (bytes, device) = (exported.bytes, &self.device);
        unsafe {
            let (theirs, ours) = (self.buffer(bytes, Some(exported)), self.buffer(bytes, None));
            let semaphores: Vec<_> = signal.map(|fd| self.imported_semaphore(fd)).into_iter().collect();
            let pool = device.create_command_pool(&vk::CommandPoolCreateInfo::default(), None).unwrap();
            let allocate = vk::CommandBufferAllocateInfo::default().command_pool(pool).command_buffer_count(1);
            let commands = device.allocate_command_buffers(&allocate).unwrap();
            device.begin_command_buffer(commands[0], &vk::CommandBufferBeginInfo::default()).unwrap();
            device.cmd_copy_buffer(commands[0], theirs.0, ours.0, &[vk::BufferCopy::default().size(bytes)]);
            let visible = vk::MemoryBarrier::default()
                .src_access_mask(vk::AccessFlags::TRANSFER_WRITE)
                .dst_access_mask(vk::AccessFlags::HOST_READ);
            let (copy, host) = (vk::PipelineStageFlags::TRANSFER, vk::PipelineStageFlags::HOST);
            device.cmd_pipeline_barrier(commands[0], copy, host, vk::DependencyFlags::empty(), &[visible], &[], &[]);
            device.end_command_buffer(commands[0]).unwrap();
            let stages = vec![vk::PipelineStageFlags::ALL_COMMANDS; semaphores.len()];
            let submit = vk::SubmitInfo::default()
                .wait_semaphores(&semaphores)
                .wait_dst_stage_mask(&stages)
                .command_buffers(&commands);
            let fence = device.create_fence(&vk::FenceCreateInfo::default(), None).unwrap();
            device.queue_submit(device.get_device_queue(0, 0), &[submit], fence).unwrap();
            device.wait_for_fences(&[fence], true, PATIENCE).expect("the semaphore was signalled");
            let mapped = device.map_memory(ours.1, 0, bytes, vk::MemoryMapFlags::empty()).unwrap();
            let values = std::slice::from_raw_parts(mapped.cast::<f32>(), bytes as usize / 4).to_vec();
            device.unmap_memory(ours.1);
            device.destroy_fence(fence, None);
            device.destroy_command_pool(pool, None);
            semaphores.iter().for_each(|semaphore| device.destroy_semaphore(*semaphore, None));
            for (buffer, memory) in [theirs, ours] {
                device.destroy_buffer(buffer, None);
                device.free_memory(memory, None);
            }
            values
        }
    }
}

/// Exported memory of a buffer.
struct Exported {
    fd: i32,
    bytes: u64,
    memory_type: u32,
    allocated: u64,
}

/// Exports the memory of a buffer of the library.
fn exported(buffer: *mut nertca_buffer) -> Exported {
    let mut exported = Exported { fd: -1, bytes: 0, memory_type: u32::MAX, allocated: 0 };
    ok(unsafe { nertca_buffer_export_fd(buffer, &mut exported.fd, &mut exported.bytes) }, buffer);
    ok(unsafe { nertca_buffer_memory(buffer, &mut exported.memory_type, &mut exported.allocated) }, buffer);
    assert!(exported.allocated >= exported.bytes);
    exported
}

fn adopted(vulkan: &nertca_vulkan, options: &str) -> *mut nertca_context {
    let (options, mut context) = (CString::new(options).unwrap(), null_mut());
    ok(unsafe { nertca_context_adopt(vulkan, options.as_ptr(), null(), &mut context) }, null::<c_void>());
    context
}

/// Returns the message when the adoption of a device is refused.
fn refused(vulkan: &nertca_vulkan) -> String {
    let mut context = null_mut();
    let status = unsafe { nertca_context_adopt(vulkan, null(), null(), &mut context) };
    assert_eq!((status, context), (NERTCA_ERROR_ARGUMENT, null_mut()));
    last_error(null::<c_void>())
}

/// Returns the vessels after a short training of a network, and a description of the context.
fn trained(context: *mut nertca_context) -> (Vec<f32>, serde_json::Value) {
    let made = reconstruction(
        context,
        &format!("preset = fast-mlp\nmarch.dynamic_samples = 40\ndynamic.width = 32\nhull.enabled = false\n{SMALL}"),
    );
    add_frames(made, 0..3);
    train(made, 20);
    let (seen, described) = (drawn(made, &view(1)), described(context));
    close(context, &[made]);
    (seen, described)
}

#[test]
fn a_device_made_with_subgroups_and_matrices_computes_as_ours_does() {
    let newest = std::env::var_os("NERTCA_MATRICES").is_some();
    for (with, layers) in [(With::Subgroups, "f32"), (With::Matrices, "matrices")] {
        let Some(application) = Application::new(with) else {
            assert!(!newest && with == With::Matrices, "the newest lavapipe has both");
            println!("no cooperative matrices here: adopting a device with them was not tried");
            continue;
        };
        let options = format!("layers = {layers}");
        let (seen, theirs) = trained(adopted(&application.describe(), &options));
        let (wanted, ours) = trained(context(&format!("{options}\nvalidation = true")));
        assert_eq!(theirs["device"]["full_subgroups"], ours["device"]["full_subgroups"]);
        assert!(theirs["device"]["full_subgroups"].is_u64());
        assert_eq!(theirs["device"]["matrices"] == ours["device"]["matrices"], with == With::Matrices || !newest);
        assert_eq!((&theirs["tuning"]["layers"], &ours["tuning"]["layers"]), (&layers.into(), &layers.into()));
        assert_eq!(seen, wanted, "{layers}: on one device and driver, bit by bit");
        application.close();
    }
}

#[test]
fn what_is_not_said_is_not_used() {
    let min = Application::new(With::Least).unwrap();
    let mut vulkan = min.describe();
    // A caller of the previous version: memory behind its struct is not read.
    vulkan.size = std::mem::offset_of!(nertca_vulkan, subgroup_size_control);
    (vulkan.subgroup_size_control, vulkan.cooperative_matrix) = (77, 77);
    let (_, described) = trained(adopted(&vulkan, ""));
    assert!(described["device"]["full_subgroups"].is_null());
    assert_eq!(described["device"]["matrices"], serde_json::json!([]));
    // These claims cannot be true.
    let vulkan = nertca_vulkan { cooperative_matrix: 1, ..min.describe() };
    assert!(refused(&vulkan).contains("needs subgroup_size_control"), "{}", refused(&vulkan));
    if Application::new(With::Matrices).map(Application::close).is_none() {
        let said = refused(&nertca_vulkan { subgroup_size_control: 1, ..vulkan });
        assert!(said.contains("cooperative_matrix") && said.contains("does not offer cooperativeMatrix"), "{said}");
    }
    min.close();
}

#[test]
fn a_device_is_shared_with_its_owner() {
    let application = Application::new(With::Least).unwrap();
    let context = adopted(&application.describe(), "");
    let made = reconstruction(context, SMALL);
    add_frames(made, 0..3);
    train(made, 3);
    let ours = drawn(made, &view(1));
    if application.exports {
        let bytes = u64::from(SIZE * SIZE * 4);
        let mut buffer = null_mut();
        ok(unsafe { nertca_buffer_create(context, bytes, &mut buffer) }, context);
        ok(unsafe { nertca_reconstruction_render_buffer(made, &view(1), buffer) }, made);
        let (first, second) = (exported(buffer), exported(buffer));
        assert!(first.bytes >= bytes && first.fd != second.fd);
        let theirs = application.import(&first, None);
        assert_eq!(theirs[..ours.len()], ours, "what was drawn, in memory of another API");
        // The memory stays valid after the buffer is freed: a second descriptor outlives the buffer.
        assert_eq!(unsafe { nertca_context_destroy(context) }, NERTCA_ERROR_BUSY);
        ok(nertca_buffer_destroy(buffer), buffer);
        assert_eq!(application.import(&second, None)[..ours.len()], ours);
    } else {
        println!("no VK_KHR_external_memory_fd here: sharing memory was not tested");
    }
    close(context, &[made]);
    let Uses { locked, unlocked } = &*application.uses;
    assert!(locked.load(Ordering::SeqCst) > 5);
    assert_eq!(locked.load(Ordering::SeqCst), unlocked.load(Ordering::SeqCst));
    application.close();
}

/// A device that the library opened draws; the application's device waits for the picture on its own queue, and reads it.
#[test]
fn another_device_waits_for_a_picture() {
    let required = std::env::var_os("NERTCA_SEMAPHORES").is_some();
    let application = Application::new(With::Least).unwrap();
    let context = context("validation = true");
    if !(application.exports && application.waits) {
        assert!(!required, "this driver is known to export semaphores");
        let mut semaphore = null_mut();
        let status = unsafe { nertca_semaphore_create(context, &mut semaphore) };
        assert_eq!((status, semaphore), (NERTCA_ERROR_DEVICE, null_mut()));
        println!("{}: semaphores were not tested", last_error(context));
        close(context, &[]);
        return application.close();
    }
    let made = reconstruction(context, SMALL);
    add_frames(made, 0..3);
    train(made, 3);
    let bytes = u64::from(SIZE * SIZE * 4);
    let (mut buffer, mut semaphore) = (null_mut(), null_mut());
    ok(unsafe { nertca_buffer_create(context, bytes, &mut buffer) }, context);
    ok(unsafe { nertca_semaphore_create(context, &mut semaphore) }, context);
    // A signal that was waited for can be given again.
    for at in [1, 2] {
        let ours = drawn(made, &view(at));
        let mut signal = -1;
        ok(unsafe { nertca_reconstruction_render_buffer(made, &view(at), buffer) }, made);
        ok(nertca_semaphore_signal(semaphore), semaphore);
        ok(unsafe { nertca_semaphore_export_fd(semaphore, &mut signal) }, semaphore);
        assert_eq!(application.import(&exported(buffer), Some(signal))[..ours.len()], ours, "view {at}");
    }
    assert_eq!(unsafe { nertca_context_destroy(context) }, NERTCA_ERROR_BUSY);
    ok(nertca_semaphore_destroy(semaphore), semaphore);
    ok(nertca_buffer_destroy(buffer), buffer);
    close(context, &[made]);
    application.close();
}
