//! The tree's stages on the device: an iteration over all phases, and one that tracks the grid at a single phase.

use super::super::layout::{GaussianSchedule, GaussianSetup};
use super::super::scene::Scene;
use super::super::settings::Settings;
use super::super::stages::{self, GaussianKernels, Particles};
use super::super::stages::{LANES, record_report, record_residual, record_splats};
use super::layout::TreeSetup;
use super::model::basis;
use super::settings::TreeSettings;
use crate::data::images::Image;
use crate::error::Result;
use crate::gpu::device::Gpu;
use crate::gpu::memory::Memory;
use crate::gpu::pipeline::Pipeline;
use crate::gpu::record::{Groups, Recording};
use crate::kernels::{Buffers, dispatch, groups_for, kernel_code};
use crate::soft_hull::background::blur;
use std::ops::Range;
use std::sync::Arc;

/// Adam's decay while the grid is tracked: little memory, for few iterations.
const TRACK_BETAS: [f32; 2] = [0.8, 0.95];
/// What the rate falls to, linearly, over the iterations of a tracked phase.
const TRACK_LAST_RATE: f64 = 0.2;
/// The grid reaches this far beyond the hull, pixels.
const MARGIN: f64 = 2.0;

/// Pipelines of the tree, beside those of [`GaussianKernels`].
pub struct TreeKernels {
    pub(super) common: GaussianKernels,
    project: Arc<Pipeline>,
    gradient: Arc<Pipeline>,
    update: Arc<Pipeline>,
    grid_gradient: Arc<Pipeline>,
    grid_update: Arc<Pipeline>,
    guess: Arc<Pipeline>,
}

impl TreeKernels {
    /// Builds the pipelines.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu) -> Result<TreeKernels> {
        let make = |name: &str| gpu.pipeline(kernel_code(name)?, LANES, &[]).map(Arc::new);
        Ok(TreeKernels {
            common: GaussianKernels::new(gpu)?,
            project: make("tree_project")?,
            gradient: make("tree_gradient")?,
            update: make("tree_update")?,
            grid_gradient: make("tree_grid_gradient")?,
            grid_update: make("tree_grid_update")?,
            guess: make("tree_guess")?,
        })
    }
}

/// A grid around the hull.
pub fn setup(scene: &Scene, settings: &TreeSettings) -> TreeSetup {
    let reach = scene.places.iter().flatten().map(|p| p.position.abs().max_element()).fold(0.0, f64::max);
    let half_side = reach + MARGIN;
    let n_nodes = (2.0 * half_side / settings.node).ceil() as u32 + 1;
    // More harmonics than half the phases cannot be told apart.
    let harmonics = settings.harmonics.min((scene.n_phases as u32 - 1) / 2);
    TreeSetup {
        n_nodes,
        half_side: half_side as f32,
        inverse_step: (f64::from(n_nodes - 1) / (2.0 * half_side)) as f32,
        n_basis: 2 * harmonics,
        smoothness: (settings.smoothness / scene.n_phases as f64) as f32,
        own_penalty: settings.own_penalty as f32,
        grid_rate: settings.grid_rate as f32,
        own_rate: settings.own_rate as f32,
    }
}

/// Names the tracking iterations have buffers of their own under.
pub(super) const TRACKED: [(&str, &str); 7] = [
    ("setup", "track_setup"),
    ("tree", "track_tree"),
    ("bound_low", "track_low"),
    ("bound_high", "track_high"),
    ("gaussian_schedule", "track_schedule"),
    ("state", "track_state"),
    ("gaussian_ring", "track_ring"),
];

/// Buffers that do not depend on the number of Gaussians, the grid at rest.
///
/// # Errors
/// [`crate::error::Error::OutOfMemory`] naming the buffer.
pub fn scene_buffers(
    gpu: &Gpu,
    scene: &Scene,
    setup: &GaussianSetup,
    tree: &TreeSetup,
    settings: (&Settings, &TreeSettings),
) -> Result<Buffers> {
    let (settings, of_tree) = settings;
    let mut buffers = stages::scene_buffers(gpu, scene, setup, settings)?;
    let basis: Vec<f32> = (0..scene.n_phases)
        .flat_map(|t| basis(tree.n_basis as usize, t as f64 / scene.n_phases as f64))
        .map(|v| v as f32)
        .collect();
    let nodes = vec![[0f32; 4]; scene.n_phases * tree.nodes()];
    buffers.set("tree", gpu.buffer_with("tree setup", &[*tree])?);
    buffers.set("basis", gpu.buffer_with("basis", &basis)?);
    buffers.set("grid", gpu.buffer_with("grid", &nodes)?);
    buffers.set("grid_first", gpu.buffer_with("grid first", &nodes)?);
    buffers.set("grid_second", gpu.buffer_with("grid second", &nodes)?);
    buffers.set("grid_gradient", gpu.buffer_with("grid gradient", &nodes)?);
    track_buffers(gpu, scene, setup, tree, of_tree, &mut buffers)?;
    Ok(buffers)
}

/// What tracking needs: blurred bounds, its own constants and schedule.
fn track_buffers(
    gpu: &Gpu,
    scene: &Scene,
    setup: &GaussianSetup,
    tree: &TreeSetup,
    settings: &TreeSettings,
    buffers: &mut Buffers,
) -> Result<()> {
    // A phase is fitted at a time.
    let track = GaussianSetup {
        blur: settings.track_blur as f32,
        loss_weight: 1.0,
        beta1: TRACK_BETAS[0],
        beta2: TRACK_BETAS[1],
        n_loss_parts: stages::loss_parts(scene.views.len() as u32 * setup.image_stride / 4),
        ..*setup
    };
    let blurred = |values: &[f32]| -> Vec<f32> {
        let images = values.chunks(scene.n_pixels()).flat_map(|image| {
            let image = Image { width: scene.width, height: scene.height, values: image.to_vec() };
            blur(&image, settings.track_blur as f32).values
        });
        stages::padded(&images.collect::<Vec<_>>(), scene.n_pixels(), setup.image_stride as usize)
    };
    let n = settings.track_iterations.max(1);
    let row = |step: u32| GaussianSchedule {
        rate: (1.0 - (1.0 - TRACK_LAST_RATE) * f64::from(step) / f64::from(n)) as f32,
        bias1: 1.0 - TRACK_BETAS[0].powi(step as i32 + 1),
        bias2: 1.0 - TRACK_BETAS[1].powi(step as i32 + 1),
        spare: 0.0,
    };
    let tree = TreeSetup { grid_rate: settings.track_rate as f32, ..*tree };
    buffers.set("track_setup", gpu.buffer_with("track setup", &[track])?);
    buffers.set("track_tree", gpu.buffer_with("track tree", &[tree])?);
    buffers.set("track_low", gpu.buffer_with("track low", &blurred(&scene.low))?);
    buffers.set("track_high", gpu.buffer_with("track high", &blurred(&scene.high))?);
    buffers.set("track_schedule", gpu.buffer_with("track schedule", &(0..n).map(row).collect::<Vec<_>>())?);
    buffers.set("track_state", gpu.buffer_with("track state", &[0u32; 4])?);
    buffers.set("track_ring", gpu.buffer("track ring", 4 * u64::from(stages::RING_LENGTH), Memory::Readback)?);
    Ok(())
}

/// Own motion with Adam's moments: `[Gaussian][basis function]`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct OwnMotion {
    /// Amplitudes.
    pub amplitudes: Vec<[f32; 4]>,
    /// First moments.
    pub first: Vec<[f32; 4]>,
    /// Second moments.
    pub second: Vec<[f32; 4]>,
}

impl OwnMotion {
    /// No motion of `n` numbers.
    pub fn none(n: usize) -> OwnMotion {
        let zeros = vec![[0.0; 4]; n];
        OwnMotion { amplitudes: zeros.clone(), first: zeros.clone(), second: zeros }
    }

    /// Puts it on the device with the Gaussians it belongs to.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub fn upload(&self, gpu: &Gpu, particles: &Particles, setup: &GaussianSetup, buffers: &mut Buffers) -> Result<()> {
        let at_all_phases = GaussianSetup { n_views: setup.n_views * setup.n_phases, ..*setup };
        particles.upload(gpu, &at_all_phases, buffers)?;
        let places = 16 * particles.rows.len() as u64 * u64::from(setup.n_phases);
        buffers.set("own_motion", gpu.buffer_with("own motion", &self.amplitudes)?);
        buffers.set("own_first", gpu.buffer_with("own first", &self.first)?);
        buffers.set("own_second", gpu.buffer_with("own second", &self.second)?);
        buffers.set("place_gradient", gpu.buffer("place gradient", places, Memory::Device)?);
        Ok(())
    }

    /// Reads `n` numbers back.
    ///
    /// # Errors
    /// Device errors.
    pub fn download(gpu: &Gpu, n: usize, buffers: &Buffers) -> Result<OwnMotion> {
        Ok(OwnMotion {
            amplitudes: gpu.download(buffers.get("own_motion")?, 0, n)?,
            first: gpu.download(buffers.get("own_first")?, 0, n)?,
            second: gpu.download(buffers.get("own_second")?, 0, n)?,
        })
    }
}

/// A tree on the device: sizes of its dispatches.
#[derive(Debug, Clone, Copy)]
pub struct Sizes {
    /// Gaussians.
    pub n: u32,
    /// Their constants.
    pub setup: GaussianSetup,
    /// The grid's.
    pub tree: TreeSetup,
}

/// Records the images of some phases into `images`, which must be clear.
///
/// # Errors
/// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
pub fn record_images(
    r: &mut Recording,
    k: &TreeKernels,
    buffers: &Buffers,
    s: &Sizes,
    phases: Range<u32>,
    renamed: &[(&str, &str)],
) -> Result<()> {
    let seen = phases.len() as u32 * s.setup.n_views;
    let groups = Groups::Direct([s.n.div_ceil(LANES), seen, 1]);
    dispatch(r, &k.project, groups, buffers, renamed, [s.n, phases.start])?;
    record_splats(r, &k.common, buffers, renamed, s.n * seen)
}

/// Records the gradient of some phases, whose images are `first_image..last_image`.
fn record_gradient(
    r: &mut Recording,
    k: &TreeKernels,
    buffers: &Buffers,
    s: &Sizes,
    phases: Range<u32>,
    images: Range<u32>,
    renamed: &[(&str, &str)],
) -> Result<()> {
    let seen = s.n * phases.len() as u32 * s.setup.n_views;
    record_images(r, k, buffers, s, phases.clone(), renamed)?;
    record_residual(r, &k.common, buffers, renamed, &s.setup, images, seen)?;
    let push = [s.n, phases.start, phases.len() as u32];
    dispatch(r, &k.gradient, groups_for(&k.gradient, s.n), buffers, renamed, push)?;
    // The grid rests at phase 0.
    let moving = phases.start.max(1)..phases.end;
    let groups = Groups::Direct([(s.tree.nodes() as u32).div_ceil(LANES), moving.len() as u32, 1]);
    dispatch(r, &k.grid_gradient, groups, buffers, renamed, [s.n, moving.start])
}

fn record_grid_update(
    r: &mut Recording,
    k: &TreeKernels,
    buffers: &Buffers,
    s: &Sizes,
    phases: Range<u32>,
    renamed: &[(&str, &str)],
) -> Result<()> {
    let groups = Groups::Direct([(s.tree.nodes() as u32).div_ceil(LANES), phases.len() as u32, 1]);
    dispatch(r, &k.grid_update, groups, buffers, renamed, [phases.start])
}

/// Records one iteration over all phases.
///
/// # Errors
/// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
pub fn record_step(r: &mut Recording, k: &TreeKernels, buffers: &Buffers, s: &Sizes) -> Result<()> {
    let phases = s.setup.n_phases;
    record_gradient(r, k, buffers, s, 0..phases, 0..s.setup.n_images, &[])?;
    dispatch(r, &k.update, groups_for(&k.update, s.n), buffers, &[], [s.n])?;
    record_grid_update(r, k, buffers, s, 1..phases, &[])?;
    record_report(r, &k.common, buffers, &[])
}

/// Records the tracking of a phase from those before, nearest first, over its images.
///
/// # Errors
/// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
pub fn record_track(
    r: &mut Recording,
    k: &TreeKernels,
    buffers: &Buffers,
    s: &Sizes,
    path: [u32; 3],
    images: Range<u32>,
    iterations: u32,
) -> Result<()> {
    let phase = path[0];
    dispatch(r, &k.guess, groups_for(&k.guess, s.tree.nodes() as u32), buffers, &TRACKED[1..2], path)?;
    r.fill(buffers.get("track_state")?, 0);
    for _ in 0..iterations {
        record_gradient(r, k, buffers, s, phase..phase + 1, images.clone(), &TRACKED)?;
        record_grid_update(r, k, buffers, s, phase..phase + 1, &TRACKED)?;
        record_report(r, &k.common, buffers, &TRACKED)?;
    }
    Ok(())
}
