//! Gaussians in a checkpoint: tensors under documented names, and their section of the header.

use crate::error::{Error, Result};
use crate::gaussians::field::{FitAgreement, GaussianField, Gaussians, MovingGaussians, Units, inverse_step};
use crate::kernels::layout::{Gaussian, GaussianSetup, MotionGridSetup};
use crate::tensors::{File, FileTensor};
use safetensors::tensor::Dtype;
use serde::{Deserialize, Serialize};

/// Format of checkpoints whose dynamic field consists of Gaussians; they contain no network.
pub(crate) const FORMAT: &str = "nertca-checkpoint-3";
/// Section of the header with the properties of the Gaussians.
pub(crate) const SECTION: &str = "gaussians";

/// Maximum number of nodes along an axis of a deformable set's grid, and of numbers per axis of own motion, far above those of any run.
const MAX_NODES: u32 = 512;
const MAX_BASIS: u32 = 256;

/// Properties of the Gaussians that tensors do not contain.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct GaussianHeader {
    /// World units (100 mm) of a pixel at the isocentre, the unit of all lengths.
    pixel: f64,
    /// Line integral that counts as 1.
    strongest: f64,
    /// Number of standard deviations at which a Gaussian is cut off.
    cut: f32,
    /// Bounds of the scales, pixels; files keep their first names.
    #[serde(rename = "least_scale")]
    min_scale: f32,
    #[serde(rename = "greatest_scale")]
    max_scale: f32,
    /// Iterations of the fit.
    step: u32,
    /// Number of views of the fit; 0 where it is not known.
    #[serde(default)]
    views: u32,
    /// The grid that moves a deformable set; none for a set per phase.
    grid: Option<GridHeader>,
    /// Whether the model consists of Gaussians alone, of which hundreds overlap.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    crowd: bool,
    /// Whether nearer Gaussians hide those behind them, so that each has an intensity.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    blended: bool,
    /// Share of the attenuation of one fit that lies in vessels of another; none for a single fit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    agreement: Option<f64>,
    /// Whether each Gaussian has the share of the other fits that have a vessel at its centre.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    agreements: bool,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct GridHeader {
    /// Nodes along each axis of a cube around the isocentre.
    nodes: u32,
    /// Half side of the cube, pixels.
    half_side: f32,
    /// Numbers per axis of a Gaussian's own motion.
    basis: u32,
    /// Rest phase, at which Gaussians are at their stored positions.
    #[serde(default)]
    rest_phase: u32,
    /// True where each Gaussian has a filling at each phase.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    filling: bool,
}

/// Name of the tensor of blended Gaussians' intensities.
const INTENSITY: &str = "gaussians.intensity";
/// Name of the tensor of agreements of fits.
const AGREEMENT: &str = "gaussians.agreement";
/// Name of the tensor of fillings.
const FILLING: &str = "gaussians.filling";

pub(crate) fn header(field: &GaussianField) -> GaussianHeader {
    let sets = field.rows();
    GaussianHeader {
        pixel: sets.units.pixel,
        strongest: sets.units.strongest,
        cut: sets.setup.cut,
        min_scale: sets.setup.min_scale,
        max_scale: sets.setup.max_scale,
        step: sets.step,
        views: sets.setup.n_views,
        crowd: sets.is_crowd,
        blended: sets.intensities.is_some(),
        agreement: sets.agreement.as_ref().map(|agreement| agreement.overall),
        agreements: sets.agreement.as_ref().is_some_and(|agreement| !agreement.of_gaussians.is_empty()),
        grid: match field {
            GaussianField::PerPhase(_) => None,
            GaussianField::Moving(moving) => Some(GridHeader {
                nodes: moving.setup.n_nodes,
                half_side: moving.setup.half_side,
                basis: moving.setup.n_basis,
                rest_phase: moving.setup.rest_phase,
                filling: moving.filling.is_some(),
            }),
        },
    }
}

pub(crate) fn tensors(field: &GaussianField) -> Vec<FileTensor> {
    let rows = &field.rows().rows;
    let floats = |name: &str, width: usize, of: &dyn Fn(&Gaussian) -> Vec<f32>| -> FileTensor {
        let bytes = rows.iter().flat_map(of).flat_map(f32::to_le_bytes).collect();
        let shape = if width == 1 { vec![rows.len()] } else { vec![rows.len(), width] };
        (format!("gaussians.{name}"), Dtype::F32, shape, bytes)
    };
    let mut all = vec![
        floats("position", 3, &|g| g.position.to_vec()),
        floats("log_scale", 3, &|g| g.log_scale.to_vec()),
        floats("rotation", 4, &|g| g.rotation.to_vec()),
        floats("log_density", 1, &|g| vec![g.log_density]),
    ];
    if let Some(intensities) = &field.rows().intensities {
        let bytes = intensities.iter().flat_map(|v| v.to_le_bytes()).collect();
        all.push((INTENSITY.into(), Dtype::F32, vec![rows.len()], bytes));
    }
    if let Some(agreement) = field.rows().agreement.as_ref().filter(|agreement| !agreement.of_gaussians.is_empty()) {
        let bytes = agreement.of_gaussians.iter().flat_map(|v| v.to_le_bytes()).collect();
        all.push((AGREEMENT.into(), Dtype::F32, vec![rows.len()], bytes));
    }
    match field {
        GaussianField::PerPhase(_) => {
            let phases = rows.iter().flat_map(|g| g.phase.to_le_bytes()).collect();
            all.push(("gaussians.phase".into(), Dtype::U32, vec![rows.len()], phases));
        }
        GaussianField::Moving(moving) => {
            let vectors = |name: &str, shape: Vec<usize>, values: &[[f32; 4]]| -> FileTensor {
                let bytes = values.iter().flat_map(|v| v[..3].to_vec()).flat_map(f32::to_le_bytes).collect();
                (format!("gaussians.{name}"), Dtype::F32, shape, bytes)
            };
            let (n, basis) = (moving.setup.n_nodes as usize, moving.setup.n_basis as usize);
            all.push(vectors("motion.grid", vec![moving.rest.n_phases, n, n, n, 3], &moving.grid));
            all.push(vectors("motion.own", vec![rows.len(), basis, 3], &moving.own));
            if let Some(filling) = &moving.filling {
                let bytes = filling.iter().flat_map(|v| v.to_le_bytes()).collect();
                all.push((FILLING.into(), Dtype::F32, vec![rows.len(), moving.rest.n_phases], bytes));
            }
        }
    }
    all
}

impl GaussianField {
    /// Returns the number of bytes that the field takes in a checkpoint.
    pub fn bytes(&self) -> usize {
        tensors(self).iter().map(|(.., bytes)| bytes.len()).sum()
    }
}

/// Reads the Gaussians of a checkpoint whose header has these `sections`.
///
/// # Errors
/// [`Error::Data`] naming what is missing, misshapen or not finite.
pub(crate) fn read_section(sections: &serde_json::Value, file: &File<'_>, n_phases: usize) -> Result<GaussianField> {
    let header: GaussianHeader = serde_json::from_value(sections[SECTION].clone())
        .map_err(|e| Error::data(file.path, SECTION, e.to_string()))?;
    read(&header, file, n_phases)
}

/// Reads the agreement of the fits whose mean a field of `n` Gaussians is; none for a single fit.
fn agreement(header: &GaussianHeader, file: &File<'_>, n: usize) -> Result<Option<FitAgreement>> {
    let Some(overall) = header.agreement else { return Ok(None) };
    let of_gaussians = if header.agreements { file.floats(AGREEMENT, &[Some(n)])? } else { Vec::new() };
    Ok(Some(FitAgreement { overall, of_gaussians }))
}

/// Reads the Gaussians that [`header`] and [`tensors`] describe.
pub(crate) fn read(header: &GaussianHeader, file: &File<'_>, n_phases: usize) -> Result<GaussianField> {
    let path = file.path;
    let positive = [header.pixel, header.strongest, header.cut.into(), header.min_scale.into()];
    if positive.iter().any(|v| !(v.is_finite() && *v > 0.0)) || header.max_scale < header.min_scale {
        return Err(Error::data(
            path,
            "gaussians",
            "pixel, strongest, cut, least_scale and greatest_scale must be positive and finite, and greatest_scale at \
             least least_scale",
        ));
    }
    let position = file.floats("gaussians.position", &[None, Some(3)])?;
    let n = position.len() / 3;
    let log_scale = file.floats("gaussians.log_scale", &[Some(n), Some(3)])?;
    let rotation = file.floats("gaussians.rotation", &[Some(n), Some(4)])?;
    let log_density = file.floats("gaussians.log_density", &[Some(n)])?;
    let phase = match &header.grid {
        None => file.words("gaussians.phase", n)?,
        Some(grid) => vec![grid.rest_phase; n],
    };
    if let Some(bad) = phase.iter().find(|p| **p as usize >= n_phases) {
        let field = if header.grid.is_some() { "gaussians.grid.rest_phase" } else { "gaussians.phase" };
        return Err(Error::data(path, field, format!("has phase {bad}, but phases go from 0 to below {n_phases}")));
    }
    let row = |i: usize| Gaussian {
        position: [0, 1, 2].map(|k| position[3 * i + k]),
        log_density: log_density[i],
        log_scale: [0, 1, 2].map(|k| log_scale[3 * i + k]),
        phase: phase[i],
        rotation: [0, 1, 2, 3].map(|k| rotation[4 * i + k]),
    };
    let sets = Gaussians {
        units: Units { pixel: header.pixel, strongest: header.strongest },
        n_phases,
        setup: GaussianSetup {
            n_views: header.views,
            n_phases: n_phases as u32,
            cut: header.cut,
            min_scale: header.min_scale,
            max_scale: header.max_scale,
            ..GaussianSetup::default()
        },
        rows: (0..n).map(row).collect(),
        step: header.step,
        is_crowd: header.crowd,
        intensities: header.blended.then(|| file.floats(INTENSITY, &[Some(n)])).transpose()?,
        agreement: agreement(header, file, n)?,
    };
    let Some(grid) = &header.grid else { return Ok(GaussianField::PerPhase(sets)) };
    if !(2..=MAX_NODES).contains(&grid.nodes)
        || grid.basis > MAX_BASIS
        || grid.half_side.is_nan()
        || grid.half_side <= 0.0
    {
        let problem = format!(
            "{} nodes, half side {} and {} basis functions are out of range",
            grid.nodes, grid.half_side, grid.basis
        );
        return Err(Error::data(path, "gaussians.grid", problem));
    }
    let nodes = Some(grid.nodes as usize);
    let vectors = |name: &str, shape: &[Option<usize>]| -> Result<Vec<[f32; 4]>> {
        let values = file.floats(name, shape)?;
        Ok(values.chunks_exact(3).map(|v| [v[0], v[1], v[2], 0.0]).collect())
    };
    let filling = grid.filling.then(|| file.floats(FILLING, &[Some(n), Some(n_phases)])).transpose()?;
    if let Some(bad) = filling.iter().flatten().find(|v| !(**v > 0.0 && **v <= 1.0)) {
        return Err(Error::data(path, FILLING, format!("has the value {bad}, but fillings are above 0 and at most 1")));
    }
    Ok(GaussianField::Moving(MovingGaussians {
        setup: MotionGridSetup {
            n_nodes: grid.nodes,
            half_side: grid.half_side,
            inverse_step: inverse_step(grid.nodes, grid.half_side),
            n_basis: grid.basis,
            rest_phase: grid.rest_phase,
            ..MotionGridSetup::default()
        },
        grid: vectors("gaussians.motion.grid", &[Some(n_phases), nodes, nodes, nodes, Some(3)])?,
        own: vectors("gaussians.motion.own", &[Some(n), Some(grid.basis as usize), Some(3)])?,
        filling,
        rest: sets,
    }))
}
