//! SAX-NeRF's field and the state of its fit in a checkpoint: tensors under documented names.

use crate::error::{Error, Result};
use crate::fitting::fit::SavedAt;
use crate::methods::sax_nerf::field::{ParamGroup, SaxField, SaxShape, SaxState};
use crate::tensors::{File, FileTensor};
use safetensors::tensor::Dtype;
use serde::{Deserialize, Serialize};

/// Properties of the field that tensors and configuration do not contain.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct SaxHeader {
    /// Half side of the box of the grid, world units (100 mm).
    bound: f64,
    /// First and last depth along rays, world units from the isocentre.
    depths: [f64; 2],
    /// Samples of a ray.
    samples: u32,
    /// Attenuation per world unit where the density is 1.
    attenuation: f64,
    /// Fields: one for each phase, or one for all.
    sets: usize,
}

/// Returns the header of a checkpoint for a field.
pub(super) fn header(field: &SaxField) -> SaxHeader {
    SaxHeader {
        bound: field.bound,
        depths: field.depths,
        samples: field.samples,
        attenuation: field.attenuation,
        sets: field.n_sets,
    }
}

/// Returns the name of the tensor of a group of parameters, and its shape for `n_sets` sets.
fn described(prefix: &str, part: &ParamGroup, n_sets: usize) -> (String, Vec<usize>) {
    (format!("sax.{prefix}{}", part.name), [&[n_sets], &part.shape[..]].concat())
}

/// Returns field and state as tensors.
pub(super) fn tensors(field: &SaxField, state: &SaxState) -> Vec<FileTensor> {
    let mut all = Vec::new();
    for part in field.shape.parts() {
        let range = part.first..part.first + part.len();
        let values = field.params.iter().flat_map(|set| &set[range.clone()]);
        let moments = |k: usize| state.moments.iter().flat_map(|set| &set[range.clone()]).map(move |m| m[k]);
        let mut add = |prefix: &str, bytes: Vec<u8>| {
            let (name, shape) = described(prefix, &part, field.n_sets);
            all.push((name, Dtype::F32, shape, bytes));
        };
        add("", values.flat_map(|v| v.to_le_bytes()).collect());
        add("adam.m.", moments(0).flat_map(f32::to_le_bytes).collect());
        add("adam.v.", moments(1).flat_map(f32::to_le_bytes).collect());
    }
    all
}

/// Reads the field and state that [`header`] and [`tensors`] describe, of a run on `n_phases` phases.
pub(super) fn read(
    header: &SaxHeader,
    shape: SaxShape,
    file: &File<'_>,
    SavedAt { n_phases, step }: SavedAt,
) -> Result<(SaxField, SaxState)> {
    let path = file.path;
    let [near, far] = header.depths;
    let is_positive = |v: f64| v.is_finite() && v > 0.0;
    if !is_positive(header.bound) || !is_positive(header.attenuation) || !is_positive(far - near) || header.samples < 2
    {
        return Err(Error::data(
            path,
            "sax",
            "bound, attenuation and the extent of depths must be positive and finite, and samples at least 2",
        ));
    }
    if header.sets != 1 && header.sets != n_phases {
        return Err(Error::data(
            path,
            "sax.sets",
            format!("is {} where 1 or {n_phases}, the number of phases, is needed", header.sets),
        ));
    }
    let n_sets = header.sets;
    // Memory is allocated only for data that the file really holds, in case it is damaged.
    let parts = shape.parts();
    let of_part = |prefix: &str, part: &ParamGroup| -> Result<Vec<f32>> {
        let (name, shape) = described(prefix, part, n_sets);
        file.floats(&name, &shape.iter().map(|n| Some(*n)).collect::<Vec<_>>())
    };
    let grid = parts.iter().find(|part| part.name == "grid");
    grid.map(|part| of_part("", part)).transpose()?;
    let mut params = vec![vec![0f32; shape.n_params()]; n_sets];
    let mut moments = vec![vec![[0f32; 2]; shape.n_params()]; n_sets];
    for part in &parts {
        let range = part.first..part.first + part.len();
        let values = of_part("", part)?;
        for (set, values) in params.iter_mut().zip(values.chunks_exact(part.len())) {
            set[range.clone()].copy_from_slice(values);
        }
        for (k, prefix) in ["adam.m.", "adam.v."].into_iter().enumerate() {
            let values = of_part(prefix, part)?;
            for (set, values) in moments.iter_mut().zip(values.chunks_exact(part.len())) {
                set[range.clone()].iter_mut().zip(values).for_each(|(moment, value)| moment[k] = *value);
            }
        }
    }
    let SaxHeader { bound, depths, samples, attenuation, .. } = *header;
    Ok((SaxField { shape, bound, depths, samples, attenuation, n_sets, params, step }, SaxState { moments }))
}
