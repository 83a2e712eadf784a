//! Fields sampled on a regular grid.

use crate::error::{Error, Result};
use crate::geometry::{MM_PER_UNIT, world_from_lps_mm};
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::record::Recording;
use crate::kernels::dispatch::Binding;
use crate::kernels::layout::{Setup, View};
use crate::kernels::push;
use crate::model::component::Component;
use crate::model::field::Row;
use crate::network::forward::{ForwardBuffers, PoseBuffers};
use crate::network::pass::Pass;
use crate::network::static_network::static_setup;
use crate::render::grid::{Grid, PatientGrid};
use crate::render::renderer::{CELLS_PER_SUBMIT, RAYS_PER_SUBMIT, Renderer, pose};
use crate::scan::gating::BeatTime;
use glam::DVec3;
use std::time::Instant;

impl Renderer {
    /// Attenuation per world unit at the points of a grid, of a component at a phase; each field is zero outside its box
    /// and hull.
    ///
    /// # Errors
    /// [`Error::Config`] for a phase the model does not have or more points along x than fit; device errors.
    pub fn sample(&self, component: Component, phase: u32, grid: &Grid) -> Result<Vec<f32>> {
        self.check_phase(phase)?;
        let mut sum = vec![0f32; grid.len()];
        for field in component.fields() {
            let cells = self.sample_field(*field, phase, grid, 0.0)?;
            sum.iter_mut().zip(cells).for_each(|(sum, cell)| *sum += cell);
        }
        Ok(sum)
    }

    /// Samples a single field at the points of a grid. For Gaussians and an `away` other than zero, world units, returns the
    /// maximum (`away` above zero) or the minimum (below) within that distance of each point.
    fn sample_field(&self, field: Component, phase: u32, grid: &Grid, away: f32) -> Result<Vec<f32>> {
        let [nx, ny, nz] = grid.size;
        if nx < 2 || nx > self.largest_row() {
            return Err(Error::config(
                "grid",
                nx,
                format!("is out of range: 2 to {} points along x are accepted", self.largest_row()),
            ));
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
        let static_network = self.static_network.as_ref().filter(|_| field == Component::Static);
        if static_network.is_some() {
            setup = static_setup(&setup);
        }
        let rows = ny * nz;
        let most_rows = RAYS_PER_SUBMIT.min((CELLS_PER_SUBMIT / nx).max(1)).min(rows);
        let pace = self.volume_paces.as_ref().map(|paces| &paces[usize::from(field == Component::Static)]);
        let bytes = u64::from(most_rows) * u64::from(nx) * 4;
        let cells = self.gpu.buffer("volume", bytes, Memory::Device)?;
        let read = self.gpu.buffer("volume read-back", bytes, Memory::Readback)?;
        let mut out = vec![0f32; grid.len()];
        let (mut first, mut left) = (0, &mut out[..]);
        while first < rows {
            self.pause()?;
            let n = pace.map_or(most_rows, |pace| (pace.items() / nx).clamp(1, most_rows)).min(rows - first);
            let (out, rest) = std::mem::take(&mut left).split_at_mut((n * nx) as usize);
            let _alone = self.alone();
            let begin = Instant::now();
            // One submit, the constants included: behind a run in training, each would wait its turn.
            let mut r = Recording::new(&self.gpu, "sample")?;
            let pose = pose(BeatTime::at_phase(phase), &setup, first);
            let of = PoseBuffers {
                views: self.constants(&mut r, "views", bytemuck::bytes_of(&view))?,
                pose: self.constants(&mut r, "pose", bytemuck::bytes_of(&pose))?,
            };
            let setup_buffer = self.constants(&mut r, "setup", bytemuck::bytes_of(&setup))?;
            let buffers = ForwardBuffers { setup: setup_buffer, ..self.buffers.clone() };
            let push = push::PoseRays { n_rays: n, image_width: ny, along_axis: setup.along_axis };
            buffers.record_pose(&mut r, &self.kernels, &of, push)?;
            match (field, &self.blobs, static_network) {
                (Component::Static, _, Some(static_network)) => {
                    r.fill(&cells, 0);
                    let pass = self.pass(&mut r, &buffers, &setup);
                    Pass { network: Some(static_network.network()), static_network: None, ..pass }.volume(n, &cells)?;
                }
                (Component::Static, _, None) => {
                    let stage = &self.kernels.volume_static;
                    let bound = [(Binding::volume, (&cells).into())];
                    let push = push::VolumeStatic { n_rays: n };
                    self.pass(&mut r, &buffers, &setup).run_with(stage, stage.groups_over(n * nx), &bound, push)?;
                }
                _ if self.field.is_some() => self.record_field(&mut r, &buffers, &setup, (phase, n), &cells)?,
                (_, Some(blobs), _) => blobs.record_points(&mut r, &buffers, phase, (n, nx), away, &cells)?,
                (_, None, _) => {
                    r.fill(&cells, 0);
                    self.pass(&mut r, &buffers, &setup).volume(n, &cells)?;
                }
            }
            r.copy(&cells, 0, &read, 0, u64::from(n) * u64::from(nx) * 4)?;
            self.gpu.wait(r.finish()?.submit()?)?;
            read.read(out)?;
            if let Some(pace) = pace {
                pace.note(n * nx, begin.elapsed().as_secs_f64());
            }
            (first, left) = (first + n, rest);
        }
        Ok(out)
    }

    /// Records the field of a method of `crate::methods` at the cells of rows along x.
    fn record_field(
        &self,
        recording: &mut Recording,
        buffers: &ForwardBuffers,
        setup: &Setup,
        (phase, n_rows): (u32, u32),
        cells: &Buffer,
    ) -> Result<()> {
        let Some(field) = &self.field else { return Ok(()) };
        let row = Row { near: setup.dynamic_near, far: setup.dynamic_far, cells: setup.n_dynamic_samples };
        field.record_cells(recording, &buffers.rays, row, phase, n_rows, cells)
    }

    /// Creates a buffer of bytes that are uploaded after the commands recorded so far.
    fn constants(&self, recording: &mut Recording, name: &str, bytes: &[u8]) -> Result<Buffer> {
        let staging = self.gpu.buffer(name, bytes.len() as u64, Memory::Upload)?;
        staging.write(bytes)?;
        let on_device = self.gpu.buffer(name, bytes.len() as u64, Memory::Device)?;
        recording.copy(&staging, 0, &on_device, 0, bytes.len() as u64)?;
        Ok(on_device)
    }

    /// Attenuation per mm at the points of a grid, of a component at a phase; zero outside the fields' boxes and hull.
    ///
    /// # Errors
    /// [`Error::Config`] for an impossible grid or phase; device errors.
    pub fn sample_patient(&self, component: Component, phase: u32, grid: &PatientGrid) -> Result<Vec<f32>> {
        grid.check()?;
        let mut out = vec![0f32; grid.size.iter().map(|n| *n as usize).product()];
        for field in component.fields() {
            let cells = self.sample(*field, phase, &rows_of(grid))?;
            add_per_mm(&mut out, &cells, grid);
        }
        Ok(out)
    }

    /// Minimum and maximum attenuation per mm of the dynamic field within `away_mm` of the points of a grid; `None` where it is
    /// not made of Gaussians, the only form with known bounds.
    ///
    /// # Errors
    /// As [`Renderer::sample_patient`].
    pub fn bound_patient(&self, phase: u32, grid: &PatientGrid, away_mm: f64) -> Result<Option<[Vec<f32>; 2]>> {
        if self.blobs.is_none() {
            return Ok(None);
        }
        grid.check()?;
        self.check_phase(phase)?;
        let bound = |away_mm: f64| -> Result<Vec<f32>> {
            let away = (away_mm / MM_PER_UNIT) as f32;
            let cells = self.sample_field(Component::Dynamic, phase, &rows_of(grid), away)?;
            let mut out = vec![0f32; grid.size.iter().map(|n| *n as usize).product()];
            add_per_mm(&mut out, &cells, grid);
            Ok(out)
        };
        Ok(Some([bound(-away_mm)?, bound(away_mm)?]))
    }
}

/// Converts a grid of the patient to one of the world, whose rows run along posterior and have two points or more.
fn rows_of(grid: &PatientGrid) -> Grid {
    let swap = |v: DVec3| DVec3::new(v.y, v.x, v.z);
    let [nl, np, ns] = grid.size;
    Grid {
        origin: world_from_lps_mm(grid.origin_mm),
        spacing: swap(grid.spacing_mm) / MM_PER_UNIT,
        size: [np.max(2), nl, ns],
    }
}

/// Adds the values of such rows, per world unit, to the points of the patient's grid, per mm.
fn add_per_mm(out: &mut [f32], cells: &[f32], grid: &PatientGrid) {
    let [nl, np, _] = grid.size.map(|n| n as usize);
    let row = np.max(2);
    for (slice, out) in out.chunks_mut(nl * np).enumerate() {
        for (p, out) in out.chunks_mut(nl).enumerate() {
            for (l, out) in out.iter_mut().enumerate() {
                *out += cells[slice * row * nl + l * row + p] / MM_PER_UNIT as f32;
            }
        }
    }
}
