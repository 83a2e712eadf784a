//! How calibration sees frames, and geometry that is known better later.

use crate::calibrate::choose::Correction;
use crate::capi::reconstruction::{nertca_reconstruction, on_reconstruction};
use crate::capi::status::nertca_status;
use crate::capi::types::{nertca_correction, nertca_geometry, read, write};

/// A frame's geometry is taken as stated.
pub const NERTCA_CORRECTION_STATED: u32 = 0;
/// Angles and position of the frame's view are corrected.
pub const NERTCA_CORRECTION_STATIC: u32 = 1;
/// A correction of the view, and a displacement of the heart in this frame.
pub const NERTCA_CORRECTION_BREATHING: u32 = 2;

fn code(correction: Correction) -> u32 {
    match correction {
        Correction::Stated => NERTCA_CORRECTION_STATED,
        Correction::Static => NERTCA_CORRECTION_STATIC,
        Correction::Breathing => NERTCA_CORRECTION_BREATHING,
    }
}

/// How the reconstruction sees a frame since training last took frames in: as stated, or as calibration (`calibrate.mode`)
/// corrected it. Frames count from 0 in the order in which they were added. To draw the vessels over a frame, render with
/// its `matrix`. Any thread, at any time.
///
/// A motion that all views share is not seen by any of them and is no part of the correction; and what a checkpoint was
/// corrected by is not known after loading it.
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
        // SAFETY: the header asks that `correction` is null or as long as its size says.
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

/// States another geometry for a frame that was added: what the C-arm, or a calibration elsewhere, knows better by now.
/// Training takes it in as it does a new frame. Calibration begins from what is stated; with `calibrate.mode = off` that
/// is what the reconstruction goes by. Any thread.
///
/// @return NERTCA_ERROR_ARGUMENT naming the field that is wrong, or for a frame that was not added; NERTCA_ERROR_BUSY
/// while training in the background in a deterministic context.
///
/// # Safety
/// `geometry` must be as long as it says, and its matrix null or readable for 12 numbers.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_set_geometry(
    reconstruction: *mut nertca_reconstruction,
    frame: u32,
    geometry: *const nertca_geometry,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        // SAFETY: the header asks that `geometry` is null or as long as its size says, and its matrix good.
        let geometry = unsafe { read(geometry)?.geometry() }?;
        Ok(reconstruction.session.set_geometry(frame as usize, geometry)?)
    })
}
