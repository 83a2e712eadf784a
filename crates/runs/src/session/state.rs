//! State of a session, which its threads share.

use crate::calibrate::correction::Calibration;
use crate::checkpoint::Checkpoint;
use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::gpu::pipeline::KeptPipelines;
use crate::kernels::tuning::Tuning;
use crate::render::live::{Live, Source};
use crate::session::inbox::{Inbox, Taken};
use crate::session::long_work::{LongViewer, LongWork};
use crate::session::progress::State;
use crate::train::training::Training;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::ThreadId;
use std::time::{Duration, Instant};

pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// State that the threads of a session share.
pub(super) struct Shared {
    pub(super) gpu: Option<Gpu>,
    pub(super) tuning: Option<Tuning>,
    /// Fits and renderers follow one another, and need the same pipelines.
    pub(super) _pipelines: Option<KeptPipelines>,
    pub(super) inbox: Mutex<Inbox>,
    /// Rises with every change of the inbox.
    pub(super) version: AtomicU64,
    pub(super) engine: Mutex<Engine>,
    /// Number of threads that wait for the engine, other than training in the background.
    pub(super) visitors: AtomicU32,
    pub(super) published: Mutex<Published>,
    /// Calibration of the frames that training uses; none before it begins.
    pub(super) calibration: Mutex<Option<Calibration>>,
    /// Iterations handed to the device.
    pub(super) step: AtomicU32,
    pub(super) viewer: Mutex<Option<Viewer>>,
    /// The last live picture.
    pub(super) drawn: Mutex<Option<Drawn>>,
    /// Renderer of long work, for which live pictures do not wait. Work under way keeps the source that it began with.
    pub(super) fields: Mutex<Option<LongViewer>>,
    pub(super) long_work: LongWork,
    /// Whether a thread trains at this moment, which then keeps up to date what live pictures show.
    pub(super) renews: AtomicBool,
    /// Frames that training took in last.
    pub(super) taken: Mutex<Taken>,
    pub(super) control: Mutex<Control>,
    pub(super) changed: Condvar,
    pub(super) stop: AtomicBool,
    pub(super) pause: AtomicBool,
}

/// The run under way.
#[derive(Default)]
pub(super) struct Engine {
    pub(super) training: Option<Training>,
    /// State to begin from where there is no trainer, and to fall back to.
    pub(super) saved: Option<Checkpoint>,
    /// Version of the inbox from which the trainer was built.
    pub(super) version: u64,
    pub(super) frames: u32,
    /// Whether the data ask for the mean of several fits, which follow the first one.
    pub(super) repeats: bool,
    /// Version of the inbox whose reconstruction was refined, or needs no refinement; 0 for none.
    pub(super) refined: u64,
    /// State before the refinement, from which training with other frames goes on.
    pub(super) unrefined: Option<Checkpoint>,
    /// Pause before new frames are taken in.
    pub(super) settling: Option<Settling>,
}

/// Pause by which frames that come one after the other are taken in together: otherwise training would do nothing else.
#[derive(Clone, Copy)]
pub(super) struct Settling {
    /// End of the pause.
    pub(super) until: Instant,
    /// Longest time without a new frame that the pause waits for.
    pub(super) quiet: Duration,
}

/// Source that is drawn.
#[derive(Default)]
pub(super) struct Published {
    pub(super) generation: u64,
    pub(super) source: Option<Source>,
    /// Number of frames that the field was fitted to.
    pub(super) frames: u32,
}

/// Renderer of live pictures.
#[derive(Clone)]
pub(super) struct Viewer {
    /// Generation of the source that it shows.
    pub(super) generation: u64,
    /// Number of frames that its field was fitted to.
    pub(super) frames: u32,
    pub(super) live: Arc<Live>,
}

/// Field that a live picture showed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Drawn {
    /// Number of frames that it was fitted to; 0 for a checkpoint that was loaded.
    pub frames: u32,
    /// Iterations of the oldest part that the picture shows.
    pub step: u32,
}

/// State of training, for those who wait for it.
pub(super) struct Control {
    pub(super) state: State,
    /// Reason why training in the background failed, or why it waits.
    pub(super) reason: Option<String>,
    pub(super) worker: Option<ThreadId>,
    /// When frames or R-peaks came last.
    pub(super) news: Instant,
    /// Time between the last two.
    pub(super) news_apart: Duration,
    /// Version of the inbox at which training in the background found too few frames.
    pub(super) waits_at: u64,
}

pub(super) fn nothing_yet() -> Error {
    Error::NotReady("there is no reconstruction yet: train first, or load a checkpoint".into())
}

impl Engine {
    /// Iterations done.
    pub(super) fn step(&self) -> u32 {
        self.training.as_ref().map_or(0, |t| t.trainer().step())
    }

    /// Counts time and iterations from now on.
    pub(super) fn start_clock(&mut self) {
        if let Some(training) = &mut self.training {
            training.start_clock();
        }
    }

    /// Number of iterations of the run.
    pub(super) fn length(&self) -> u32 {
        self.training.as_ref().map_or(0, |t| t.trainer().plan().config.train.iterations)
    }
}

impl Shared {
    pub(super) fn device(&self) -> Result<(&Gpu, &Tuning)> {
        match (&self.gpu, &self.tuning) {
            (Some(gpu), Some(tuning)) => Ok((gpu, tuning)),
            _ => Err(Error::NoDevice("the context was created without a device".into())),
        }
    }

    /// Locks the engine before training in the background takes it again.
    pub(super) fn visit(&self) -> MutexGuard<'_, Engine> {
        self.visitors.fetch_add(1, Ordering::AcqRel);
        let engine = lock(&self.engine);
        self.visitors.fetch_sub(1, Ordering::AcqRel);
        engine
    }
}
