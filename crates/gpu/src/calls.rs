//! Numbers of the host's calls to a device.

use std::sync::atomic::{AtomicU64, Ordering};

/// Numbers of the host's calls to a device, each of which takes microseconds to milliseconds on a GPU however little work it is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Calls {
    /// Submits to the queue.
    pub submits: u64,
    /// Waits of the host for submits, those that found them complete included.
    pub waits: u64,
    /// Command buffers that were recorded.
    pub recordings: u64,
    /// Buffers that were made.
    pub buffers: u64,
    /// Barriers in submitted commands, at which dispatches wait for earlier ones.
    pub barriers: u64,
}

impl Calls {
    /// Returns the calls since earlier numbers of the same device.
    #[must_use]
    pub fn since(&self, earlier: &Calls) -> Calls {
        Calls {
            submits: self.submits - earlier.submits,
            waits: self.waits - earlier.waits,
            recordings: self.recordings - earlier.recordings,
            buffers: self.buffers - earlier.buffers,
            barriers: self.barriers - earlier.barriers,
        }
    }
}

/// Counters of [`Calls`].
#[derive(Default)]
pub(super) struct CallCounters {
    pub(super) submits: AtomicU64,
    pub(super) waits: AtomicU64,
    pub(super) recordings: AtomicU64,
    pub(super) buffers: AtomicU64,
    pub(super) barriers: AtomicU64,
}

impl CallCounters {
    /// Returns the numbers so far.
    pub(super) fn read(&self) -> Calls {
        let CallCounters { submits, waits, recordings, buffers, barriers } = self;
        let [submits, waits, recordings, buffers, barriers] =
            [submits, waits, recordings, buffers, barriers].map(|counter| counter.load(Ordering::Relaxed));
        Calls { submits, waits, recordings, buffers, barriers }
    }
}
