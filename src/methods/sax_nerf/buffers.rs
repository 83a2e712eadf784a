//! Buffers of SAX-NeRF on a device, and a check of the memory that a fit takes.

use crate::config::Config;
use crate::config::sections::SaxSettings;
use crate::error::{Error, Result};
use crate::fitting::ring::ring;
use crate::fitting::sets::seed_of_set;
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::gpu::memory::DeviceMemory;
use crate::gpu::record::Recording;
use crate::kernels::constants::{SAX_FORWARD_VECTORS, SAX_VECTORS};
use crate::kernels::dispatch::Binding;
use crate::kernels::layout::{DeviceState, Ray, SaxSetup};
use crate::kernels::tuning::Tuning;
use crate::methods::sax_nerf::data::SaxData;
use crate::methods::sax_nerf::field::{SaxField, SaxState};
use crate::methods::sax_nerf::lineformer::{capacity, vector_bytes};
use crate::methods::sax_nerf::products::products;
use crate::methods::sax_nerf::setup::{adam_setup, schedule};
use crate::methods::sax_nerf::stages::{SaxFitBuffers, SaxSampleBuffers, SaxSetBuffers};

const MIB: u64 = 1 << 20;

/// Bytes that a fit takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SaxMemory {
    /// Size of the largest buffer of a field: moments, or sums of the grid's gradient.
    pub of_field_buffer: u64,
    /// Size of the largest buffer of a batch.
    pub of_batch_buffer: u64,
    /// Total size without images.
    pub total: u64,
}

impl SaxMemory {
    /// Returns the memory that the fields of `setup` and their batches take.
    pub fn of(setup: &SaxSetup) -> SaxMemory {
        let (weights, grid) = (u64::from(setup.n_weights), u64::from(setup.n_grid));
        let params = weights + grid;
        let samples = u64::from(setup.n_rays) * u64::from(setup.n_samples);
        let (encoding, parts) = (8 * u64::from(setup.n_levels) * samples, 4 * weights * u64::from(setup.n_groups));
        let vectors = vector_bytes(SAX_VECTORS, capacity(setup.n_rays * setup.n_samples));
        let of_fields = u64::from(setup.n_sets) * 12 * params + 8 * grid + 4 * params;
        SaxMemory {
            of_field_buffer: 8 * params,
            of_batch_buffer: encoding.max(parts).max(vectors).max(16 * samples),
            total: of_fields + 2 * encoding + parts + vectors + 20 * samples,
        }
    }

    /// Refuses a device with too little memory in total or too little free memory.
    ///
    /// # Errors
    /// [`Error::Config`] naming the setting to lower; [`Error::OutOfMemory`] where other programs hold the memory.
    pub fn check(&self, gpu: &Gpu, config: &Config<SaxSettings>, n_sets: usize) -> Result<()> {
        let (sax, info) = (&config.sax, gpu.info());
        let largest = u64::from(info.max_storage_buffer_range);
        let mib = |bytes: u64| bytes.div_ceil(MIB);
        if self.of_field_buffer > largest {
            let problem = format!(
                "Adam's moments of a field need a buffer of {} MiB, and the largest buffer of this device has {} MiB: \
                 lower sax.log2_hashmap_size or sax.num_levels",
                mib(self.of_field_buffer),
                mib(largest)
            );
            return Err(Error::config("sax.log2_hashmap_size", sax.log2_table, problem));
        }
        if self.of_batch_buffer > largest {
            let problem = format!(
                "a batch needs a buffer of {} MiB, and the largest buffer of this device has {} MiB: lower \
                 sax.n_samples, sax.n_rays or sax.window_num",
                mib(self.of_batch_buffer),
                mib(largest)
            );
            return Err(Error::config("sax.n_samples", sax.samples, problem));
        }
        self.check_total(&info.name, gpu.memory(), sax.log2_table, n_sets)
    }

    fn check_total(&self, device: &str, memory: DeviceMemory, log2_table: u32, n_sets: usize) -> Result<()> {
        if self.total > memory.bytes {
            let problem = format!(
                "{n_sets} fields need {} MiB, and this device has {memory}: lower sax.log2_hashmap_size or sax.num_levels, or use \
                 one field for all phases (sax.static_data = \"pooled\")",
                self.total.div_ceil(MIB)
            );
            return Err(Error::config("sax.log2_hashmap_size", log2_table, problem));
        }
        match memory.free {
            Some(free) if self.total > free => Err(Error::OutOfMemory {
                object: format!("a fit of {n_sets} fields"),
                bytes: self.total,
                detail: format!("{device} has {memory}"),
                may_pass: true,
                instead: "again when other programs have freed memory, a lower sax.log2_hashmap_size, a lower sax.num_levels, one \
                          field for all phases (sax.static_data = \"pooled\")",
            }),
            _ => Ok(()),
        }
    }
}

/// Purpose of samples, which determines how many vectors of the Lineformer they need.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Passes {
    /// Forward pass alone.
    Drawing,
    /// Forward and backward pass.
    Fitting,
}

/// Creates the buffers for evaluating a field at a number of samples at once.
///
/// # Errors
/// [`Error::OutOfMemory`] naming the buffer.
pub fn sample_buffers(
    gpu: &Gpu,
    field: &SaxField,
    setup: &SaxSetup,
    n_samples: u32,
    passes: Passes,
) -> Result<SaxSampleBuffers> {
    let new = |name: Binding, bytes: u64| gpu.buffer(name.name(), bytes, Memory::Device);
    let operands = Tuning::for_device(gpu.info()).operands;
    let n = u64::from(n_samples);
    let n_vectors = if passes == Passes::Fitting { SAX_VECTORS } else { SAX_FORWARD_VECTORS };
    let bytes = vector_bytes(n_vectors, capacity(n_samples));
    let vectors = gpu.operand_buffer(Binding::sax_vectors.name(), bytes, operands)?;
    let encoding_bytes = 8 * u64::from(setup.n_levels) * n;
    Ok(SaxSampleBuffers {
        sax_setup: gpu.buffer_with("sax_setup", &[*setup])?,
        sax_levels: gpu.buffer_with("sax_levels", &field.shape.grid())?,
        state: gpu.buffer_with("state", &[DeviceState { step: field.step, ..DeviceState::default() }])?,
        sax_points: new(Binding::sax_points, 16 * n)?,
        sax_encoding: gpu.operand_buffer(Binding::sax_encoding.name(), encoding_bytes, operands)?,
        sax_sigma: new(Binding::sax_sigma, 4 * n)?,
        sax_vectors: vectors.clone(),
        sax_operands: vectors,
    })
}

/// Uploads the parameters of a field to the device.
///
/// # Errors
/// [`Error::OutOfMemory`] naming the buffer; other device errors.
pub fn params_buffer(gpu: &Gpu, name: &str, params: &[f32]) -> Result<Buffer> {
    let buffer = gpu.operand_buffer(name, 4 * params.len() as u64, Tuning::for_device(gpu.info()).operands)?;
    gpu.upload(&buffer, 0, params)?;
    Ok(buffer)
}

/// Creates the buffers of a fit.
///
/// # Errors
/// [`Error::OutOfMemory`] naming the buffer; other device errors.
pub fn fit_buffers(
    gpu: &Gpu,
    data: &SaxData,
    field: &SaxField,
    setup: &SaxSetup,
    config: &Config<SaxSettings>,
) -> Result<SaxFitBuffers> {
    let new = |name: Binding, bytes: u64| gpu.buffer(name.name(), bytes, Memory::Device);
    let [rays, samples, weights, grid] =
        [setup.n_rays, setup.n_rays * setup.n_samples, setup.n_weights, setup.n_grid].map(u64::from);
    let fit = SaxFitBuffers {
        setup: gpu.buffer_with("setup", &[adam_setup(field.shape)])?,
        schedule: gpu.buffer_with("schedule", &schedule(config))?,
        sax_turns: gpu.buffer_with("sax_turns", &data.turns().0)?,
        sax_views: gpu.buffer_with("sax_views", &data.views)?,
        sax_lists: gpu.buffer_with("sax_lists", &data.lists)?,
        sax_listed: gpu.buffer_with("sax_listed", &data.listed)?,
        sax_images: gpu.buffer_with("sax_images", &data.images)?,
        rays: new(Binding::rays, size_of::<Ray>() as u64 * rays)?,
        sax_ray_gradient: new(Binding::sax_ray_gradient, 4 * rays)?,
        sax_losses: new(Binding::sax_losses, 4 * rays * u64::from(setup.n_sets))?,
        sax_products: gpu.buffer_with("sax_products", &products(field.shape))?,
        sax_weight_parts: new(Binding::sax_weight_parts, 4 * weights * u64::from(setup.n_groups))?,
        sax_encoding_gradient: new(Binding::sax_encoding_gradient, 8 * u64::from(setup.n_levels) * samples)?,
        sax_grid_sums: new(Binding::sax_grid_sums, 8 * grid)?,
        gradient: new(Binding::gradient, 4 * (weights + grid))?,
        sax_ring: ring(gpu, "sax_ring")?,
    };
    let mut recording = Recording::new(gpu, "clear the grid's sums")?;
    recording.fill(&fit.sax_grid_sums, 0);
    gpu.wait(recording.finish()?.submit()?)?;
    Ok(fit)
}

/// Creates the buffers of the fields.
///
/// # Errors
/// [`Error::OutOfMemory`] naming the buffer; other device errors.
pub fn set_buffers(
    gpu: &Gpu,
    data: &SaxData,
    field: &SaxField,
    state: &SaxState,
    seed: u32,
) -> Result<Vec<SaxSetBuffers>> {
    let (_, first_turns) = data.turns();
    let set = |index: usize| {
        Ok(SaxSetBuffers {
            params: params_buffer(gpu, &format!("sax_params of {index}"), &field.params[index])?,
            moments: gpu.buffer_with(&format!("moments of {index}"), &state.moments[index])?,
            seed: seed_of_set(seed, index),
            turns: (first_turns[index], data.sets.images(index).len() as u32),
        })
    };
    (0..field.n_sets).map(set).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;
    use crate::methods::sax_nerf::field::SaxShape;
    use crate::methods::sax_nerf::setup::n_parts;

    /// Minimum buffer size that every device supports, bytes.
    const MIN_STORAGE_BUFFER: u64 = 128 << 20;

    #[test]
    fn the_published_field_fits_the_buffers_of_every_device() {
        let sax = Config::preset(Preset::SaxNerf).of::<crate::config::sections::SaxSettings>().unwrap().method.sax;
        let shape = SaxShape::of(&sax);
        let n_rays = sax.windows * sax.window * sax.window + sax.rays;
        let setup = SaxSetup {
            n_levels: sax.levels,
            n_samples: sax.samples,
            n_rays,
            n_sets: 10,
            n_weights: shape.n_weights() as u32,
            n_grid: shape.n_grid() as u32,
            n_groups: n_parts(n_rays, sax.samples),
            ..SaxSetup::default()
        };
        let memory = SaxMemory::of(&setup);
        assert!(memory.of_field_buffer < MIN_STORAGE_BUFFER && memory.of_batch_buffer < MIN_STORAGE_BUFFER);
        assert_eq!((memory.of_field_buffer / MIB, memory.of_batch_buffer / MIB, memory.total / MIB), (109, 100, 2041));
    }

    #[test]
    fn what_others_hold_may_be_given_back_and_what_is_not_there_may_not() {
        let fit = SaxMemory { of_field_buffer: MIB, of_batch_buffer: MIB, total: 100 * MIB };
        let check = |bytes, free: Option<u64>| {
            let memory = DeviceMemory { bytes: bytes * MIB, free: free.map(|free| free * MIB) };
            fit.check_total("a device", memory, 19, 10)
        };
        assert!(check(100, None).is_ok() && check(100, Some(100)).is_ok());
        let Err(Error::Config { problem, .. }) = check(99, Some(99)) else { panic!("there is too little") };
        assert!(problem.contains("10 fields need 100 MiB") && problem.contains("99 MiB, of which 99 MiB"), "{problem}");
        let short = check(8192, Some(99)).unwrap_err();
        assert!(matches!(short, Error::OutOfMemory { may_pass: true, .. }));
        let text = short.to_string();
        assert!(
            text.contains("8192 MiB, of which 99 MiB are currently free") && text.contains("sax.log2_hashmap_size"),
            "{text}"
        );
        assert!(!text.contains("train.rays"), "{text}");
    }
}
