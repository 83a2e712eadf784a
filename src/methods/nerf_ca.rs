//! NeRF-CA (Maas et al. 2024), the predecessor with which the paper compares itself: a static and a dynamic network, which entropies
//! of their shares separate.
//!
//! The fit itself is that of [`crate::fields`]; here stand the choices that make it NeRF-CA's.

pub mod changes;

use crate::config::fields::FieldSettings;
use crate::config::{Config, Method as Settings};
use crate::error::{Error, Result};
use crate::fields::data::{FieldData, RayLists, heart_shifts_ignored};
use crate::fields::motion;
use crate::fields::state;
use crate::fitting::extent::between_phases;
use crate::fitting::fit::{Abilities, Method, PlannedFit, SavedAt, SavedFit};
use crate::kernels::stages::StaticNetworkKernels;
use crate::model::scene::Scene;
use crate::scan::dataset::Dataset;
use crate::tensors::File;

/// The method, for the registry.
pub static METHOD: Method = Method {
    checkpoint_format: state::FORMAT,
    smaller_steps: "a lower static.lr or dynamic.lr, or a longer networks.delay",
    boxes_hold_all_rays: true,
    plan,
    read,
    make_pipelines: |gpu, _, _| StaticNetworkKernels::new(gpu).map(|_| ()),
    rays_per_iteration: |config| config.fields().map_or(0, |settings| settings.rays),
    lower_rates,
    abilities: Abilities::NONE,
};

/// Prepares a fit.
fn plan(config: &Config, dataset: &Dataset, notes: &mut Vec<String>) -> Result<PlannedFit> {
    notes.extend(heart_shifts_ignored(dataset));
    notes.extend(between_phases(dataset, "are trained at their own time"));
    let settings = settings_of(config)?;
    let motion = motion::analyse(dataset, motion::Thresholds::default());
    let scene = Scene::new(&settings, dataset, &motion, None)?;
    let changes = changes::of_views(dataset, &motion);
    let min_change = settings.networks.as_ref().map_or(0.0, |networks| networks.min_change);
    let (rays, n_motion) = changes::rays(dataset, &motion, &changes, min_change);
    let n_all = dataset.training().len() * dataset.n_pixels();
    notes.extend(notes_of(&settings, n_motion as f64 / n_all as f64));
    let lists = RayLists { rays, n_motion, pixel_changes: changes.concat() };
    Ok(FieldData::new(&settings, dataset, &motion, None, scene, lists)?.into())
}

/// Reads the fields and the state of their fit from a checkpoint.
fn read(sections: &serde_json::Value, config: &Config, at: SavedAt, file: &File<'_>) -> Result<SavedFit> {
    state::read(sections, &settings_of(config)?, at, file)
}

/// Lowers the learning rates by a factor.
fn lower_rates(config: &mut Config, factor: f64) {
    let Settings::NerfCa(own) = &mut config.method else { return };
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

/// Returns notes for the user; a `share` of the rays changes over the beat.
fn notes_of(settings: &FieldSettings, share: f64) -> [String; 2] {
    let near = settings.dynamic.occlusion_share;
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
