//! Changes of the members of a deformable set: Gaussians that are dropped, and new ones where line integrals are missing.

use crate::config::CatheterChoice;
use crate::error::Result;
use crate::gaussians::field::dense;
use crate::methods::dynamic_gaussians::deformable::DeformableTrainer;
use crate::methods::dynamic_gaussians::deformable::catheter::{Catheter, views_entered};
use crate::methods::dynamic_gaussians::groups::vessels;
use crate::methods::dynamic_gaussians::per_phase::strong;
use crate::methods::dynamic_gaussians::rules::FAINT;
use crate::methods::dynamic_gaussians::seeds;
use glam::DVec3;

/// Minimum filling at the phases whose images decide where new Gaussians are placed.
const MOSTLY_FILLED: f64 = 0.5;
/// Number of views in which a catheter must come from the border of the image: one alone may show an edge of a bone there, as was seen in one
/// of three data sets without a catheter.
const MIN_VIEWS_ENTERED: usize = 2;

impl DeformableTrainer {
    /// Drops weak Gaussians and places new ones where data are missing at half the phases. This happens once in a run, on the
    /// host, as with a set per phase.
    pub(super) fn grow(&mut self) -> Result<()> {
        let (weakest, setup) = (self.config.gaussians.prune_threshold, self.joint.setup);
        let mut members = self.retain(|rows| strong(rows, &setup, weakest))?;
        let settings = self.targets.lengths.gaussians(&self.config.gaussians);
        if seeds::n_additions(&settings) == 0 {
            return Ok(());
        }
        let deformable = self.deformable()?;
        let carried = |x: DVec3, phase: f64| deformable.carried(x, phase);
        let is_filled = |x: DVec3, phase: usize| {
            deformable.filling.is_none() || deformable.filling_at(deformable.nearest(x), phase) >= MOSTLY_FILLED
        };
        let images = self.images()?;
        let additions =
            seeds::deformable_additions(&self.targets, &settings, self.config.seed, &images, carried, is_filled);
        members.append(additions, &deformable);
        self.replace(&members)
    }

    /// Drops Gaussians that are too faint for vessels: they stand for other motion.
    pub(super) fn clear(&mut self) -> Result<()> {
        let (faint, setup) = (FAINT, self.joint.setup);
        self.retain(|rows| dense(rows, &setup, faint)).map(|_| ())
    }

    /// Drops Gaussians that are alone and broad.
    pub(super) fn drop_strays(&mut self) -> Result<()> {
        let (link, setup) = (self.targets.lengths.gaussians(&self.config.gaussians).link, self.joint.setup);
        self.retain(|rows| vessels(rows, &setup, link)).map(|_| ())
    }

    /// Looks for a catheter, and drops it where the settings, or the images of the views, say so.
    pub(super) fn find_catheter(&mut self) -> Result<()> {
        let field = self.deformable()?;
        let Some(catheter) = Catheter::find(&field, self.targets.lengths.factor) else { return Ok(()) };
        let n_entered = views_entered(&self.targets, &field, catheter.slowest_member);
        let is_left_out = match self.config.catheter {
            CatheterChoice::Keep => false,
            CatheterChoice::LeaveOut => true,
            CatheterChoice::Auto => n_entered >= MIN_VIEWS_ENTERED,
        };
        if is_left_out {
            self.retain(|_| catheter.members.iter().map(|member| !member).collect())?;
        }
        self.finding = Some(catheter.sentence(n_entered, is_left_out));
        Ok(())
    }

    /// Returns a sentence on the catheter that was found, once.
    pub(in crate::methods::dynamic_gaussians) fn take_finding(&mut self) -> Option<String> {
        self.finding.take()
    }
}
