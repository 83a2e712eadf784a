//! State of a fit of X-Gaussian in a checkpoint: tensors under documented names.

use crate::error::{Error, Result};
use crate::kernels::layout::{BlendGaussian, XStatistics};
use crate::methods::x_gaussian::state::XState;
use crate::tensors::{File, FileTensor};
use safetensors::tensor::Dtype;

/// Number of parameters of a Gaussian: position, opacity, scale, intensity, rotation.
const N_NUMBERS: usize = 12;

pub(super) fn tensors(state: &XState) -> Vec<FileTensor> {
    let n = state.rows.len();
    let floats = |name: &str, width: usize, values: Vec<f32>| -> FileTensor {
        let shape = if width == 1 { vec![n] } else { vec![n, width] };
        (format!("x.{name}"), Dtype::F32, shape, values.into_iter().flat_map(f32::to_le_bytes).collect())
    };
    let of_rows = |of: &dyn Fn(&BlendGaussian) -> Vec<f32>| state.rows.iter().flat_map(of).collect();
    let moments = |all: &[[f32; N_NUMBERS]]| all.iter().flatten().copied().collect();
    let sets = state.sets.iter().flat_map(|set| set.to_le_bytes()).collect();
    let statistics = state.statistics.iter().flat_map(|s| [s.pull, s.seen, s.radius]).collect();
    vec![
        floats("position", 3, of_rows(&|g| g.position.to_vec())),
        floats("opacity", 1, of_rows(&|g| vec![g.opacity])),
        floats("scale", 3, of_rows(&|g| g.log_scale.to_vec())),
        floats("intensity", 1, of_rows(&|g| vec![g.intensity])),
        floats("rotation", 4, of_rows(&|g| g.rotation.to_vec())),
        ("x.set".into(), Dtype::U32, vec![n], sets),
        floats("adam.m", N_NUMBERS, moments(&state.first)),
        floats("adam.v", N_NUMBERS, moments(&state.second)),
        floats("statistics", 3, statistics),
    ]
}

/// Reads the state that [`tensors`] describes, of a run on `n_phases` phases.
pub(super) fn read(file: &File<'_>, n_phases: usize) -> Result<XState> {
    let position = file.floats("x.position", &[None, Some(3)])?;
    let n = position.len() / 3;
    let opacity = file.floats("x.opacity", &[Some(n)])?;
    let scale = file.floats("x.scale", &[Some(n), Some(3)])?;
    let intensity = file.floats("x.intensity", &[Some(n)])?;
    let rotation = file.floats("x.rotation", &[Some(n), Some(4)])?;
    let sets = file.words("x.set", n)?;
    if let Some(bad) = sets.iter().find(|set| **set as usize >= n_phases) {
        return Err(Error::data(file.path, "x.set", format!("has set {bad}, but sets go from 0 to below {n_phases}")));
    }
    let row = |i: usize| BlendGaussian {
        position: [0, 1, 2].map(|k| position[3 * i + k]),
        opacity: opacity[i],
        log_scale: [0, 1, 2].map(|k| scale[3 * i + k]),
        intensity: intensity[i],
        rotation: [0, 1, 2, 3].map(|k| rotation[4 * i + k]),
    };
    let moments = |name: &str| -> Result<Vec<[f32; N_NUMBERS]>> {
        let values = file.floats(name, &[Some(n), Some(N_NUMBERS)])?;
        Ok(values.as_chunks::<N_NUMBERS>().0.to_vec())
    };
    let statistics = file.floats("x.statistics", &[Some(n), Some(3)])?;
    let statistics = statistics.as_chunks::<3>().0.iter();
    Ok(XState {
        rows: (0..n).map(row).collect(),
        sets,
        first: moments("x.adam.m")?,
        second: moments("x.adam.v")?,
        statistics: statistics.map(|&[pull, seen, radius]| XStatistics { pull, seen, radius }).collect(),
    })
}
