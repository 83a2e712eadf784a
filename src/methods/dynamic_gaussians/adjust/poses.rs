//! Poses of the views as unknowns: stated views, and what the frames see at given poses.

use crate::calibrate::correction::Calibration;
use crate::calibrate::gauge::{RigidMotion, frame_rays, heart_points};
use crate::calibrate::pose::{Poses, StatedView, ViewPose};
use crate::gaussians::view::SplatView;
use crate::geometry::{MM_PER_UNIT, ViewRays, world_from_lps_mm};
use crate::methods::dynamic_gaussians::targets::Targets;
use crate::scan::dataset::{Dataset, Frame};
use glam::DVec3;

/// Views of a dataset with their stated geometry. A slot is an index into the views that the Gaussians are fitted to.
pub struct Stands<'a> {
    /// Dataset with the stated geometry.
    pub dataset: &'a Dataset,
    /// `[slot]`: index into the dataset's views.
    pub views: Vec<usize>,
    /// `[slot]`: stated geometry.
    pub stands: Vec<StatedView>,
}

impl<'a> Stands<'a> {
    /// Collects the stated geometry of views, which are indices into the dataset's views.
    pub fn new(dataset: &'a Dataset, views: Vec<usize>) -> Stands<'a> {
        let stand = |view: &usize| StatedView::new(&dataset.views[*view].geometry, &dataset.views[*view].rays);
        Stands { dataset, stands: views.iter().map(stand).collect(), views }
    }

    fn slot_of(&self, view: usize) -> Option<usize> {
        self.views.iter().position(|v| *v == view)
    }

    /// Returns the poses of a calibration.
    pub fn poses(&self, calibration: &Calibration) -> Poses {
        let mut poses = Poses::stated(self.views.len(), self.dataset.n_phases as usize);
        for c in &calibration.views {
            let Some(slot) = self.slot_of(c.view) else { continue };
            let shift = world_from_lps_mm(DVec3::from_array(c.table_mm));
            poses.views[slot] = ViewPose { angles_deg: [c.primary_deg, c.secondary_deg], shift };
        }
        for c in &calibration.frames {
            let Some(slot) = self.slot_of(c.view) else { continue };
            poses.heart[slot][c.phase as usize] = DVec3::from_array(c.heart_shift_mm) / MM_PER_UNIT;
            poses.gains[slot][c.phase as usize] = c.contrast - 1.0;
        }
        poses
    }

    /// Rays that see the heart in a slot's frame of a phase.
    fn rays(&self, poses: &Poses, slot: usize, phase: usize) -> ViewRays {
        self.stands[slot].corrected_rays(&poses.views[slot], poses.heart[slot][phase])
    }

    /// Returns what each image of the targets sees at other poses.
    pub fn seen(&self, targets: &Targets, poses: &Poses) -> Vec<SplatView> {
        let mut seen = targets.views.clone();
        for (at, image) in targets.image_of.iter().enumerate() {
            let Some(image) = image else { continue };
            let (phase, slot) = (at / targets.n_views, at % targets.n_views);
            let view = SplatView::new(&self.rays(poses, slot, phase), targets.units);
            seen[*image] = SplatView { after_phase: seen[*image].after_phase, ..view };
        }
        seen
    }

    /// Returns the root mean square distance between the images of points of the heart at two sets of poses, pixels.
    pub fn change_px(&self, a: &Poses, b: &Poses) -> f64 {
        let points = heart_points(&self.stands[0].rays, self.dataset.views[self.views[0]].size);
        let frames = frame_rays(&self.stands, 0..self.stands.len(), [a, b]);
        RigidMotion::none(self.dataset.n_phases as usize).remainder_px(&frames, &points)
    }

    /// Returns the dataset at other poses.
    pub fn at(&self, poses: &Poses) -> Dataset {
        let mut moved = self.dataset.clone();
        for ((view, stand), pose) in self.views.iter().zip(&self.stands).zip(&poses.views) {
            let view = &mut moved.views[*view];
            view.rays = stand.corrected_rays(pose, DVec3::ZERO);
            view.geometry = view.geometry.corrected(pose.angles_deg, pose.shift);
        }
        let correct = |frame: &mut Frame| {
            let Some(slot) = self.slot_of(frame.view) else { return };
            let phase = frame.phase as usize;
            frame.heart_shift_mm = (poses.heart[slot][phase] * MM_PER_UNIT).to_array();
            frame.contrast = 1.0 + poses.gains[slot][phase];
        };
        moved.frames.iter_mut().for_each(correct);
        moved
    }
}
