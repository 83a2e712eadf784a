//! The device's projector against the f64 one, to 1e-4 relative.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

mod common;

use common::{expect_silence, gpu, relative_error};
use glam::{DAffine3, DMat3, DVec3};
use nertca_vk::formats::volume::Volume;
use nertca_vk::geometry::{CArm, Geometry};
use nertca_vk::phantom::projector::Projector;
use nertca_vk::reference::projector::project_pixel;

#[test]
fn device_and_f64_projector_agree() {
    let gpu = gpu();
    let size = [23, 17, 29];
    let values = (0..size.iter().product::<usize>())
        .map(|i| {
            let (x, y, z) = (i % 23, i / 23 % 17, i / (23 * 17));
            0.01 + 0.002 * ((x * 7 + y * 3 + z * 5) % 11) as f32
        })
        .collect();
    // Oblique, anisotropic and off-centre, as a scanner would have it.
    let axes = DMat3::from_euler(glam::EulerRot::XYZ, 0.3, -0.2, 0.5) * DMat3::from_diagonal(DVec3::new(2.0, 3.1, 1.4));
    let volume =
        Volume { size, values, index_to_lps: DAffine3::from_mat3_translation(axes, DVec3::new(-20.0, -31.0, -17.0)) };
    let arms: Vec<_> = [(-30.0, 25.0), (90.0, 0.0), (0.0, 0.0)]
        .map(|(primary_deg, secondary_deg)| {
            let arm = CArm {
                primary_deg,
                secondary_deg,
                sid_mm: 1100.0,
                sod_mm: 750.0,
                pixel_mm: [6.0, 5.0],
                offset_mm: [3.0, 0.0],
                table_mm: [0.0; 3],
            };
            Geometry::CArm(arm).rays(21, 19).unwrap()
        })
        .to_vec();
    let projector = Projector::new(&gpu, 21, 19).unwrap();
    let loaded = projector.load(volume.clone()).unwrap();
    let images = projector.project(&loaded, &arms, DVec3::ZERO).unwrap();
    for (view, image) in images.iter().enumerate() {
        let want: Vec<f64> = (0..21 * 19).map(|p| project_pixel(&volume, &arms[view], p % 21, p / 21)).collect();
        let (error, at) = relative_error(image, &want);
        assert!(error < 1e-4, "view {view} pixel {at}: {} against {}", image[at], want[at]);
        assert!(want.contains(&0.0) && want.iter().any(|v| *v > 0.5), "rays must both hit and miss");
    }
    // Moving the volume moves the image: the same as a volume with another origin.
    let shift = DVec3::new(4.0, -3.0, 8.0);
    let mut moved = volume.clone();
    moved.index_to_lps.translation += shift;
    let image = projector.project(&loaded, &arms[..1], shift).unwrap().swap_remove(0);
    let want: Vec<f64> = (0..21 * 19).map(|p| project_pixel(&moved, &arms[0], p % 21, p / 21)).collect();
    assert!(relative_error(&image, &want).0 < 1e-4);
    drop((projector, loaded));
    expect_silence(gpu);
}
