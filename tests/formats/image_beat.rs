//! Detection of the beat in images of a real coronary artery that follows a real heart (`../shared/data`, if present),
//! under breathing, inflow of contrast, and noise.

use crate::shared::shared;
use glam::DVec3;
use nertca_vk::geometry::{CArm, Geometry, ViewRays, world_from_lps_mm};
use nertca_vk::random::{STREAM_PHOTON, normal};
use nertca_vk::raster::Image;
use nertca_vk_import::image_beat::beat;
use serde::Deserialize;

const SIZE: usize = 96;
/// Standard deviation of the noise of a pixel; the thickest vessel adds 0.4.
const NOISE: f32 = 0.04;
const VIEWS: [(f64, f64); 4] = [(-30.0, 25.0), (-25.0, -25.0), (45.0, 20.0), (40.0, -25.0)];

/// Centrelines over one beat, patient axes RAS, mm.
#[derive(Deserialize)]
struct Tree {
    radius_mm: Vec<f64>,
    points_mm: Vec<Vec<[f64; 3]>>,
}

impl Tree {
    /// Point at a fraction of the beat, LPS mm.
    fn at(&self, point: usize, fraction: f64) -> DVec3 {
        let n = self.points_mm.len();
        let position = fraction.rem_euclid(1.0) * n as f64;
        let (low, share) = (position.floor() as usize % n, position.fract());
        let here = |t: usize| DVec3::from_array(self.points_mm[t][point]) * DVec3::new(-1.0, -1.0, 1.0);
        here(low).lerp(here((low + 1) % n), share)
    }
}

/// Acquisition of a run.
#[derive(Clone, Copy)]
struct Taken {
    beats_per_min: f64,
    frames_per_s: f64,
    images: usize,
    /// Time of the first R-peak, as a share of a beat.
    r_peak: f64,
}

fn images(tree: &Tree, rays: &ViewRays, taken: Taken) -> (Vec<Image>, Vec<f64>) {
    let times: Vec<f64> = (0..taken.images).map(|i| i as f64 / taken.frames_per_s).collect();
    let image = |(index, t): (usize, &f64)| {
        let mut image = Image::zeros(SIZE, SIZE);
        let breath = DVec3::new(0.0, 0.4, 1.5) * (std::f64::consts::TAU * t / 4.0).sin();
        let contrast = 1.0 - 0.7 * (-(t + 0.5) / 0.5).exp();
        for (point, radius) in tree.radius_mm.iter().enumerate() {
            let at = tree.at(point, t * taken.beats_per_min / 60.0 - taken.r_peak) + breath;
            let Some((u, v)) = rays.project(world_from_lps_mm(at)) else { continue };
            let (x, y) = (u.round() as usize, v.round() as usize);
            if x < SIZE && y < SIZE {
                image.values[y * SIZE + x] = image.values[y * SIZE + x].max((contrast * 0.2 * radius) as f32);
            }
        }
        // Adds a chest's gradient, and noise.
        for (p, value) in image.values.iter_mut().enumerate() {
            let noise = normal(1, STREAM_PHOTON, index as u32, p as u32);
            *value += 2.0 + 0.01 * (p / SIZE) as f32 + NOISE * noise as f32;
        }
        image
    };
    (times.iter().enumerate().map(image).collect(), times)
}

#[test]
fn a_real_heart_s_beat_is_found_in_every_view() {
    let Some(folder) = shared("anatomy") else { return };
    let text = std::fs::read_to_string(folder.join("coronary_tree_hra.json")).unwrap();
    let tree: Tree = serde_json::from_str(&text).unwrap();
    let rays_of = |(primary_deg, secondary_deg)| {
        let c_arm = CArm {
            primary_deg,
            secondary_deg,
            sid_mm: 1100.0,
            sod_mm: 750.0,
            pixel_mm: [2.2; 2],
            offset_mm: [0.0; 2],
            table_mm: [0.0; 3],
        };
        Geometry::CArm(c_arm).rays(SIZE, SIZE).unwrap()
    };
    let runs = [
        Taken { beats_per_min: 70.0, frames_per_s: 15.0, images: 45, r_peak: 0.35 },
        Taken { beats_per_min: 60.0, frames_per_s: 15.0, images: 40, r_peak: 0.8 },
        Taken { beats_per_min: 85.0, frames_per_s: 30.0, images: 60, r_peak: 0.1 },
        Taken { beats_per_min: 75.0, frames_per_s: 7.5, images: 22, r_peak: 0.6 },
    ];
    for taken in runs {
        let offsets: Vec<f64> = VIEWS
            .iter()
            .map(|angles| {
                let (images, times) = images(&tree, &rays_of(*angles), taken);
                let found = beat(&images.iter().collect::<Vec<_>>(), &times, 2).unwrap();
                let rate = found.beats_per_min / taken.beats_per_min;
                assert!(
                    (rate - 1.0).abs() < 0.03,
                    "{:.1} for {:.1} per minute",
                    found.beats_per_min,
                    taken.beats_per_min
                );
                let off = found.r_peaks.times_s()[1] * taken.beats_per_min / 60.0 - taken.r_peak;
                off - off.round()
            })
            .collect();
        println!(
            "{:.0} per minute, {} frames/s: R-peaks off by {offsets:.3?} of a beat",
            taken.beats_per_min, taken.frames_per_s
        );
        assert!(offsets.iter().all(|off| off.abs() < 0.1), "{:.0} per minute: {offsets:?}", taken.beats_per_min);
    }
}
