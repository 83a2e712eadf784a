//! Makes a dataset of projections and a geometry of the Reconstruction Toolkit (RTK).
//!
//! RTK's axes are taken as left, superior and anterior, so that its axis of rotation is the patient's. Its projections are line integrals;
//! their rows go upwards, and are reversed.

use crate::error::{Error, Result};
use crate::formats::rtk::{RtkMatrix, read_geometry};
use crate::formats::volume::{Volume, VolumeHints};
use crate::formats::volume_files;
use crate::geometry::{CArm, Geometry, MM_PER_UNIT, Matrix};
use crate::raster::Image;
use crate::scan::at_rest;
use crate::scan::dataset::{Layout, Split};
use crate::scan::frame_checks::{Complaint, check_phase, check_values, checked_view};
use crate::scan::gating::BeatTime;
use crate::scan::same_view::find_or_add;
use crate::scan::writer::{About, Writer};
use glam::DVec3;
use std::path::Path;

/// Largest share of a pixel by which axes may be off the image's rows and columns.
const STRAIGHT: f64 = 1e-6;

/// Options of an import.
#[derive(Debug, Clone)]
pub struct RtkOptions {
    /// Number of cardiac phases.
    pub phases: u32,
    /// Time of each projection in the beat, phases; none for an object at rest.
    pub times: Option<Vec<f64>>,
    /// Depth searched before and behind the isocentre, mm.
    pub depth_half_extent_mm: f64,
}

/// Writes a dataset of the projections of a stack (columns, rows, projections; line integrals) and a geometry with one matrix for each; returns
/// the number of views.
///
/// # Errors
/// [`Error::Data`] naming file and field; [`Error::Config`] for times that do not fit; [`Error::Io`].
pub fn import(geometry: &Path, projections: &Path, options: &RtkOptions, out: &Path) -> Result<usize> {
    let matrices = read_geometry(geometry)?;
    let stack = Stack::read(projections)?;
    let n = stack.volume.size[2];
    if matrices.len() != n {
        let problem = format!("has {} projections, but {} has {n}", matrices.len(), projections.display());
        return Err(Error::data(geometry, "Projection", problem));
    }
    let times = options.times.clone().unwrap_or_else(|| vec![0.0; n]);
    if times.len() != n {
        return Err(Error::config("phases", times.len(), format!("times are given for {n} projections")));
    }
    let phases = if options.times.is_some() { options.phases } else { at_rest::PHASES };
    let depth_before = options.depth_half_extent_mm / MM_PER_UNIT;
    let [columns, rows, _] = stack.volume.size;
    let about = About {
        description: format!("{n} projections with a geometry of RTK"),
        phases,
        depth_half_extent_mm: options.depth_half_extent_mm,
        vessel_attenuation_per_mm: None,
        still: options.times.is_none(),
        vessels_alone: false,
        size: [columns, rows],
        c_arm: unstated(),
    };
    let mut writer = Writer::new(out, Layout::Native, about)?;
    let mut views = Vec::new();
    for (index, (matrix, time)) in matrices.iter().zip(&times).enumerate() {
        let told = |file: &Path, found: Complaint| {
            Error::data(
                file,
                format!("projection {}: {}", index + 1, found.field),
                format!("{} {}", found.value, found.problem),
            )
        };
        check_phase(*time, phases).map_err(|found| Error::config(found.field, found.value, found.problem))?;
        let image = stack.image(index);
        check_values(&image.values, columns).map_err(|found| told(projections, found))?;
        let stated = Geometry::Matrix(Matrix { matrix: stack.to_pixels(matrix) });
        checked_view(stated.clone(), [columns, rows], depth_before).map_err(|found| told(geometry, found))?;
        let view = find_or_add(&mut views, stated.clone(), [columns, rows], depth_before)
            .map_err(|found| told(geometry, found))?;
        writer.frame(&stated, Split::Train, view, BeatTime::of(*time, phases), &image, None)?;
    }
    writer.finish()?;
    Ok(views.len())
}

/// C-arm of the authors' layout, which this import does not write.
fn unstated() -> CArm {
    CArm {
        primary_deg: 0.0,
        secondary_deg: 0.0,
        sid_mm: 1.0,
        sod_mm: 1.0,
        pixel_mm: [1.0; 2],
        offset_mm: [0.0; 2],
        table_mm: [0.0; 3],
    }
}

/// Stack of projections.
struct Stack {
    volume: Volume,
    /// Place of the first pixel on the detector, mm.
    origin_mm: [f64; 2],
    /// Pitch of pixels, mm.
    pitch_mm: [f64; 2],
}

impl Stack {
    fn read(path: &Path) -> Result<Stack> {
        let volume = volume_files::read(path, &VolumeHints::default())?;
        let axes = volume.index_to_lps.matrix3;
        let origin = volume.index_to_lps.translation;
        let is_straight = |axis: DVec3, along: usize| {
            let others = (0..3).filter(|k| *k != along).map(|k| axis[k].abs());
            axis[along] > 0.0 && others.fold(0.0, f64::max) < STRAIGHT * axis[along]
        };
        if !is_straight(axes.x_axis, 0) || !is_straight(axes.y_axis, 1) {
            let problem = "turns the projections: columns and rows must lie along the axes, as RTK writes them";
            return Err(Error::data(path, "orientation", problem));
        }
        Ok(Stack { origin_mm: [origin.x, origin.y], pitch_mm: [axes.x_axis.x, axes.y_axis.y], volume })
    }

    /// Image of a projection, whose rows go downwards.
    fn image(&self, index: usize) -> Image {
        let [width, height, _] = self.volume.size;
        let of_projection = &self.volume.values[index * width * height..(index + 1) * width * height];
        let values = of_projection.chunks(width).rev().flatten().copied().collect();
        Image { width, height, values }
    }

    /// Converts a projection from RTK's coordinates to mm on the detector to one from LPS mm to (column, row) of [`Stack::image`].
    fn to_pixels(&self, matrix: &RtkMatrix) -> [[f64; 4]; 3] {
        // RTK's axes in (left, posterior, superior): x is left, y superior, z anterior.
        let of_patient = |row: &[f64; 4]| [row[0], -row[2], row[1], row[3]];
        let [u, v, w] = [of_patient(&matrix[0]), of_patient(&matrix[1]), of_patient(&matrix[2])];
        let last_row = self.volume.size[1] as f64 - 1.0;
        let column = |k: usize| (u[k] - self.origin_mm[0] * w[k]) / self.pitch_mm[0];
        let row = |k: usize| last_row * w[k] - (v[k] - self.origin_mm[1] * w[k]) / self.pitch_mm[1];
        [std::array::from_fn(column), std::array::from_fn(row), w]
    }
}
