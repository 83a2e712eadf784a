//! Vessels that are known before any angiogram is read, for example from a CT.

use crate::error::{Error, Result};
use crate::files;
use glam::DVec3;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// File of the prior in a run directory.
pub const PRIOR: &str = "prior.json";
/// Maximum number of points of a prior: a coronary tree has a few hundred at a distance of a mm.
pub const MAX_PRIOR_POINTS: usize = 50_000;
/// Maximum size of that file.
const MAX_BYTES: u64 = 1 << 28;

/// Points of vessels in the patient, as a tree or a volume states them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct VesselPrior {
    /// Points in patient mm (LPS, with the isocentre at the origin), `[shape][point]`. Several shapes are at equal fractions of the
    /// beat; a single one counts for all of it.
    pub shapes_mm: Vec<Vec<[f64; 3]>>,
}

impl VesselPrior {
    /// Points at the shape nearest to a fraction of the beat, patient mm (LPS).
    pub fn at(&self, fraction: f64) -> Vec<DVec3> {
        let shapes = self.shapes_mm.len().max(1);
        let nearest = (fraction * shapes as f64).round() as usize % shapes;
        self.shapes_mm.get(nearest).into_iter().flatten().map(|point| DVec3::from_array(*point)).collect()
    }

    /// Checks that there are points, and that all coordinates are finite.
    ///
    /// # Errors
    /// [`Error::Config`].
    pub fn check(&self) -> Result<()> {
        let points = || self.shapes_mm.iter().flatten();
        if points().next().is_none() {
            return Err(Error::config("prior", "no point", "states no vessel"));
        }
        match points().position(|point| point.iter().any(|value| !value.is_finite())) {
            Some(at) => Err(Error::config("prior", format!("point {at}"), "has a coordinate that is not finite")),
            None => Ok(()),
        }
    }

    /// Writes the prior into a run directory.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, run: &Path) -> Result<()> {
        let json = serde_json::to_string(self).map_err(|e| Error::Internal(e.to_string()))?;
        Ok(files::write_atomic(&run.join(PRIOR), json.as_bytes())?)
    }

    /// Reads the prior of a run; `None` where the run has none.
    ///
    /// # Errors
    /// [`Error::Io`] or [`Error::Data`].
    pub fn read(run: &Path) -> Result<Option<VesselPrior>> {
        let file = run.join(PRIOR);
        if !file.is_file() {
            return Ok(None);
        }
        let prior: VesselPrior = files::read_json(&file, MAX_BYTES)?;
        if prior.shapes_mm.iter().flatten().flatten().any(|value| !value.is_finite()) {
            return Err(Error::data(&file, "shapes_mm", "contains a coordinate that is not finite"));
        }
        Ok(Some(prior))
    }
}
