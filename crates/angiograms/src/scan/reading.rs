//! Reads datasets: detects their layout, and reads the native one.

use crate::error::{Error, Result};
use crate::files;
use crate::formats::images;
use crate::geometry::MM_PER_UNIT;
use crate::scan::builder::{Builder, NewFrame};
use crate::scan::dataset::{Dataset, Layout, MANIFEST, Manifest};
use crate::scan::nerfca;
use std::path::{Path, PathBuf};

const MAX_MANIFEST_BYTES: u64 = 256 << 20;

/// Path of a file that a manifest names. A name with backslashes, as other systems write it, also means the file in that folder,
/// unless there is a file of exactly this name.
fn found(dataset: &Path, name: &Path) -> PathBuf {
    let path = dataset.join(name);
    match name.to_str() {
        Some(text) if text.contains('\\') && !path.exists() => dataset.join(text.replace('\\', "/")),
        _ => path,
    }
}

impl Dataset {
    /// Reads a dataset and detects its layout.
    ///
    /// # Errors
    /// [`Error::Data`] or [`Error::Io`] naming file and field.
    pub fn open(path: &Path) -> Result<Dataset> {
        if path.join(MANIFEST).is_file() {
            return Self::open_native(path);
        }
        if path.join(nerfca::GENERAL).is_file() {
            return nerfca::open(path);
        }
        if !path.is_dir() {
            return Err(Error::data(path, "dataset", "is not a directory"));
        }
        Err(Error::data(
            path,
            "dataset",
            format!("contains neither {MANIFEST} (native layout) nor {} (NeRF-CA layout)", nerfca::GENERAL),
        ))
    }

    fn open_native(path: &Path) -> Result<Dataset> {
        let file = path.join(MANIFEST);
        let manifest: Manifest = files::read_json(&file, MAX_MANIFEST_BYTES)?;
        if manifest.format != "nertca-dataset" || manifest.version != 1 {
            return Err(Error::data(
                &file,
                "format",
                format!(
                    "is `{}` version {}, but `nertca-dataset` version 1 is expected",
                    manifest.format, manifest.version
                ),
            ));
        }
        let half = manifest.depth_half_extent_mm / MM_PER_UNIT;
        if !(half.is_finite() && half > 0.0 && half < 1e3) {
            return Err(Error::data(&file, "depth_half_extent_mm", "is not a positive length in mm"));
        }
        let vessel = manifest.vessel_attenuation_per_mm.map(|a| a * MM_PER_UNIT);
        let mut builder = Builder::new(&file, manifest.phases, (-half, half), vessel)?;
        if manifest.still {
            builder.at_rest()?;
        }
        builder.vessels_alone = manifest.vessels_alone;
        for (index, frame) in manifest.frames.iter().enumerate() {
            frame
                .intensity
                .check()
                .map_err(|(field, problem)| Error::data(&file, format!("frames[{index}].{field}"), problem))?;
            let image_path = found(path, &frame.image);
            let image = images::read_image(&image_path)?;
            let mask = match &frame.mask {
                None => None,
                Some(name) => {
                    let mask = images::read_image(&found(path, name))?;
                    if (mask.width, mask.height) != (image.width, image.height) {
                        return Err(Error::data(path.join(name), "shape", "differs from the shape of its image"));
                    }
                    Some(mask.values.iter().map(|v| *v != 0.0).collect())
                }
            };
            builder.add(NewFrame {
                index,
                source: &image_path,
                geometry: frame.geometry.clone(),
                time_phases: frame.phase,
                split: frame.split,
                image,
                to_integral: |v| frame.intensity.integral(v),
                mask,
                heart_shift_mm: frame.heart_shift_mm,
            })?;
        }
        builder.finish(path, Layout::Native)
    }
}
