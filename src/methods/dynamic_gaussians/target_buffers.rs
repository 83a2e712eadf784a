//! Targets of Gaussians on the device, and what is read back of a fit.

use crate::error::Result;
use crate::fitting::ring::ring;
use crate::gaussians::stages::TargetBuffers;
use crate::gpu::buffer::Memory;
use crate::gpu::device::Gpu;
use crate::gpu::record::Recording;
use crate::kernels::dispatch::Binding;
use crate::kernels::layout::{GaussianSchedule, GaussianSetup, GaussianView};
use crate::methods::dynamic_gaussians::remainder::{self, Bounds};
use crate::methods::dynamic_gaussians::targets::Targets;

/// Targets, schedule and counters of a fit that has not begun.
pub(super) fn target_buffers(
    gpu: &Gpu,
    targets: &Targets,
    setup: &GaussianSetup,
    schedule: &[GaussianSchedule],
) -> Result<TargetBuffers> {
    let views: Vec<GaussianView> = targets.views.iter().map(|v| v.to_device()).collect();
    let image_of_view: Vec<i32> = targets.image_of.iter().map(|image| image.map_or(-1, |i| i as i32)).collect();
    let n_values = u64::from(setup.n_images) * u64::from(setup.image_stride);
    let image = |name: Binding, values: &[f32]| gpu.buffer_with(name.name(), &padded(values, targets, setup));
    let new = |name: Binding, n: u64, memory: Memory| gpu.buffer(name.name(), 4 * n, memory);
    let buffers = TargetBuffers {
        gaussian_setup: gpu.buffer_with("gaussian_setup", &[*setup])?,
        gaussian_views: gpu.buffer_with("gaussian_views", &views)?,
        image_of_view: gpu.buffer_with("image_of_view", &image_of_view)?,
        bound_low: image(Binding::bound_low, &targets.low)?,
        bound_high: image(Binding::bound_high, &targets.high)?,
        pixel_weight: image(Binding::pixel_weight, &targets.weight)?,
        gaussian_schedule: gpu.buffer_with("gaussian_schedule", schedule)?,
        splat_images: new(Binding::splat_images, n_values, Memory::Device)?,
        splat_image_gradient: new(Binding::splat_image_gradient, n_values, Memory::Device)?,
        gaussian_loss_parts: new(Binding::gaussian_loss_parts, setup.n_loss_parts.into(), Memory::Device)?,
        gaussian_step: gpu.buffer_with("gaussian_step", &[0u32])?,
        gaussian_ring: ring(gpu, "gaussian_ring")?,
    };
    clear_images(gpu, &buffers)?;
    Ok(buffers)
}

/// Computes bounds from the background that the field's `images` leave, on the host and on the device.
pub(super) fn renew_bounds(
    gpu: &Gpu,
    targets: &mut Targets,
    buffers: &TargetBuffers,
    setup: &GaussianSetup,
    images: &[f32],
) -> Result<()> {
    // Bounds of large images take hundreds of megabytes: they are replaced in place.
    let before = Bounds { low: std::mem::take(&mut targets.low), high: std::mem::take(&mut targets.high) };
    let Bounds { low, high } = remainder::bounds(targets, images, before);
    (targets.low, targets.high) = (low, high);
    gpu.upload(&buffers.bound_low, 0, &padded(&targets.low, targets, setup))?;
    Ok(gpu.upload(&buffers.bound_high, 0, &padded(&targets.high, targets, setup))?)
}

/// Images, each padded with zeros up to the stride.
pub(super) fn padded(values: &[f32], targets: &Targets, setup: &GaussianSetup) -> Vec<f32> {
    let fill = vec![0.0; setup.image_stride as usize - targets.n_pixels()];
    values.chunks(targets.n_pixels()).flat_map(|image| image.iter().chain(&fill)).copied().collect()
}

fn clear_images(gpu: &Gpu, buffers: &TargetBuffers) -> Result<()> {
    let mut recording = Recording::new(gpu, "clear images")?;
    recording.fill(&buffers.splat_images, 0);
    Ok(gpu.wait(recording.finish()?.submit()?)?)
}

/// Reads the images just recorded, `[image][pixel]`, and clears them.
pub(super) fn take_images(
    gpu: &Gpu,
    buffers: &TargetBuffers,
    targets: &Targets,
    setup: &GaussianSetup,
) -> Result<Vec<f32>> {
    let stride = setup.image_stride as usize;
    let sums: Vec<i32> = gpu.download(&buffers.splat_images, 0, targets.n_images * stride)?;
    clear_images(gpu, buffers)?;
    let pixels = sums.chunks(stride).flat_map(|image| &image[..targets.n_pixels()]);
    Ok(pixels.map(|v| *v as f32 / setup.fixed_point).collect())
}
