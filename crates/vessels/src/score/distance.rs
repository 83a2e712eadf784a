//! Distance of the vessels of a run in training from the true ones: one number at one phase, quickly computed.

use crate::calibrate::gauge::RigidMotion;
use crate::error::{Error, Result};
use crate::model::scene::Scene;
use crate::render::renderer::Renderer;
use crate::scan::dataset::Dataset;
use crate::scan::gating::SYSTOLE_SHARE;
use crate::scan::truth::{VOLUMES, truth_file};
use crate::score::shapes::chamfer_mm;
use crate::score::volume::{TrueVessels, on_one_grid, pixel_mm, read};
use crate::vessels::field::VesselField;
use std::path::PathBuf;

/// The true vessels at the phase nearest to the end of systole, where their displacement is largest.
pub struct Distance {
    truth: TrueVessels,
    file: PathBuf,
    phase: u32,
    pixel_mm: f64,
}

impl Distance {
    /// Reads the truth in the dataset's directory; `None` where there is none. Where the reconstruction is `carried`
    /// against the truth, the motion is applied to the truth.
    ///
    /// # Errors
    /// As [`crate::score::volume::score`] for a truth that cannot be used.
    pub fn new(dataset: &Dataset, carried: Option<&RigidMotion>) -> Result<Option<Distance>> {
        let systole = SYSTOLE_SHARE * f64::from(dataset.n_phases);
        let file = |phase: u32| truth_file(&dataset.path.join(VOLUMES), phase);
        let known = (0..dataset.n_phases).filter(|phase| file(*phase).is_file());
        let away = |phase: &u32| (f64::from(*phase) - systole).abs();
        let Some(phase) = known.min_by(|a, b| away(a).total_cmp(&away(b))) else { return Ok(None) };
        let file = file(phase);
        let mut volume = read(&file)?;
        if let Some(motion) = carried {
            volume = volume.carried(&motion.patient_mm(phase as usize));
        }
        Ok(Some(Distance { truth: TrueVessels::new(&volume, dataset), file, phase, pixel_mm: pixel_mm(dataset) }))
    }

    /// Returns the Chamfer distance, mm, of the dynamic field where it exceeds a threshold; `None` where it does not exceed
    /// it anywhere, or where it fills too much of its box to be compared, which can happen during training.
    ///
    /// # Errors
    /// Device errors.
    pub fn chamfer_mm(&self, renderer: &Renderer, scene: &Scene, threshold_per_mm: f64) -> Result<Option<f64>> {
        let Distance { truth, file, phase, pixel_mm } = self;
        let field = VesselField { renderer, scene, phase: *phase, pixel_mm: *pixel_mm, threshold_per_mm };
        match on_one_grid(&field, &field.coarse()?, truth, file) {
            Err(Error::Data { .. }) => Ok(None),
            grid => grid.map(|(_, [truth, ours])| chamfer_mm(&truth, &ours)),
        }
    }
}
