//! Checks of every frame, whether it comes from a file or from a caller.

use crate::geometry::{Geometry, MM_PER_UNIT};
use crate::scan::dataset::View;

/// Problem with a frame.
pub struct Complaint {
    /// Field of the frame.
    pub field: String,
    /// Value of the field.
    pub value: String,
    /// Explanation why the value is not accepted.
    pub problem: String,
}

impl Complaint {
    /// Makes a complaint about a field.
    pub fn new(field: &str, value: impl ToString, problem: impl ToString) -> Complaint {
        Complaint { field: field.into(), value: value.to_string(), problem: problem.to_string() }
    }
}

/// Rejects values that are not finite and names the pixel.
pub fn check_values(values: &[f32], width: usize) -> Result<(), Complaint> {
    match values.iter().position(|v| !v.is_finite()) {
        Some(at) => {
            let pixel = format!("column {}, row {}", at % width, at / width);
            Err(Complaint::new("pixels", pixel, format!("{} is not a finite number", values[at])))
        }
        None => Ok(()),
    }
}

/// Rejects a time, counted in phases, outside the beat.
pub fn check_phase(time_phases: f64, n_phases: u32) -> Result<(), Complaint> {
    if (0.0..f64::from(n_phases)).contains(&time_phases) {
        return Ok(());
    }
    let problem = format!(
        "is out of range: phases go from 0 to {}, and times between two phases from 0 to below {n_phases}",
        n_phases.saturating_sub(1)
    );
    Err(Complaint::new("phase", time_phases, problem))
}

/// Makes a view of images of `size` (columns, rows) and checks that its source lies outside the searched depth range, which
/// begins `depth_before` world units before the isocentre.
pub fn checked_view(geometry: Geometry, size: [usize; 2], depth_before: f64) -> Result<View, Complaint> {
    let view = View::new(geometry, size).map_err(|(field, problem)| Complaint::new(&field, "", problem))?;
    if view.rays.sod <= depth_before {
        let problem =
            format!("is too small: the source is inside the depth range of {:.0} mm", depth_before * MM_PER_UNIT);
        return Err(Complaint::new("sod_mm", format!("{:.0}", view.rays.sod * MM_PER_UNIT), problem));
    }
    Ok(view)
}
