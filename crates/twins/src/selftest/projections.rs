//! Line integrals through voxel volumes, which phantoms are made with.

use crate::error::Result;
use crate::formats::volume::Volume;
use crate::geometry::{CArm, Geometry, ViewRays};
use crate::gpu::device::Gpu;
use crate::kernels::push::{self, PushConstants};
use crate::reference::projector::project_pixel;
use crate::scan::small;
use crate::selftest::compare::{Findings, Tolerance};
use glam::{DAffine3, DMat3, DVec3};
use nertca_vk_phantom::projector::Projector;

const PROJECT: &[&str] = &[push::Project::SHADER];
/// Positions in f32.
const PIXEL: Tolerance = Tolerance::OfLargest(1e-4);
/// Columns and rows.
const SIZE: [usize; 2] = [21, 19];

/// Compares projections from three sides, and of the volume moved.
///
/// # Errors
/// Device errors.
pub fn compare(gpu: &Gpu, findings: &mut Findings) -> Result<()> {
    findings.begin("f32", "23 x 17 x 29 voxels");
    let size = [23, 17, 29];
    let value = |i: usize| {
        let (x, y, z) = (i % 23, i / 23 % 17, i / (23 * 17));
        // Blocks that are left out, and one with a single voxel in its corner.
        if x >= 8 && z < 16 && [x, y, z] != [16, 16, 8] {
            return 0.0;
        }
        0.01 + 0.002 * ((x * 7 + y * 3 + z * 5) % 11) as f32
    };
    let values = (0..size.iter().product::<usize>()).map(value).collect();
    // Oblique, anisotropic and off-centre, as a scanner would have it.
    let axes = DMat3::from_euler(glam::EulerRot::XYZ, 0.3, -0.2, 0.5) * DMat3::from_diagonal(DVec3::new(2.0, 3.1, 1.4));
    let index_to_lps = DAffine3::from_mat3_translation(axes, DVec3::new(-20.0, -31.0, -17.0));
    let volume = Volume { size, values, index_to_lps };
    let views = [(-30.0, 25.0), (90.0, 0.0), (0.0, 0.0)].map(rays);
    let views = views.into_iter().collect::<Result<Vec<ViewRays>>>()?;
    let [width, height] = SIZE;
    let projector = Projector::new(gpu, width, height)?;
    let loaded = projector.load(volume.clone())?;
    let twin = |volume: &Volume, rays: &ViewRays| -> Vec<f64> {
        (0..width * height).map(|p| project_pixel(volume, rays, p % width, p / width)).collect()
    };
    for (view, image) in projector.project(&loaded, &views, DVec3::ZERO)?.iter().enumerate() {
        let want = twin(&volume, &views[view]);
        findings.numbers(PROJECT, &format!("view {view}"), image, &want, PIXEL);
        findings.require(PROJECT, "rays that miss the volume", want.contains(&0.0));
    }
    // Moving the volume moves the image: the same as a volume with another origin.
    let shift_mm = DVec3::new(4.0, -3.0, 8.0);
    let mut moved = volume;
    moved.index_to_lps.translation += shift_mm;
    for image in projector.project(&loaded, &views[..1], shift_mm)? {
        findings.numbers(PROJECT, "moved volume", &image, &twin(&moved, &views[0]), PIXEL);
    }
    Ok(())
}

fn rays((primary_deg, secondary_deg): (f64, f64)) -> Result<ViewRays> {
    let arm = CArm {
        primary_deg,
        secondary_deg,
        sid_mm: 1100.0,
        sod_mm: 750.0,
        pixel_mm: [6.0, 5.0],
        offset_mm: [3.0, 0.0],
        table_mm: [0.0; 3],
    };
    small::rays(&Geometry::CArm(arm), SIZE[0], SIZE[1])
}
