//! NerT-CA (Maas et al. 2025), the method of the paper: a static tensor field and a dynamic network with a latent code per cardiac
//! phase, through which rays are marched together.
//!
//! The fit itself is that of [`crate::fields`]; here stand the choices that make it NerT-CA's.

use crate::config::fields::FieldSettings;
use crate::config::sections::{NertCaHull, NertCaSettings};
use crate::config::{Config, Method as Settings, Preset};
use crate::error::{Error, Result};
use crate::fields::carve::carve;
use crate::fields::data::{FieldData, RayLists, heart_shifts_ignored};
use crate::fields::motion::{self, Thresholds, ViewMotion};
use crate::fields::scale::dynamic_half;
use crate::fields::state;
use crate::fitting::extent::{between_phases, seen_half};
use crate::fitting::fit::{Abilities, Method, PlannedFit, SavedAt, SavedFit};
use crate::geometry::MM_PER_UNIT;
use crate::model::hull::Hull;
use crate::model::scene::Scene;
use crate::scan::dataset::Dataset;
use crate::tensors::File;

/// The method, for the registry.
pub static METHOD: Method = Method {
    checkpoint_format: state::FORMAT,
    smaller_steps: "a lower static.lr or dynamic.lr, or a longer dynamic.delay",
    boxes_hold_all_rays: false,
    plan,
    read,
    make_pipelines: |_, _, _| Ok(()),
    rays_per_iteration: |config| config.fields().map_or(0, |settings| settings.rays),
    lower_rates,
    abilities: Abilities::NONE,
};

/// Half side of the dynamic field's box, in units of what the views see, from which its vessels do not appear in unseen views
/// (studies/README.md: .8 works, 2 does not).
const WIDE: f64 = 1.5;

/// Half side of the dynamic field's box of the preset `nert-ca`, in the same unit: the ball that the views see reaches the corners of the
/// images, and few points there are seen by two views. It is 20 mm for the data of studies/README.md, with which the preset was found.
const BOX: f64 = 0.8;

/// Prepares a fit.
fn plan(config: &Config, dataset: &Dataset, notes: &mut Vec<String>) -> Result<PlannedFit> {
    notes.extend(heart_shifts_ignored(dataset));
    notes.extend(between_phases(dataset, "are trained at their own time"));
    let (config, mut settings) = (config.of::<NertCaSettings>()?, settings_of(config)?);
    if config.preset == Preset::NertCa && config.dynamic.half_extent_mm == 0.0 {
        settings.dynamic.half_extent_mm = BOX * seen_half(dataset) * MM_PER_UNIT;
    }
    notes.extend(wide_box(config.dynamic.half_extent_mm, dataset));
    let NertCaHull { min_share, min_share_few_views, dilate_pixels, .. } = config.hull;
    let motion = motion::analyse(dataset, Thresholds { min_share, min_share_few_views, dilate_pixels });
    let hull = choose_hull(&config.hull, dynamic_half(config.dynamic.half_extent_mm, dataset), dataset, &motion, notes);
    let scene = Scene::new(&settings, dataset, &motion, hull.as_ref())?;
    let lists = RayLists::of_hull(dataset, &motion, hull.as_ref());
    Ok(FieldData::new(&settings, dataset, &motion, hull, scene, lists)?.into())
}

/// Returns a warning where the box of the dynamic field, `half_extent_mm` each way, is much wider than what the views see.
fn wide_box(half_extent_mm: f64, dataset: &Dataset) -> Option<String> {
    let seen_mm = seen_half(dataset) * MM_PER_UNIT;
    (half_extent_mm > WIDE * seen_mm).then(|| {
        format!(
            "warning: the box of the dynamic field reaches {half_extent_mm} mm each way, but the views see {seen_mm:.0} mm together; in \
             a box so wide the network explains each view by itself and no vessels appear in others. The preset nert-ca is this \
             method with a box of what the views see"
        )
    })
}

/// Reads the fields and the state of their fit from a checkpoint.
fn read(sections: &serde_json::Value, config: &Config, at: SavedAt, file: &File<'_>) -> Result<SavedFit> {
    state::read(sections, &settings_of(config)?, at, file)
}

/// Lowers the learning rates by a factor.
fn lower_rates(config: &mut Config, factor: f64) {
    let Settings::NertCa(own) = &mut config.method else { return };
    // All bands are open.
    own.network.window_iterations = 0;
    own.network.lr_end *= factor;
    own.static_field.lr_end *= factor;
    (own.network.lr, own.static_field.lr) = (own.network.lr_end, own.static_field.lr_end);
}

/// Returns the settings of the fields of a configuration.
fn settings_of(config: &Config) -> Result<FieldSettings> {
    config.fields().ok_or_else(|| Error::Internal("the configuration has no fields".into()))
}

fn choose_hull(
    settings: &NertCaHull,
    half: f64,
    dataset: &Dataset,
    motion: &[ViewMotion],
    notes: &mut Vec<String>,
) -> Option<Hull> {
    if !settings.enabled {
        return None;
    }
    let single_phase: Vec<_> = motion.iter().filter(|m| m.n_phases < 2).map(|m| m.view).collect();
    if !single_phase.is_empty() {
        notes.push(format!("the motion hull is not used: views {single_phase:?} have a single phase"));
        return None;
    }
    let hull = carve(dataset, motion, half, settings.resolution as usize, true);
    let share = hull.share();
    if share == 0.0 {
        notes.push("the motion hull is not used: at no point is there motion in all views that see it".into());
        None
    } else if share > settings.max_share {
        notes.push(format!(
            "the motion hull is not used: it would keep {:.0} % of the box, and at most {:.0} % are of use",
            100.0 * share,
            100.0 * settings.max_share
        ));
        None
    } else {
        notes.push(format!("the motion hull keeps {:.3} % of the box", 100.0 * share));
        Some(hull)
    }
}
