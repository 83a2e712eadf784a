//! Sends the engine's log messages to the caller's log callback; nothing is printed.

use crate::status::{Failure, Outcome};
use crate::types::nertca_log;
use std::ffi::{CString, c_char, c_void};
use std::fmt::Write as _;
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::subscriber::Interest;
use tracing::{Dispatch, Event, Level, Metadata, Subscriber};

/// Severity of a log message: an error.
pub const NERTCA_LOG_ERROR: u32 = 1;
/// Severity of a log message: a warning.
pub const NERTCA_LOG_WARNING: u32 = 2;
/// Severity of a log message: information on the work being done, and the reasons.
pub const NERTCA_LOG_INFO: u32 = 3;

struct Callback {
    call: unsafe extern "C" fn(u32, *const c_char, *mut c_void),
    user: *mut c_void,
    max: u32,
}

// SAFETY: the header requires a callback and a pointer that may be used on any thread.
unsafe impl Send for Callback {}
// SAFETY: the header also says that messages may come on several threads at once.
unsafe impl Sync for Callback {}

/// Returns the receiver of a context's messages.
pub(super) fn dispatch(log: Option<nertca_log>) -> Outcome<Dispatch> {
    let Some(log) = log else { return Ok(Dispatch::none()) };
    if log.level == 0 || log.level > NERTCA_LOG_INFO {
        return Err(Failure::argument("log.level", format!("{} is not in the accepted range, 1 to 3", log.level)));
    }
    let Some(call) = log.callback else { return Err(Failure::argument("log.callback", "is null")) };
    Ok(Dispatch::new(Callback { call, user: log.user, max: log.level }))
}

fn severity(level: Level) -> u32 {
    match level {
        Level::ERROR => NERTCA_LOG_ERROR,
        Level::WARN => NERTCA_LOG_WARNING,
        Level::INFO => NERTCA_LOG_INFO,
        _ => u32::MAX,
    }
}

struct Text(String);

impl Visit for Text {
    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        // Writing to a string cannot fail.
        let _ = match field.name() {
            "message" => write!(self.0, "{value:?}"),
            name => write!(self.0, " {name}={value:?}"),
        };
    }
}

impl Subscriber for Callback {
    /// Never gives a final answer, because other contexts have logs of their own; see [`crate::callsites`].
    fn register_callsite(&self, _: &'static Metadata<'static>) -> Interest {
        Interest::sometimes()
    }

    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        metadata.is_event()
            && metadata.target().starts_with("nertca") | (metadata.target() == "vulkan")
            && severity(*metadata.level()) <= self.max
    }

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn event(&self, event: &Event<'_>) {
        let mut text = Text(String::new());
        event.record(&mut text);
        // A zero inside the text would end the C string.
        let text = CString::new(text.0.replace('\0', "?")).unwrap_or_default();
        // SAFETY: the caller gave function and pointer for this purpose, valid for the lifetime of the context; the text lives
        // until the call returns.
        unsafe { (self.call)(severity(*event.metadata().level()), text.as_ptr(), self.user) };
    }

    fn enter(&self, _: &Id) {}

    fn exit(&self, _: &Id) {}
}
