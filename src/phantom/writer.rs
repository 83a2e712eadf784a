//! Writes phantom datasets in either layout.

use super::dataset::Stage;
use crate::data::dataset::{Intensity, Layout, MANIFEST, Manifest, ManifestFrame, Split};
use crate::data::geometry::Geometry;
use crate::data::images;
use crate::data::nerfca;
use crate::error::{Error, Result};
use crate::files;
use std::path::{Path, PathBuf};

/// ln(8.670397): the value of an unattenuated pixel in the authors' images.
pub const I0_LOG: f64 = 2.159_914_6;
/// Writes frames as they come and the manifest last, so that an interrupted run leaves no dataset.
pub(super) struct Writer<'a> {
    out: &'a Path,
    size: usize,
    layout: Layout,
    manifest: Manifest,
    general: nerfca::General,
    lists: [Vec<nerfca::FrameEntry>; 2],
}

impl<'a> Writer<'a> {
    pub(super) fn new(out: &'a Path, size: usize, layout: Layout, stage: &Stage) -> Result<Writer<'a>> {
        files::create_directory(out)?;
        let carm = &stage.c_arm;
        let half_units = stage.depth_half_extent_mm / 100.0;
        let n = size as f64;
        Ok(Writer {
            out,
            size,
            layout,
            manifest: Manifest {
                format: "nertca-dataset".into(),
                version: 1,
                description: stage.description.clone(),
                phases: stage.moving.len() as u32,
                depth_half_extent_mm: stage.depth_half_extent_mm,
                vessel_attenuation_per_mm: stage.vessel_attenuation,
                frames: Vec::new(),
            },
            general: nerfca::General {
                DSD: carm.sid_mm,
                DSO: carm.sod_mm,
                nDetector: vec![n, n],
                dDetector: carm.pixel_mm.to_vec(),
                nVoxel: vec![512.0; 3],
                dVoxel: vec![2.0 * stage.depth_half_extent_mm / 512.0; 3],
                offOrigin: vec![0.0; 3],
                offDetector: vec![0.0; 2],
                near_thresh: carm.sod_mm / 100.0 - half_units,
                far_thresh: carm.sod_mm / 100.0 + half_units,
                max_pixel_value: I0_LOG,
            },
            lists: [Vec::new(), Vec::new()],
        })
    }

    pub(super) fn frame(
        &mut self,
        geometry: &Geometry,
        split: Split,
        view: usize,
        phase: u32,
        integrals: &[f32],
        mask: Option<&[bool]>,
    ) -> Result<()> {
        let kind = if split == Split::Train { "train" } else { "test" };
        let name = format!("{kind}-view{view}-phase{phase:02}");
        match self.layout {
            Layout::Native => {
                let image = PathBuf::from(format!("images/{name}.npy"));
                let mask_file = PathBuf::from(format!("masks/{name}.png"));
                images::write_npy(&self.out.join(&image), &[self.size, self.size], integrals)?;
                if let Some(mask) = mask {
                    let codes = mask.iter().map(|m| if *m { u16::MAX } else { 0 }).collect();
                    images::write_png16(&self.out.join(&mask_file), self.size, self.size, codes)?;
                }
                self.manifest.frames.push(ManifestFrame {
                    image,
                    phase,
                    split,
                    geometry: geometry.clone(),
                    intensity: Intensity::Integral { scale: 1.0, offset: 0.0 },
                    mask: mask.map(|_| mask_file),
                });
            }
            Layout::Nerfca => {
                let values: Vec<f32> = integrals.iter().map(|y| (I0_LOG - f64::from(*y)) as f32).collect();
                let (low, high) = values.iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
                let range = f64::from(high) - f64::from(low);
                let unit: Vec<f32> =
                    values.iter().map(|v| ((f64::from(*v) - f64::from(low)) / range.max(1e-12)) as f32).collect();
                let (image, mask_file) = (format!("{name}.npy"), format!("{name}-mask.npy"));
                let shape = [self.size, self.size];
                images::write_npy(&self.out.join(&image), &shape, &nerfca::transpose(&unit, self.size, self.size))?;
                if let Some(mask) = mask {
                    let masked: Vec<f32> =
                        values.iter().zip(mask).map(|(v, m)| if *m { *v } else { I0_LOG as f32 }).collect();
                    let stored = nerfca::transpose(&masked, self.size, self.size);
                    images::write_npy(&self.out.join(&mask_file), &shape, &stored)?;
                }
                let (theta, phi) = geometry.angles_deg().unwrap_or_default();
                self.lists[usize::from(split == Split::Validation)].push(nerfca::FrameEntry {
                    file_path: image,
                    img_min_max: [f64::from(low), f64::from(high).max(f64::from(low) + 1e-12)],
                    mask_file_path: mask.map(|_| mask_file),
                    weighted_file_path: None,
                    heart_phase: f64::from(phase),
                    theta,
                    phi,
                    larm: 0.0,
                });
            }
        }
        Ok(())
    }

    pub(super) fn finish(self) -> Result<()> {
        let write = |name: &str, text: serde_json::Result<String>| {
            let text = text.map_err(|e| Error::Internal(e.to_string()))?;
            files::write_atomic(&self.out.join(name), text.as_bytes())
        };
        match self.layout {
            Layout::Native => write(MANIFEST, serde_json::to_string_pretty(&self.manifest)),
            Layout::Nerfca => {
                let [train, test] = self.lists;
                write("train-0.json", serde_json::to_string_pretty(&nerfca::FrameList { frames: train }))?;
                write("test-0.json", serde_json::to_string_pretty(&nerfca::FrameList { frames: test }))?;
                write(nerfca::GENERAL, serde_json::to_string_pretty(&self.general))
            }
        }
    }
}
