//! What every frame must satisfy, whether it comes from a file or from a caller.

use crate::geometry::{Geometry, MM_PER_UNIT};
use crate::scan::dataset::View;

/// What is wrong with a frame.
pub(crate) struct Complaint {
    /// Part of the frame.
    pub(crate) field: String,
    /// What it is.
    pub(crate) value: String,
    /// Why that cannot be.
    pub(crate) problem: String,
}

impl Complaint {
    pub(crate) fn new(field: &str, value: impl ToString, problem: impl ToString) -> Complaint {
        Complaint { field: field.into(), value: value.to_string(), problem: problem.to_string() }
    }
}

/// Refuses a value that is no number, naming its pixel.
pub(crate) fn check_values(values: &[f32], width: usize) -> Result<(), Complaint> {
    match values.iter().position(|v| !v.is_finite()) {
        Some(at) => {
            let pixel = format!("column {}, row {}", at % width, at / width);
            Err(Complaint::new("pixels", pixel, format!("{} is not a finite number", values[at])))
        }
        None => Ok(()),
    }
}

/// Refuses a time, counted in phases, that there is not.
pub(crate) fn check_phase(time_phases: f64, n_phases: u32) -> Result<(), Complaint> {
    if (0.0..f64::from(n_phases)).contains(&time_phases) {
        return Ok(());
    }
    let problem = format!(
        "phases go from 0 to {}, and what lies between two from 0 to below {n_phases}",
        n_phases.saturating_sub(1)
    );
    Err(Complaint::new("phase", time_phases, problem))
}

/// A view of images of `size` (columns, rows) whose source stands before what is searched, `depth_before` world units from the
/// isocentre on.
pub(crate) fn checked_view(geometry: Geometry, size: [usize; 2], depth_before: f64) -> Result<View, Complaint> {
    let view = View::new(geometry, size).map_err(|(field, problem)| Complaint::new(&field, "", problem))?;
    if view.rays.sod <= depth_before {
        let problem = format!("the source stands inside the depth range of {:.0} mm", depth_before * MM_PER_UNIT);
        return Err(Complaint::new("sod_mm", format!("{:.0}", view.rays.sod * MM_PER_UNIT), problem));
    }
    Ok(view)
}
