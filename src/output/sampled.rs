//! Fields sampled on a regular grid: for export, and baked into 3D images for display rates.

use super::render::Renderer;
use crate::data::geometry::ViewRays;
use crate::error::{Error, Result};
use crate::gpu::memory::{Buffer, Memory};
use crate::gpu::record::{Commands, Recording};
use crate::gpu::volume::Volume;
use crate::kernels::{dispatch, groups_for};
use crate::layout::View;
use glam::DVec3;
use half::f16;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

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
        let mut buffers = self.buffers.clone();
        buffers.set("views", self.gpu.buffer_with("views", &[view])?);
        buffers.set("setup", self.gpu.buffer_with("setup", &[setup])?);
        let rows = ny * nz;
        let rows_at_once = self.rays_at_once(&setup).min(rows);
        let bytes = u64::from(rows_at_once) * u64::from(nx) * 4;
        let cells = self.gpu.buffer("volume", bytes, Memory::Device)?;
        buffers.set("volume", cells.clone());
        let mut out = Vec::with_capacity(grid.len());
        for first in (0..rows).step_by(rows_at_once as usize) {
            let n = rows_at_once.min(rows - first);
            let mut r = Recording::new(&self.gpu, "sample")?;
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
            self.gpu.wait(r.finish()?.submit()?)?;
            out.extend(self.gpu.download::<f32>(&cells, 0, (n * nx) as usize)?);
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
/// finer detail than a cell is lost.
pub struct Baked {
    renderer: Arc<Renderer>,
    still: Volume,
    moving: Vec<Volume>,
    /// Recorded once per size, phase and quantity: a frame is a view written, a submit and a picture read.
    shots: Mutex<HashMap<ShotKey, Arc<Shot>>>,
}

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
        let s = &renderer.setup;
        let v = |x: f32, y: f32, z: f32| DVec3::new(x.into(), y.into(), z.into());
        let still = Grid::over(
            v(s.static_min_x, s.static_min_y, s.static_min_z),
            v(s.static_max_x, s.static_max_y, s.static_max_z),
            cells,
        );
        let moving = Grid::over(
            v(s.dynamic_min_x, s.dynamic_min_y, s.dynamic_min_z),
            v(s.dynamic_max_x, s.dynamic_max_y, s.dynamic_max_z),
            cells,
        );
        let bake = |field: Field, grid: &Grid, gain: f32| {
            // In units of the field's scale, values are near 1 and f16 loses a thousandth at most.
            let cells: Vec<f16> = renderer.sample(field, grid)?.iter().map(|x| f16::from_f32(x / gain)).collect();
            renderer.gpu.volume("baked", grid.size, &cells)
        };
        let still = bake(Field::Static, &still, s.static_gain)?;
        let moving =
            (0..s.n_phases).map(|phase| bake(Field::Dynamic(phase), &moving, s.dynamic_gain)).collect::<Result<_>>()?;
        Ok(Baked { still, moving, renderer, shots: Mutex::default() })
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

    fn shot(&self, width: usize, height: usize, phase: u32, quantity: Quantity) -> Result<Arc<Shot>> {
        let mut shots = self.shots.lock().unwrap_or_else(PoisonError::into_inner);
        let key = (width, height, phase, quantity);
        if let Some(shot) = shots.get(&key) {
            return Ok(shot.clone());
        }
        let (gpu, pixels) = (&self.renderer.gpu, (width * height) as u32);
        let mut buffers = self.renderer.buffers.clone();
        let view = gpu.buffer("view", size_of::<View>() as u64, Memory::Upload)?;
        let image = gpu.buffer("image", u64::from(pixels) * 4, Memory::Readback)?;
        buffers.set("views", view.clone());
        buffers.set("image", image.clone());
        buffers.set_volume("static_volume", self.still.clone());
        buffers.set_volume("dynamic_volume", self.moving[phase as usize].clone());
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
        let shot = Arc::new(Shot { commands: recording.finish()?, view, image, in_use: Mutex::default() });
        shots.insert(key, shot.clone());
        Ok(shot)
    }
}
