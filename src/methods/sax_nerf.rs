//! SAX-NeRF (Cai et al. 2024), a static baseline of the paper: a hash grid and a Lineformer, fitted to whole images of each phase,
//! or of all.

pub mod buffers;
pub mod data;
pub mod drawing;
pub mod field;
mod interface;
pub mod lineformer;
pub mod products;
pub mod setup;
pub mod stages;
pub mod start;
mod tensors;
pub mod trainer;

use crate::config::sections::SaxSettings;
use crate::config::{Config, Method as Settings, OfMethod, StaticData};
use crate::error::{Error, Result};
use crate::fields::scale::FieldVolume;
use crate::fitting::extent::volume_half;
use crate::fitting::fit::{Abilities, Fit, FitData, FitField, FitStart, Method, PlannedFit, SavedAt, SavedFit, Use};
use crate::fitting::sets::ignored;
use crate::model::scene::Scene;
use crate::scan::dataset::Dataset;
use crate::tensors::File;
use data::SaxData;
use field::{SaxField, SaxShape, SaxState};
use interface::KEY;
use stages::SaxKernels;
use std::sync::Arc;
use trainer::SaxTrainer;

/// The method, for the registry.
pub static METHOD: Method = Method {
    checkpoint_format: "nertca-checkpoint-4",
    smaller_steps: field::SMALLER_STEPS,
    boxes_hold_all_rays: false,
    plan,
    read,
    make_pipelines: |gpu, _, _| SaxKernels::new(gpu).map(|_| ()),
    rays_per_iteration: |config| SaxSettings::of(&config.method).map_or(0, |settings| setup::n_rays(&settings.sax)),
    lower_rates: |config, factor| {
        let Settings::SaxNerf(SaxSettings { sax }) = &mut config.method else { return };
        sax.rate *= factor;
    },
    abilities: Abilities::NONE,
};

/// Prepares a fit.
fn plan(config: &Config, dataset: &Dataset, notes: &mut Vec<String>) -> Result<PlannedFit> {
    let config = &config.of::<SaxSettings>()?;
    let volume = FieldVolume {
        half: volume_half(config.sax.half_extent_mm, dataset),
        // Volumes are kept in units of the attenuation of a density of 1.
        attenuation: Some(dataset.vessel_attenuation.unwrap_or(1.0)),
    };
    let data = SaxData::new(dataset, &config.sax, volume.half)?;
    notes.extend(notes_of(config, dataset, &data));
    Ok(PlannedFit::of_images(Scene::of_volume(dataset, volume), data))
}

/// Reads the field and the state of its fit from a checkpoint.
fn read(sections: &serde_json::Value, config: &Config, at: SavedAt, file: &File<'_>) -> Result<SavedFit> {
    let bad = |e: serde_json::Error| Error::data(file.path, KEY, e.to_string());
    let about = serde_json::from_value(sections[KEY].clone()).map_err(bad)?;
    let (field, state) = tensors::read(&about, SaxShape::of(&config.of::<SaxSettings>()?.sax), file, at)?;
    Ok(SavedFit { field: FitField::of_own(Arc::new(field)), state: Arc::new(state) })
}

/// Returns notes for the user about decisions on the data.
fn notes_of(config: &Config<SaxSettings>, dataset: &Dataset, data: &SaxData) -> Vec<String> {
    let images = (0..data.n_sets()).map(|set| data.sets.images(set).len()).max().unwrap_or(1);
    let passes = config.train.iterations as usize / images;
    let mut notes = vec![match config.sax.static_data {
        StaticData::PerPhase => format!(
            "SAX-NeRF, a static method: each phase is reconstructed from its own images, one image per iteration, in \
             {passes} passes over them (sax.static_data = \"per-phase\")"
        ),
        StaticData::Pooled => format!(
            "SAX-NeRF, a static method: one reconstruction from the images of all phases, one image per iteration, in \
             {passes} passes over them, is used for every phase (sax.static_data = \"pooled\")"
        ),
    }];
    if dataset.vessel_attenuation.is_none() {
        notes.push(
            "the dataset states no attenuation of vessels: densities are per 100 mm, and SAX-NeRF cannot represent \
             densities above 1"
                .into(),
        );
    }
    notes.extend(ignored(dataset, "SAX-NeRF"));
    notes
}

impl FitData for SaxData {
    fn begin(self: Box<Self>, start: &FitStart<'_>, _: &mut Vec<String>) -> Result<Box<dyn Fit>> {
        let (gpu, config, from) = (start.gpu, &start.config.of()?, start.from);
        let field = from.field_to(Use::Resume).and_then(|field| field.own.as_ref()?.downcast::<SaxField>());
        Ok(match field.zip(from.state_as::<SaxState>()) {
            Some((field, state)) => Box::new(SaxTrainer::with(gpu, *self, config, field, state)?),
            None => Box::new(SaxTrainer::new(gpu, *self, config)?),
        })
    }

    fn set_scene(&mut self, _: &Scene) {}
}
