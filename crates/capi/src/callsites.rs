//! Keeps every log statement enabled for every context, whichever thread reaches it first.
//!
//! A log statement stores for the whole process whether any subscriber is interested. While there is a single subscriber,
//! `tracing` asks the subscriber of the thread that arrives first. That thread may work for a context without a log, which
//! would disable the statement for all contexts. Two permanent subscribers that never give a final answer keep every statement
//! enabled; the log of the context at work then decides whether the message is delivered.

use std::sync::LazyLock;
use tracing::span::{Attributes, Id, Record};
use tracing::subscriber::Interest;
use tracing::{Dispatch, Event, Metadata, Subscriber};

static UNDECIDED: LazyLock<[Dispatch; 2]> = LazyLock::new(|| [Dispatch::new(Undecided), Dispatch::new(Undecided)]);

/// Creates the two subscribers. Every call of the ABI does this first, so that it precedes every log statement.
pub(super) fn keep_open() {
    LazyLock::force(&UNDECIDED);
}

/// Subscriber that receives nothing, but never declares a statement uninteresting.
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
