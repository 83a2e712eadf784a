//! Extent of the region that the views of a dataset see, and a note about frames taken between two phases.

use crate::geometry::MM_PER_UNIT;
use crate::scan::dataset::Dataset;

/// Maximum half side of the static field's box, radii of the field of view. Boxes of 1.0, 2.4 and 4.9 radii have a lower PSNR
/// (docs/tried.md, static field).
const STATIC_FIELDS_OF_VIEW: f64 = 1.6;

/// Radius around the isocentre that the views see, world units.
pub(crate) fn field_of_view(dataset: &Dataset) -> f64 {
    let mut radius = 0f64;
    for view in dataset.training_views() {
        let [w, h] = dataset.views[view].size.map(|n| n as f64 - 0.5);
        for (i, j) in [(-0.5, -0.5), (w, -0.5), (-0.5, h), (w, h)] {
            radius = radius.max(dataset.views[view].rays.pixel(i, j).0.length());
        }
    }
    radius
}

/// Half side of a box around the isocentre, world units: as stated, or large enough for what the views see.
pub(crate) fn box_half(stated_mm: f64, dataset: &Dataset) -> f64 {
    if stated_mm > 0.0 {
        return stated_mm / MM_PER_UNIT;
    }
    half_depth(dataset).min(STATIC_FIELDS_OF_VIEW * field_of_view(dataset))
}

/// Half side of a static method's volume, a cube around the isocentre, world units: as stated, or the default of [`box_half`].
pub(crate) fn volume_half(stated_mm: f64, dataset: &Dataset) -> f64 {
    box_half(stated_mm, dataset)
}

pub(crate) fn half_depth(dataset: &Dataset) -> f64 {
    dataset.depth_range.0.abs().max(dataset.depth_range.1.abs())
}

/// Half side of the box that the views see within the depth range, world units.
pub(crate) fn seen_half(dataset: &Dataset) -> f64 {
    field_of_view(dataset).min(half_depth(dataset))
}

/// Returns a note that counts the frames taken between two phases and tells their `fate`; none without such frames.
pub(crate) fn between_phases(dataset: &Dataset, fate: &str) -> Option<String> {
    let n = dataset.training().iter().filter(|f| f.after_phase != 0.0).count();
    (n > 0).then(|| format!("{n} of {} frames were taken between two phases and {fate}", dataset.training().len()))
}
