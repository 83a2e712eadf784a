//! Scores of synthetic data in the frame that the reconstruction lives in. Views know nothing of a motion that all of them
//! share, so a reconstruction of corrected views is carried by one against the truth. Where `truth.json` says how images
//! were really taken, that motion is found, and unseen views are carried along.

use crate::calibrate::gauge::{FrameRays, RigidMotion, common_motion};
use crate::error::{Error, Result};
use crate::geometry::{Geometry, MM_PER_UNIT, ViewRays};
use crate::scan::dataset::{Dataset, Frame, Split};
use crate::scan::truth::{TRUTH, TrueFrame, Truth};
use glam::DVec3;

/// Half side of the cube of points that stand for the heart, as a share of the field of view's half.
const HEART_SHARE: f64 = 0.5;

/// Rays by which the image of a frame was really taken, the heart at its mean position.
pub(super) fn true_rays(frame: &TrueFrame, dataset: &Dataset) -> Result<ViewRays> {
    let rays = Geometry::CArm(frame.geometry.clone()).rays(dataset.width, dataset.height);
    rays.map_err(|(field, problem)| Error::data(dataset.path.join(TRUTH), field, problem))
}

/// Where breathing had carried the heart, world units.
pub(super) fn shift_of(frame: &TrueFrame) -> DVec3 {
    DVec3::from_array(frame.heart_shift_mm) / MM_PER_UNIT
}

/// Points that stand for the heart: the corners and the middle of a cube.
fn points(dataset: &Dataset) -> Vec<DVec3> {
    let rays = &dataset.views[0].rays;
    let pixel = rays.anchor[1].length().min(rays.anchor[2].length());
    let half = HEART_SHARE * 0.5 * pixel * dataset.width.min(dataset.height) as f64;
    let sign = |k: usize, axis: usize| if k >> axis & 1 == 1 { half } else { -half };
    (0..8).map(|k| DVec3::new(sign(k, 0), sign(k, 1), sign(k, 2))).chain([DVec3::ZERO]).collect()
}

/// Ways that no score shows, pixels.
const NEGLIGIBLE_PX: f64 = 0.01;

/// The dataset, of corrected training views, with its unseen views where the reconstruction has them. None without
/// `truth.json`, where that is of other frames, or where nothing moves by it.
///
/// # Errors
/// [`Error::Io`] and [`Error::Data`] for a truth that cannot be read.
pub fn in_calibrated_frame(dataset: &Dataset) -> Result<Option<Dataset>> {
    if !dataset.path.join(TRUTH).is_file() {
        return Ok(None);
    }
    let truth = Truth::load(&dataset.path)?;
    let found = TrueFrames::new(&truth, dataset);
    if dataset.frames.iter().any(|f| found.of(f).is_none()) {
        return Ok(None);
    }
    let motion = found.motion()?;
    let mean = motion.translations.iter().sum::<DVec3>() / f64::from(dataset.n_phases);
    let still = RigidMotion { rotation: motion.rotation, translations: vec![mean] };
    let mut carried = dataset.clone();
    for (f, frame) in dataset.frames.iter().zip(&mut carried.frames) {
        // Views that training shares with scoring are where they were corrected to.
        if f.split == Split::Train || found.training.contains(&f.view) {
            continue;
        }
        let Some(was) = found.of(f) else { continue };
        carried.views[f.view].rays = still.carry_rays(&true_rays(was, dataset)?, 0);
        let shift = still.carry(shift_of(was), 0) - motion.translations[f.phase as usize];
        frame.heart_shift_mm = (shift * MM_PER_UNIT).to_array();
    }
    Ok((farthest_px(dataset, &carried) > NEGLIGIBLE_PX).then_some(carried))
}

/// The truth of a dataset's frames.
pub(super) struct TrueFrames<'a> {
    truth: &'a Truth,
    dataset: &'a Dataset,
    /// Views of training, and those unseen: the truth counts them in this order.
    training: Vec<usize>,
    unseen: Vec<usize>,
}

impl<'a> TrueFrames<'a> {
    pub(super) fn new(truth: &'a Truth, dataset: &'a Dataset) -> TrueFrames<'a> {
        let views = |frames: &[Frame]| {
            let mut views: Vec<usize> = frames.iter().map(|f| f.view).collect();
            views.sort_unstable();
            views.dedup();
            views
        };
        TrueFrames { truth, dataset, training: views(dataset.training()), unseen: views(dataset.validation()) }
    }

    /// How the image of a frame was really taken; none where the truth is of other frames.
    pub(super) fn of(&self, frame: &Frame) -> Option<&'a TrueFrame> {
        let place = |views: &[usize]| views.iter().position(|v| *v == frame.view);
        let view = match frame.split {
            Split::Train => place(&self.training)?,
            Split::Validation => self.training.len() + place(&self.unseen)?,
        };
        self.truth.frames.iter().find(|f| (f.split, f.view, f.phase) == (frame.split, view, frame.phase))
    }

    /// What the reconstruction is carried by.
    fn motion(&self) -> Result<RigidMotion> {
        let dataset = self.dataset;
        let (mut frames, mut breathes) = (Vec::new(), dataset.heart_shifts());
        for f in dataset.training() {
            let Some(was) = self.of(f) else { continue };
            breathes |= shift_of(was) != DVec3::ZERO;
            let truth = true_rays(was, dataset)?.moved(shift_of(was));
            frames.push(FrameRays { phase: f.phase as usize, truth, corrected: dataset.heart_rays(f) });
        }
        Ok(common_motion(&frames, &points(dataset), dataset.n_phases as usize, breathes))
    }
}

/// How far apart two datasets see points of the heart in unseen frames, at most.
fn farthest_px(a: &Dataset, b: &Dataset) -> f64 {
    let points = points(a);
    let apart = |(a, b): (ViewRays, ViewRays)| {
        let frame = [FrameRays { phase: 0, truth: a, corrected: b }];
        RigidMotion::none(1).remainder_px(&frame, &points)
    };
    let frames = a.validation().iter().zip(b.validation());
    frames.map(|(f, g)| apart((a.heart_rays(f), b.heart_rays(g)))).fold(0.0, f64::max)
}
