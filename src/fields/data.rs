//! Data of a fit of fields, in the device's terms: scales, boxes, hull, backgrounds, ray lists, schedule. The device and its f64 twin
//! start here.

use crate::config::DynamicTarget;
use crate::config::fields::FieldSettings;
use crate::error::{Error, Result};
use crate::fields::motion::ViewMotion;
use crate::fields::start::StartRays;
use crate::fitting::fit::PlannedFit;
use crate::kernels::layout::{self, Setup};
use crate::model::hull::Hull;
use crate::model::params::ParamMap;
use crate::model::scene::Scene;
use crate::scan::dataset::{Dataset, Frame};
use crate::scan::pixels::Pixels;

/// Data of a fit of fields.
#[derive(Clone)]
pub struct FieldData {
    /// Settings of the fields.
    pub settings: FieldSettings,
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
    /// Line integrals of each training frame.
    pub images: Vec<Pixels>,
    /// Bounds of the static background of each pixel of each view.
    pub backgrounds: Vec<[f32; 2]>,
    /// Change of each pixel of each view over the beat where rays are chosen by it; else empty.
    pub pixel_changes: Vec<f32>,
    /// Listed rays as frame * pixels + pixel, see [`RayLists`].
    pub listed_rays: Vec<u32>,
    /// Motion hull, if it is used.
    pub hull: Option<Hull>,
    /// Weighted loss of an empty dynamic field, where a network is the dynamic field and the target is temporal.
    pub empty_loss: Option<f64>,
}

/// Rays from which batches are drawn, as frame * pixels + pixel.
#[derive(Debug, Clone, Default)]
pub struct RayLists {
    /// Rays of the motion list, then those of the other list. With a hull, the first ones meet it, and all rays that are not hidden
    /// follow if some pixels are hidden. Where rays are chosen by their change, the first ones change over the beat, and the other
    /// rays that are not hidden follow.
    pub rays: Vec<u32>,
    /// Number of rays of the motion list.
    pub n_motion: usize,
    /// Change of each pixel of each view over the beat where rays are chosen by it; else empty.
    pub pixel_changes: Vec<f32>,
}

impl RayLists {
    /// Lists the rays that meet a hull, if there is one, and all rays that are not hidden, if some are.
    pub fn of_hull(dataset: &Dataset, motion: &[ViewMotion], hull: Option<&Hull>) -> RayLists {
        let (pixels, training) = (dataset.n_pixels(), dataset.training());
        let mut rays = Vec::new();
        if hull.is_some() {
            for (index, frame) in training.iter().enumerate() {
                let Some(m) = motion.iter().find(|m| m.view == frame.view) else { continue };
                let moving = &m.moving_at[frame.phase as usize];
                let shown = (0..pixels).filter(|p| moving[*p] && dataset.shows(frame.view, *p));
                rays.extend(shown.map(|p| (index * pixels + p) as u32));
            }
        }
        let n_motion = rays.len();
        if !dataset.hidden.is_empty() {
            let shown = |id: &usize| dataset.shows(training[id / pixels].view, id % pixels);
            rays.extend((0..training.len() * pixels).filter(shown).map(|id| id as u32));
        }
        RayLists { rays, n_motion, pixel_changes: Vec::new() }
    }
}

impl FieldData {
    /// Collects the data of a fit in a scene.
    ///
    /// # Errors
    /// [`Error::Unmet`] for a temporal target with a single phase.
    pub fn new(
        settings: &FieldSettings,
        dataset: &Dataset,
        motion: &[ViewMotion],
        hull: Option<Hull>,
        mut scene: Scene,
        lists: RayLists,
    ) -> Result<FieldData> {
        let compared = settings.network.is_some() && settings.loss.dynamic_target == DynamicTarget::Temporal;
        let rays = compared
            .then(|| StartRays::new(settings.motion_share, dataset, motion, hull.as_ref(), scene.dynamic_depth));
        if let Some(rays) = rays.as_ref().filter(|_| settings.loss.normalise && settings.dynamic.best_start) {
            scene.dynamic_shift = rays.best_shift(scene.dynamic_gain, scene.robust_scale);
        }
        let empty_loss = rays.map(|rays| scene.dynamic_weight * rays.empty_loss(scene.robust_scale));
        if compared && motion.iter().any(|m| m.n_phases < 2) {
            let problem = "needs several phases in every view; use `absolute` for static objects, and where the C-arm \
                           or the table moves";
            return Err(Error::unmet("loss.dynamic_target", "temporal", problem));
        }
        let (pixels, training) = (dataset.n_pixels(), dataset.training());
        let params = ParamMap::of(Some(settings), dataset.n_phases as usize);
        let setup = Setup {
            n_motion_rays: match lists.n_motion {
                0 => 0,
                _ => (f64::from(settings.rays) * settings.motion_share).round() as u32,
            },
            n_motion_list: lists.n_motion as u32,
            n_shown_list: (lists.rays.len() - lists.n_motion) as u32,
            n_all_rays: (training.len() * pixels) as u32,
            n_pixels: pixels as u32,
            image_width: dataset.width as u32,
            ..scene.setup(settings, &params, hull.as_ref())
        };
        Ok(FieldData {
            settings: settings.clone(),
            scene,
            setup,
            params,
            schedule: settings.schedule_table(),
            views: motion.iter().map(|m| layout::View::of(&dataset.views[m.view].rays)).collect(),
            frames: frames(dataset, motion),
            images: training.iter().map(|frame| frame.integrals.clone()).collect(),
            backgrounds: motion.iter().flat_map(ViewMotion::background_bounds).collect(),
            pixel_changes: lists.pixel_changes,
            listed_rays: lists.rays,
            hull,
            empty_loss,
        })
    }
}

impl From<FieldData> for PlannedFit {
    fn from(data: FieldData) -> PlannedFit {
        let (scene, hull, empty_loss) = (data.scene.clone(), data.hull.clone(), data.empty_loss);
        PlannedFit { scene, hull, empty_loss, data: Box::new(data) }
    }
}

/// Returns the training frames. Views are numbered as in `motion`.
fn frames(dataset: &Dataset, motion: &[ViewMotion]) -> Vec<layout::Frame> {
    let pixels = dataset.n_pixels();
    let slot = |view: usize| motion.iter().position(|m| m.view == view).map_or(u32::MAX, |slot| slot as u32);
    let frame = |frame: &Frame| {
        let (view, taken) = (slot(frame.view), frame.beat_time());
        layout::Frame {
            view,
            phase: frame.phase,
            beyond: taken.beyond(dataset.n_phases),
            beyond_share: taken.after_phase.abs() as f32,
            // Follows from the limits of the device.
            image_offset: 0,
            background_offset: view * pixels as u32,
        }
    };
    dataset.training().iter().map(frame).collect()
}

/// Returns a note on displacements of the heart, which fields ignore, if the dataset states some.
pub fn heart_shifts_ignored(dataset: &Dataset) -> Option<String> {
    dataset.heart_shifts().then(|| {
        "the network uses one geometry for all frames of a view: the stated displacements of the heart are ignored"
            .into()
    })
}
