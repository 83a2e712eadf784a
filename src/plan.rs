//! Builds everything a run needs from a dataset and a configuration, in the device's terms: scales, boxes, hull, backgrounds,
//! ray lists, schedule. Pure host code; both the engine and its CPU twin start here.

pub mod carve;
pub mod changes;
pub mod fit;
pub mod lengths;
pub mod motion;
pub mod remainder;
pub mod scale;
pub mod seeds;
pub mod soft_hull;
pub mod start;
pub mod targets;

use crate::config::method::MethodKind;
use crate::config::{Config, DynamicTarget, GaussianForm};
use crate::error::{Error, Result};
use crate::fitting::extent::between_phases;
use crate::fitting::fit::FitData;
use crate::kernels::layout::{self, Setup};
use crate::methods;
use crate::model::hull::Hull;
use crate::model::params::ParamMap;
use crate::model::scene::Scene;
use crate::plan::motion::ViewMotion;
use crate::plan::scale::dynamic_half;
use crate::plan::soft_hull::carve::SoftMotion;
use crate::plan::start::StartRays;
use crate::plan::targets::Targets;
use crate::scan::dataset::Dataset;

/// Prepared run, ready to start.
pub struct Plan {
    /// The configuration it came from.
    pub config: Config,
    /// Scales and boxes.
    pub scene: Scene,
    /// Constants for the shaders.
    pub setup: Setup,
    /// Location of each parameter.
    pub params: ParamMap,
    /// One row per iteration.
    pub schedule: Vec<layout::Schedule>,
    /// Training views.
    pub views: Vec<layout::View>,
    /// Training frames.
    pub frames: Vec<layout::Frame>,
    /// Line integrals of all training frames.
    pub images: Vec<f32>,
    /// Bounds of the static background of each pixel of each view.
    pub backgrounds: Vec<[f32; 2]>,
    /// Change of each pixel of each view over the beat where two networks are the fields; else empty.
    pub pixel_changes: Vec<f32>,
    /// Listed rays as frame * pixels + pixel. With a hull: first the rays that meet it, then, if some pixels are hidden, all
    /// rays that are not hidden. With two networks: first the rays that change over the beat, then the other rays that are not
    /// hidden.
    pub listed_rays: Vec<u32>,
    /// Motion hull, if it is used.
    pub hull: Option<Hull>,
    /// Targets of the Gaussians, where they are the dynamic field and follow the beat.
    pub targets: Option<Targets>,
    /// Fit data of a method of [`crate::methods`]; `None` for all other methods.
    pub fit: Option<Box<dyn FitData>>,
    /// Weighted loss of an empty dynamic field, where a network is the dynamic field and the target is temporal.
    pub empty_loss: Option<f64>,
    /// Decisions that the user should know.
    pub notes: Vec<String>,
}

impl Plan {
    /// Prepares a run.
    ///
    /// # Errors
    /// [`Error::Config`] when the dataset and the configuration do not fit.
    pub fn new(config: &Config, dataset: &Dataset) -> Result<Plan> {
        let mut notes = Vec::new();
        let motion = motion::analyse(dataset, &config.hull);
        let mut fit = None;
        let (hull, targets) = if let Some(method) = methods::of(config) {
            fit = Some(method.plan(config, dataset, &mut notes)?);
            (None, None)
        } else if config.method() == MethodKind::Gaussians {
            let (hull, targets) = plan_gaussians(config, dataset, &mut notes)?;
            (Some(hull), Some(targets))
        } else {
            if dataset.heart_shifts() {
                notes.push(
                    "the network uses one geometry for all frames of a view: the stated displacements of the heart are \
                     ignored".into(),
                );
            }
            notes.extend(between_phases(dataset, "are trained at their own time"));
            (choose_hull(config, dataset, &motion, &mut notes), None)
        };
        let mut scene = Scene::new(config, dataset, &motion, hull.as_ref())?;
        let compared = targets.is_none() && config.loss.dynamic_target == DynamicTarget::Temporal;
        let rays = compared.then(|| StartRays::new(config, dataset, &motion, hull.as_ref(), scene.dynamic_depth));
        if let Some(rays) = rays.as_ref().filter(|_| config.loss.normalise && config.dynamic.best_start) {
            scene.dynamic_shift = rays.best_shift(scene.dynamic_gain, scene.robust_scale);
        }
        let empty_loss = rays.map(|rays| scene.dynamic_weight * rays.empty_loss(scene.robust_scale));
        let pixels = dataset.n_pixels();
        let training = dataset.training();
        let n_all = training.len() * pixels;
        if n_all > (1 << 30) {
            return Err(Error::config("dataset", n_all, "at most 2^30 training pixels are supported"));
        }
        let mut views = Vec::new();
        let mut backgrounds = Vec::with_capacity(motion.len() * pixels);
        let mut slot_of_view = vec![u32::MAX; dataset.views.len()];
        for (slot, m) in motion.iter().enumerate() {
            slot_of_view[m.view] = slot as u32;
            views.push(layout::View::of(&dataset.views[m.view].rays));
            backgrounds.extend(m.background_low.iter().zip(&m.background).map(|(low, high)| [*low, *high]));
        }
        let mut frames = Vec::with_capacity(training.len());
        let mut images = Vec::with_capacity(n_all);
        let mut listed_rays = Vec::new();
        for (index, frame) in training.iter().enumerate() {
            let (slot, taken) = (slot_of_view[frame.view], frame.beat_time());
            frames.push(layout::Frame {
                view: slot,
                phase: frame.phase,
                beyond: taken.beyond(dataset.n_phases),
                beyond_share: taken.after_phase.abs() as f32,
                image_offset: (index * pixels) as u32,
                background_offset: slot * pixels as u32,
            });
            images.extend_from_slice(&frame.integrals);
            if hull.is_some() {
                let m = &motion[slot as usize];
                let moving = if config.hull.per_phase { &m.moving_at[frame.phase as usize] } else { &m.moving };
                let shown = (0..pixels).filter(|p| moving[*p] && dataset.shows(frame.view, *p));
                listed_rays.extend(shown.map(|p| (index * pixels + p) as u32));
            }
        }
        let mut n_motion_list = listed_rays.len();
        let mut pixel_changes = Vec::new();
        if config.method() == MethodKind::TwoNetworks {
            let changes = changes::of_views(dataset, &motion);
            (listed_rays, n_motion_list) = changes::rays(dataset, &motion, &changes, config.networks.least_change);
            pixel_changes = changes.concat();
            notes.extend(two_networks(config, n_motion_list as f64 / n_all as f64));
        } else if !dataset.hidden.is_empty() {
            let shown = |id: &usize| dataset.shows(training[id / pixels].view, id % pixels);
            listed_rays.extend((0..n_all).filter(shown).map(|id| id as u32));
        }
        if compared && motion.iter().any(|m| m.n_phases < 2) {
            let problem = "needs several phases in every view; use `absolute` for static objects, and where the C-arm \
                           or the table moves";
            return Err(Error::config("loss.dynamic_target", "temporal", problem));
        }
        let params = ParamMap::new(config, dataset.n_phases as usize);
        let n_motion_rays = if n_motion_list == 0 {
            0
        } else {
            (f64::from(config.train.rays) * config.train.motion_share).round() as u32
        };
        let mut setup = scene.setup(config, &params, hull.as_ref());
        setup.n_motion_rays = n_motion_rays;
        setup.n_motion_list = n_motion_list as u32;
        setup.n_shown_list = (listed_rays.len() - n_motion_list) as u32;
        setup.n_all_rays = n_all as u32;
        setup.n_pixels = pixels as u32;
        setup.image_width = dataset.width as u32;
        let schedule = config.schedule_table();
        Ok(Plan {
            config: config.clone(),
            scene,
            setup,
            params,
            schedule,
            views,
            frames,
            images,
            backgrounds,
            pixel_changes,
            listed_rays,
            hull,
            targets,
            fit,
            empty_loss,
            notes,
        })
    }

    /// Returns this plan in a known scene, for example when resuming.
    pub fn in_scene(self, scene: Scene) -> Plan {
        let setup = Setup {
            n_motion_rays: self.setup.n_motion_rays,
            n_motion_list: self.setup.n_motion_list,
            n_shown_list: self.setup.n_shown_list,
            n_all_rays: self.setup.n_all_rays,
            n_pixels: self.setup.n_pixels,
            image_width: self.setup.image_width,
            ..scene.setup(&self.config, &self.params, self.hull.as_ref())
        };
        Plan { scene, setup, ..self }
    }
}

/// Cells along each axis of the soft hull that Gaussians are seeded in.
const SOFT_HULL_CELLS: usize = 112;

/// Computes where vessels may be, and the targets that Gaussians are fitted to.
fn plan_gaussians(config: &Config, dataset: &Dataset, notes: &mut Vec<String>) -> Result<(Hull, Targets)> {
    let soft = SoftMotion::new(dataset, dynamic_half(config, dataset), SOFT_HULL_CELLS);
    let targets = Targets::new(dataset, &soft, &config.gaussians)?;
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
    notes.push(match form {
        GaussianForm::Deformable => match targets.rest_phase {
            0 => "one deformable set of Gaussians is fitted to all phases (gaussians.form = \"deformable\")".into(),
            phase => format!(
                "one deformable set of Gaussians is fitted to all phases (gaussians.form = \"deformable\"), starting from \
                 phase {phase}, which shows more of the vessels than phase 0"
            ),
        },
        _ if targets.contrast_comes_and_goes() => {
            "each phase has its own set of Gaussians (gaussians.form = \"phase\"), because contrast agent flows in or \
             out during the beat"
                .into()
        }
        _ => "each phase has its own set of Gaussians (gaussians.form = \"phase\")".into(),
    });
    Ok((soft.hull.to_hull(), targets))
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

/// Returns the notes on two networks; a `share` of the rays changes over the beat.
fn two_networks(config: &Config, share: f64) -> [String; 2] {
    let near = config.dynamic.occlusion_share;
    [
        format!(
            "both fields are networks, without a box and without a hull; {:.1} % of the rays change over the beat",
            100.0 * share
        ),
        if near >= 1.0 {
            "the dynamic field is kept small along whole rays, as NeRF-CA's code does (dynamic.occlusion_share = 1)"
                .into()
        } else {
            format!(
                "the dynamic field is kept small along the first {:.0} % of each ray, at the source \
                 (dynamic.occlusion_share)",
                100.0 * near
            )
        },
    ]
}

fn choose_hull(config: &Config, dataset: &Dataset, motion: &[ViewMotion], notes: &mut Vec<String>) -> Option<Hull> {
    if !config.hull.enabled {
        return None;
    }
    let single_phase: Vec<_> = motion.iter().filter(|m| m.n_phases < 2).map(|m| m.view).collect();
    if !single_phase.is_empty() {
        notes.push(format!("the motion hull is not used: views {single_phase:?} have a single phase"));
        return None;
    }
    let hull = carve::carve(
        dataset,
        motion,
        dynamic_half(config, dataset),
        config.hull.resolution as usize,
        config.hull.per_phase,
    );
    let share = hull.share();
    if share == 0.0 {
        notes.push("the motion hull is not used: at no point is there motion in all views that see it".into());
        None
    } else if share > config.hull.max_share {
        notes.push(format!(
            "the motion hull is not used: it would keep {:.0} % of the box, and hull.max_share is {:.0} %",
            100.0 * share,
            100.0 * config.hull.max_share
        ));
        None
    } else {
        notes.push(format!("the motion hull keeps {:.3} % of the box", 100.0 * share));
        Some(hull)
    }
}
