//! Checkpoints: one `.safetensors` file with parameters and Adam moments under documented names, the hull,
//! and (as JSON in the metadata) configuration, scene, step and seed. Random numbers are a function of seed
//! and step, so these two are the generator's whole state.

use crate::config::Config;
use crate::error::{Error, Result};
use crate::files;
use crate::fitting::fit::{FitField, FitState, SavedAt, SavedFit, SavedState};
use crate::gaussians::tensors::{self as gaussian_tensors, FORMAT as GAUSSIAN_FORMAT, GaussianHeader};
use crate::geometry::CArm;
use crate::methods;
use crate::model::Model;
use crate::model::hull::Hull;
use crate::model::params::ParamMap;
use crate::model::scene::Scene;
use crate::tensors::{File, FileTensor};
use glam::DVec3;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use std::any::Any;
use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;

const HULL_BITS: &str = "hull.bits";
const MAX_BYTES: u64 = 4 << 30;
/// Maximum number of cardiac phases.
const MAX_PHASES: usize = 4096;
/// Checkpoints kept besides the newest.
const KEEP_OLDER: usize = 2;

/// A model, and the state from which its fit is resumed.
#[derive(Debug, Clone)]
pub struct Checkpoint {
    /// The model.
    pub model: Model,
    /// State of the fit, of its method's own type.
    pub fit: Arc<dyn FitState>,
    /// Fingerprint of the training data, to refuse resuming on other data.
    pub data_fingerprint: String,
}

#[derive(Serialize, Deserialize)]
struct Header {
    format: String,
    config: Config,
    scene: Scene,
    phases: usize,
    step: u32,
    seed: u32,
    vessel_attenuation: Option<f64>,
    c_arm: CArm,
    image_size: [usize; 2],
    data_fingerprint: String,
    hull: Option<HullHeader>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    gaussians: Option<GaussianHeader>,
}

#[derive(Serialize, Deserialize)]
struct HullHeader {
    size: [usize; 3],
    min: [f64; 3],
    cell: f64,
    n_phases: usize,
}

impl HullHeader {
    fn of(hull: &Hull) -> HullHeader {
        HullHeader { size: hull.size, min: hull.min.to_array(), cell: hull.cell, n_phases: hull.n_phases }
    }

    /// Reads the hull of a run of `n_phases` phases.
    fn read(self, file: &File<'_>, n_phases: usize) -> Result<Hull> {
        let bad = |problem: String| Error::data(file.path, HULL_BITS, problem);
        let view = file.tensors.tensor(HULL_BITS).map_err(|e| bad(e.to_string()))?;
        let cells = self.size.iter().try_fold(1usize, |n, s| n.checked_mul(*s)).unwrap_or(0);
        let words = cells.div_ceil(32).checked_mul(self.n_phases).unwrap_or(0);
        if view.dtype() != Dtype::U32
            || view.shape() != [words]
            || ![1, n_phases].contains(&self.n_phases)
            || words == 0
            || self.cell.is_nan()
            || self.cell <= 0.0
        {
            return Err(bad(format!(
                "a tensor of shape {:?} does not fit a hull of {:?} cells",
                view.shape(),
                self.size
            )));
        }
        let bits = file.words(HULL_BITS, words)?;
        Ok(Hull { size: self.size, min: DVec3::from_array(self.min), cell: self.cell, n_phases: self.n_phases, bits })
    }
}

/// Adds a section under `key` at the end of a header's JSON object.
fn with_section(header: &str, key: &str, section: &str) -> String {
    format!("{},\"{key}\":{section}}}", header.strip_suffix('}').unwrap_or(header))
}

/// Returns the name of the checkpoint file of a step.
pub fn file_name(step: u32) -> String {
    format!("checkpoint-{step:07}.safetensors")
}

/// Returns the checkpoints of a run, oldest first.
///
/// # Errors
/// [`Error::Io`].
pub fn list(run: &Path) -> Result<Vec<(u32, PathBuf)>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(run).map_err(Error::io("list", run))? {
        let path = entry.map_err(Error::io("list", run))?.path();
        let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default();
        let step = name.strip_prefix("checkpoint-").and_then(|n| n.strip_suffix(".safetensors"));
        if let Some(step) = step.and_then(|s| s.parse().ok()) {
            found.push((step, path));
        }
    }
    found.sort();
    Ok(found)
}

/// Returns the newest checkpoint of a run directory; returns the path itself if it is a file.
///
/// # Errors
/// [`Error::Data`] when there is none.
pub fn newest(run: &Path) -> Result<PathBuf> {
    if run.is_file() {
        return Ok(run.to_path_buf());
    }
    if !run.is_dir() {
        return Err(Error::data(run, "run", "is neither a run directory nor a checkpoint"));
    }
    list(run)?.pop().map(|(_, path)| path).ok_or_else(|| {
        Error::data(
            run,
            "checkpoint",
            "there is no checkpoint-*.safetensors in this directory: the run may not have saved any checkpoint yet, and is then \
             trained from the start, without --resume",
        )
    })
}

/// Returns the model of a run's newest checkpoint, or of a checkpoint file.
///
/// # Errors
/// Errors of [`newest`] and [`Checkpoint::read`]; that of a broken checkpoint names the newest older one that can be read.
pub fn newest_model(run: &Path) -> Result<Model> {
    match Checkpoint::read(&newest(run)?) {
        Ok(checkpoint) => Ok(checkpoint.model),
        Err(Error::Data { file, field, problem }) => match intact_before(run, &file) {
            None => Err(Error::Data { file, field, problem }),
            Some(older) => {
                let older = older.file_name().unwrap_or_default().to_string_lossy().into_owned();
                let problem = format!("{problem}. {older} in the same run is intact: remove the broken file to use it");
                Err(Error::Data { file, field, problem })
            }
        },
        Err(other) => Err(other),
    }
}

/// Returns the newest checkpoint of a run directory before `broken` that can be read.
fn intact_before(run: &Path, broken: &Path) -> Option<PathBuf> {
    let older = list(run).ok()?.into_iter().map(|(_, path)| path).take_while(|path| path != broken).collect::<Vec<_>>();
    older.into_iter().rev().find(|path| Checkpoint::read(path).is_ok())
}

impl Checkpoint {
    /// Writes the checkpoint into a run directory and removes all but the newest three.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn save(&self, run: &Path) -> Result<PathBuf> {
        let path = run.join(file_name(self.model.step));
        self.write(&path)?;
        let mut older = list(run)?;
        older.retain(|(step, _)| *step < self.model.step);
        for (_, old) in older.iter().rev().skip(KEEP_OLDER) {
            std::fs::remove_file(old).map_err(Error::io("remove", old))?;
        }
        Ok(path)
    }

    /// Writes the checkpoint to a file.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, path: &Path) -> Result<()> {
        Ok(files::write_atomic(path, &self.to_bytes()?)?)
    }

    /// Returns the content of a checkpoint file.
    ///
    /// # Errors
    /// [`Error::Internal`].
    pub fn to_bytes(&self) -> Result<Vec<u8>> {
        let model = &self.model;
        let mut tensors: Vec<FileTensor> = model.gaussians.as_ref().map(gaussian_tensors::tensors).unwrap_or_default();
        let SavedState { tensors: of_fit, sections } = self.fit.saved(model)?;
        tensors.extend(of_fit);
        if let Some(hull) = &model.hull {
            let bytes = hull.bits.iter().flat_map(|w| w.to_le_bytes()).collect();
            tensors.push((HULL_BITS.into(), Dtype::U32, vec![hull.bits.len()], bytes));
        }
        let views = tensors
            .iter()
            .map(|(name, dtype, shape, bytes)| {
                TensorView::new(*dtype, shape.clone(), bytes)
                    .map(|view| (name.as_str(), view))
                    .map_err(|e| Error::Internal(format!("{name}: {e}")))
            })
            .collect::<Result<Vec<_>>>()?;
        let metadata = HashMap::from([("nertca".to_owned(), self.header(sections)?)]);
        safetensors::serialize(views, Some(metadata)).map_err(|e| Error::Internal(e.to_string()))
    }

    /// Returns the header, with the `sections` of the state and that of the field.
    fn header(&self, sections: Vec<(&'static str, String)>) -> Result<String> {
        let model = &self.model;
        let header = Header {
            format: methods::of(&model.config).checkpoint_format.into(),
            gaussians: model.gaussians.as_ref().map(gaussian_tensors::header),
            config: model.config.clone(),
            scene: model.scene.clone(),
            phases: model.param_map.phases,
            step: model.step,
            seed: model.config.seed,
            vessel_attenuation: model.vessel_attenuation,
            c_arm: model.c_arm.clone(),
            image_size: model.image_size,
            data_fingerprint: self.data_fingerprint.clone(),
            hull: model.hull.as_ref().map(HullHeader::of),
        };
        let mut text = serde_json::to_string(&header).map_err(|e| Error::Internal(e.to_string()))?;
        for (key, section) in sections {
            text = with_section(&text, key, &section);
        }
        if let Some(field) = &model.field {
            text = with_section(&text, field.key(), &field.header()?);
        }
        Ok(text)
    }

    /// Returns field and state, from which a fit begins.
    pub fn saved_fit(&self) -> SavedFit {
        let Model { params, hull, gaussians, field, .. } = self.model.clone();
        SavedFit { field: FitField { params, hull, gaussians, own: field }, state: self.fit.clone() }
    }

    /// Returns the state of the fit as the type of its method.
    ///
    /// # Errors
    /// [`Error::Internal`] for the state of another method.
    pub fn state<T: Any>(&self) -> Result<&T> {
        let other = || Error::Internal("the state of the fit is that of another method".into());
        let state: &dyn Any = &*self.fit;
        state.downcast_ref().ok_or_else(other)
    }

    /// Reads a checkpoint file.
    ///
    /// # Errors
    /// [`Error::Data`] naming the tensor that is missing, misshapen or not finite.
    pub fn read(path: &Path) -> Result<Checkpoint> {
        Self::from_bytes(&files::read_limited(path, MAX_BYTES)?, path)
    }

    /// Reads the content of a checkpoint file; `path` is for messages.
    ///
    /// # Errors
    /// Errors of [`Checkpoint::read`].
    pub fn from_bytes(bytes: &[u8], path: &Path) -> Result<Checkpoint> {
        let bad = |field: &str, problem: String| Error::data(path, field, problem);
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|e| bad("header", e.to_string()))?;
        let text = metadata.metadata().as_ref().and_then(|m| m.get("nertca")).cloned();
        let text = text.ok_or_else(|| bad("metadata", "is not a checkpoint of this program".into()))?;
        let header: Header = serde_json::from_str(&text).map_err(|e| bad("metadata", e.to_string()))?;
        let sections: serde_json::Value = serde_json::from_str(&text).map_err(|e| bad("metadata", e.to_string()))?;
        check_format(&header, path)?;
        header.config.check()?;
        if header.phases == 0 || header.phases > MAX_PHASES {
            return Err(bad("phases", header.phases.to_string()));
        }
        let tensors = SafeTensors::deserialize(bytes).map_err(|e| bad("tensors", e.to_string()))?;
        let file = File { tensors: &tensors, path };
        let at = SavedAt { n_phases: header.phases, step: header.step };
        let SavedFit { field, state } = (methods::of(&header.config).read)(&sections, &header.config, at, &file)?;
        let hull = header.hull.map(|hull| hull.read(&file, header.phases)).transpose()?;
        let model = Model {
            param_map: ParamMap::new(&header.config, header.phases),
            config: header.config,
            scene: header.scene,
            hull,
            gaussians: field.gaussians,
            field: field.own,
            params: field.params,
            step: header.step,
            vessel_attenuation: header.vessel_attenuation,
            c_arm: header.c_arm,
            image_size: header.image_size,
        };
        Ok(Checkpoint { model, fit: state, data_fingerprint: header.data_fingerprint })
    }
}

/// Refuses a format that no method has, and one that is not that of the file's configuration.
fn check_format(header: &Header, path: &Path) -> Result<()> {
    let bad = |field: &str, problem: String| Err(Error::data(path, field, problem));
    let known: BTreeSet<&str> = methods::METHODS.iter().map(|method| method.checkpoint_format).collect();
    if !known.contains(header.format.as_str()) {
        let known: Vec<&str> = known.into_iter().collect();
        let problem = format!("`{}` is not supported; this version reads {}", header.format, known.join(", "));
        return bad("format", problem);
    }
    let needed = methods::of(&header.config).checkpoint_format;
    if header.format != needed {
        return bad("format", format!("is `{}`, but the file's configuration needs `{needed}`", header.format));
    }
    if header.gaussians.is_some() != (header.format == GAUSSIAN_FORMAT) {
        let problem = format!(
            "the header has this field although the format `{}` does not allow it, or lacks it although the format needs it",
            header.format
        );
        return bad("gaussians", problem);
    }
    Ok(())
}
