//! NeRF-CA (Maas et al. 2024), the predecessor with which the paper compares itself: a static and a dynamic network, which entropies
//! of their shares separate.
//!
//! The fit itself is that of [`crate::fields`]; here stand the choices that make it NeRF-CA's.

pub mod changes;

use crate::config::Config;
use crate::config::method::MethodKind;
use crate::error::Result;
use crate::fields::data::{self, FieldData, RayLists, heart_shifts_ignored};
use crate::fields::motion;
use crate::fields::state;
use crate::fitting::extent::between_phases;
use crate::fitting::fit::{Method, PlannedFit, SavedAt, SavedFit};
use crate::gpu::device::Gpu;
use crate::kernels::stages::StaticNetworkKernels;
use crate::kernels::tuning::Tuning;
use crate::model::scene::Scene;
use crate::scan::dataset::Dataset;
use crate::tensors::File;

/// The method, for the registry.
pub struct NerfCa;

impl Method for NerfCa {
    fn kind(&self) -> MethodKind {
        MethodKind::NerfCa
    }

    fn checkpoint_format(&self) -> &'static str {
        state::FORMAT
    }

    fn plan(&self, config: &Config, dataset: &Dataset, notes: &mut Vec<String>) -> Result<PlannedFit> {
        notes.extend(heart_shifts_ignored(dataset));
        notes.extend(between_phases(dataset, "are trained at their own time"));
        let motion = motion::analyse(dataset, &config.hull);
        let scene = Scene::new(config, dataset, &motion, None)?;
        let changes = changes::of_views(dataset, &motion);
        let (rays, n_motion) = changes::rays(dataset, &motion, &changes, config.networks.min_change);
        let n_all = dataset.training().len() * dataset.n_pixels();
        notes.extend(notes_of(config, n_motion as f64 / n_all as f64));
        let lists = RayLists { rays, n_motion, pixel_changes: changes.concat() };
        let data = FieldData::new(config, dataset, &motion, None, scene, lists)?;
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
        "a lower static.lr or dynamic.lr, or a longer networks.delay"
    }

    fn make_pipelines(&self, gpu: &Gpu, _: &Config, _: &Tuning) -> Result<()> {
        StaticNetworkKernels::new(gpu).map(|_| ())
    }

    fn boxes_hold_all_rays(&self) -> bool {
        true
    }
}

/// Returns notes for the user; a `share` of the rays changes over the beat.
fn notes_of(config: &Config, share: f64) -> [String; 2] {
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
