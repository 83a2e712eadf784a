//! Fields sampled on a regular grid: for export, and baked into 3D images for display rates.

use super::render::{RAYS_PER_SUBMIT, Renderer};
use crate::data::geometry::{MM_PER_UNIT, ViewRays, world_from_lps_mm};
use crate::error::{Error, Result};
use crate::gpu::memory::{Buffer, Memory};
use crate::gpu::record::{Commands, Recording};
use crate::gpu::volume::Volume;
use crate::kernels::{dispatch, groups_for};
use crate::layout::View;
use crate::model::field::Model;
use glam::DVec3;
use half::f16;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

/// Cells sampled by one submit: 16 MiB on their way to the host.
const CELLS_PER_SUBMIT: u32 = 1 << 22;

/// A regular grid of points in world units (100 mm), x fastest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grid {
    /// First point.
    pub origin: DVec3,
    /// Distance between neighbours along each axis.
    pub spacing: DVec3,
    /// Points along x, y, z.
    pub size: [u32; 3],
}

impl Grid {
    /// `cells` points along the longest side of a box and as many along the others as keep them apart as far; the
    /// first and last lie on its faces.
    pub fn over(low: DVec3, high: DVec3, cells: u32) -> Grid {
        let extent = high - low;
        let step = extent.max_element() / f64::from(cells - 1);
        let size = extent.to_array().map(|e| ((e / step).round() as u32 + 1).max(2));
        let spacing = extent / DVec3::from_array(size.map(|n| f64::from(n - 1)));
        Grid { origin: low, spacing, size }
    }

    /// Points in all.
    pub fn len(&self) -> usize {
        self.size.iter().map(|n| *n as usize).product()
    }

    /// Whether it has no points.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// A regular grid of points in patient coordinates (left, posterior, superior), mm; left is the fastest axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PatientGrid {
    /// First point.
    pub origin_mm: DVec3,
    /// Distance between neighbours along each axis.
    pub spacing_mm: DVec3,
    /// Points along each axis.
    pub size: [u32; 3],
}

impl PatientGrid {
    /// Refuses grids that cannot be sampled.
    ///
    /// # Errors
    /// [`Error::Config`].
    pub fn check(&self) -> Result<()> {
        let spacing = self.spacing_mm;
        if !(self.origin_mm.is_finite() && spacing.is_finite() && spacing.min_element() > 0.0) {
            return Err(Error::config("grid", spacing, "origin and spacing must be finite, spacing positive"));
        }
        if self.size.iter().any(|n| *n == 0 || *n > 4096) {
            return Err(Error::config("grid", format!("{:?}", self.size), "1 to 4096 points along each axis"));
        }
        Ok(())
    }

    /// Some of its slices.
    pub fn slices(&self, slices: std::ops::Range<u32>) -> PatientGrid {
        let [nx, ny, _] = self.size;
        let origin_mm = self.origin_mm + DVec3::Z * self.spacing_mm.z * f64::from(slices.start);
        PatientGrid { origin_mm, size: [nx, ny, slices.len() as u32], ..*self }
    }
}

/// Which fields to sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fields {
    /// Include the still background.
    pub with_static: bool,
    /// Include the moving vessels, at this phase.
    pub dynamic_phase: Option<u32>,
}

/// Which field to sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Field {
    /// The still background.
    Static,
    /// The moving vessels at a phase.
    Dynamic(u32),
}

impl Renderer {
    /// Attenuation per world unit of a field at the points of a grid; zero outside its box and hull.
    ///
    /// # Errors
    /// [`Error::Config`] for a phase the model does not have or more points along x than fit; device errors.
    pub fn sample(&self, field: Field, grid: &Grid) -> Result<Vec<f32>> {
        let phase = match field {
            Field::Static => 0,
            Field::Dynamic(phase) => phase,
        };
        self.check_phase(phase)?;
        let [nx, ny, nz] = grid.size;
        if nx < 2 || nx > self.largest_row() {
            return Err(Error::config("grid", nx, format!("2 to {} points along x are accepted", self.largest_row())));
        }
        // Rows along x are rays: the depth is x.
        let f = |v: DVec3| [v.x as f32, v.y as f32, v.z as f32, 0.0];
        let view = View {
            anchor00: f(DVec3::new(0.0, grid.origin.y, grid.origin.z)),
            anchor_du: f(DVec3::Y * grid.spacing.y),
            anchor_dv: f(DVec3::Z * grid.spacing.z),
            direction00: f(DVec3::X),
            direction_du: [0.0; 4],
            direction_dv: [0.0; 4],
        };
        let mut setup = self.setup;
        setup.n_dynamic_samples = nx;
        setup.dynamic_near = grid.origin.x as f32;
        setup.dynamic_far = (grid.origin.x + grid.spacing.x * f64::from(nx - 1)) as f32;
        let rows = ny * nz;
        let rows_at_once = RAYS_PER_SUBMIT.min((CELLS_PER_SUBMIT / nx).max(1)).min(rows);
        let bytes = u64::from(rows_at_once) * u64::from(nx) * 4;
        let cells = self.gpu.buffer("volume", bytes, Memory::Device)?;
        let read = self.gpu.buffer("volume read-back", bytes, Memory::Readback)?;
        let mut buffers = self.buffers.clone();
        buffers.set("volume", cells.clone());
        let mut out = vec![0f32; grid.len()];
        for (i, out) in out.chunks_mut((rows_at_once * nx) as usize).enumerate() {
            let first = i as u32 * rows_at_once;
            let n = rows_at_once.min(rows - first);
            // One submit, the constants included: behind a run in training, each would wait its turn.
            let mut r = Recording::new(&self.gpu, "sample")?;
            for (name, bytes) in [("views", bytemuck::bytes_of(&view)), ("setup", bytemuck::bytes_of(&setup))] {
                let staging = self.gpu.buffer(name, bytes.len() as u64, Memory::Upload)?;
                staging.write(bytes)?;
                let on_device = self.gpu.buffer(name, bytes.len() as u64, Memory::Device)?;
                r.copy(&staging, 0, &on_device, 0, bytes.len() as u64)?;
                buffers.set(name, on_device);
            }
            let k = &self.kernels;
            dispatch(&mut r, &k.pose_rays, groups_for(&k.pose_rays, n), &buffers, &[], [first, n, phase, ny, 0])?;
            match field {
                Field::Static => {
                    let groups = groups_for(&k.volume_static, n * nx);
                    dispatch(&mut r, &k.volume_static, groups, &buffers, &[], [n])?;
                }
                Field::Dynamic(_) => {
                    r.fill(&cells, 0);
                    self.record_dynamic_cells(&mut r, &buffers, &setup, n)?;
                }
            }
            r.copy(&cells, 0, &read, 0, u64::from(n) * u64::from(nx) * 4)?;
            self.gpu.wait(r.finish()?.submit()?)?;
            read.read(out)?;
        }
        Ok(out)
    }
}

impl Renderer {
    /// Attenuation per mm of the sum of fields at the points of a grid; zero outside their boxes and hull.
    ///
    /// # Errors
    /// [`Error::Config`] for an impossible grid or phase; device errors.
    pub fn sample_patient(&self, fields: Fields, grid: &PatientGrid) -> Result<Vec<f32>> {
        grid.check()?;
        let swap = |v: DVec3| DVec3::new(v.y, v.x, v.z);
        let [nl, np, ns] = grid.size;
        // A row of the world's grid, along posterior, has two points or more.
        let rows = Grid {
            origin: world_from_lps_mm(grid.origin_mm),
            spacing: swap(grid.spacing_mm) / MM_PER_UNIT,
            size: [np.max(2), nl, ns],
        };
        let mut out = vec![0f32; (nl * np) as usize * ns as usize];
        let wanted = fields.dynamic_phase.map(Field::Dynamic).into_iter();
        for field in wanted.chain(fields.with_static.then_some(Field::Static)) {
            let cells = self.sample(field, &rows)?;
            let (row, plane) = (rows.size[0] as usize, (rows.size[0] * nl) as usize);
            for (slice, out) in out.chunks_mut((nl * np) as usize).enumerate() {
                for (p, out) in out.chunks_mut(nl as usize).enumerate() {
                    for (l, out) in out.iter_mut().enumerate() {
                        *out += cells[slice * plane + l * row + p] / MM_PER_UNIT as f32;
                    }
                }
            }
        }
        Ok(out)
    }
}

/// Cells of a baked volume along its longest side.
pub const BAKED_CELLS: u32 = 192;

/// What a pixel of a baked view shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Quantity {
    /// Include the still background.
    pub with_static: bool,
    /// Include the moving vessels.
    pub with_dynamic: bool,
    /// The largest attenuation per world unit along the ray (of both fields, the larger) instead of the line integral.
    pub maximum: bool,
}

/// A model baked into volumes: every phase's dynamic field over its box, and the static field. Renders at display rates;
/// finer detail than a cell is lost. Volumes are baked when first needed, or when asked for.
pub struct Baked {
    renderer: Arc<Renderer>,
    still: Grid,
    moving: Grid,
    /// The static field, then each phase.
    volumes: Mutex<Vec<Option<Volume>>>,
    /// Recorded once per size, phase and quantity: a frame is a view written, a submit and a picture read.
    shots: Mutex<HashMap<ShotKey, Arc<Shot>>>,
}

/// Recorded frames kept; a viewer in use has far fewer.
const MOST_SHOTS: usize = 256;

/// Columns, rows, phase, quantity.
type ShotKey = (usize, usize, u32, Quantity);

struct Shot {
    commands: Commands,
    view: Buffer,
    image: Buffer,
    /// A shot's buffers hold one frame.
    in_use: Mutex<()>,
}

impl Baked {
    /// Bakes all phases with `cells` cells along the longest side of each box.
    ///
    /// # Errors
    /// Device errors, [`Error::OutOfMemory`] first of all.
    pub fn new(renderer: Arc<Renderer>, cells: u32) -> Result<Baked> {
        let baked = Self::empty(renderer, cells, cells);
        baked.bake(Field::Static)?;
        for phase in 0..baked.renderer.setup.n_phases {
            baked.bake(Field::Dynamic(phase))?;
        }
        Ok(baked)
    }

    /// Prepares volumes whose moving cells have sides of `cell_mm`, for drawing at display rates; bakes none yet. The
    /// static field has no detail between the cells of its grid, of which there are two to one of those.
    pub fn for_display(renderer: Arc<Renderer>, model: &Model, cell_mm: f64) -> Baked {
        let scene = &model.scene;
        let extent = (0..3).map(|i| scene.dynamic_max[i] - scene.dynamic_min[i]).fold(0.0, f64::max);
        let moving_cells = ((extent * MM_PER_UNIT / cell_mm).ceil() as u32).clamp(32, BAKED_CELLS);
        let still_cells = (2 * model.config.static_field.grid).clamp(32, BAKED_CELLS);
        Self::empty(renderer, still_cells, moving_cells)
    }

    /// Prepares volumes of `still_cells` and `moving_cells` cells along the longest side of each box; bakes none yet.
    fn empty(renderer: Arc<Renderer>, still_cells: u32, moving_cells: u32) -> Baked {
        let s = &renderer.setup;
        let v = |x: f32, y: f32, z: f32| DVec3::new(x.into(), y.into(), z.into());
        let still = Grid::over(
            v(s.static_min_x, s.static_min_y, s.static_min_z),
            v(s.static_max_x, s.static_max_y, s.static_max_z),
            still_cells,
        );
        let moving = Grid::over(
            v(s.dynamic_min_x, s.dynamic_min_y, s.dynamic_min_z),
            v(s.dynamic_max_x, s.dynamic_max_y, s.dynamic_max_z),
            moving_cells,
        );
        let volumes = Mutex::new(vec![None; 1 + s.n_phases as usize]);
        Baked { still, moving, volumes, renderer, shots: Mutex::default() }
    }

    /// What the volumes are baked from.
    pub fn renderer(&self) -> &Renderer {
        &self.renderer
    }

    /// Bakes a field as the renderer's parameters are now, for the first time or again. The last copy may be under way:
    /// it is in order with what is rendered next; dropping the result waits for it.
    ///
    /// # Errors
    /// As [`Renderer::sample`]; [`Error::OutOfMemory`].
    pub fn bake(&self, field: Field) -> Result<Commands> {
        let setup = &self.renderer.setup;
        let (grid, gain, slot) = match field {
            Field::Static => (&self.still, setup.static_gain, 0),
            Field::Dynamic(phase) => (&self.moving, setup.dynamic_gain, 1 + phase as usize),
        };
        // In units of the field's scale, values are near 1 and f16 loses a thousandth at most.
        let cells: Vec<f16> = self.renderer.sample(field, grid)?.iter().map(|x| f16::from_f32(x / gain)).collect();
        let mut volumes = self.volumes.lock().unwrap_or_else(PoisonError::into_inner);
        match &volumes[slot] {
            Some(volume) => volume.fill(&cells),
            None => {
                let volume = self.renderer.gpu.volume("baked", grid.size)?;
                let filling = volume.fill(&cells)?;
                volumes[slot] = Some(volume);
                Ok(filling)
            }
        }
    }

    /// Whether a field has been baked.
    pub fn has(&self, field: Field) -> bool {
        self.volume(field).is_some()
    }

    fn volume(&self, field: Field) -> Option<Volume> {
        let slot = match field {
            Field::Static => 0,
            Field::Dynamic(phase) => 1 + phase as usize,
        };
        self.volumes.lock().unwrap_or_else(PoisonError::into_inner)[slot].clone()
    }

    fn volume_or_bake(&self, field: Field) -> Result<Volume> {
        if !self.has(field) {
            self.bake(field)?;
        }
        self.volume(field).ok_or_else(|| Error::Internal(format!("{field:?} was baked into nothing")))
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
        let shot = self.shot(width, height, phase, quantity)?;
        let _alone = shot.in_use.lock().unwrap_or_else(PoisonError::into_inner);
        shot.view.write(&[rays.to_device()])?;
        self.renderer.gpu.wait(shot.commands.submit()?)?;
        let mut image = vec![0f32; width * height];
        shot.image.read(&mut image)?;
        Ok(image)
    }

    /// As [`Baked::render`], into a buffer on the device: `width` x `height` floats.
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
        let view = self.renderer.gpu.buffer("view", size_of::<View>() as u64, Memory::Upload)?;
        view.write(&[rays.to_device()])?;
        let commands = self.record(&view, target, (width, height), phase, quantity)?;
        self.renderer.gpu.wait(commands.submit()?)
    }

    fn shot(&self, width: usize, height: usize, phase: u32, quantity: Quantity) -> Result<Arc<Shot>> {
        let mut shots = self.shots.lock().unwrap_or_else(PoisonError::into_inner);
        let key = (width, height, phase, quantity);
        if let Some(shot) = shots.get(&key) {
            return Ok(shot.clone());
        }
        if shots.len() >= MOST_SHOTS {
            shots.clear();
        }
        let (gpu, pixels) = (&self.renderer.gpu, (width * height) as u32);
        let view = gpu.buffer("view", size_of::<View>() as u64, Memory::Upload)?;
        let image = gpu.buffer("image", u64::from(pixels) * 4, Memory::Readback)?;
        let commands = self.record(&view, &image, (width, height), phase, quantity)?;
        let shot = Arc::new(Shot { commands, view, image, in_use: Mutex::default() });
        shots.insert(key, shot.clone());
        Ok(shot)
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
        let mut buffers = self.renderer.buffers.clone();
        buffers.set("views", view.clone());
        buffers.set("image", image.clone());
        // A field that is not shown is bound, since the kernel names it, but not read.
        let shown = |field, wanted| if wanted { self.volume_or_bake(field).map(Some) } else { Ok(None) };
        let still = shown(Field::Static, quantity.with_static)?;
        let moving = shown(Field::Dynamic(phase), quantity.with_dynamic || still.is_none())?;
        let any = still.as_ref().or(moving.as_ref());
        let any = any.ok_or_else(|| Error::Internal("no volume to render".into()))?;
        buffers.set_volume("static_volume", still.as_ref().unwrap_or(any).clone());
        buffers.set_volume("dynamic_volume", moving.as_ref().unwrap_or(any).clone());
        let stage = &self.renderer.kernels.baked_march;
        let push = [
            pixels,
            width as u32,
            u32::from(quantity.with_static),
            u32::from(quantity.with_dynamic),
            u32::from(quantity.maximum),
        ];
        let mut recording = Recording::new(gpu, "baked render")?;
        dispatch(&mut recording, stage, groups_for(stage, pixels), &buffers, &[], push)?;
        recording.finish()
    }
}
