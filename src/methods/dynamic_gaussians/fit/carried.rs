//! Judges whether a fit goes on from a deformable set that was fitted before frames were added, or geometry stated anew, instead of
//! beginning from seeds.

use crate::error::Result;
use crate::gaussians::field::MovingGaussians;
use crate::methods::dynamic_gaussians::deformable::DeformableTrainer;
use crate::methods::dynamic_gaussians::rules::Rules;
use crate::methods::dynamic_gaussians::setup;
use crate::methods::dynamic_gaussians::targets::Targets;

/// Minimum share of the images of each view and phase that an earlier deformable set must explain to be carried over.
const MIN_EXPLAINED: f64 = 0.7;

/// Tells whether a fit can go on from an earlier deformable set: whether it has the same phases and views and the same shape, and whether
/// iterations are left to go on with.
pub(super) fn can_go_on(targets: &Targets, config: &Rules, earlier: &MovingGaussians) -> bool {
    let (was, phases_alike) = (&earlier.rest.setup, earlier.rest.n_phases == targets.n_phases);
    let rests_alike = earlier.setup.rest_phase as usize == targets.rest_phase;
    let has_room = setup::carried_step(&config.gaussians) < config.gaussian_iterations();
    // An additional view tells more than a fit that was done without it can take in.
    let seen_alike = was.n_views as usize == targets.n_views;
    let shape = setup::deformable_setup(targets, &targets.deformable(&config.deformable));
    phases_alike && rests_alike && seen_alike && has_room && shape.n_basis == earlier.setup.n_basis
}

/// Tells whether a fit that goes on from an earlier deformable set explains most of every view and phase.
///
/// # Errors
/// Device errors.
pub(super) fn explains_all(trainer: &DeformableTrainer) -> Result<bool> {
    let explained = min_explained(trainer.targets(), &trainer.images()?).unwrap_or(0.0);
    let percent = 100.0 * explained;
    if explained < MIN_EXPLAINED {
        tracing::info!(
            "Gaussians are fitted from the start, because the earlier ones explain only {percent:.0} % of some view or \
             phase"
        );
    } else {
        tracing::info!(
            "the fit continues from the earlier Gaussians, which explain at least {percent:.0} % of every view and phase"
        );
    }
    Ok(explained >= MIN_EXPLAINED)
}

/// Share of what vessels are known to add to the images that a field explains: the minimum over all views and phases; none
/// where nothing is known. `drawn` is `[image][pixel]`, shares of the strongest change.
fn min_explained(targets: &Targets, drawn: &[f32]) -> Option<f64> {
    let shares = |images: &mut dyn Iterator<Item = usize>| -> Option<f64> {
        let (mut explained, mut there) = (0.0, 0.0);
        for pixel in images.flat_map(|image| targets.pixels_that_stand_out(image)) {
            explained += f64::from(drawn[pixel].min(targets.low[pixel]));
            there += f64::from(targets.low[pixel]);
        }
        (there > 0.0).then(|| explained / there)
    };
    let of_phase = |phase: usize| shares(&mut targets.views_at(phase).map(|(image, _)| image));
    let of_view =
        |view: usize| shares(&mut targets.image_of.iter().skip(view).step_by(targets.n_views).flatten().copied());
    let all = (0..targets.n_phases).filter_map(of_phase).chain((0..targets.n_views).filter_map(of_view));
    all.reduce(f64::min)
}
