//! The Vulkan loader, an instance of it, and the messages of its validation layer.

use super::capabilities::{DeviceInfo, describe};
use super::lock::lock;
use crate::error::{Error, Result};
use ash::{ext, khr, vk};
use std::ffi::{CStr, c_void};
use std::sync::Mutex;

const VALIDATION_LAYER: &CStr = c"VK_LAYER_KHRONOS_validation";
/// Packages to install where there is no loader.
const LOADER_PACKAGES: &str = "Debian, Ubuntu: libvulkan1; Fedora: vulkan-loader; Arch: vulkan-icd-loader";
/// Packages to install where there is no driver.
pub(super) const DRIVER_PACKAGES: &str = "that of the GPU vendor, or that of Mesa, which also supports CPUs; Debian, \
                                          Ubuntu, Fedora: mesa-vulkan-drivers; Arch: vulkan-swrast";

/// A Vulkan loader that an application supplies in place of the system's.
#[derive(Debug, Clone, Copy)]
pub struct Loader(vk::PFN_vkGetInstanceProcAddr);

impl Loader {
    /// Makes a loader from its `vkGetInstanceProcAddr`.
    ///
    /// # Safety
    /// The function must be that of a working Vulkan loader, and stay loaded as long as anything opened with it.
    pub unsafe fn new(get_instance_proc_addr: vk::PFN_vkGetInstanceProcAddr) -> Loader {
        Loader(get_instance_proc_addr)
    }

    fn entry(self) -> ash::Entry {
        let functions = ash::StaticFn { get_instance_proc_addr: self.0 };
        // SAFETY: whoever made this loader vouched for the function in `Loader::new`.
        unsafe { ash::Entry::from_static_fn(functions) }
    }
}

/// An instance; it is destroyed on drop if it was made here.
pub(super) struct Instance {
    raw: ash::Instance,
    ours: bool,
    messenger: Option<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    /// Messages of the validation layer; boxed because the messenger keeps their address.
    messages: Box<Mutex<Vec<String>>>,
    /// Version of Vulkan that the validation layer was made for, where it is on.
    validation_version: Option<u32>,
    /// Keeps the loader's library in memory.
    entry: ash::Entry,
}

impl std::ops::Deref for Instance {
    type Target = ash::Instance;

    fn deref(&self) -> &ash::Instance {
        &self.raw
    }
}

fn load(loader: Option<Loader>) -> Result<ash::Entry> {
    if let Some(loader) = loader {
        return Ok(loader.entry());
    }
    // SAFETY: loads the system's Vulkan loader, whose initialisers are trusted as any shared library's are.
    unsafe { ash::Entry::load() }.map_err(|e| {
        Error::NoDevice(format!(
            "the Vulkan loader could not be opened ({e}). Install it ({LOADER_PACKAGES}) and a driver \
             ({DRIVER_PACKAGES})"
        ))
    })
}

/// Returns the error of a failed instance creation. The most common reason is that the loader finds no driver.
fn no_instance(code: vk::Result) -> Error {
    Error::NoDevice(match code {
        vk::Result::ERROR_INCOMPATIBLE_DRIVER => {
            format!("the Vulkan loader finds no driver. {}", remedy())
        }
        code => format!("vkCreateInstance failed: {code}"),
    })
}

/// Variables by which the loader uses some drivers only, and whether it finds none where they are set to an empty text.
const DRIVER_VARIABLES: [(&str, bool); 4] = [
    ("VK_DRIVER_FILES", true),
    ("VK_ICD_FILENAMES", true),
    ("VK_LOADER_DRIVERS_SELECT", false),
    ("VK_LOADER_DRIVERS_DISABLE", false),
];

/// Returns advice for a loader without drivers: variables that hide them, or else packages.
pub(crate) fn remedy() -> String {
    let set = |name: &str, also_empty: bool| std::env::var_os(name).filter(|value| also_empty || !value.is_empty());
    let hiding = DRIVER_VARIABLES.iter().filter_map(|(name, also_empty)| Some((name, set(name, *also_empty)?)));
    let hiding: Vec<String> = hiding.map(|(name, value)| format!("{name}={}", value.to_string_lossy())).collect();
    match hiding.is_empty() {
        true => format!("Install one ({DRIVER_PACKAGES})"),
        false => format!(
            "The environment hides all drivers but those that it names ({}): correct or unset it",
            hiding.join(", ")
        ),
    }
}

/// Tells whether the loader hides drivers such as MoltenVK from applications that do not ask for them.
fn lists_portability_drivers(entry: &ash::Entry) -> Result<bool> {
    // SAFETY: needs nothing but a loader, which `entry` keeps loaded.
    let found = unsafe { entry.enumerate_instance_extension_properties(None) }
        .map_err(Error::vulkan("vkEnumerateInstanceExtensionProperties", "loader"))?;
    Ok(found.iter().any(|e| e.extension_name_as_c_str().is_ok_and(|n| n == khr::portability_enumeration::NAME)))
}

/// Returns the version of Vulkan that the installed validation layer was made for.
fn validation_layer(entry: &ash::Entry) -> Result<u32> {
    // SAFETY: needs nothing but a loader, which `entry` keeps loaded.
    let found = unsafe { entry.enumerate_instance_layer_properties() }
        .map_err(Error::vulkan("vkEnumerateInstanceLayerProperties", "loader"))?;
    let layer = found.iter().find(|l| l.layer_name_as_c_str().is_ok_and(|n| n == VALIDATION_LAYER));
    layer.map(|l| l.spec_version).ok_or_else(|| {
        Error::NoDevice(
            "validation was requested, but VK_LAYER_KHRONOS_validation is not installed (Debian: vulkan-validationlayers)"
                .into(),
        )
    })
}

fn check_layer(version: Option<u32>, device: &str, has_matrices: bool) -> Result<()> {
    /// First version that has `VK_KHR_cooperative_matrix`.
    const MATRICES: u32 = vk::make_api_version(0, 1, 3, 255);
    match version {
        Some(version) if version < MATRICES && has_matrices => Err(Error::NoDevice(format!(
            "{device}: validation was requested, but the validation layer is of Vulkan {}, which is older than the cooperative \
             matrices of this device: install one of Vulkan {} or later",
            version_text(version),
            version_text(MATRICES)
        ))),
        _ => Ok(()),
    }
}

/// Formats a version, as 1.3.255.
fn version_text(version: u32) -> String {
    let [major, minor, patch] =
        [vk::api_version_major(version), vk::api_version_minor(version), vk::api_version_patch(version)];
    format!("{major}.{minor}.{patch}")
}

impl Instance {
    /// Creates an instance of Vulkan 1.2 with a loader (`None`: the system's), and on demand with the validation layer.
    pub fn create(loader: Option<Loader>, validation: bool) -> Result<Instance> {
        let entry = load(loader)?;
        let app = vk::ApplicationInfo::default()
            .application_name(c"nertca-vk")
            .engine_name(c"nertca-vk")
            .api_version(vk::API_VERSION_1_2);
        let mut layers = Vec::new();
        let mut extensions = Vec::new();
        let mut flags = vk::InstanceCreateFlags::empty();
        if lists_portability_drivers(&entry)? {
            extensions.push(khr::portability_enumeration::NAME.as_ptr());
            flags |= vk::InstanceCreateFlags::ENUMERATE_PORTABILITY_KHR;
        }
        let mut validation_version = None;
        if validation {
            validation_version = Some(validation_layer(&entry)?);
            layers.push(VALIDATION_LAYER.as_ptr());
            extensions.push(ext::debug_utils::NAME.as_ptr());
        }
        let enabled = [vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION];
        let mut features = vk::ValidationFeaturesEXT::default().enabled_validation_features(&enabled);
        let mut create = vk::InstanceCreateInfo::default()
            .application_info(&app)
            .flags(flags)
            .enabled_layer_names(&layers)
            .enabled_extension_names(&extensions);
        if validation {
            create = create.push_next(&mut features);
        }
        // SAFETY: `create` and all it points to are locals of this function, alive until the call returns.
        let raw = unsafe { entry.create_instance(&create, None) }.map_err(no_instance)?;
        let mut instance =
            Instance { raw, ours: true, messenger: None, messages: Box::default(), validation_version, entry };
        if validation {
            instance.listen()?;
        }
        Ok(instance)
    }

    /// Adopts an application's instance, which is not destroyed.
    ///
    /// # Safety
    /// The handle must be valid, come from the loader, and outlive the result.
    pub unsafe fn adopt(loader: Option<Loader>, raw: vk::Instance) -> Result<Instance> {
        let entry = load(loader)?;
        // SAFETY: the caller vouches for the handle and that it is this loader's.
        let raw = unsafe { ash::Instance::load(entry.static_fn(), raw) };
        Ok(Instance { raw, ours: false, messenger: None, messages: Box::default(), validation_version: None, entry })
    }

    fn listen(&mut self) -> Result<()> {
        let debug = ext::debug_utils::Instance::new(&self.entry, &self.raw);
        let create = vk::DebugUtilsMessengerCreateInfoEXT::default()
            .message_severity(
                vk::DebugUtilsMessageSeverityFlagsEXT::ERROR | vk::DebugUtilsMessageSeverityFlagsEXT::WARNING,
            )
            .message_type(
                vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION | vk::DebugUtilsMessageTypeFlagsEXT::PERFORMANCE,
            )
            .pfn_user_callback(Some(on_message))
            .user_data(std::ptr::from_ref::<Mutex<Vec<String>>>(&self.messages).cast_mut().cast());
        // SAFETY: the instance has the extension; the callback's data is boxed in `self`, whose drop destroys the
        // messenger before it goes.
        let messenger = unsafe { debug.create_debug_utils_messenger(&create, None) }
            .map_err(Error::vulkan("vkCreateDebugUtilsMessengerEXT", "messenger"))?;
        self.messenger = Some((debug, messenger));
        Ok(())
    }

    /// Tells whether objects can be given names that the validation layer uses.
    pub fn has_debug_names(&self) -> bool {
        self.messenger.is_some()
    }

    /// Checks that the validation layer, if it is on, knows all that we use of a device. An older layer calls what it does not know
    /// an error.
    ///
    /// # Errors
    /// [`Error::NoDevice`].
    pub fn check_validation(&self, info: &DeviceInfo) -> Result<()> {
        check_layer(self.validation_version, &info.name, !info.matrices.is_empty())
    }

    /// Returns the validation layer's errors and warnings so far.
    pub fn messages(&self) -> Vec<String> {
        lock(&self.messages).clone()
    }

    /// Returns the properties and capabilities of a device of this instance.
    pub fn describe(&self, index: usize, physical: vk::PhysicalDevice) -> DeviceInfo {
        describe(&self.entry, &self.raw, index, physical)
    }

    /// Returns the functions that query cooperative matrices, for devices that have them.
    pub fn cooperative_matrix(&self) -> khr::cooperative_matrix::Instance {
        khr::cooperative_matrix::Instance::new(&self.entry, &self.raw)
    }

    /// Lists every device, usable or not.
    pub fn devices(&self) -> Result<Vec<(vk::PhysicalDevice, DeviceInfo)>> {
        // SAFETY: the query needs only the instance, which `self` keeps alive.
        let physical = unsafe { self.raw.enumerate_physical_devices() }
            .map_err(|code| Error::NoDevice(format!("vkEnumeratePhysicalDevices failed: {code}")))?;
        Ok(physical.into_iter().enumerate().map(|(i, p)| (p, self.describe(i, p))).collect())
    }
}

impl Drop for Instance {
    fn drop(&mut self) {
        if let Some((debug, messenger)) = self.messenger.take() {
            // SAFETY: the messenger was made from this instance, which is alive, and is taken out exactly once.
            unsafe { debug.destroy_debug_utils_messenger(messenger, None) };
        }
        if self.ours {
            // SAFETY: a device owns the instance it was made from, so by now there is none; nothing else was made.
            unsafe { self.raw.destroy_instance(None) };
        }
    }
}

unsafe extern "system" fn on_message(
    _severity: vk::DebugUtilsMessageSeverityFlagsEXT,
    _kind: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    user: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: the layer passes data that is valid during the call; `user` is the box of an `Instance`, which destroys
    // the messenger first.
    let (data, sink) = unsafe { (&*data, &*user.cast::<Mutex<Vec<String>>>()) };
    // SAFETY: the message is null or, as Vulkan demands of the layer, a text that ends with a zero.
    let text = unsafe { data.message_as_c_str() }.map_or(String::new(), |t| t.to_string_lossy().into_owned());
    tracing::error!(target: "vulkan", "{text}");
    lock(sink).push(text);
    vk::FALSE
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_validation_layer_older_than_what_is_used_is_refused() {
        let old = vk::make_api_version(0, 1, 3, 239);
        let refused = check_layer(Some(old), "card", true).unwrap_err().to_string();
        assert!(refused.contains("card: ") && refused.contains("1.3.239") && refused.contains("1.3.255"), "{refused}");
        let new = vk::make_api_version(0, 1, 4, 309);
        for (version, has_matrices) in [(Some(old), false), (Some(new), true), (None, true)] {
            check_layer(version, "card", has_matrices).unwrap();
        }
    }
}
