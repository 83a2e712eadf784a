//! Views of a run while it trains: baked volumes that are refreshed as fast as the device can afford.

use crate::config::Config;
use crate::error::Result;
use crate::fitting::fit::FieldFeed;
use crate::gaussians::field::GaussianFeed;
use crate::geometry::ViewRays;
use crate::gpu::buffer::Buffer;
use crate::gpu::device::Gpu;
use crate::gpu::record::Commands;
use crate::kernels::tuning::Tuning;
use crate::model::Model;
use crate::model::component::Component;
use crate::model::scene::Scene;
use crate::render::baked::Baked;
use crate::render::quantity::Quantity;
use crate::render::renderer::{Renderer, Rendering};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, PoisonError};
use std::time::Instant;

/// Side of a cell of the dynamic field: finer than a thin vessel, coarse enough to be baked again and again.
const CELL_MM: f64 = 0.8;
/// Pause after a refresh, as a multiple of the time that it took.
const REST: u32 = 4;

/// Data of a run in training that a view needs.
#[derive(Clone)]
pub struct Source {
    /// Model that is drawn, with its parameters if `feed` has none.
    pub outline: Model,
    /// Numbers of the field.
    pub feed: FieldFeed,
}

impl Source {
    /// Returns the source of a model that does not change.
    pub fn of(model: &Model) -> Source {
        Source { outline: model.clone(), feed: FieldFeed::default() }
    }
}

/// Draws the present state of a source.
pub struct Live {
    baked: Baked,
    config: Config,
    scene: Scene,
    params: Option<Buffer>,
    gaussians: Option<GaussianFeed>,
    /// Count of the feed's changes at the field that is drawn.
    gaussians_at: AtomicU64,
    /// Iteration the static field and each phase were baked at.
    baked_at: Vec<u32>,
    rest_until: Instant,
}

impl Live {
    /// Prepares to draw; bakes nothing yet.
    ///
    /// # Errors
    /// Device errors.
    pub fn new(gpu: &Gpu, source: &Source, tuning: Tuning) -> Result<Live> {
        let model = &source.outline;
        let renderer = Arc::new(Renderer::new(gpu, model, tuning)?);
        if !source.feed.own.is_empty() {
            renderer.follow_fit(&source.feed.own);
        }
        Ok(Live {
            baked: Baked::for_display(renderer, model, CELL_MM),
            config: model.config.clone(),
            scene: model.scene.clone(),
            params: source.feed.params.clone(),
            gaussians: source.feed.gaussians.clone(),
            gaussians_at: AtomicU64::new(u64::MAX),
            baked_at: vec![0; 1 + model.param_map.phases],
            rest_until: Instant::now(),
        })
    }

    /// Draws a view as [`Baked::render`] does. A volume older than `step`, the source's present iteration, is baked anew unless
    /// the last refresh was too recent: refreshing takes at most a fifth of the time.
    ///
    /// # Errors
    /// As [`Renderer::render`].
    pub fn render(
        &mut self,
        step: u32,
        rays: &ViewRays,
        size: (usize, usize),
        phase: u32,
        quantity: Quantity,
    ) -> Result<Vec<f32>> {
        self.follow_gaussians()?;
        let _under_way = self.refresh(step, phase, quantity)?;
        self.baked.render(rays, size.0, size.1, phase, quantity)
    }

    /// Draws a view as [`Live::render`] does, into a buffer on the device.
    ///
    /// # Errors
    /// As [`Baked::render_into`].
    pub fn render_into(
        &mut self,
        target: &Buffer,
        step: u32,
        rays: &ViewRays,
        size: (usize, usize),
        phase: u32,
        quantity: Quantity,
    ) -> Result<()> {
        self.follow_gaussians()?;
        let _under_way = self.refresh(step, phase, quantity)?;
        self.baked.render_into(target, rays, size, phase, quantity)
    }

    fn refresh(&mut self, step: u32, phase: u32, quantity: Quantity) -> Result<Vec<Commands>> {
        let mut under_way = Vec::new();
        self.baked.renderer().check_phase(phase)?;
        let component = quantity.component;
        let static_field = (component.has_static(), Component::Static, 0);
        let baked = component.has_dynamic() && !self.baked.renderer().draws_gaussians(quantity);
        let dynamic_field = (baked, Component::Dynamic, 1 + phase as usize);
        for (wanted, field, slot) in [static_field, dynamic_field] {
            let old = || self.baked_at[slot] != step && Instant::now() >= self.rest_until;
            if wanted && (!self.baked.has(field, phase) || old()) {
                let begin = Instant::now();
                under_way.extend(self.follow(step)?);
                under_way.extend(self.baked.bake(field, phase)?);
                self.baked_at[slot] = step;
                self.rest_until = Instant::now() + begin.elapsed() * REST;
            }
        }
        Ok(under_way)
    }

    /// Renders through the fields themselves, as they are at the source's present iteration.
    ///
    /// # Errors
    /// As [`Renderer::render`].
    pub fn render_fields(&self, step: u32, rays: &ViewRays, size: (usize, usize), phase: u32) -> Result<Rendering> {
        let _under_way = self.follow(step)?;
        self.baked.renderer().render(rays, size.0, size.1, phase)
    }

    /// Returns the renderer, brought up to the source's present iteration.
    ///
    /// # Errors
    /// Device errors.
    pub fn renderer(&self, step: u32) -> Result<&Renderer> {
        self.follow(step)?;
        Ok(self.baked.renderer())
    }

    /// Scales and boxes of what is drawn.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    fn follow(&self, step: u32) -> Result<Option<Commands>> {
        self.follow_gaussians()?;
        let Some(params) = &self.params else { return Ok(None) };
        self.baked.renderer().follow(params, self.config.schedule(step)).map(Some)
    }

    /// Takes the source's Gaussians if they have changed.
    fn follow_gaussians(&self) -> Result<()> {
        let Some(feed) = &self.gaussians else { return Ok(()) };
        let (change, field) = {
            let now = feed.lock().unwrap_or_else(PoisonError::into_inner);
            if now.0 == self.gaussians_at.load(Ordering::Relaxed) {
                return Ok(());
            }
            now.clone()
        };
        self.baked.renderer().set_gaussians(&field)?;
        self.gaussians_at.store(change, Ordering::Relaxed);
        Ok(())
    }
}
