//! Pictures that X-Gaussian's Gaussians give of any view: blended front to back by the stages that fit them.

use crate::error::{Error, Result};
use crate::gaussians::blending::opacity::stored_opacity;
use crate::gaussians::blending::particles::BlendedGaussians;
use crate::gaussians::blending::stages::{BlendBuffers, BlendKernels, BlendPass};
use crate::gaussians::blending::{FIXED_POINT_BITS, NEAREST_MM, TILE};
use crate::gaussians::field::{Gaussians, Units};
use crate::gaussians::view::SplatView;
use crate::geometry::{MM_PER_UNIT, ViewRays};
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::gpu::record::Recording;
use crate::kernels::layout::{
    BlendCounts, BlendEnd, BlendGaussian, BlendList, BlendSetup, Gaussian, GaussianSetup, PictureTurn,
};

/// A unit of pictures in fixed point.
pub fn unit() -> f32 {
    2f32.powi(-FIXED_POINT_BITS)
}

/// Entries of all tiles' lists per Gaussian for which there is room at first.
const FIRST_ENTRIES: u32 = 4;
/// Additional room of lists: one part in so many of what they need.
const MORE_ROOM: u32 = 4;

/// Room for the lists of `n` Gaussians before their need is known.
pub fn first_capacity(n: u32, limit: u32) -> u32 {
    (FIRST_ENTRIES * n.max(256)).min(limit)
}

/// Room for lists that need more than there was. `asked` is the setting or size that they follow from, and its value; `remedy` makes them
/// shorter.
///
/// # Errors
/// [`Error::Config`] where the device has no buffer so large.
pub fn more_capacity(needed: u32, limit: u32, asked: (&str, u64), remedy: &str) -> Result<u32> {
    if needed > limit {
        let problem = format!(
            "the Gaussians cover {needed} tiles of 16 x 16 pixels, and the largest buffer of this device has room for \
             {limit}: use {remedy}"
        );
        let (field, value) = asked;
        return Err(Error::config(field, value, problem));
    }
    Ok(needed.saturating_add(needed / MORE_ROOM).min(limit))
}

/// Draws a set of Gaussians, one view after the other.
pub struct BlendedPicture {
    scene: BlendBuffers,
    seen: BlendedGaussians,
    x: BlendSetup,
    units: Units,
    n: u32,
}

/// Drawable form of a Gaussian of a model.
fn drawn((g, intensity): &(Gaussian, f32)) -> BlendGaussian {
    BlendGaussian {
        position: g.position,
        opacity: stored_opacity(g.log_density.into()) as f32,
        log_scale: g.log_scale,
        intensity: *intensity,
        rotation: g.rotation,
    }
}

impl BlendedPicture {
    /// Prepares to draw the Gaussians of a phase in pictures of `size` (columns, rows).
    ///
    /// # Errors
    /// Device errors.
    pub fn new(gpu: &Gpu, field: &Gaussians, phase: usize, [width, height]: [usize; 2]) -> Result<BlendedPicture> {
        let rows: Vec<BlendGaussian> = field.blended_at(phase).iter().map(drawn).collect();
        let n = rows.len() as u32;
        // Buffers are never empty.
        let rows = if rows.is_empty() { vec![BlendGaussian::default()] } else { rows };
        let pixels = (width * height) as u32;
        let setup = GaussianSetup {
            n_views: 1,
            n_phases: 1,
            width: width as u32,
            height: height as u32,
            fixed_point: 1.0 / unit(),
            n_images: 1,
            image_stride: pixels,
            ..GaussianSetup::default()
        };
        let x = BlendSetup {
            nearest: (NEAREST_MM / (field.units.pixel * MM_PER_UNIT)) as f32,
            n_sets: 1,
            tile_columns: (width as u32).div_ceil(TILE),
            tile_rows: (height as u32).div_ceil(TILE),
            capacity: first_capacity(n, capacity_limit(gpu)),
            absolute_weight: 1.0,
        };
        let n_tiles = u64::from(x.tile_columns * x.tile_rows);
        let new = |name: &str, bytes: u64| gpu.buffer(name, bytes, Memory::Device);
        let view_bytes = size_of::<crate::kernels::layout::GaussianView>() as u64;
        let scene = BlendBuffers {
            gaussian_setup: gpu.buffer_with("gaussian_setup of a picture", &[setup])?,
            blend_setup: gpu.buffer_with("blend_setup of a picture", &[x])?,
            gaussian_views: gpu.buffer("gaussian_views of a picture", view_bytes, Memory::Upload)?,
            picture_turns: gpu.buffer_with("picture_turns of a picture", &[PictureTurn::default()])?,
            gaussian_step: gpu.buffer_with("gaussian_step of a picture", &[0u32])?,
            blend_tile_counts: new("blend_tile_counts of a picture", 4 * n_tiles)?,
            blend_counts: gpu.buffer("blend_counts of a picture", size_of::<BlendCounts>() as u64, Memory::Readback)?,
            blend_lists: new("blend_lists of a picture", size_of::<BlendList>() as u64 * n_tiles)?,
            splat_images: gpu.buffer("splat_images of a picture", 4 * u64::from(pixels), Memory::Readback)?,
            blend_ends: new("blend_ends of a picture", size_of::<BlendEnd>() as u64 * u64::from(pixels))?,
        };
        let seen = BlendedGaussians::new(gpu, &rows, &vec![0; rows.len()], 1, x.capacity)?;
        Ok(BlendedPicture { scene, seen, x, units: field.units, n })
    }

    /// Draws a view: the picture in fixed point, rows first.
    ///
    /// # Errors
    /// [`Error::Config`] where no buffer holds the tiles' lists; device errors.
    pub fn draw(&mut self, gpu: &Gpu, kernels: &BlendKernels, rays: &ViewRays) -> Result<&Buffer> {
        self.scene.gaussian_views.write(&[SplatView::new(rays, self.units).to_device()])?;
        loop {
            let mut recording = Recording::new(gpu, "blended picture of Gaussians")?;
            let (scene, seen, x, n) = (&self.scene, &self.seen, &self.x, self.n);
            if n == 0 {
                recording.fill(&scene.splat_images, 0);
                recording.fill(&scene.blend_counts, 0);
            } else {
                BlendPass { recording: &mut recording, kernels, scene, seen, x, n }.record()?;
            }
            gpu.wait(recording.finish()?.submit()?)?;
            let mut counts = [BlendCounts::default()];
            scene.blend_counts.read(&mut counts)?;
            if counts[0].entries <= self.x.capacity {
                return Ok(&self.scene.splat_images);
            }
            let columns = u64::from(self.x.tile_columns * TILE);
            self.x.capacity =
                more_capacity(counts[0].entries, capacity_limit(gpu), ("size", columns), "smaller pictures")?;
            gpu.upload(&self.scene.blend_setup, 0, &[self.x])?;
            self.seen.make_room(gpu, self.x.capacity)?;
        }
    }
}

/// Maximum number of list entries that a buffer holds.
fn capacity_limit(gpu: &Gpu) -> u32 {
    gpu.info().max_storage_buffer_range / size_of::<u32>() as u32
}
