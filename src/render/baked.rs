//! Fields baked into 3D images, for display rates.

use crate::config::fields::StaticField;
use crate::error::{Error, Result};
use crate::geometry::{MM_PER_UNIT, ViewRays};
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::image::Image3d;
use crate::gpu::record::{Commands, Recording};
use crate::kernels::dispatch::{Binding, dispatch};
use crate::kernels::layout::View;
use crate::kernels::push;
use crate::model::Model;
use crate::model::component::Component;
use crate::render::grid::Grid;
use crate::render::kept_images::{ImageKey, KeptImages};
use crate::render::quantity::{Projection, Quantity};
use crate::render::renderer::Renderer;
use glam::Vec3;
use half::f16;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// Cells of a baked volume along its longest side.
pub const BAKED_CELLS: u32 = 192;
/// Minimum number of cells along the longest side.
const MIN_BAKED_CELLS: u32 = 32;

/// A model baked into volumes: every phase's dynamic field over its box, and the static field. Renders at display rates; finer
/// detail than a cell is lost, except for Gaussians, which are drawn themselves in front of the baked static field. Volumes are
/// baked when first needed, or when asked for.
pub struct Baked {
    renderer: Arc<Renderer>,
    static_grid: Grid,
    dynamic_grid: Grid,
    /// The static field, then each phase.
    volumes: Mutex<Vec<Option<Image3d>>>,
    /// Recorded commands by size, phase and quantity: a frame only writes a view, submits, and reads a picture.
    recorded: Mutex<HashMap<RecordedKey, Arc<RecordedView>>>,
    /// Images of the static field, behind Gaussians.
    static_images: KeptImages,
}

/// Maximum number of recorded frames kept; a viewer in use has far fewer.
const MAX_RECORDED: usize = 256;
/// Pixels of recorded frames beyond which they are discarded: 64 MiB on the device.
const MAX_RECORDED_PIXELS: usize = 1 << 24;

/// Maximum number of pixels of a strip that is drawn beside other pictures: a CPU takes about 10 ms for it.
const STRIP_PIXELS: usize = 1 << 14;

/// Columns, rows, phase, quantity.
type RecordedKey = (usize, usize, u32, Quantity);

/// Commands that draw a view, ready to be submitted.
struct RecordedView {
    commands: Commands,
    view: Buffer,
    image: Buffer,
    /// Held while its buffers, which hold one frame, are in use.
    in_use: Mutex<()>,
}

/// Index of a field's volume: the static field, then each phase.
fn slot(field: Component, phase: u32) -> usize {
    if field == Component::Static { 0 } else { 1 + phase as usize }
}

impl Baked {
    /// Bakes the static field and, where a network is the dynamic field, all phases, with `cells` cells along the longest side
    /// of each box.
    ///
    /// # Errors
    /// Device errors, [`Error::OutOfMemory`] first of all.
    pub fn new(renderer: Arc<Renderer>, cells: u32) -> Result<Baked> {
        let baked = Self::empty(renderer, cells, cells);
        baked.bake(Component::Static, 0)?;
        let n_baked = if baked.renderer.blobs.is_some() { 0 } else { baked.renderer.setup.n_phases };
        for phase in 0..n_baked {
            baked.bake(Component::Dynamic, phase)?;
        }
        Ok(baked)
    }

    /// Prepares volumes for drawing at display rates, with dynamic cells of side `cell_mm`; bakes none yet. A static tensor
    /// field gets two cells per cell of its grid, since it has no finer detail.
    pub fn for_display(renderer: Arc<Renderer>, model: &Model, cell_mm: f64) -> Baked {
        let scene = &model.scene;
        let extent = (0..3).map(|i| scene.dynamic_max[i] - scene.dynamic_min[i]).fold(0.0, f64::max);
        let dynamic_cells = ((extent * MM_PER_UNIT / cell_mm).ceil() as u32).clamp(MIN_BAKED_CELLS, BAKED_CELLS);
        let static_cells = match model.config.fields().map(|settings| settings.static_field) {
            Some(StaticField::Tensor(tensor)) => (2 * tensor.grid).clamp(MIN_BAKED_CELLS, BAKED_CELLS),
            Some(StaticField::Network(_)) => dynamic_cells,
            None => MIN_BAKED_CELLS,
        };
        Self::empty(renderer, static_cells, dynamic_cells)
    }

    /// Prepares volumes of `static_cells` and `dynamic_cells` cells along the longest side of each box; bakes none yet.
    fn empty(renderer: Arc<Renderer>, static_cells: u32, dynamic_cells: u32) -> Baked {
        let s = &renderer.setup;
        let corner = |at: [f32; 3]| Vec3::from(at).as_dvec3();
        let static_grid = Grid::over(corner(s.static_min), corner(s.static_max), static_cells);
        let dynamic_grid = Grid::over(corner(s.dynamic_min), corner(s.dynamic_max), dynamic_cells);
        let volumes = Mutex::new(vec![None; 1 + s.n_phases as usize]);
        Baked {
            static_grid,
            dynamic_grid,
            volumes,
            renderer,
            recorded: Mutex::default(),
            static_images: KeptImages::default(),
        }
    }

    /// Renderer whose fields are baked.
    pub fn renderer(&self) -> &Renderer {
        &self.renderer
    }

    /// Bakes the fields of a component with the renderer's present parameters, for the first time or again. The last copies may
    /// still be under way: they precede whatever is rendered next; dropping the result waits for them.
    ///
    /// # Errors
    /// As [`Renderer::sample`]; [`Error::OutOfMemory`].
    pub fn bake(&self, component: Component, phase: u32) -> Result<Vec<Commands>> {
        self.renderer.check_phase(phase)?;
        component.fields().iter().map(|field| self.bake_field(*field, phase)).collect()
    }

    fn bake_field(&self, field: Component, phase: u32) -> Result<Commands> {
        if field == Component::Static {
            self.static_images.clear();
        }
        self.fill(field, phase, &self.cells(field, phase)?)
    }

    /// Samples a single field at the cells of its volume, in units of its scale.
    ///
    /// # Errors
    /// As [`Renderer::sample`].
    pub fn cells(&self, field: Component, phase: u32) -> Result<Vec<f16>> {
        let setup = &self.renderer.setup;
        let (grid, gain) = match field {
            Component::Static => (&self.static_grid, setup.static_gain),
            _ => (&self.dynamic_grid, setup.dynamic_gain),
        };
        // In units of the field's scale, values are near 1 and f16 loses a thousandth at most.
        let cells = self.renderer.sample(field, phase, grid)?;
        Ok(cells.iter().map(|x| f16::from_f32(x / gain)).collect())
    }

    /// Fills the volume of a single field with cells that [`Baked::cells`] returned. The copy may still be under way, as after
    /// [`Baked::bake`]. No picture may be under way. Pictures show kept images of the earlier static field until
    /// [`crate::render::live::Live`] has drawn them anew.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`]; other device errors.
    pub fn fill(&self, field: Component, phase: u32, cells: &[f16]) -> Result<Commands> {
        let grid = if field == Component::Static { &self.static_grid } else { &self.dynamic_grid };
        let mut volumes = self.volumes.lock().unwrap_or_else(PoisonError::into_inner);
        match &mut volumes[slot(field, phase)] {
            Some(volume) => Ok(volume.fill(cells)?),
            none => {
                let volume = self.renderer.gpu.image_3d("baked", grid.size)?;
                let filling = volume.fill(cells)?;
                *none = Some(volume);
                Ok(filling)
            }
        }
    }

    /// Tells whether every field of a component has been baked.
    pub fn has(&self, component: Component, phase: u32) -> bool {
        component.fields().iter().all(|field| self.volume(*field, phase).is_some())
    }

    fn volume(&self, field: Component, phase: u32) -> Option<Image3d> {
        self.volumes.lock().unwrap_or_else(PoisonError::into_inner)[slot(field, phase)].clone()
    }

    fn volume_or_bake(&self, field: Component, phase: u32) -> Result<Image3d> {
        if !self.has(field, phase) {
            self.bake(field, phase)?;
        }
        self.volume(field, phase).ok_or_else(|| Error::Internal(format!("{field:?} was not baked")))
    }

    /// Renders a `width` x `height` view at a phase, rows first.
    ///
    /// # Errors
    /// As [`Renderer::render`].
    pub fn render(
        &self,
        rays: &ViewRays,
        width: usize,
        height: usize,
        phase: u32,
        quantity: Quantity,
    ) -> Result<Vec<f32>> {
        self.renderer.check_phase(phase)?;
        if self.renderer.draws_gaussians(quantity) {
            return self.render_gaussians(rays, (width, height), phase, quantity);
        }
        let recorded = self.recorded_view(width, height, phase, quantity)?;
        let _alone = recorded.in_use.lock().unwrap_or_else(PoisonError::into_inner);
        recorded.view.write(&[View::of(rays)])?;
        self.renderer.gpu.wait(recorded.commands.submit()?)?;
        let mut image = vec![0f32; width * height];
        recorded.image.read(&mut image)?;
        Ok(image)
    }

    /// Renders Gaussians themselves, in front of the baked static field.
    fn render_gaussians(
        &self,
        rays: &ViewRays,
        (width, height): (usize, usize),
        phase: u32,
        quantity: Quantity,
    ) -> Result<Vec<f32>> {
        let of = |component| Quantity { component, ..quantity };
        let mut image = self.renderer.show(rays, (width, height), phase, of(Component::Dynamic))?;
        if quantity.component.has_static() {
            let static_image = self.static_image(rays, (width, height), quantity.projection)?;
            image.iter_mut().zip(&*static_image).for_each(|(sum, static_image)| *sum += static_image);
        }
        Ok(image)
    }

    /// Returns an image of the static field alone, rows first.
    ///
    /// # Errors
    /// As [`Baked::render`].
    pub fn static_image(&self, rays: &ViewRays, size: (usize, usize), projection: Projection) -> Result<Arc<Vec<f32>>> {
        let quantity = Quantity { component: Component::Static, projection };
        let key = ImageKey { rays: rays.clone(), size, projection };
        self.static_images.get(key, || self.render(rays, size.0, size.1, 0, quantity))
    }

    /// Draws the kept images of the static field anew that `earlier` showed within the last `lately`, beside pictures that are drawn in
    /// other threads; `earlier` may be this.
    ///
    /// # Errors
    /// As [`Baked::render`].
    pub(super) fn redraw_static_images(&self, earlier: &Baked, lately: Duration) -> Result<()> {
        let shown = earlier.static_images.shown_lately(lately);
        self.static_images.redraw(shown, |key| self.draw_in_strips(key))
    }

    /// Renders the static field in strips of rows, between which other pictures pass.
    fn draw_in_strips(&self, key: &ImageKey) -> Result<Vec<f32>> {
        let (width, height) = key.size;
        let quantity = Quantity { component: Component::Static, projection: key.projection };
        let rows = (STRIP_PIXELS / width.max(1)).clamp(1, height.max(1));
        let mut image = Vec::with_capacity(width * height);
        for first in (0..height).step_by(rows) {
            self.renderer.pause()?;
            let strip = key.rays.from_row(first);
            image.extend(self.render(&strip, width, rows.min(height - first), 0, quantity)?);
        }
        Ok(image)
    }

    /// Draws a view as [`Baked::render`] does, into a buffer on the device: `width` x `height` floats.
    ///
    /// # Errors
    /// As [`Baked::render`]; [`Error::Internal`] when the buffer is too small.
    pub fn render_into(
        &self,
        target: &Buffer,
        rays: &ViewRays,
        (width, height): (usize, usize),
        phase: u32,
        quantity: Quantity,
    ) -> Result<()> {
        self.renderer.check_phase(phase)?;
        target.check_range(0, (width * height * 4) as u64)?;
        if self.renderer.draws_gaussians(quantity) {
            return self.render_gaussians_into(target, rays, (width, height), phase, quantity);
        }
        let view = self.renderer.gpu.buffer("view", size_of::<View>() as u64, Memory::Upload)?;
        view.write(&[View::of(rays)])?;
        let commands = self.record(&view, target, (width, height), phase, quantity)?;
        Ok(self.renderer.gpu.wait(commands.submit()?)?)
    }

    /// Draws [`Baked::render_gaussians`] into a buffer. Maxima along rays and kept images of the static field come by way of the host.
    fn render_gaussians_into(
        &self,
        target: &Buffer,
        rays: &ViewRays,
        size: (usize, usize),
        phase: u32,
        quantity: Quantity,
    ) -> Result<()> {
        if quantity.projection == Projection::Mip {
            let image = self.render_gaussians(rays, size, phase, quantity)?;
            return Ok(self.renderer.gpu.upload(target, 0, &image)?);
        }
        let has_static = quantity.component.has_static();
        if has_static {
            let image = self.static_image(rays, size, quantity.projection)?;
            self.renderer.gpu.upload(target, 0, &image)?;
        }
        self.renderer.show_gaussians_into(target, rays, size, phase, has_static)
    }

    fn recorded_view(&self, width: usize, height: usize, phase: u32, quantity: Quantity) -> Result<Arc<RecordedView>> {
        let mut all = self.recorded.lock().unwrap_or_else(PoisonError::into_inner);
        let key = (width, height, phase, quantity);
        if let Some(recorded) = all.get(&key) {
            return Ok(recorded.clone());
        }
        let pixels = all.keys().map(|(width, height, ..)| width * height).sum::<usize>();
        if all.len() >= MAX_RECORDED || pixels + width * height > MAX_RECORDED_PIXELS {
            all.clear();
        }
        let (gpu, pixels) = (&self.renderer.gpu, (width * height) as u32);
        let view = gpu.buffer("view", size_of::<View>() as u64, Memory::Upload)?;
        let image = gpu.buffer("image", u64::from(pixels) * 4, Memory::Readback)?;
        let commands = self.record(&view, &image, (width, height), phase, quantity)?;
        let recorded = Arc::new(RecordedView { commands, view, image, in_use: Mutex::default() });
        all.insert(key, recorded.clone());
        Ok(recorded)
    }

    fn record(
        &self,
        view: &Buffer,
        image: &Buffer,
        (width, height): (usize, usize),
        phase: u32,
        quantity: Quantity,
    ) -> Result<Commands> {
        let (gpu, pixels) = (&self.renderer.gpu, (width * height) as u32);
        // A field that is not shown is bound, since the kernel names it, but not read.
        let component = quantity.component;
        let shown = |field, wanted| if wanted { self.volume_or_bake(field, phase).map(Some) } else { Ok(None) };
        let static_volume = shown(Component::Static, component.has_static())?;
        let dynamic_volume = shown(Component::Dynamic, component.has_dynamic())?;
        let any = static_volume.as_ref().or(dynamic_volume.as_ref());
        let any = any.ok_or_else(|| Error::Internal("there is no volume to render".into()))?;
        let bound = [
            (Binding::setup, (&self.renderer.buffers.setup).into()),
            (Binding::views, view.into()),
            (Binding::static_volume, static_volume.as_ref().unwrap_or(any).into()),
            (Binding::dynamic_volume, dynamic_volume.as_ref().unwrap_or(any).into()),
            (Binding::image, image.into()),
        ];
        let push = push::BakedMarch {
            n_pixels: pixels,
            image_width: width as u32,
            with_static: u32::from(component.has_static()),
            with_dynamic: u32::from(component.has_dynamic()),
            maximum: u32::from(quantity.projection == Projection::Mip),
        };
        let stage = &self.renderer.kernels.baked_march;
        let mut recording = Recording::new(gpu, "baked render")?;
        dispatch(&mut recording, stage, stage.groups_over(pixels), &bound, push)?;
        Ok(recording.finish()?)
    }
}
