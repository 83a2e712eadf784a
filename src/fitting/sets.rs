//! Parameter sets of static methods on a moving object: a set for each phase, or one for all phases.

use crate::config::StaticData;
use crate::error::{Error, Result};
use crate::fitting::extent::between_phases;
use crate::scan::dataset::{Dataset, Frame};

/// Images of each set of a static method, and the phase of each set if it belongs to one.
pub(crate) type Sets = (Vec<Vec<usize>>, Vec<Option<u32>>);

/// Returns the sets of a static method. `key` is the name of its setting, for messages.
///
/// # Errors
/// [`Error::Config`] where a phase shall have a set and no image shows it.
pub(crate) fn sets_of(dataset: &Dataset, static_data: StaticData, key: &str) -> Result<Sets> {
    let (training, n_phases) = (dataset.training(), dataset.n_phases);
    let of_phase = |phase: u32| (0..training.len()).filter(|i| training[*i].phase == phase).collect::<Vec<_>>();
    let unseen: Vec<u32> = (0..n_phases).filter(|phase| of_phase(*phase).is_empty()).collect();
    if static_data == StaticData::PerPhase && !unseen.is_empty() {
        let problem = format!("no image shows the phases {unseen:?}: set {key} = \"pooled\"");
        return Err(Error::config("dataset", dataset.path.display(), problem));
    }
    Ok(match static_data {
        StaticData::Pooled => (vec![(0..training.len()).collect()], vec![None]),
        StaticData::PerPhase => (0..n_phases).map(|t| (of_phase(t), Some(t))).unzip(),
    })
}

/// Refuses an image with pixels that are not finite, which would spread to all parameters.
///
/// # Errors
/// [`Error::Config`] naming the image and the pixel.
pub(crate) fn check_finite(dataset: &Dataset, frame: &Frame) -> Result<()> {
    let Some(p) = frame.integrals.iter().position(|v| !v.is_finite()) else { return Ok(()) };
    let (column, row) = (p % dataset.width, p / dataset.width);
    let problem = format!("{}: column {column}, row {row} is not a finite number", frame.name);
    Err(Error::config("dataset", dataset.path.display(), problem))
}

/// Returns notes for the user about what a static method, by its name, ignores of a dataset.
pub(crate) fn ignored(dataset: &Dataset, method: &str) -> Vec<String> {
    let mut notes = Vec::new();
    if !dataset.hidden.is_empty() {
        notes.push(format!(
            "pixels that show nothing of the patient are fitted like all others, because {method} does not support masks"
        ));
    }
    if dataset.heart_shifts() {
        notes.push(format!(
            "{method} uses one geometry for all frames of a view: the stated displacements of the heart are ignored"
        ));
    }
    notes.extend(between_phases(dataset, "are used as frames of the nearest phase"));
    notes
}

/// Returns the random seed of a set.
pub fn seed_of_set(seed: u32, set: usize) -> u32 {
    seed.wrapping_add((set as u32).wrapping_mul(0x9e37_79b9))
}
