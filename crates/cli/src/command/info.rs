//! The command `info`.

use crate::pages::geometry_picture;
use clap::Args;
use nertca_vk::checkpoint::{self, Checkpoint};
use nertca_vk::error::{Error, Result};
use nertca_vk::files::{path_in_json, pretty_json};
use nertca_vk::gaussians::field::GaussianField;
use nertca_vk::geometry::MM_PER_UNIT;
use nertca_vk::scan::dataset::{Dataset, Split, manifest_schema};
use nertca_vk_vessels::score::pictures::Window;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Arguments of `info`.
#[derive(Debug, Args)]
pub struct InfoArgs {
    /// Dataset directory, run directory or checkpoint.
    #[arg(required_unless_present = "schema")]
    pub path: Option<PathBuf>,
    /// Print JSON instead of text.
    #[arg(long)]
    pub json: bool,
    /// Write a picture of a dataset's geometry to this file: sources, detectors, central rays and the patient's axes, from
    /// three sides.
    #[arg(long, value_name = "FILE.png", conflicts_with_all = ["schema", "json"])]
    pub picture: Option<PathBuf>,
    /// Print the JSON schema of `dataset.json` and exit.
    #[arg(long)]
    pub schema: bool,
}

/// Describes a dataset or a run.
pub fn info(args: &InfoArgs) -> Result<()> {
    if args.schema {
        out!("{}", manifest_schema().trim_end());
        return Ok(());
    }
    let path = args.path.as_deref().unwrap_or(Path::new("."));
    let is_run = path.is_file() || checkpoint::list(path).is_ok_and(|found| !found.is_empty());
    if let Some(picture) = &args.picture {
        if is_run {
            let problem = format!("needs a dataset, whose geometry the picture shows, but {} is a run", path.display());
            return Err(Error::config("--picture", picture.display(), problem));
        }
        geometry_picture::write(&Dataset::open(path)?, picture)?;
        out!("{}", picture.display());
        return Ok(());
    }
    let described = if is_run { describe_run(path)? } else { describe_dataset(path)? };
    if args.json {
        out!("{}", pretty_json(&described)?);
    } else {
        print_tree(&described, 0);
    }
    Ok(())
}

fn describe_run(path: &Path) -> Result<serde_json::Value> {
    let file = checkpoint::newest(path)?;
    let model = Checkpoint::read(&file)?.model;
    let mut described = serde_json::json!({
        "kind": "run",
        "checkpoint": Stored(&file),
        "step": model.step,
        "iterations": model.config.train.iterations,
        "parameters": model.param_map.len,
        "phases": model.shown_phases(),
        "still": model.scene.still,
        "hull_share": model.hull.as_ref().map(|h| h.share()),
        "gaussians": model.gaussians.as_ref().map(describe_gaussians),
        "scene": model.scene,
        "config": model.config,
    });
    if let Some(field) = &model.field {
        described[field.key()] = field.describe();
    }
    Ok(described)
}

/// A path, as JSON.
#[derive(Serialize)]
struct Stored<'a>(#[serde(serialize_with = "path_in_json::serialize")] &'a Path);

fn describe_gaussians(field: &GaussianField) -> serde_json::Value {
    let phases = 0..field.rows().n_phases;
    let filled = field.moving().filter(|set| set.filling.is_some());
    serde_json::json!({
        "form": field.form(),
        "count": field.rows().rows.len(),
        "bytes": field.bytes(),
        "rest_phase": field.moving().map(|set| set.setup.rest_phase),
        "filled_share": filled.map(|set| phases.clone().map(|p| set.filled_share(p)).collect::<Vec<_>>()),
        "displacement_from_phase_0": field.moving().map(|set| phases.map(|p| set.displacement(p as f64)).collect::<Vec<_>>()),
    })
}

fn describe_dataset(path: &Path) -> Result<serde_json::Value> {
    let dataset = Dataset::open(path)?;
    let views: Vec<_> = dataset
        .views
        .iter()
        .enumerate()
        .map(|(index, view)| {
            let of = |split| dataset.frames.iter().filter(|f| f.view == index && f.split == split).count();
            serde_json::json!({
                "geometry": view.geometry,
                "image": view.size,
                "training_frames": of(Split::Train),
                "validation_frames": of(Split::Validation),
            })
        })
        .collect();
    let range = Window::of(&dataset.training().iter().flat_map(|f| f.integrals.iter().copied()).collect::<Vec<_>>());
    Ok(serde_json::json!({
        "kind": "dataset",
        "layout": dataset.layout,
        "image": dataset.canvas(),
        "phases": dataset.shown_phases(),
        "still": dataset.still,
        "depth_range_mm": [dataset.depth_range.0 * MM_PER_UNIT, dataset.depth_range.1 * MM_PER_UNIT],
        "line_integrals": [range.low, range.high],
        "vessel_attenuation_per_mm": dataset.vessel_attenuation.map(|a| a / MM_PER_UNIT),
        "masks": dataset.frames.iter().filter(|f| f.mask.is_some()).count(),
        "notes": dataset.notes,
        "views": views,
    }))
}

fn print_tree(value: &serde_json::Value, depth: usize) {
    let Some(map) = value.as_object() else { return };
    for (key, value) in map {
        match value {
            // Properties that a run does not have are omitted.
            serde_json::Value::Null => {}
            serde_json::Value::Object(_) => {
                out!("{:indent$}{key}:", "", indent = 2 * depth);
                print_tree(value, depth + 1);
            }
            serde_json::Value::Array(items) if items.iter().any(serde_json::Value::is_object) => {
                for (index, item) in items.iter().enumerate() {
                    out!("{:indent$}{key}[{index}]:", "", indent = 2 * depth);
                    print_tree(item, depth + 1);
                }
            }
            other => out!("{:indent$}{key}: {other}", "", indent = 2 * depth),
        }
    }
}
