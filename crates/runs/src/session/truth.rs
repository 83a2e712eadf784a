//! True vessels that a caller knows, and scores of a session against them and against its frames for validation.

use crate::error::{Error, Result};
use crate::geometry::MM_PER_UNIT;
use crate::scan::gating::BeatTime;
use crate::score::eval::{Evaluation, evaluate, moving_field_warning};
use crate::score::trees::{self, TrueLine};
use crate::score::volume::{MAX_VOXELS, TrueVessels, score_known};
use crate::session::Session;
use crate::session::known::{between, check_lines};
use crate::session::state::lock;
use std::collections::BTreeMap;

impl Session {
    /// Sets which voxels are vessel at a phase, in place of an earlier statement; `None` removes it. [`Session::evaluate`] then
    /// has scores in 3D.
    ///
    /// # Errors
    /// [`Error::Config`] for a phase that does not exist, or a grid that does not fit its voxels or has too many.
    pub fn set_true_vessels(&self, phase: u32, vessels: Option<TrueVessels>) -> Result<()> {
        self.check_phase(phase)?;
        let Some(vessels) = vessels else {
            lock(&self.known).volumes.remove(&phase);
            return Ok(());
        };
        vessels.grid.check()?;
        let voxels = vessels.grid.size.iter().map(|n| u64::from(*n)).product::<u64>();
        if voxels != vessels.inside.len() as u64 {
            let problem = format!("is not the number of voxels of this grid, {voxels}");
            return Err(Error::config("vessels", vessels.inside.len(), problem));
        }
        if voxels > MAX_VOXELS {
            return Err(Error::config(
                "vessels",
                voxels,
                format!("exceeds the maximum number of voxels, {MAX_VOXELS}"),
            ));
        }
        lock(&self.known).volumes.insert(phase, vessels);
        Ok(())
    }

    /// Sets the true centrelines and vessel widths at each phase, in place of an earlier statement. [`Session::evaluate`] then
    /// finds the vessels as trees and scores those; where a line is the same at all phases, point i of it must be the same
    /// material point.
    ///
    /// # Errors
    /// [`Error::Config`] for a phase that does not exist, where phase 0 is missing or phases differ in their lines, and for
    /// invalid lines.
    pub fn set_true_trees(&self, trees: BTreeMap<u32, Vec<TrueLine>>) -> Result<()> {
        trees.keys().try_for_each(|phase| self.check_phase(*phase))?;
        check_lines(&trees)?;
        lock(&self.known).trees = trees;
        Ok(())
    }

    fn check_phase(&self, phase: u32) -> Result<()> {
        let phases = self.phases();
        if phase < phases {
            return Ok(());
        }
        Err(Error::config("phase", phase, format!("is out of range: phases go from 0 to {}", phases.saturating_sub(1))))
    }

    /// Scores the frames that were added for validation, and the reconstruction against the true vessels where these are known,
    /// at their stated places, whatever calibration did to the views. `threshold_per_mm` replaces the rule for the threshold
    /// from which the dynamic field counts as vessel.
    ///
    /// # Errors
    /// [`Error::Data`] without such frames; [`Error::Interrupted`] after [`Session::cancel`]; as [`Session::render`] and
    /// [`Session::trees`].
    pub fn evaluate(&self, threshold_per_mm: Option<f64>) -> Result<Evaluation> {
        let call = self.shared.long_work.begin();
        let dataset = lock(&self.shared.inbox).scored_dataset()?;
        let frames: Vec<_> = dataset.validation().iter().collect();
        let threshold = threshold_per_mm.map(|t| t * MM_PER_UNIT);
        let volumes = lock(&self.known).volumes.clone();
        let mut evaluation = self.shared.with_fields(|live, step| {
            let renderer = live.renderer(step)?;
            let mut evaluation = evaluate(renderer, &dataset, &frames, step, threshold, |_| call.check())?;
            let threshold_per_mm = evaluation.threshold.dynamic_per_mm;
            evaluation.volume = score_known(renderer, live.scene(), &volumes, threshold_per_mm, &dataset)?;
            evaluation.warnings.extend(moving_field_warning(renderer, &dataset)?);
            Ok(evaluation)
        })?;
        let lines = lock(&self.known).trees.clone();
        if !lines.is_empty() {
            // What `tree` finds by itself: its threshold is not that of the images.
            let mut beat = self.trees_during(&call, threshold_per_mm, None)?;
            beat.phases.retain(|tree| lines.contains_key(&tree.phase));
            let at = |moment: f64| between(&lines, BeatTime::of(moment, dataset.n_phases), dataset.n_phases);
            evaluation.tree = Some(trees::score(&beat, &dataset, None, None, at)?);
        }
        evaluation.warnings.iter().for_each(|warning| tracing::warn!("{warning}"));
        Ok(evaluation)
    }
}
