//! Status codes and failures of calls.

use nertca_vk::error::Error;
use std::ffi::c_char;

/// Result of a call: 0 for success, negative for an error whose text `nertca_last_error` returns.
pub type nertca_status = i32;

/// Success.
pub const NERTCA_OK: nertca_status = 0;
/// An argument is null, out of range, or contradicts another.
pub const NERTCA_ERROR_ARGUMENT: nertca_status = -1;
/// A handle was destroyed, has another type, or is not a handle.
pub const NERTCA_ERROR_HANDLE: nertca_status = -2;
/// Data that was passed (for example a checkpoint) is malformed.
pub const NERTCA_ERROR_DATA: nertca_status = -3;
/// The operating system refused a file operation.
pub const NERTCA_ERROR_IO: nertca_status = -4;
/// No device fits, or it lacks a requested feature.
pub const NERTCA_ERROR_DEVICE: nertca_status = -5;
/// The device stopped answering: destroy everything made from the context, then the context.
pub const NERTCA_ERROR_DEVICE_LOST: nertca_status = -6;
/// Memory ran out, or the context's limit was reached.
pub const NERTCA_ERROR_MEMORY: nertca_status = -7;
/// Training diverged; the last good state is kept.
pub const NERTCA_ERROR_DIVERGED: nertca_status = -8;
/// A callback cancelled the call.
pub const NERTCA_ERROR_CANCELLED: nertca_status = -9;
/// The call is not possible while something else is active (training, or handles that still exist).
pub const NERTCA_ERROR_BUSY: nertca_status = -10;
/// The buffer passed is too small; the required length was written.
pub const NERTCA_ERROR_BUFFER: nertca_status = -11;
/// The call needs something that is not there yet: frames, or training.
pub const NERTCA_ERROR_NOT_READY: nertca_status = -12;
/// A handle of the parent process was used after a fork.
pub const NERTCA_ERROR_FORKED: nertca_status = -13;
/// A fault of this library. Please report it.
pub const NERTCA_ERROR_INTERNAL: nertca_status = -14;

/// Status and text of a failed call.
#[derive(Debug)]
pub(super) struct Failure {
    pub status: nertca_status,
    pub text: String,
}

pub(super) type Outcome<T> = Result<T, Failure>;

impl Failure {
    pub fn new(status: nertca_status, text: impl Into<String>) -> Failure {
        Failure { status, text: text.into() }
    }

    pub fn argument(name: &str, problem: impl std::fmt::Display) -> Failure {
        Failure::new(NERTCA_ERROR_ARGUMENT, format!("{name}: {problem}"))
    }
}

impl From<nertca_vk::gpu::error::Error> for Failure {
    fn from(error: nertca_vk::gpu::error::Error) -> Failure {
        Error::from(error).into()
    }
}

impl From<Error> for Failure {
    fn from(error: Error) -> Failure {
        let status = match &error {
            Error::Config { .. } => NERTCA_ERROR_ARGUMENT,
            Error::Data { .. } => NERTCA_ERROR_DATA,
            Error::Io { .. } => NERTCA_ERROR_IO,
            Error::NoDevice(_) | Error::Vulkan { .. } => NERTCA_ERROR_DEVICE,
            Error::DeviceLost { .. } => NERTCA_ERROR_DEVICE_LOST,
            Error::OutOfMemory { .. } => NERTCA_ERROR_MEMORY,
            Error::Diverged { .. } => NERTCA_ERROR_DIVERGED,
            Error::Interrupted => NERTCA_ERROR_CANCELLED,
            Error::Busy(_) => NERTCA_ERROR_BUSY,
            Error::NotReady(_) | Error::Unmet { .. } => NERTCA_ERROR_NOT_READY,
            // `Error::Internal`, and variants that have no status of their own.
            _ => NERTCA_ERROR_INTERNAL,
        };
        Failure::new(status, error.to_string())
    }
}

/// Copies a text with its closing zero into a caller's buffer, truncated to fit. `length` receives the full length without the
/// zero.
///
/// # Safety
/// `buffer` must hold `size` bytes, unless null; `length` must be writable, unless null.
pub(super) unsafe fn copy_text(text: &str, buffer: *mut c_char, size: usize, length: *mut usize) -> Outcome<()> {
    if !length.is_null() {
        // SAFETY: the pointer is not null, and callers of this function guarantee that it can be written.
        unsafe { length.write_unaligned(text.len()) };
    }
    if buffer.is_null() {
        let asks = size == 0 && !length.is_null();
        return if asks { Ok(()) } else { Err(Failure::argument("buffer", "is null")) };
    }
    if size == 0 {
        return Err(Failure::argument("size", "is 0"));
    }
    let n = text.len().min(size - 1);
    // SAFETY: the caller guarantees `size` bytes.
    unsafe {
        std::ptr::copy_nonoverlapping(text.as_ptr(), buffer.cast(), n);
        buffer.add(n).write(0);
    }
    if n < text.len() {
        return Err(Failure::new(NERTCA_ERROR_BUFFER, format!("{} bytes are needed", text.len() + 1)));
    }
    Ok(())
}

/// Returns a short description of a status, for logs. The text is static, and never null. Callable from any thread.
#[unsafe(no_mangle)]
pub extern "C" fn nertca_status_text(status: nertca_status) -> *const c_char {
    (match status {
        NERTCA_OK => c"ok",
        NERTCA_ERROR_ARGUMENT => c"invalid argument",
        NERTCA_ERROR_HANDLE => c"invalid handle",
        NERTCA_ERROR_DATA => c"malformed data",
        NERTCA_ERROR_IO => c"file error",
        NERTCA_ERROR_DEVICE => c"device error",
        NERTCA_ERROR_DEVICE_LOST => c"device lost",
        NERTCA_ERROR_MEMORY => c"out of memory",
        NERTCA_ERROR_DIVERGED => c"training diverged",
        NERTCA_ERROR_CANCELLED => c"cancelled",
        NERTCA_ERROR_BUSY => c"busy",
        NERTCA_ERROR_BUFFER => c"buffer too small",
        NERTCA_ERROR_NOT_READY => c"not ready",
        NERTCA_ERROR_FORKED => c"used after fork",
        NERTCA_ERROR_INTERNAL => c"internal fault",
        _ => c"unknown status",
    })
    .as_ptr()
}
