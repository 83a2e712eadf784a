//! Freedom of the motion of a deformable set, by the number of views, and whether images are noisy.

use crate::config::sections::Rule;
use crate::evidence::noise::NOISY;
use crate::methods::dynamic_gaussians::rules::DeformableRules;
use crate::methods::dynamic_gaussians::targets::Targets;

/// Number of views up to which the motion is stiff: with free motion, false crossings of two views' rays explain the images of all
/// phases. Three noisy views lose Dice by stiff motion (docs/tried.md).
const FEW_VIEWS: usize = 2;
/// Minimum penalty on squared differences of neighbouring nodes in stiff motion. Chosen among 0.005, 0.02, 0.05 and 0.2 with two views
/// (docs/tried.md).
const STIFF_SMOOTHNESS: f64 = 0.02;

impl Targets {
    /// Tells whether noise is so strong that a fit explains much of it.
    pub fn is_noisy(&self) -> bool {
        self.noise.median() >= NOISY
    }

    /// Tells whether the motion of a deformable set is limited to that of a smooth grid.
    pub fn needs_stiff_motion(&self) -> bool {
        self.n_views <= FEW_VIEWS && self.left_out.keeps(Rule::StiffMotion)
    }

    /// Returns the settings of a deformable set with lengths in pixels of the images and the freedom of motion that the views allow.
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
    fn motion_is_stiff_with_two_views() {
        let settings = rules().deformable;
        let of = |n_views: usize, settings: &DeformableRules| {
            let got = targets(&vec![0.0; n_views * PHASES * SIDE * SIDE], n_views).deformable(settings);
            (got.own_rate, got.smoothness)
        };
        let free = (settings.own_rate, settings.smoothness);
        for (n_views, expected) in [(1, (0.0, STIFF_SMOOTHNESS)), (2, (0.0, STIFF_SMOOTHNESS)), (3, free), (4, free)] {
            assert_eq!(of(n_views, &settings), expected, "{n_views} views");
        }
        let smoother = DeformableRules { smoothness: 0.5, ..settings };
        assert_eq!(of(1, &smoother).1, 0.5, "a smoother setting stays");
    }
}
