//! Drawing of SAX-NeRF's field along rays and at the cells of volumes.

use crate::error::{Error, Result};
use crate::gpu::buffer::Buffer;
use crate::gpu::device::Gpu;
use crate::gpu::record::Recording;
use crate::kernels::layout::SaxSetup;
use crate::methods::sax_nerf::buffers::{Passes, params_buffer, sample_buffers};
use crate::methods::sax_nerf::field::SaxField;
use crate::methods::sax_nerf::setup::drawing_setup;
use crate::methods::sax_nerf::stages::{SaxFieldKernels, SaxSampleBuffers, SaxSampling, record_view};
use crate::model::field::{Field, FieldDrawing, Row};
use crate::network::chunk::Chunk;
use std::sync::{Mutex, PoisonError};

/// Number of samples evaluated at once: 16 MiB of features with 16 levels.
const SAMPLES_AT_ONCE: u32 = 131_072;

/// Draws a field.
pub struct SaxDrawing {
    gpu: Gpu,
    kernels: SaxFieldKernels,
    field: SaxField,
    setup: SaxSetup,
    buffers: SaxSampleBuffers,
    /// Parameters of each set on the device.
    params: Mutex<Vec<Buffer>>,
}

/// Target of a drawing.
#[derive(Clone, Copy)]
enum Target<'a> {
    /// Rendered values of rays.
    View(&'a Buffer),
    /// Attenuation per world unit at samples, `[ray][sample]`.
    Cells(&'a Buffer),
}

/// Rays that are drawn, and the buffers in which their samples are evaluated.
struct DrawnRays<'a> {
    buffers: &'a SaxSampleBuffers,
    setup: &'a SaxSetup,
    rays: &'a Buffer,
    phase: u32,
    n_rays: u32,
}

impl SaxDrawing {
    /// Uploads a field to the device; parameters that it lacks are set by [`FieldDrawing::follow`].
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
        drawing.replace_field(field)?;
        Ok(drawing)
    }

    fn replace_field(&self, field: &SaxField) -> Result<()> {
        if field.shape != self.field.shape || field.n_sets != self.field.n_sets {
            return Err(Error::Internal(
                "the field has a different shape from the field that the drawing was created for".into(),
            ));
        }
        if !field.params.is_empty() {
            let upload = |set: &Vec<f32>| params_buffer(&self.gpu, "sax_params that are drawn", set);
            self.set_params(field.params.iter().map(upload).collect::<Result<_>>()?);
        }
        Ok(())
    }

    fn set_params(&self, params: Vec<Buffer>) {
        *self.params.lock().unwrap_or_else(PoisonError::into_inner) = params;
    }

    fn record(
        &self,
        recording: &mut Recording,
        DrawnRays { buffers, setup, rays, phase, n_rays }: DrawnRays<'_>,
        target: Target<'_>,
    ) -> Result<()> {
        let all = self.params.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let missing = || Error::Internal(format!("there are no parameters of SAX-NeRF's field at phase {phase}"));
        let params = all.get(self.field.set_of(phase)).ok_or_else(missing)?;
        let sampling = SaxSampling { kernels: &self.kernels, buffers, setup, shape: self.field.shape, params, rays };
        let attenuation = self.field.attenuation as f32;
        let at_once = (SAMPLES_AT_ONCE / setup.n_samples).max(1);
        for first in (0..n_rays).step_by(at_once as usize) {
            let chunk = Chunk { first_ray: first, n_rays: at_once.min(n_rays - first) };
            let out = match target {
                Target::View(_) => None,
                Target::Cells(volume) => Some((volume, first * setup.n_samples)),
            };
            sampling.record(recording, 0, chunk, attenuation, out)?;
            if let Target::View(ray_out) = target {
                record_view(recording, &sampling, ray_out, chunk)?;
            }
        }
        Ok(())
    }
}

impl FieldDrawing for SaxDrawing {
    fn replace(&self, field: &dyn Field) -> Result<()> {
        match field.downcast::<SaxField>() {
            Some(field) => self.replace_field(field),
            None => Err(Error::Internal(
                "the field belongs to another method than the field that the drawing was created for".into(),
            )),
        }
    }

    fn follow(&self, params: Vec<Buffer>) {
        self.set_params(params);
    }

    fn record_rays(
        &self,
        recording: &mut Recording,
        rays: &Buffer,
        ray_out: &Buffer,
        phase: u32,
        n_rays: u32,
    ) -> Result<()> {
        let drawn = DrawnRays { buffers: &self.buffers, setup: &self.setup, rays, phase, n_rays };
        self.record(recording, drawn, Target::View(ray_out))
    }

    fn record_cells(
        &self,
        recording: &mut Recording,
        rays: &Buffer,
        Row { near, far, cells }: Row,
        phase: u32,
        n_rows: u32,
        volume: &Buffer,
    ) -> Result<()> {
        if cells > SAMPLES_AT_ONCE {
            return Err(Error::config("grid", cells, format!("at most {SAMPLES_AT_ONCE} points along x are accepted")));
        }
        let setup = SaxSetup { near, far, n_samples: cells, ..self.setup };
        let buffers = SaxSampleBuffers {
            sax_setup: self.gpu.buffer_with("sax_setup of rows", &[setup])?,
            ..self.buffers.clone()
        };
        let drawn = DrawnRays { buffers: &buffers, setup: &setup, rays, phase, n_rays: n_rows };
        self.record(recording, drawn, Target::Cells(volume))
    }
}
