//! Tells whether other views may show a vessel somewhere on a ray.

use crate::calibrate::observed::Observed;
use crate::geometry::ViewRays;
use crate::raster::widened;
use glam::{DMat3, DVec3};

/// Number of depths sampled along a ray to either side of the isocentre, as a share of the image's longer side; their step
/// is one pixel at the isocentre.
const DEPTHS_PER_SIDE: f64 = 0.5;

/// Evidence of a view for a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Evidence {
    /// The point is beyond the image's edge, or hidden.
    Unseen,
    /// A vessel is possible at the point.
    Vessel,
    /// No vessel is at the point.
    Nothing,
}

/// Vessels of a view at a phase.
struct ViewVessels<'a> {
    source: DVec3,
    inverse: DMat3,
    size: [usize; 2],
    visible: &'a [bool],
    vessels: Vec<bool>,
}

impl ViewVessels<'_> {
    fn look(&self, point: DVec3) -> Evidence {
        let h = self.inverse * (point - self.source);
        let (i, j) = ((h.x / h.z).round(), (h.y / h.z).round());
        let inside = h.z > 0.0 && i >= 0.0 && j >= 0.0 && i < self.size[0] as f64 && j < self.size[1] as f64;
        if !inside {
            return Evidence::Unseen;
        }
        let pixel = j as usize * self.size[0] + i as usize;
        match (self.visible[pixel], self.vessels[pixel]) {
            (false, _) => Evidence::Unseen,
            (true, true) => Evidence::Vessel,
            (true, false) => Evidence::Nothing,
        }
    }
}

/// All views but one, at a phase.
pub(super) struct Others<'a> {
    /// Columns and rows of the images.
    pub(super) size: [usize; 2],
    sights: Vec<ViewVessels<'a>>,
}

impl<'a> Others<'a> {
    /// Returns the views other than `view` that have an image at `phase`, with geometry by `rays` and their vessels widened
    /// by `near` pixels; `None` where no other view has an image.
    pub(super) fn of(
        observed: &'a Observed,
        view: usize,
        phase: usize,
        near: usize,
        rays: impl Fn(usize) -> ViewRays,
    ) -> Option<Others<'a>> {
        let size = observed.fine.views[view].size;
        let sight = |v: usize| {
            let rays = rays(v);
            let basis = DMat3::from_cols(rays.direction[1], rays.direction[2], rays.direction[0]);
            Some(ViewVessels {
                source: rays.source(),
                inverse: basis.inverse(),
                size,
                visible: &observed.visible[v],
                vessels: widened(observed.shown[v][phase].as_ref()?, size, near),
            })
        };
        let sights: Vec<ViewVessels> = (0..observed.views.len()).filter(|v| *v != view).filter_map(sight).collect();
        (!sights.is_empty()).then_some(Others { size, sights })
    }

    /// Tells whether there is a place on the ray of a pixel, possibly beyond the image, where at least one view shows a
    /// vessel and every view that sees the place does.
    pub(super) fn may_show(&self, rays: &ViewRays, column: f64, row: f64) -> bool {
        let pixel = 0.5 * (rays.anchor[1].length() + rays.anchor[2].length());
        let half = (DEPTHS_PER_SIDE * self.size[0].max(self.size[1]) as f64) as i64;
        let (anchor, direction) = rays.pixel(column, row);
        (-half..=half).any(|k| {
            let point = anchor + direction * (k as f64 * pixel);
            let mut vessel = false;
            let contradicted = self.sights.iter().any(|sight| {
                let look = sight.look(point);
                vessel |= look == Evidence::Vessel;
                look == Evidence::Nothing
            });
            vessel && !contradicted
        })
    }
}
