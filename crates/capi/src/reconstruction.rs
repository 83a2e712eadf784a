//! Reconstructions: adding frames, saving and loading checkpoints.

use crate::boundary::call;
use crate::context::{Claim, Context, nertca_context, on_context};
use crate::handles::{self, Kind};
use crate::options::{Options, text};
use crate::status::{
    Failure, NERTCA_ERROR_BUFFER, NERTCA_ERROR_BUSY, NERTCA_ERROR_NOT_READY, NERTCA_OK, Outcome, copy_text,
    nertca_status,
};
use crate::types::{
    NERTCA_USE_NO_PHASE, NERTCA_USE_ONE_PHASE, NERTCA_USE_TRAINING, NERTCA_USE_VALIDATION, nertca_frame,
    nertca_frame_status, nertca_progress, read, state_code, write,
};
use nertca_vk::checkpoint::Checkpoint;
use nertca_vk::choice::Choice;
use nertca_vk::config::{Config, Preset};
use nertca_vk::scan::at_rest;
use nertca_vk::scan::gating::RPeaks;
use nertca_vk::scan::prior::{MAX_PRIOR_POINTS, VesselPrior};
use nertca_vk_runs::session::{FrameUse, Progress, Session, SessionOptions};
use nertca_vk_vessels::trees::tree::BeatTree;
use std::ffi::{c_char, c_void};
use std::path::Path;
use std::sync::{Arc, Mutex};

/// A reconstruction: its frames, its training, its fields.
pub struct nertca_reconstruction {
    _opaque: [u8; 0],
}

/// Object behind [`nertca_reconstruction`].
pub(super) struct Reconstruction {
    // Fields are dropped in this order, because the session's memory belongs to the context's device.
    pub session: Session,
    pub latest: Arc<Mutex<Option<Progress>>>,
    /// Vessels found by the last extraction.
    pub tree: Mutex<Option<BeatTree>>,
    pub claim: Claim,
    process: u32,
}

impl Kind for Reconstruction {
    const NAME: &'static str = "reconstruction";

    fn process(&self) -> u32 {
        self.process
    }
}

/// Runs a body on the reconstruction of a handle, with the context's log.
pub(super) fn on_reconstruction(
    handle: *mut nertca_reconstruction,
    body: impl FnOnce(&Arc<Reconstruction>) -> Outcome<()>,
) -> nertca_status {
    call(handle, || {
        let reconstruction = handles::get::<Reconstruction, _>(handle)?;
        let log = reconstruction.claim.context.log.clone();
        tracing::dispatcher::with_default(&log, || body(&reconstruction))
    })
}

fn session(context: &Context, mut options: Options) -> Outcome<Session> {
    let number = "a number";
    let phases = options.take_as("phases", number)?;
    let depth = options.take_as("depth_half_extent_mm", number)?;
    let vessel = options.take_as("vessel_attenuation_per_mm", number)?;
    let still = options.take_as("still", "true or false")?.unwrap_or(false);
    let preset = match options.take("preset") {
        None => None,
        Some(name) => Some(
            Preset::named(&name)
                .ok_or_else(|| Failure::argument("preset", format!("`{name}` is not one of {}", Preset::names())))?,
        ),
    };
    let config = Config::load(preset, None, &options.settings())?;
    let options = SessionOptions {
        config,
        phases: phases
            .or(still.then_some(at_rest::PHASES))
            .ok_or_else(|| Failure::argument("phases", "is missing: give the number of cardiac phases"))?,
        depth_half_extent_mm: depth.unwrap_or(100.0),
        vessel_attenuation_per_mm: vessel,
        still,
        deterministic: context.deterministic,
    };
    Ok(Session::new(context.gpu.clone(), context.tuning.clone(), options)?)
}

/// Creates a reconstruction without frames.
///
/// `options` are lines of `key = value` or a JSON object: `phases` (number of cardiac phases; required, unless `still` is true), `still`
/// (`true` for an object at rest, as in `dataset.json`: frames of phase 0 show it, and frames of phase 1 the same without vessels, which
/// are estimated for views that have none; frames with a time need no R-peaks; the result has one phase, 0), `depth_half_extent_mm`
/// (attenuation is searched within this distance of the isocentre plane; 100), `vessel_attenuation_per_mm` (attenuation of
/// filled vessels, where known: sets the Dice threshold), `preset` (fast, fast-mlp, paper, public-code, nert-ca, nerf-ca, r2-gaussian,
/// x-gaussian or sax-nerf) and every key that `nertca-vk train --print-config` shows, as in `train.iterations = 800`.
///
/// `*reconstruction` is null on failure. Callable from any thread.
///
/// # Safety
/// `options` must be null or end with a zero; `reconstruction` must be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_create(
    context: *mut nertca_context,
    options: *const c_char,
    reconstruction: *mut *mut nertca_reconstruction,
) -> nertca_status {
    on_context(context, |context| {
        if reconstruction.is_null() {
            return Err(Failure::argument("reconstruction", "is null"));
        }
        // SAFETY: `reconstruction` is not null, and the header requires that it can be written.
        unsafe { reconstruction.write_unaligned(std::ptr::null_mut()) };
        // SAFETY: the header requires that `options` is null or ends with a zero.
        let options = Options::parse(unsafe { text("options", options) }?.unwrap_or_default())?;
        let made = Arc::new(Reconstruction {
            session: session(context, options)?,
            latest: Arc::default(),
            tree: Mutex::default(),
            claim: Claim::new(context),
            process: std::process::id(),
        });
        let handle = handles::insert(made)?;
        // SAFETY: `reconstruction` was checked and written above, and the caller's memory is still valid.
        unsafe { reconstruction.write_unaligned(std::ptr::without_provenance_mut(handle)) };
        Ok(())
    })
}

/// Destroys a reconstruction: stops its training, ends long calls on it in other threads, waits for all calls there, and frees its
/// memory. `_train`, `_evaluate`, `_tree`, `_sample` and exact pictures under way return NERTCA_ERROR_CANCELLED, after the iterations
/// or before the slice that they are at. Null is allowed, and does nothing. Callable from any thread except inside its own callbacks.
///
/// @return NERTCA_ERROR_BUSY, with nothing done, from inside a callback of a call on it.
///
/// # Safety
/// Any value is allowed: a stale handle is an error.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_destroy(reconstruction: *mut nertca_reconstruction) -> nertca_status {
    if reconstruction.is_null() {
        return NERTCA_OK;
    }
    call(reconstruction, || {
        if handles::is_active(reconstruction) {
            return Err(Failure::new(NERTCA_ERROR_BUSY, "reconstruction: it is in use by a call in this thread"));
        }
        let log = {
            let found = handles::get::<Reconstruction, _>(reconstruction)?;
            found.session.close()?;
            found.claim.context.log.clone()
        };
        tracing::dispatcher::with_default(&log, || handles::remove::<Reconstruction, _>(reconstruction).map(drop))
    })
}

/// Adds a frame; its pixels are copied. Frames may be added at any time. Training in the background takes a new frame in by
/// itself after a short while (frames that arrive in quick succession are taken in together); other training takes it in when
/// it next begins. Callable from any thread.
///
/// @return NERTCA_ERROR_ARGUMENT naming the field that is wrong; NERTCA_ERROR_BUSY while training in the background in a
/// deterministic context.
///
/// # Safety
/// `frame` must be as long as its `size` says, and its pointers readable for the stated lengths.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_add_frame(
    reconstruction: *mut nertca_reconstruction,
    frame: *const nertca_frame,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        // SAFETY: the header requires that `frame` is null or as long as its size says, and that its pointers are readable for
        // the lengths in its fields.
        let frame = unsafe { read(frame)?.new_frame() }?;
        Ok(reconstruction.session.add_frame(frame)?)
    })
}

/// Removes a frame, whose memory is freed; the others keep their numbers. Training in the background takes that in like a new frame;
/// training that has ended does so when it is next started. Callable from any thread.
///
/// @return NERTCA_ERROR_ARGUMENT for a frame that was not added or was removed before; NERTCA_ERROR_BUSY while training in the
/// background in a deterministic context.
#[unsafe(no_mangle)]
pub extern "C" fn nertca_reconstruction_remove_frame(
    reconstruction: *mut nertca_reconstruction,
    frame: u32,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| Ok(reconstruction.session.remove_frame(frame as usize)?))
}

/// Returns phase, view and use of a frame. Frames count from 0 in the order in which they were added. Callable from any thread.
///
/// @return NERTCA_ERROR_ARGUMENT for a frame that was not added or was removed.
///
/// # Safety
/// `status` must be writable, with its size set.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_frame_status(
    reconstruction: *mut nertca_reconstruction,
    frame: u32,
    status: *mut nertca_frame_status,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        let found = reconstruction.session.frame_status(frame as usize)?;
        // SAFETY: the header requires that `status` is null or as long as its size says.
        unsafe {
            write(status, |size| nertca_frame_status {
                size,
                usage: use_code(found.usage),
                taken_in: u32::from(found.taken_in),
                view: found.view as u32,
                phase: found.beat_time.map_or(-1, |taken| taken.phase as i32),
                after_phase: found.beat_time.map_or(0.0, |taken| taken.after_phase),
            })
        }
    })
}

fn use_code(usage: FrameUse) -> u32 {
    match usage {
        FrameUse::Training => NERTCA_USE_TRAINING,
        FrameUse::Validation => NERTCA_USE_VALIDATION,
        FrameUse::NoPhase => NERTCA_USE_NO_PHASE,
        FrameUse::OnePhase => NERTCA_USE_ONE_PHASE,
    }
}

/// Returns the phase of a time on the clock of the R-peaks, seconds, as for a frame with this time stamp: from 0 to below the number
/// of phases, usually between two. Split into its whole part and the rest, it is `phase` and `after_phase` of a view. Callable from
/// any thread.
///
/// @return NERTCA_ERROR_NOT_READY for a time that R-peaks do not cover.
///
/// # Safety
/// `phase` must be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_beat_phase(
    reconstruction: *mut nertca_reconstruction,
    time_s: f64,
    phase: *mut f64,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        if phase.is_null() {
            return Err(Failure::argument("phase", "is null"));
        }
        if !time_s.is_finite() {
            return Err(Failure::argument("time_s", format!("{time_s} is not finite")));
        }
        let uncovered = || Failure::new(NERTCA_ERROR_NOT_READY, format!("R-peaks do not cover the time {time_s} s"));
        let found = reconstruction.session.beat_time(time_s).ok_or_else(uncovered)?;
        // SAFETY: `phase` is not null, and the header requires that it can be written.
        unsafe { phase.write_unaligned(found.phases(reconstruction.session.phases())) };
        Ok(())
    })
}

/// Sets the times of the R-peaks, seconds, in ascending order. Frames with time stamps get their phase from them: systole keeps
/// its length (310 ms, 35 % of the phases) and diastole takes the rest of the beat. The phases 0 to T - 1 are the middles of T equal
/// parts of the beat, so a frame at an R-peak lies half a phase before phase 0, at T - 0.5. A method with one set of moving Gaussians
/// fits each frame at its own time within the phase. A call replaces the times given earlier, so that a growing list can be
/// given repeatedly. A null `times_s` with a `count` of 0 clears them. Callable from any thread.
///
/// @return NERTCA_ERROR_ARGUMENT for fewer than two times, and for times that do not increase; NERTCA_ERROR_BUSY while training in the
/// background in a deterministic context.
///
/// # Safety
/// `times_s` must be readable for `count` numbers.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_set_r_peaks(
    reconstruction: *mut nertca_reconstruction,
    times_s: *const f64,
    count: usize,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        if times_s.is_null() && count == 0 {
            return Ok(reconstruction.session.set_r_peaks(None)?);
        }
        if times_s.is_null() {
            return Err(Failure::argument("times_s", "is null"));
        }
        if count > 1 << 20 {
            return Err(Failure::argument("count", format!("{count} exceeds the maximum, 2^20")));
        }
        // SAFETY: the pointer is not null, and the header requires `count` numbers, which need no alignment.
        let times = (0..count).map(|i| unsafe { times_s.add(i).read_unaligned() }).collect::<Vec<_>>();
        Ok(reconstruction.session.set_r_peaks(Some(RPeaks::new(&times)?))?)
    })
}

/// States vessels that are known before, for example from a CT: points along their centrelines, about a millimetre apart, as patient mm
/// (left, posterior, superior) with the isocentre at the origin. They decide where vessels are sought first; the angiograms decide whether
/// they are there. A call replaces the points given earlier and acts on fits that begin later. A null `points_mm` with a `count` of 0
/// clears them. Callable from any thread.
///
/// @return NERTCA_ERROR_ARGUMENT for coordinates that are not finite, and with a preset other than `fast`; NERTCA_ERROR_BUSY while
/// training in the background in a deterministic context.
///
/// # Safety
/// `points_mm` must be readable for 3 x `count` numbers, the three coordinates of a point together.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_set_prior(
    reconstruction: *mut nertca_reconstruction,
    points_mm: *const f64,
    count: usize,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        if points_mm.is_null() && count == 0 {
            return Ok(reconstruction.session.set_prior(None)?);
        }
        if points_mm.is_null() {
            return Err(Failure::argument("points_mm", "is null"));
        }
        if count > MAX_PRIOR_POINTS {
            return Err(Failure::argument("count", format!("{count} exceeds the maximum, {MAX_PRIOR_POINTS}")));
        }
        // SAFETY: the pointer is not null, and the header requires `3 * count` numbers, which need no alignment.
        let coordinate = |i: usize| unsafe { points_mm.add(i).read_unaligned() };
        let points = (0..count).map(|i| [0, 1, 2].map(|axis| coordinate(3 * i + axis))).collect();
        Ok(reconstruction.session.set_prior(Some(VesselPrior { shapes_mm: vec![points] }))?)
    })
}

/// Returns state and progress of training. Callable from any thread, at any time.
///
/// @return NERTCA_OK also when training has failed: `state` is then `NERTCA_STATE_FAILED`, and `nertca_reconstruction_failure`
/// returns the reason.
///
/// # Safety
/// `progress` must be writable, with its size set.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_progress(
    reconstruction: *mut nertca_reconstruction,
    progress: *mut nertca_progress,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        let latest = *reconstruction.latest.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let state = state_code(reconstruction.session.state());
        let step = reconstruction.session.step();
        // SAFETY: the header requires that `progress` is null or as long as its size says.
        unsafe {
            write(progress, |size| nertca_progress {
                size,
                state,
                step,
                iterations: latest.map_or(0, |l| l.iterations),
                frames: latest.map_or(0, |l| l.frames),
                loss: latest.map_or(f64::NAN, |l| l.loss.total()),
                psnr_db: latest.map_or(f64::NAN, |l| l.psnr_db),
                iterations_per_s: latest.map_or(0.0, |l| l.iterations_per_s),
            })
        }
    })
}

/// Returns the reason why training in the background failed, or, in the state NERTCA_STATE_WAITING, why it cannot go on with the frames
/// there are; empty otherwise. `text`, `size` and `length` work as in `nertca_last_error`. Callable from any thread.
///
/// # Safety
/// `text` must hold `size` bytes; `length` must be writable or null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_failure(
    reconstruction: *mut nertca_reconstruction,
    text: *mut c_char,
    size: usize,
    length: *mut usize,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        let session = &reconstruction.session;
        let failure = session.failure().or_else(|| session.waits_for()).unwrap_or_default();
        // SAFETY: the header requires that `text` holds `size` bytes and that `length` is null or can be written.
        unsafe { copy_text(&failure, text, size, length) }
    })
}

/// Writes a checkpoint, with everything needed to continue, into a file, which appears whole or not at all. Callable from any
/// thread, also during training.
///
/// @return NERTCA_ERROR_NOT_READY before anything was trained or loaded.
///
/// # Safety
/// `path` must end with a zero.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_save(
    reconstruction: *mut nertca_reconstruction,
    path: *const c_char,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        // SAFETY: the header requires that `path` is null or ends with a zero.
        let path = unsafe { text("path", path) }?.filter(|p| !p.is_empty());
        let path = path.ok_or_else(|| Failure::argument("path", "is null or empty"))?;
        Ok(reconstruction.session.checkpoint()?.write(Path::new(path))?)
    })
}

/// Saves a checkpoint like `nertca_reconstruction_save`, into memory. `*length` receives the number of bytes needed; with a
/// null `bytes` and a `size` of 0, only the length is returned.
///
/// @return NERTCA_ERROR_BUFFER when `size` is too small. During training in the background the size of the state changes, by
/// kilobytes when Gaussians are added: try again with the new `*length`.
///
/// # Safety
/// `bytes` must hold `size` bytes; `length` must be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_save_memory(
    reconstruction: *mut nertca_reconstruction,
    bytes: *mut c_void,
    size: usize,
    length: *mut usize,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        if length.is_null() {
            return Err(Failure::argument("length", "is null"));
        }
        if bytes.is_null() && size > 0 {
            return Err(Failure::argument("bytes", "is null"));
        }
        let content = reconstruction.session.checkpoint()?.to_bytes()?;
        // SAFETY: `length` is not null, and the header requires that it can be written.
        unsafe { length.write_unaligned(content.len()) };
        if bytes.is_null() {
            return Ok(());
        }
        if content.len() > size {
            return Err(Failure::new(NERTCA_ERROR_BUFFER, format!("{} bytes are needed", content.len())));
        }
        // SAFETY: `bytes` is not null, with room for `size` bytes, which was checked to be enough; the content is ours, so the
        // two do not overlap.
        unsafe { std::ptr::copy_nonoverlapping(content.as_ptr(), bytes.cast(), content.len()) };
        Ok(())
    })
}

/// Loads a checkpoint file of this library or of `nertca-vk train`, with its hyper-parameters and phases. It can be rendered at
/// once, and trained further with the frames of this reconstruction. Callable from any thread.
///
/// @return NERTCA_ERROR_BUSY while training in the background; NERTCA_ERROR_DATA for a malformed file.
///
/// # Safety
/// `path` must end with a zero.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_load(
    reconstruction: *mut nertca_reconstruction,
    path: *const c_char,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        // SAFETY: the header requires that `path` is null or ends with a zero.
        let path = unsafe { text("path", path) }?.filter(|p| !p.is_empty());
        let path = path.ok_or_else(|| Failure::argument("path", "is null or empty"))?;
        Ok(reconstruction.session.load(Checkpoint::read(Path::new(path))?)?)
    })
}

/// Loads a checkpoint like `nertca_reconstruction_load`, from memory.
///
/// # Safety
/// `bytes` must be readable for `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_load_memory(
    reconstruction: *mut nertca_reconstruction,
    bytes: *const c_void,
    size: usize,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        if bytes.is_null() {
            return Err(Failure::argument("bytes", "is null"));
        }
        if size > 4 << 30 {
            return Err(Failure::argument("size", format!("{size} exceeds the maximum, 4 GiB")));
        }
        // SAFETY: the pointer is not null, and the header requires `size` bytes, which nobody changes during the call.
        let content = unsafe { std::slice::from_raw_parts(bytes.cast::<u8>(), size) };
        Ok(reconstruction.session.load(Checkpoint::from_bytes(content, Path::new("memory"))?)?)
    })
}
