//! SAX-NeRF's field as it is drawn: along rays, and at the cells of volumes.

use crate::error::{Error, Result};
use crate::gpu::buffer::Buffer;
use crate::gpu::device::Gpu;
use crate::gpu::record::Recording;
use crate::kernels::layout::SaxSetup;
use crate::model::sax::SaxField;
use crate::sax::buffers::{Passes, params_buffer, sample_buffers};
use crate::sax::setup::drawing_setup;
use crate::sax::stages::{SaxFieldKernels, SaxSampleBuffers, SaxSampling, record_view};
use std::sync::{Mutex, PoisonError};

/// Samples asked at once: 16 MiB of features where there are 16 levels.
const SAMPLES_AT_ONCE: u32 = 131_072;

/// Draws a field.
pub struct SaxDrawing {
    gpu: Gpu,
    kernels: SaxFieldKernels,
    field: SaxField,
    setup: SaxSetup,
    buffers: SaxSampleBuffers,
    /// Numbers of each set on the device.
    params: Mutex<Vec<Buffer>>,
}

/// What is drawn into.
#[derive(Clone, Copy)]
enum Target<'a> {
    /// What rays see.
    View(&'a Buffer),
    /// Attenuation per world unit at samples, `[ray][sample]`.
    Cells(&'a Buffer),
}

impl SaxDrawing {
    /// Puts a field on the device; numbers that it lacks come by [`SaxDrawing::follow`].
    ///
    /// # Errors
    /// [`Error::OutOfMemory`]; other device errors.
    pub fn new(gpu: &Gpu, field: &SaxField) -> Result<SaxDrawing> {
        let setup = drawing_setup(field);
        let at_once = SAMPLES_AT_ONCE.max(field.samples);
        let outline = SaxField { params: Vec::new(), step: 0, ..field.clone() };
        let drawing = SaxDrawing {
            gpu: gpu.clone(),
            kernels: SaxFieldKernels::new(gpu)?,
            buffers: sample_buffers(gpu, &outline, &setup, at_once, Passes::Drawing)?,
            field: outline,
            setup,
            params: Mutex::new(Vec::new()),
        };
        drawing.replace(field)?;
        Ok(drawing)
    }

    /// Draws another field of the same sizes from now on; what was recorded before draws the old one. One without
    /// numbers changes nothing.
    ///
    /// # Errors
    /// As [`SaxDrawing::new`]; [`Error::Internal`] for other sizes.
    pub fn replace(&self, field: &SaxField) -> Result<()> {
        if field.shape != self.field.shape || field.n_sets != self.field.n_sets {
            return Err(Error::Internal("the field has other sizes than the one that is drawn".into()));
        }
        if !field.params.is_empty() {
            let upload = |set: &Vec<f32>| params_buffer(&self.gpu, "sax_params that are drawn", set);
            self.follow(field.params.iter().map(upload).collect::<Result<_>>()?);
        }
        Ok(())
    }

    /// Draws numbers that are on the device, as a run leaves them there.
    pub fn follow(&self, params: Vec<Buffer>) {
        *self.params.lock().unwrap_or_else(PoisonError::into_inner) = params;
    }

    /// Records what `n_rays` of `rays` see at a phase.
    ///
    /// # Errors
    /// [`Error::Internal`] when stages and buffers do not fit, or there are no numbers yet.
    pub fn record_rays(
        &self,
        recording: &mut Recording,
        rays: &Buffer,
        ray_out: &Buffer,
        phase: u32,
        n_rays: u32,
    ) -> Result<()> {
        let parts = (&self.buffers, &self.setup);
        self.record(recording, parts, rays, (phase, n_rays), Target::View(ray_out))
    }

    /// Records attenuation per world unit at the cells of `volume`: rows of `row` cells from depth `near` to `far`
    /// along `rays`.
    ///
    /// # Errors
    /// As [`SaxDrawing::record_rays`]; [`Error::Config`] for a row of more cells than are asked at once.
    pub fn record_cells(
        &self,
        recording: &mut Recording,
        rays: &Buffer,
        (near, far, row): (f32, f32, u32),
        (phase, n_rows): (u32, u32),
        volume: &Buffer,
    ) -> Result<()> {
        if row > SAMPLES_AT_ONCE {
            return Err(Error::config("grid", row, format!("at most {SAMPLES_AT_ONCE} points along x are accepted")));
        }
        let setup = SaxSetup { near, far, n_samples: row, ..self.setup };
        let buffers = SaxSampleBuffers {
            sax_setup: self.gpu.buffer_with("sax_setup of rows", &[setup])?,
            ..self.buffers.clone()
        };
        self.record(recording, (&buffers, &setup), rays, (phase, n_rows), Target::Cells(volume))
    }

    fn record(
        &self,
        recording: &mut Recording,
        (buffers, setup): (&SaxSampleBuffers, &SaxSetup),
        rays: &Buffer,
        (phase, n_rays): (u32, u32),
        target: Target<'_>,
    ) -> Result<()> {
        let all = self.params.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let missing = || Error::Internal(format!("no numbers of SAX-NeRF's field at phase {phase}"));
        let params = all.get(self.field.set_of(phase)).ok_or_else(missing)?;
        let sampling = SaxSampling { kernels: &self.kernels, buffers, setup, shape: self.field.shape, params, rays };
        let attenuation = self.field.attenuation as f32;
        let at_once = (SAMPLES_AT_ONCE / setup.n_samples).max(1);
        for first in (0..n_rays).step_by(at_once as usize) {
            let n = at_once.min(n_rays - first);
            let out = match target {
                Target::View(_) => None,
                Target::Cells(volume) => Some((volume, first * setup.n_samples)),
            };
            sampling.record(recording, (0, first, n), attenuation, out)?;
            if let Target::View(ray_out) = target {
                record_view(recording, &sampling, ray_out, (first, n))?;
            }
        }
        Ok(())
    }
}
