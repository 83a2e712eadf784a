//! Prepares the views of a dataset for a fit: they are calibrated, then adjusted with the field in the loop. Runs, sessions and the command
//! `calibrate` share these steps. [`Dataset::corrected`] applies the result; a plan ([`crate::plan::Plan`]) and a trainer
//! ([`crate::train::trainer::Trainer`]) follow.

use crate::calibrate::correction::Calibration;
use crate::calibrate::settings::CalibrateSettings;
use crate::calibrate::{adjusted, calibrate};
use crate::config::Config;
use crate::error::Result;
use crate::fitting::fit::{AdjustTask, AdjustedFit, MadeFit, Observe};
use crate::gpu::device::Gpu;
use crate::methods;
use crate::scan::dataset::Dataset;

/// Corrections of the views of a dataset.
pub struct Prepared {
    /// Corrections of the geometry as stated, and how they were found.
    pub calibration: Calibration,
    /// Fit to the corrected views that their adjustment has left.
    pub made: Option<MadeFit>,
}

impl Prepared {
    /// Takes corrections that are known.
    pub fn known(calibration: Calibration) -> Prepared {
        Prepared { calibration, made: None }
    }

    /// Calibrates the views of a dataset with the geometry as stated.
    ///
    /// # Errors
    /// Errors of [`calibrate`].
    pub fn calibrated(stated: &Dataset, settings: CalibrateSettings) -> Result<Prepared> {
        Ok(Prepared::known(calibrate(stated, settings)?))
    }

    /// Adjusts calibrated views with the field in the loop, where the method of the configuration can do so and the data ask for it.
    /// `observe` receives the share that is done, and may end the adjustment by an error.
    ///
    /// # Errors
    /// Errors of `observe`; device errors.
    pub fn adjusted(self, gpu: &Gpu, config: &Config, stated: &Dataset, observe: &mut Observe<'_>) -> Result<Prepared> {
        let Some(adjust) = methods::of(config).abilities.adjust_views else { return Ok(self) };
        let task = AdjustTask { gpu, config, dataset: stated, calibration: &self.calibration };
        let Some(AdjustedFit { adjusted: outcome, made }) = adjust(&task, observe)? else { return Ok(self) };
        Ok(Prepared { calibration: adjusted(stated, self.calibration, outcome)?, made })
    }

    /// Tells whether an adjustment has changed the views.
    pub fn are_adjusted(&self) -> bool {
        self.calibration.adjustment.as_ref().is_some_and(|record| record.accepted)
    }
}
