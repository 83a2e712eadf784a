//! Training: in the calling thread, or in the background.

use crate::reconstruction::{nertca_reconstruction, on_reconstruction};
use crate::status::{Failure, nertca_status};
use crate::types::{NERTCA_STATE_RUNNING, nertca_progress, nertca_progress_callback};
use nertca_vk_runs::session::Progress;
use std::ffi::c_void;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// A progress callback with the caller's pointer.
struct Callback {
    call: nertca_progress_callback,
    user: *mut c_void,
    latest: Arc<Mutex<Option<Progress>>>,
}

// SAFETY: the header says on which thread the callback is called, with this pointer.
unsafe impl Send for Callback {}

impl Callback {
    /// Reports progress to the caller; returns whether to continue.
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
        // SAFETY: the header requires a function that takes `user`; the progress it receives lives until the call
        // returns.
        unsafe { call(&raw const progress, self.user) == 0 }
    }
}

/// Trains up to `iterations` more iterations in the calling thread, with the frames added so far. `progress` may be
/// null; a non-zero result of it ends the call. `*done` (may be null) receives the number of iterations done, which is
/// smaller at the end of the run.
///
/// Only one such call at a time is allowed on a reconstruction; other threads may make all other calls meanwhile.
///
/// @return NERTCA_ERROR_CANCELLED when the callback ended the call, or `nertca_reconstruction_destroy`; NERTCA_ERROR_NOT_READY without
/// enough frames, or where the settings cannot be met with them; NERTCA_ERROR_BUSY while training in the background;
/// NERTCA_ERROR_DIVERGED, with the last good state kept.
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
            // SAFETY: the pointer is not null, and the header requires that it can be written.
            unsafe { done.write_unaligned(trained) };
        }
        if cancelled || reconstruction.session.is_closed() {
            Err(nertca_vk::error::Error::Interrupted.into())
        } else {
            Ok(())
        }
    })
}

/// Trains in the background until the run is complete. While there are too few frames, or the settings cannot be met with those there
/// are (nothing moves in them, for example), it waits for more or other ones in the state NERTCA_STATE_WAITING;
/// `nertca_reconstruction_failure` tells why. `progress` may be null; it is called on the training thread, and a non-zero result of it
/// ends training. Callable from any thread.
///
/// @return NERTCA_ERROR_BUSY if it is already training in the background.
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

/// Pauses training in the background after the iterations under way; does nothing without such training. Callable from
/// any thread.
#[unsafe(no_mangle)]
pub extern "C" fn nertca_reconstruction_pause(reconstruction: *mut nertca_reconstruction) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        reconstruction.session.pause();
        Ok(())
    })
}

/// Resumes paused training; does nothing otherwise. Callable from any thread.
#[unsafe(no_mangle)]
pub extern "C" fn nertca_reconstruction_resume(reconstruction: *mut nertca_reconstruction) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        reconstruction.session.resume();
        Ok(())
    })
}

/// Ends training in the background after the iterations under way, and waits until it has ended; does nothing without
/// such training. Training may be started again. Callable from any thread except that of the progress callback.
///
/// @return NERTCA_ERROR_BUSY from inside the progress callback.
#[unsafe(no_mangle)]
pub extern "C" fn nertca_reconstruction_stop(reconstruction: *mut nertca_reconstruction) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| Ok(reconstruction.session.stop()?))
}

/// Waits until training in the background has ended, at most `limit_ms` milliseconds. `*ended` (may be null) receives 1
/// if it has ended, else 0. Callable from any thread except that of the progress callback.
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
            // SAFETY: the pointer is not null, and the header requires that it can be written.
            unsafe { ended.write_unaligned(over.into()) };
        }
        Ok(())
    })
}
