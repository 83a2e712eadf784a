//! Datasets of one phase, for static methods.

use nertca_vk::geometry::{CArm, Geometry};
use nertca_vk::scan::dataset::{Dataset, Frame, Layout, Split, View};

/// Images of a C-arm, `(primary, secondary)` degrees each, all of one phase unless stated otherwise.
pub fn dataset(angles: &[[f64; 2]], [width, height]: [usize; 2], image: impl Fn(usize, &View) -> Vec<f32>) -> Dataset {
    let view = |angles: &[f64; 2]| {
        let geometry = Geometry::CArm(CArm {
            primary_deg: angles[0],
            secondary_deg: angles[1],
            sid_mm: 1000.0,
            sod_mm: 620.0,
            pixel_mm: [1.5, 1.8],
            offset_mm: [0.0; 2],
            table_mm: [0.0; 3],
        });
        View::new(geometry, [width, height]).unwrap()
    };
    let views: Vec<View> = angles.iter().map(view).collect();
    let frame = |(v, view): (usize, &View)| Frame {
        name: format!("v{v}"),
        view: v,
        phase: 0,
        split: Split::Train,
        integrals: image(v, view).into(),
        mask: None,
        after_phase: 0.0,
        heart_shift_mm: [0.0; 3],
        contrast: 1.0,
    };
    Dataset {
        path: "test".into(),
        layout: Layout::Native,
        frames: views.iter().enumerate().map(frame).collect(),
        views,
        width,
        height,
        n_phases: 1,
        notes: Vec::new(),
        depth_range: (-0.5, 0.5),
        hidden: Default::default(),
        vessel_attenuation: None,
        still: false,
        vessels_alone: false,
        views_adjusted: false,
        prior: None,
    }
}
