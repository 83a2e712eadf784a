//! The stages of a step on the device, their buffers, and one iteration, top to bottom.

use super::layout::{Gaussian, GaussianSchedule, GaussianSetup, GaussianView};
use super::scene::Scene;
use super::settings::Settings;
use crate::error::Result;
use crate::gpu::device::Gpu;
use crate::gpu::memory::Memory;
use crate::gpu::pipeline::Pipeline;
use crate::gpu::record::{Groups, Recording};
use crate::kernels::{Buffers, dispatch, groups_for, kernel_code};
use std::ops::Range;
use std::sync::Arc;

/// Invocations of a workgroup.
pub(super) const LANES: u32 = 64;
/// Losses kept on the device.
pub const RING_LENGTH: u32 = 1024;
/// Bits behind the point of the integer sums: images hold up to 2048 times the strongest change, in steps of 1e-6.
const FIXED_POINT_BITS: i32 = 20;
/// vec4 of a Gaussian.
const ROWS: u64 = 3;
/// Adam's decay of the first and second moment, and its guard.
const BETAS: [f32; 2] = [0.9, 0.98];
const EPSILON: f32 = 1e-12;

/// Pipelines of a training step.
pub struct GaussianKernels {
    project: Arc<Pipeline>,
    splat: Arc<Pipeline>,
    residual: Arc<Pipeline>,
    moments: Arc<Pipeline>,
    update: Arc<Pipeline>,
    report: Arc<Pipeline>,
}

impl GaussianKernels {
    /// Builds the pipelines.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu) -> Result<GaussianKernels> {
        let make = |name: &str| gpu.pipeline(kernel_code(name)?, LANES, &[]).map(Arc::new);
        Ok(GaussianKernels {
            project: make("gaussian_project")?,
            splat: make("gaussian_splat")?,
            residual: make("gaussian_residual")?,
            moments: make("gaussian_moments")?,
            update: make("gaussian_update")?,
            report: make("gaussian_report")?,
        })
    }
}

/// Constants of a run.
pub fn setup(scene: &Scene, settings: &Settings) -> GaussianSetup {
    let mut setup = GaussianSetup {
        n_views: scene.views.len() as u32,
        n_phases: scene.n_phases as u32,
        width: scene.width as u32,
        height: scene.height as u32,
        cut: settings.cut as f32,
        least_scale: settings.least_scale as f32,
        greatest_scale: settings.greatest_scale as f32,
        fixed_point: 2f32.powi(FIXED_POINT_BITS),
        bend: settings.bend as f32,
        loss_weight: 1.0 / scene.phases_seen().max(1) as f32,
        beta1: BETAS[0],
        beta2: BETAS[1],
        epsilon: EPSILON,
        position_rate: settings.position_rate as f32,
        scale_rate: settings.scale_rate as f32,
        rotation_rate: settings.rotation_rate as f32,
        density_rate: settings.density_rate as f32,
        ring_length: RING_LENGTH,
        n_images: scene.n_images as u32,
        image_stride: (scene.n_pixels() as u32).next_multiple_of(4),
        n_loss_parts: 0,
        blur: 0.0,
    };
    setup.n_loss_parts = loss_parts(pixel_quads(&setup));
    setup
}

/// One row per iteration.
pub fn schedule(settings: &Settings) -> Vec<GaussianSchedule> {
    let bias = |beta: f32, updates: u32| (1.0 - f64::from(beta).powi(updates as i32)) as f32;
    let row = |step: u32| GaussianSchedule {
        rate: settings.rate(step) as f32,
        bias1: bias(BETAS[0], step + 1),
        bias2: bias(BETAS[1], step + 1),
        spare: 0.0,
    };
    (0..settings.iterations.max(1)).map(row).collect()
}

/// Partial sums of the loss of so many groups of four pixels.
pub(super) fn loss_parts(n_quads: u32) -> u32 {
    n_quads.div_ceil(LANES)
}

/// Groups of four pixels of all images.
fn pixel_quads(setup: &GaussianSetup) -> u32 {
    setup.n_images * setup.image_stride / 4
}

/// Images of `n_pixels`, each filled up to `stride` numbers with zeros, which residuals of nothing are.
pub(super) fn padded(values: &[f32], n_pixels: usize, stride: usize) -> Vec<f32> {
    let fill = vec![0.0; stride - n_pixels];
    values.chunks(n_pixels).flat_map(|image| image.iter().chain(&fill)).copied().collect()
}

/// Buffers that do not depend on the Gaussians' number, filled.
///
/// # Errors
/// [`crate::error::Error::OutOfMemory`] naming the buffer.
pub fn scene_buffers(gpu: &Gpu, scene: &Scene, setup: &GaussianSetup, settings: &Settings) -> Result<Buffers> {
    let mut buffers = Buffers::default();
    let views: Vec<GaussianView> = scene.views.iter().map(|v| v.to_device()).collect();
    let image_of: Vec<i32> = scene.image_of.iter().map(|image| image.map_or(-1, |i| i as i32)).collect();
    let quads = u64::from(pixel_quads(setup));
    let padded = |values: &[f32]| padded(values, scene.n_pixels(), setup.image_stride as usize);
    buffers.set("setup", gpu.buffer_with("gaussian setup", &[*setup])?);
    buffers.set("gaussian_views", gpu.buffer_with("gaussian views", &views)?);
    buffers.set("image_of", gpu.buffer_with("image of", &image_of)?);
    buffers.set("bound_low", gpu.buffer_with("bound low", &padded(&scene.low))?);
    buffers.set("bound_high", gpu.buffer_with("bound high", &padded(&scene.high))?);
    buffers.set("pixel_weight", gpu.buffer_with("pixel weight", &padded(&scene.weight))?);
    buffers.set("gaussian_schedule", gpu.buffer_with("gaussian schedule", &schedule(settings))?);
    buffers.set("images", gpu.buffer_with("gaussian images", &vec![0u32; 4 * quads as usize])?);
    buffers.set("image_gradient", gpu.buffer("image gradient", 16 * quads, Memory::Device)?);
    buffers.set("loss_parts", gpu.buffer("loss parts", 4 * u64::from(setup.n_loss_parts), Memory::Device)?);
    buffers.set("state", gpu.buffer_with("gaussian state", &[0u32; 4])?);
    buffers.set("gaussian_ring", gpu.buffer("gaussian ring", 4 * u64::from(RING_LENGTH), Memory::Readback)?);
    Ok(buffers)
}

/// Gaussians with Adam's moments: what grows and shrinks together.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Particles {
    /// Parameters.
    pub rows: Vec<Gaussian>,
    /// First moments, laid out as the parameters.
    pub first: Vec<[f32; 12]>,
    /// Second moments.
    pub second: Vec<[f32; 12]>,
}

impl Particles {
    /// Gaussians that were never updated.
    pub fn fresh(rows: Vec<Gaussian>) -> Particles {
        let zeros = vec![[0.0; 12]; rows.len()];
        Particles { rows, first: zeros.clone(), second: zeros }
    }

    /// Keeps those for which `keep` holds.
    pub fn retain(&mut self, keep: impl Fn(&Gaussian) -> bool) {
        let mask: Vec<bool> = self.rows.iter().map(keep).collect();
        let mut at = mask.iter();
        self.rows.retain(|_| at.next() == Some(&true));
        for moments in [&mut self.first, &mut self.second] {
            let mut at = mask.iter();
            moments.retain(|_| at.next() == Some(&true));
        }
    }

    /// Adds Gaussians that were never updated.
    pub fn append(&mut self, rows: Vec<Gaussian>) {
        let fresh = Particles::fresh(rows);
        self.rows.extend(fresh.rows);
        self.first.extend(fresh.first);
        self.second.extend(fresh.second);
    }

    /// Puts them on the device, with room for what a step computes of them.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub fn upload(&self, gpu: &Gpu, setup: &GaussianSetup, buffers: &mut Buffers) -> Result<()> {
        let n = self.rows.len() as u64;
        let splats = n * u64::from(setup.n_views);
        buffers.set("gaussians", gpu.buffer_with("gaussians", &self.rows)?);
        buffers.set("adam_first", gpu.buffer_with("adam first", &self.first)?);
        buffers.set("adam_second", gpu.buffer_with("adam second", &self.second)?);
        buffers.set("gradient", gpu.buffer("gaussian gradient", 16 * ROWS * n, Memory::Device)?);
        buffers.set("splats", gpu.buffer("splats", 32 * splats, Memory::Device)?);
        buffers.set("splat_image", gpu.buffer("splat image", 4 * splats, Memory::Device)?);
        buffers.set("moments", gpu.buffer("gaussian moments", 32 * splats, Memory::Device)?);
        Ok(())
    }

    /// Reads `n` of them back.
    ///
    /// # Errors
    /// Device errors.
    pub fn download(gpu: &Gpu, n: usize, buffers: &Buffers) -> Result<Particles> {
        Ok(Particles {
            rows: gpu.download(buffers.get("gaussians")?, 0, n)?,
            first: gpu.download(buffers.get("adam_first")?, 0, n)?,
            second: gpu.download(buffers.get("adam_second")?, 0, n)?,
        })
    }
}

/// Records the images of `n` Gaussians, each of one phase, into `images`, which must be clear.
///
/// # Errors
/// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
pub fn record_images(
    r: &mut Recording,
    k: &GaussianKernels,
    buffers: &Buffers,
    setup: &GaussianSetup,
    n: u32,
) -> Result<()> {
    let groups = Groups::Direct([n.div_ceil(LANES), setup.n_views, 1]);
    dispatch(r, &k.project, groups, buffers, &[], [n])?;
    record_splats(r, k, buffers, &[], n * setup.n_views)
}

/// Reads the images just recorded, `[image][pixel]`, and clears them.
///
/// # Errors
/// Device errors.
pub fn take_images(gpu: &Gpu, buffers: &Buffers, scene: &Scene, setup: &GaussianSetup) -> Result<Vec<f32>> {
    let (images, stride) = (buffers.get("images")?, setup.image_stride as usize);
    let sums: Vec<i32> = gpu.download(images, 0, scene.n_images * stride)?;
    let mut recording = Recording::new(gpu, "clear images")?;
    recording.fill(images, 0);
    gpu.wait(recording.finish()?.submit()?)?;
    let pixels = sums.chunks(stride).flat_map(|image| &image[..scene.n_pixels()]);
    Ok(pixels.map(|v| *v as f32 / setup.fixed_point).collect())
}

/// Records splats that are projected already into `images`.
pub(super) fn record_splats(
    r: &mut Recording,
    k: &GaussianKernels,
    buffers: &Buffers,
    renamed: &[(&str, &str)],
    n_splats: u32,
) -> Result<()> {
    dispatch(r, &k.splat, groups_for(&k.splat, n_splats), buffers, renamed, [n_splats])
}

/// Records the residuals of some images, and the moments of all splats.
pub(super) fn record_residual(
    r: &mut Recording,
    k: &GaussianKernels,
    buffers: &Buffers,
    renamed: &[(&str, &str)],
    setup: &GaussianSetup,
    images: Range<u32>,
    n_splats: u32,
) -> Result<()> {
    let [first, n_quads] = [images.start, images.len() as u32].map(|n| n * setup.image_stride / 4);
    dispatch(r, &k.residual, groups_for(&k.residual, n_quads), buffers, renamed, [first, n_quads])?;
    dispatch(r, &k.moments, groups_for(&k.moments, n_splats), buffers, renamed, [n_splats])
}

/// Records the end of an iteration: its loss, and the count.
pub(super) fn record_report(
    r: &mut Recording,
    k: &GaussianKernels,
    buffers: &Buffers,
    renamed: &[(&str, &str)],
) -> Result<()> {
    dispatch(r, &k.report, Groups::Direct([1, 1, 1]), buffers, renamed, ())
}

/// Records one iteration on `n` Gaussians, each of one phase.
///
/// # Errors
/// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
pub fn record_step(
    r: &mut Recording,
    k: &GaussianKernels,
    buffers: &Buffers,
    setup: &GaussianSetup,
    n: u32,
) -> Result<()> {
    record_images(r, k, buffers, setup, n)?;
    record_residual(r, k, buffers, &[], setup, 0..setup.n_images, n * setup.n_views)?;
    dispatch(r, &k.update, groups_for(&k.update, n), buffers, &[], [n])?;
    record_report(r, k, buffers, &[])
}
