//! Data of a fit: targets of the Gaussians, and the images of the static field behind them.

mod prior;

use crate::config::sections::GaussiansSettings;
use crate::config::{Config, GaussianForm};
use crate::error::{Error, Result};
use crate::fields::data::{FieldData, RayLists};
use crate::fields::motion;
use crate::fields::scale::dynamic_half;
use crate::fitting::extent::between_phases;
use crate::geometry::ViewRays;
use crate::methods::dynamic_gaussians::rules::Rules;
use crate::methods::dynamic_gaussians::soft_hull::carve::SoftMotion;
use crate::methods::dynamic_gaussians::targets::Targets;
use crate::model::hull::Hull;
use crate::model::scene::Scene;
use crate::scan::dataset::{Dataset, Frame};

/// Circumstances of an image.
#[derive(Clone)]
pub struct Shot {
    /// Rays that see the heart.
    pub rays: ViewRays,
    /// Time in the beat, counted in phases.
    pub phases: f64,
    /// Contrast of the vessels, as a multiple of the mean over the frames.
    pub contrast: f32,
}

/// Data of a fit.
#[derive(Clone)]
pub struct GaussianData {
    /// Targets of the Gaussians.
    pub targets: Targets,
    /// Data of the static field.
    pub fields: FieldData,
    /// Circumstances of each training image.
    pub shots: Vec<Shot>,
}

impl GaussianData {
    /// Prepares the data of a fit and appends remarks for the user to `notes`.
    ///
    /// # Errors
    /// [`crate::error::Error::Unmet`] where nothing moves, or too little is known to tell.
    pub fn new(config: &Config, dataset: &Dataset, notes: &mut Vec<String>) -> Result<GaussianData> {
        let settings = config.fields().ok_or_else(|| Error::Internal("the configuration has no fields".into()))?;
        let motion = motion::analyse(dataset, motion::Thresholds::default());
        let (hull, targets) = hull_and_targets(&config.of()?, dataset, notes)?;
        let scene = Scene::new(&settings, dataset, &motion, Some(&hull))?;
        let lists = RayLists::of_hull(dataset, &motion, Some(&hull));
        let fields = FieldData::new(&settings, dataset, &motion, Some(hull), scene, lists)?;
        let shot = |frame: &Frame| Shot {
            rays: dataset.heart_rays(frame),
            phases: frame.beat_time().phases(dataset.n_phases),
            contrast: frame.contrast as f32,
        };
        Ok(GaussianData { targets, fields, shots: dataset.training().iter().map(shot).collect() })
    }
}

/// Cells along each axis of the soft hull that Gaussians are seeded in. On a procedural phantom, 224 cells change Dice by .003.
pub(super) const SOFT_HULL_CELLS: usize = 112;

/// Computes where vessels may be, and the targets that Gaussians are fitted to.
fn hull_and_targets(
    config: &Config<GaussiansSettings>,
    dataset: &Dataset,
    notes: &mut Vec<String>,
) -> Result<(Hull, Targets)> {
    let mut soft = SoftMotion::new(dataset, dynamic_half(config.dynamic.half_extent_mm, dataset), SOFT_HULL_CELLS);
    // Only the hull is made of the ratios, which take as much memory as the images.
    soft.views.iter_mut().for_each(|view| view.ratios.clear());
    let mut targets = Targets::new(dataset, &soft, &Rules::of(config).gaussians)?;
    if let Some(prior) = &dataset.prior {
        notes.push(prior::apply(&mut targets, prior));
    }
    let form = targets.form(config.gaussians.form);
    notes.extend(between_phases(
        dataset,
        match form {
            GaussianForm::Deformable => {
                "are fitted at their own time (at the mean time of the frames that share a phase and a view)"
            }
            _ => "are used as frames of the nearest phase",
        },
    ));
    notes.extend(wide_motion(&soft));
    notes.extend(without_motion(dataset, &soft));
    notes.push(format!("the soft motion hull keeps {:.3} % of the box", 100.0 * soft.hull.share()));
    notes.extend(wide_hull(&soft, dataset));
    notes.extend(idle_iterations(config));
    notes.push(match form {
        GaussianForm::Deformable if targets.contrast_comes_and_goes => format!(
            "one deformable set of Gaussians is fitted to all phases (gaussians.form = \"deformable\"), starting from \
             phase {}, which shows most of the vessels; contrast agent flows in or out during the beat, so each Gaussian \
             has a filling at each phase, and the motion of vessels without contrast is estimated from the others and from \
             other phases",
            targets.rest_phase
        ),
        GaussianForm::Deformable => match targets.rest_phase {
            0 => "one deformable set of Gaussians is fitted to all phases (gaussians.form = \"deformable\")".into(),
            phase => format!(
                "one deformable set of Gaussians is fitted to all phases (gaussians.form = \"deformable\"), starting from \
                 phase {phase}, which shows more of the vessels than phase 0"
            ),
        },
        _ if targets.contrast_comes_and_goes => {
            "each phase has its own set of Gaussians (gaussians.form = \"phase\"), because contrast agent flows in or \
             out during the beat"
                .into()
        }
        _ => "each phase has its own set of Gaussians (gaussians.form = \"phase\")".into(),
    });
    if let (fits, Some(reason)) = targets.fits(config.gaussians.fits) {
        notes
            .push(format!("the Gaussians are the mean of {fits} fits with different seeds, {reason} (gaussians.fits)"));
    }
    Ok((soft.hull.to_hull(), targets))
}

/// Share of the box above which a hull holds much more than vessels, which fill less than a hundredth of a box.
const WIDE_HULL: f64 = 0.02;
/// Side of images, pixels, from which a wide hull makes iterations very slow.
const LARGE_SIDE: usize = 300;

/// Returns a note where the hull holds much more than vessels.
fn wide_hull(soft: &SoftMotion, dataset: &Dataset) -> Option<String> {
    (soft.hull.share() > WIDE_HULL).then(|| {
        let mut note = "that is far more than vessels fill: the views may not show the same object (`check` tells), only two views may \
                        be given, or much more than vessels may move, as where the table was panned (`import --gate-by-images` removes that); each \
                        iteration takes the longer, the more the hull keeps"
            .to_owned();
        if dataset.width.max(dataset.height) > LARGE_SIDE {
            note += "; images of half the width and height take about a quarter of the time";
        }
        note
    })
}

/// Returns a note where more iterations were asked for than usual, without more of them for the vessels.
fn idle_iterations(config: &Config<GaussiansSettings>) -> Option<String> {
    let (all, vessels) = (config.train.iterations, config.gaussians.iterations.min(config.train.iterations));
    let usual = Config::preset(config.preset);
    let as_usual = config.gaussians.iterations <= usual.gaussian_iterations();
    (all > usual.train.iterations && as_usual && vessels < all).then(|| {
        format!(
            "the vessels are fitted in the first {vessels} of the {all} iterations, the others fit the static background only: a \
             higher gaussians.iterations fits the vessels for longer"
        )
    })
}

/// Returns a note on the frames that Gaussians are not fitted to: frames of views with a single phase.
fn without_motion(dataset: &Dataset, soft: &SoftMotion) -> Option<String> {
    let fitted = |view: usize| soft.views.iter().any(|v| v.view == view);
    let left = dataset.training().iter().filter(|frame| !fitted(frame.view)).count();
    (left > 0).then(|| {
        format!(
            "{left} of {} frames are the only phase of their view, e.g. because the C-arm or the table moves: only the \
             static field is fitted to them",
            dataset.training().len()
        )
    })
}

/// Returns a note on the views in which more than vessels moves.
fn wide_motion(soft: &SoftMotion) -> Option<String> {
    let views: Vec<usize> = soft.views.iter().filter(|v| v.background.drift.size().is_some()).map(|v| v.view).collect();
    let what = "wide structures move as well as vessels, e.g. the heart, the diaphragm or the lungs: their motion is \
                removed from the images to which vessels are fitted";
    (!views.is_empty()).then(|| format!("views {views:?}: {what}"))
}
