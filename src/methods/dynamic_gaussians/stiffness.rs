//! Freedom of the motion of a deformable set, by the noise of the images and the number of views.

use crate::config::sections::Deformable;
use crate::methods::dynamic_gaussians::targets::Targets;

/// Number of views up to which the motion is stiff in noise: with few views, free motion explains noise.
const FEW_VIEWS: usize = 3;
/// Noise of the median pixel, as a share of the strongest change, from which on images are noisy: 1e5 photons give 0.10, 2e4
/// photons 0.22.
const NOISY: f32 = 0.15;
/// Number of views up to which the motion is stiff where a prior states the vessels: two views do not tell motion along their rays.
const TWO_VIEWS: usize = 2;
/// Minimum penalty on squared differences of neighbouring nodes in stiff motion.
const STIFF_SMOOTHNESS: f64 = 0.02;

impl Targets {
    /// Tells whether noise is so strong that a fit explains much of it.
    pub fn is_noisy(&self) -> bool {
        self.noise.median() >= NOISY
    }

    /// Tells whether vessels are sought near those of a prior first.
    fn follows_prior(&self) -> bool {
        self.places.iter().flatten().any(|place| place.far_from_prior > 0.0)
    }

    /// Tells whether the motion of a deformable set is limited to that of a smooth grid.
    pub fn needs_stiff_motion(&self) -> bool {
        self.n_views <= FEW_VIEWS && self.is_noisy() || self.n_views <= TWO_VIEWS && self.follows_prior()
    }

    /// Returns the settings of a deformable set with lengths in pixels of the images and the freedom of motion that noise allows.
    pub fn deformable(&self, settings: &Deformable) -> Deformable {
        let settings = self.lengths.deformable(settings);
        if !self.needs_stiff_motion() {
            return settings;
        }
        Deformable { own_rate: 0.0, smoothness: settings.smoothness.max(STIFF_SMOOTHNESS), ..settings }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Preset};
    use crate::methods::dynamic_gaussians::targets::PossibleVessel;
    use crate::methods::dynamic_gaussians::test_targets::{PHASES, SIDE, targets};
    use glam::DVec3;

    #[test]
    fn motion_is_stiff_with_few_noisy_views_and_with_a_prior_of_two() {
        let settings = Config::preset(Preset::Fast).deformable;
        for (n_views, noise, prior, stiff) in [
            (3, 0.2, 0.0, true),
            (3, 0.1, 0.0, false),
            (4, 0.2, 0.0, false),
            (2, 0.2, 0.0, true),
            (2, 0.1, 0.0, false),
            (2, 0.1, 0.5, true),
            (3, 0.1, 0.5, false),
        ] {
            let mut targets = targets(&vec![0.0; n_views * PHASES * SIDE * SIDE], n_views);
            targets.noise.fill(noise);
            let place = PossibleVessel { position: DVec3::ZERO, evidence: 9.0, far_from_prior: prior };
            targets.places = vec![vec![place]; PHASES];
            let got = targets.deformable(&settings);
            let expected = if stiff { (0.0, STIFF_SMOOTHNESS) } else { (settings.own_rate, settings.smoothness) };
            assert_eq!((got.own_rate, got.smoothness), expected, "{n_views} views, noise {noise}, prior {prior}");
        }
        let mut noisy = targets(&vec![0.0; PHASES * SIDE * SIDE], 1);
        noisy.noise.fill(0.2);
        let smoother = Deformable { smoothness: 0.5, ..settings };
        assert_eq!(noisy.deformable(&smoother).smoothness, 0.5, "a smoother setting stays");
    }
}
