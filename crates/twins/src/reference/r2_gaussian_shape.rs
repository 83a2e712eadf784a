//! Centre, scales and pixels of a Gaussian, for the twins of R2-Gaussian.

use crate::kernels::layout::GaussianSetup;
use crate::methods::r2_gaussian::parameters::ScaleBounds;
use crate::reference::gaussians::Params;
use glam::{DVec2, DVec3};

pub(super) fn position(p: &Params) -> DVec3 {
    DVec3::new(p[0], p[1], p[2])
}

pub(super) fn scale(p: &Params, setup: &GaussianSetup) -> DVec3 {
    DVec3::new(p[4], p[5], p[6]).map(|stored| bounds(setup).scale(stored))
}

/// Index and offset from the centre of every pixel of a box with these half sides.
pub(super) fn pixels_within(
    middle: DVec2,
    half: DVec2,
    setup: &GaussianSetup,
) -> impl Iterator<Item = (usize, DVec2)> + use<> {
    let (width, height) = (i64::from(setup.width), i64::from(setup.height));
    let (first, last) = ((middle - half).ceil(), (middle + half).floor());
    let along = |first: f64, last: f64, n: i64| first.max(0.0) as i64..(last.max(-1.0) as i64 + 1).min(n);
    let (columns, rows) = (along(first.x, last.x, width), along(first.y, last.y, height));
    rows.flat_map(move |y| {
        columns.clone().map(move |x| ((y * width + x) as usize, DVec2::new(x as f64, y as f64) - middle))
    })
}

pub(super) fn bounds(setup: &GaussianSetup) -> ScaleBounds {
    ScaleBounds { min: setup.min_scale.into(), max: setup.max_scale.into() }
}
