//! The boundary around every call: it catches all panics, and keeps the texts of failures.

use crate::status::{Failure, NERTCA_ERROR_INTERNAL, NERTCA_OK, Outcome, copy_text, nertca_status};
use crate::{callsites, handles};
use nertca_vk_runs::session::TRAINING_THREAD;
use std::cell::{Cell, RefCell};
use std::collections::HashMap;
use std::ffi::{c_char, c_void};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Once;

/// Number of texts kept per thread; beyond it, texts of destroyed handles are discarded.
const MAX_TEXTS: usize = 64;

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
        if last.len() >= MAX_TEXTS {
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
        assert!(text.contains("the sky fell") && text.contains("boundary.rs"), "{text}");
    }
}
