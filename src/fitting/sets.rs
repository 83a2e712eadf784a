//! Parameter sets of static methods on a moving object: a set for each phase, or one for all phases.

use crate::config::StaticData;
use crate::error::{Error, Result};
use crate::fitting::extent::between_phases;
use crate::random::{STREAM_SET_IMAGE, permute};
use crate::scan::dataset::{Dataset, Frame};

/// Images of each parameter set of a static method.
#[derive(Debug, Clone)]
pub struct Sets {
    images: Vec<Vec<usize>>,
    /// Phase of each set; none of a set for all phases.
    phases: Vec<Option<u32>>,
}

impl Sets {
    /// Returns the sets of a static method. `key` is the name of its setting, for messages.
    ///
    /// # Errors
    /// [`Error::Unmet`] where a phase needs a set and no image shows it.
    pub(crate) fn of(dataset: &Dataset, static_data: StaticData, key: &str) -> Result<Sets> {
        let training = dataset.training();
        let of_phase = |phase: u32| (0..training.len()).filter(|i| training[*i].phase == phase).collect::<Vec<_>>();
        if static_data == StaticData::Pooled {
            return Ok(Sets { images: vec![(0..training.len()).collect()], phases: vec![None] });
        }
        let sets = Sets::per_phase((0..dataset.n_phases).map(of_phase).collect());
        let unseen: Vec<usize> = (0..sets.len()).filter(|phase| sets.images[*phase].is_empty()).collect();
        if !unseen.is_empty() {
            let problem = format!("no image shows the phases {unseen:?}: set {key} = \"pooled\"");
            return Err(Error::unmet("dataset", dataset.path.display(), problem));
        }
        Ok(sets)
    }

    /// Returns one set per phase, from the images of each phase.
    pub(crate) fn per_phase(images: Vec<Vec<usize>>) -> Sets {
        let phases = (0..images.len() as u32).map(Some).collect();
        Sets { images, phases }
    }

    /// Returns the number of sets, which is at least one.
    #[expect(clippy::len_without_is_empty, reason = "a static method has at least one set")]
    pub fn len(&self) -> usize {
        self.images.len()
    }

    /// Returns the images of a set.
    pub fn images(&self, set: usize) -> &[usize] {
        &self.images[set]
    }

    /// Returns the name of a set in messages.
    pub(crate) fn name(&self, set: usize) -> String {
        self.phases[set].map_or("all phases".into(), |phase| format!("phase {phase}"))
    }

    /// Returns the image of a set in iteration `step`. The order of the images is drawn anew when all have been shown; `seed` is
    /// the seed of the set.
    pub(crate) fn image_of_turn(&self, set: usize, seed: u32, step: u32) -> u32 {
        let images = self.images(set);
        let n = images.len() as u32;
        images[permute(step % n, n, seed, step / n, STREAM_SET_IMAGE) as usize] as u32
    }

    /// Returns the index and the phase of each Gaussian of a field of `n_phases` phases, from the set of each fitted Gaussian: a
    /// Gaussian of a set for all phases belongs to every phase.
    pub(crate) fn gaussians_of_phases(
        &self,
        sets: impl Iterator<Item = u32> + Clone,
        n_phases: usize,
    ) -> Vec<(usize, u32)> {
        if self.phases.first() == Some(&None) {
            return (0..n_phases as u32).flat_map(|phase| (0..sets.clone().count()).map(move |i| (i, phase))).collect();
        }
        sets.enumerate().filter_map(|(i, set)| Some((i, self.phases[set as usize]?))).collect()
    }
}

/// Refuses images of several sizes. `method` is the name of the method, for the message.
///
/// # Errors
/// [`Error::Config`] naming the dataset.
pub(crate) fn check_sizes(dataset: &Dataset, method: &str) -> Result<()> {
    if dataset.sizes().len() <= 1 {
        return Ok(());
    }
    let problem =
        format!("{method} needs images of equal size, and these images have several sizes: use the preset fast");
    Err(Error::config("dataset", dataset.path.display(), problem))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaussians_of_a_set_for_all_phases_belong_to_every_phase() {
        let sets_of_gaussians = [1, 0, 1].into_iter();
        let per_phase = Sets::per_phase(vec![vec![0], vec![1, 2]]);
        assert_eq!(per_phase.gaussians_of_phases(sets_of_gaussians, 2), [(0, 1), (1, 0), (2, 1)]);
        let pooled = Sets { images: vec![vec![0, 1, 2]], phases: vec![None] };
        assert_eq!(pooled.gaussians_of_phases([0, 0].into_iter(), 2), [(0, 0), (1, 0), (0, 1), (1, 1)]);
        assert_eq!([pooled.name(0), per_phase.name(1)], ["all phases", "phase 1"]);
    }
}
