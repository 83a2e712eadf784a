//! Semaphores by which other APIs and devices wait for what was drawn into a shared buffer.

use crate::boundary::call;
use crate::context::{Claim, Context, nertca_context, on_context};
use crate::handles::{self, Kind};
use crate::status::{Failure, NERTCA_ERROR_BUSY, NERTCA_OK, nertca_status};
use std::sync::Arc;

/// A semaphore of the device that other APIs and processes can import.
pub struct nertca_semaphore {
    _opaque: [u8; 0],
}

#[cfg(unix)]
mod system {
    use nertca_vk::error::{Error, Result};
    use nertca_vk::gpu::device::Gpu;
    use nertca_vk::gpu::semaphore::ExportedSemaphore;
    use std::os::fd::IntoRawFd;

    /// Semaphore that others import by descriptors.
    pub struct Semaphore(ExportedSemaphore);

    impl Semaphore {
        pub fn new(gpu: &Gpu) -> Result<Semaphore> {
            Ok(Semaphore(gpu.exported_semaphore()?))
        }

        /// Returns a new descriptor of the semaphore, which the caller owns.
        pub fn descriptor(&self) -> Result<i32> {
            Ok(self.0.descriptor().map_err(Error::from)?.into_raw_fd())
        }

        pub fn signal(&self) -> Result<()> {
            self.0.signal()?;
            Ok(())
        }
    }
}

#[cfg(not(unix))]
mod system {
    use nertca_vk::error::{Error, Result};
    use nertca_vk::gpu::device::Gpu;

    /// This type has no values: such semaphores do not exist here.
    pub enum Semaphore {}

    impl Semaphore {
        pub fn new(_: &Gpu) -> Result<Semaphore> {
            let problem = "semaphores are shared through file descriptors, which this system does not support";
            Err(Error::NoDevice(problem.into()))
        }

        pub fn descriptor(&self) -> Result<i32> {
            match *self {}
        }

        pub fn signal(&self) -> Result<()> {
            match *self {}
        }
    }
}

/// Object behind [`nertca_semaphore`].
struct SharedSemaphore {
    semaphore: system::Semaphore,
    _claim: Claim,
    process: u32,
}

impl Kind for SharedSemaphore {
    const NAME: &'static str = "semaphore";

    fn process(&self) -> u32 {
        self.process
    }
}

/// Makes a binary semaphore on the device that can be shared through `VK_KHR_external_semaphore_fd`. `*semaphore` is null on
/// failure. Callable from any thread.
///
/// @return NERTCA_ERROR_DEVICE where the device does not export semaphores as opaque descriptors (`external_semaphore_fd` of
/// `nertca_context_describe` is false).
///
/// # Safety
/// `semaphore` must be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_semaphore_create(
    context: *mut nertca_context,
    semaphore: *mut *mut nertca_semaphore,
) -> nertca_status {
    on_context(context, |context: &Arc<Context>| {
        if semaphore.is_null() {
            return Err(Failure::argument("semaphore", "is null"));
        }
        // SAFETY: `semaphore` is not null, and the header requires that it can be written.
        unsafe { semaphore.write_unaligned(std::ptr::null_mut()) };
        let made = system::Semaphore::new(context.device()?)?;
        let shared = SharedSemaphore { semaphore: made, _claim: Claim::new(context), process: std::process::id() };
        let handle = handles::insert(Arc::new(shared))?;
        // SAFETY: `semaphore` was checked and written above, and the caller's memory is still valid.
        unsafe { semaphore.write_unaligned(std::ptr::without_provenance_mut(handle)) };
        Ok(())
    })
}

/// Returns a new file descriptor of the semaphore (`VK_EXTERNAL_SEMAPHORE_HANDLE_TYPE_OPAQUE_FD_BIT`), which the caller must import
/// or close. Callable from any thread.
///
/// # Safety
/// `fd` must be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_semaphore_export_fd(semaphore: *mut nertca_semaphore, fd: *mut i32) -> nertca_status {
    call(semaphore, || {
        let shared = handles::get::<SharedSemaphore, _>(semaphore)?;
        if fd.is_null() {
            return Err(Failure::argument("fd", "is null"));
        }
        let copy = shared.semaphore.descriptor()?;
        // SAFETY: `fd` is not null, and the header requires that it can be written.
        unsafe { fd.write_unaligned(copy) };
        Ok(())
    })
}

/// Signals the semaphore on the device's queue, after the work of all calls that have returned: a picture in a shared buffer, for
/// example, is then visible to the commands of another device that wait for the semaphore. The call does not wait. Each signal must be
/// waited for once before the next. Callable from any thread.
///
/// @return NERTCA_ERROR_DEVICE_LOST where the device no longer works.
#[unsafe(no_mangle)]
pub extern "C" fn nertca_semaphore_signal(semaphore: *mut nertca_semaphore) -> nertca_status {
    call(semaphore, || {
        let shared = handles::get::<SharedSemaphore, _>(semaphore)?;
        Ok(shared.semaphore.signal()?)
    })
}

/// Destroys a semaphore, after its last signal; what others imported stays valid for them. Null is allowed, and does nothing. Waits for
/// calls on the semaphore in other threads.
#[unsafe(no_mangle)]
pub extern "C" fn nertca_semaphore_destroy(semaphore: *mut nertca_semaphore) -> nertca_status {
    if semaphore.is_null() {
        return NERTCA_OK;
    }
    call(semaphore, || {
        if handles::is_active(semaphore) {
            return Err(Failure::new(NERTCA_ERROR_BUSY, "semaphore: it is in use by a call in this thread"));
        }
        handles::remove::<SharedSemaphore, _>(semaphore).map(drop)
    })
}
