//! Status codes, error texts, and the boundary that catches all panics.

use crate::capi::{callsites, handles};
use crate::error::Error;
use crate::session::TRAINING_THREAD;
use std::cell::{Cell, RefCell};
use std::collections::HashMap;
use std::ffi::{c_char, c_void};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Once;

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
            Error::NotReady(_) => NERTCA_ERROR_NOT_READY,
            Error::Internal(_) => NERTCA_ERROR_INTERNAL,
        };
        Failure::new(status, error.to_string())
    }
}

/// Number of texts kept per thread; beyond it, texts of destroyed handles are discarded.
const MOST_TEXTS: usize = 64;

thread_local! {
    /// Text of the last failure by handle; key 0 has the last failure of any handle.
    static LAST: RefCell<HashMap<usize, String>> = RefCell::default();
    /// Report of a panic inside a call: it becomes the call's failure, and is not printed.
    static PANIC: RefCell<Option<String>> = const { RefCell::new(None) };
    static DEPTH: Cell<u32> = const { Cell::new(0) };
}

fn remember(handle: usize, text: &str) {
    // A thread that is ending has no texts.
    let _ = LAST.try_with(|last| {
        let mut last = last.borrow_mut();
        if last.len() >= MOST_TEXTS {
            last.retain(|handle, _| *handle == 0 || handles::exists(*handle));
        }
        last.insert(handle, text.to_owned());
        last.insert(0, text.to_owned());
    });
}

/// Installs a panic hook. Panics inside a call, or in threads that work for one, are kept for the call's failure; all others go
/// to the previous hook.
fn catch_reports() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            let training = std::thread::current().name() == Some(TRAINING_THREAD);
            if training || rayon::current_thread_index().is_some() || DEPTH.try_with(Cell::get).unwrap_or(0) > 0 {
                let _ = PANIC.try_with(|panic| *panic.borrow_mut() = Some(info.to_string()));
            } else {
                before(info);
            }
        }));
    });
}

/// Guard that marks this thread as inside the library.
struct Inside;

impl Inside {
    fn enter() -> Inside {
        catch_reports();
        callsites::keep_open();
        let _ = DEPTH.try_with(|depth| depth.set(depth.get() + 1));
        Inside
    }
}

impl Drop for Inside {
    fn drop(&mut self) {
        let _ = DEPTH.try_with(|depth| depth.set(depth.get() - 1));
    }
}

/// Runs the body of a call on `handle` (null for none). Its failure, or panic, becomes a status and a text.
pub(super) fn call<H>(handle: *const H, body: impl FnOnce() -> Outcome<()>) -> nertca_status {
    let inside = Inside::enter();
    let outcome = catch_unwind(AssertUnwindSafe(body));
    drop(inside);
    let failure = match outcome {
        Ok(Ok(())) => return NERTCA_OK,
        Ok(Err(failure)) => failure,
        Err(_) => {
            let report = PANIC.try_with(|panic| panic.borrow_mut().take()).ok().flatten();
            let report = report.unwrap_or_else(|| "panic".into());
            Failure::new(NERTCA_ERROR_INTERNAL, format!("internal fault: {report}. Please report it"))
        }
    };
    remember(handle.addr(), &failure.text);
    failure.status
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

/// Returns the text of the last failed call on `handle` (of any type) in this thread, or of the last failed call of all when
/// `handle` is null; empty when there was none. The text is UTF-8 with a closing zero, truncated to `size` bytes. `*length`
/// receives the full length without the zero. With a null `text` and a `size` of 0, only the length is returned.
///
/// Callable from any thread. Texts of calls without a handle (those that create one) are found under null.
///
/// @return NERTCA_OK, NERTCA_ERROR_BUFFER when the text was truncated, NERTCA_ERROR_ARGUMENT.
///
/// # Safety
/// `text` must hold `size` bytes; `length` must be writable or null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_last_error(
    handle: *const c_void,
    text: *mut c_char,
    size: usize,
    length: *mut usize,
) -> nertca_status {
    let inside = Inside::enter();
    let last = LAST.try_with(|last| last.borrow().get(&handle.addr()).cloned()).ok().flatten().unwrap_or_default();
    // SAFETY: the header requires that `text` holds `size` bytes and that `length` is null or can be written.
    let outcome = catch_unwind(AssertUnwindSafe(|| unsafe { copy_text(&last, text, size, length) }));
    drop(inside);
    // A failure here does not replace the text that the caller wanted to read.
    match outcome {
        Ok(Ok(())) => NERTCA_OK,
        Ok(Err(failure)) => failure.status,
        Err(_) => NERTCA_ERROR_INTERNAL,
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_becomes_a_status_and_a_text() {
        let handle = std::ptr::without_provenance::<c_void>(12_345);
        let status = call(handle, || panic!("the sky fell"));
        assert_eq!(status, NERTCA_ERROR_INTERNAL);
        let mut text = [0; 256];
        // SAFETY: the text has room.
        unsafe { nertca_last_error(handle, text.as_mut_ptr(), text.len(), std::ptr::null_mut()) };
        // SAFETY: it ends with a zero.
        let text = unsafe { std::ffi::CStr::from_ptr(text.as_ptr()) }.to_string_lossy().into_owned();
        assert!(text.contains("the sky fell") && text.contains("status.rs"), "{text}");
    }
}
