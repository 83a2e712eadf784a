//! Targets of Gaussians on the device, and what is read back of a fit. Where all images are more than one buffer of the device holds, they
//! are divided into parts of a few phases, which the stages work through one after the other.

use crate::error::Result;
use crate::fitting::ring::ring;
use crate::gaussians::stages::{TargetBuffers, loss_parts};
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::gpu::record::Recording;
use crate::kernels::dispatch::Binding;
use crate::kernels::layout::{GaussianSchedule, GaussianSetup, GaussianView};
use crate::methods::dynamic_gaussians::remainder::{self, Bounds};
use crate::methods::dynamic_gaussians::targets::Targets;
use std::borrow::Cow;
use std::ops::Range;

/// Images of some phases on the device.
pub(super) struct TargetPart {
    /// The phases.
    pub phases: Range<u32>,
    /// Their images, as indices over all images.
    pub images: Range<usize>,
    /// Their buffers, in which images are counted from the first one of the part.
    pub buffers: TargetBuffers,
}

impl TargetPart {
    /// Makes the part of all phases.
    pub(super) fn all(targets: &Targets, buffers: TargetBuffers) -> TargetPart {
        TargetPart { phases: 0..targets.n_phases as u32, images: 0..targets.n_images, buffers }
    }
}

/// Use of the bounds after they have been renewed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Renewal {
    /// Bounds are renewed again later, or the fit is carried over to other images.
    OneOfSeveral,
    /// Only the device needs the bounds from now on.
    Last,
}

/// Makes targets, schedule and counters of a fit that has not begun, for stages that work on all images at once.
pub(super) fn undivided_targets(
    gpu: &Gpu,
    targets: &Targets,
    setup: &GaussianSetup,
    schedule: &[GaussianSchedule],
) -> Result<TargetPart> {
    let shared = shared_buffers(gpu, targets, setup, schedule, targets.n_images)?;
    let all = (0..targets.n_phases as u32, 0..targets.n_images);
    make_part(gpu, targets, setup, (&shared, None), all)
}

/// Makes the same as [`undivided_targets`] in parts, where the device asks for it: buffers of the whole fit, and the parts of its images.
/// The constants in `setup` become those of the parts. With several parts, the buffers of the whole fit have no images.
pub(super) fn divided_targets(
    gpu: &Gpu,
    targets: &Targets,
    setup: &mut GaussianSetup,
    schedule: &[GaussianSchedule],
) -> Result<(TargetBuffers, Vec<TargetPart>)> {
    let most = gpu.info().max_storage_buffer_range / (size_of::<f32>() as u32 * setup.image_stride);
    let runs = runs(targets, most as usize);
    if runs.len() < 2 {
        let part = undivided_targets(gpu, targets, setup, schedule)?;
        return Ok((part.buffers.clone(), vec![part]));
    }
    setup.n_loss_parts = runs.iter().map(|(_, images)| n_loss_parts(images, setup)).sum();
    let longest = runs.iter().map(|(_, images)| images.len()).max().unwrap_or(0);
    let shared = shared_buffers(gpu, targets, setup, schedule, longest)?;
    let mut parts: Vec<TargetPart> = Vec::new();
    for run in runs {
        // Weights of a view are equal at all phases, so that parts whose images show the same views share them.
        let slots = |images: &Range<usize>| &targets.weight.slots()[images.clone()];
        let alike = parts.iter().find(|part| slots(&part.images).starts_with(slots(&run.1)));
        let weight = alike.map(|part| part.buffers.pixel_weight.clone());
        parts.push(make_part(gpu, targets, setup, (&shared, weight), run)?);
    }
    Ok((shared, parts))
}

/// Divides the phases into runs with at most `most` images; a phase with more images is a run of its own. Returns phases and images of
/// each run.
fn runs(targets: &Targets, most: usize) -> Vec<(Range<u32>, Range<usize>)> {
    let mut runs: Vec<(Range<u32>, Range<usize>)> = Vec::new();
    let mut first = 0;
    for phase in 0..targets.n_phases {
        let (end, after) = (first + targets.views_at(phase).count(), phase as u32 + 1);
        match runs.last_mut() {
            Some((phases, images)) if end - images.start <= most => (phases.end, images.end) = (after, end),
            _ => runs.push((phase as u32..after, first..end)),
        }
        first = end;
    }
    runs
}

/// Returns the number of partial sums of the loss of some images.
pub(super) fn n_loss_parts(images: &Range<usize>, setup: &GaussianSetup) -> u32 {
    loss_parts(images.len() as u32 * setup.image_stride / 4)
}

/// Makes what all parts share; images that are drawn into have room for the `longest` part. Bounds and weights have no content.
fn shared_buffers(
    gpu: &Gpu,
    targets: &Targets,
    setup: &GaussianSetup,
    schedule: &[GaussianSchedule],
    longest: usize,
) -> Result<TargetBuffers> {
    let n_values = longest as u64 * u64::from(setup.image_stride);
    let new = |name: Binding, n: u64| gpu.buffer(name.name(), 4 * n, Memory::Device);
    let of_parts = gpu.buffer("images of the parts", 4, Memory::Device)?;
    let shared = TargetBuffers {
        gaussian_setup: gpu.buffer_with("gaussian_setup", &[*setup])?,
        gaussian_views: views(gpu, targets, &(0..targets.n_images))?,
        image_of_view: image_of_view(gpu, targets, &(0..targets.n_images))?,
        bound_low: of_parts.clone(),
        bound_high: of_parts.clone(),
        pixel_weight: of_parts,
        gaussian_schedule: gpu.buffer_with("gaussian_schedule", schedule)?,
        splat_images: new(Binding::splat_images, n_values)?,
        splat_image_gradient: new(Binding::splat_image_gradient, n_values)?,
        gaussian_loss_parts: new(Binding::gaussian_loss_parts, setup.n_loss_parts.into())?,
        gaussian_step: gpu.buffer_with("gaussian_step", &[0u32])?,
        gaussian_ring: ring(gpu, "gaussian_ring")?,
    };
    clear_images(gpu, &shared)?;
    Ok(shared)
}

/// Makes a part from what all parts share, and from the weights of a part with the same ones, if there is one.
fn make_part(
    gpu: &Gpu,
    targets: &Targets,
    setup: &GaussianSetup,
    (shared, weight): (&TargetBuffers, Option<Buffer>),
    (phases, images): (Range<u32>, Range<usize>),
) -> Result<TargetPart> {
    let pixels = images.start * targets.n_pixels()..images.end * targets.n_pixels();
    let image =
        |name: Binding, values: &[f32]| gpu.buffer_with(name.name(), &padded(values, targets.n_pixels(), setup));
    // Lower bounds that are renewed before the first iteration are not kept.
    let low = match targets.low.is_empty() {
        true => gpu.buffer(Binding::bound_low.name(), n_bytes(&images, setup), Memory::Device)?,
        false => image(Binding::bound_low, &targets.low[pixels.clone()])?,
    };
    let weight = match weight {
        Some(weight) => weight,
        None => {
            let weights: Vec<f32> = images.clone().flat_map(|image| targets.weight.image(image)).copied().collect();
            image(Binding::pixel_weight, &weights)?
        }
    };
    let n_parts = u64::from(n_loss_parts(&images, setup));
    let is_whole = images.len() == targets.n_images;
    let buffers = TargetBuffers {
        gaussian_views: views(gpu, targets, &images)?,
        image_of_view: image_of_view(gpu, targets, &images)?,
        bound_low: low,
        bound_high: image(Binding::bound_high, &targets.high[pixels])?,
        pixel_weight: weight,
        gaussian_loss_parts: match is_whole {
            true => shared.gaussian_loss_parts.clone(),
            false => gpu.buffer(Binding::gaussian_loss_parts.name(), 4 * n_parts, Memory::Device)?,
        },
        ..shared.clone()
    };
    Ok(TargetPart { phases, images, buffers })
}

/// Returns the size of a buffer of images, bytes.
fn n_bytes(images: &Range<usize>, setup: &GaussianSetup) -> u64 {
    (images.len() * setup.image_stride as usize * size_of::<f32>()) as u64
}

fn views(gpu: &Gpu, targets: &Targets, images: &Range<usize>) -> Result<Buffer> {
    let views: Vec<GaussianView> = targets.views[images.clone()].iter().map(|v| v.to_device()).collect();
    Ok(gpu.buffer_with("gaussian_views", &views)?)
}

/// Makes the table of the images of each phase and view: indices from the first of `images` on, -1 for others.
fn image_of_view(gpu: &Gpu, targets: &Targets, images: &Range<usize>) -> Result<Buffer> {
    let index = |image: &Option<usize>| match image {
        Some(image) if images.contains(image) => (image - images.start) as i32,
        _ => -1,
    };
    let table: Vec<i32> = targets.image_of.iter().map(index).collect();
    Ok(gpu.buffer_with("image_of_view", &table)?)
}

/// Computes bounds from the background that the field's `images` leave, on the host and on the device. After the last renewal, the host has
/// none.
pub(super) fn renew_bounds(
    gpu: &Gpu,
    targets: &mut Targets,
    parts: &[TargetPart],
    setup: &GaussianSetup,
    images: &[f32],
    renewal: Renewal,
) -> Result<()> {
    let n = targets.n_pixels();
    let upload = |buffer: &Buffer, first: usize, images: &[f32]| {
        let offset = first * setup.image_stride as usize * size_of::<f32>();
        gpu.upload(buffer, offset as u64, &padded(images, n, setup))
    };
    if renewal == Renewal::Last {
        // Bounds of large images take hundreds of megabytes: none are kept.
        for Bounds { image, low, high } in remainder::bounds(targets, images) {
            for part in parts.iter().filter(|part| part.images.contains(&image)) {
                upload(&part.buffers.bound_low, image - part.images.start, &low)?;
                upload(&part.buffers.bound_high, image - part.images.start, &high)?;
            }
        }
        (targets.low, targets.high) = (Vec::new(), Vec::new());
        return Ok(());
    }
    if targets.max.is_none() {
        targets.max = Some(targets.high.clone());
    }
    let (mut low, mut high) = (std::mem::take(&mut targets.low), std::mem::take(&mut targets.high));
    for bounds in remainder::bounds(targets, images) {
        low[bounds.image * n..][..n].copy_from_slice(&bounds.low);
        high[bounds.image * n..][..n].copy_from_slice(&bounds.high);
    }
    for part in parts {
        let pixels = part.images.start * n..part.images.end * n;
        upload(&part.buffers.bound_low, 0, &low[pixels.clone()])?;
        upload(&part.buffers.bound_high, 0, &high[pixels])?;
    }
    (targets.low, targets.high) = (low, high);
    Ok(())
}

/// Returns images, each padded with zeros up to the stride.
pub(super) fn padded<'a>(values: &'a [f32], n_pixels: usize, setup: &GaussianSetup) -> Cow<'a, [f32]> {
    let fill = vec![0.0; setup.image_stride as usize - n_pixels];
    if fill.is_empty() {
        return Cow::Borrowed(values);
    }
    values.chunks(n_pixels).flat_map(|image| image.iter().chain(&fill)).copied().collect()
}

fn clear_images(gpu: &Gpu, buffers: &TargetBuffers) -> Result<()> {
    let mut recording = Recording::new(gpu, "clear images")?;
    recording.fill(&buffers.splat_images, 0);
    Ok(gpu.wait(recording.finish()?.submit()?)?)
}

/// Reads the images of a part that were just recorded, `[image][pixel]`, appends them to `images`, and clears them.
pub(super) fn take_images(
    gpu: &Gpu,
    part: &TargetPart,
    targets: &Targets,
    setup: &GaussianSetup,
    images: &mut Vec<f32>,
) -> Result<()> {
    let stride = setup.image_stride as usize;
    let sums: Vec<i32> = gpu.download(&part.buffers.splat_images, 0, part.images.len() * stride)?;
    clear_images(gpu, &part.buffers)?;
    let pixels = sums.chunks(stride).flat_map(|image| &image[..targets.n_pixels()]);
    images.extend(pixels.map(|v| *v as f32 / setup.fixed_point));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::dynamic_gaussians::targets::test_targets::{PHASES, SIDE, targets};

    #[test]
    fn phases_are_divided_into_runs_of_few_images() {
        let mut targets = targets(&vec![0.0; PHASES * 3 * SIDE * SIDE], 3);
        let images = |targets: &Targets, most| runs(targets, most).into_iter().map(|run| run.1).collect::<Vec<_>>();
        assert_eq!(images(&targets, 30), vec![Range { start: 0, end: 30 }]);
        assert_eq!(images(&targets, 13), [0..12, 12..24, 24..30]);
        assert_eq!(runs(&targets, 13)[1].0, 4..8);
        assert_eq!(images(&targets, 2).len(), PHASES, "a phase is not divided");
        // A view lacks the second phase.
        targets.image_of[4] = None;
        targets.image_of.iter_mut().skip(5).flatten().for_each(|image| *image -= 1);
        targets.n_images -= 1;
        assert_eq!(images(&targets, 6), [0..5, 5..11, 11..17, 17..23, 23..29]);
    }
}
