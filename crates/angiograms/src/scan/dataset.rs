//! Dataset in memory and its native layout on disk (`dataset.json` + images; see `docs/formats.md`).

use crate::geometry::{CArm, Geometry, MM_PER_UNIT, ViewRays, is_at_rest};
use crate::scan::gating::BeatTime;
use crate::scan::pixels::Pixels;
use crate::scan::prior::VesselPrior;
use glam::DVec3;
use serde::{Deserialize, Serialize, Serializer};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use strum::{IntoStaticStr, VariantArray};

/// Name of the manifest inside a native dataset.
pub const MANIFEST: &str = "dataset.json";

/// Meaning of the pixel values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Intensity {
    /// `value * scale + offset` is the line integral of attenuation (no unit).
    Integral {
        /// Factor on the stored value.
        #[serde(default = "one")]
        scale: f64,
        /// Added after the factor.
        #[serde(default)]
        offset: f64,
    },
    /// `i0 - value` is the line integral: logarithmic detector, Beer-Lambert in the log domain.
    Log {
        /// Value of an unattenuated ray.
        i0: f64,
    },
    /// `-ln(value / i0)` is the line integral: detector linear in intensity.
    Linear {
        /// Value of an unattenuated ray.
        i0: f64,
    },
}

fn one() -> f64 {
    1.0
}

impl Intensity {
    pub(super) fn check(&self) -> std::result::Result<(), (String, String)> {
        let (field, ok) = match self {
            Intensity::Integral { scale, offset } => {
                ("scale", scale.is_finite() && *scale != 0.0 && offset.is_finite())
            }
            Intensity::Log { i0 } => ("i0", i0.is_finite()),
            Intensity::Linear { i0 } => ("i0", i0.is_finite() && *i0 > 0.0),
        };
        if ok { Ok(()) } else { Err((format!("intensity.{field}"), "is not finite or is outside its range".into())) }
    }

    /// Line integral of a stored value. The values of a linear detector are clamped from below at 1e-7 of `i0`.
    pub fn integral(&self, value: f32) -> f32 {
        let v = f64::from(value);
        (match self {
            Intensity::Integral { scale, offset } => v * scale + offset,
            Intensity::Log { i0 } => i0 - v,
            Intensity::Linear { i0 } => -(v / i0).max(1e-7).ln(),
        }) as f32
    }
}

/// Purpose of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Split {
    /// The reconstruction may see it.
    Train,
    /// Kept for evaluation.
    Validation,
}

/// `dataset.json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Always `nertca-dataset`.
    pub format: String,
    /// Version of this layout: 1.
    pub version: u32,
    /// Free text.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub description: String,
    /// Number of cardiac phases T; the times of frames go from 0 to below T.
    pub phases: u32,
    /// Attenuation is searched within this distance before and behind the isocentre plane, mm.
    pub depth_half_extent_mm: f64,
    /// Attenuation of contrast-filled vessels, 1/mm, where known; a fifth of it is the Dice threshold.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vessel_attenuation_per_mm: Option<f64>,
    /// Whether the object is at rest: phase 0 shows it, and phase 1 is the same without vessels. Phase 1 is estimated for views
    /// without an image of it, from their images of phase 0. `phases` is 1 or 2.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub still: bool,
    /// Whether the images show vessels and nothing else, as those that `import --gate-by-images` writes: their static background is 0.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub vessels_alone: bool,
    /// All images.
    pub frames: Vec<ManifestFrame>,
}

/// One image of a manifest.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ManifestFrame {
    /// Image file (`.npy` of shape rows x columns, or grey `.png`), relative to the manifest.
    pub image: PathBuf,
    /// When in the beat it was taken, counted in phases from 0; a frame may lie between two.
    #[serde(serialize_with = "whole_if_so")]
    pub phase: f64,
    /// Training or validation.
    pub split: Split,
    /// How it was taken.
    pub geometry: Geometry,
    /// Meaning of the image's values.
    pub intensity: Intensity,
    /// Vessel mask of the same size: non-zero inside vessels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask: Option<PathBuf>,
    /// How far breathing has carried the heart from its mean along (posterior, left, superior) in this frame, mm. It moves the
    /// beating heart, not the static background.
    #[serde(default, skip_serializing_if = "is_at_rest")]
    pub heart_shift_mm: [f64; 3],
    /// The geometry as it was stated before it was corrected; kept for the record, not used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stated_geometry: Option<Geometry>,
}

/// Writes whole numbers as integers, because other readers of the manifest expect integer phases.
fn whole_if_so<S: Serializer>(phase: &f64, to: S) -> std::result::Result<S::Ok, S::Error> {
    if phase.fract() == 0.0 { to.serialize_i64(*phase as i64) } else { to.serialize_f64(*phase) }
}

/// An image, ready for use.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Name of the frame, for messages and pictures.
    pub name: String,
    /// Index into [`Dataset::views`].
    pub view: usize,
    /// Cardiac phase nearest to the time it was taken, from 0.
    pub phase: u32,
    /// Time between that phase and the image, in phases: from -0.5 to 0.5.
    pub after_phase: f64,
    /// Training or validation.
    pub split: Split,
    /// Line integrals in row-major order; in a dataset, on the canvas of all images (see [`crate::scan::canvas`]).
    pub integrals: Pixels,
    /// Vessel mask, where known; false outside the image's own size.
    pub mask: Option<Vec<bool>>,
    /// Displacement of the heart from its mean position by breathing, along (posterior, left, superior), mm.
    pub heart_shift_mm: [f64; 3],
    /// Contrast of the vessels in this frame, as a multiple of the mean over the frames.
    pub contrast: f64,
}

impl Frame {
    /// Time in the beat at which it was taken.
    pub fn beat_time(&self) -> BeatTime {
        BeatTime { phase: self.phase, after_phase: self.after_phase }
    }

    /// Displacement of the heart from its mean position by breathing, world units.
    pub fn heart_shift(&self) -> DVec3 {
        DVec3::from_array(self.heart_shift_mm) / MM_PER_UNIT
    }
}

/// A geometry and a size shared by frames.
#[derive(Debug, Clone)]
pub struct View {
    /// Geometry as stated in the file.
    pub geometry: Geometry,
    /// Columns and rows of the view's images.
    pub size: [usize; 2],
    /// Rays in world units.
    pub rays: ViewRays,
}

impl View {
    /// Makes a view of images of `size` (columns, rows).
    ///
    /// # Errors
    /// Field and problem, for an impossible geometry.
    pub fn new(geometry: Geometry, size: [usize; 2]) -> std::result::Result<View, (String, String)> {
        let rays = geometry.rays(size[0], size[1])?;
        Ok(View { geometry, size, rays })
    }
}

/// Layout of a dataset on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "kebab-case")]
pub enum Layout {
    /// `dataset.json`.
    Native,
    /// The NeRF-CA / NerT-CA authors' `general.json`.
    Nerfca,
}

/// Angiograms with geometry and phase, validated.
#[derive(Debug, Clone)]
pub struct Dataset {
    /// Directory it came from.
    pub path: PathBuf,
    /// Layout of the files it was read from.
    pub layout: Layout,
    /// Distinct geometries and sizes.
    pub views: Vec<View>,
    /// All images; training images come first.
    pub frames: Vec<Frame>,
    /// Pixels of the canvas that do not show the patient, such as those behind a collimator's blade or beyond a smaller image,
    /// by index into `views`; views without such pixels are left out.
    pub hidden: BTreeMap<usize, Vec<bool>>,
    /// Columns of the canvas, equal to those of the widest image.
    pub width: usize,
    /// Rows of the canvas, equal to those of the highest image.
    pub height: usize,
    /// Number of cardiac phases.
    pub n_phases: u32,
    /// Depth range around the isocentre plane, world units.
    pub depth_range: (f64, f64),
    /// Vessel attenuation per world unit, where stated.
    pub vessel_attenuation: Option<f64>,
    /// Whether the object is at rest: phase 0 shows it, and phase 1 is the same without vessels.
    pub still: bool,
    /// Whether the images show vessels and nothing else (see [`Manifest::vessels_alone`]).
    pub vessels_alone: bool,
    /// Whether the geometry of the views was adjusted with the vessels in the loop.
    pub views_adjusted: bool,
    /// Vessels that are known before the images are read.
    pub prior: Option<Arc<VesselPrior>>,
    /// Findings on reading that are no errors but may be unintended.
    pub notes: Vec<String>,
}

impl Dataset {
    /// Number of phases to show: those of the beat, or only the first for an object at rest.
    pub fn shown_phases(&self) -> u32 {
        if self.still { 1 } else { self.n_phases }
    }

    /// Rays that see the heart in a frame: the view's rays, displaced opposite to the heart.
    pub fn heart_rays(&self, frame: &Frame) -> ViewRays {
        self.views[frame.view].rays.moved(frame.heart_shift())
    }

    /// Rays that see the heart in a view's training frames at a phase; the view's own rays if it has no such frame.
    pub fn heart_rays_at(&self, view: usize, phase: u32) -> ViewRays {
        let frame = self.training().iter().find(|f| (f.view, f.phase) == (view, phase));
        frame.map_or_else(|| self.views[view].rays.clone(), |f| self.heart_rays(f))
    }

    /// Mean time between a phase and a view's training frames of that phase, in phases; 0 if the view has none.
    pub fn after_phase(&self, view: usize, phase: u32) -> f64 {
        let frames = self.training().iter().filter(|f| (f.view, f.phase) == (view, phase));
        let (sum, n) = frames.fold((0.0, 0u32), |(sum, n), f| (sum + f.after_phase, n + 1));
        sum / f64::from(n.max(1))
    }

    /// Mean contrast of a view's training frames at a phase; 1 if the view has none.
    pub fn contrast_at(&self, view: usize, phase: u32) -> f64 {
        let frames = self.training().iter().filter(|f| (f.view, f.phase) == (view, phase));
        let (sum, n) = frames.fold((0.0, 0u32), |(sum, n), f| (sum + f.contrast, n + 1));
        if n == 0 { 1.0 } else { sum / f64::from(n) }
    }

    /// Tells whether some training frame has a displacement of the heart.
    pub fn heart_shifts(&self) -> bool {
        self.training().iter().any(|f| f.heart_shift_mm != [0.0; 3])
    }

    /// Frames that the reconstruction may use; they come first in [`Dataset::frames`].
    pub fn training(&self) -> &[Frame] {
        &self.frames[..self.n_training()]
    }

    /// Frames kept for evaluation.
    pub fn validation(&self) -> &[Frame] {
        &self.frames[self.n_training()..]
    }

    fn n_training(&self) -> usize {
        self.frames.iter().take_while(|f| f.split == Split::Train).count()
    }

    /// Number of pixels of the canvas.
    pub fn n_pixels(&self) -> usize {
        self.width * self.height
    }

    /// Returns the first of the training views with the largest number of pixels. Renderings without a stated view use it.
    pub fn reference_view(&self) -> &View {
        let views = self.training().iter().map(|frame| &self.views[frame.view]);
        let larger = |a: &View, b: &View| b.size[0] * b.size[1] > a.size[0] * a.size[1];
        views.reduce(|a, b| if larger(a, b) { b } else { a }).unwrap_or(&self.views[0])
    }

    /// Returns the C-arm of [`Dataset::reference_view`]; for an explicit matrix, a C-arm with the same magnification.
    pub fn reference_c_arm(&self) -> CArm {
        let view = self.reference_view();
        match &view.geometry {
            Geometry::CArm(c_arm) => c_arm.clone(),
            Geometry::Matrix(_) => {
                let sod_mm = view.rays.sod * MM_PER_UNIT;
                let sid_mm = 1.5 * sod_mm;
                CArm {
                    primary_deg: 0.0,
                    secondary_deg: 0.0,
                    sid_mm,
                    sod_mm,
                    pixel_mm: [view.rays.direction[1].length() * sid_mm, view.rays.direction[2].length() * sid_mm],
                    offset_mm: [0.0; 2],
                    table_mm: [0.0; 3],
                }
            }
        }
    }

    /// Views that training frames use.
    pub fn training_views(&self) -> Vec<usize> {
        let mut views: Vec<usize> = self.training().iter().map(|f| f.view).collect();
        views.sort_unstable();
        views.dedup();
        views
    }
}

/// JSON schema of the manifest.
#[cfg(feature = "schema")]
pub fn manifest_schema() -> String {
    let schema = schemars::schema_for!(Manifest);
    serde_json::to_string_pretty(&schema).unwrap_or_default() + "\n"
}
