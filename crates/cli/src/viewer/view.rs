//! `view`: shows a run in a browser.

use crate::args::options::GlobalOptions;
use crate::command::tree::compare_with_run;
use crate::viewer::view_server::{AngiogramGeometry, PictureSource, Server, TYPICAL_SIDE};
use crate::viewer::view_tree::TreeWork;
use clap::Args;
use nertca_vk::checkpoint::newest_model;
use nertca_vk::choice::Choice;
use nertca_vk::error::Result;
use nertca_vk::geometry::ViewRays;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::model::Model;
use nertca_vk::model::component::Component;
use nertca_vk::render::baked::Baked;
use nertca_vk::render::quantity::{Projection, Quantity};
use nertca_vk::render::renderer::Renderer;
use nertca_vk_vessels::trees::tree::BeatTree;
use serde_json::{Value, json};
use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

/// Arguments of `view`.
#[derive(Debug, Args)]
pub struct ViewArgs {
    /// Run directory or checkpoint file.
    pub run: PathBuf,
    /// Port on 127.0.0.1; a free one by default.
    #[arg(long, default_value_t = 0)]
    pub port: u16,
}

/// Side of a cell of the dynamic field: finer than a vessel, coarse enough to draw while the mouse is dragged.
const CELL_MM: f64 = 0.5;

/// A run that does not change.
struct Finished {
    run: PathBuf,
    model: Model,
    taken: AngiogramGeometry,
    /// Baked volumes. The lock allows one picture at a time, because pictures share the device.
    baked: Mutex<Baked>,
    gpu: Gpu,
    /// Largest value of each kind of picture.
    ranges: HashMap<Quantity, f32>,
}

impl PictureSource for Finished {
    fn taken(&self) -> Result<AngiogramGeometry> {
        Ok(self.taken.clone())
    }

    fn phases(&self) -> u32 {
        self.model.shown_phases()
    }

    fn about(&self) -> Value {
        json!({ "step": self.model.step, "preset": self.model.config.preset.name() })
    }

    fn render(&self, rays: &ViewRays, side: usize, phase: u32, quantity: Quantity) -> Result<Vec<f32>> {
        let _drawn = self.gpu.looks().begin();
        self.baked.lock().unwrap_or_else(PoisonError::into_inner).render(rays, side, side, phase, quantity)
    }

    fn range(&self, quantity: Quantity, _phase: u32) -> Result<f32> {
        Ok(self.ranges.get(&quantity).copied().unwrap_or(1.0))
    }

    fn model(&self) -> Result<Model> {
        Ok(self.model.clone())
    }

    fn compare_with_images(&self, beat: &mut BeatTree) {
        compare_with_run(beat, &self.run);
    }
}

/// Serves the page until Ctrl-C.
pub fn view(global: &GlobalOptions, args: &ViewArgs) -> Result<()> {
    let model = newest_model(&args.run)?;
    let gpu = global.open_device()?;
    let tuning = global.tuning(&gpu, &model.config);
    let renderer = Arc::new(Renderer::new(&gpu, &model, tuning.clone())?);
    eprintln!("preparing {} phases on {} ...", model.shown_phases(), gpu.info().name);
    let mut shown = Finished {
        run: args.run.clone(),
        taken: AngiogramGeometry { c_arm: model.c_arm.clone(), image_size: model.image_size },
        baked: Mutex::new(Baked::for_display(renderer, &model, CELL_MM)),
        gpu: gpu.clone(),
        ranges: HashMap::new(),
        model,
    };
    shown.ranges = typical_ranges(&shown)?;
    let server = Server::open(args.port, Arc::new(shown), Arc::new(TreeWork::new(&gpu, tuning)))?;
    out!("{}", server.url());
    server.serve(async {
        // Without a handler, Ctrl-C ends the process at once, and there is nothing to wait for.
        let _ = tokio::signal::ctrl_c().await;
    })?;
    global.close_device(&gpu)
}

/// Returns the largest value of each kind of picture from the model's own angle. As a side effect, every phase is
/// baked.
fn typical_ranges(shown: &Finished) -> Result<HashMap<Quantity, f32>> {
    let AngiogramGeometry { c_arm, .. } = &shown.taken;
    let rays = shown.taken.turned(c_arm.primary_deg, c_arm.secondary_deg, TYPICAL_SIDE)?;
    let mut ranges = HashMap::new();
    for &component in Component::ALL {
        // The static background is the same at every phase.
        let phases = if component.has_dynamic() { shown.phases() } else { 1 };
        for &projection in Projection::ALL {
            let quantity = Quantity { component, projection };
            let mut max = f32::MIN_POSITIVE;
            for phase in 0..phases {
                max = shown.render(&rays, TYPICAL_SIDE, phase, quantity)?.into_iter().fold(max, f32::max);
            }
            ranges.insert(quantity, max);
        }
    }
    Ok(ranges)
}
