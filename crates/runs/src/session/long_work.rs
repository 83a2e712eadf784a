//! Long work on the fields of a session: scores, volumes, trees and exact pictures. It is done in slices. Live pictures pass between
//! slices, and it can be cancelled there.

use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::render::live::Live;
use crate::render::renderer::Interlude;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// Function that is called between slices.
pub(super) type SliceObserver = Arc<dyn Fn() + Send + Sync>;

/// Cancellations of the long work of a session.
#[derive(Default)]
struct Cancelled {
    /// Number of times that work under way was cancelled.
    times: AtomicU64,
    /// Whether all work, also that which begins later, is cancelled.
    for_good: AtomicBool,
}

/// Long work of a session.
#[derive(Default)]
pub(super) struct LongWork {
    cancelled: Arc<Cancelled>,
    observer: Mutex<Option<SliceObserver>>,
}

/// A call that does long work.
#[derive(Clone)]
pub(super) struct LongCall {
    cancelled: Arc<Cancelled>,
    cancelled_before: u64,
    observer: Option<SliceObserver>,
}

/// Renderer of a call, kept for the next one.
pub(super) struct LongViewer {
    /// Generation of the source that it shows.
    pub(super) generation: u64,
    pub(super) live: Live,
    /// Call that uses it.
    pub(super) call: Arc<Mutex<LongCall>>,
}

impl LongWork {
    /// Begins a call.
    pub(super) fn begin(&self) -> LongCall {
        LongCall {
            cancelled: self.cancelled.clone(),
            cancelled_before: self.cancelled.times.load(Ordering::Acquire),
            observer: self.observer.lock().unwrap_or_else(PoisonError::into_inner).clone(),
        }
    }

    /// Ends the calls under way at their next slices.
    pub(super) fn cancel(&self) {
        self.cancelled.times.fetch_add(1, Ordering::AcqRel);
    }

    /// Ends the calls under way at their next slices, and calls that begin later at their first.
    pub(super) fn close(&self) {
        self.cancelled.for_good.store(true, Ordering::Release);
    }

    /// Tells whether all work is cancelled.
    pub(super) fn is_closed(&self) -> bool {
        self.cancelled.for_good.load(Ordering::Acquire)
    }

    /// Sets the function that is called between the slices of calls that begin later.
    pub(super) fn observe(&self, observer: Option<SliceObserver>) {
        *self.observer.lock().unwrap_or_else(PoisonError::into_inner) = observer;
    }

    /// Returns what happens between the slices of a call: live pictures pass, and cancelled work ends.
    pub(super) fn interlude(gpu: &Gpu, call: &Arc<Mutex<LongCall>>) -> Interlude {
        let (looks, call) = (gpu.looks().clone(), call.clone());
        Arc::new(move || {
            let now = call.lock().unwrap_or_else(PoisonError::into_inner).clone();
            now.check()?;
            if let Some(observer) = &now.observer {
                observer();
            }
            looks.give_way();
            Ok(())
        })
    }
}

impl LongCall {
    /// Returns an error if the call was cancelled.
    ///
    /// # Errors
    /// [`Error::Interrupted`].
    pub(super) fn check(&self) -> Result<()> {
        let Cancelled { times, for_good } = &*self.cancelled;
        let is_cancelled = times.load(Ordering::Acquire) != self.cancelled_before || for_good.load(Ordering::Acquire);
        if is_cancelled { Err(Error::Interrupted) } else { Ok(()) }
    }
}
