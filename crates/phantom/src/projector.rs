//! Line integrals through voxel volumes on the device, for phantoms and `project`.

use crate::error::Result;
use crate::formats::volume::Volume;
use crate::geometry::{MM_PER_UNIT, ViewRays, world_to_index};
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::gpu::record::Recording;
use crate::kernels::dispatch::{Binding, dispatch};
use crate::kernels::layout::View;
use crate::kernels::push;
use crate::kernels::stages::{Build, Stage};
use glam::DVec3;

/// Side of a block of voxels that is skipped where all of it is zero, voxels; `BLOCK` of the shader.
const BLOCK: usize = 8;

/// Number of depth steps, of half a voxel each, for a projection through `volume` over `half_depth` (world units) on both
/// sides.
pub fn depth_steps(volume: &Volume, half_depth: f64) -> u32 {
    (2.0 * half_depth * MM_PER_UNIT / (0.5 * volume.spacing_mm())).ceil() as u32
}

/// Projector on the device, for images of one size.
pub struct Projector {
    gpu: Gpu,
    project: Stage<push::Project>,
    width: usize,
    height: usize,
}

/// A volume on the device.
pub struct LoadedVolume {
    values: Buffer,
    occupied: Buffer,
    volume: Volume,
}

impl Projector {
    /// Makes a projector for `width` x `height` images.
    ///
    /// # Errors
    /// Errors of creating the pipeline.
    pub fn new(gpu: &Gpu, width: usize, height: usize) -> Result<Projector> {
        Ok(Projector { gpu: gpu.clone(), project: Build::default().stage(gpu)?, width, height })
    }

    /// Loads a volume onto the device; its values on the host are freed.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`].
    pub fn load(&self, mut volume: Volume) -> Result<LoadedVolume> {
        let values = self.gpu.buffer_with("volume", &volume.values)?;
        let occupied = self.gpu.buffer_with("occupied", &occupied_blocks(&volume))?;
        volume.values = Vec::new();
        Ok(LoadedVolume { values, occupied, volume })
    }

    /// Line integrals (attenuation per mm times mm) of `volume`, displaced by `shift_mm` (LPS), for each view.
    ///
    /// # Errors
    /// Device errors.
    pub fn project(&self, loaded: &LoadedVolume, views: &[ViewRays], shift_mm: DVec3) -> Result<Vec<Vec<f32>>> {
        let pixels = self.width * self.height;
        let device_views: Vec<View> = views.iter().map(View::of).collect();
        let views_buffer = self.gpu.buffer_with("views", &device_views)?;
        let integrals = self.gpu.buffer("integrals", (views.len() * pixels * 4) as u64, Memory::Device)?;
        let mut volume = loaded.volume.clone();
        volume.index_to_lps.translation += shift_mm;
        let to_index = world_to_index(&volume.index_to_lps);
        let [row_x, row_y, row_z] = [0, 1, 2].map(|r| {
            let row = to_index.matrix3.row(r);
            [row.x as f32, row.y as f32, row.z as f32, to_index.translation[r] as f32]
        });
        let half_depth = bounding_radius(&volume);
        let mut recording = Recording::new(&self.gpu, "project")?;
        recording.fill(&integrals, 0);
        for (view, rays) in views.iter().enumerate() {
            let half = half_depth.min(rays.sod);
            let push = push::Project {
                row_x,
                row_y,
                row_z,
                size: volume.size.map(|n| n as u32),
                view: view as u32,
                near: -half as f32,
                far: half as f32,
                steps: depth_steps(&volume, half),
                scale: MM_PER_UNIT as f32,
                image_width: self.width as u32,
                n_pixels: pixels as u32,
                first_pixel: (view * pixels) as u32,
            };
            let bound = [
                (Binding::views, (&views_buffer).into()),
                (Binding::volume, (&loaded.values).into()),
                (Binding::occupied, (&loaded.occupied).into()),
                (Binding::integrals, (&integrals).into()),
            ];
            dispatch(&mut recording, &self.project, self.project.groups_over(pixels as u32), &bound, push)?;
        }
        self.gpu.wait(recording.finish()?.submit()?)?;
        let all: Vec<f32> = self.gpu.download(&integrals, 0, views.len() * pixels)?;
        Ok(all.chunks(pixels).map(<[f32]>::to_vec).collect())
    }
}

/// Returns 1 for each block of voxels where the block, or a voxel next to its upper faces, edges or corner, is not zero: a sample in any other
/// block is zero. Blocks are ordered as voxels are.
fn occupied_blocks(volume: &Volume) -> Vec<u32> {
    let blocks = volume.size.map(|n| n.div_ceil(BLOCK));
    let [columns, rows, _] = volume.size;
    let mut occupied = vec![0; blocks.iter().product()];
    for (row, values) in volume.values.chunks(columns.max(1)).enumerate() {
        let (y, z) = (row % rows, row / rows);
        for x in (0..values.len()).filter(|x| values[*x] != 0.0) {
            // A voxel is also interpolated by samples of the voxels before it.
            let of = |at: usize| at.saturating_sub(1) / BLOCK..=at / BLOCK;
            for (bz, by) in of(z).flat_map(|bz| of(y).map(move |by| (bz, by))) {
                of(x).for_each(|bx| occupied[(bz * blocks[1] + by) * blocks[0] + bx] = 1);
            }
        }
    }
    occupied
}

/// Largest distance of a volume's corner from the isocentre, world units.
pub fn bounding_radius(volume: &Volume) -> f64 {
    let mut radius = 0f64;
    for corner in 0..8 {
        let at = |axis: usize| {
            if corner >> axis & 1 == 1 { volume.size[axis] as f64 } else { -1.0 }
        };
        let p = volume.index_to_lps.transform_point3(DVec3::new(at(0), at(1), at(2)));
        radius = radius.max(p.length());
    }
    radius / MM_PER_UNIT
}
