//! Freedom of the motion of a deformable set, by the noise of the images and the number of views.

use crate::config::sections::Rule;
use crate::evidence::noise::NOISY;
use crate::methods::dynamic_gaussians::rules::DeformableRules;
use crate::methods::dynamic_gaussians::targets::Targets;

/// Number of views up to which the motion is stiff in noise: with few views, free motion explains noise.
const FEW_VIEWS: usize = 3;
/// Number of views up to which the motion is stiff without noise as well: with free motion, false crossings of two views' rays explain the
/// images of all phases.
const TWO_VIEWS: usize = 2;
/// Minimum penalty on squared differences of neighbouring nodes in stiff motion.
const STIFF_SMOOTHNESS: f64 = 0.02;

impl Targets {
    /// Tells whether noise is so strong that a fit explains much of it.
    pub fn is_noisy(&self) -> bool {
        self.noise.median() >= NOISY
    }

    /// Tells whether the motion of a deformable set is limited to that of a smooth grid.
    pub fn needs_stiff_motion(&self) -> bool {
        let few = self.n_views <= TWO_VIEWS || self.n_views <= FEW_VIEWS && self.is_noisy();
        few && self.left_out.keeps(Rule::StiffMotion)
    }

    /// Returns the settings of a deformable set with lengths in pixels of the images and the freedom of motion that noise allows.
    pub fn deformable(&self, settings: &DeformableRules) -> DeformableRules {
        let settings = self.lengths.deformable(settings);
        if !self.needs_stiff_motion() {
            return settings;
        }
        DeformableRules { own_rate: 0.0, smoothness: settings.smoothness.max(STIFF_SMOOTHNESS), ..settings }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::dynamic_gaussians::targets::test_targets::rules;
    use crate::methods::dynamic_gaussians::targets::test_targets::{PHASES, SIDE, targets};

    #[test]
    fn motion_is_stiff_with_two_views_and_with_three_noisy_ones() {
        let settings = rules().deformable;
        for (n_views, noise, stiff) in
            [(2, 0.1, true), (2, 0.2, true), (3, 0.1, false), (3, 0.2, true), (4, 0.1, false), (4, 0.2, false)]
        {
            let mut targets = targets(&vec![0.0; n_views * PHASES * SIDE * SIDE], n_views);
            targets.noise.fill(noise);
            let got = targets.deformable(&settings);
            let expected = if stiff { (0.0, STIFF_SMOOTHNESS) } else { (settings.own_rate, settings.smoothness) };
            assert_eq!((got.own_rate, got.smoothness), expected, "{n_views} views, noise {noise}");
        }
        let mut noisy = targets(&vec![0.0; PHASES * SIDE * SIDE], 1);
        noisy.noise.fill(0.2);
        let smoother = DeformableRules { smoothness: 0.5, ..settings };
        assert_eq!(noisy.deformable(&smoother).smoothness, 0.5, "a smoother setting stays");
    }
}
