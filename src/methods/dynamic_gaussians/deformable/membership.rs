//! Changes of the members of a deformable set: Gaussians that are dropped, and new ones where line integrals are missing.

use crate::error::Result;
use crate::gaussians::field::dense;
use crate::methods::dynamic_gaussians::deformable::DeformableTrainer;
use crate::methods::dynamic_gaussians::deformable::catheter::Catheter;
use crate::methods::dynamic_gaussians::groups::vessels;
use crate::methods::dynamic_gaussians::per_phase::strong;
use crate::methods::dynamic_gaussians::rules::FAINT;
use crate::methods::dynamic_gaussians::seeds;
use glam::DVec3;

/// Minimum filling at the phases whose images decide where new Gaussians are placed.
const MOSTLY_FILLED: f64 = 0.5;

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

    /// Looks for a catheter, and drops it where the settings say so.
    pub(super) fn find_catheter(&mut self) -> Result<()> {
        self.catheter = Catheter::find(&self.deformable()?, self.targets.lengths.factor);
        let dropped = self.catheter.as_ref().filter(|_| self.config.without_catheter);
        if let Some(keep) = dropped.map(|catheter| catheter.members.iter().map(|member| !member).collect()) {
            self.retain(|_| keep)?;
        }
        Ok(())
    }

    /// Returns a sentence on the catheter that was found, once.
    pub(in crate::methods::dynamic_gaussians) fn take_finding(&mut self) -> Option<String> {
        let Catheter { extent_mm, slowest, .. } = self.catheter.take()?;
        let found = format!(
            "a catheter seems to be in the dynamic field: {extent_mm:.0} mm whose motion falls to {:.0} % of that of the vessels",
            100.0 * slowest
        );
        Some(match self.config.without_catheter {
            true => format!("{found}; it is left out (gaussians.without_catheter)"),
            false => format!("{found}; --set gaussians.without_catheter=true leaves it out of field, tree and scores"),
        })
    }
}
