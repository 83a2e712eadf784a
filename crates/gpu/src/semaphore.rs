//! Semaphores that other devices, APIs and processes wait for.

use crate::device::{Gpu, Shared};
use crate::error::{Error, Result};
use crate::record::Ticket;
use ash::vk;
use std::os::fd::{FromRawFd, OwnedFd};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Handle type of exported semaphores.
const EXPORTED: vk::ExternalSemaphoreHandleTypeFlags = vk::ExternalSemaphoreHandleTypeFlags::OPAQUE_FD;

/// Name of exported semaphores in messages.
const NAME: &str = "exported semaphore";

/// Binary semaphore whose state others import through file descriptors. Each signal must be waited for once, in another queue, before the
/// next.
pub struct ExportedSemaphore {
    gpu: Arc<Shared>,
    raw: vk::Semaphore,
    /// Value of the device's timeline after the last submit that signals the semaphore; 0 before the first.
    last_submit: AtomicU64,
}

impl Gpu {
    /// Makes a semaphore that can be exported as an opaque file descriptor.
    ///
    /// # Errors
    /// [`Error::NoDevice`] where `VK_KHR_external_semaphore_fd` is missing or knows no opaque descriptors; [`Error::OutOfMemory`].
    pub fn exported_semaphore(&self) -> Result<ExportedSemaphore> {
        let info = self.info();
        if !info.external_semaphore_fd {
            let missing = "semaphores as opaque file descriptors (VK_KHR_external_semaphore_fd)";
            let problem = format!("{}: the device does not export {missing}", info.name);
            return Err(Error::NoDevice(problem));
        }
        let mut export = vk::ExportSemaphoreCreateInfo::default().handle_types(EXPORTED);
        let create = vk::SemaphoreCreateInfo::default().push_next(&mut export);
        // SAFETY: the chain lives until the call returns, and the device has the extension and exports such semaphores.
        let raw = unsafe { self.shared.device.create_semaphore(&create, None) }
            .map_err(Error::vulkan("vkCreateSemaphore", NAME))?;
        self.shared.track();
        Ok(ExportedSemaphore { gpu: self.shared.clone(), raw, last_submit: AtomicU64::new(0) })
    }
}

impl ExportedSemaphore {
    /// Returns a new descriptor of the semaphore, which the caller must import or close.
    ///
    /// # Errors
    /// [`Error::Vulkan`].
    pub fn descriptor(&self) -> Result<OwnedFd> {
        let get = vk::SemaphoreGetFdInfoKHR::default().semaphore(self.raw).handle_type(EXPORTED);
        let export = ash::khr::external_semaphore_fd::Device::new(&self.gpu.device.instance, &self.gpu.device);
        // SAFETY: the semaphore was made for export as this type.
        let fd = unsafe { export.get_semaphore_fd(&get) }.map_err(Error::vulkan("vkGetSemaphoreFdKHR", NAME))?;
        // SAFETY: Vulkan passes ownership of the descriptor to its caller, and nothing else uses it.
        Ok(unsafe { OwnedFd::from_raw_fd(fd) })
    }

    /// Signals the semaphore after all work that was submitted before. What this work has written is then visible to who waits.
    ///
    /// # Errors
    /// [`Error::DeviceLost`], [`Error::OutOfMemory`] or [`Error::Vulkan`].
    pub fn signal(&self) -> Result<Ticket> {
        let ticket = self.gpu.submit_signal(self.raw, NAME)?;
        self.last_submit.store(ticket.value(), Ordering::Release);
        Ok(ticket)
    }
}

impl Drop for ExportedSemaphore {
    fn drop(&mut self) {
        let submitted = self.last_submit.load(Ordering::Acquire);
        if submitted > 0 {
            // A lost device runs nothing, so destroying is allowed even if the wait fails.
            let _ = self.gpu.wait(submitted);
        }
        // SAFETY: the last submit that uses the semaphore is complete, and it is destroyed once, here.
        unsafe { self.gpu.device.destroy_semaphore(self.raw, None) };
        self.gpu.untrack();
    }
}
