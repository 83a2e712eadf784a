//! Training: in the calling thread, or in the background.

use crate::capi::reconstruction::{nertca_reconstruction, on_reconstruction};
use crate::capi::status::{Failure, nertca_status};
use crate::capi::types::{
    NERTCA_STATE_CANCELLED, NERTCA_STATE_FAILED, NERTCA_STATE_FINISHED, NERTCA_STATE_IDLE, NERTCA_STATE_PAUSED,
    NERTCA_STATE_RUNNING, NERTCA_STATE_WAITING, nertca_progress, nertca_progress_callback,
};
use crate::session::{Progress, State};
use std::ffi::c_void;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// A state as a number.
pub(super) fn state_code(state: State) -> u32 {
    match state {
        State::Idle => NERTCA_STATE_IDLE,
        State::Running => NERTCA_STATE_RUNNING,
        State::Paused => NERTCA_STATE_PAUSED,
        State::Waiting => NERTCA_STATE_WAITING,
        State::Finished => NERTCA_STATE_FINISHED,
        State::Cancelled => NERTCA_STATE_CANCELLED,
        State::Failed => NERTCA_STATE_FAILED,
    }
}

/// A progress callback with the caller's pointer.
struct Callback {
    call: nertca_progress_callback,
    user: *mut c_void,
    latest: Arc<Mutex<Option<Progress>>>,
}

// SAFETY: the header says on which thread the callback is called, with this pointer.
unsafe impl Send for Callback {}

impl Callback {
    /// Tells the caller; whether to go on.
    fn tell(&self, p: &Progress) -> bool {
        *self.latest.lock().unwrap_or_else(PoisonError::into_inner) = Some(*p);
        let Some(call) = self.call else { return true };
        let progress = nertca_progress {
            size: size_of::<nertca_progress>(),
            state: NERTCA_STATE_RUNNING,
            step: p.loss.step,
            iterations: p.iterations,
            frames: p.frames,
            loss: p.loss.total(),
            psnr_db: p.psnr_db,
            iterations_per_s: p.iterations_per_s,
        };
        // SAFETY: the header asks for a function that takes `user`; the progress it points to lives until the call
        // returns.
        unsafe { call(&raw const progress, self.user) == 0 }
    }
}

/// Trains up to `iterations` more in the calling thread, with the frames there are. `progress` may be null; a non-zero
/// result of it ends the call. `*done` (may be null) gets the iterations done: fewer at the end of the run.
///
/// One call at a time on a reconstruction; everything else may be called meanwhile from other threads.
///
/// @return NERTCA_ERROR_CANCELLED when the callback ended it; NERTCA_ERROR_NOT_READY without frames enough;
/// NERTCA_ERROR_BUSY while training in the background; NERTCA_ERROR_DIVERGED, with the last good state kept.
///
/// # Safety
/// `done` must be writable or null; `progress` must be callable with `user`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_train(
    reconstruction: *mut nertca_reconstruction,
    iterations: u32,
    progress: nertca_progress_callback,
    user: *mut c_void,
    done: *mut u32,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        if iterations == 0 {
            return Err(Failure::argument("iterations", "is 0"));
        }
        let callback = Callback { call: progress, user, latest: reconstruction.latest.clone() };
        let mut cancelled = false;
        let trained = reconstruction.session.train(iterations, &mut |p| {
            cancelled = !callback.tell(p);
            !cancelled
        })?;
        if !done.is_null() {
            // SAFETY: not null, and the header asks that it can be written.
            unsafe { done.write_unaligned(trained) };
        }
        if cancelled { Err(crate::error::Error::Interrupted.into()) } else { Ok(()) }
    })
}

/// Trains in the background until the run is done, and waits for frames while there are too few. `progress` may be
/// null; it is called on the training thread, and a non-zero result of it ends training. Any thread.
///
/// @return NERTCA_ERROR_BUSY while it does so already.
///
/// # Safety
/// `progress` must be callable with `user` on another thread until training has ended.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_start(
    reconstruction: *mut nertca_reconstruction,
    progress: nertca_progress_callback,
    user: *mut c_void,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        let callback = Callback { call: progress, user, latest: reconstruction.latest.clone() };
        Ok(reconstruction.session.start(Box::new(move |p| callback.tell(p)))?)
    })
}

/// Holds training in the background after the iterations under way; does nothing without any. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn nertca_reconstruction_pause(reconstruction: *mut nertca_reconstruction) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        reconstruction.session.pause();
        Ok(())
    })
}

/// Lets paused training go on; does nothing otherwise. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn nertca_reconstruction_resume(reconstruction: *mut nertca_reconstruction) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        reconstruction.session.resume();
        Ok(())
    })
}

/// Ends training in the background after the iterations under way and waits for that; does nothing without any.
/// Training may be started again. Any thread but that of the progress callback.
///
/// @return NERTCA_ERROR_BUSY from inside the progress callback.
#[unsafe(no_mangle)]
pub extern "C" fn nertca_reconstruction_stop(reconstruction: *mut nertca_reconstruction) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| Ok(reconstruction.session.stop()?))
}

/// Waits until training in the background has ended, at most `limit_ms` milliseconds; `*ended` (may be null) gets 1 or
/// 0. Any thread but that of the progress callback.
///
/// # Safety
/// `ended` must be writable or null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_wait(
    reconstruction: *mut nertca_reconstruction,
    limit_ms: u32,
    ended: *mut i32,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        let over = reconstruction.session.wait(Duration::from_millis(limit_ms.into()));
        if !ended.is_null() {
            // SAFETY: not null, and the header asks that it can be written.
            unsafe { ended.write_unaligned(over.into()) };
        }
        Ok(())
    })
}
