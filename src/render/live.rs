//! Views of a run while it trains: baked volumes that are refreshed as fast as the device can afford.

use crate::config::Config;
use crate::error::{Error, Result};
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
use crate::render::quantity::{Projection, Quantity};
use crate::render::renderer::{Interlude, Renderer, Rendering};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Side of a cell of the dynamic field: finer than a thin vessel, coarse enough to be baked again and again.
const CELL_MM: f64 = 0.8;
/// Pause after a refresh, as a multiple of the time that it took.
const REST: u32 = 4;
/// Time after a picture during which the volumes that it showed are kept up to date.
const SHOWN_LATELY: Duration = Duration::from_secs(1);

/// Index of the static field among the volumes; those of the phases follow.
const STATIC_SLOT: usize = 0;

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

/// When volumes that are older than the source's present iteration are baked anew.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refresh {
    /// By the picture that shows them.
    Now,
    /// By [`Live::refresh_beside`] in another thread; pictures show the volumes there are meanwhile.
    Beside,
}

/// Draws the present state of a source. Pictures are drawn one after the other; volumes may be baked beside them.
pub struct Live {
    gpu: Gpu,
    baked: Baked,
    config: Config,
    scene: Scene,
    params: Option<Buffer>,
    /// Iteration up to which `params` do not change.
    params_fixed_until: u32,
    gaussians: Option<GaussianFeed>,
    /// Count of the feed's changes at the field that is drawn.
    gaussians_at: AtomicU64,
    /// Held while a picture is drawn, and while a volume is replaced.
    drawing: Mutex<()>,
    freshness: Mutex<Freshness>,
}

/// Age of volumes: the static field, then each phase.
struct Freshness {
    volumes: Vec<VolumeAge>,
    rest_until: Instant,
}

#[derive(Clone, Copy, Default)]
struct VolumeAge {
    /// Iteration it was baked at; none before.
    baked_at: Option<u32>,
    /// When a picture last showed it.
    shown: Option<Instant>,
}

fn was_shown_lately(age: &VolumeAge) -> bool {
    age.shown.is_some_and(|shown| shown.elapsed() < SHOWN_LATELY)
}

/// Field and phase of a volume.
fn volume(slot: usize) -> (Component, u32) {
    if slot == STATIC_SLOT { (Component::Static, 0) } else { (Component::Dynamic, slot as u32 - 1) }
}

impl Live {
    /// Prepares to draw; bakes nothing yet. With an interlude, it works in slices (see [`Renderer::in_slices`]).
    ///
    /// # Errors
    /// Device errors.
    pub fn new(gpu: &Gpu, source: &Source, tuning: Tuning, interlude: Option<Interlude>) -> Result<Live> {
        let model = &source.outline;
        let renderer = Renderer::new(gpu, model, tuning)?;
        let renderer = Arc::new(match interlude {
            Some(interlude) => renderer.in_slices(interlude),
            None => renderer,
        });
        if !source.feed.own.is_empty() {
            renderer.follow_fit(&source.feed.own);
        }
        let volumes = vec![VolumeAge::default(); 1 + model.param_map.phases];
        Ok(Live {
            gpu: gpu.clone(),
            baked: Baked::for_display(renderer, model, CELL_MM),
            config: model.config.clone(),
            scene: model.scene.clone(),
            params: source.feed.params.clone(),
            params_fixed_until: source.feed.params_fixed_until,
            gaussians: source.feed.gaussians.clone(),
            gaussians_at: AtomicU64::new(u64::MAX),
            drawing: Mutex::default(),
            freshness: Mutex::new(Freshness { volumes, rest_until: Instant::now() }),
        })
    }

    /// Draws a view as [`Baked::render`] does. A volume that was never baked is baked first. One that is older than `step`, the
    /// source's present iteration, is baked anew as `refresh` says. A `phase` may lie between two for line integrals of one set of
    /// Gaussians that moves.
    ///
    /// # Errors
    /// As [`Renderer::render`]; [`Error::Config`] for a phase between two where it cannot be drawn.
    pub fn render(
        &self,
        at: (u32, Refresh),
        rays: &ViewRays,
        size: (usize, usize),
        phase: f64,
        quantity: Quantity,
    ) -> Result<Vec<f32>> {
        let _alone = self.alone();
        let _under_way = self.follow_and_refresh(at, phase, quantity)?;
        if phase.fract() == 0.0 {
            return self.baked.render(rays, size.0, size.1, phase as u32, quantity);
        }
        self.between(rays, size, phase, quantity)
    }

    /// Draws a view as [`Live::render`] does, into a buffer on the device.
    ///
    /// # Errors
    /// As [`Baked::render_into`].
    pub fn render_into(
        &self,
        target: &Buffer,
        at: (u32, Refresh),
        rays: &ViewRays,
        size: (usize, usize),
        phase: f64,
        quantity: Quantity,
    ) -> Result<()> {
        let _alone = self.alone();
        let _under_way = self.follow_and_refresh(at, phase, quantity)?;
        if phase.fract() == 0.0 {
            return self.baked.render_into(target, rays, size, phase as u32, quantity);
        }
        target.check_range(0, (size.0 * size.1 * 4) as u64)?;
        Ok(self.gpu.upload(target, 0, &self.between(rays, size, phase, quantity)?)?)
    }

    fn between(&self, rays: &ViewRays, size: (usize, usize), phase: f64, quantity: Quantity) -> Result<Vec<f32>> {
        let of = |component| Quantity { component, ..quantity };
        let Some(mut image) = self.baked.renderer().show_between(rays, size, phase, of(Component::Dynamic))? else {
            return Err(Error::config(
                "phase",
                phase,
                "lies between two phases, where live pictures show line integrals of one set of moving Gaussians only: choose \
                 a whole phase, or exact quality",
            ));
        };
        if quantity.component.has_static() {
            let behind = self.baked.static_image(rays, size, quantity.projection)?;
            image.iter_mut().zip(&*behind).for_each(|(sum, behind)| *sum += behind);
        }
        Ok(image)
    }

    fn follow_and_refresh(
        &self,
        (step, refresh): (u32, Refresh),
        phase: f64,
        quantity: Quantity,
    ) -> Result<Vec<Commands>> {
        let last = self.freshness().volumes.len() as u32 - 2;
        if !(0.0..f64::from(last + 1)).contains(&phase) {
            return Err(Error::config("phase", phase, format!("is out of range: phases go from 0 to {last}")));
        }
        let between = phase.fract() != 0.0;
        let drawn = quantity.projection == Projection::Drr && self.baked.renderer().gaussians_move();
        let component = if between && drawn { Component::Static } else { quantity.component };
        self.follow_gaussians()?;
        if between && drawn && !quantity.component.has_static() {
            return Ok(Vec::new());
        }
        self.refresh(step, refresh, phase as u32, Quantity { component, ..quantity })
    }

    fn alone(&self) -> MutexGuard<'_, ()> {
        self.drawing.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn freshness(&self) -> MutexGuard<'_, Freshness> {
        self.freshness.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Volumes that a picture shows.
    fn shown_volumes(&self, phase: u32, quantity: Quantity) -> Vec<usize> {
        let component = quantity.component;
        let dynamic = component.has_dynamic() && !self.baked.renderer().draws_gaussians(quantity);
        let slots = [(component.has_static(), STATIC_SLOT), (dynamic, 1 + phase as usize)];
        slots.into_iter().filter(|(shown, _)| *shown).map(|(_, slot)| slot).collect()
    }

    /// Iteration of the oldest part that a picture shows which was just drawn at `step`.
    pub fn shown_step(&self, step: u32, phase: f64, quantity: Quantity) -> u32 {
        let freshness = self.freshness();
        let volumes = self.shown_volumes(phase as u32, quantity).into_iter();
        let oldest = |oldest: u32, slot: usize| match freshness.volumes[slot].baked_at {
            Some(baked_at) if self.is_stale(slot, baked_at, step) => oldest.min(baked_at),
            _ => oldest,
        };
        volumes.fold(step, oldest)
    }

    /// Tells whether the field of a volume that was baked at an iteration is another one at `step`.
    fn is_stale(&self, slot: usize, baked_at: u32, step: u32) -> bool {
        let fixed = volume(slot).0 == Component::Static && baked_at.max(step) <= self.params_fixed_until;
        baked_at != step && !fixed
    }

    fn refresh(&self, step: u32, refresh: Refresh, phase: u32, quantity: Quantity) -> Result<Vec<Commands>> {
        let mut under_way = Vec::new();
        self.baked.renderer().check_phase(phase)?;
        for slot in self.shown_volumes(phase, quantity) {
            let begin = Instant::now();
            let bakes = {
                let mut freshness = self.freshness();
                let age = &mut freshness.volumes[slot];
                age.shown = Some(begin);
                age.baked_at.is_none_or(|baked_at| refresh == Refresh::Now && self.is_stale(slot, baked_at, step))
            };
            if bakes {
                let (field, phase) = volume(slot);
                under_way.extend(self.follow(step)?);
                under_way.extend(self.baked.bake(field, phase)?);
                self.note_baked(slot, step, begin);
            }
        }
        Ok(under_way)
    }

    fn note_baked(&self, slot: usize, step: u32, begin: Instant) {
        let mut freshness = self.freshness();
        freshness.volumes[slot].baked_at = Some(step);
        freshness.rest_until = Instant::now() + begin.elapsed() * REST;
    }

    /// Bakes the volumes anew that pictures showed lately and that are older than `step`, the source's present iteration, while
    /// pictures may be drawn in other threads; refreshing takes at most a fifth of the time.
    ///
    /// # Errors
    /// Device errors.
    pub fn refresh_beside(&self, step: u32) -> Result<()> {
        let stale = {
            let freshness = self.freshness();
            let stale = |slot: &usize| {
                let age = &freshness.volumes[*slot];
                age.baked_at.is_some_and(|baked_at| self.is_stale(*slot, baked_at, step)) && was_shown_lately(age)
            };
            let rests = Instant::now() < freshness.rest_until;
            // The oldest first, so that each has its turn.
            let of_age = |slot: &usize| freshness.volumes[*slot].baked_at;
            (0..freshness.volumes.len()).filter(|slot| !rests && stale(slot)).min_by_key(of_age)
        };
        stale.map_or(Ok(()), |slot| self.bake_beside(slot, step, self))
    }

    /// Bakes all volumes anew that pictures showed lately and that are older than `step`, as [`Live::refresh_beside`] does one after
    /// the other.
    ///
    /// # Errors
    /// Device errors.
    pub fn refresh_all_beside(&self, step: u32) -> Result<()> {
        let n_volumes = self.freshness().volumes.len();
        for slot in 0..n_volumes {
            let age = self.freshness().volumes[slot];
            let stale = age.baked_at.is_some_and(|baked_at| self.is_stale(slot, baked_at, step));
            if stale && was_shown_lately(&age) {
                self.bake_beside(slot, step, self)?;
            }
        }
        Ok(())
    }

    /// Bakes the static field at `step`, before any picture is drawn: pictures of Gaussians show it.
    ///
    /// # Errors
    /// Device errors.
    pub fn bake_static_field(&self, step: u32) -> Result<()> {
        self.bake_beside(STATIC_SLOT, step, self)
    }

    /// Bakes, at `step`, the volumes that pictures of `earlier` showed, before this takes its place.
    ///
    /// # Errors
    /// Device errors.
    pub fn bake_like(&self, earlier: &Live, step: u32) -> Result<()> {
        let before = earlier.freshness().volumes.clone();
        // The lock must be free again before volumes are baked.
        let n_volumes = self.freshness().volumes.len();
        for (slot, age) in before.iter().enumerate().take(n_volumes) {
            if was_shown_lately(age) {
                self.bake_beside(slot, step, earlier)?;
                self.freshness().volumes[slot].shown = age.shown;
            }
        }
        Ok(())
    }

    /// Bakes a volume anew, and draws the images of it that `earlier` showed.
    fn bake_beside(&self, slot: usize, step: u32, earlier: &Live) -> Result<()> {
        let (begin, (field, phase)) = (Instant::now(), volume(slot));
        let followed = if slot == STATIC_SLOT { self.follow_params(step)? } else { self.follow(step)? };
        let cells = self.baked.cells(field, phase)?;
        drop(followed);
        {
            let _alone = self.alone();
            drop(self.baked.fill(field, phase, &cells)?);
        }
        if field == Component::Static {
            self.baked.redraw_static_images(&earlier.baked, SHOWN_LATELY)?;
        }
        self.note_baked(slot, step, begin);
        Ok(())
    }

    /// Renders through the fields themselves, as they are at the source's present iteration.
    ///
    /// # Errors
    /// As [`Renderer::render`].
    pub fn render_fields(&self, step: u32, rays: &ViewRays, size: (usize, usize), phase: f64) -> Result<Rendering> {
        let _under_way = self.follow(step)?;
        self.baked.renderer().render_at(rays, size.0, size.1, phase)
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
        self.follow_params(step)
    }

    fn follow_params(&self, step: u32) -> Result<Option<Commands>> {
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
