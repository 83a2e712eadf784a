//! Every log statement stays open for every context, whichever thread comes by first.
//!
//! A statement remembers for the whole process whether anyone listens. While there is a single subscriber, `tracing` asks
//! the thread that comes by first, and that may work for a context without a log: the statement would then be off for all.
//! Two subscribers that never go away, and never commit themselves, keep every statement open; whether it is heard is
//! then up to the log of the context at work.

use std::sync::LazyLock;
use tracing::span::{Attributes, Id, Record};
use tracing::subscriber::Interest;
use tracing::{Dispatch, Event, Metadata, Subscriber};

static UNDECIDED: LazyLock<[Dispatch; 2]> = LazyLock::new(|| [Dispatch::new(Undecided), Dispatch::new(Undecided)]);

/// Called at the start of every call, so that no statement is reached before.
pub(super) fn keep_open() {
    LazyLock::force(&UNDECIDED);
}

/// Listens to nothing, and rules nothing out.
struct Undecided;

impl Subscriber for Undecided {
    fn register_callsite(&self, _: &'static Metadata<'static>) -> Interest {
        Interest::sometimes()
    }

    fn enabled(&self, _: &Metadata<'_>) -> bool {
        false
    }

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn event(&self, _: &Event<'_>) {}

    fn enter(&self, _: &Id) {}

    fn exit(&self, _: &Id) {}
}
