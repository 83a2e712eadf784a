//! Views of a model's C-arm at other angles.

use nertca_vk::error::{Error, Result};
use nertca_vk::geometry::{CArm, Geometry, ViewRays};
use nertca_vk::model::Model;

/// Rays and image size of a rendering.
pub struct Viewpoint {
    pub rays: ViewRays,
    pub width: usize,
    pub height: usize,
}

/// Returns the model's C-arm at other angles, with the same field of view on `width` x `height` pixels.
pub fn turned(model: &Model, primary_deg: f64, secondary_deg: f64, [width, height]: [usize; 2]) -> CArm {
    CArm {
        primary_deg,
        secondary_deg,
        pixel_mm: [
            model.c_arm.pixel_mm[0] * model.image_size[0] as f64 / width as f64,
            model.c_arm.pixel_mm[1] * model.image_size[1] as f64 / height as f64,
        ],
        ..model.c_arm.clone()
    }
}

/// Returns a view of the model's C-arm at other angles, with the same field of view on `width` x `height` pixels.
pub fn viewpoint(
    model: &Model,
    primary_deg: f64,
    secondary_deg: f64,
    [width, height]: [usize; 2],
) -> Result<Viewpoint> {
    let c_arm = turned(model, primary_deg, secondary_deg, [width, height]);
    let rays =
        Geometry::CArm(c_arm).rays(width, height).map_err(|(field, problem)| Error::config(field, "", problem))?;
    Ok(Viewpoint { rays, width, height })
}
