//! Numbers of a fit of Gaussians: settings of users, values that a fit of a kind changes, and constants.
//!
//! Lengths are in pixels at the isocentre for images whose smaller side has 100 pixels, until [`Lengths`] adapts them to the images at hand;
//! line integrals are shares of the views' strongest change. All numbers were tuned on the default phantom; `docs/tried.md` holds the
//! measurements of [`FAINT`], `link` and `smoothness`. Those of the other numbers were not kept, so a change of them needs measurements of
//! its own.
//!
//! [`Lengths`]: crate::methods::dynamic_gaussians::targets::lengths::Lengths

use crate::config::sections::{GaussiansSettings, LeftOut, Train};
use crate::config::{CatheterChoice, Config, GaussianForm};

/// Adam's rate of natural log-scales, per iteration.
pub const SCALE_RATE: f64 = 0.03;
/// Adam's rate of the numbers of quaternions, per iteration.
pub const ROTATION_RATE: f64 = 0.03;
/// Adam's rate of natural log-densities, per iteration.
pub const DENSITY_RATE: f64 = 0.08;
/// Share of the iterations, at the end, over which rates fall.
pub const FALL_SHARE: f64 = 0.3;
/// Final learning rates, as a share of their initial values.
pub const LAST_RATE: f64 = 0.05;
/// Residual at which the loss changes from quadratic to linear, a share of the strongest change.
pub const BEND: f64 = 0.05;
/// Noise, a share of the strongest change, at which the weight of a pixel is 0.7.
pub const NOISE_SCALE: f64 = 0.05;
/// Density below which a Gaussian is too faint for a vessel, as a share of the vessels' density.
pub const FAINT: f64 = 0.2;
/// Minimum missing line integral at which a Gaussian is seeded, a share of the strongest change; also its initial density.
pub const MISSING: f64 = 0.03;
/// Minimum amplitude at which a Gaussian of the rest phase is taken into the deformable set, a share of the strongest change.
pub const TAKE: f64 = 0.03;
/// Harmonics of a Gaussian's own motion.
pub const HARMONICS: u32 = 4;

/// Numbers of a fit of Gaussians.
#[derive(Debug, Clone, PartialEq)]
pub struct Rules {
    /// Seed of all random choices.
    pub seed: u32,
    /// The training loop.
    pub train: Train,
    /// Form of the Gaussians.
    pub form: GaussianForm,
    /// Number of fits whose mean is the dynamic field; 0 = as many as the data ask for.
    pub fits: u32,
    /// Treatment of a catheter.
    pub catheter: CatheterChoice,
    /// A set of Gaussians.
    pub gaussians: GaussianRules,
    /// One set that moves.
    pub deformable: DeformableRules,
}

/// Numbers of a set of Gaussians.
#[derive(Debug, Clone, PartialEq)]
pub struct GaussianRules {
    /// Iterations, each over all images.
    pub iterations: u32,
    /// Gaussians seeded per phase.
    pub count: u32,
    /// Initial scale.
    pub first_scale: f64,
    /// Minimum scale; noise raises it by up to half where vessels are wide enough.
    pub min_scale: f64,
    /// Maximum scale.
    pub max_scale: f64,
    /// Adam's rate of positions.
    pub position_rate: f64,
    /// Number of standard deviations at which a Gaussian is cut off.
    pub cut: f64,
    /// Iteration at which weak Gaussians are pruned and new ones are seeded where line integrals are missing; 0 = never.
    pub grow_at: u32,
    /// New Gaussians per phase, as a share of `count`.
    pub grow_share: f64,
    /// Amplitude threshold below which a Gaussian is pruned.
    pub prune_threshold: f64,
    /// Iteration at which Gaussians too faint for vessels are pruned, since they represent other moving structures; 0 = never.
    pub clear_at: u32,
    /// Distance within which Gaussians belong to one vessel. Broad isolated Gaussians are pruned after all iterations; 0 = never.
    pub link: f64,
    /// Interval, in iterations, at which the static background is estimated again from the images minus the Gaussians; not while
    /// rates fall; 0 = never.
    pub background_every: u32,
    /// Rules that are left out.
    pub left_out: LeftOut,
}

/// Numbers of one set that moves.
#[derive(Debug, Clone, PartialEq)]
pub struct DeformableRules {
    /// Iterations that fit a set per phase, before the deformable set is made from one of these sets.
    pub warm_iterations: u32,
    /// Distance between nodes of the displacement grid.
    pub node: f64,
    /// Adam's rate of displacements.
    pub grid_rate: f64,
    /// Penalty on squared differences of neighbouring nodes.
    pub smoothness: f64,
    /// Adam's rate of the Gaussians' own motion.
    pub own_rate: f64,
    /// Penalty on squared own motion.
    pub own_penalty: f64,
    /// Blur of images and Gaussians while the grid is tracked.
    pub track_blur: f64,
    /// Adam's rate of displacements while they are tracked.
    pub track_rate: f64,
    /// Iterations per tracked phase.
    pub track_iterations: u32,
}

impl Rules {
    /// Returns the numbers of a run.
    pub fn of(config: &Config<GaussiansSettings>) -> Rules {
        let (gaussians, deformable) = (&config.gaussians, &config.deformable);
        Rules {
            seed: config.seed,
            train: config.train.clone(),
            form: gaussians.form,
            fits: gaussians.fits,
            catheter: gaussians.catheter,
            gaussians: GaussianRules {
                iterations: gaussians.iterations,
                count: gaussians.count,
                first_scale: 0.8,
                min_scale: 0.4,
                max_scale: 3.0,
                position_rate: 0.05,
                cut: 3.2,
                grow_at: gaussians.grow_at,
                grow_share: 0.15,
                prune_threshold: 0.01,
                clear_at: gaussians.clear_at,
                link: 4.0,
                background_every: gaussians.background_every,
                left_out: gaussians.without_rules.clone(),
            },
            deformable: DeformableRules {
                warm_iterations: deformable.warm_iterations,
                node: 18.0,
                grid_rate: 0.03,
                smoothness: 0.002,
                own_rate: 0.02,
                own_penalty: 0.3,
                track_blur: 1.5,
                track_rate: 0.25,
                track_iterations: deformable.track_iterations,
            },
        }
    }

    /// Returns the number of iterations at the start of a run that fit Gaussians; the others fit the static field.
    pub fn gaussian_iterations(&self) -> u32 {
        self.gaussians.iterations.min(self.train.iterations)
    }
}
