//! State of a session and progress of its training.

use crate::fitting::losses::StepLoss;

/// State of a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// Not training.
    Idle,
    /// Training in the background.
    Running,
    /// Held by [`Session::pause`](crate::session::Session::pause).
    Paused,
    /// Training in the background as soon as there are frames enough.
    Waiting,
    /// All iterations are done.
    Finished,
    /// The observer ended it.
    Cancelled,
    /// An error ended it: see [`Session::failure`](crate::session::Session::failure).
    Failed,
}

impl State {
    /// Tells whether training in the background goes on, or will again.
    pub(super) fn in_background(self) -> bool {
        matches!(self, State::Running | State::Paused | State::Waiting)
    }
}

/// Progress of training.
#[derive(Debug, Clone, Copy)]
pub struct Progress {
    /// Losses of the last iteration.
    pub loss: StepLoss,
    /// Length of the run.
    pub iterations: u32,
    /// Training frames it uses.
    pub frames: u32,
    /// PSNR of the training rays of the last iteration, dB.
    pub psnr_db: f64,
    /// Iterations per second since training was last begun.
    pub iterations_per_s: f64,
}

/// Callback that receives the progress of training now and then; returns whether to go on.
pub type Observer<'a> = dyn FnMut(&Progress) -> bool + 'a;
