//! Changes of the members of a deformable set: Gaussians that are dropped, and new ones where line integrals are missing.

use crate::config::sections::Rule;
use crate::error::Result;
use crate::gaussians::field::dense;
use crate::methods::dynamic_gaussians::deformable::DeformableTrainer;
use crate::methods::dynamic_gaussians::deformable::catheter::Catheter;
use crate::methods::dynamic_gaussians::deformable::members::Members;
use crate::methods::dynamic_gaussians::deformable::pruning::{Judge, broad_parts, components, short_parts};
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

    /// Returns sentences on a catheter that was found and on what was dropped, once.
    pub(in crate::methods::dynamic_gaussians) fn take_findings(&mut self) -> Vec<String> {
        let n = std::mem::take(&mut self.n_broad);
        let broad = (n > 0).then(|| {
            format!(
                "Gaussians that are left out, because they are broader than the vessels and hidden from some view, e.g. by a blade: {n}"
            )
        });
        broad.into_iter().chain(self.take_catheter()).collect()
    }

    /// Returns a sentence on the catheter that was found, once.
    fn take_catheter(&mut self) -> Option<String> {
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

    /// Drops components that are no vessels: broad ones that not all views show, and, where the trainer prunes, short ones that the
    /// images do not support.
    pub(super) fn drop_unsupported(&mut self) -> Result<()> {
        let members = self.download()?;
        let (rows, setup) = (&members.particles.rows, &self.joint.setup);
        let components = components(rows, setup);
        let targets = &self.targets;
        let broad =
            if targets.left_out.keeps(Rule::BroadParts) { broad_parts(&components, rows, setup) } else { Vec::new() };
        let prunes = self.prunes && targets.left_out.keeps(Rule::ShortParts);
        let short = if prunes { short_parts(&components, rows, targets.lengths.factor) } else { Vec::new() };
        if broad.is_empty() && short.is_empty() {
            return Ok(());
        }
        let judge = Judge::new(&self.targets, &self.images()?);
        let mut keep = vec![true; rows.len()];
        for part in &broad {
            if !judge.is_shown_by_all(&self.images_of_part(&members, part)?) {
                part.iter().for_each(|i| keep[*i] = false);
            }
        }
        let n_broad = keep.iter().filter(|keep| !**keep).count();
        let left: Vec<&Vec<usize>> = short.into_iter().filter(|component| keep[component[0]]).collect();
        for component in left {
            if !judge.supports(&self.images_of_part(&members, component)?) {
                component.iter().for_each(|i| keep[*i] = false);
            }
        }
        // A set without Gaussians is no set: where the images support none, all stay.
        if keep.contains(&true) && keep.contains(&false) {
            self.retain(|_| keep)?;
            self.n_broad = n_broad;
        }
        Ok(())
    }

    /// Images of some of the Gaussians, `[image][pixel]`, shares of the strongest change.
    fn images_of_part(&self, members: &Members, part: &[usize]) -> Result<Vec<f32>> {
        let mut keep = vec![false; members.particles.rows.len()];
        part.iter().for_each(|i| keep[*i] = true);
        let mut alone = members.clone();
        alone.retain(&keep);
        self.images_of(&alone.upload(&self.gpu, &self.joint.setup)?, part.len() as u32)
    }
}
