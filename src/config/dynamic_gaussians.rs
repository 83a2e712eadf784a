//! Settings of Gaussians in front of a static tensor field: the preset `fast`.

use crate::calibrate::settings::CalibrateMode;
use crate::config::choices::{AdjustMode, Decay, DynamicTarget, OcclusionRegion};
use crate::config::common::{Calibrate, Render, Train};
use crate::config::fields::{
    Adam, DynamicField, FieldSettings, Loss, March, Occupancy, StaticField, Tensor, check_batches,
};
use crate::config::method::MethodSettings;
use crate::config::section::{section, sections};
use crate::config::{Config, Preset, Shared};
use crate::error::Result;
use serde::{Deserialize, Deserializer, Serialize};
use strum::{IntoStaticStr, VariantArray};

/// Decay of Adam's first and second moments for the static field: the betas of NerT-CA's authors, whose static field it is.
const BETAS: [f64; 2] = [0.9, 0.99];
/// Constant added to the denominator of Adam's update of the static field.
const EPSILON: f64 = 1e-8;

fn one_fit() -> u32 {
    1
}

/// Form of the Gaussians of the preset `fast`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum GaussianForm {
    /// A separate set of Gaussians per phase; the sets share nothing.
    Phase,
    /// One set of Gaussians that moves over the beat.
    #[serde(alias = "tree")]
    Deformable,
    /// `Deformable` where the data allow it, otherwise `Phase`.
    Auto,
}

/// Treatment of a catheter that a fit of the preset `fast` finds in the dynamic field.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum CatheterChoice {
    /// It stays in field, tree and scores: the choice of runs without this setting.
    #[default]
    Keep,
    /// It is left out.
    LeaveOut,
    /// `LeaveOut` where at least two views show that it continues to the border of their images, otherwise `Keep`.
    Auto,
}

/// Reads the treatment of a catheter; in older files it is whether one is left out.
fn catheter_choice<'de, D: Deserializer<'de>>(from: D) -> std::result::Result<CatheterChoice, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged, expecting = "expected keep, leave-out or auto")]
    enum Stated {
        IsLeftOut(bool),
        Choice(CatheterChoice),
    }
    Ok(match Stated::deserialize(from)? {
        Stated::IsLeftOut(true) => CatheterChoice::LeaveOut,
        Stated::IsLeftOut(false) => CatheterChoice::Keep,
        Stated::Choice(choice) => choice,
    })
}

/// A special case of a fit of Gaussians, which a study can leave out to measure what it earns (`studies/rules.toml`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum Rule {
    /// Gaussians far fainter than the vessels are dropped.
    FaintGaussians,
    /// Gaussians have a filling at each phase where contrast comes or goes.
    Fillings,
    /// The mean of several fits is taken where blades hide much of few views.
    FitsBehindBlades,
    /// The mean of several fits is taken where images are noisy.
    FitsInNoise,
    /// Broad Gaussians that are alone are dropped.
    IsolatedGaussians,
    /// Places that two views see are seeded by a regression on what both show, instead of by evidence alone.
    LikelihoodOfTwoViews,
    /// Motion is stiff with two views.
    StiffMotion,
    /// The motion of vessels that contrast does not show is that of other phases.
    UnseenPhases,
}

/// Rules that are left out.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct LeftOut(pub Vec<Rule>);

impl LeftOut {
    /// Tells whether a rule applies.
    pub fn keeps(&self, rule: Rule) -> bool {
        !self.0.contains(&rule)
    }
}

section! {
    /// Adjustment of the calibrated views.
    Adjustment, "calibrate" {
        /// Adjustment of angles, positions, breathing and contrasts with the Gaussians in the loop, after the calibration.
        #[serde(default)] adjust: AdjustMode,
    }
}

section! {
    /// Batches of rays of the static field.
    GaussiansRays, "train" {
        /// Rays of a batch.
        rays: u32 in 1.0 to 65_535.0,
    }
}

section! {
    /// Sampling along rays of the static field.
    GaussiansMarch, "march" {
        /// Depths per ray.
        static_samples: u32 in 2.0 to 4096.0,
    }
}

section! {
    /// Place of the Gaussians.
    GaussiansPlace, "dynamic" {
        /// Half side of the box that they are searched in, mm; 0 = the field of view.
        half_extent_mm: f64 in 0.0 to 1e5,
    }
}

section! {
    /// Gaussians as the dynamic field.
    Gaussians, "gaussians" {
        /// Form: "phase" (a set per phase), "deformable" (one set that moves), or "auto".
        form: GaussianForm,
        /// Iterations, each over all images.
        iterations: u32 in 1.0 to 1e6,
        /// Gaussians seeded per phase.
        count: u32 in 1.0 to 1_048_576.0,
        /// Number of fits with different seeds whose mean is the dynamic field; 0 = three where images are noisy, views were adjusted, or
        /// blades hide much of three views, five with two views, else one; 1 is the default for older files without this setting.
        #[serde(default = "one_fit")] fits: u32 in 0.0 to 9.0,
        /// Treatment of a catheter: Gaussians of a deformable set whose motion ends along a line.
        #[serde(default, alias = "without_catheter", deserialize_with = "catheter_choice")] catheter: CatheterChoice,
        /// Rules that are left out, for studies of what each earns, e.g. `["fillings"]`.
        #[serde(default)] without_rules: LeftOut,
    } fixed {
        /// Iteration at which weak Gaussians are pruned and new ones are seeded where line integrals are missing; 0 = never.
        grow_at: u32 in 0.0 to 1e6,
        /// Iteration at which Gaussians too faint for vessels are pruned, since they represent other moving structures; 0 =
        /// never.
        clear_at: u32 in 0.0 to 1e6,
        /// Interval, in iterations, at which the static background is estimated again from the images minus the Gaussians; not
        /// while rates fall; 0 = never.
        background_every: u32 in 0.0 to 1e6,
    }
}

section! {
    /// One set of Gaussians that moves over the beat.
    Deformable, "deformable" {} fixed {
        /// Iterations that fit a set per phase, before the deformable set is made from one of these sets.
        warm_iterations: u32 in 1.0 to 1e6,
        /// Iterations per tracked phase.
        track_iterations: u32 in 0.0 to 1e6,
    }
}

sections! {
    /// Settings of Gaussians in front of a static tensor field.
    GaussiansSettings {
        /// Adjustment of the calibrated views.
        adjustment: Adjustment,
        /// Batches of rays of the static field.
        batch: GaussiansRays,
        /// Sampling along rays of the static field.
        march: GaussiansMarch,
        /// The static field.
        static_field: Tensor,
        /// Place of the Gaussians.
        dynamic: GaussiansPlace,
        /// The Gaussians.
        gaussians: Gaussians,
        /// One set of Gaussians that moves.
        deformable: Deformable,
    }
}

/// Gaussians in front of a static field. Numbers of iterations were tuned on the default phantom; `docs/tried.md` holds the measurement of
/// `clear_at`.
pub(super) fn fast() -> Config<GaussiansSettings> {
    Config {
        preset: Preset::Fast,
        seed: 1,
        train: Train {
            iterations: 300,
            chunk_samples: 524_288,
            // Must divide the numbers of iterations between changes of the number of Gaussians and of the background.
            iterations_per_submit: 10,
            checkpoint_every: 100,
            validate_every: 0,
            stop_at_loss_ratio: 0.0,
        },
        calibrate: Calibrate { mode: CalibrateMode::Auto },
        render: Render { render_samples: 256 },
        method: GaussiansSettings {
            adjustment: Adjustment { adjust: AdjustMode::Auto },
            batch: GaussiansRays { rays: 256 },
            march: GaussiansMarch { static_samples: 32 },
            // Three or four views do not determine how a low-rank field looks from other angles; smoothness does. Few
            // iterations need large steps.
            static_field: Tensor {
                grid: 48,
                ranks: 3,
                half_extent_mm: 0.0,
                lr: 3e-2,
                lr_end: 3e-3,
                decay: Decay::Linear,
                tv: 100.0,
            },
            dynamic: GaussiansPlace { half_extent_mm: 0.0 },
            gaussians: Gaussians {
                form: GaussianForm::Auto,
                iterations: 120,
                count: 500,
                fits: 0,
                catheter: CatheterChoice::Auto,
                without_rules: LeftOut::default(),
                grow_at: 50,
                clear_at: 65,
                background_every: 40,
            },
            deformable: Deformable { warm_iterations: 60, track_iterations: 25 },
        },
    }
}

impl MethodSettings for GaussiansSettings {
    fn name(&self) -> &'static str {
        "Gaussians in front of a tensor field"
    }

    fn check(&self, shared: &Shared<'_>) -> Result<()> {
        self.fields(shared).iter().try_for_each(check_batches)
    }

    /// The fields are the static one alone; where the dynamic field may be, and the scale of what moves, places and scales the
    /// Gaussians as well.
    fn fields(&self, shared: &Shared<'_>) -> Option<FieldSettings> {
        Some(FieldSettings {
            seed: shared.seed,
            train: shared.train.clone(),
            begin: self.gaussian_iterations(shared.train),
            rays: self.batch.rays,
            motion_share: 0.0,
            march: March {
                static_samples: self.march.static_samples,
                dynamic_samples: 2,
                per_ray_depths: true,
                fit_dynamic_range: true,
                fit_static_range: true,
            },
            render_samples: shared.render.render_samples,
            along_axis: false,
            static_field: StaticField::Tensor(self.static_field.clone()),
            network: None,
            dynamic: DynamicField {
                half_extent_mm: self.dynamic.half_extent_mm,
                encode_box: true,
                window_start: 0.0,
                delay: 0,
                normalised_shift: -2.0,
                best_start: false,
                min_slope: 1e-3,
                occlusion: 0.0,
                occlusion_share: 0.2,
                occlusion_region: OcclusionRegion::DepthRange,
            },
            loss: Loss { normalise: true, dynamic_target: DynamicTarget::Temporal, robust: 0.1 },
            has_hull: true,
            occupancy: Occupancy::NONE,
            adam: Adam { beta1: BETAS[0], beta2: BETAS[1], epsilon: EPSILON, decay_share: 1.0 },
            networks: None,
        })
    }

    fn gaussian_iterations(&self, train: &Train) -> u32 {
        self.gaussians.iterations.min(train.iterations)
    }

    fn gaussian_iterations_mut<'a>(&'a mut self, _: &'a mut Train) -> Option<&'a mut u32> {
        Some(&mut self.gaussians.iterations)
    }

    fn follows_breath(&self) -> bool {
        true
    }

    /// A fit of Gaussians has its own number of iterations, which does not scale with the run.
    fn shorten(&mut self, train: &mut Train, iterations: u32, whole: u32) {
        train.iterations = self.gaussians.iterations.saturating_add(iterations).min(whole);
    }
}
