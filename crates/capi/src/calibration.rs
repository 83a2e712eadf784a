//! Corrections by calibration, and better geometry for frames that were added earlier.

use crate::reconstruction::{nertca_reconstruction, on_reconstruction};
use crate::status::{Outcome, nertca_status};
use crate::types::{nertca_correction, nertca_geometry, read, write};
use nertca_vk::calibrate::choose::Correction;
use nertca_vk::error::Result;
use nertca_vk::geometry::Geometry;
use nertca_vk_runs::session::{FrameUse, Session};

/// The stated geometry of the frame is used.
pub const NERTCA_CORRECTION_STATED: u32 = 0;
/// Angles and position of the frame's view are corrected.
pub const NERTCA_CORRECTION_STATIC: u32 = 1;
/// The view is corrected, and so is a displacement of the heart in this frame.
pub const NERTCA_CORRECTION_BREATHING: u32 = 2;

fn code(correction: Correction) -> u32 {
    match correction {
        Correction::Stated => NERTCA_CORRECTION_STATED,
        Correction::Static => NERTCA_CORRECTION_STATIC,
        Correction::Breathing => NERTCA_CORRECTION_BREATHING,
    }
}

/// Returns how the reconstruction has corrected a frame's geometry since training last took in frames: not at all, or by
/// calibration (`calibrate.mode`). Frames count from 0 in the order in which they were added. To draw the vessels over a frame,
/// render with its `matrix`. Callable from any thread, at any time.
///
/// A motion common to all views cannot be observed and is no part of the correction. After loading a checkpoint, the
/// corrections made before it was saved are not known.
///
/// @return NERTCA_ERROR_ARGUMENT for a frame that was not added.
///
/// # Safety
/// `correction` must be writable, with its size set.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_correction(
    reconstruction: *mut nertca_reconstruction,
    frame: u32,
    correction: *mut nertca_correction,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        let found = reconstruction.session.corrected_frame(frame as usize)?;
        let view = found.view.as_ref();
        // SAFETY: the header requires that `correction` is null or as long as its size says.
        unsafe {
            write(correction, |size| nertca_correction {
                size,
                kind: code(found.correction),
                primary_deg: view.map_or(0.0, |v| v.primary_deg),
                secondary_deg: view.map_or(0.0, |v| v.secondary_deg),
                table_mm: view.map_or([0.0; 3], |v| v.table_mm),
                heart_shift_mm: found.heart_shift_mm,
                moved_px: view.map_or(0.0, |v| v.moved_px),
                residual_before: view.map_or(0.0, |v| v.residual_before),
                residual_after: view.map_or(0.0, |v| v.residual_after),
                matrix: found.projection,
            })
        }
    })
}

/// Sets another geometry for a frame that was added, for example when the C-arm or an external calibration provides a better one.
/// Training in the background takes it in like a new frame; training that has ended does so when it is next started. Calibration
/// starts from the stated geometry; with `calibrate.mode = off` the reconstruction uses the stated geometry. Callable from any
/// thread.
///
/// A frame whose new geometry no other frame shares within a tenth of a pixel is a view of its own. Presets that look for what moves
/// (`fast`, `fast-mlp`) leave it out while it is the only phase of its view: the log says so, and `nertca_reconstruction_frame_status`
/// tells. `nertca_reconstruction_set_view_geometry` sets the geometry of a whole view.
///
/// @return NERTCA_ERROR_ARGUMENT naming the field that is wrong, or for a frame that was not added; NERTCA_ERROR_BUSY while
/// training in the background in a deterministic context.
///
/// # Safety
/// `geometry` must be as long as its `size` says, and its matrix null or readable for 12 numbers.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_set_geometry(
    reconstruction: *mut nertca_reconstruction,
    frame: u32,
    geometry: *const nertca_geometry,
) -> nertca_status {
    // SAFETY: the header requires the same of `geometry` as `with_geometry` does.
    unsafe {
        with_geometry(reconstruction, geometry, |session, geometry| session.set_geometry(frame as usize, geometry))
    }
}

/// Sets another geometry for a frame and for all other frames of its view, as `nertca_reconstruction_set_geometry` does for one.
/// Callable from any thread.
///
/// @return as `nertca_reconstruction_set_geometry`.
///
/// # Safety
/// `geometry` must be as long as its `size` says, and its matrix null or readable for 12 numbers.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_set_view_geometry(
    reconstruction: *mut nertca_reconstruction,
    frame: u32,
    geometry: *const nertca_geometry,
) -> nertca_status {
    // SAFETY: the header requires the same of `geometry` as `with_geometry` does.
    unsafe {
        with_geometry(reconstruction, geometry, |session, geometry| session.set_view_geometry(frame as usize, geometry))
    }
}

/// Hands a caller's geometry to the session of a reconstruction.
///
/// # Safety
/// `geometry` must be null or as long as its size says, and its matrix null or readable for 12 numbers.
unsafe fn with_geometry(
    reconstruction: *mut nertca_reconstruction,
    geometry: *const nertca_geometry,
    set: impl FnOnce(&Session, Geometry) -> Result<FrameUse>,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| -> Outcome<()> {
        // SAFETY: callers of this function guarantee what it requires.
        let geometry = unsafe { read(geometry)?.geometry() }?;
        set(&reconstruction.session, geometry)?;
        Ok(())
    })
}
