//! State of a fit of R2-Gaussian in a checkpoint: tensors under documented names.

use crate::error::{Error, Result};
use crate::kernels::layout::R2Gaussian;
use crate::methods::r2_gaussian::state::R2State;
use crate::tensors::{File, FileTensor};
use safetensors::tensor::Dtype;

/// Number of parameters of a Gaussian: position, density, scale, rotation.
const N_NUMBERS: usize = 11;
/// Index of each parameter's moment in a row of twelve, of which number 7 is unused.
const PLACES: [usize; N_NUMBERS] = [0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 11];

pub(super) fn tensors(state: &R2State) -> Vec<FileTensor> {
    let n = state.rows.len();
    let floats = |name: &str, width: usize, values: Vec<f32>| -> FileTensor {
        let shape = if width == 1 { vec![n] } else { vec![n, width] };
        (format!("r2.{name}"), Dtype::F32, shape, values.into_iter().flat_map(f32::to_le_bytes).collect())
    };
    let of_rows = |of: &dyn Fn(&R2Gaussian) -> Vec<f32>| state.rows.iter().flat_map(of).collect();
    let moments = |all: &[[f32; 12]]| all.iter().flat_map(|m| PLACES.map(|k| m[k])).collect();
    let sets = state.rows.iter().flat_map(|g| g.set.to_le_bytes()).collect();
    vec![
        floats("position", 3, of_rows(&|g| g.position.to_vec())),
        floats("density", 1, of_rows(&|g| vec![g.density])),
        floats("scale", 3, of_rows(&|g| g.scale.to_vec())),
        floats("rotation", 4, of_rows(&|g| g.rotation.to_vec())),
        ("r2.set".into(), Dtype::U32, vec![n], sets),
        floats("adam.m", N_NUMBERS, moments(&state.first)),
        floats("adam.v", N_NUMBERS, moments(&state.second)),
        floats("statistics", 2, state.statistics.iter().flatten().copied().collect()),
    ]
}

/// Reads the state that [`tensors`] describes, of a run on `n_phases` phases.
pub(super) fn read(file: &File<'_>, n_phases: usize) -> Result<R2State> {
    let position = file.floats("r2.position", &[None, Some(3)])?;
    let n = position.len() / 3;
    let density = file.floats("r2.density", &[Some(n)])?;
    let scale = file.floats("r2.scale", &[Some(n), Some(3)])?;
    let rotation = file.floats("r2.rotation", &[Some(n), Some(4)])?;
    let sets = file.words("r2.set", n)?;
    if let Some(bad) = sets.iter().find(|set| **set as usize >= n_phases) {
        return Err(Error::data(file.path, "r2.set", format!("has set {bad}, but sets go from 0 to below {n_phases}")));
    }
    let row = |i: usize| R2Gaussian {
        position: [0, 1, 2].map(|k| position[3 * i + k]),
        density: density[i],
        scale: [0, 1, 2].map(|k| scale[3 * i + k]),
        set: sets[i],
        rotation: [0, 1, 2, 3].map(|k| rotation[4 * i + k]),
    };
    let moments = |name: &str| -> Result<Vec<[f32; 12]>> {
        let values = file.floats(name, &[Some(n), Some(N_NUMBERS)])?;
        let placed = |numbers: &[f32]| {
            let mut row = [0.0; 12];
            PLACES.iter().zip(numbers).for_each(|(at, value)| row[*at] = *value);
            row
        };
        Ok(values.chunks_exact(N_NUMBERS).map(placed).collect())
    };
    let statistics = file.floats("r2.statistics", &[Some(n), Some(2)])?;
    Ok(R2State {
        rows: (0..n).map(row).collect(),
        first: moments("r2.adam.m")?,
        second: moments("r2.adam.v")?,
        statistics: statistics.chunks_exact(2).map(|pair| [pair[0], pair[1]]).collect(),
    })
}
