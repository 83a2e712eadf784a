//! Angiograms that need no file, small enough for f64 twins, for tests and the self-test.

use crate::error::{Error, Result};
use crate::geometry::{CArm, Geometry, ViewRays};
use crate::scan::dataset::{Dataset, Frame, Layout, Split, View};
use std::path::PathBuf;

/// Rays of a view's pixels.
///
/// # Errors
/// [`Error::Config`] for an impossible geometry or size.
pub fn rays(geometry: &Geometry, width: usize, height: usize) -> Result<ViewRays> {
    let size = format!("{width} x {height}");
    geometry.rays(width, height).map_err(|(field, problem)| Error::config(field, size, problem))
}

/// A smooth blob that moves over the phases in front of a still gradient, seen from three sides; the last image is unseen.
///
/// # Errors
/// [`Error::Config`] for an impossible size.
pub fn small_dataset(width: usize, height: usize, n_phases: u32) -> Result<Dataset> {
    let mut views = Vec::new();
    let mut frames = Vec::new();
    for (v, (primary_deg, secondary_deg)) in [(-30.0, 20.0), (40.0, -10.0), (85.0, 15.0)].into_iter().enumerate() {
        let geometry = Geometry::CArm(CArm {
            primary_deg,
            secondary_deg,
            sid_mm: 1000.0,
            sod_mm: 600.0,
            pixel_mm: [120.0 / width as f64, 120.0 / height as f64],
            offset_mm: [1.0, -2.0],
            table_mm: [0.0; 3],
        });
        views.push(View { rays: rays(&geometry, width, height)?, size: [width, height], geometry });
        for phase in 0..n_phases {
            // The path is that of three phases, in as many steps as there are phases.
            let along = 3.0 * f64::from(phase) / f64::from(n_phases);
            let centre = (0.4 + 0.1 * along, 0.5 - 0.05 * v as f64);
            let integrals = (0..width * height)
                .map(|p| {
                    let (x, y) = ((p % width) as f64 / width as f64, (p / width) as f64 / height as f64);
                    let d2 = (x - centre.0).powi(2) + (y - centre.1).powi(2);
                    (0.8 + 0.3 * x - 0.2 * y + 0.5 * (-d2 / 0.005).exp()) as f32
                })
                .collect();
            let split = if v == 2 && phase + 1 == n_phases { Split::Validation } else { Split::Train };
            frames.push(Frame {
                name: format!("v{v}p{phase}"),
                view: v,
                phase,
                split,
                integrals,
                mask: None,
                after_phase: 0.0,
                heart_shift_mm: [0.0; 3],
                contrast: 1.0,
            });
        }
    }
    frames.sort_by_key(|f| f.split);
    Ok(Dataset {
        path: PathBuf::from("test"),
        layout: Layout::Native,
        views,
        frames,
        width,
        height,
        n_phases,
        depth_range: (-0.9, 0.9),
        hidden: Default::default(),
        vessel_attenuation: Some(1.0),
        still: false,
        vessels_alone: false,
        views_adjusted: false,
        prior: None,
        notes: Vec::new(),
    })
}

/// A dataset like [`small_dataset`] of three phases, with some images taken between two, before and after the nearest.
///
/// # Errors
/// As [`small_dataset`].
pub fn uneven_dataset(width: usize, height: usize) -> Result<Dataset> {
    let mut dataset = small_dataset(width, height, 3)?;
    // Exact in f16.
    let after = [0.0, 0.25, -0.375, 0.5].into_iter().cycle();
    dataset.frames.iter_mut().zip(after).for_each(|(frame, after)| frame.after_phase = after);
    Ok(dataset)
}
