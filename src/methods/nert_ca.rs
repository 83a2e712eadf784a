//! NerT-CA (Maas et al. 2025), the method of the paper: a static tensor field and a dynamic network with a latent code per cardiac
//! phase, through which rays are marched together.
//!
//! The fit itself is that of [`crate::fields`]; here stand the choices that make it NerT-CA's.

use crate::config::Config;
use crate::config::method::MethodKind;
use crate::error::Result;
use crate::fields::carve::carve;
use crate::fields::data::{self, FieldData, RayLists, heart_shifts_ignored};
use crate::fields::motion::{self, ViewMotion};
use crate::fields::scale::dynamic_half;
use crate::fields::state;
use crate::fitting::extent::between_phases;
use crate::fitting::fit::{Method, PlannedFit, SavedAt, SavedFit};
use crate::gpu::device::Gpu;
use crate::kernels::tuning::Tuning;
use crate::model::hull::Hull;
use crate::model::scene::Scene;
use crate::scan::dataset::Dataset;
use crate::tensors::File;

/// The method, for the registry.
pub struct NertCa;

impl Method for NertCa {
    fn kind(&self) -> MethodKind {
        MethodKind::NertCa
    }

    fn checkpoint_format(&self) -> &'static str {
        state::FORMAT
    }

    fn plan(&self, config: &Config, dataset: &Dataset, notes: &mut Vec<String>) -> Result<PlannedFit> {
        notes.extend(heart_shifts_ignored(dataset));
        notes.extend(between_phases(dataset, "are trained at their own time"));
        let motion = motion::analyse(dataset, &config.hull);
        let hull = choose_hull(config, dataset, &motion, notes);
        let scene = Scene::new(config, dataset, &motion, hull.as_ref())?;
        let lists = RayLists::of_hull(config, dataset, &motion, hull.as_ref());
        let data = FieldData::new(config, dataset, &motion, hull, scene, lists)?;
        Ok(PlannedFit { scene: data.scene.clone(), data: Box::new(data) })
    }

    fn read(&self, sections: &serde_json::Value, config: &Config, at: SavedAt, file: &File<'_>) -> Result<SavedFit> {
        state::read(sections, config, at, file)
    }

    fn rays_per_iteration(&self, config: &Config) -> u32 {
        config.train.rays
    }

    fn lower_rates(&self, config: &mut Config, factor: f64) {
        data::lower_rates(config, factor);
    }

    fn smaller_steps(&self) -> &'static str {
        "a lower static.lr or dynamic.lr, or a longer dynamic.delay"
    }

    fn make_pipelines(&self, _: &Gpu, _: &Config, _: &Tuning) -> Result<()> {
        Ok(())
    }
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
    let half = dynamic_half(config, dataset);
    let hull = carve(dataset, motion, half, config.hull.resolution as usize, config.hull.per_phase);
    let share = hull.share();
    if share == 0.0 {
        notes.push("the motion hull is not used: at no point is there motion in all views that see it".into());
        None
    } else if share > config.hull.max_share {
        notes.push(format!(
            "the motion hull is not used: it would keep {:.0} % of the box, and more than {:.0} % saves nothing",
            100.0 * share,
            100.0 * config.hull.max_share
        ));
        None
    } else {
        notes.push(format!("the motion hull keeps {:.3} % of the box", 100.0 * share));
        Some(hull)
    }
}
