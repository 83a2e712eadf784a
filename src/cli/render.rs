//! `render`.

use super::args::{Cli, RenderArgs};
use super::frame_rates::print_measured;
use nertca_vk::error::{Error, Result};
use nertca_vk::formats::images::MAX_SIDE;
use nertca_vk::formats::npy;
use nertca_vk::geometry::{CArm, Geometry, MM_PER_UNIT, ViewRays};
use nertca_vk::model::Model;
use nertca_vk::model::checkpoint::newest_model;
use nertca_vk::render::baked::{BAKED_CELLS, Baked};
use nertca_vk::render::quantity::{Projection, Quantity};
use nertca_vk::render::renderer::Renderer;
use nertca_vk::score::pictures::{self, Window};
use std::sync::Arc;

/// Where and what to render.
pub struct Shot {
    pub rays: ViewRays,
    pub width: usize,
    pub height: usize,
}

/// A view of the model's C-arm, over the same field of view on more or fewer pixels.
pub fn shot(model: &Model, primary_deg: f64, secondary_deg: f64, [width, height]: [usize; 2]) -> Result<Shot> {
    let c_arm = CArm {
        primary_deg,
        secondary_deg,
        pixel_mm: [
            model.c_arm.pixel_mm[0] * model.image_size[0] as f64 / width as f64,
            model.c_arm.pixel_mm[1] * model.image_size[1] as f64 / height as f64,
        ],
        ..model.c_arm.clone()
    };
    let rays =
        Geometry::CArm(c_arm).rays(width, height).map_err(|(field, problem)| Error::config(field, "", problem))?;
    Ok(Shot { rays, width, height })
}

/// The fields themselves, or volumes baked from them.
pub enum Renders {
    Fields(Arc<Renderer>),
    Baked(Box<Baked>),
}

impl Renders {
    /// Line integrals, or maxima per mm.
    pub fn render(&self, shot: &Shot, phase: u32, quantity: Quantity) -> Result<Vec<f32>> {
        let image = match self {
            Renders::Fields(renderer) => renderer.show(&shot.rays, (shot.width, shot.height), phase, quantity)?,
            Renders::Baked(baked) => baked.render(&shot.rays, shot.width, shot.height, phase, quantity)?,
        };
        Ok(match quantity.projection {
            Projection::Drr => image,
            Projection::Mip => image.into_iter().map(|x| x / MM_PER_UNIT as f32).collect(),
        })
    }
}

/// Renders a run.
pub fn render(cli: &Cli, args: &RenderArgs) -> Result<()> {
    let model = newest_model(&args.run)?;
    let size = args.size.map_or(model.image_size, |n| [n, n]);
    if !(1..=MAX_SIDE).contains(&size[0]) {
        return Err(Error::config("--size", size[0], format!("1 to {} is accepted", MAX_SIDE)));
    }
    let Some(out) = &args.out else { return print_measured(cli, args, &model) };
    let extension = out.extension().and_then(|e| e.to_str()).unwrap_or_default().to_lowercase();
    if !["png", "npy", "gif"].contains(&extension.as_str()) {
        return Err(Error::config("--out", out.display(), "ends in none of .png .npy .gif"));
    }
    let (phases, _) = super::export::phases(&args.phase, model.layout.phases as u32)?;
    if extension == "png" && phases.len() > 1 {
        return Err(Error::config("--phase", "all", "a .png holds one phase; use .gif or .npy"));
    }
    let shot = shot(&model, args.primary, args.secondary, size)?;
    let (width, height) = (shot.width, shot.height);
    let gpu = cli.open_device()?;
    let renderer = Arc::new(Renderer::new(&gpu, &model, cli.tuning(&gpu, &model.config))?);
    let renders = match args.baked {
        false => Renders::Fields(renderer),
        true => Renders::Baked(Box::new(Baked::new(renderer, BAKED_CELLS)?)),
    };
    let quantity = Quantity { component: args.component, projection: args.projection };
    let frames =
        phases.iter().map(|phase| renders.render(&shot, *phase, quantity)).collect::<Result<Vec<Vec<f32>>>>()?;
    let window = Window::of(&frames.concat());
    match extension.as_str() {
        "npy" => {
            let shape = if args.phase == "all" { vec![frames.len(), height, width] } else { vec![height, width] };
            npy::write(out, &shape, &frames.concat())?;
        }
        "gif" => pictures::write_gif(out, &frames, width, window, 90)?,
        _ => pictures::write_grey(out, &frames[0], width, window)?,
    }
    drop(renders);
    cli.close_device(&gpu)
}
