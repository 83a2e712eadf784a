//! Reads voxel volumes of any supported format: `.npy`, `.nii(.gz)`, `.nrrd`, `.mha` and raw binaries.

use crate::error::{Error, Result};
use crate::volume::{MAX_BYTES, Volume, VolumeHints};
use crate::{metaimage, nifti, npy, nrrd, raw};
use glam::DVec3;
use std::path::Path;

/// Reads a volume; the file name's extension selects the format.
///
/// # Errors
/// [`Error::Data`] or [`Error::Io`] naming file and field.
pub fn read(path: &Path, hints: &VolumeHints) -> Result<Volume> {
    let name = path.file_name().map(|n| n.to_string_lossy().to_lowercase()).unwrap_or_default();
    let mut volume = if name.ends_with(".npy") {
        read_npy(path, hints)?
    } else if name.ends_with(".nii") || name.ends_with(".nii.gz") {
        nifti::read(path)?
    } else if name.ends_with(".nrrd") {
        nrrd::read(path)?
    } else if name.ends_with(".mha") {
        metaimage::read(path)?
    } else if hints.size.is_some() {
        raw::read(path, hints)?
    } else {
        return Err(Error::data(
            path,
            "extension",
            "is not one of .npy .nii .nii.gz .nrrd .mha; for a raw binary, the size must be given",
        ));
    };
    let m = volume.index_to_lps.matrix3;
    if !m.determinant().is_finite() || m.determinant().abs() < 1e-12 || !volume.index_to_lps.translation.is_finite() {
        return Err(Error::data(path, "orientation", "spacing and directions cannot be inverted"));
    }
    if let Some(at) = volume.values.iter().position(|v| !v.is_finite()) {
        return Err(Error::data(path, format!("voxel {at}"), "is not a finite number"));
    }
    if hints.centre {
        let half = DVec3::new(volume.size[0] as f64, volume.size[1] as f64, volume.size[2] as f64) * 0.5 - 0.5;
        volume.index_to_lps.translation = -(m * half);
    }
    Ok(volume)
}

fn read_npy(path: &Path, hints: &VolumeHints) -> Result<Volume> {
    let npy::Array { shape, values } = npy::read(path, MAX_BYTES)?;
    let reversed: Vec<u64> = shape.iter().rev().map(|n| *n as u64).collect();
    let size = Volume::check_size(path, "shape", &reversed)?;
    Ok(Volume { size, values, index_to_lps: Volume::axis_aligned(size, hints.spacing(path)?) })
}
