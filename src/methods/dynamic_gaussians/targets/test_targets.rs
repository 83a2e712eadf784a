//! Small targets for the tests of this room.

use crate::config::sections::LeftOut;
use crate::config::{Config, Preset};
use crate::gaussians::field::Units;
use crate::gaussians::view::SplatView;
use crate::geometry::{CArm, Geometry};
use crate::methods::dynamic_gaussians::rules::Rules;
use crate::methods::dynamic_gaussians::targets::Targets;
use crate::methods::dynamic_gaussians::targets::lengths::Lengths;
use crate::methods::dynamic_gaussians::targets::shared_images::SharedImages;

/// Columns and rows.
pub const SIDE: usize = 40;
/// Cardiac phases.
pub const PHASES: usize = 10;

/// Targets of images `[phase][view][pixel]`, from the minimum of each pixel over the phases.
pub fn targets(images: &[f32], n_views: usize) -> Targets {
    let geometry = CArm {
        primary_deg: 0.0,
        secondary_deg: 0.0,
        sid_mm: 1000.0,
        sod_mm: 700.0,
        pixel_mm: [1.0; 2],
        offset_mm: [0.0; 2],
        table_mm: [0.0; 3],
    };
    let units = Units { pixel: 0.01, strongest: 1.0 };
    let (n, n_images) = (SIDE * SIDE * n_views, PHASES * n_views);
    let min = |p: usize| (0..PHASES).map(|t| images[t * n + p % n]).fold(f32::MAX, f32::min);
    let low: Vec<f32> = (0..images.len()).map(|p| images[p] - min(p)).collect();
    Targets {
        units,
        width: SIDE,
        height: SIDE,
        n_phases: PHASES,
        n_views,
        views: vec![SplatView::new(&Geometry::CArm(geometry).rays(SIDE, SIDE).unwrap(), units); n_images],
        image_of: (0..n_images).map(Some).collect(),
        n_images,
        images: images.to_vec(),
        max: None,
        high: low.iter().map(|v| v + 1.0).collect(),
        weight: SharedImages::of_each(vec![1.0; low.len()], SIDE * SIDE),
        noise: SharedImages::of_each(vec![0.01; low.len()], SIDE * SIDE),
        contrast: vec![1.0; n_images],
        low,
        lengths: Lengths { factor: 1.0, smoothing: 1.0 },
        rest_phase: 0,
        contrast_comes_and_goes: false,
        views_adjusted: false,
        left_out: LeftOut::default(),
        places: vec![Vec::new(); PHASES],
        cell: 1.0,
    }
}

/// Returns the numbers of the default run.
pub fn rules() -> Rules {
    Rules::of(&Config::preset(Preset::Fast).of().unwrap())
}
