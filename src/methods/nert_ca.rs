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
use crate::fitting::fit::{Abilities, Method, PlannedFit};
use crate::model::hull::Hull;
use crate::model::scene::Scene;
use crate::scan::dataset::Dataset;

/// The method, for the registry.
pub static METHOD: Method = Method {
    kind: MethodKind::NertCa,
    checkpoint_format: state::FORMAT,
    smaller_steps: "a lower static.lr or dynamic.lr, or a longer dynamic.delay",
    boxes_hold_all_rays: false,
    plan,
    read: state::read,
    make_pipelines: |_, _, _| Ok(()),
    rays_per_iteration: |config| config.train.rays,
    lower_rates: data::lower_rates,
    abilities: Abilities::NONE,
};

/// Prepares a fit.
fn plan(config: &Config, dataset: &Dataset, notes: &mut Vec<String>) -> Result<PlannedFit> {
    notes.extend(heart_shifts_ignored(dataset));
    notes.extend(between_phases(dataset, "are trained at their own time"));
    let motion = motion::analyse(dataset, &config.hull);
    let hull = choose_hull(config, dataset, &motion, notes);
    let scene = Scene::new(config, dataset, &motion, hull.as_ref())?;
    let lists = RayLists::of_hull(config, dataset, &motion, hull.as_ref());
    Ok(FieldData::new(config, dataset, &motion, hull, scene, lists)?.into())
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
