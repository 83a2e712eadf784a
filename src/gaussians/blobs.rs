//! Drawing of Gaussians along rays and at the cells of volumes.

use crate::error::{Error, Result};
use crate::gaussians::field::{GaussianField, Gaussians, Units, scales};
use crate::gpu::buffer::Buffer;
use crate::gpu::device::Gpu;
use crate::gpu::record::{Groups, Recording};
use crate::kernels::constants::gaussian_points::ROWS;
use crate::kernels::dispatch::{Binding, BufferSet, dispatch_finding};
use crate::kernels::layout::{Blob, Gaussian, GaussianSetup};
use crate::kernels::push::{self, GaussianRays};
use crate::kernels::stages::{Build, Stage, vec4_variant};
use crate::kernels::tuning::Tuning;
use glam::{DMat3, DQuat, DVec3};
use std::ops::Range;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Sides of the tile of pixels that a workgroup draws.
const TILE: u32 = 8;

/// Pipelines.
pub struct BlobKernels {
    /// Line integrals.
    pub rays: Stage<push::GaussianRays>,
    /// Line integrals and maxima.
    pub rays_maxima: Stage<push::GaussianRays>,
    /// Maxima where many Gaussians overlap.
    pub maxima: Stage<push::GaussianMaxima>,
    /// Attenuation at the cells of rows.
    pub points: Stage<push::GaussianPoints>,
}

impl BlobKernels {
    /// Builds the pipelines.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu, tuning: &Tuning) -> Result<BlobKernels> {
        let plain = Build::default();
        Ok(BlobKernels {
            rays: Build { variant: vec4_variant(tuning), ..plain }.stage(gpu)?,
            rays_maxima: Build { variant: vec4_variant(tuning), constants: &[("with_maxima", 1)], ..plain }
                .stage(gpu)?,
            maxima: Build { exchanges: true, ..plain }.stage(gpu)?,
            points: plain.stage(gpu)?,
        })
    }
}

impl Blob {
    /// Returns a Gaussian in world units.
    pub fn of(g: &Gaussian, units: Units, setup: &GaussianSetup) -> Blob {
        let scale = scales(g, setup) * units.pixel;
        let [w, x, y, z] = g.rotation.map(f64::from);
        let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        let inverse = axes * DMat3::from_diagonal(1.0 / (scale * scale)) * axes.transpose();
        let cut = f64::from(setup.cut);
        let f32s = |v: DVec3| v.as_vec3().to_array();
        Blob {
            centre: f32s(DVec3::from_array(g.position.map(f64::from)) * units.pixel),
            density: (f64::from(g.log_density).exp() * units.attenuation()) as f32,
            diagonal: f32s(DVec3::new(inverse.x_axis.x, inverse.y_axis.y, inverse.z_axis.z)),
            reach: (cut * scale.max_element()) as f32,
            mixed: f32s(DVec3::new(inverse.y_axis.x, inverse.z_axis.x, inverse.z_axis.y)),
            cut: (cut * cut) as f32,
        }
    }
}

/// Gaussians on the device at one moment of the beat: a range of a buffer.
#[derive(Clone)]
pub struct BlobList {
    blobs: Buffer,
    range: Range<u32>,
}

/// Gaussians of all phases on the device.
struct BlobSet {
    blobs: Buffer,
    /// Range of each phase's Gaussians in the buffer.
    phases: Vec<Range<u32>>,
}

impl BlobSet {
    fn new(gpu: &Gpu, field: &GaussianField) -> Result<BlobSet> {
        let (sets, mut all, mut phases) = (field.rows(), Vec::new(), Vec::new());
        for phase in 0..sets.n_phases {
            let first = all.len() as u32;
            all.extend(field.at(phase).iter().map(|g| Blob::of(g, sets.units, &sets.setup)));
            phases.push(first..all.len() as u32);
        }
        Ok(BlobSet { blobs: upload(gpu, all)?, phases })
    }
}

/// The field, which is uploaded when it is first drawn: pictures at display rates do not need it here.
struct Shown {
    field: GaussianField,
    on_device: Option<BlobSet>,
}

/// Creates a buffer of Gaussians, which is never empty.
fn upload(gpu: &Gpu, blobs: Vec<Blob>) -> Result<Buffer> {
    let blobs = if blobs.is_empty() { vec![Blob::default()] } else { blobs };
    Ok(gpu.buffer_with("blobs", &blobs)?)
}

/// Draws a dynamic field that consists of Gaussians.
pub struct Blobs {
    gpu: Gpu,
    kernels: BlobKernels,
    shown: Mutex<Shown>,
}

impl Blobs {
    /// Prepares to draw a field.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu, tuning: &Tuning, field: &GaussianField) -> Result<Blobs> {
        let shown = Mutex::new(Shown { field: field.clone(), on_device: None });
        Ok(Blobs { gpu: gpu.clone(), kernels: BlobKernels::new(gpu, tuning)?, shown })
    }

    /// Replaces the field to be drawn. Commands that were recorded before draw the old field.
    pub fn replace(&self, field: &GaussianField) {
        *self.shown() = Shown { field: field.clone(), on_device: None };
    }

    fn shown(&self) -> MutexGuard<'_, Shown> {
        self.shown.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the Gaussians at a phase.
    ///
    /// # Errors
    /// [`Error::Internal`] for a phase the field does not have; [`Error::OutOfMemory`]; other device errors.
    pub fn at(&self, phase: u32) -> Result<BlobList> {
        let Shown { field, on_device } = &mut *self.shown();
        let set = match on_device {
            Some(set) => set,
            none => none.insert(BlobSet::new(&self.gpu, field)?),
        };
        let missing = || Error::Internal(format!("there are no Gaussians of phase {phase}"));
        Ok(BlobList { blobs: set.blobs.clone(), range: set.phases.get(phase as usize).ok_or_else(missing)?.clone() })
    }

    /// Tells whether the field is known between phases.
    pub fn move_between_phases(&self) -> bool {
        self.shown().field.moving().is_some()
    }

    /// Returns the Gaussians of a deformable set at a phase, which may be fractional; none for another field, which is known only at
    /// whole phases.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`]; other device errors.
    pub fn between(&self, phase: f64) -> Result<Option<BlobList>> {
        let blobs: Vec<Blob> = {
            let shown = self.shown();
            let Some(moving) = shown.field.moving() else { return Ok(None) };
            let Gaussians { units, setup, .. } = &moving.rest;
            moving.at(phase).iter().map(|g| Blob::of(g, *units, setup)).collect()
        };
        let range = 0..blobs.len() as u32;
        Ok(Some(BlobList { blobs: upload(&self.gpu, blobs)?, range }))
    }

    /// Records line integrals, and maxima if requested, of Gaussians at one moment along the `n_rays` rays in `buffers`, which
    /// are rows of an image of `image_width` columns. For the maximum of the sum of both fields, `ray_out` must already hold
    /// the values of the static field.
    ///
    /// # Errors
    /// [`Error::Internal`] when stage and buffers do not fit.
    pub fn record_rays(
        &self,
        recording: &mut Recording,
        buffers: &dyn BufferSet,
        BlobList { blobs, range }: &BlobList,
        n_rays: u32,
        image_width: u32,
        maxima: bool,
    ) -> Result<()> {
        let rows = n_rays.div_ceil(image_width);
        let tiles = image_width.div_ceil(TILE) * rows.div_ceil(TILE);
        let push = GaussianRays { n_rays, image_width, first_blob: range.start, n_blobs: range.len() as u32 };
        let bound = [(Binding::blobs, blobs.into())];
        let is_crowd = maxima && self.shown().field.rows().is_crowd;
        let stage = if maxima && !is_crowd { &self.kernels.rays_maxima } else { &self.kernels.rays };
        let (groups, find) = (|| Groups::Direct([tiles, 1, 1]), |name| buffers.find(name));
        dispatch_finding(recording, stage, groups(), &bound, find, push)?;
        if is_crowd {
            let GaussianRays { n_rays, image_width, first_blob, n_blobs } = push;
            let push = push::GaussianMaxima { n_rays, image_width, first_blob, n_blobs };
            dispatch_finding(recording, &self.kernels.maxima, groups(), &bound, find, push)?;
        }
        Ok(())
    }

    /// Records the field at the cells of `volume`: rows of `row_cells` along the rays `rows` in `buffers`. With an `away` other
    /// than zero, world units, records the maximum (`away` above zero) or minimum (below zero) of the field within this
    /// distance of the cells.
    ///
    /// # Errors
    /// Errors of [`Blobs::record_rays`].
    pub fn record_points(
        &self,
        recording: &mut Recording,
        buffers: &dyn BufferSet,
        phase: u32,
        (n_rows, row_cells): (u32, u32),
        away: f32,
        volume: &Buffer,
    ) -> Result<()> {
        // Groups along y are limited to 65535 on every device.
        const MAX_ROWS: u32 = 65_535 * ROWS;
        let BlobList { blobs, range } = self.at(phase)?;
        let bound = [(Binding::blobs, (&blobs).into()), (Binding::volume, volume.into())];
        let points = &self.kernels.points;
        for first_row in (0..n_rows).step_by(MAX_ROWS as usize) {
            let rows = MAX_ROWS.min(n_rows - first_row);
            let (first_blob, n_blobs) = (range.start, range.len() as u32);
            let push = push::GaussianPoints { first_row, n_rows, first_blob, n_blobs, away };
            let groups = Groups::Direct([row_cells.div_ceil(points.local_size()), rows.div_ceil(ROWS), 1]);
            dispatch_finding(recording, points, groups, &bound, |name| buffers.find(name), push)?;
        }
        Ok(())
    }
}
