//! Geometry of a single run that the user states, in place of what its file says or does not say.

/// Geometry of a run as the user states it; it takes precedence over the file.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StatedGeometry {
    /// Distance from source to detector, mm.
    pub sid_mm: Option<f64>,
    /// Distance from source to isocentre, mm.
    pub sod_mm: Option<f64>,
    /// Primary and secondary angle, degrees (LAO and cranial positive), of all frames.
    pub angles_deg: Option<[f64; 2]>,
    /// Pixel pitch on the detector along columns and rows, mm.
    pub pixel_mm: Option<[f64; 2]>,
}
