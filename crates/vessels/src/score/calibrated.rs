//! Scores of synthetic data in the frame of the reconstruction. Views do not determine a motion common to all of them, so a
//! reconstruction from corrected views is displaced by one against the truth. Where `truth.json` states the true geometry
//! of the images, that motion is found and applied to unseen views and true vessels.

use crate::calibrate::gauge::{FrameRays, RigidMotion, common_motion, heart_points};
use crate::error::{Error, Result};
use crate::geometry::{Geometry, MM_PER_UNIT, ViewRays};
use crate::scan::dataset::{Dataset, Frame, Split};
use crate::scan::truth::{TRUTH, TrueFrame, Truth};
use glam::DVec3;
use std::collections::BTreeMap;
use std::ffi::OsStr;

/// True rays of a frame's image, with the heart at its mean position.
pub(super) fn true_rays(frame: &TrueFrame, view: usize, dataset: &Dataset) -> Result<ViewRays> {
    let [width, height] = dataset.views[view].size;
    let rays = Geometry::CArm(frame.geometry.clone()).rays(width, height);
    rays.map_err(|(field, problem)| Error::data(dataset.path.join(TRUTH), field, problem))
}

/// True displacement of the heart by breathing, world units.
pub(super) fn shift_of(frame: &TrueFrame) -> DVec3 {
    DVec3::from_array(frame.heart_shift_mm) / MM_PER_UNIT
}

/// Points that represent the heart of a dataset.
fn points(dataset: &Dataset) -> Vec<DVec3> {
    heart_points(&dataset.views[0].rays, dataset.views[0].size)
}

/// Displacements up to this have no influence on scores, pixels.
const NEGLIGIBLE_PX: f64 = 0.01;

/// Truth of a dataset; `None` where there is none, or where it belongs to other frames.
fn truth_of(dataset: &Dataset) -> Result<Option<Truth>> {
    if !dataset.path.join(TRUTH).is_file() {
        return Ok(None);
    }
    let truth = Truth::load(&dataset.path)?;
    let of_these = dataset.frames.iter().all(|frame| TrueFrames::new(&truth, dataset).of(frame).is_some());
    Ok(of_these.then_some(truth))
}

/// Returns a dataset of corrected training views with its unseen images in the frame of the reconstruction. If a view is
/// both trained and scored, the scored images get a view of their own. Returns `None` without `truth.json`, where it
/// belongs to other frames, or where the motion is negligible.
///
/// # Errors
/// [`Error::Io`] and [`Error::Data`] for a truth that cannot be read.
pub fn in_calibrated_frame(dataset: &Dataset) -> Result<Option<Dataset>> {
    let Some(truth) = truth_of(dataset)? else { return Ok(None) };
    let found = TrueFrames::new(&truth, dataset);
    let motion = found.motion()?;
    let mean = motion.translations.iter().sum::<DVec3>() / f64::from(dataset.n_phases);
    let still = RigidMotion { rotation: motion.rotation, translations: vec![mean] };
    let trained = dataset.training_views();
    let mut own = BTreeMap::new();
    let mut carried = dataset.clone();
    for (f, frame) in dataset.frames.iter().zip(&mut carried.frames) {
        let Some(was) = found.of(f).filter(|_| f.split == Split::Validation) else { continue };
        if trained.contains(&f.view) {
            frame.view = *own.entry(f.view).or_insert_with(|| {
                carried.views.push(dataset.views[f.view].clone());
                carried.views.len() - 1
            });
            if let Some(hidden) = dataset.hidden.get(&f.view) {
                carried.hidden.insert(frame.view, hidden.clone());
            }
        }
        carried.views[frame.view].rays = still.carry_rays(&true_rays(was, f.view, dataset)?, 0);
        let shift = still.carry(shift_of(was), 0) - motion.translations[f.phase as usize];
        frame.heart_shift_mm = (shift * MM_PER_UNIT).to_array();
    }
    Ok((farthest_px(dataset, &carried) > NEGLIGIBLE_PX).then_some(carried))
}

/// Returns the motion of the reconstruction of a dataset's corrected training views against the true vessels, phase by
/// phase; `None` without `truth.json`, where it belongs to other frames, or where the motion is negligible.
///
/// # Errors
/// [`Error::Io`] and [`Error::Data`] for a truth that cannot be read.
pub fn carried_by(dataset: &Dataset) -> Result<Option<RigidMotion>> {
    let Some(truth) = truth_of(dataset)? else { return Ok(None) };
    let motion = TrueFrames::new(&truth, dataset).motion()?;
    let negligible = NEGLIGIBLE_PX * dataset.views[0].rays.anchor[1].length();
    let points = points(dataset);
    let moves = |phase: usize| points.iter().any(|p| motion.carry(*p, phase).distance(*p) > negligible);
    Ok((0..dataset.n_phases as usize).any(moves).then_some(motion))
}

/// The truth of a dataset's frames.
pub(super) struct TrueFrames<'a> {
    truth: &'a Truth,
    dataset: &'a Dataset,
}

impl<'a> TrueFrames<'a> {
    pub(super) fn new(truth: &'a Truth, dataset: &'a Dataset) -> TrueFrames<'a> {
        TrueFrames { truth, dataset }
    }

    /// Truth of a frame's image; `None` where the truth belongs to other frames.
    pub(super) fn of(&self, frame: &Frame) -> Option<&'a TrueFrame> {
        // The phase of a frame between two phases is ambiguous, so frames are identified by name.
        let is = |was: &&TrueFrame| was.split == frame.split && was.image.file_stem() == Some(OsStr::new(&frame.name));
        self.truth.frames.iter().find(is)
    }

    /// Motion of the reconstruction against the truth.
    fn motion(&self) -> Result<RigidMotion> {
        let dataset = self.dataset;
        let (mut frames, mut breathes) = (Vec::new(), dataset.heart_shifts());
        for f in dataset.training() {
            let Some(was) = self.of(f) else { continue };
            breathes |= shift_of(was) != DVec3::ZERO;
            let truth = true_rays(was, f.view, dataset)?.moved(shift_of(was));
            frames.push(FrameRays { phase: f.phase as usize, truth, corrected: dataset.heart_rays(f) });
        }
        Ok(common_motion(&frames, &points(dataset), dataset.n_phases as usize, breathes))
    }
}

/// Maximum distance between the images of points of the heart in unseen frames of two datasets.
fn farthest_px(a: &Dataset, b: &Dataset) -> f64 {
    let points = points(a);
    let apart = |(a, b): (ViewRays, ViewRays)| {
        let frame = [FrameRays { phase: 0, truth: a, corrected: b }];
        RigidMotion::none(1).remainder_px(&frame, &points)
    };
    let frames = a.validation().iter().zip(b.validation());
    frames.map(|(f, g)| apart((a.heart_rays(f), b.heart_rays(g)))).fold(0.0, f64::max)
}
