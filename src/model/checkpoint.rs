//! Checkpoints: one `.safetensors` file with parameters and Adam moments under documented names, the hull,
//! and (as JSON in the metadata) configuration, scene, step and seed. Random numbers are a function of seed
//! and step, so these two are the generator's whole state.

use crate::config::method::MethodKind;
use crate::config::{Config, StaticForm};
use crate::error::{Error, Result};
use crate::files;
use crate::fitting::fit::{FitField, FitState, SavedAt, SavedFit};
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
use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;

const FORMAT: &str = "nertca-checkpoint-2";
const OCCUPANCY: &str = "occupancy.bits";
const LAST_REPORT: &str = "report.words";
const MAX_BYTES: u64 = 4 << 30;
/// Checkpoints kept besides the newest.
const KEEP_OLDER: usize = 2;

/// A model and the optimiser's moments.
#[derive(Debug, Clone)]
pub struct Checkpoint {
    /// The fields.
    pub model: Model,
    /// Adam's first and second moment of each parameter, padded like the parameters.
    pub moments: Vec<[f32; 2]>,
    /// Occupancy of three epochs, in the layout of the shaders; empty for a run without occupancy.
    pub occupancy: Vec<u32>,
    /// Loss scale of a run on matrix units.
    pub loss_scale: Option<LossScale>,
    /// Whether learning ended before the end of the run because an entropy of two networks vanished.
    pub stopped: bool,
    /// Words of the last [`crate::kernels::layout::StepReport`], which a run whose learning has ended repeats; empty while it
    /// learns.
    pub last_report: Vec<u32>,
    /// State of the fit of a method of [`crate::methods`], beside the model's field; `None` for all other methods.
    pub fit: Option<Arc<dyn FitState>>,
    /// Fingerprint of the training data, to refuse resuming on other data.
    pub data_fingerprint: String,
}

/// Factor on gradients in f16, and the number of updates since its last change.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LossScale {
    /// The factor.
    pub scale: f32,
    /// Number of updates since the factor changed, including the update at which it grew.
    pub good_updates: u32,
    /// Scale to which the factor returns quickly after overflows; 0 = none yet, as in older checkpoints.
    #[serde(default)]
    pub return_scale: f32,
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
    #[serde(default)]
    loss_scale: Option<LossScale>,
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    stopped: bool,
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

/// Returns the format that a checkpoint's header states.
fn format_of(config: &Config) -> &'static str {
    match methods::of(config) {
        Some(method) => method.checkpoint_format(),
        None if config.method() == MethodKind::Gaussians => GAUSSIAN_FORMAT,
        None => FORMAT,
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
            "there is no checkpoint-*.safetensors in this directory: the run may not have saved any checkpoint yet",
        )
    })
}

/// Returns the model of a run's newest checkpoint, or of a checkpoint file.
///
/// # Errors
/// Errors of [`newest`] and [`Checkpoint::read`].
pub fn newest_model(run: &Path) -> Result<Model> {
    Ok(Checkpoint::read(&newest(run)?)?.model)
}

fn to_words(bytes: &[u8]) -> Vec<u32> {
    bytes.chunks_exact(4).map(|w| u32::from_le_bytes([w[0], w[1], w[2], w[3]])).collect()
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
        files::write_atomic(path, &self.to_bytes()?)
    }

    /// Returns the content of a checkpoint file.
    ///
    /// # Errors
    /// [`Error::Internal`].
    pub fn to_bytes(&self) -> Result<Vec<u8>> {
        let model = &self.model;
        let mut tensors: Vec<FileTensor> = Vec::new();
        if let Some(field) = &model.gaussians {
            tensors.extend(gaussian_tensors::tensors(field));
        }
        if let Some(state) = &self.fit {
            tensors.extend(state.tensors(model.field.as_deref())?);
        }
        for tensor in model.param_map.tensors() {
            let gather = |value: &dyn Fn(usize) -> f32| -> Vec<u8> {
                tensor.positions.iter().flat_map(|at| value(*at as usize).to_le_bytes()).collect()
            };
            for (prefix, bytes) in [
                ("", gather(&|at| model.params[at])),
                ("adam.m.", gather(&|at| self.moments[at][0])),
                ("adam.v.", gather(&|at| self.moments[at][1])),
            ] {
                tensors.push((format!("{prefix}{}", tensor.name), Dtype::F32, tensor.shape.clone(), bytes));
            }
        }
        if let Some(hull) = &model.hull {
            let bytes = hull.bits.iter().flat_map(|w| w.to_le_bytes()).collect();
            tensors.push(("hull.bits".into(), Dtype::U32, vec![hull.bits.len()], bytes));
        }
        for (name, words) in [(OCCUPANCY, &self.occupancy), (LAST_REPORT, &self.last_report)] {
            if !words.is_empty() {
                let bytes = words.iter().flat_map(|w| w.to_le_bytes()).collect();
                tensors.push((name.into(), Dtype::U32, vec![words.len()], bytes));
            }
        }
        let header = Header {
            format: format_of(&model.config).into(),
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
            loss_scale: self.loss_scale,
            stopped: self.stopped,
            hull: model.hull.as_ref().map(|h| HullHeader {
                size: h.size,
                min: h.min.to_array(),
                cell: h.cell,
                n_phases: h.n_phases,
            }),
        };
        let mut header = serde_json::to_string(&header).map_err(|e| Error::Internal(e.to_string()))?;
        if let Some(field) = &model.field {
            header = with_section(&header, field.key(), &field.header()?);
        }
        let views = tensors
            .iter()
            .map(|(name, dtype, shape, bytes)| {
                TensorView::new(*dtype, shape.clone(), bytes)
                    .map(|view| (name.as_str(), view))
                    .map_err(|e| Error::Internal(format!("{name}: {e}")))
            })
            .collect::<Result<Vec<_>>>()?;
        let metadata = HashMap::from([("nertca".to_owned(), header)]);
        safetensors::serialize(views, Some(metadata)).map_err(|e| Error::Internal(e.to_string()))
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
        let formats = methods::METHODS.iter().map(|method| method.checkpoint_format());
        let known: BTreeSet<&str> = [FORMAT, GAUSSIAN_FORMAT].into_iter().chain(formats).collect();
        if !known.contains(header.format.as_str()) {
            let known: Vec<&str> = known.into_iter().collect();
            let problem = format!("`{}` is not supported; this version reads {}", header.format, known.join(", "));
            return Err(bad("format", problem));
        }
        if header.format != format_of(&header.config) {
            let problem =
                format!("is `{}`, but the file's configuration needs `{}`", header.format, format_of(&header.config));
            return Err(bad("format", problem));
        }
        if header.gaussians.is_some() != (header.format == GAUSSIAN_FORMAT) {
            return Err(bad(
                "gaussians",
                format!(
                    "the header has this field although the format `{}` does not allow it, or lacks it although the \
                     format needs it",
                    header.format
                ),
            ));
        }
        header.config.check()?;
        let method = methods::of(&header.config);
        if let Some(LossScale { scale, .. }) = header.loss_scale.filter(|s| !(s.scale.is_finite() && s.scale >= 1.0)) {
            return Err(bad("loss_scale", format!("is {scale} where at least 1 is needed")));
        }
        if header.phases == 0 || header.phases > 4096 {
            return Err(bad("phases", header.phases.to_string()));
        }
        let tensors = SafeTensors::deserialize(bytes).map_err(|e| bad("tensors", e.to_string()))?;
        let (s, d) = (&header.config.static_field, &header.config.dynamic);
        let [grid, ranks, layers, width] = [s.grid, s.ranks, d.layers, d.width].map(u64::from);
        let hidden = layers * width * width;
        let static_len = match header.config.static_field.form {
            StaticForm::Tensor => 3 * ranks * grid * (grid + 1),
            StaticForm::Network => hidden,
            StaticForm::None => 0,
        };
        let network = hidden + header.phases as u64 * u64::from(d.latent);
        let needed = static_len + if header.config.method().has_network() { network } else { 0 };
        if needed > bytes.len() as u64 / 4 {
            return Err(bad("config", format!("{needed} parameters do not fit into the file's {} bytes", bytes.len())));
        }
        let param_map = ParamMap::new(&header.config, header.phases);
        let mut params = vec![0f32; param_map.len];
        let mut moments = vec![[0f32; 2]; param_map.len];
        for tensor in param_map.tensors() {
            for prefix in ["", "adam.m.", "adam.v."] {
                let name = format!("{prefix}{}", tensor.name);
                let view = tensors.tensor(&name).map_err(|e| bad(&name, e.to_string()))?;
                if view.dtype() != Dtype::F32 || view.shape() != tensor.shape {
                    return Err(bad(
                        &name,
                        format!("is {:?} {:?} where F32 {:?} is needed", view.dtype(), view.shape(), tensor.shape),
                    ));
                }
                for (word, at) in view.data().chunks_exact(4).zip(&tensor.positions) {
                    let value = f32::from_le_bytes([word[0], word[1], word[2], word[3]]);
                    if !value.is_finite() {
                        return Err(bad(&name, "contains a value that is not finite".into()));
                    }
                    match prefix {
                        "" => params[*at as usize] = value,
                        "adam.m." => moments[*at as usize][0] = value,
                        _ => moments[*at as usize][1] = value,
                    }
                }
            }
        }
        let hull = match header.hull {
            None => None,
            Some(h) => {
                let view = tensors.tensor("hull.bits").map_err(|e| bad("hull.bits", e.to_string()))?;
                let cells = h.size.iter().try_fold(1usize, |n, s| n.checked_mul(*s)).unwrap_or(0);
                let words = cells.div_ceil(32).checked_mul(h.n_phases).unwrap_or(0);
                if view.dtype() != Dtype::U32
                    || view.shape() != [words]
                    || ![1, header.phases].contains(&h.n_phases)
                    || words == 0
                    || h.cell.is_nan()
                    || h.cell <= 0.0
                {
                    return Err(bad(
                        "hull.bits",
                        format!("a tensor of shape {:?} does not fit a hull of {:?} cells", view.shape(), h.size),
                    ));
                }
                let bits = to_words(view.data());
                Some(Hull { size: h.size, min: DVec3::from_array(h.min), cell: h.cell, n_phases: h.n_phases, bits })
            }
        };
        let file = File { tensors: &tensors, path };
        let gaussians = match &header.gaussians {
            Some(about) if method.is_none() => Some(gaussian_tensors::read(about, &file, header.phases)?),
            _ => None,
        };
        let words = |name: &str| match tensors.tensor(name) {
            Ok(view) if view.dtype() == Dtype::U32 => to_words(view.data()),
            _ => Vec::new(),
        };
        let fit = match method {
            None => None,
            Some(method) => {
                let sections: serde_json::Value =
                    serde_json::from_str(&text).map_err(|e| bad("metadata", e.to_string()))?;
                let at = SavedAt { n_phases: header.phases, step: header.step };
                Some(method.read(&sections, &header.config, at, &file)?)
            }
        };
        let (field, fit) = fit.map(|SavedFit { field, state }| (field, state)).unzip();
        let (of_fit, field) = field.map_or((None, None), FitField::split);
        Ok(Checkpoint {
            fit,
            occupancy: words(OCCUPANCY),
            last_report: words(LAST_REPORT),
            model: Model {
                config: header.config,
                scene: header.scene,
                param_map,
                hull,
                gaussians: gaussians.or(of_fit),
                field,
                params,
                step: header.step,
                vessel_attenuation: header.vessel_attenuation,
                c_arm: header.c_arm,
                image_size: header.image_size,
            },
            moments,
            loss_scale: header.loss_scale,
            stopped: header.stopped,
            data_fingerprint: header.data_fingerprint,
        })
    }
}
