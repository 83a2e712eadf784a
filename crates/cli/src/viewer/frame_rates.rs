//! Frames per second of renderings.

use crate::args::viewpoint::viewpoint;
use nertca_vk::error::Result;
use nertca_vk::model::Model;
use nertca_vk::model::component::Component;
use nertca_vk::render::baked::{BAKED_CELLS, Baked};
use nertca_vk::render::quantity::{Projection, Quantity};
use nertca_vk::render::renderer::Renderer;
use std::sync::Arc;

/// Frames per second of a model that turns about the patient, with all phases in turn.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct FrameRate {
    /// Rendering from the `fields` or from `baked` volumes.
    pub way: String,
    /// Number of columns and of rows.
    pub size: usize,
    /// Number of frames rendered.
    pub frames: u32,
    /// Frames per second of wall time, including the read-back to the host.
    pub fps: f64,
}

/// Renders for at least `seconds` at each size, both from the fields and from baked volumes.
pub fn measure_frame_rates(
    renderer: &Arc<Renderer>,
    model: &Model,
    component: Component,
    sizes: &[usize],
    seconds: f64,
) -> Result<Vec<FrameRate>> {
    let baked = Baked::new(renderer.clone(), BAKED_CELLS)?;
    let quantity = Quantity { component, projection: Projection::Drr };
    let mut rates = Vec::new();
    for way in ["fields", "baked"] {
        for &size in sizes {
            let frame = |i: u32| {
                let viewpoint = viewpoint(model, f64::from(i * 7 % 180) - 90.0, 10.0, [size, size])?;
                let phase = i % model.shown_phases();
                match way {
                    "fields" => renderer.show(&viewpoint.rays, (size, size), phase, quantity),
                    _ => baked.render(&viewpoint.rays, size, size, phase, quantity),
                }
            };
            frame(0)?;
            let (begin, mut frames) = (std::time::Instant::now(), 0);
            while frames < 2 || begin.elapsed().as_secs_f64() < seconds {
                frames += 1;
                frame(frames)?;
            }
            rates.push(FrameRate {
                way: way.into(),
                size,
                frames,
                fps: f64::from(frames) / begin.elapsed().as_secs_f64(),
            });
        }
    }
    Ok(rates)
}

/// Prints frame rates as a table.
pub fn print_frame_rates(rates: &[FrameRate]) {
    for r in rates {
        out!("{:6} {:4} x {:<4} {:9.1} frames/s ({} frames)", r.way, r.size, r.size, r.fps, r.frames);
    }
}
