//! Writes datasets in the native layout or in the authors' layout.

use crate::error::{Error, Result};
use crate::files;
use crate::formats::{npy, png};
use crate::geometry::{CArm, Geometry, MM_PER_UNIT};
use crate::raster::Image;
use crate::scan::dataset::{Dataset, Intensity, Layout, MANIFEST, Manifest, ManifestFrame, Split};
use crate::scan::gating::BeatTime;
use crate::scan::nerfca;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// ln(8.670397): the value of an unattenuated pixel in the authors' images.
pub const I0_LOG: f64 = 2.159_914_6;
/// Message for a dataset with images of different sizes, which the authors' layout cannot hold.
const ONE_SIZE: &str = "supports one size for all images only, and this dataset has several";

/// Properties of a dataset other than its frames.
#[derive(Debug, Clone)]
pub struct About {
    /// Free text.
    pub description: String,
    /// Cardiac phases.
    pub phases: u32,
    /// Depth searched before and behind the isocentre plane, mm.
    pub depth_half_extent_mm: f64,
    /// Attenuation of filled vessels, 1/mm, where known.
    pub vessel_attenuation_per_mm: Option<f64>,
    /// Whether the object is at rest (see [`Manifest::still`]); the authors' layout cannot state it.
    pub still: bool,
    /// Whether the images show vessels and nothing else (see [`Manifest::vessels_alone`]); the authors' layout cannot state it.
    pub vessels_alone: bool,
    /// Columns and rows of all images in the authors' layout, which states one size for all.
    pub size: [usize; 2],
    /// C-arm that gives the distances and pixels of the authors' layout, which states them once for all views.
    pub c_arm: CArm,
}

/// Writes frames as they come and the manifest last, so that an interrupted run leaves no valid dataset.
pub struct Writer<'a> {
    out: &'a Path,
    size: [usize; 2],
    /// Number of frames written under each name, to number several frames of one view and phase.
    names: HashMap<String, u32>,
    c_arm: CArm,
    layout: Layout,
    manifest: Manifest,
    general: nerfca::General,
    lists: [Vec<nerfca::FrameEntry>; 2],
}

impl<'a> Writer<'a> {
    /// Creates the directory of the dataset.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn new(out: &'a Path, layout: Layout, about: About) -> Result<Writer<'a>> {
        files::create_directory(out)?;
        let carm = &about.c_arm;
        let half_units = about.depth_half_extent_mm / MM_PER_UNIT;
        Ok(Writer {
            out,
            size: about.size,
            names: HashMap::new(),
            c_arm: about.c_arm.clone(),
            layout,
            manifest: Manifest {
                format: "nertca-dataset".into(),
                version: 1,
                description: about.description,
                phases: about.phases,
                depth_half_extent_mm: about.depth_half_extent_mm,
                vessel_attenuation_per_mm: about.vessel_attenuation_per_mm,
                still: about.still,
                vessels_alone: about.vessels_alone,
                frames: Vec::new(),
            },
            general: nerfca::General {
                DSD: carm.sid_mm,
                DSO: carm.sod_mm,
                nDetector: about.size.map(|n| n as f64).to_vec(),
                dDetector: carm.pixel_mm.to_vec(),
                nVoxel: vec![512.0; 3],
                dVoxel: vec![2.0 * about.depth_half_extent_mm / 512.0; 3],
                offOrigin: vec![0.0; 3],
                offDetector: carm.offset_mm.to_vec(),
                near_thresh: carm.sod_mm / MM_PER_UNIT - half_units,
                far_thresh: carm.sod_mm / MM_PER_UNIT + half_units,
                max_pixel_value: I0_LOG,
            },
            lists: [Vec::new(), Vec::new()],
        })
    }

    /// Writes a frame's image of line integrals and its mask; returns the image file, relative to the dataset. The authors'
    /// layout has only whole phases: a frame between two phases gets the nearest.
    ///
    /// # Errors
    /// [`Error::Config`] for a geometry or a size that the authors' layout cannot state; [`Error::Io`].
    pub fn frame(
        &mut self,
        geometry: &Geometry,
        split: Split,
        view: usize,
        taken: BeatTime,
        image: &Image,
        mask: Option<&[bool]>,
    ) -> Result<PathBuf> {
        let kind = if split == Split::Train { "train" } else { "test" };
        let name = format!("{kind}-view{view}-phase{:02}", taken.phase);
        let seen = self.names.entry(name.clone()).or_default();
        *seen += 1;
        let name = if *seen > 1 { format!("{name}-{seen}") } else { name };
        let Image { width, height, values: integrals } = image;
        let (width, height) = (*width, *height);
        match self.layout {
            Layout::Native => {
                let file = PathBuf::from(format!("images/{name}.npy"));
                let mask_file = PathBuf::from(format!("masks/{name}.png"));
                npy::write(&self.out.join(&file), &[height, width], integrals)?;
                if let Some(mask) = mask {
                    let codes = mask.iter().map(|m| if *m { u16::MAX } else { 0 }).collect();
                    png::write_grey16(&self.out.join(&mask_file), width, height, codes)?;
                }
                self.manifest.frames.push(ManifestFrame {
                    image: file.clone(),
                    phase: taken.phases(self.manifest.phases),
                    split,
                    geometry: geometry.clone(),
                    intensity: Intensity::Integral { scale: 1.0, offset: 0.0 },
                    mask: mask.map(|_| mask_file),
                    heart_shift_mm: [0.0; 3],
                    stated_geometry: None,
                });
                Ok(file)
            }
            Layout::Nerfca => {
                if [width, height] != self.size {
                    return Err(Error::config("layout", "nerfca", ONE_SIZE));
                }
                let values: Vec<f32> = integrals.iter().map(|y| (I0_LOG - f64::from(*y)) as f32).collect();
                let (low, high) = values.iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
                let range = f64::from(high) - f64::from(low);
                let unit: Vec<f32> =
                    values.iter().map(|v| ((f64::from(*v) - f64::from(low)) / range.max(1e-12)) as f32).collect();
                let (file, mask_file) = (format!("{name}.npy"), format!("{name}-mask.npy"));
                npy::write(&self.out.join(&file), &[height, width], &unit)?;
                if let Some(mask) = mask {
                    let masked: Vec<f32> =
                        values.iter().zip(mask).map(|(v, m)| if *m { *v } else { I0_LOG as f32 }).collect();
                    npy::write(&self.out.join(&mask_file), &[height, width], &masked)?;
                }
                let (theta, phi) = authors_angles(&self.c_arm, geometry)?;
                self.lists[usize::from(split == Split::Validation)].push(nerfca::FrameEntry {
                    file_path: file.clone(),
                    img_min_max: [f64::from(low), f64::from(high).max(f64::from(low) + 1e-12)],
                    mask_file_path: mask.map(|_| mask_file),
                    weighted_file_path: None,
                    heart_phase: f64::from(taken.phase),
                    theta,
                    phi,
                    larm: 0.0,
                });
                Ok(PathBuf::from(file))
            }
        }
    }

    /// Adds to the frame written last the displacement of the heart along (posterior, left, superior), mm, and the geometry
    /// that was stated before it was corrected.
    ///
    /// # Errors
    /// [`Error::Config`] where the layout cannot state a displacement.
    pub fn corrected(&mut self, heart_shift_mm: [f64; 3], stated: Option<&Geometry>) -> Result<()> {
        if self.layout == Layout::Nerfca {
            check_shift(heart_shift_mm)?;
        }
        if let Some(frame) = self.manifest.frames.last_mut() {
            (frame.heart_shift_mm, frame.stated_geometry) = (heart_shift_mm, stated.cloned());
        }
        Ok(())
    }

    /// Writes the files that list the frames; from then on the dataset is complete.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn finish(self) -> Result<()> {
        let write = |name: &str, text: serde_json::Result<String>| -> Result<()> {
            let text = text.map_err(|e| Error::Internal(e.to_string()))?;
            Ok(files::write_atomic(&self.out.join(name), text.as_bytes())?)
        };
        match self.layout {
            Layout::Native => write(MANIFEST, serde_json::to_string_pretty(&self.manifest)),
            Layout::Nerfca => {
                let [train, test] = self.lists;
                write(nerfca::TRAINING_LIST, serde_json::to_string_pretty(&nerfca::FrameList { frames: train }))?;
                write(nerfca::VALIDATION_LIST, serde_json::to_string_pretty(&nerfca::FrameList { frames: test }))?;
                write(nerfca::GENERAL, serde_json::to_string_pretty(&self.general))
            }
        }
    }
}

/// Rejects a displacement of the heart, which the authors' layout cannot state.
fn check_shift(heart_shift_mm: [f64; 3]) -> Result<()> {
    if heart_shift_mm == [0.0; 3] {
        return Ok(());
    }
    let problem = "does not support displacements of the heart, which this dataset has";
    Err(Error::config("layout", "nerfca", problem))
}

/// Returns the angles of a geometry that differs from that of the C-arm `common` at most in its angles, as the authors' layout
/// requires it.
///
/// # Errors
/// [`Error::Config`] for another geometry.
pub fn authors_angles(common: &CArm, geometry: &Geometry) -> Result<(f64, f64)> {
    let c_arm = match geometry {
        Geometry::CArm(c_arm) => c_arm,
        Geometry::Matrix(_) => {
            let problem = "does not support projection matrices, only angles and distances";
            return Err(Error::config("layout", "nerfca", problem));
        }
    };
    let common = CArm { primary_deg: c_arm.primary_deg, secondary_deg: c_arm.secondary_deg, ..common.clone() };
    if *c_arm != common {
        let problem = "supports the same distances, pixels and table position for all views only, and they differ in this \
                       dataset";
        return Err(Error::config("layout", "nerfca", problem));
    }
    Ok((c_arm.primary_deg, c_arm.secondary_deg))
}

/// Writes a dataset in a layout. Stored values become line integrals. Returns the image file of each frame, relative to `out`.
///
/// # Errors
/// [`Error::Config`] for properties that the layout cannot state; [`Error::Io`].
pub fn convert(dataset: &Dataset, layout: Layout, out: &Path) -> Result<Vec<PathBuf>> {
    let description = format!("converted from {:?}", dataset.layout).to_lowercase();
    write(dataset, layout, out, description, &|_| None)
}

/// Writes a dataset of line integrals; `stated` returns the geometry of a view before it was corrected. Returns the image file of each
/// frame, relative to `out`.
///
/// # Errors
/// Errors of [`convert`].
pub fn write(
    dataset: &Dataset,
    layout: Layout,
    out: &Path,
    description: String,
    stated: &dyn Fn(usize) -> Option<Geometry>,
) -> Result<Vec<PathBuf>> {
    let (low, high) = dataset.depth_range;
    if layout == Layout::Nerfca && (low + high).abs() > 1e-9 {
        return Err(Error::config("layout", "nerfca", "the depth range is not centred"));
    }
    if layout == Layout::Nerfca && dataset.sizes().len() > 1 {
        return Err(Error::config("layout", "nerfca", ONE_SIZE));
    }
    if layout == Layout::Nerfca {
        // Nothing is written of a dataset that the layout cannot hold.
        let common = dataset.reference_c_arm();
        dataset.views.iter().try_for_each(|view| authors_angles(&common, &view.geometry).map(drop))?;
        dataset.frames.iter().try_for_each(|frame| check_shift(frame.heart_shift_mm))?;
    }
    let mut writer = Writer::new(
        out,
        layout,
        About {
            description,
            phases: dataset.n_phases,
            depth_half_extent_mm: low.abs().max(high.abs()) * MM_PER_UNIT,
            vessel_attenuation_per_mm: dataset.vessel_attenuation.map(|a| a / MM_PER_UNIT),
            still: dataset.still,
            vessels_alone: dataset.vessels_alone,
            size: dataset.canvas(),
            c_arm: dataset.reference_c_arm(),
        },
    )?;
    let mut image_files = Vec::with_capacity(dataset.frames.len());
    for frame in &dataset.frames {
        let view = &dataset.views[frame.view];
        let (own, [width, height]) = (dataset.own_frame(frame).into_owned(), view.size);
        let image = Image { width, height, values: own.integrals.into_vec() };
        let (taken, mask) = (frame.beat_time(), own.mask.as_deref());
        image_files.push(writer.frame(&view.geometry, frame.split, frame.view, taken, &image, mask)?);
        writer.corrected(frame.heart_shift_mm, stated(frame.view).as_ref())?;
    }
    writer.finish()?;
    Ok(image_files)
}
