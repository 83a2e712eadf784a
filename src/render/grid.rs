//! Regular grids of points, in world units and in patient coordinates.

use crate::error::{Error, Result};
use glam::DVec3;

/// A regular grid of points in world units (100 mm), x fastest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grid {
    /// First point.
    pub origin: DVec3,
    /// Distance between neighbours along each axis.
    pub spacing: DVec3,
    /// Points along x, y, z.
    pub size: [u32; 3],
}

impl Grid {
    /// Returns a grid with `cells` points along the longest side of a box, and as many along the others as give the same
    /// spacing; the first and last lie on its faces.
    pub fn over(low: DVec3, high: DVec3, cells: u32) -> Grid {
        let extent = high - low;
        let step = extent.max_element() / f64::from(cells - 1);
        let size = extent.to_array().map(|e| ((e / step).round() as u32 + 1).max(2));
        let spacing = extent / DVec3::from_array(size.map(|n| f64::from(n - 1)));
        Grid { origin: low, spacing, size }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.size.iter().map(|n| *n as usize).product()
    }

    /// Tells whether the grid has no points.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// A regular grid of points in patient coordinates (left, posterior, superior), mm; left is the fastest axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PatientGrid {
    /// First point.
    pub origin_mm: DVec3,
    /// Distance between neighbours along each axis.
    pub spacing_mm: DVec3,
    /// Points along each axis.
    pub size: [u32; 3],
}

impl PatientGrid {
    /// Refuses grids that cannot be sampled.
    ///
    /// # Errors
    /// [`Error::Config`].
    pub fn check(&self) -> Result<()> {
        let spacing = self.spacing_mm;
        if !(self.origin_mm.is_finite() && spacing.is_finite() && spacing.min_element() > 0.0) {
            return Err(Error::config("grid", spacing, "origin and spacing must be finite, spacing positive"));
        }
        if self.size.iter().any(|n| *n == 0 || *n > 4096) {
            return Err(Error::config(
                "grid",
                format!("{:?}", self.size),
                "is out of range: 1 to 4096 points along each axis are accepted",
            ));
        }
        Ok(())
    }

    /// Returns a range of its slices as a grid.
    pub fn slices(&self, slices: std::ops::Range<u32>) -> PatientGrid {
        let [nx, ny, _] = self.size;
        let origin_mm = self.origin_mm + DVec3::Z * self.spacing_mm.z * f64::from(slices.start);
        PatientGrid { origin_mm, size: [nx, ny, slices.len() as u32], ..*self }
    }
}
